"""Light that arrives at a hit: its direction, its irradiance, and whether something blocks it."""

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Bool, Float

from ..core.ray import Ray
from ..core.types import Flag, Index, Scalar, Vector
from ..core.vector import dot, floor_to_power_of_two, greater, largest_component, quotient, rounded_clamp, select, unit, within
from ..preparation.world import World, unblocked
from ..scene.light import Directional, Point, Sky, Sun, casts_sharp_shadows
from ..trace.cylinder import Tube
from ..trace.grid import Grid
from ..trace.hit import Hit
from ..trace.intersect import blocked
from ..trace.skirt import Walls, wall_slopes
from ..trace.skyline import hidden_slopes, skyline_slope
from ..trace.triangle import triangle_corners
from ..trace.walk_start import place_on_grid
from ..xla.materialise import materialise
from .reflectance import brdf, brdf_under_sky

# Altitude up to which slopes are told apart, radians.
_STEEPEST = np.deg2rad(89.9)
# So near to the zenith, radians, the sun has no azimuth: chords across x then do as well as any.
_NO_AZIMUTH = 1e-4


def light_from(number: int, world: World, hit: Hit, wo: Vector | None, active: Flag) -> tuple[Vector, Index]:
    """What of one light the side of the surface that the ray came from sends towards `wo`, (3,), and how many walks ran out of
    steps. Without `wo`, which all but `Matte` ask for, what that side gets: its irradiance."""
    light = world.lights[number]
    if isinstance(light, Sky):
        cosine = hit.ns[2] * hit.side.astype(hit.ns.dtype)
        share = (1 + cosine) / 2
        seen = [(k, _seen_share(grid, sky, hit)) for k, grid, _ in world.grids if (sky := world.sky[k]) is not None]
        share = select(jnp.where(hit.side > 0, hit.object, -1), seen, share)
        even = light.radiance * (jnp.pi * share)
        return even if wo is None else even * brdf_under_sky(world, wo, hit), jnp.zeros((), jnp.int32)
    if isinstance(light, Sun):
        share, mean, exhausted = _disc(world, light, hit, active)
        towards = quotient(mean, jnp.where(share > 0, share, 1))
        return light.irradiance * share * _sent_on(world, towards, hit, wo), exhausted
    wi, arriving, distance = materialise(_towards(light, hit.p))
    lit, exhausted = _visible(number, world, wi, distance, hit, active)
    return jnp.where(lit, arriving * _sent_on(world, wi, hit, wo), 0), exhausted


def _seen_share(grid: Grid, sky: Float[jax.Array, "_ 3"], hit: Hit) -> Scalar:
    """Of an even sky's light, what arrives at the upper side; from the visible sky at the vertices, see `sky_vector`."""
    ix, iy, x, y = place_on_grid(grid, hit)
    upper = hit.triangle == 1
    first, between, last = triangle_corners(sky, grid.nx, ix, iy, upper)
    u, v = x - ix.astype(x.dtype), y - iy.astype(y.dtype)
    on_first, on_last = jnp.where(upper, v, u), jnp.where(upper, u, v)
    return greater(dot(first + on_first * (between - first) + on_last * (last - between), hit.ns), jnp.zeros((), hit.t.dtype))


def sharp_lights(world: World) -> list[tuple[int, Directional | Point]]:
    """The lights whose shadows have sharp edges, with their numbers."""
    return [(number, light) for number, light in enumerate(world.lights) if casts_sharp_shadows(light)]


def unshadowed_light(world: World, light: Directional | Point, hit: Hit, wo: Vector | None) -> Vector:
    """`light_from` if nothing stood between the light and the hit, and the light on that side of it."""
    wi, arriving, _ = _towards(light, hit.p)
    return arriving * _sent_on(world, wi, hit, wo)


