"""The solid below a height field: a base and four walls, met from outside or from within.

All of it lies in the column over the footprint. A ray is in the column between two distances, at each of which it may meet a
wall; between them it may meet the base's two horizontal faces. Whether it is over the floor where it meets a wall is asked
of the very distances at which it meets the floor, so that no rounding opens an edge.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Float

from ..core.ray import Ray
from ..core.types import Flag, Index, Scalar, Vector
from ..core.vector import greater, lesser, time_to
from ..trace.grid import Grid
from .hfield import HField

_ROUNDING = 16  # units in the last place by which the height of a wall's rim may be off


class Ground(eqx.Module):
    """A height field, see `HField`, as one of its rays sees it."""

    rows: Float[jax.Array, " vertices"]  # the data, row after row
    size: Float[jax.Array, "4"]
    pos: Vector
    quat: Float[jax.Array, "4"]
    shape: tuple[int, int] = eqx.field(static=True)  # (nrow, ncol)
    # For the search of a triangle alone, cells by cells by data; None where no ray searches. Where `rows` hold several height
    # fields, so do its arrays, and `grid.first` is the place of this one's first number in both.
    grid: Grid | None

    @property
    def first(self) -> Index | None:
        return None if self.grid is None else self.grid.first


def ground_of(hfield: HField, grid: Grid | None = None) -> Ground:
    """One height field, not a batch."""
    nrow, ncol = hfield.data.shape
    return Ground(hfield.data.reshape(-1), hfield.size, hfield.pos, hfield.quat, (nrow, ncol), grid)


class Side(eqx.Module):
    """Where a ray meets the plane of a side: its t, whether the side is there, and the normal, out of the solid."""

    t: Scalar
    met: Flag
    n: Vector


class Within(NamedTuple):
    """The distances between which a ray is within a body; the first is the greater one where it never is."""

    begin: Scalar
    end: Scalar

    def common(self, other: "Within") -> "Within":
        return Within(greater(self.begin, other.begin), lesser(self.end, other.end))

    def either(self, other: "Within") -> "Within":
        """Of two bodies that together are convex."""
        return Within(lesser(self.begin, other.begin), greater(self.end, other.end))


def slab(o: Scalar, d: Scalar, half: Scalar) -> Within:
    """Where a coordinate o + t d is within -half..half."""
    ahead = jnp.where(d > 0, half, -half)
    (begin, begins), (end, ends) = time_to(-ahead - o, d), time_to(ahead - o, d)
    always = jnp.where(jnp.abs(o) <= half, jnp.inf, -jnp.inf)
    return Within(jnp.where(begins, begin, -always), jnp.where(ends, end, always))


def column(ground: Ground, ray: Ray) -> tuple[Side, Side]:
    """Where a ray (in the height field's frame) enters the column over the footprint, and where it leaves it.

    Both lie in the planes of walls, at t that may be infinite, and are `met` where the ray comes through the column.
    """
    near, far = [], []
    for axis in (0, 1):
        d, within = ray.d[axis], slab(ray.o[axis], ray.d[axis], ground.size[axis])
        n = jnp.zeros(3, d.dtype).at[axis].set(jnp.where(d > 0, 1, -1).astype(d.dtype))
        near.append((within.begin, -n))
        far.append((within.end, n))
    (near_x, in_x), (near_y, in_y), (far_x, out_x), (far_y, out_y) = *near, *far
    first, last = near_x < near_y, far_x > far_y
    t_in, t_out = jnp.where(first, near_y, near_x), jnp.where(last, far_y, far_x)
    through = t_in <= t_out
    return Side(t_in, through, jnp.where(first, in_y, in_x)), Side(t_out, through, jnp.where(last, out_y, out_x))


def base_faces(ground: Ground, ray: Ray, within: tuple[Side, Side]) -> list[Side]:
    """The upper face of the base, and the floor; `within` is the ray's column."""
    (enters, leaves), up = within, jnp.array([0, 0, 1], ray.d.dtype)
    faces = []
    for level, n in ((jnp.zeros_like(ray.d[2]), up), (-ground.size[3], -up)):
        t, ever = time_to(level - ray.o[2], ray.d[2])
        faces.append(Side(t, ever & (t >= 0) & (enters.t <= t) & (t <= leaves.t), n))
    return faces


def wall(ground: Ground, ray: Ray, side: Side, below: Flag) -> Side:
    """The wall in whose plane a side of the ray's column lies: met where that is over the floor and below the rim.

    Where rounding cannot tell at the rim, it is met by a ray `below` the surface: so nothing gets in between the two.
    """
    t = jnp.where(side.met & jnp.isfinite(side.t), side.t, 0)
    p, up = ray(t), ray.d[2]
    t_floor, ever = time_to(-ground.size[3] - ray.o[2], up)
    over_floor = jnp.where(ever, jnp.where(up > 0, t >= t_floor, t <= t_floor), ray.o[2] >= -ground.size[3])
    nrow, ncol = ground.shape
    along_x = side.n[1] != 0
    c, u = _cell(p[0] / ground.size[0], ncol)
    r, v = _cell(p[1] / ground.size[1], nrow)
    last = jnp.where(along_x, side.n[1], side.n[0]) > 0
    r, c = jnp.where(along_x, jnp.where(last, nrow - 1, 0), r), jnp.where(along_x, c, jnp.where(last, ncol - 1, 0))
    at = r * ncol + c if ground.first is None else r * ncol + c + ground.first
    low, high = ground.rows[at], ground.rows[at + jnp.where(along_x, 1, ncol)]
    rim = (low + jnp.where(along_x, u, v) * (high - low)) * ground.size[2]
    gap, noise = p[2] - rim, _ROUNDING * jnp.finfo(rim.dtype).eps * (ground.size[2] + jnp.abs(ray.o[2]) + jnp.abs(t * up))
    under = (gap < -noise) | ((gap <= noise) & below)
    return Side(t, side.met & jnp.isfinite(side.t) & (t >= 0) & over_floor & under, side.n)


def _cell(place: Scalar, vertices: int) -> tuple[Index, Scalar]:
    """The cell along an axis at -1..1 of the footprint, and where in the cell."""
    at = (place + 1) * ((vertices - 1) / 2)
    cell = jnp.clip(at.astype(jnp.int32), 0, vertices - 2)
    return cell, jnp.clip(at - cell.astype(at.dtype), 0, 1)
