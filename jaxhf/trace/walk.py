"""One ray's way over the cells of a grid, as a state that fits into one integer and two steps that change it.

The ray is followed over the cells below it, and the sign of g(t) = height of the ray - height of the surface is taken at
every crossing of a line x = i, of a line y = j and of a diagonal. Between two crossings g is linear, so the first change
of sign is the first hit. Each crossing's g is computed once and handed to the next cell as one bit, so nothing can fall
between two cells: a ray that enters above the surface and leaves below it has a change of sign somewhere, whatever the
rounding. Blocks of cells that the ray passes over (or under) as a whole are skipped.

Which cells a ray visits is decided by comparing its distances to the planes between them. Every such distance is computed
by the same expression from the plane's integer, so all blocks, of whatever size, agree on the ray's path, and skipping
cannot change a hit in a single bit.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Bool, Float, UInt32

from ..core.types import Flag, Index, Scalar
from ..core.vector import FAR, greater, lesser
from .hit import Status
from .pyramid import Pyramid
from .triangle import corners

# The state of a walk is one unsigned integer, as every further carried array would repeat the step's arithmetic in a
# kernel of its own. From its lowest bit on: the status (2 bits); whether the ray is above the surface; x, with the size of
# the block; y. The code of x is 2 x + size: the lowest bit that is set in it tells the size, as x is a multiple of it. After
# a hit, when the size is known to be one cell, that bit says whether it was the upper triangle.
MISS, HIT = int(Status.MISS), int(Status.HIT)
WALKING = int(Status.EXHAUSTED)  # what a walk that still goes on ends with when its budget runs out
LEAVING = 3  # still in the triangle that the ray starts from


class WalkResult(eqx.Module):
    """Where a walk ended.

    Attributes:
      status: see `Status`; unless it is HIT, the cell is in range but means nothing.
      ix, iy: the cell.
      upper: in its triangle (00, 11, 01), not in (00, 10, 11).
      side: 1 where the ray came from the +z side of the surface, else -1.
      t_near, t_far: the hit lies between them.
      steps: taken on the way; None unless counted.
    """

    status: Index
    ix: Index
    iy: Index
    upper: Flag
    side: Index
    t_near: Scalar
    t_far: Scalar
    steps: Index | None


def walking(state: UInt32[jax.Array, "*batch"]) -> Bool[jax.Array, "*batch"]:
    """Whether the walk goes on; of one ray or of several."""
    return (state & 3) >= WALKING


class Cell(NamedTuple):
    """What a walk finds in one cell.

    Attributes:
      whole: whether all of its vertices have heights.
      near, out, out_x, out_y: distances at which the ray enters and leaves, and reaches its far planes in x and in y.
      through_x: whether it leaves through that in x.
      across, diagonal: see `Walk._diagonal`.
      crosses: whether the ray crosses the diagonal there.
      on_own: whether that crossing is on the triangle that the ray leaves.
      skip_out: whether the exit is.
      gap_out, gap_diagonal: heights of the ray above the surface at the exit and at the diagonal.
    """

    whole: Flag
    near: Scalar
    out: Scalar
    out_x: Scalar
    out_y: Scalar
    through_x: Flag
    across: Scalar
    diagonal: Scalar
    crosses: Flag
    on_own: Flag
    skip_out: Flag
    gap_out: Scalar
    gap_diagonal: Scalar


class Walk(eqx.Module):
    """The constants of one ray's walk and the steps that it takes.

    A step ends in two selections: the outer one has its own flags and the inner one may keep the state. LLVM would make a
    single selection between a new state and the old one a masked store, as XLA writes both in one place; that took a fifth of
    a step on AMD's processors. Without levels `skip` still ends in one.

    The walk has a frame of its own: the grid's, mirrored so that the ray moves towards +x and +y. As it is mirrored
    within a width that is a power of two (that of the pyramid), a block stays a block.

    Attributes:
      rows, nx, pyramid: the grid's heights, how many are in a row, its bounds.
      of_x: the bits of the code of x, which has one more than x needs, for the size.
      first_of_y: the first bit of y in the state.
      first: its first height in `rows`, where those hold several grids, one after the other; None: 0.
      x, y, z_ray: where the walk begins.
      dx, dy, dz: the ray's direction.
      inv_x, inv_y: 1 / dx and 1 / dy, see `reciprocal`.
      back_x, back_y: whether the axis is mirrored.
      along_diagonals: the quantity that is constant on a diagonal, at the origin.
      rate, inv_rate: how fast it changes along the ray.
      t_start: the ray's t where the walk begins; the walk's own distances count from there.
      t_end: where the ray leaves the grid's floor or ceiling.
      t_stop: where it leaves the box, or what it is asked for.
      budget: steps after which it is given up.
      ahead: for a ray that departs from a triangle, whether the cell's diagonal may lie before it; None where none does.
      noise: for such rays, a g no larger than this has no sign: near a vertex the ray crosses into a neighbour at once,
        where g is all rounding, and a neighbour in the same plane would be met.
    """

    rows: Float[jax.Array, " vertices"]
    nx: Index
    pyramid: Pyramid
    of_x: Index
    first_of_y: UInt32[jax.Array, ""]
    x: Scalar
    y: Scalar
    z_ray: Scalar
    dx: Scalar
    dy: Scalar
    dz: Scalar
    inv_x: Scalar
    inv_y: Scalar
    back_x: Flag
    back_y: Flag
    along_diagonals: Scalar
    rate: Scalar
    inv_rate: Scalar
    t_start: Scalar
    t_end: Scalar
    t_stop: Scalar
    budget: Index
    ahead: Flag | None
    noise: Scalar | None
    first: Index | None = None

    @property
    def flip(self) -> tuple[Index, Index]:
        """A column or row of cells is mirrored by flipping all bits of its number."""
        return jnp.where(self.back_x, self.pyramid.width - 1, 0), jnp.where(self.back_y, self.pyramid.height - 1, 0)

    def distance_x(self, plane: Index) -> Scalar:
        return (plane.astype(self.x.dtype) - self.x) * self.inv_x

    def distance_y(self, plane: Index) -> Scalar:
        return (plane.astype(self.y.dtype) - self.y) * self.inv_y

    def pack(self, status: jax.Array | int, above: jax.Array, code_x: jax.Array, iy: jax.Array) -> jax.Array:
        def bits(value: jax.Array | int, shift: UInt32[jax.Array, ""] | int) -> jax.Array:
            return jnp.asarray(value).astype(jnp.uint32) << shift

        return bits(status, 0) | bits(above, 2) | bits(code_x, 3) | bits(iy, self.first_of_y)

    def _fields(self, state: jax.Array) -> tuple[Flag, Index, Index]:
        """What `pack` took besides the status."""
        code = (state >> 3).astype(jnp.int32) & self.of_x
        return (state & 4) != 0, code, (state >> self.first_of_y).astype(jnp.int32)

    def unpack(self, state: jax.Array) -> tuple[Flag, Index, Index, Index]:
        """Whether the ray is above the surface, and its block's first cell and size."""
        above, code, iy = self._fields(state)
        size = code & -code
        return above, (code - size) >> 1, iy, size

    def _passage(self, ix: Index, iy: Index, size: Index) -> tuple[Scalar, Scalar, Scalar]:
        """Distances at which the ray enters the block, and at which it reaches its far planes in x and in y."""
        near = greater(greater(self.distance_x(ix), self.distance_y(iy)), jnp.zeros_like(self.x))
        return near, self.distance_x(ix + size), self.distance_y(iy + size)

    def skip(self, state: jax.Array) -> jax.Array:
        """One block: passes it where the ray is clear of it, else goes down to the part of it that the ray is in.

        A cell of which the ray is not clear is left to `visit`.
        """
        above, ix, iy, size = self.unpack(state)
        near, out_x, out_y = self._passage(ix, iy, size)
        out = lesser(lesser(out_x, out_y), self.t_stop)
        # If it moves towards the surface, it is nearest to it where it leaves the block, else where it enters.
        heading = jnp.where(above, self.dz, -self.dz)  # less than 0: towards the surface
        height = self.z_ray + jnp.where(heading < 0, out, near) * self.dz
        flip_x, flip_y = self.flip
        bound = self.pyramid.bound(above, _log2(size), ix ^ flip_x, iy ^ flip_y)
        height = jnp.where(above, height, -height)
        clear = height > bound
        onwards = self.onwards(above, ix, iy, size, out_x, out_y)
        walks = (state & 3) == WALKING
        if self.pyramid.has_levels:
            half = size >> 1
            part_x = jnp.where(self.distance_x(ix + half) <= near, ix + half, ix)
            part_y = jnp.where(self.distance_y(iy + half) < near, iy + half, iy)
            part = self.pack(WALKING, above, 2 * part_x + half, part_y)
            state = jnp.where(walks & (size > 1), part, state)
        return jnp.where(walks & clear, onwards, state)

    def visit(self, state: jax.Array) -> jax.Array:
        """One cell: looks for a change of sign at its diagonal and at its exit, else moves on; larger blocks are left alone."""
        above, ix, iy, size = self.unpack(state)
        cell = self.cell(state, ix, iy, size)
        met_first = cell.crosses & ~cell.on_own & _opposite(above, cell.gap_diagonal)
        met = cell.whole & (met_first | (~cell.skip_out & _opposite(above, cell.gap_out)))
        # On which side of the diagonal the hit is: where the ray crosses it, before it or behind; else where its middle is. Two
        # numbers are chosen and compared, as flags would be packed into bytes to choose between them.
        least = jnp.finfo(self.rate.dtype).tiny
        middle = jnp.where(cell.crosses, jnp.where(met_first, 0, self.rate), (cell.near + cell.out) / 2 * self.rate)
        line = jnp.where(cell.crosses, jnp.where(met_first, self.rate, least), cell.across)
        upper = (middle < line) != self.back_x

        above = jnp.where(cell.whole, above, cell.gap_out >= 0)  # behind a hole the side is found anew
        onwards = self.onwards(above, ix, iy, size, cell.out_x, cell.out_y)
        hit = self.pack(HIT, above, 2 * ix + upper.astype(jnp.int32), iy)
        visits = walking(state) & (size == 1)
        return jnp.where(visits & ~met, onwards, jnp.where(visits & met, hit, state))

    def cell(self, state: jax.Array, ix: Index, iy: Index, size: Index) -> Cell:
        near, out_x, out_y = self._passage(ix, iy, size)
        flip_x, flip_y = self.flip
        z00, z10, z01, z11 = corners(self.rows, self.nx, ix ^ flip_x, iy ^ flip_y, self.first)
        whole = jnp.isfinite(z00 + z10 + z01 + z11)
        through_x = out_x <= out_y
        out = lesser(out_x, out_y)
        last = self.t_end <= out
        out = lesser(out, self.t_end)
        across, diagonal = self._diagonal(ix, iy)
        crosses = (near < diagonal) & (diagonal < out)
        on_own, skip_out = jnp.zeros((), bool), jnp.zeros((), bool)
        if self.ahead is not None:
            leaving = (state & 3) == LEAVING
            crosses = jnp.where(leaving, self.ahead & (diagonal < out), crosses)
            on_own, skip_out = leaving & crosses, leaving & ~crosses

        def along(t: Scalar) -> tuple[Scalar, Scalar]:
            """Where the ray is in the cell, in the grid's frame."""
            u = self.x + t * self.dx - ix.astype(self.x.dtype)
            v = self.y + t * self.dy - iy.astype(self.y.dtype)
            return jnp.where(self.back_x, 1 - u, u), jnp.where(self.back_y, 1 - v, v)

        # The edge of the exit: its ends, and how far along the ray crosses it.
        u, v = along(out)
        low = jnp.where(through_x, jnp.where(self.back_x, z00, z10), jnp.where(self.back_y, z00, z01))
        high = jnp.where(through_x, jnp.where(self.back_x, z01, z11), jnp.where(self.back_y, z10, z11))
        gap_out = self.gap(out, low, high, jnp.where(through_x, v, u))
        gap_diagonal = self.gap(diagonal, z00, z11, along(diagonal)[0])
        if self.noise is not None:
            gap_out, gap_diagonal = (jnp.where(jnp.abs(gap) <= self.noise, 0, gap) for gap in (gap_out, gap_diagonal))
        gap_out = jnp.where(last, self.dz, gap_out)  # below the lowest height or above the highest: no rounding can hide it
        return Cell(
            whole, near, out, out_x, out_y, through_x, across, diagonal, crosses, on_own, skip_out, gap_out, gap_diagonal
        )

    @property
    def begins_upper(self) -> Flag:
        """Whether the ray goes from the upper to the lower triangle where it crosses a diagonal."""
        return (self.rate > 0) != self.back_x

    def onwards(self, above: Flag, ix: Index, iy: Index, size: Index, out_x: Scalar, out_y: Scalar) -> jax.Array:
        """The state in the next block; in one of twice the size where the ray also leaves this block's parent."""
        through_x = out_x <= out_y
        next_x, next_y = jnp.where(through_x, ix + size, ix), jnp.where(through_x, iy, iy + size)
        leaves = self.t_stop <= lesser(out_x, out_y)
        if self.pyramid.has_levels:
            plane = jnp.where(through_x, next_x, next_y)
            grows = ((plane & size) == 0) & (size < self.pyramid.largest)
            size = jnp.where(grows, 2 * size, size)
            next_x, next_y = next_x & -size, next_y & -size
        return jnp.where(
            leaves,
            self.pack(MISS, above, jnp.ones_like(ix), jnp.zeros_like(iy)),
            self.pack(WALKING, above, 2 * next_x + size, next_y),
        )

    def _diagonal(self, ix: Index, iy: Index) -> tuple[Scalar, Scalar]:
        """How far the cell's diagonal lies from the origin, and the distance at which the ray crosses it."""
        turned = jnp.where(self.back_x != self.back_y, -1, 0)
        line = ix - (iy ^ turned)  # x - y = ix - iy, or x + y = ix + iy + 1
        across = line.astype(self.x.dtype) - self.along_diagonals
        return across, across * self.inv_rate

    def gap(self, t: Scalar, low: Scalar, high: Scalar, along: Scalar) -> Scalar:
        """g at the crossing of an edge; relative to the ray's own height first, so that a flat surface leaves no rounding."""
        along = lesser(greater(along, jnp.zeros_like(along)), jnp.ones_like(along))
        return t * self.dz - ((low - self.z_ray) + along * (high - low))

    def finish(self, state: jax.Array, valid: Flag, steps: Index | None) -> WalkResult:
        met = (state & 3) == HIT
        above, code, iy = self._fields(state)
        ix, iy = jnp.where(met, code >> 1, 0), jnp.where(met, iy, 0)
        near, out_x, out_y = self._passage(ix, iy, jnp.ones_like(ix))
        far = greater(lesser(lesser(out_x, out_y), self.t_end), near)
        # Within its triangle, that is, on its side of the diagonal where that is crossed: a ray that grazes the triangle's
        # plane could otherwise be anywhere in the cell.
        upper = code & 1 != 0
        _, diagonal = self._diagonal(ix, iy)
        crosses, before = (near < diagonal) & (diagonal < far), upper == self.begins_upper
        near, far = jnp.where(crosses & ~before, diagonal, near), jnp.where(crosses & before, diagonal, far)
        ended = jnp.where(walking(state), WALKING, (state & 3).astype(jnp.int32))
        flip_x, flip_y = self.flip
        return WalkResult(
            status=jnp.where(valid, ended, int(Status.INVALID)).astype(jnp.int32),
            ix=jnp.where(met, ix ^ flip_x, 0),
            iy=jnp.where(met, iy ^ flip_y, 0),
            upper=met & upper,
            side=jnp.where(above, 1, -1).astype(jnp.int32),
            t_near=jnp.where(met, self.t_start + near, 0),
            t_far=jnp.where(met, self.t_start + far, 0),
            steps=steps,
        )


def _log2(size: Index) -> Index:
    """Of a power of two, from the exponent of the number that it is: LLVM counts leading zeros in 25 instructions."""
    return (lax.bitcast_convert_type(size.astype(jnp.float32), jnp.int32) >> 23) - 127


def _opposite(above: Flag, gap: Scalar) -> Flag:
    """Whether `gap` lies strictly on the other side; never where it is nan."""
    return jnp.where(above, gap, -gap) < 0


def reciprocal(d: Scalar) -> Scalar:
    still = jnp.abs(d) < 1 / FAR
    return jnp.where(still, FAR, 1 / jnp.where(still, 1, d))
