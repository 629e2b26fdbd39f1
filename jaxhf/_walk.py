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

import enum

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax

from ._grid import Grid, corners, triangle_plane
from ._ray import Ray
from ._types import Flag, Index, Scalar

# Along an axis in which it moves less than 1 / _FAR, a ray counts as standing still; its distance to the next plane there is
# then large, but finite in single precision whatever it is multiplied with later.
_FAR = 1e30


class Status(enum.IntEnum):
    """How a ray ended."""

    MISS = 0
    HIT = 1
    EXHAUSTED = 2  # its budget of steps ran out
    INVALID = 3  # its origin or direction was not finite, or its direction zero


# The state of a walk is one unsigned integer, as every further carried array would repeat the step's arithmetic in a
# kernel of its own. From its lowest bit on: the status (2 bits); whether the ray is above the surface; x, with the size of
# the block; y. The code of x is 2 x + size: the lowest bit that is set in it tells the size, as x is a multiple of it. After
# a hit, when the size is known to be one cell, that bit says whether it was the upper triangle.
_MISS, _HIT = int(Status.MISS), int(Status.HIT)
_WALKING = int(Status.EXHAUSTED)  # what a walk that still goes on ends with when its budget runs out
_LEAVING = 3  # still in the triangle that the ray starts from


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


def walking(state: jax.Array) -> Flag:
    return (state & 3) >= _WALKING


