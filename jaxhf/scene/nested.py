"""A fine terrain within a coarser one: one surface of several heightfields, without a seam."""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..core.errors import ArgumentError, require_kind
from ..core.rules import Whole, require
from .heightfield import Heightfield
from .record import known

# By which the ring beyond the seam lies below the coarse surface, of its relief and of a fine cell: many times what single
# precision rounds places to, and nothing that is seen.
_BELOW = 1e-4, 1e-3
_ROUNDING = 1e-6  # of a cell: posts that are so near stand on each other


def nested(*fields: Heightfield, blend: int | None = None) -> tuple[Heightfield, ...]:
    """Fits terrains of several spacings into each other, so that they are one surface without a seam.

    As each is the shape of an `Object`, the finest first, a scene shows the coarse ones around the fine one, and these cast
    their shadows on it; `fit` seeks the first and holds it at its border. Each coarse one loses the cells over which a finer
    one lies. This meets it along the coarse cells' sides, in heights as in the slopes with which it is shaded, see
    `Heightfield.seam`; one ring of posts goes on beyond, just below the coarse surface, so that no ray gets in between.

    Args:
      fields: from fine to coarse, in one frame. Each must go on for two of its cells beyond the finer one on every side, and
        hold three or more of its cells within that. Where posts of a coarse one stand on none of the finer one, they are moved
        onto the nearest, along its surface.
      blend: over how many of its posts a fine terrain turns from the coarse surface at the seam to its own heights; None: over
        one coarse cell. Its holes are filled from the coarse one.

    Returns:
      The fields with their new heights: each finer one cropped to whole cells of the coarser one, with the ring.

    Raises:
      ValueError: they do not lie within each other, from fine to coarse, or have holes where they meet.
    """
    if len(fields) < 2:
        raise ArgumentError("nested", "fields", f"must be two or more, from fine to coarse, they are {len(fields)}")
    for field in fields:
        require_kind("nested", "fields", field, Heightfield, "Heightfields (a Terrain has its .heightfield())")
        if field.seam is not None:
            raise ArgumentError("nested", "fields", "must not be nested already: all of them go into one call")
    if blend is not None:
        require("nested", "blend", blend, Whole(1))
    found = list(fields)
    for k in range(1, len(found)):
        found[k] = _aligned(found[k - 1], found[k])
    for k in reversed(range(1, len(found))):
        found[k - 1 : k + 1] = _joined(found[k - 1], found[k], blend)
    return tuple(found)


class _Along(NamedTuple):
    """How a fine terrain lies within a coarser one along an axis."""

    times: int  # fine cells in a coarse one
    begin: int  # the first fine post on a coarse line
    cells: int  # whole coarse cells in the fine terrain from there on
    before: int  # coarse cells before them
    after: int

    @property
    def coarse(self) -> slice:
        """The coarse posts inside the seam, without those on it."""
        return slice(self.before + 1, self.before + self.cells)

    @property
    def fine(self) -> slice:
        """The fine posts from seam to seam."""
        return slice(self.begin, self.begin + self.cells * self.times + 1)

    def places(self) -> Float[np.ndarray, " n"]:
        """Where these stand among the coarse ones, and one more before and after them: the ring."""
        return self.before + np.arange(-1, self.cells * self.times + 2) / self.times

    def inwards(self) -> Int[np.ndarray, " n"]:
        """By how many cells those are inside the seam; -1 on the ring."""
        numbers = np.arange(-1, self.cells * self.times + 2)
        return np.minimum(numbers, numbers[::-1])


def _posts(field: Heightfield, axis: int) -> tuple[float, float, int]:
    """How far apart a terrain's posts are along y (0) or x, where the first stands, and how many there are."""
    return (*((field.dy, field.y0), (field.dx, field.x0))[axis], field.heights.shape[axis])


def _along(inner: Heightfield, outer: Heightfield, axis: int) -> _Along:
    (d, start, n), (coarse, first, count) = _posts(inner, axis), _posts(outer, axis)
    if coarse < d * (1 - _ROUNDING):
        found = f"along {'yx'[axis]} the cells of one have {d:.6g}, of the next {coarse:.6g}"
        raise ArgumentError("nested", "fields", f"must come from fine to coarse; {found}")
    times, shift = round(coarse / d), (first - start) / d
    begin = round(shift) % times
    before = math.floor((begin - shift) / times + _ROUNDING)
    last = math.floor((shift + (count - 1) * coarse / d - begin) / times + _ROUNDING)
    cells = (n - 1 - begin) // times
    if before < 2 or last - cells < 2 or cells < 3:
        ends = f"{start:.9g} to {start + (n - 1) * d:.9g}", f"{first:.9g} to {first + (count - 1) * coarse:.9g}"
        rule = "must hold 3 cells of the next coarser one each, which goes on for 2 of its cells beyond them on every side"
        found = f"along {'yx'[axis]} one lies from {ends[0]}, the next, of cells of {coarse:.6g}, from {ends[1]}"
        raise ArgumentError("nested", "fields", f"{rule}; {found}")
    return _Along(times, begin, cells, before, last - cells)


