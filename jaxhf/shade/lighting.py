"""Light that arrives at a hit: its direction, its strength, and whether something blocks it."""

import jax
import jax.numpy as jnp
from jaxtyping import Bool

from ..core.materialise import stored
from ..core.ray import Ray
from ..core.settings import Settings
from ..core.types import Flag, Index, Scalar, Vector
from ..core.vector import dot, largest_component, power_of_two, unit
from ..scene.light import Directional, Light, Point, Sky
from ..trace.intersect import blocked
from ..trace.walk_start import Origin
from ..trace.world import Vertex, World

# A cosine below this is rounded off; 0.6 degrees from the horizon of the shading normal.
_GRAZING = 0.01


def _count(flag: Flag) -> Index:
    return flag.astype(jnp.int32)


def _irradiance(settings: Settings, world: World, light: Light, vertex: Vertex, active: Flag) -> tuple[Vector, Index]:
    """What arrives at the side of the surface that the ray came from."""
    hit = vertex.hit
    if isinstance(light, Sky):
        cosine = hit.ns[2] * hit.side.astype(hit.ns.dtype)
        return light.radiance * (jnp.pi * (1 + cosine) / 2), jnp.zeros((), jnp.int32)
    wi, arriving, distance = stored(_towards(light, hit.p), world.surfaces[0].sure)
    lit, exhausted = _visible(world, wi, distance, vertex, active, settings)
    cosine = rounded_abs(dot(wi, hit.ns)) if settings.shading == "smooth" else jnp.abs(dot(wi, hit.ns))
    return jnp.where(lit, arriving * cosine, 0), exhausted


def _towards(light: Directional | Point, p: Vector) -> tuple[Vector, Vector, Scalar | None]:
    """Unit direction to the light, irradiance across that direction, distance (None: infinite)."""
    if isinstance(light, Directional):
        return unit(light.towards), light.irradiance, None
    to = light.p - p
    size = largest_component(to)
    size = power_of_two(jnp.where(size > 0, size, 1))  # beyond its square root no number has a square
    to = to / size
    square = dot(to, to)
    square = jnp.where(square > 0, square, 1)
    distance = jnp.sqrt(square)
    return to / distance, light.intensity / square / size / size, distance * size


def _visible(
    world: World, wi: Vector, distance: Scalar | None, vertex: Vertex, active: Flag, settings: Settings
) -> tuple[Flag, Index]:
    """Whether light from `wi` reaches the side that the ray came from, and how many walks ran out of steps.

    The triangle's own normal decides on which side the light stands (Veach 1997, section 5.3; pbrt-v2's BSDF::f).
    """
    hit = vertex.hit
    lit = active & (dot(wi, hit.n) * hit.side.astype(wi.dtype) > 0)
    exhausted = jnp.zeros((), jnp.int32)
    if settings.shadows:
        for k, surface in enumerate(world.surfaces):
            origin = Origin(hit, vertex.index == k)
            hidden, ran_out = blocked(surface, Ray(hit.p, wi), settings, origin, lit, distance)
            lit, exhausted = lit & ~hidden, exhausted + _count(ran_out)
    return lit, exhausted


def rounded_abs(cosine: Scalar) -> Scalar:
    """|cosine|, with the corner at zero replaced by a parabola that meets it with equal slope.

    Where an interpolated normal faces away from a surface that does face the light, a cosine clamped at zero leaves a
    black hole; pbrt-v2 takes its absolute value, whose derivative jumps. This is that, without the jump: it differs
    only below 0.01, by at most 0.005.
    """
    size = jnp.abs(cosine)
    return jnp.where(size < _GRAZING, (cosine * cosine + _GRAZING**2) / (2 * _GRAZING), size)


def in_shadow(world: World, vertex: Vertex, settings: Settings) -> Bool[jax.Array, " lights"]:
    """For each light but the sky, whether it fails to reach the vertex: blocked, or behind the surface; shape (lights,)."""
    hit = vertex.index >= 0
    flags = []
    for light in world.lights:
        if not isinstance(light, Sky):
            wi, _, distance = _towards(light, vertex.hit.p)
            flags.append(hit & ~_visible(world, wi, distance, vertex, hit, settings)[0])
    return jnp.stack(flags) if flags else jnp.zeros(0, bool)
