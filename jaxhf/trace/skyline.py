"""Which slopes a heightfield hides from one point in one direction: the horizon seen from a hit, between two slopes.

`horizon` finds the same for all vertices of a grid. Here the point is any. A walk over the cells below the lower slope's ray
raises that ray wherever the surface is above it. Its blocks are skipped as in a search for a hit, and it is over where the
ray reaches the upper slope: it costs about three times as much as a search. The lower end of what a surface hides is found by
the same walk upside down.
"""

import dataclasses

import jax
import jax.numpy as jnp
from jax import lax

from ..core.autodiff import stored
from ..core.ray import Ray
from ..core.types import Flag, Index, Scalar, Vector
from ..core.vector import greater, lesser, quotient
from ..xla.materialise import materialise, values_at
from .edges import step_of
from .grid import Grid, triangle_plane
from .hit import Hit
from .search import SKIPS, until_ended
from .triangle import corners
from .walk import MISS, Walk, walking
from .walk_start import point_on_grid, walk_start


def hidden_slopes(
    grid: Grid, number: int, level: Vector, leaving: Hit, active: Flag, between: tuple[Scalar, Scalar]
) -> tuple[tuple[Scalar, Scalar], Index]:
    """The lowest and the highest slope that a sheet with two sides hides from a point, and how many walks ran out of steps.

    In a vertical plane the sheet is one line, of which all is hidden between its lowest and its highest point as they are seen.
    What begins below the point, or at the upper side that the point lies on, hides all from minus infinity on; what begins over
    it, all up to infinity. Of a sheet with holes what lies between two of its pieces counts as hidden.

    The arguments are those of `skyline_slope`; the slopes are differentiable as its result is. Where they are equal nothing is
    hidden.
    """
    own, lowest = leaving.object == number, between[0]
    covers, gap = _over_footprint(grid, grid.grid_from_world.point(leaving.p))
    underfoot = jnp.where(own, leaving.side > 0, covers & (gap > 0))
    overhead = jnp.where(own, leaving.side < 0, covers & (gap <= 0))
    high, ran_out = skyline_slope(grid, number, level, leaving, active & ~overhead, between)
    stands = active & ~underfoot & (overhead | (high > lowest))
    low, more = skyline_slope(grid, number, level, leaving, stands, between, above=False)
    hidden = jnp.where(underfoot, -jnp.inf, jnp.where(stands, low, lowest)), jnp.where(overhead, jnp.inf, high)
    return hidden, ran_out.astype(jnp.int32) + more.astype(jnp.int32)


def _over_footprint(grid: Grid, o: Vector) -> tuple[Flag, Scalar]:
    """Whether a point in the grid's frame is above or below the surface, or on its border, and how high above it."""
    cells_x, cells_y = grid.extent
    wide = _rounding(grid, o)
    covers = (o[0] >= -wide) & (o[0] <= cells_x + wide) & (o[1] >= -wide) & (o[1] <= cells_y + wide)
    ix, iy = (jnp.clip(jnp.floor(o[k]).astype(jnp.int32), 0, n - 1) for k, n in enumerate(grid.cells))
    u, v = o[0] - ix.astype(o.dtype), o[1] - iy.astype(o.dtype)
    a, b, c = triangle_plane(grid, ix, iy, v > u)
    whole = jnp.isfinite(sum(corners(grid.rows, grid.nx, ix, iy, grid.first)))  # of a hole's cells three may be there
    return covers & whole, lax.stop_gradient(o[2] - (c + a * u + b * v))


def _rounding(grid: Grid, o: Vector) -> Scalar:
    """By how many cells a point on a wall along the border may be off."""
    return 64 * float(jnp.finfo(o.dtype).eps) * jnp.maximum(*grid.extent)


def skyline_slope(
    grid: Grid,
    number: int,
    level: Vector,
    leaving: Hit,
    active: Flag,
    between: tuple[Scalar, Scalar],
    above: bool = True,
    t_max: Scalar | None = None,
) -> tuple[Scalar, Flag]:
    """The largest slope at which the surface is seen from a point, and whether the walk ran out of steps.

    The slope is differentiable in the heights, the transform, the point and the direction: it is that of the edge which makes
    the horizon.

    Args:
      grid: an upright surface.
      number: of its object.
      level: a horizontal direction of length 1, world frame.
      leaving: the hit at that point; if it lies on this grid, its own triangle does not count.
      active: False spares the walk.
      between: the slopes that matter: what is below the first counts as the first, and the walk gives up beyond the second.
      above: False for the smallest slope: then what is above the second counts as the second, and the walk gives up beyond the
        first.
      t_max: the horizontal distance up to which the surface counts, world units; None: to its end.
    """
    o = jnp.where(leaving.object == number, point_on_grid(grid, leaving), grid.grid_from_world.point(leaving.p))
    fixed = lax.stop_gradient((grid, o, level, leaving, between, t_max))
    edge, exhausted = stored(materialise(_outermost_edge(*fixed, number, active, above)))
    slope = _slope_to(grid, o, level, edge, above)
    return (greater(slope, between[0]) if above else lesser(slope, between[1])), exhausted


