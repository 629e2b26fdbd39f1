"""Which cell does a ray meet? A discrete search: integers come out, no derivative goes through.

The ray is followed over the cells below it, and the sign of g(t) = height of the ray - height of the surface is taken at
every crossing of a line x = i, of a line y = j and of a diagonal. Between two crossings g is linear, so the first change
of sign is the first hit. Each crossing's g is computed once and handed to the next cell as one bit, so nothing can fall
between two cells: a ray that enters above the surface and leaves below it has a change of sign somewhere, whatever the
rounding.
"""

import enum
import math

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Float

from ._heightfield import Grid
from ._ray import Ray
from ._types import Flag, Index, Scalar

# Steps between two looks at whether every ray of the chunk is done.
_STRIDE = 8
# Directions flatter than this along an axis count as parallel to it: their reciprocal is still finite in float32.
_PARALLEL = 1e-30


class Status(enum.IntEnum):
    """How a ray ended."""

    MISS = 0
    HIT = 1
    EXHAUSTED = 2  # its budget of steps ran out
    INVALID = 3  # its origin or direction was not finite, or its direction zero


class Departure(eqx.Module):
    """The place on a surface that a ray leaves, so that it cannot meet the same triangle again.

    Attributes:
      active: False for a ray that starts anywhere else.
      ix, iy, upper: the triangle.
      x, y: the point in grid coordinates.
      side: 1 where the ray leaves on the +z side, else -1.
    """

    active: Flag
    ix: Index
    iy: Index
    upper: Flag
    x: Scalar
    y: Scalar
    side: Index


