"""How steeply a heightfield rises above one point in one direction: the horizon seen from a hit, between two slopes.

`horizon` finds the same for all vertices of a grid. Here the point is any. A walk over the cells below the lower slope's ray
raises that ray wherever the surface is above it. Its blocks are skipped as in a search for a hit, and it is over where the
ray reaches the upper slope: it costs about three times as much as a search.
"""

import dataclasses

import jax
import jax.numpy as jnp
from jax import lax

from ..core.autodiff import stored
from ..core.ray import Ray
from ..core.types import Flag, Index, Scalar, Vector
from ..core.vector import greater, lesser, quotient
from ..xla.materialise import materialise
from .grid import Grid, triangle_plane
from .hit import Hit
from .search import SKIPS, enough_steps
from .walk import MISS, Walk, walking
from .walk_start import place_on_grid, walk_start

# From an edge's first vertex to its second, by its kind.
_STEPS = ((1, 0), (0, 1), (1, 1))


def skyline_slope(
    grid: Grid,
    number: int,
    p: Vector,
    level: Vector,
    leaving: Hit,
    active: Flag,
    between: tuple[Scalar, Scalar],
    max_steps: int | None,
) -> tuple[Scalar, Flag]:
    """The largest slope at which the surface is seen from a point, and whether the walk ran out of steps.

    The ground below the surface counts as solid. The slope is differentiable in the heights, the transform, the point and the
    direction: it is that of the edge which makes the horizon.

    Args:
      grid: an upright surface.
      number: of its object.
      p: the point of the hit `leaving`, world frame.
      level: a horizontal direction of length 1, world frame.
      leaving: the hit; if that lies on this grid, its own triangle does not count.
      active: False spares the walk.
      between: the slopes that matter: what is below the first counts as the first, and the walk gives up beyond the second.
      max_steps: see `first_triangle`.
    """
    ix, iy, x, y = place_on_grid(grid, leaving)
    a, b, c = triangle_plane(grid, ix, iy, leaving.triangle == 1)
    on_own = jnp.stack([x, y, c + a * (x - ix.astype(x.dtype)) + b * (y - iy.astype(y.dtype))])
    o = jnp.where(leaving.object == number, on_own, grid.grid_from_world.point(p))
    local, rise = jnp.stack([*grid.grid_from_world.vector(level)[:2], jnp.zeros_like(o[2])]), grid.grid_from_world.linear[2, 2]
    lowest, highest = between
    fixed = lax.stop_gradient((grid, Ray(o, local), level, leaving, lowest, highest, rise))
    edge, exhausted = stored(materialise(_highest_edge(*fixed, number, active, max_steps)))
    return greater(_slope_to(grid, o, level, edge), lowest), exhausted


def _slope_to(grid: Grid, o: Vector, level: Vector, edge: Index) -> Scalar:
    """World-frame slope of the point of an edge above the line o + t level in the plane; differentiable. -inf for no edge.

    Args:
      grid: which may lean by an infinitesimal, for its derivative in the transform.
      o: in the grid's frame.
      level: a horizontal direction, world frame.
      edge: see `Walk._edge`.
    """
    known, edge = edge >= 0, jnp.maximum(edge, 0)
    first, kind, nx = edge // 3, edge % 3, grid.shape[1]
    step = jnp.asarray(_STEPS, jnp.int32)[kind]
    z0, z1 = (grid.rows.at[at].get(mode="clip") for at in (first, first + step[1] * nx + step[0]))
    known = known & jnp.isfinite(z0 + z1)
    z0, z1 = jnp.where(known, z0, 0), jnp.where(known, z1, 0)
    to = grid.world_from_grid.vector(jnp.stack([(first % nx).astype(o.dtype), (first // nx).astype(o.dtype), z0]) - o)
    e = grid.world_from_grid.vector(jnp.stack([*step.astype(o.dtype), z1 - z0]))
    across = level[0] * e[1] - level[1] * e[0]
    t, s = to[0] * e[1] - to[1] * e[0], to[0] * level[1] - to[1] * level[0]  # both times `across`
    known = known & (t != 0) & ((t > 0) == (across > 0))  # their product may underflow
    rise = to[2] * across + s * e[2]
    return jnp.where(known, quotient(rise, jnp.where(known, t, 1)), -jnp.inf)


def _highest_edge(
    grid: Grid,
    ray: Ray,
    level: Vector,
    leaving: Hit,
    lowest: Scalar,
    highest: Scalar,
    rise: Scalar,
    number: int,
    active: Flag,
    max_steps: int | None,
) -> tuple[Index, Flag]:
    """The edge that makes the horizon, -1 where that is the lowest slope; and whether the walk ran out of steps.

    The walk begins as that of a level ray between the lowest and the highest of the heights, so that it leaves by the sides.

    Args:
      ray: level, in the grid's frame, t in world units.
      level: its direction, world frame.
      lowest, highest: world frame.
      rise: of a world unit, in the grid's frame.
      grid, leaving, number, active, max_steps: as for `skyline_slope`.
    """
    o = ray.o
    inside = Ray(jnp.stack([o[0], o[1], jnp.clip(o[2], 0, grid.z_top)]), ray.d)
    walk, state, _ = walk_start(grid, inside, leaving, number, None, active & (lowest < highest))
    state = state | 4  # above the surface
    own = leaving.object == number
    height = jnp.where(own, walk.z_ray, o[2])
    # A point on a wall along the border may be inside by rounding; the border does not stand before it then.
    rounding = 64 * float(jnp.finfo(o.dtype).eps) * max(grid.cells)
    touching = jnp.where(own, 0, rounding / greater(walk.dx, walk.dy))
    start = jnp.stack([o[0], o[1], height])

    def tilted(slope: Scalar) -> Walk:
        slope = slope * rise
        up = slope > 0
        at_top = jnp.where(up, (grid.z_top - height) / jnp.where(up, slope, 1) - walk.t_start, jnp.inf)
        z_ray, t_end, t_stop = height + walk.t_start * slope, jnp.full_like(slope, jnp.inf), lesser(walk.t_stop, at_top)
        return dataclasses.replace(walk, dz=slope, z_ray=z_ray, t_end=t_end, t_stop=t_stop)

    def raised(slope: Scalar, edge: Index) -> Scalar:
        return materialise(jnp.maximum(_slope_to(grid, start, level, edge), slope))

    def advance(carry: tuple[jax.Array, Scalar, Index]) -> tuple[jax.Array, Scalar, Index]:
        state, slope, edge = carry
        here = tilted(slope)
        state = lax.fori_loop(0, SKIPS, lambda _, state: here.skip(state), state)
        state, found = here.above_cell(state, touching)
        slope = raised(slope, found)
        return jnp.where(slope < highest, state, MISS), slope, jnp.where(found >= 0, found, edge)

    # Where the surface's border stands over a ray that comes from outside.
    edge = jnp.where(~own & (walk.t_start > touching), tilted(lowest).border(state), -1)
    init = state, raised(lowest, edge), edge
    bound = enough_steps(grid)
    budget = bound if max_steps is None else min(max_steps, bound)
    if not grid.early_exit:
        state, _, edge = lax.fori_loop(0, budget, lambda _, carry: advance(carry), init)
        return edge, walking(state)

    def going(carry: tuple[Index, tuple[jax.Array, Scalar, Index]]) -> Flag:
        return (carry[0] < budget) & walking(carry[1][0])

    state, _, edge = lax.while_loop(going, lambda carry: (carry[0] + 1, advance(carry[1])), (jnp.zeros((), jnp.int32), init))[1]
    return edge, walking(state)
