"""Which triangle does a ray meet? A discrete search: integers come out, no derivative goes through."""

import math

import jax.numpy as jnp
from jax import lax

from ._begin import Departure, begin
from ._grid import Grid, triangle_plane
from ._march import march
from ._ray import Ray
from ._types import Flag, Scalar
from ._walk import CellHit, Status


def first_hit(
    grid: Grid,
    ray: Ray,
    *,
    max_steps: int | None,
    active: Flag | None = None,
    departure: Departure | None = None,
    t_max: Scalar | None = None,
    count_steps: bool = False,
) -> CellHit:
    """Finds the first triangle in which `ray` meets the surface.

    With one level of bounds this is the walk of Amanatides and Woo (A fast voxel traversal algorithm, Eurographics 1987), with
    the distance to each crossing recomputed from the integer cell, as a running sum drifts; with all levels, that of Tevs
    et al. (I3D 2008) over their maximum mipmaps. It has a fixed number of steps and ends early. It is discrete
    and carries no gradient; see `surface_interaction`.

    Args:
      grid: the surface.
      ray: in the grid's frame; may start outside the footprint, or below the surface.
      max_steps: the most steps, in each of which up to two blocks are passed and one cell is visited; None: `enough_steps`.
      active: False spares a ray the walk: it ends as a miss.
      departure: for rays that leave this surface.
      t_max: where to give up; a hit beyond it may or may not be reported.
      count_steps: whether to count the steps.
    """
    grid, ray, departure, t_max = lax.stop_gradient((grid, ray, departure, t_max))
    walk, state, valid = begin(grid, ray, departure, t_max, active)
    bound = enough_steps(grid)
    state, steps = march(walk, state, bound if max_steps is None else min(max_steps, bound), count_steps)
    return walk.finish(state, valid, steps)


def enough_steps(grid: Grid) -> int:
    """A number of steps that suffices for any ray.

    A ray moves one way along each axis, so on each level it passes through at most (blocks along x) + (blocks along y) - 1
    blocks. It comes to each of them at most once: it grows to a block only on entering it, and goes down into one
    only from the block around it. Each step deals with at least one of them.
    """
    cells_x, cells_y = grid.cells
    levels = range(grid.pyramid.levels + 1)
    return sum(math.ceil(cells_x / 2**level) + math.ceil(cells_y / 2**level) - 1 for level in levels)


def distance(plane: tuple[Scalar, Scalar, Scalar], ray: Ray, found: CellHit) -> Scalar:
    """t at which `ray` (in the grid's frame) meets the plane of the triangle that was found, see `triangle_plane`.

    Plain arithmetic that is differentiable in the heights and in the ray. It starts at the cell, as the subtraction
    of far heights would cancel; t is clamped to the part of the ray over the triangle, without touching its derivative. A
    ray that lies in the plane meets it all along: then t is that of the cell, with the derivative zero.

    Args:
      plane: of the triangle.
      ray: in the grid's frame.
      found: where the walk ended.
    """
    a, b, c = plane
    o, d = ray(found.t_near), ray.d
    u, v = o[0] - found.ix.astype(o.dtype), o[1] - found.iy.astype(o.dtype)
    slope = d[2] - a * d[0] - b * d[1]
    grazing = (slope == 0) | (found.status != int(Status.HIT))
    step = jnp.where(grazing, 0, (c + a * u + b * v - o[2]) / jnp.where(grazing, 1, slope))
    t = found.t_near + step
    return t + lax.stop_gradient(jnp.clip(t, found.t_near, found.t_far) - t)


def occluded(
    grid: Grid, ray: Ray, *, max_steps: int | None, active: Flag, departure: Departure | None, t_max: Scalar | None
) -> tuple[Flag, Flag]:
    """Whether `ray` (in the grid's frame) meets the surface before `t_max`, and whether its budget ran out."""
    grid, ray, t_max = lax.stop_gradient((grid, ray, t_max))
    found = first_hit(grid, ray, max_steps=max_steps, active=active, departure=departure, t_max=t_max)
    blocked = found.status == int(Status.HIT)
    if t_max is not None:
        plane = triangle_plane(grid, found.ix, found.iy, found.upper)
        blocked = blocked & (distance(plane, ray, found) < t_max)
    return blocked, found.status == int(Status.EXHAUSTED)
