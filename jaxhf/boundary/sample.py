"""The part of the picture's derivative that comes from moving silhouettes, terminators and shadow boundaries.

Where a boundary sweeps over a pixel, the pixel changes although the radiance along each of its rays does not. That part
is an integral along the boundaries in the picture (Li et al., Differentiable Monte Carlo ray tracing through edge
sampling, SIGGRAPH Asia 2018, equation 5; for shadows Zhang et al., Path-space differentiable rendering, SIGGRAPH 2020):

    d pixel = integral of (L(x - eps n) - L(x + eps n)) (n . dx) dl

On a heightfield every boundary is the image of edges: of those that separate triangles facing the eye or a light from
triangles facing away, where they stand; and of the latter's shadows. A point is drawn on such an edge and followed to its
position x(s) in the picture by plain arithmetic, which carries the derivative; all else is discrete or held constant. n dl is
dx/ds turned by a right angle, times ds, so the term is the mean over points of jump (turned dx/ds) . dx / density of s.
docs/concepts/boundary.md has the whole.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Float, Int

from ..core.affine import affine
from ..core.ray import Ray
from ..core.types import Flag, Index, Point2, Scalar, Vector
from ..core.vector import dot, floor_to_power_of_two, largest_component, quotient, select, unit
from ..preparation.world import World
from ..scene.camera import Camera
from ..scene.light import Point
from ..scene.projection import size_of
from ..shade.lighting import sharp_lights
from ..trace.cylinder import Tube
from ..trace.edges import step_of
from ..trace.grid import Grid
from ..trace.triangle import plane_through, triangle_corners, triangle_vertices
from ..xla.materialise import materialise
from .guiding import GuidingDistribution, edge_sets
from .silhouette import framed_part

# What is added to the heights at the `deciding_vertices` of a sample.
HeightChanges = Float[jax.Array, "5"]


class BoundarySample(eqx.Module):
    """A point sampled on an edge, and where its shadow falls. All of it is discrete but `s`, the position along the edge.

    Attributes:
      valid: whether there is such a point, and it can be seen in the picture but for what hides it.
      edge: its number, see `edge_sets`; beyond all where a stratum has none.
      surface: the object whose edge it is.
      light: the one that casts its shadow; -1: it is seen where it stands.
      start, end: the edge's vertices, (ix, iy).
      s: the position between them, 0..1.
      measure: the reciprocal of the probability density of s.
      receiver: the object on which its shadow falls.
      cell, upper: the triangle there.
      t: the distance to it, along the light's direction.
    """

    valid: Flag
    edge: Index
    surface: Index
    light: Index
    start: Int[jax.Array, "2"]
    end: Int[jax.Array, "2"]
    s: Scalar
    measure: Scalar
    receiver: Index
    cell: Int[jax.Array, "2"]
    upper: Flag
    t: Scalar


def draw(world: World, camera: Camera, guiding: GuidingDistribution, k: Index, u: Point2) -> BoundarySample:
    """The sample of the k-th stratum, from two uniform random numbers; none where there are fewer strata."""
    dtype = u.dtype
    chosen = jnp.minimum((u[0] * guiding.stratum.astype(dtype)).astype(jnp.int32), guiding.stratum - 1)
    chosen = chosen + k * guiding.stratum  # of the integers that the weights add up to
    sets = edge_sets(world)
    edge, weight, before = guiding.at(chosen)
    edge = jnp.minimum(edge, sets[-1].end - 1)
    valid, weight = (k < guiding.strata) & (chosen < guiding.ends[-1]), jnp.maximum(weight, 1)
    s = ((chosen - before).astype(dtype) + u[1]) / weight.astype(dtype)
    measure = guiding.stratum.astype(dtype) / weight.astype(dtype)

    number = sum((edge >= later.first).astype(jnp.int32) for later in sets[1:])
    surface, light, first, vertices = jnp.array(sets, jnp.int32)[number]
    kind, vertex = (edge - first) // vertices, (edge - first) % vertices
    nx = select(surface, ((k, grid.nx) for k, grid, _ in world.grids))
    start, none = jnp.stack([vertex % nx, vertex // nx]), jnp.zeros((), jnp.int32)
    point = BoundarySample(
        valid=valid, edge=jnp.where(valid, edge, sets[-1].end), surface=surface, light=light, start=start,
        end=start + step_of(kind), s=s, measure=measure, receiver=none, cell=jnp.zeros(2, jnp.int32),
        upper=jnp.zeros((), bool), t=jnp.zeros((), dtype),
    )  # fmt: skip
    # Of an edge that is seen where it stands, only the part in the frame is drawn from.
    film = camera.film_from_world()
    a, b = materialise(tuple(film(on_edge(world, point, jnp.full((), end, dtype))) for end in (0, 1)))
    first, last = materialise(framed_part(camera, a, b))
    stands = light < 0
    first, last = jnp.where(stands, first, 0), jnp.where(stands, last, 1)
    share, valid = last - first, valid & (last > first)
    return dataclasses.replace(point, valid=valid, s=first + s * share, measure=measure * share)


def between_ends(point: BoundarySample, s: Scalar) -> tuple[Scalar, Scalar]:
    a, b = point.start.astype(s.dtype), point.end.astype(s.dtype)
    return a[0] + s * (b[0] - a[0]), a[1] + s * (b[1] - a[1])


def on_edge(
    world: World, point: BoundarySample, s: Scalar, offset: Vector | None = None, perturbation: HeightChanges | None = None
) -> Vector:
    """World frame, moved by `offset` (in the surface's own frame); differentiable in the heights and in the transform."""

    def on(grid: Grid) -> Vector:
        x, y = between_ends(point, s)
        z0, z1 = end_heights(grid, point, None if perturbation is None else perturbation[:2])
        p = jnp.stack([x, y, z0 + s * (z1 - z0)])
        return grid.world_from_grid.point(p if offset is None else p + offset)

    return select(point.surface, ((k, on(grid)) for k, grid, _ in world.grids))


def end_heights(grid: Grid, point: BoundarySample, more: Point2 | None = None) -> tuple[Scalar, Scalar]:
    """At the edge's two vertices, grid frame, with `more` added; zero for holes, which bound no edge that counts."""
    z0, z1 = (grid.rows.at[end].get(mode="clip") for end in _ends(grid, point))
    if more is not None:
        z0, z1 = z0 + more[0], z1 + more[1]
    return jnp.where(jnp.isfinite(z0), z0, 0), jnp.where(jnp.isfinite(z1), z1, 0)


def _ends(grid: Grid, point: BoundarySample) -> tuple[Index, Index]:
    """The numbers of the edge's two vertices in its grid, row by row."""
    start, end = (vertex[1] * grid.nx + vertex[0] for vertex in (point.start, point.end))
    return start, end


def _receiving_cell(grid: Grid, point: BoundarySample) -> Int[jax.Array, "2"]:
    """In range also where the shadow falls on another surface."""
    return jnp.clip(point.cell, 0, jnp.stack(grid.cells) - 1)


def deciding_vertices(world: World, point: BoundarySample) -> Int[jax.Array, "5"]:
    """The vertices on whose heights the position in the picture depends, numbered over all grids.

    The edge's two; and the three of the triangle on which its shadow falls.
    """
    ends, triangles = [], []
    for k, grid, before in world.grids:
        cell = _receiving_cell(grid, point)
        ends.append((k, before + jnp.clip(jnp.stack(_ends(grid, point)), 0, grid.rows.shape[0] - 1)))
        triangles.append((k, before + jnp.stack(triangle_vertices(grid.nx, cell[0], cell[1], point.upper))))
    none = jnp.zeros(3, jnp.int32)
    return jnp.concatenate([select(point.surface, ends), select(point.receiver, triangles, none)])


def ways_to_lights(world: World, p: Vector) -> list[tuple[int, tuple[Vector, Scalar]]]:
    """The unit direction from p to each light whose shadows are sharp, and its distance, with the light's number."""
    ways = []
    for number, light in sharp_lights(world):
        at_place = isinstance(light, Point)
        there = light.p - p if at_place else light.towards
        to = unit(there)
        ways.append((number, (to, dot(there, to) if at_place else jnp.full((), jnp.inf, p.dtype))))
    return ways


def _fallen(world: World, point: BoundarySample, p: Vector, perturbation: HeightChanges | None = None) -> Vector:
    """Where the light past p meets the triangle that was found; differentiable."""
    still = jnp.zeros_like(p), jnp.zeros((), p.dtype)  # for what is seen where it stands, whose result is not used
    away = -select(point.light, ways_to_lights(world, p), still)[0]
    near = p + jnp.where(point.valid, point.t, 0) * away

    def on_triangle(grid: Grid) -> Vector:
        # From `near` on, which lies there but for its derivative: far distances would cancel.
        local = grid.grid_from_world.ray(Ray(near, away))
        cell = _receiving_cell(grid, point)
        heights = triangle_corners(grid.rows, grid.nx, cell[0], cell[1], point.upper)
        if perturbation is not None:
            heights = tuple(z + more for z, more in zip(heights, perturbation[2:], strict=True))
        a, b, c = plane_through(heights, point.upper)
        u, v = local.o[0] - cell[0].astype(p.dtype), local.o[1] - cell[1].astype(p.dtype)
        # At a length around one, as the derivative has the slope's square in it; a power of two changes no bit.
        size = largest_component(local.d)
        size = floor_to_power_of_two(jnp.where(size > 0, size, 1))
        d = local.d / size
        slope = d[2] - a * d[0] - b * d[1]
        grazing = (slope == 0) | ~point.valid
        step = jnp.where(grazing, 0, quotient(c + a * u + b * v - local.o[2], jnp.where(grazing, 1, slope))) / size
        return near + step * away

    def on_tube(tube: Tube) -> Vector:
        t, found, _ = tube.distance(Ray(p, away), None, 0)
        return p + jnp.where(found, t, point.t) * away

    grids = [(k, on_triangle(grid)) for k, grid, _ in world.grids]
    tubes = [(k, on_tube(tube)) for k, tube in enumerate(world.surfaces) if isinstance(tube, Tube)]
    return select(point.receiver, [*grids, *tubes], near)


def picture_point(
    world: World,
    camera: Camera,
    point: BoundarySample,
    s: Scalar,
    offset: Vector | None = None,
    perturbation: HeightChanges | None = None,
) -> tuple[Point2, Flag]:
    """The position of the sample, or of its shadow, in the picture (pixels), and whether it is in the frame; differentiable.

    In every leaf of the scene, in s while the shadow stays in its triangle, and in `perturbation`.
    """
    p = materialise(on_edge(world, point, s, offset, perturbation))
    if any(edges.light >= 0 for edges in edge_sets(world)):
        p = jnp.where(point.light >= 0, _fallen(world, point, p, perturbation), p)
    # Of a point that does not count, the position may be larger than any number, and its derivative, times zero, none.
    ahead = affine(jnp.asarray(camera.world_from_camera)).point(jnp.array([0, 0, 1], p.dtype))
    at = materialise(camera.film_from_world()(materialise(jnp.where(point.valid, p, lax.stop_gradient(ahead)))))
    before = (at[2] > 0) & (at[3] > 0)
    x = quotient(at[:2], jnp.where(before, at[2], 1))
    size = jnp.stack([jnp.asarray(side, x.dtype) for side in size_of(camera)])
    return x, point.valid & before & (x >= 0).all() & (x < size).all()