def _sent_on(world: World, wi: Vector, hit: Hit, wo: Vector | None) -> Scalar | Vector:
    """The cosine of the light's direction and the shading normal on the side that the ray came from, for light that is on that
    side; with `wo` times the BRDF."""
    smooth = world.settings.shading == "smooth"
    cosine = rounded_clamp(dot(wi, hit.ns) * hit.side.astype(wi.dtype)) if smooth else jnp.abs(dot(wi, hit.ns))
    if wo is None:
        return cosine
    along = jnp.where(largest_component(wi) > 0, unit(wi), hit.ns)  # no part of a sun's disc may be seen
    return cosine * brdf(world, along, wo, hit)


def in_shadow(world: World, hit: Hit) -> Bool[jax.Array, " lights"]:
    """For each light but the sky, whether it fails to reach the hit: blocked, or behind the surface; shape (lights,)."""
    met = hit.object >= 0
    flags = []
    for number, light in enumerate(world.lights):
        if isinstance(light, Sun):
            flags.append(met & ~(_disc(world, light, hit, met)[0] > 0))
        elif not isinstance(light, Sky):
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


def _disc(world: World, sun: Sun, hit: Hit, active: Flag) -> tuple[Scalar, Vector, Index]:
    """The share of the sun's disc that is seen from the side of the surface that the ray came from, the integral of the
    directions towards it over the disc's area, and how many walks ran out of steps.

    The disc is cut into vertical chords, at the nodes of Gauss's and Chebyshev's quadrature of the second kind, whose weight is
    the chords' length. In the plane of a chord each surface hides what lies between two slopes: what is left of the chord, and
    the middles of its parts, are known exactly. Angles there count from the chord's middle, and may go beyond the zenith.
    """
    dtype = hit.p.dtype
    wi, radius = unit(sun.towards), jnp.deg2rad(sun.angular_diameter) / 2
    along = unit(jnp.where(largest_component(wi[:2]) < _NO_AZIMUTH, jnp.array([1, 0], dtype), wi[:2]))
    aside = jnp.stack([along[1], -along[0]])
    n = hit.n * hit.side.astype(dtype)
    ground = _solid_ground(world)
    lit = active if ground is None else active & ((hit.side > 0) | (hit.object != ground[0]))

    def chord(seen: tuple[Scalar, Vector, Index], node: tuple[Scalar, Scalar]) -> tuple[tuple[Scalar, Vector, Index], None]:
        share, mean, exhausted = seen
        half, foot = radius * node[1], wi[:2] + radius * node[0] * aside
        level = jnp.stack([*unit(foot), jnp.zeros((), dtype)])
        centre = jnp.stack([*foot, wi[2]])
        centre = centre / jnp.sqrt(dot(centre, centre))  # about 1
        middle = jnp.arctan2(wi[2], dot(foot, level[:2]))
        lowest, slope, highest = (jnp.tan(within(middle + end, -_STEEPEST, _STEEPEST)) for end in (-half, 0, half))
        own = _own_slopes(n, level, slope)

        def angle(slope: Scalar) -> Scalar:
            above = jnp.where(slope < jnp.inf, within(jnp.arctan(slope) - middle, -half, half), half)
            return jnp.where(slope > lowest, above, -half)

        if ground is None:
            hidden, more = _hidden(world, hit, lit, level, (lowest, highest))
            ends = [(jnp.where(low < highest, angle(low), half), angle(high)) for low, high in (own, *hidden)]
            parts, exhausted = _left_open(materialise(ends), half), exhausted + more
        else:
            slope = greater(own[1], lowest)
            if world.settings.shadows:
                number, grid = ground
                slope, more = skyline_slope(grid, number, level, hit, lit, (slope, highest))
                exhausted = exhausted + more.astype(jnp.int32)
            parts = [(angle(slope), half)]
        upwards = jnp.stack([*(-centre[2] * level[:2]), dot(centre, level)])
        for begin, end in parts:
            weight = 2 * node[1] * node[1] / (sun.chords + 1) * quotient(end - begin, 2 * half)
            weight = jnp.where(lit, weight, 0)
            higher = (begin + end) / 2
            direction = jnp.cos(higher) * centre + jnp.sin(higher) * upwards
            share, mean = share + weight, mean + weight * direction
        return (share, mean, exhausted), None

    turns = np.arange(1, sun.chords + 1) * (np.pi / (sun.chords + 1))
    nodes = jnp.asarray(np.cos(turns), dtype), jnp.asarray(np.sin(turns), dtype)
    none = jnp.zeros((), dtype), jnp.zeros(3, dtype), jnp.zeros((), jnp.int32)
    (share, mean, exhausted), _ = lax.scan(chord, none, nodes)
    for number, surface in enumerate(world.surfaces):
        if world.settings.shadows and isinstance(surface, Tube):
            fixed = lax.stop_gradient((surface, Ray(hit.p, wi), hit))
            met, _ = blocked(*fixed, lit, None, number=number)
            share, mean = jnp.where(met, 0, share), jnp.where(met, 0, mean)
    return share, mean, exhausted


