"""Light that arrives at a hit: its direction, its irradiance, and whether something blocks it."""

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float

from ..core.materialise import materialise
from ..core.powers import floor_to_power_of_two
from ..core.ray import Ray
from ..core.types import Flag, Index, Scalar, Vector
from ..core.vector import dot, largest_component, unit
from ..scene.light import Directional, Point, Sky
from ..trace.grid import Grid
from ..trace.hit import Hit
from ..trace.triangle import triangle_corners
from ..trace.walk_start import place_on_grid
from ..trace.world import World, unblocked

# A cosine below this is rounded off; 0.6 degrees from the horizon of the shading normal.
GRAZING = 0.01


def irradiance(number: int, world: World, hit: Hit, active: Flag) -> tuple[Vector, Index]:
    """What one light sends to the side of the surface that the ray came from, (3,), and how many walks ran out of steps."""
    light = world.lights[number]
    if isinstance(light, Sky):
        cosine = hit.ns[2] * hit.side.astype(hit.ns.dtype)
        share = (1 + cosine) / 2
        for k, grid, _ in world.grids:
            seen = world.sky[k]
            if seen is not None:
                share = jnp.where((hit.object == k) & (hit.side > 0), _seen_share(grid, seen, hit), share)
        return light.radiance * (jnp.pi * share), jnp.zeros((), jnp.int32)
    wi, arriving, distance = materialise(_towards(light, hit.p))
    lit, exhausted = _visible(number, world, wi, distance, hit, active)
    return jnp.where(lit, arriving * _cosine(world, wi, hit), 0), exhausted


def _seen_share(grid: Grid, sky: Float[jax.Array, "_ 3"], hit: Hit) -> Scalar:
    """Of an even sky's light, what arrives at the upper side; from the visible sky at the vertices, see `sky_vector`."""
    ix, iy, x, y = place_on_grid(grid, hit)
    upper = hit.triangle == 1
    first, between, last = triangle_corners(sky, grid.shape[1], ix, iy, upper)
    u, v = x - ix.astype(x.dtype), y - iy.astype(y.dtype)
    on_first, on_last = jnp.where(upper, v, u), jnp.where(upper, u, v)
    return jnp.maximum(dot(first + on_first * (between - first) + on_last * (last - between), hit.ns), 0)


def unshadowed_irradiance(world: World, light: Directional | Point, hit: Hit) -> Vector:
    """What would arrive if nothing stood between the light and the hit, and the light on that side of it."""
    wi, arriving, _ = _towards(light, hit.p)
    return arriving * _cosine(world, wi, hit)


def _cosine(world: World, wi: Vector, hit: Hit) -> Scalar:
    return rounded_abs(dot(wi, hit.ns)) if world.settings.shading == "smooth" else jnp.abs(dot(wi, hit.ns))


def in_shadow(world: World, hit: Hit) -> Bool[jax.Array, " lights"]:
    """For each light but the sky, whether it fails to reach the hit: blocked, or behind the surface; shape (lights,)."""
    met = hit.object >= 0
    flags = []
    for number, light in enumerate(world.lights):
        if not isinstance(light, Sky):
            wi, _, distance = _towards(light, hit.p)
            flags.append(met & ~_visible(number, world, wi, distance, hit, met)[0])
    return jnp.stack(flags) if flags else jnp.zeros(0, bool)


def _towards(light: Directional | Point, p: Vector) -> tuple[Vector, Vector, Scalar | None]:
    """Unit direction to the light, irradiance across that direction, distance (None: infinite)."""
    if isinstance(light, Directional):
        return unit(light.towards), light.irradiance, None
    to = light.p - p
    size = largest_component(to)
    size = floor_to_power_of_two(jnp.where(size > 0, size, 1))  # beyond its square root no number has a square
    to = to / size
    square = dot(to, to)
    square = jnp.where(square > 0, square, 1)
    distance = jnp.sqrt(square)
    return to / distance, light.intensity / square / size / size, distance * size


def _visible(number: int, world: World, wi: Vector, distance: Scalar | None, hit: Hit, active: Flag) -> tuple[Flag, Index]:
    """Whether a light, seen at `wi`, reaches the side that the ray came from, and how many walks ran out of steps.

    The triangle's own normal decides on which side the light stands (Veach 1997, section 5.3; pbrt-v2's BSDF::f).
    """
    lit = active & (dot(wi, hit.n) * hit.side.astype(wi.dtype) > 0)
    if world.settings.shadows:
        return unblocked(world, Ray(hit.p, wi), hit, lit, distance, number)
    return lit, jnp.zeros((), jnp.int32)


def rounded_abs(cosine: Scalar) -> Scalar:
    """|cosine|, with the corner at zero replaced by a parabola that meets it with equal slope.

    Where an interpolated normal faces away from a surface that does face the light, a cosine clamped at zero leaves a
    black hole; pbrt-v2 takes its absolute value, whose derivative jumps. This is that, without the jump: it differs
    only below 0.01, by at most 0.005.
    """
    size = jnp.abs(cosine)
    return jnp.where(size < GRAZING, (cosine * cosine + GRAZING**2) / (2 * GRAZING), size)
