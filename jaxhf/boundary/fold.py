"""The two triangles of an edge, as sight or light that passes a point of the edge meets them. Discrete: no derivative."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp

from ..core.ray import Ray
from ..core.types import Flag, Index, Scalar, Vector
from ..core.vector import dot, select, unit
from ..preparation.world import World, nearest_hit, no_hit
from ..scene.camera import Camera
from ..trace.grid import Grid, triangle_plane
from ..trace.hit import Hit, Status
from ..trace.intersect import intersect
from ..trace.triangle import corners
from ..xla.materialise import materialise
from .sample import BoundarySample, between_ends, end_heights, on_edge, ways_to_lights

# Other surfaces are looked for beside the edge and from a little before it, so that those that share a border with the edge's
# are met: this many times the square root of an ulp of the grid's larger side beside it, and as many times that before it.
_ASIDE, _BACK = 1 / 16, 16


class Fold(eqx.Module):
    """An edge's two triangles at a sample, met by the ray that passes it from the eye, or from the light whose shadow it is.

    Attributes:
      past: the ray, from the sample on, away from its source; `d` has length 1.
      distance: of the source; infinite for a directional light.
      near: on the triangle over which the ray comes, from the side of its source.
      ahead: on that over which the ray goes on, likewise. At a border both are the only triangle.
      bends: whether the source sees only one of the triangles, or there is only one: then the edge bounds what it sees.
      beside: the ray that other surfaces than the edge's are met by, on the side away from `near`; it begins `back` earlier.
      back: in the units of the ray.
      across: unit normal of the plane through the edge and the source, towards `near`; in the surface's own frame.
    """

    past: Ray
    distance: Scalar
    near: Hit
    ahead: Hit
    bends: Flag
    beside: Ray
    back: Scalar
    across: Vector


def towards(world: World, camera: Camera, light: Index, p: Vector) -> tuple[Vector, Scalar]:
    """Unit direction from p to a light, or to the eye where that is -1, and the distance."""
    eye, at_place = camera.viewpoint()
    sight = eye - p if at_place else eye * camera.film_from_world()(p)[3]
    to = unit(sight)
    return select(light, ways_to_lights(world, p), (to, dot(sight, to)))


def fold_at(world: World, camera: Camera, sample: BoundarySample) -> Fold:
    """The fold at a sample."""
    p = on_edge(world, sample, sample.s)
    to, distance = towards(world, camera, sample.light, p)
    return select(sample.surface, ((k, _fold_on(grid, k, sample, Ray(p, -to), distance)) for k, grid, _ in world.grids))


def _fold_on(grid: Grid, number: int, sample: BoundarySample, past: Ray, distance: Scalar) -> Fold:
    local = grid.grid_from_world.vector(past.d)
    d = unit(local)
    ix, iy = sample.start[0], sample.start[1]
    along_x, along_y = sample.end[1] == iy, sample.end[0] == ix
    # The triangles to the left of the edge (above it, where it runs along x) and to its right.
    left_x, left_y, left_upper = jnp.where(along_y, ix - 1, ix), iy, ~along_x & ~along_y
    right_x, right_y, right_upper = ix, jnp.where(along_x, iy - 1, iy), along_x | along_y
    has_left, has_right = _has_cell(grid, left_x, left_y), _has_cell(grid, right_x, right_y)
    leftwards = jnp.where(along_x, d[1] > 0, jnp.where(along_y, d[0] < 0, d[1] > d[0]))
    ahead_left = (has_left & leftwards) | ~has_right
    near_left = ahead_left ^ (has_left & has_right)
    x, y = between_ends(sample, sample.s)

    def on_triangle(left: Flag) -> Hit:
        """A hit from the side of the source on one of the two."""
        cell_x = jnp.clip(jnp.where(left, left_x, right_x), 0, grid.cells[0] - 1)
        cell_y = jnp.clip(jnp.where(left, left_y, right_y), 0, grid.cells[1] - 1)
        upper = jnp.where(left, left_upper, right_upper)
        a, b, _ = triangle_plane(grid, cell_x, cell_y, upper)
        side = jnp.where(d[2] - a * d[0] - b * d[1] <= 0, 1, -1).astype(jnp.int32)
        return dataclasses.replace(
            no_hit(d.dtype),
            object=jnp.full((), number, jnp.int32),
            cell=jnp.stack([cell_x, cell_y]),
            triangle=upper.astype(jnp.int32),
            side=side,
            uv=jnp.stack([x / grid.extent[0], y / grid.extent[1]]),
        )

    near, ahead = on_triangle(near_left), on_triangle(ahead_left)
    z0, z1 = end_heights(grid, sample)
    e = jnp.stack([*(sample.end - sample.start).astype(d.dtype), z1 - z0])
    normal = jnp.stack([e[i] * d[j] - e[j] * d[i] for i, j in ((1, 2), (2, 0), (0, 1))])
    # The triangle on the left lies on the side of e x d if the source sees its +z side.
    across = unit(normal) * jnp.where(near_left, near.side, -near.side).astype(d.dtype)
    bends = (near.side != ahead.side) | ~(has_left & has_right)
    step = _ASIDE * float(jnp.finfo(d.dtype).eps) ** 0.5 * jnp.maximum(*grid.extent)
    back = _BACK * step / dot(local, d)
    beside = Ray(past.o - grid.world_from_grid.vector(across * step) - back * past.d, past.d)
    return Fold(past, distance, near, ahead, bends, beside, back, across)


def _has_cell(grid: Grid, ix: Index, iy: Index) -> Flag:
    """Whether there is such a cell, with all its vertices."""
    x, y = jnp.clip(ix, 0, grid.cells[0] - 1), jnp.clip(iy, 0, grid.cells[1] - 1)
    z00, z10, z01, z11 = corners(grid.rows, grid.nx, x, y, None)
    return materialise((x == ix) & (y == iy) & jnp.isfinite(z00 + z10 + z01 + z11))


def meet(
    world: World, sample: BoundarySample, ray: Ray, beside: Ray, back: Scalar, leaving: Hit, active: Flag, t_max: Scalar
) -> tuple[Hit, Flag]:
    """What a ray from the hit `leaving` meets, and whether it is active and meets nothing before `t_max`.

    By `ray` the edge's own surface is met, by `beside` others are. That begins `back` earlier, so that a surface which touches
    the edge is met at a t between -`back` and `back`: t counts from the start of `ray`.
    """
    hits = []
    for number, surface in enumerate(world.surfaces):
        way, earlier = ray, jnp.zeros_like(back)
        if len(world.surfaces) > 1:
            way, earlier = select(sample.surface, [(number, (way, earlier))], (beside, back))
        hit = intersect(surface, number, way, leaving=leaving, active=active, t_max=t_max + earlier)
        hits.append(dataclasses.replace(hit, t=hit.t - earlier))
    hit = nearest_hit(hits)
    return hit, active & ~((hit.status == int(Status.HIT)) & (hit.t < t_max))
