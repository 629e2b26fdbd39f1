"""Radiance along one ray: direct light, shadows, mirrors."""

import functools
from collections.abc import Iterable

import jax.numpy as jnp
from jax import lax

from ..core.masked import only_where
from ..core.ray import Ray
from ..core.settings import Settings
from ..core.types import Flag, Index, Vector
from ..core.vector import dot, unit
from ..scene.light import Sky
from ..scene.material import Material, Matte, Mirror
from ..scene.texture import ImageTexture
from ..trace.hit import Hit
from ..trace.status import Status
from ..trace.world import Vertex, World, first_vertex, nowhere
from .lighting import _GRAZING, _count, _irradiance


def radiance(world: World, ray: Ray, settings: Settings) -> tuple[Vector, Index]:
    """What comes along a camera ray against its direction, shape (3,), and how many walks ran out of steps on the way."""
    if not mirrors(world.materials, settings):
        return direct(world, ray, settings)[:2]

    def bounce(carry, _):
        ray, origin, throughput, total, active, exhausted = carry
        reached = only_where(active, functools.partial(_bounce, settings), world, ray, origin, active)
        mirrored_ray, vertex, reflectance, light, goes_on, more = reached
        carry = mirrored_ray, vertex, throughput * reflectance, total + throughput * light, goes_on, exhausted + more
        return carry, None

    dtype = ray.d.dtype
    none = jnp.zeros((), jnp.int32)
    init = (ray, nowhere(dtype), jnp.ones(3, dtype), jnp.zeros(3, dtype), jnp.ones((), bool), none)
    (_, _, _, total, _, exhausted), _ = lax.scan(bounce, init, length=settings.max_depth + 1)
    return total, exhausted


def mirrors(materials: Iterable[Material], settings: Settings) -> bool:
    """Whether light may come by way of a mirror."""
    return settings.max_depth > 0 and any(isinstance(material, Mirror) for material in materials)


def direct(world: World, ray: Ray, settings: Settings) -> tuple[Vector, Index, Vertex]:
    """`radiance` where there are no mirrors, and from where it comes."""
    vertex = first_vertex(world, ray, settings)
    light, exhausted = _outgoing(world, ray, vertex, vertex.hit.status != int(Status.EXHAUSTED), settings)
    return light, exhausted + _count(vertex.hit.status == int(Status.EXHAUSTED)), vertex


def _bounce(
    settings: Settings, world: World, ray: Ray, origin: Vertex, active: Flag
) -> tuple[Ray, Vertex, Vector, Vector, Flag, Index]:
    """Follows `ray` to where it arrives.

    Returns:
      The mirrored ray, where it starts, and by how much it weighs less; the light from there; whether to go on; how many
      walks ran out of steps.
    """
    vertex = first_vertex(world, ray, settings, origin, active)
    out_of_steps = active & (vertex.hit.status == int(Status.EXHAUSTED))
    light, exhausted = _outgoing(world, ray, vertex, active & ~out_of_steps, settings)
    mirrored, reflectance = _mirrored(world, vertex)
    onwards = Ray(vertex.hit.p, _reflect(ray.d, vertex.hit))
    return onwards, vertex, reflectance, light, active & mirrored, exhausted + _count(out_of_steps)


def _outgoing(world: World, ray: Ray, vertex: Vertex, active: Flag, settings: Settings) -> tuple[Vector, Index]:
    """Light that a matte surface sends back along `ray`, or the sky where there is no surface."""
    hit = active & (vertex.hit.status == int(Status.HIT))
    total, exhausted = jnp.zeros_like(ray.d), jnp.zeros((), jnp.int32)
    albedo = _albedo(world, vertex)
    if albedo is not None:
        matte = hit & _is(world, vertex, Matte)
        for light in world.lights:
            irradiance, more = only_where(matte, functools.partial(_irradiance, settings), world, light, vertex, matte)
            total, exhausted = total + irradiance, exhausted + more
        total = jnp.where(matte, albedo / jnp.pi * total, 0)
    for light in world.lights:
        if isinstance(light, Sky):
            total = total + jnp.where(active & (vertex.hit.status == int(Status.MISS)), light.radiance, 0)
    return total, exhausted


def _reflect(d: Vector, hit: Hit) -> Vector:
    """The mirrored direction about the shading normal, lifted where it would dive below the triangle itself.

    The lift along n is smooth and begins 0.6 degrees above the surface; the idea of bending a reflection
    back is that of Keller et al. (The Iray light transport simulation and rendering system, 2017, appendix A.3).
    """
    out = d - 2 * dot(d, hit.ns) * hit.ns
    n = hit.n * hit.side.astype(d.dtype)
    height = dot(out, n)
    low = height < _GRAZING
    lifted = _GRAZING**2 / jnp.where(low, 2 * _GRAZING - height, 1)
    return jnp.where(low, unit(out + (lifted - height) * n), out)


def _is(world: World, vertex: Vertex, kind: type) -> Flag:
    """Whether the vertex lies on an object of a material."""
    flags = [isinstance(material, kind) for material in world.materials]
    if all(flags):
        return vertex.index >= 0
    found = jnp.zeros((), bool)
    for k, flag in enumerate(flags):
        found = found | (vertex.index == k) if flag else found
    return found


def _albedo(world: World, vertex: Vertex) -> Vector | None:
    """That of the object which was hit; None where no object is matte."""
    values = [
        (k, m.albedo(vertex.hit.uv) if isinstance(m.albedo, ImageTexture) else jnp.asarray(m.albedo))
        for k, m in enumerate(world.materials)
        if isinstance(m, Matte)
    ]
    return _select(values, vertex.index)


def _mirrored(world: World, vertex: Vertex) -> tuple[Flag, Vector]:
    values = [(k, jnp.asarray(m.reflectance)) for k, m in enumerate(world.materials) if isinstance(m, Mirror)]
    reflectance = _select(values, vertex.index)
    assert reflectance is not None
    return _is(world, vertex, Mirror), reflectance


def _select(values: list[tuple[int, Vector]], index: Index) -> Vector | None:
    """The value whose number is `index`; any of them where there is none such."""
    chosen = None
    for k, value in values:
        chosen = value if chosen is None else jnp.where(index == k, value, chosen)
    return chosen