def _solid_ground(world: World) -> tuple[int, Grid] | None:
    """The only heightfield, with its number, of a scene that has nothing else, but for its own skirt. It counts as solid ground
    below its surface; where there is more, heightfields are sheets with two sides."""
    grids = world.grids
    if len(grids) != 1:
        return None
    number, grid, _ = grids[0]
    others = (surface for k, surface in enumerate(world.surfaces) if k != number)
    alone = all(isinstance(other, Walls) and other.known_shape == grid.known_shape for other in others)
    return (number, grid) if alone else None


def _hidden(
    world: World, hit: Hit, active: Flag, level: Vector, between: tuple[Scalar, Scalar]
) -> tuple[list[tuple[Scalar, Scalar]], Index]:
    """The lowest and the highest slope that each heightfield and each skirt hides in the plane of a level direction, and how
    many walks ran out of steps."""
    hidden, exhausted = [], jnp.zeros((), jnp.int32)
    for number, surface in enumerate(world.surfaces if world.settings.shadows else ()):
        if isinstance(surface, Grid):
            slopes, more = hidden_slopes(surface, number, level, hit, active, between)
            hidden, exhausted = [*hidden, slopes], exhausted + more
        elif isinstance(surface, Walls):
            hidden = [*hidden, wall_slopes(surface, number, level, hit)]
    return hidden, exhausted


def _left_open(hidden: list[tuple[Scalar, Scalar]], half: Scalar) -> list[tuple[Scalar, Scalar]]:
    """What intervals leave of -half..half: parts that do not overlap, some of them empty. One begins where an interval ends in
    no other one, and goes on to where the next begins."""
    begins, parts = [-half, *(high for _, high in hidden)], []
    for k, begin in enumerate(begins):
        covered, end = jnp.zeros((), bool), half
        for low, high in hidden:
            covered = covered | ((low <= begin) & (begin < high))
            end = jnp.where((begin < low) & (low < end), low, end)
        for other in begins[:k]:
            covered = covered | (other == begin)
        parts.append((begin, jnp.where(covered, begin, end)))
    return parts


def _own_slopes(n: Vector, level: Vector, middle: Scalar) -> tuple[Scalar, Scalar]:
    """Between which slopes, in the plane of a level direction, a surface hides the light from its side of the normal n.

    On an upright surface the light at a `middle` slope stands for all of it.
    """
    along, upright = dot(n, level), jnp.abs(n[2]) <= 1e-6
    faces = jnp.where(upright, along + middle * n[2] > 0, n[2] < 0)
    slope = -along / jnp.where(upright, 1, n[2])
    low = jnp.where(faces, jnp.where(upright, jnp.inf, slope), -jnp.inf)
    high = jnp.where(upright, jnp.where(faces, -jnp.inf, jnp.inf), jnp.where(faces, jnp.inf, slope))
    return low, high