def _slope_to(grid: Grid, o: Vector, level: Vector, edge: Index, above: bool) -> Scalar:
    """World-frame slope of the point of an edge above the line o + t level in the plane; differentiable. Of no edge it is
    -inf, if not `above` inf.

    Args:
      grid: which may lean by an infinitesimal, for its derivative in the transform.
      o: in the grid's frame.
      level: a horizontal direction, world frame.
      edge: see `_edge`.
    """
    known, edge = edge >= 0, jnp.maximum(edge, 0)
    first, kind, nx = edge // 3, edge % 3, grid.nx
    step = step_of(kind)
    z0, z1 = values_at(grid.rows, first, (step[1] * nx + step[0],))
    known = known & jnp.isfinite(z0 + z1)
    z0, z1 = jnp.where(known, z0, 0), jnp.where(known, z1, 0)
    to = grid.world_from_grid.vector(jnp.stack([(first % nx).astype(o.dtype), (first // nx).astype(o.dtype), z0]) - o)
    e = grid.world_from_grid.vector(jnp.stack([*step.astype(o.dtype), z1 - z0]))
    across = level[0] * e[1] - level[1] * e[0]
    t, s = to[0] * e[1] - to[1] * e[0], to[0] * level[1] - to[1] * level[0]  # both times `across`
    known = known & (t != 0) & ((t > 0) == (across > 0))  # their product may underflow
    rise = to[2] * across + s * e[2]
    return jnp.where(known, quotient(rise, jnp.where(known, t, 1)), -jnp.inf if above else jnp.inf)


def _outermost_edge(
    grid: Grid,
    o: Vector,
    level: Vector,
    leaving: Hit,
    between: tuple[Scalar, Scalar],
    t_max: Scalar | None,
    number: int,
    active: Flag,
    above: bool,
) -> tuple[Index, Flag]:
    """The edge that makes the horizon, -1 where that is the slope to begin with; and whether the walk ran out of steps.

    The walk begins as that of a level ray between the lowest and the highest of the heights, with t in world units. It comes
    from `o`, in the grid's frame; the other arguments are those of `skyline_slope`.
    """
    (lowest, highest), rise = between, grid.grid_from_world.linear[2, 2]
    along = jnp.stack([*grid.grid_from_world.vector(level)[:2], jnp.zeros_like(o[2])])
    inside = Ray(jnp.stack([o[0], o[1], jnp.clip(o[2], 0, grid.z_top)]), along)
    walk, state, _ = walk_start(grid, inside, leaving, number, None, active & (lowest < highest))
    state = state | 4 if above else state & ~jnp.uint32(4)
    own = leaving.object == number
    z = jnp.where(own, walk.z_ray, o[2])
    end_x = jnp.where(walk.back_x, grid.pyramid.width, grid.cells[0])
    end_y = jnp.where(walk.back_y, grid.pyramid.height, grid.cells[1])
    by_side = lesser(walk.distance_x(end_x), walk.distance_y(end_y))
    by_side = by_side if t_max is None else lesser(by_side, t_max - walk.t_start)
    # A point on a wall along the border may be inside by rounding; the border does not stand before it then.
    touching = jnp.where(own, 0, _rounding(grid, o) / greater(walk.dx, walk.dy))
    start = jnp.stack([o[0], o[1], z])

    def tilted(slope: Scalar) -> Walk:
        slope = slope * rise
        leaves = slope > 0 if above else slope < 0
        last = grid.z_top - z if above else -z
        at_last = jnp.where(leaves, last / jnp.where(leaves, slope, 1) - walk.t_start, jnp.inf)
        z_ray, t_end, t_stop = z + walk.t_start * slope, jnp.full_like(slope, jnp.inf), lesser(by_side, at_last)
        return dataclasses.replace(walk, dz=slope, z_ray=z_ray, t_end=t_end, t_stop=t_stop)

    def raised(slope: Scalar, edge: Index) -> Scalar:
        found = _slope_to(grid, start, level, edge, above)
        return materialise(jnp.maximum(found, slope) if above else jnp.minimum(found, slope))

    def advance(carry: tuple[jax.Array, Scalar, Index]) -> tuple[jax.Array, Scalar, Index]:
        state, slope, edge = carry
        here = tilted(slope)
        state = lax.fori_loop(0, SKIPS, lambda _, state: here.skip(state), state)
        state, found = _beside_cell(here, state, touching, above, t_max)
        slope = raised(slope, found)
        goes_on = slope < highest if above else slope > lowest
        return jnp.where(goes_on, state, MISS), slope, jnp.where(found >= 0, found, edge)

    init = state, lowest if above else highest, jnp.full_like(leaving.object, -1)
    state, _, edge = until_ended(advance, init, walk.budget, grid.fixed_steps)
    return edge, walking(state)


def _beside_cell(walk: Walk, state: jax.Array, beyond: Scalar, above: bool, t_max: Scalar | None) -> tuple[jax.Array, Index]:
    """One cell, for a ray on one side of the surface that nothing stops: goes on, and says which edge is furthest past it.

    Args:
      state: of the walk.
      beyond: up to which t no edge counts.
      above: whether the ray is above the surface.
      t_max: up to which t edges count; None: all.

    Returns:
      The state in the next cell, and the edge that is seen from where t is 0 at the largest slope of those above the ray
      (at the smallest of those below a ray that is below the surface), see `_edge`; -1 where none is, and in a larger
      block, which is left alone.
    """
    side, ix, iy, size = walk.unpack(state)
    visits = walking(state) & (size == 1)
    cell = walk.cell(state, ix, iy, size)
    kind_entry, gap_entry = _entry(walk, ix, iy, cell.near)

    def past(t: Scalar, gap: Scalar, counts: Flag) -> Scalar:
        """How far an edge stands past the ray; 0 where it does not, or does not count."""
        counts = counts & (t > beyond) if t_max is None else counts & (t > beyond) & (t <= t_max)
        return jnp.where(counts, greater(-gap if above else gap, jnp.zeros_like(gap)), 0)

    at_entry, at_diagonal, at_exit = (walk.t_start + t for t in (cell.near, cell.diagonal, cell.out))
    entry = past(at_entry, gap_entry, jnp.ones_like(visits))
    diagonal = past(at_diagonal, cell.gap_diagonal, cell.crosses & ~cell.on_own)
    exit_ = past(at_exit, cell.gap_out, ~cell.skip_out)
    # A diagonal that is not crossed may lie behind, with a t below 0.
    by_diagonal = (diagonal > 0) & (diagonal * at_exit > exit_ * at_diagonal)
    most, at_most = jnp.where(by_diagonal, diagonal, exit_), jnp.where(by_diagonal, at_diagonal, at_exit)
    ahead = _edge(walk, ix, iy, jnp.where(by_diagonal, 2, cell.through_x.astype(jnp.int32)), ahead=True)
    # That of the cell before, which may have no triangle.
    by_entry = (entry > 0) & (entry * at_most > most * at_entry)
    edge = jnp.where(by_entry, _edge(walk, ix, iy, kind_entry, ahead=False), ahead)
    rises = visits & cell.whole & (greater(entry, most) > 0)
    edge = materialise(jnp.where(rises, edge, -1))
    return jnp.where(visits, walk.onwards(side, ix, iy, size, cell.out_x, cell.out_y), state), edge


def _entry(walk: Walk, ix: Index, iy: Index, near: Scalar) -> tuple[Index, Scalar]:
    """The kind of the edge by which a ray comes into a cell, and how high it is above that edge."""
    z00, z10, z01, z11 = corners(walk.rows, walk.nx, ix ^ walk.flip[0], iy ^ walk.flip[1], walk.first)
    u, v = walk.x + near * walk.dx - ix.astype(near.dtype), walk.y + near * walk.dy - iy.astype(near.dtype)
    through_x = walk.distance_x(ix) >= walk.distance_y(iy)
    low = jnp.where(through_x, jnp.where(walk.back_x, z10, z00), jnp.where(walk.back_y, z01, z00))
    high = jnp.where(through_x, jnp.where(walk.back_x, z11, z01), jnp.where(walk.back_y, z11, z10))
    along = jnp.where(through_x, jnp.where(walk.back_y, 1 - v, v), jnp.where(walk.back_x, 1 - u, u))
    return through_x.astype(jnp.int32), walk.gap(near, low, high, along)


def _edge(walk: Walk, ix: Index, iy: Index, kind: Index, ahead: bool) -> Index:
    """3 * its first vertex + its kind: of the sides by which the ray leaves or enters a cell that along x (0) or y (1), or
    the diagonal (2)."""
    flip_x, flip_y = walk.flip
    further_x, further_y = (kind == 1) & (walk.back_x != ahead), (kind == 0) & (walk.back_y != ahead)
    x, y = (ix ^ flip_x) + further_x.astype(jnp.int32), (iy ^ flip_y) + further_y.astype(jnp.int32)
    return 3 * (y * walk.nx + x) + kind