class Walk:
    """The constants of one ray's walk, in the grid's frame, and the steps that it takes."""

    def __init__(self, grid: Grid, ray: Ray, departure: Departure | None, t_max: Scalar | None):
        self.z, self.pyramid, self.departure = grid.z, grid.pyramid, departure
        self.cells_x, self.cells_y = grid.cells
        self.bits_x = self.pyramid.width.bit_length()  # one more than x needs: for the size
        if 3 + self.bits_x + (self.pyramid.height - 1).bit_length() > 32:
            raise ValueError(f"Heightfield: at most 2**28 cells can be traced, heights have shape {grid.z.shape}")
        o, d = ray.o, ray.d
        self.valid = jnp.isfinite(o).all() & jnp.isfinite(d).all() & (d != 0).any()
        self.dx, self.dy, self.dz = d[0], d[1], d[2]
        self.inv_x, self.inv_y, self.inv_z = _reciprocal(self.dx), _reciprocal(self.dy), _reciprocal(self.dz)
        self.forward_x, self.forward_y = self.inv_x > 0, self.inv_y > 0
        self.rate = self.dx - self.dy
        self.inv_rate = _reciprocal(self.rate)
        self._enter(grid, o)
        self.t_end = jnp.where(self.inv_z > 0, grid.z_top - self.z_ray, -self.z_ray) * self.inv_z
        self.t_max = None if t_max is None else t_max - self.t_start

    def _enter(self, grid: Grid, o: jax.Array) -> None:
        """Moves the origin to where the ray enters the surface's box, or to the point that it departs from.

        The far distances are widened by the rounding of the operations behind them, so that no ray along a face is lost
        (Ize, Robust BVH ray traversal, JCGT 2(2), 2013).
        """
        near_x, far_x = _slab(o[0], self.inv_x, self.cells_x)
        near_y, far_y = _slab(o[1], self.inv_y, self.cells_y)
        near_z, far_z = _slab(o[2], self.inv_z, grid.z_top)
        start = jnp.maximum(jnp.maximum(near_x, near_y), jnp.maximum(near_z, 0))
        wide = 1 + 8 * jnp.finfo(o.dtype).eps
        self.enters = self.valid & (start <= jnp.minimum(jnp.minimum(far_x, far_y), far_z) * wide)
        start = jnp.where(self.enters, start, 0)
        # An ulp inside the far border, so that a ray which stands still on it is in the last cell.
        inside = 1 - jnp.finfo(o.dtype).epsneg
        self.x = jnp.clip(o[0] + start * self.dx, 0, self.cells_x * inside)
        self.y = jnp.clip(o[1] + start * self.dy, 0, self.cells_y * inside)
        self.z_ray = jnp.clip(o[2] + start * self.dz, 0, grid.z_top)
        # Came through floor or ceiling: the side is known, whatever the rounding of the height there.
        self.through_end = ((o[2] < 0) | (o[2] > grid.z_top)) & (start == near_z)
        if self.departure is not None:
            away, at = self.departure.active, self.departure
            a, b, c = triangle_plane(grid.z, at.ix, at.iy, at.upper)
            height = c + a * (at.x - at.ix.astype(o.dtype)) + b * (at.y - at.iy.astype(o.dtype))
            self.enters = self.enters | away
            start = jnp.where(away, 0, start)
            self.x, self.y = jnp.where(away, at.x, self.x), jnp.where(away, at.y, self.y)
            self.z_ray = jnp.where(away, height, self.z_ray)
        self.t_start = start

    def start(self, active: Flag | None) -> jax.Array:
        """The state in which the walk begins; `active` False: it does not begin at all.

        By the rule of the walk, planes in x count as crossed at their own distance and planes in y just behind it, so that
        at a vertex x is crossed first.
        """
        column = jnp.where(self.forward_x, jnp.floor(self.x), jnp.ceil(self.x) - 1)
        row = jnp.where(self.forward_y, jnp.ceil(self.y) - 1, jnp.floor(self.y))
        ix = jnp.clip(column.astype(jnp.int32), 0, self.cells_x - 1)
        iy = jnp.clip(row.astype(jnp.int32), 0, self.cells_y - 1)
        u, v = self.x - ix.astype(self.x.dtype), self.y - iy.astype(self.y.dtype)
        a, b, c = triangle_plane(self.z, ix, iy, v > u)
        gap = self.z_ray - (c + a * u + b * v)
        gap = jnp.where(gap == 0, self.dz - a * self.dx - b * self.dy, gap)  # on the surface: where it goes
        above = jnp.where(self.through_end, self.dz < 0, gap >= 0)
        going = self.enters if active is None else self.enters & active
        status = jnp.where(going, _WALKING, _MISS)
        if self.departure is not None:
            away, at = self.departure.active, self.departure
            ix, iy = jnp.where(away, at.ix, ix), jnp.where(away, at.iy, iy)
            above = jnp.where(away, at.side > 0, above)
            status = jnp.where(going & away, _LEAVING, status)
        return self._pack(status, above, 2 * ix + 1, iy)

    def _distance_x(self, plane: Index) -> Scalar:
        return (plane.astype(self.x.dtype) - self.x) * self.inv_x

    def _distance_y(self, plane: Index) -> Scalar:
        return (plane.astype(self.y.dtype) - self.y) * self.inv_y

    def _pack(self, status: jax.Array | int, above: jax.Array, code_x: jax.Array, iy: jax.Array) -> jax.Array:
        def bits(value: jax.Array | int, shift: int) -> jax.Array:
            return jnp.asarray(value).astype(jnp.uint32) << shift

        return bits(status, 0) | bits(above, 2) | bits(code_x, 3) | bits(iy, 3 + self.bits_x)

    def _fields(self, state: jax.Array) -> tuple[Flag, Index, Index]:
        """What `_pack` took besides the status."""
        code = (state >> 3).astype(jnp.int32) & ((1 << self.bits_x) - 1)
        return (state & 4) != 0, code, (state >> (3 + self.bits_x)).astype(jnp.int32)

    def _unpack(self, state: jax.Array) -> tuple[Flag, Index, Index, Index]:
        """Whether the ray is above the surface, and its block's first cell and size."""
        above, code, iy = self._fields(state)
        size = code & -code
        return above, (code - size) >> 1, iy, size

    def _passage(self, ix: Index, iy: Index, size: Index) -> tuple[Scalar, Scalar, Scalar]:
        """Distances at which the ray enters the block, and at which it reaches its far planes in x and in y."""
        x0, x1, y0, y1 = self._distance_x(ix), self._distance_x(ix + size), self._distance_y(iy), self._distance_y(iy + size)
        near = jnp.maximum(jnp.maximum(jnp.minimum(x0, x1), jnp.minimum(y0, y1)), 0)
        return near, jnp.maximum(x0, x1), jnp.maximum(y0, y1)

    def skip(self, state: jax.Array) -> jax.Array:
        """One block: passes it where the ray is clear of it, else goes down to the part of it that the ray is in.

        A cell of which the ray is not clear is left to `visit`.
        """
        above, ix, iy, size = self._unpack(state)
        near, out_x, out_y = self._passage(ix, iy, size)
        out = jnp.minimum(jnp.minimum(out_x, out_y), self.t_end)
        towards = jnp.where(above, self.dz < 0, self.dz > 0)  # nearest to the surface where it leaves, else where it enters
        height = self.z_ray + jnp.where(towards, out, near) * self.dz
        level = 31 - lax.clz(size)
        clear = jnp.where(above, height, -height) > self.pyramid.bound(above, level, ix, iy)
        onwards = self._onwards(above, ix, iy, size, out_x, out_y)
        inside = state
        if self.pyramid.levels:
            half = size >> 1
            far_x = (self._distance_x(ix + half) <= near) == self.forward_x
            far_y = (self._distance_y(iy + half) < near) == self.forward_y
            part_x, part_y = ix + jnp.where(far_x, half, 0), iy + jnp.where(far_y, half, 0)
            # A part beyond the border is entered only by a ray that has left the footprint.
            gone = (part_x >= self.cells_x) | (part_y >= self.cells_y)
            part = self._pack(jnp.where(gone, _MISS, _WALKING), above, 2 * part_x + half, part_y)
            inside = jnp.where(size > 1, part, state)
        return jnp.where((state & 3) == _WALKING, jnp.where(clear, onwards, inside), state)

    def visit(self, state: jax.Array) -> jax.Array:
        """One cell: looks for a change of sign at its diagonal and at its exit, else moves on; larger blocks are left alone."""
        above, ix, iy, size = self._unpack(state)
        near, out_x, out_y = self._passage(ix, iy, size)
        x, y = ix.astype(self.x.dtype), iy.astype(self.y.dtype)
        z00, z10, z01, z11 = corners(self.z, jnp.minimum(ix, self.cells_x - 1), jnp.minimum(iy, self.cells_y - 1))
        whole = jnp.isfinite(z00 + z10 + z01 + z11)
        through_x = out_x <= out_y
        out = jnp.minimum(out_x, out_y)
        last = self.t_end <= out
        out = jnp.minimum(out, self.t_end)
        across, diagonal = self._diagonal(ix, iy)
        crosses = (near < diagonal) & (diagonal < out)
        on_own, skip_out = jnp.zeros((), bool), jnp.zeros((), bool)
        if self.departure is not None:
            leaving = (state & 3) == _LEAVING
            ahead = jnp.where(self.departure.upper, self.rate > 0, self.rate < 0) & (diagonal < out)
            crosses = jnp.where(leaving, ahead, crosses)
            on_own, skip_out = leaving & crosses, leaving & ~crosses

        # The edge of the exit: its lower and upper end, and how far along the ray crosses it.
        low = jnp.where(through_x, jnp.where(self.forward_x, z10, z00), jnp.where(self.forward_y, z01, z00))
        high = jnp.where(through_x, jnp.where(self.forward_x, z11, z01), jnp.where(self.forward_y, z11, z10))
        along = jnp.where(through_x, self.y + out * self.dy - y, self.x + out * self.dx - x)
        gap_out = self._gap(out, low, high, along)
        gap_out = jnp.where(last, self.dz, gap_out)  # below the lowest height or above the highest: no rounding can hide it
        gap_diagonal = self._gap(diagonal, z00, z11, self.x + diagonal * self.dx - x)
        met_first = crosses & ~on_own & _opposite(above, gap_diagonal)
        met = whole & (met_first | (~skip_out & _opposite(above, gap_out)))
        above_diagonal = (near + out) / 2 * self.rate < across
        upper = jnp.where(crosses, jnp.where(met_first, self.rate > 0, self.rate < 0), above_diagonal)

        above = jnp.where(whole, above, gap_out >= 0)  # behind a hole the side is found anew
        onwards = self._onwards(above, ix, iy, size, out_x, out_y)
        hit = self._pack(_HIT, above, 2 * ix + upper.astype(jnp.int32), iy)
        return jnp.where(walking(state) & (size == 1), jnp.where(met, hit, onwards), state)

    def _onwards(self, above: Flag, ix: Index, iy: Index, size: Index, out_x: Scalar, out_y: Scalar) -> jax.Array:
        """The state in the next block; in one of twice the size where the ray also leaves this block's parent."""
        through_x = out_x <= out_y
        next_x = ix + jnp.where(through_x, jnp.where(self.forward_x, size, -size), 0)
        next_y = iy + jnp.where(through_x, 0, jnp.where(self.forward_y, size, -size))
        out = jnp.minimum(out_x, out_y)
        leaves = (self.t_end <= out) | (next_x < 0) | (next_x >= self.cells_x) | (next_y < 0) | (next_y >= self.cells_y)
        if self.t_max is not None:
            leaves = leaves | (out > self.t_max)
        if self.pyramid.levels:
            plane = jnp.where(through_x, jnp.where(self.forward_x, next_x, ix), jnp.where(self.forward_y, next_y, iy))
            grows = ((plane & size) == 0) & (size < (1 << self.pyramid.levels))
            size = jnp.where(grows, 2 * size, size)
            next_x, next_y = next_x & -size, next_y & -size
        code, row = jnp.where(leaves, 1, 2 * next_x + size), jnp.where(leaves, 0, next_y)
        return self._pack(jnp.where(leaves, _MISS, _WALKING), above, code, row)

    def _diagonal(self, ix: Index, iy: Index) -> tuple[Scalar, Scalar]:
        """How far the cell's diagonal lies from the origin along x - y, and the distance at which the ray crosses it."""
        across = (ix - iy).astype(self.x.dtype) - (self.x - self.y)
        return across, across * self.inv_rate

    def _gap(self, t: Scalar, low: Scalar, high: Scalar, along: Scalar) -> Scalar:
        """g at the crossing of an edge; relative to the ray's own height first, so that a flat surface leaves no rounding."""
        return t * self.dz - ((low - self.z_ray) + jnp.clip(along, 0, 1) * (high - low))

    def finish(self, state: jax.Array, steps: Index | None) -> CellHit:
        met = (state & 3) == _HIT
        above, code, iy = self._fields(state)
        ix, iy = jnp.where(met, code >> 1, 0), jnp.where(met, iy, 0)
        near, out_x, out_y = self._passage(ix, iy, jnp.ones_like(ix))
        far = jnp.maximum(jnp.minimum(jnp.minimum(out_x, out_y), self.t_end), near)
        # Within its triangle, that is, on its side of the diagonal where that is crossed: a ray that grazes the triangle's
        # plane could otherwise be anywhere in the cell.
        upper = code & 1 != 0
        _, diagonal = self._diagonal(ix, iy)
        crosses, before = (near < diagonal) & (diagonal < far), upper == (self.rate > 0)
        near, far = jnp.where(crosses & ~before, diagonal, near), jnp.where(crosses & before, diagonal, far)
        ended = jnp.where(walking(state), _WALKING, (state & 3).astype(jnp.int32))
        return CellHit(
            status=jnp.where(self.valid, ended, int(Status.INVALID)).astype(jnp.int32),
            ix=ix,
            iy=iy,
            upper=met & upper,
            side=jnp.where(above, 1, -1).astype(jnp.int32),
            t_near=jnp.where(met, self.t_start + near, 0),
            t_far=jnp.where(met, self.t_start + far, 0),
            steps=steps,
        )


def _opposite(above: Flag, gap: Scalar) -> Flag:
    """Whether `gap` lies strictly on the other side; never where it is nan."""
    return jnp.where(above, gap < 0, gap > 0)


def _reciprocal(d: Scalar) -> Scalar:
    still = jnp.abs(d) < 1 / _FAR
    return jnp.where(still, _FAR, 1 / jnp.where(still, 1, d))


def _slab(o: Scalar, inverse: Scalar, high: Scalar | int) -> tuple[Scalar, Scalar]:
    """Distances between which a ray is in 0 <= coordinate <= high; (inf, -inf) where it never is."""
    a, b = -o * inverse, (high - o) * inverse
    still, inside = inverse == _FAR, (o >= 0) & (o <= high)
    near = jnp.where(still, jnp.where(inside, -jnp.inf, jnp.inf), jnp.minimum(a, b))
    far = jnp.where(still, jnp.where(inside, jnp.inf, -jnp.inf), jnp.maximum(a, b))
    return near, far