def _heights(field: Heightfield) -> Float[np.ndarray, "ny nx"]:
    heights = known(field.heights)
    if heights is None:
        raise ArgumentError("nested", "fields", "must have heights that are known, theirs are traced by JAX")
    return np.where(np.isfinite(heights), heights, np.nan).astype(np.float64)


def _aligned(inner: Heightfield, outer: Heightfield) -> Heightfield:
    """The coarser terrain with its posts moved onto the nearest of the finer one."""
    places, grid = [], []
    for axis in (0, 1):
        way, (fine, begin, _), (coarse, first, _) = _along(inner, outer, axis), _posts(inner, axis), _posts(outer, axis)
        step, start = way.times * fine, begin + (way.begin - way.before * way.times) * fine
        at = (start - first + np.arange(way.before + way.cells + way.after + 1) * step) / coarse
        places.append(np.where(np.abs(at - np.round(at)) < _ROUNDING, np.round(at), at))
        grid.append((step, start))
    (dy, y0), (dx, x0) = grid
    return Heightfield(_on_triangles(_heights(outer), *places).astype(inner.heights.dtype), dx, dy, x0, y0)


def _joined(inner: Heightfield, outer: Heightfield, blend: int | None) -> tuple[Heightfield, Heightfield]:
    """Two aligned terrains with one surface."""
    y, x = (_along(inner, outer, axis) for axis in (0, 1))
    coarse, dtype = _heights(outer), inner.heights.dtype
    places, inwards = (y.places(), x.places()), np.minimum(y.inwards()[:, None], x.inwards()[None, :])
    around = _on_triangles(coarse, *places)
    missing = np.argwhere(np.isnan(around) & (inwards == 0))
    if len(missing):
        at_y, at_x = (along[number] for along, number in zip(places, missing[0], strict=True))
        place = f"x {outer.x0 + at_x * outer.dx:.9g}, y {outer.y0 + at_y * outer.dy:.9g}"
        raise ArgumentError("nested", "fields", f"must have no holes where they meet, a coarser one has one at {place}")
    fine = np.pad(_heights(inner)[y.fine, x.fine], 1, constant_values=np.nan)
    fine = np.where(np.isnan(fine), around, fine)
    share = np.clip(1 - inwards / (blend or max(y.times, x.times)), 0, 1)
    heights = share * np.where(np.isnan(around), fine, around) + (1 - share) * fine
    relief, cell = np.nanmax(coarse) - np.nanmin(coarse), min(inner.dx, inner.dy)
    heights = np.where(inwards < 0, heights - _BELOW[0] * relief - _BELOW[1] * cell, heights)
    slopes = np.stack([_slopes(coarse, 1) / outer.dx, _slopes(coarse, 0) / outer.dy], -1)
    seam = np.where(inwards[..., None] <= 0, _on_triangles(slopes, *places), np.nan)
    corner = inner.x0 + (x.begin - 1) * inner.dx, inner.y0 + (y.begin - 1) * inner.dy
    coarse[y.coarse, x.coarse] = np.nan
    here = np.s_[y.before : y.before + y.cells + 1, x.before : x.before + x.cells + 1]
    other = np.full(slopes.shape, np.nan) if outer.seam is None else np.array(outer.seam)
    other[here] = slopes[here]
    return (
        Heightfield(heights.astype(dtype), inner.dx, inner.dy, *corner, seam.astype(dtype)),
        Heightfield(coarse.astype(dtype), outer.dx, outer.dy, outer.x0, outer.y0, other.astype(dtype)),
    )


def _on_triangles(
    values: Float[np.ndarray, "ny nx *k"], rows: Float[np.ndarray, " m"], columns: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "m n *k"]:
    """Values between posts, linear on the triangles of a heightfield; a hole counts where its vertex has a weight."""
    iy, ix = (np.clip(np.floor(at).astype(int), 0, n - 2) for at, n in zip((rows, columns), values.shape, strict=False))
    v, u = (rows - iy)[:, None], (columns - ix)[None, :]
    weights = 1 - np.maximum(u, v), np.maximum(u - v, 0), np.maximum(v - u, 0), np.minimum(u, v)
    total = np.zeros((rows.size, columns.size, *values.shape[2:]))
    for weight, (down, along) in zip(weights, ((0, 0), (0, 1), (1, 0), (1, 1)), strict=True):
        weight = weight.reshape(*weight.shape, *(1,) * (values.ndim - 2))
        total += np.where(weight > 0, weight * values[(iy + down)[:, None], (ix + along)[None, :]], 0)
    return total


def _slopes(heights: Float[np.ndarray, "ny nx"], axis: int) -> Float[np.ndarray, "ny nx"]:
    """Central differences per cell, one-sided beside holes and at the border; 0 between two holes."""
    steps = np.diff(heights, axis=axis)
    beside = ((1, 0), (0, 0)), ((0, 1), (0, 0))
    behind, ahead = (np.pad(steps, pad if axis == 0 else pad[::-1], constant_values=np.nan) for pad in beside)
    behind, ahead = np.where(np.isnan(behind), ahead, behind), np.where(np.isnan(ahead), behind, ahead)
    return np.nan_to_num((behind + ahead) / 2)
