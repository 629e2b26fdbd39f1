"""Radiance along one ray: direct light, and what mirrors show."""

import functools
from collections.abc import Iterable

import jax.numpy as jnp
from jax import lax

from ..core.ray import Ray
from ..core.settings import Settings
from ..core.types import Flag, Index, Vector
from ..core.vector import dot, select, unit
from ..preparation.world import World, first_hit, no_hit
from ..scene.light import Sky
from ..scene.material import Material, Matte, Mirror
from ..scene.texture import ImageTexture
from ..trace.hit import Hit, Status
from ..xla.masked import only_where
from .lighting import GRAZING, irradiance, sharp_lights, unshadowed_irradiance


def radiance(world: World, ray: Ray) -> tuple[Vector, Index]:
    """What comes along a camera ray against its direction, shape (3,), and how many walks ran out of steps on the way."""
    if not has_mirrors(world.materials, world.settings):
        return direct(world, ray)[:2]
    return _path(world, ray, no_hit(ray.d.dtype), jnp.ones((), bool), world.settings.max_depth + 1)


def radiance_from(world: World, ray: Ray, hit: Hit, active: Flag) -> Vector:
    """`radiance` along a ray whose first hit is known; zero unless active."""
    light, _ = _outgoing(world, ray, hit, active)
    if not has_mirrors(world.materials, world.settings):
        return light
    onwards, reflectance, mirrored = _mirrored(world, ray, hit)
    return light + reflectance * _path(world, onwards, hit, active & mirrored, world.settings.max_depth)[0]


def shadowed_radiance(world: World, number: Index, hit: Hit) -> Vector:
    """By how much the shadow of the light of this number darkens the hit, if nothing else keeps that light from it.

    Only what is matte has shadows; what it sends out is the same in all directions.
    """
    albedo, dark = _albedo(world, hit), jnp.zeros_like(hit.n)
    if albedo is None:
        return dark
    arriving = ((k, unshadowed_irradiance(world, light, hit)) for k, light in sharp_lights(world))
    return jnp.where(_has_material(world, hit, Matte), albedo / jnp.pi * select(number, arriving, dark), 0)


def _path(world: World, ray: Ray, leaving: Hit, active: Flag, length: int) -> tuple[Vector, Index]:
    """The light of at most `length` hits along a ray and its mirrored rays, and how many walks ran out of steps."""

    def bounce(carry, _):
        ray, leaving, throughput, total, active, exhausted = carry
        arrived = only_where(active, _bounce, world, ray, leaving, active, skips=world.settings.early_exit)
        mirrored_ray, hit, reflectance, light, goes_on, more = arrived
        carry = mirrored_ray, hit, throughput * reflectance, total + throughput * light, goes_on, exhausted + more
        return carry, None

    dtype = ray.d.dtype
    none = jnp.zeros((), jnp.int32)
    init = (ray, leaving, jnp.ones(3, dtype), jnp.zeros(3, dtype), active, none)
    (_, _, _, total, _, exhausted), _ = lax.scan(bounce, init, length=length)
    return total, exhausted


def has_mirrors(materials: Iterable[Material], settings: Settings) -> bool:
    """Whether light may come by way of a mirror."""
    return settings.max_depth > 0 and any(isinstance(material, Mirror) for material in materials)


def direct(world: World, ray: Ray, leaving: Hit | None = None, active: Flag | None = None) -> tuple[Vector, Index, Hit]:
    """`radiance` of a scene without mirrors, and the hit that it comes from; `leaving` and `active` as for `first_hit`."""
    hit = first_hit(world, ray, leaving, active)
    ran_out = hit.status == int(Status.EXHAUSTED)
    light, exhausted = _outgoing(world, ray, hit, ~ran_out if active is None else active & ~ran_out)
    return light, exhausted + ran_out.astype(jnp.int32), hit


def _bounce(world: World, ray: Ray, leaving: Hit, active: Flag) -> tuple[Ray, Hit, Vector, Vector, Flag, Index]:
    """One segment of a path: to the next hit, and the mirrored ray from there.

    Returns:
      The mirrored ray, the hit that it leaves, and that mirror's reflectance; the light from the hit; whether the path goes
      on; how many walks ran out of steps.
    """
    light, exhausted, hit = direct(world, ray, leaving, active)
    onwards, reflectance, mirrored = _mirrored(world, ray, hit)
    return onwards, hit, reflectance, light, active & mirrored, exhausted


def _mirrored(world: World, ray: Ray, hit: Hit) -> tuple[Ray, Vector, Flag]:
    """The mirrored ray from a hit, the mirror's reflectance, and whether there is a mirror."""
    values = [(number, jnp.asarray(m.reflectance)) for number, m in enumerate(world.materials) if isinstance(m, Mirror)]
    return Ray(hit.p, _reflect(ray.d, hit)), select(hit.object, values), _has_material(world, hit, Mirror)


def _outgoing(world: World, ray: Ray, hit: Hit, active: Flag) -> tuple[Vector, Index]:
    """Light that a matte surface sends back along `ray`, or the sky where there is no surface."""
    met = active & (hit.status == int(Status.HIT))
    total, exhausted = jnp.zeros_like(ray.d), jnp.zeros((), jnp.int32)
    albedo = _albedo(world, hit)
    if albedo is not None:
        matte = met & _has_material(world, hit, Matte)
        for number in range(len(world.lights)):
            arriving, more = only_where(
                matte, functools.partial(irradiance, number), world, hit, matte, skips=world.settings.early_exit
            )
            total, exhausted = total + arriving, exhausted + more
        total = jnp.where(matte, albedo / jnp.pi * total, 0)
    for light in world.lights:
        if isinstance(light, Sky):
            total = total + jnp.where(active & (hit.status == int(Status.MISS)), light.radiance, 0)
    return total, exhausted


def _reflect(d: Vector, hit: Hit) -> Vector:
    """The mirrored direction about the shading normal, lifted where it would dive below the triangle itself.

    The lift along n is smooth and begins 0.6 degrees above the surface; the idea of bending a reflection
    back is that of Keller et al. (The Iray light transport simulation and rendering system, 2017, appendix A.3).
    """
    out = d - 2 * dot(d, hit.ns) * hit.ns
    n = hit.n * hit.side.astype(d.dtype)
    height = dot(out, n)
    low = height < GRAZING
    lifted = GRAZING**2 / jnp.where(low, 2 * GRAZING - height, 1)
    return jnp.where(low, unit(out + (lifted - height) * n), out)


def _has_material(world: World, hit: Hit, kind: type) -> Flag:
    """Whether the hit lies on an object of this kind of material."""
    flags = [isinstance(material, kind) for material in world.materials]
    if all(flags):
        return hit.object >= 0
    found = jnp.zeros((), bool)
    for number, flag in enumerate(flags):
        found = found | (hit.object == number) if flag else found
    return found


def _albedo(world: World, hit: Hit) -> Vector | None:
    """That of the object which was hit; None where no object is matte."""
    values = [
        (number, m.albedo(hit.uv) if isinstance(m.albedo, ImageTexture) else jnp.asarray(m.albedo))
        for number, m in enumerate(world.materials)
        if isinstance(m, Matte)
    ]
    return select(hit.object, values) if values else None