class CellHit(eqx.Module):
    """Where a walk ended.

    Attributes:
      status: see `Status`; unless it is HIT, the cell is in range but means nothing.
      ix, iy: the cell.
      upper: in its triangle (00, 11, 01), not in (00, 10, 11).
      side: 1 where the ray came from the +z side of the surface, else -1.
      t_near, t_far: the hit lies between them.
      steps: cells visited; None unless counted.
    """

    status: Index
    ix: Index
    iy: Index
    upper: Flag
    side: Index
    t_near: Scalar
    t_far: Scalar
    steps: Index | None


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

    The walk is that of Amanatides and Woo (A fast voxel traversal algorithm, Eurographics 1987), with the distance to each
    crossing recomputed from the integer cell, as a running sum drifts. It has a fixed number of steps, taken in blocks that
    end early. It is discrete and carries no gradient; see `surface_interaction`.

    Args:
      grid: the surface.
      ray: in the grid's frame; may start outside the footprint, or below the surface.
      max_steps: the most cells that are visited; None: as many as any ray can need, cells along x + cells along y - 1,
        since no step goes back along either axis.
      active: False spares a ray the walk: it ends as a miss.
      departure: for rays that leave this surface.
      t_max: where to give up; a hit beyond it may or may not be reported.
      count_steps: whether to count the cells visited.
    """
    grid, ray, departure, t_max = lax.stop_gradient((grid, ray, departure, t_max))
    walk = _Walk(grid, ray, departure, t_max)
    state = walk.start(active, departure)

    def advance(carry):
        state, steps = carry
        if steps is not None:
            steps = steps + (_status(state) == _WALKING).astype(jnp.int32)
        return walk.step(state), steps

    steps = jnp.zeros((), jnp.int32) if count_steps else None
    cells_x, cells_y = grid.cells
    state, steps = _repeat(advance, (state, steps), max_steps, cells_x + cells_y - 1)
    return walk.finish(state, steps)


def _repeat(advance, carry, budget: int | None, bound: int):
    """Calls `advance` exactly `budget` times, or at least `bound` times where the budget is None, unless all is done."""
    stride = _STRIDE if budget is None else min(_STRIDE, budget)
    blocks = math.ceil(bound / stride) if budget is None else min(budget, bound) // stride
    rest = 0 if budget is None else min(budget, bound) % stride

    def going(loop):
        block, (state, _) = loop
        return (block < blocks) & (_status(state) == _WALKING)

    def block_of_steps(loop):
        block, carry = loop
        return block + 1, lax.fori_loop(0, stride, lambda _, carry: advance(carry), carry)

    _, carry = lax.while_loop(going, block_of_steps, (jnp.zeros((), jnp.int32), carry))
    return lax.fori_loop(0, rest, lambda _, carry: advance(carry), carry) if rest else carry


# The state of a walk is one unsigned integer, as every further carried array would repeat the step's arithmetic in a
# kernel of its own: 2 bits of status, 1 of side, 1 that means "has just left a triangle" while walking and "upper triangle"
# after a hit, and the cell.
# A walk that still goes on has the status that it ends with when its budget runs out.
_WALKING = int(Status.EXHAUSTED)


def _status(state: jax.Array) -> jax.Array:
    return state & 3


class _Walk:
    """The constants of one ray's walk, and its steps."""

    def __init__(self, grid: Grid, ray: Ray, departure: Departure | None, t_max: Scalar | None):
        self.z = grid.z
        self.cells_x, self.cells_y = grid.cells
        self.bits_x = max(1, (self.cells_x - 1).bit_length())
        if 4 + self.bits_x + max(1, (self.cells_y - 1).bit_length()) > 32:
            raise ValueError(f"Heightfield: at most 2**28 cells can be traced, heights have shape {grid.z.shape}")
        o, d = ray.o, ray.d
        self.valid = jnp.isfinite(o).all() & jnp.isfinite(d).all() & (d != 0).any()
        self.dx, self.dy, self.dz = d[0], d[1], d[2]
        self._enter(grid, o, departure)
        self.forward_x, self.forward_y = self.dx > 0, self.dy > 0
        self.parallel_x, self.inv_x = _reciprocal(self.dx)
        self.parallel_y, self.inv_y = _reciprocal(self.dy)
        self.rate = self.dx - self.dy
        self.parallel_diagonal, self.inv_rate = _reciprocal(self.rate)
        self.t_max = None if t_max is None else t_max - self.t_start
        self.left_upper = None if departure is None else departure.upper

    def _enter(self, grid: Grid, o: jax.Array, departure: Departure | None) -> None:
        """Moves the origin to where the ray enters the surface's box; finds where it leaves it through floor or ceiling.

        The far distances are widened by the rounding of the three operations behind them, so that no ray along a face is
        lost (Ize, Robust BVH ray traversal, JCGT 2(2), 2013).
        """
        near_x, far_x = _slab(o[0], self.dx, self.cells_x)
        near_y, far_y = _slab(o[1], self.dy, self.cells_y)
        near_z, far_z = _slab(o[2], self.dz, grid.z_top)
        start = jnp.maximum(jnp.maximum(near_x, near_y), jnp.maximum(near_z, 0))
        wide = 1 + 8 * jnp.finfo(o.dtype).eps
        self.enters = start <= jnp.minimum(jnp.minimum(far_x, far_y), far_z) * wide
        start = jnp.where(self.enters & self.valid, start, 0)
        self.x = jnp.clip(o[0] + start * self.dx, 0, self.cells_x)
        self.y = jnp.clip(o[1] + start * self.dy, 0, self.cells_y)
        self.z_ray = jnp.clip(o[2] + start * self.dz, 0, grid.z_top)
        # Came through floor or ceiling: the side is known, whatever the rounding of the height there.
        self.from_end = ((o[2] < 0) | (o[2] > grid.z_top)) & (start == near_z)
        if departure is not None:
            away = departure.active
            a, b, c = triangle_plane(grid.z, departure.ix, departure.iy, departure.upper)
            u, v = departure.x - departure.ix.astype(o.dtype), departure.y - departure.iy.astype(o.dtype)
            self.enters = self.enters | away
            start = jnp.where(away, 0, start)
            self.x = jnp.where(away, departure.x, self.x)
            self.y = jnp.where(away, departure.y, self.y)
            self.z_ray = jnp.where(away, c + a * u + b * v, self.z_ray)
        self.t_start = start
        end = jnp.where(self.dz > 0, grid.z_top - self.z_ray, -self.z_ray)
        parallel_z, inv_z = _reciprocal(self.dz)
        self.t_end = jnp.where(parallel_z, jnp.inf, end * inv_z)

    def start(self, active: Flag | None, departure: Departure | None) -> jax.Array:
        ix = jnp.clip(jnp.floor(self.x).astype(jnp.int32), 0, self.cells_x - 1)
        iy = jnp.clip(jnp.floor(self.y).astype(jnp.int32), 0, self.cells_y - 1)
        u, v = self.x - ix.astype(self.x.dtype), self.y - iy.astype(self.y.dtype)
        a, b, c = triangle_plane(self.z, ix, iy, v > u)
        gap = self.z_ray - (c + a * u + b * v)
        gap = jnp.where(gap == 0, self.dz - a * self.dx - b * self.dy, gap)  # on the surface: where it goes
        above = jnp.where(self.from_end, self.dz < 0, gap >= 0)
        fresh = jnp.zeros((), bool)
        if departure is not None:
            ix, iy = jnp.where(departure.active, departure.ix, ix), jnp.where(departure.active, departure.iy, iy)
            above = jnp.where(departure.active, departure.side > 0, above)
            fresh = departure.active
        going = self.enters if active is None else self.enters & active
        status = jnp.where(self.valid, jnp.where(going, _WALKING, int(Status.MISS)), int(Status.INVALID))
        return self._pack(status, above, fresh, ix, iy)

    def _pack(self, status, above, flag, ix, iy) -> jax.Array:
        def bits(value, shift):
            return value.astype(jnp.uint32) << shift

        return bits(status, 0) | bits(above, 2) | bits(flag, 3) | bits(ix, 4) | bits(iy, 4 + self.bits_x)

    def _unpack(self, state):
        above, flag = (state >> 2) & 1 != 0, (state >> 3) & 1 != 0
        ix, iy = (state >> 4) & ((1 << self.bits_x) - 1), state >> (4 + self.bits_x)
        return above, flag, ix.astype(jnp.int32), iy.astype(jnp.int32)

    def _crossings(self, ix, iy):
        """Distances at which the ray enters the cell, crosses its diagonal, and leaves it along x and along y."""
        x, y = ix.astype(self.x.dtype) - self.x, iy.astype(self.y.dtype) - self.y
        far_x, far_y = self.forward_x.astype(x.dtype), self.forward_y.astype(y.dtype)
        out_x = jnp.where(self.parallel_x, jnp.inf, (x + far_x) * self.inv_x)
        out_y = jnp.where(self.parallel_y, jnp.inf, (y + far_y) * self.inv_y)
        in_x = jnp.where(self.parallel_x, 0, (x + (1 - far_x)) * self.inv_x)
        in_y = jnp.where(self.parallel_y, 0, (y + (1 - far_y)) * self.inv_y)
        near = jnp.maximum(jnp.maximum(in_x, in_y), 0)
        return near, (x - y) * self.inv_rate, out_x, out_y

    def step(self, state: jax.Array) -> jax.Array:
        """One cell: looks for a change of sign at its diagonal and at its exit, else moves on."""
        above, fresh, ix, iy = self._unpack(state)
        x, y = ix.astype(self.x.dtype), iy.astype(self.y.dtype)
        z00, z10, z01, z11 = corners(self.z, ix, iy)
        whole = jnp.isfinite(z00 + z10 + z01 + z11)
        near, diagonal, out_x, out_y = self._crossings(ix, iy)
        through_x = out_x <= out_y
        out = jnp.minimum(out_x, out_y)
        last = self.t_end <= out
        out = jnp.minimum(out, self.t_end)

        crosses = (near < diagonal) & (diagonal < out) & ~self.parallel_diagonal
        own, skip_out = jnp.zeros((), bool), jnp.zeros((), bool)
        if self.left_upper is not None:
            ahead = jnp.where(self.left_upper, self.rate > 0, self.rate < 0) & ~self.parallel_diagonal
            crosses = jnp.where(fresh, ahead & (diagonal < out), crosses)
            own, skip_out = fresh & crosses, fresh & ~crosses

        # The edge of the exit: its lower and upper end, and how far along the ray crosses it.
        low = jnp.where(through_x, jnp.where(self.forward_x, z10, z00), jnp.where(self.forward_y, z01, z00))
        high = jnp.where(through_x, jnp.where(self.forward_x, z11, z01), jnp.where(self.forward_y, z11, z10))
        along = jnp.where(through_x, self.y + out * self.dy - y, self.x + out * self.dx - x)
        gap_out = self._gap(out, low, high, along)
        gap_out = jnp.where(last, self.dz, gap_out)  # below the lowest height or above the highest: no rounding can hide it
        gap_diagonal = self._gap(diagonal, z00, z11, self.x + diagonal * self.dx - x)

        met_first = crosses & ~own & _opposite(above, gap_diagonal)
        met = whole & (met_first | (~skip_out & _opposite(above, gap_out)))
        before = jnp.where(
            crosses, jnp.where(met_first, self.rate > 0, self.rate < 0), self._upper_at((near + out) / 2, ix, iy)
        )

        next_ix = ix + jnp.where(through_x, jnp.where(self.forward_x, 1, -1), 0)
        next_iy = iy + jnp.where(through_x, 0, jnp.where(self.forward_y, 1, -1))
        leaves = last | (next_ix < 0) | (next_ix >= self.cells_x) | (next_iy < 0) | (next_iy >= self.cells_y)
        if self.t_max is not None:
            leaves = leaves | (out > self.t_max)
        status = jnp.where(met, int(Status.HIT), jnp.where(leaves, int(Status.MISS), _WALKING))
        stays = met | leaves
        above = jnp.where(whole, above, gap_out >= 0)  # behind a hole the side is found anew
        moved = self._pack(status, above, met & before, jnp.where(stays, ix, next_ix), jnp.where(stays, iy, next_iy))
        return jnp.where(_status(state) == _WALKING, moved, state)

    def _gap(self, t, low, high, along):
        """g at the crossing of an edge; relative to the ray's own height first, so that a flat surface leaves no rounding."""
        return t * self.dz - ((low - self.z_ray) + jnp.clip(along, 0, 1) * (high - low))

    def _upper_at(self, t, ix, iy):
        """Whether the ray at `t` is on the upper side of the cell's diagonal."""
        return (self.x - self.y) - (ix - iy).astype(self.x.dtype) + t * self.rate < 0

    def finish(self, state: jax.Array, steps: Index | None) -> CellHit:
        above, upper, ix, iy = self._unpack(state)
        near, _, out_x, out_y = self._crossings(ix, iy)
        far = jnp.minimum(jnp.minimum(out_x, out_y), self.t_end)
        met = _status(state) == int(Status.HIT)
        return CellHit(
            status=_status(state).astype(jnp.int32),
            ix=ix,
            iy=iy,
            upper=upper & met,
            side=jnp.where(above, 1, -1).astype(jnp.int32),
            t_near=jnp.where(met, self.t_start + near, 0),
            t_far=jnp.where(met, self.t_start + jnp.maximum(far, near), 0),
            steps=steps,
        )


