"""Radiance along one ray: direct light, and what mirrors show."""

import functools
from collections.abc import Iterable

import jax.numpy as jnp
from jax import lax

from ..core.ray import Ray
from ..core.settings import Settings
from ..core.types import Flag, Index, Vector
from ..core.vector import GRAZING, dot, select, unit
from ..preparation.world import World, first_hit, no_hit
from ..scene.light import Sky
from ..scene.material import Material, Mirror
from ..trace.hit import Hit, Status
from ..xla.masked import only_where
from .lighting import light_from, sharp_lights, unshadowed_light
from .reflectance import depends_on_view, has_material, matte_albedo


def radiance(world: World, ray: Ray) -> tuple[Vector, Index]:
    """What comes along a camera ray against its direction, shape (3,), and how many walks ran out of steps on the way."""
    if not has_mirrors(world.materials, world.settings):
        return direct(world, ray)[:2]
    return _path(world, ray, no_hit(ray.d.dtype), jnp.ones((), bool), world.settings.max_depth + 1)


def radiance_and_hit(world: World, ray: Ray, count_steps: bool) -> tuple[Vector, Index, Hit]:
    """`radiance`, and the ray's first hit."""
    if not has_mirrors(world.materials, world.settings):
        return direct(world, ray, count_steps=count_steps)
    return *radiance(world, ray), first_hit(world, ray, count_steps=count_steps)


def radiance_from(world: World, ray: Ray, hit: Hit, active: Flag) -> Vector:
    """`radiance` along a ray whose first hit is known; zero unless active."""
    light, _ = _outgoing(world, ray, hit, active)
    if not has_mirrors(world.materials, world.settings):
        return light
    onwards, reflectance, mirrored = _mirrored(world, ray, hit)
    return light + reflectance * _path(world, onwards, hit, active & mirrored, world.settings.max_depth)[0]


def shadowed_radiance(world: World, number: Index, hit: Hit, wo: Vector | None) -> Vector:
    """By how much the shadow of the light of this number darkens the hit, if nothing else keeps that light from it.

    `wo` is as for `light_from`. A mirror has no shadows.
    """
    dark = jnp.zeros_like(hit.n)
    if not _scatters(world):
        return dark
    albedo = matte_albedo(world, hit) if wo is None else None
    arriving = ((k, unshadowed_light(world, light, hit, wo)) for k, light in sharp_lights(world))
    return jnp.where(has_material(world, hit, Material), _times(albedo, select(number, arriving, dark)), 0)


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


def has_mirrors(materials: Iterable[Material | Mirror], settings: Settings) -> bool:
    """Whether light may come by way of a mirror."""
    return settings.max_depth > 0 and any(isinstance(material, Mirror) for material in materials)


def direct(
    world: World, ray: Ray, leaving: Hit | None = None, active: Flag | None = None, count_steps: bool = False
) -> tuple[Vector, Index, Hit]:
    """`radiance` of a scene without mirrors, and the hit that it comes from; the other arguments as for `first_hit`."""
    hit = first_hit(world, ray, leaving, active, count_steps)
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
    return Ray(hit.p, _reflect(ray.d, hit)), select(hit.object, values), has_material(world, hit, Mirror)


def _outgoing(world: World, ray: Ray, hit: Hit, active: Flag) -> tuple[Vector, Index]:
    """Light that a surface scatters back along `ray`, or the sky where there is no surface."""
    met = active & (hit.status == int(Status.HIT))
    total, exhausted = jnp.zeros_like(ray.d), jnp.zeros((), jnp.int32)
    if _scatters(world):
        wo = unit(-ray.d) if depends_on_view(world) else None
        albedo = matte_albedo(world, hit) if wo is None else None
        lit = met & has_material(world, hit, Material)
        for number in range(len(world.lights)):
            light = functools.partial(light_from, number)
            arriving, more = only_where(lit, light, world, hit, wo, lit, skips=world.settings.early_exit)
            total, exhausted = total + arriving, exhausted + more
        total = jnp.where(lit, _times(albedo, total), 0)
    for light in world.lights:
        if isinstance(light, Sky):
            total = total + jnp.where(active & (hit.status == int(Status.MISS)), light.radiance, 0)
    return total, exhausted


def _scatters(world: World) -> bool:
    return any(isinstance(material, Material) for material in world.materials)


def _times(albedo: Vector | None, light: Vector) -> Vector:
    """Light times a Lambertian BRDF; as it is, if it has been multiplied by another one."""
    return light if albedo is None else albedo / jnp.pi * light


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
