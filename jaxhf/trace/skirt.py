"""Where a ray meets the walls and the floor under a terrain."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Float

from ..core.affine import Affine
from ..core.ray import Ray
from ..core.types import Flag, Index, Scalar, Vector
from ..core.vector import greater, largest_component, lesser, quotient, time_to, unit, within
from ..scene.heightfield import Size
from ..scene.skirt import Skirt
from ..xla.materialise import materialise, values_at
from .hit import Hit, hit_of_closed_form, orthogonal_tangents

# The directions out of the solid through the four walls and the floor, object frame.
OUTWARDS = ((0, -1, 0), (0, 1, 0), (-1, 0, 0), (1, 0, 0), (0, 0, -1))
_FLOOR = 4  # the number of that side; the walls are 0 to 3
_WIDE = 16  # units in the last place by which a ray's place on a side may be off


class Walls(eqx.Module):
    """A skirt made ready for tracing.

    Attributes:
      tops: heights of the border: south, north, west, east, one after the other.
      base: z of the floor.
      tallest: the height of the tallest wall.
      size: of the footprint, x and y.
      cells: along x and along y.
      known_shape: of the heightfield that they close, as a `Grid` has it.
    """

    tops: Float[jax.Array, " vertices"]
    base: Scalar
    tallest: Scalar
    size: tuple[Scalar, Scalar]
    cells: tuple[Index, Index]
    known_shape: tuple[int, int] | None = eqx.field(static=True)
    world_from_object: Affine
    object_from_world: Affine

    def distance(self, ray: Ray, leaving: Hit | None, number: int) -> tuple[Scalar, Flag, Index]:
        """The smallest t > 0 at which a world-frame ray meets a wall or the floor, whether it does, and which of the five.

        For rays from outside each side is wider by rounding, for those from inside narrower: so nothing gets in between two
        sides, or a side and the terrain, and who grazes an edge from outside does not see the inside. If the hit that a ray
        leaves lies on these walls (the object `number`), its side cannot be met again.
        """
        local = self.object_from_world.ray(ray)
        o, d = local.o, local.d
        wide = _WIDE * jnp.finfo(o.dtype).eps
        best, found, nearest = jnp.full_like(self.base, jnp.inf), jnp.zeros((), bool), jnp.zeros((), jnp.int32)
        none = jnp.zeros((), jnp.int32)
        planes = [*_upright(self), (2, self.base, 0, self.size[0], none, none)]
        for side, (axis, place, along, length, cells, first) in enumerate(planes):
            t, ever = time_to(place - o[axis], d[axis])
            at, rate = o + t * d, jnp.where(ever, d[axis], 1)
            off = jnp.abs(o) + jnp.abs(at) + (jnp.abs(o[axis]) + jnp.abs(place)) / jnp.abs(rate) * jnp.abs(d)
            outwards = -1 if side in (0, 2, _FLOOR) else 1
            wider = jnp.where(outwards * d[axis] < 0, wide, -wide) * off
            inside = (at[along] >= -wider[along]) & (at[along] <= length + wider[along])
            if side == _FLOOR:
                inside = inside & (at[1] >= -wider[1]) & (at[1] <= self.size[1] + wider[1])
            else:
                position = jnp.clip(at[along] / length, 0, 1) * cells.astype(at.dtype)
                low, high, share = materialise(_tops(self, first, position, cells))
                more = wider[2] + jnp.abs(high - low) * (cells.astype(at.dtype) / length) * wider[along]
                inside = inside & (at[2] >= self.base - wider[2]) & (at[2] <= low + share * (high - low) + more)
            met = ever & (t > 0) & (t < best) & inside
            if leaving is not None:
                met = met & ~((leaving.object == number) & (leaving.cell[0] == side))
            best, found, nearest = jnp.where(met, t, best), found | met, jnp.where(met, side, nearest)
        return jnp.where(found, best, 0), found, nearest

    def hit(self, number: int, p: Vector, d: Vector, side: Index, found: Flag, tangents: bool) -> Hit:
        """The hit at a point of a wall, or of the floor, of a ray that comes along `d`; with t = 0."""
        local = self.object_from_world.point(p)
        (size_x, size_y), dtype = self.size, p.dtype
        outwards = jnp.array(OUTWARDS, dtype)[side]
        along_x, floor = (side < 2) | (side == _FLOOR), side == _FLOOR
        u = jnp.where(along_x, local[0] / size_x, local[1] / size_y)
        v = jnp.where(floor, local[1] / size_y, time_to(local[2] - self.base, self.tallest)[0])
        n = unit(self.object_from_world.covector(outwards))
        zero = jnp.zeros((), dtype)
        hit = hit_of_closed_form(number, p, n, jnp.stack([u, v]), d, side)
        if not tangents:
            return hit
        per_u = jnp.where(along_x, jnp.stack([zero + size_x, zero, zero]), jnp.stack([zero, zero + size_y, zero]))
        per_v = jnp.where(floor, jnp.stack([zero, zero + size_y, zero]), jnp.stack([zero, zero, self.tallest]))
        dp_du, dp_dv = orthogonal_tangents(self.world_from_object.vector(per_u), self.world_from_object.vector(per_v), n)
        return dataclasses.replace(hit, dp_du=dp_du, dp_dv=dp_dv, dn_du=jnp.zeros_like(n), dn_dv=jnp.zeros_like(n))


def make_walls(skirt: Skirt, world_from_object: Affine | None, size: Size | None = None) -> Walls:
    """Prepares a skirt for tracing. With a `size` that is data its sides may be longer: then the order of `tops` and the
    `known_shape` are those of the sides."""
    tops = jnp.concatenate([jnp.asarray(side) for side in (skirt.south, skirt.north, skirt.west, skirt.east)])
    dtype = tops.dtype
    world = Affine(jnp.eye(3, dtype=dtype), jnp.zeros(3, dtype)) if world_from_object is None else world_from_object
    shape = len(skirt.west), len(skirt.south)
    size = Size.of(shape, skirt.dx, skirt.dy, dtype) if size is None else size
    lengths, cells = ((jnp.asarray(x), jnp.asarray(y)) for x, y in (size.lengths, size.cells))
    base = jnp.asarray(skirt.base, dtype)
    tallest = jnp.max(jnp.where(jnp.isfinite(tops), tops, base)) - base
    return Walls(tops, base, tallest, lengths, cells, shape, world, world.inverse())


def _upright(walls: Walls) -> list[tuple[int, Scalar, int, Scalar, Index, Index]]:
    """Of each wall: the axis across it, its place there, the axis along it, its length, its cells, and its first of `tops`."""
    (size_x, size_y), (cells_x, cells_y) = walls.size, walls.cells
    zero, first, (nx, ny) = jnp.zeros_like(size_x), jnp.zeros_like(cells_x), (cells_x + 1, cells_y + 1)
    return [(1, zero, 0, size_x, cells_x, first), (1, size_y, 0, size_x, cells_x, nx),
            (0, zero, 1, size_y, cells_y, 2 * nx), (0, size_x, 1, size_y, cells_y, 2 * nx + ny)]  # fmt: skip


def _tops(walls: Walls, first: Index, position: Scalar, cells: Index) -> tuple[Scalar, Scalar, Scalar]:
    """The heights of a wall before and after a position from 0 to `cells` along it, and its share of the way."""
    cell = jnp.clip(position.astype(jnp.int32), 0, cells - 1)
    low, high = values_at(walls.tops, first + cell, (1,))
    return low, high, position - cell.astype(position.dtype)


def wall_slopes(walls: Walls, number: int, level: Vector, leaving: Hit) -> tuple[Scalar, Scalar]:
    """The lowest and the highest slope that a skirt hides from a point; differentiable. (inf, -inf) where it hides none.

    In a vertical plane the floor and the walls at its ends are one line, as a sheet is, see `hidden_slopes`.

    The arguments are those of `skyline_slope`; the skirt is upright. If the hit lies on the outside of these walls, they hide
    nothing beside what its own side does.
    """
    p = leaving.p
    o, d = walls.object_from_world.point(p), walls.object_from_world.vector(level)
    reach = largest_component(o[:2]) + jnp.maximum(*walls.size)
    wide, own = _WIDE * float(jnp.finfo(o.dtype).eps) * reach, leaving.object == number
    low, high = jnp.full_like(walls.base, jnp.inf), jnp.full_like(walls.base, -jnp.inf)
    for axis, place, along, length, cells, first in _upright(walls):
        t, ever = time_to(place - o[axis], d[axis])
        other = o[along] + t * d[along]
        ahead = ever & (t * largest_component(d) > wide) & (other >= -wide) & (other <= length + wide)
        t = quotient(jnp.where(ahead, place - o[axis], 1), jnp.where(ahead, d[axis], 1))  # of others it may be huge
        at = o + t * d
        *tops, share = _tops(walls, first, within(at[along] / length, 0.0, 1.0) * cells.astype(o.dtype), cells)
        first_top, last_top = (jnp.where(jnp.isfinite(tops[0] + tops[1]), top, walls.base) for top in tops)
        for z in (walls.base, first_top + share * (last_top - first_top)):
            rise = walls.world_from_object.point(jnp.stack([at[0], at[1], z]))[2] - p[2]
            slope = quotient(rise, t)
            low, high = jnp.where(ahead, lesser(slope, low), low), jnp.where(ahead, greater(slope, high), high)
    covers = (o[0] >= -wide) & (o[0] <= walls.size[0] + wide) & (o[1] >= -wide) & (o[1] <= walls.size[1] + wide)
    covers, above = jnp.where(own, leaving.side < 0, covers), own | (o[2] >= walls.base)
    low, high = jnp.where(covers & above, -jnp.inf, low), jnp.where(covers & ~above, jnp.inf, high)
    outside = own & (leaving.side > 0)
    return jnp.where(outside, jnp.inf, low), jnp.where(outside, -jnp.inf, high)


def before_terrain(t: Scalar) -> Scalar:
    """The t of a wall that is met from outside: at the rim the terrain, whose lower side would be seen there, comes behind."""
    return t * (1 - _WIDE * jnp.finfo(t.dtype).eps)