def _opposite(above, gap):
    """Whether `gap` lies strictly on the other side; never where it is nan."""
    return jnp.where(above, gap < 0, gap > 0)


def _reciprocal(d: Scalar) -> tuple[Flag, Scalar]:
    parallel = jnp.abs(d) < _PARALLEL
    return parallel, 1 / jnp.where(parallel, 1, d)


def _slab(o: Scalar, d: Scalar, high: Scalar | int) -> tuple[Scalar, Scalar]:
    """Distances between which a ray is in 0 <= coordinate <= high; (inf, -inf) where it never is."""
    parallel, inverse = _reciprocal(d)
    inside = (o >= 0) & (o <= high)
    a, b = -o * inverse, (high - o) * inverse
    near = jnp.where(parallel, jnp.where(inside, -jnp.inf, jnp.inf), jnp.minimum(a, b))
    far = jnp.where(parallel, jnp.where(inside, jnp.inf, -jnp.inf), jnp.maximum(a, b))
    return near, far


def corners(values: Float[jax.Array, "ny nx *rest"], ix: Index, iy: Index) -> tuple[jax.Array, ...]:
    """What stands at the vertices 00, 10, 01, 11 of a cell that is in range."""

    def at(column, row):
        return values.at[row, column].get(mode="promise_in_bounds", wrap_negative_indices=False)

    return at(ix, iy), at(ix + 1, iy), at(ix, iy + 1), at(ix + 1, iy + 1)


def triangle_plane(z: Float[jax.Array, "ny nx"], ix: Index, iy: Index, upper: Flag) -> tuple[Scalar, Scalar, Scalar]:
    """(a, b, c) of the triangle's plane c + a u + b v, with u and v from the cell's vertex 00; finite in a hole too."""
    z00, z10, z01, z11 = (jnp.where(jnp.isfinite(value), value, 0) for value in corners(z, ix, iy))
    return jnp.where(upper, z11 - z01, z10 - z00), jnp.where(upper, z01 - z00, z11 - z10), z00


def distance(grid: Grid, ray: Ray, found: CellHit) -> Scalar:
    """t at which `ray` (in the grid's frame) meets the plane of the triangle that was found.

    Plain arithmetic that is differentiable in the heights and in the ray. It starts at the cell, as the subtraction
    of far heights would cancel; the rounding of t is clamped to the cell, without touching its derivative. A ray that
    lies in the plane meets it all along: then t is that of the cell, with the derivative zero.
    """
    a, b, c = triangle_plane(grid.z, found.ix, found.iy, found.upper)
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
        blocked = blocked & (distance(grid, ray, found) < t_max)
    return blocked, found.status == int(Status.EXHAUSTED)
