"""Where rays meet a heightfield, and the normals there: slow, plain NumPy in double precision, written apart from jaxhf.

`cast` follows g(t) = height of the ray - height of the surface: between two crossings of lines x = i, y = j and diagonals g is
linear, so its values at all the crossings settle everything, also how close the answer is to another one.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

MISS, HIT = 0, 1

Vectors = Float[np.ndarray, "n 3"]


class Place(NamedTuple):
    """Points on the surface, one to a ray; without meaning where there is no hit.

    Attributes:
      p: in the frame of the rays.
      n: unit normals of the triangles, on the surface's +z side.
      uv: position in the whole footprint, 0..1.
      cell: (ix, iy).
      triangle: 0 for (00, 10, 11), 1 for (00, 11, 01).
      inside: distance along x or y to the nearest edge of the triangle, in cells.
    """

    p: Vectors
    n: Vectors
    uv: Float[np.ndarray, "n 2"]
    cell: Int[np.ndarray, "n 2"]
    triangle: Int[np.ndarray, " n"]
    inside: Float[np.ndarray, " n"]


class OracleHit(NamedTuple):
    """How rays end, and what rounding could make of them.

    Rounding is taken to shift a ray against the surface by at most `slack` times the largest lengths that occur: along x
    and y the size of the grid or the distance of the origin, along z the range of the heights or the origin's distance
    from the lowest.

    Attributes:
      status: MISS or HIT.
      t: the smallest t > 0; infinite without a hit.
      place: what stands there.
      decided: whether no such shift turns a hit into a miss or a miss into a hit.
      earliest: no shifted ray hits before; infinite where none hits at all.
      latest: no shifted ray passes beyond; infinite where one may miss.
      shift: the shift along x and y, in cells.
      rise: its effect, with that of the shift along z, on the height over the surface near the hit.
    """

    status: Int[np.ndarray, " n"]
    t: Float[np.ndarray, " n"]
    place: Place
    decided: Bool[np.ndarray, " n"]
    earliest: Float[np.ndarray, " n"]
    latest: Float[np.ndarray, " n"]
    shift: Float[np.ndarray, " n"]
    rise: Float[np.ndarray, " n"]

    @property
    def spread(self) -> Float[np.ndarray, " n"]:
        """How far apart hits of shifted rays can be, in t; infinite unless all of them hit."""
        bounded = np.isfinite(self.latest)
        return np.where(bounded, self.latest, np.inf) - np.where(bounded, self.earliest, 0)


class _Sheet(NamedTuple):
    """A heightfield in cells with its holes filled and a ring of cells round it, so that near misses have a distance.

    Attributes:
      z: heights from the lowest; vertex (ix, iy) of the field is at [iy + 1, ix + 1].
      there: cells that belong to the field.
      steepness: see the function.
    """

    z: Float[np.ndarray, "rows columns"]
    there: Bool[np.ndarray, "cell_rows cell_columns"]
    steepness: Float[np.ndarray, "cell_rows cell_columns"]


def _sheet(heights: np.ndarray) -> tuple[_Sheet, float]:
    """The field as a sheet, and its lowest height."""
    finite = np.isfinite(heights)
    there = finite[:-1, :-1] & finite[:-1, 1:] & finite[1:, :-1] & finite[1:, 1:]
    lowest = heights[finite].min() if finite.any() else 0.0
    known = np.where(finite, heights - lowest, 0)
    totals, counts = (_windows(np.pad(value.astype(float), 1), 3).sum((2, 3)) for value in (known, finite))
    z = np.pad(np.where(finite, known, totals / np.maximum(counts, 1)), 1, mode="edge")
    return _Sheet(z, np.pad(there, 1), steepness(z)), lowest


def steepness(heights: np.ndarray) -> np.ndarray:
    """For each cell, what no height in it or in a neighbour changes by more when x or y or both change by one cell."""
    along_x, along_y = np.abs(np.diff(heights, axis=1)), np.abs(np.diff(heights, axis=0))
    found = np.maximum(along_x[:-1], along_x[1:]) + np.maximum(along_y[:, :-1], along_y[:, 1:])
    return _windows(np.pad(found, 1), 3).max((2, 3))


def _windows(values: np.ndarray, size: int) -> np.ndarray:
    return np.lib.stride_tricks.sliding_window_view(values, (size, size))


def _height(sheet: _Sheet, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Height over the points (x, y), and the slopes along x and y of the triangle there; beyond the ring that of its rim."""
    rows, columns = sheet.there.shape
    ix = np.clip(np.floor(x).astype(int) + 1, 0, columns - 1)
    iy = np.clip(np.floor(y).astype(int) + 1, 0, rows - 1)
    u, v = np.clip(x - (ix - 1), 0, 1), np.clip(y - (iy - 1), 0, 1)
    z00, z10, z01, z11 = sheet.z[iy, ix], sheet.z[iy, ix + 1], sheet.z[iy + 1, ix], sheet.z[iy + 1, ix + 1]
    a = np.where(v > u, z11 - z01, z10 - z00)
    b = np.where(v > u, z01 - z00, z11 - z10)
    return z00 + a * u + b * v, a, b


def _distance(present: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """How far along x or y points are from the nearest marked cell; infinite where that is beyond their cell's neighbours."""
    padded = np.pad(present, 2)
    ix, iy = np.floor(x), np.floor(y)
    nearest = np.full(x.shape, np.inf)
    for jx in (-1, 0, 1):
        for jy in (-1, 0, 1):
            column = np.clip(ix + jx + 3, 0, padded.shape[1] - 1).astype(int)
            row = np.clip(iy + jy + 3, 0, padded.shape[0] - 1).astype(int)
            away_x = np.maximum(np.maximum(ix + jx - x, x - (ix + jx + 1)), 0)
            away_y = np.maximum(np.maximum(iy + jy - y, y - (iy + jy + 1)), 0)
            nearest = np.minimum(nearest, np.where(padded[row, column], np.maximum(away_x, away_y), np.inf))
    return nearest


def cast(
    heights: np.ndarray, dx: float, dy: float, x0: float, y0: float, o: Vectors, d: Vectors, slack: float = 1e-12
) -> OracleHit:
    """The first hits of half-lines o + t d, t > 0, on the surface, by the sign of g at every crossing.

    A hit is where g goes from one sign to the other; none is where a ray starts on the surface, or touches it and turns back.

    Args:
      heights: (ny, nx); a vertex that is not finite removes the four cells round it.
      dx, dy, x0, y0: vertex (ix, iy) is at x0 + ix dx, y0 + iy dy.
      o, d: (n, 3) each.
      slack: how large a rounding is to be allowed for, see `OracleHit`.
    """
    heights = np.asarray(heights, np.float64)
    sheet, lowest = _sheet(heights)
    corner, unit = np.array([x0, y0, lowest]), np.array([dx, dy, 1.0])
    co, cd = (o - corner) / unit, d / unit
    reach = np.maximum(np.abs(co[:, :2]).max(1), max(heights.shape))
    tall = np.maximum(sheet.z.max(), np.abs(co[:, 2]))
    shift = slack * reach
    t, g = _nodes(sheet, co, cd, shift, 2 * tall)

    middle = (t[:, 1:] + t[:, :-1]) / 2
    mx, my = co[:, :1] + middle * cd[:, :1], co[:, 1:2] + middle * cd[:, 1:2]
    to_field, to_gap = _distance(sheet.there, mx, my), _distance(~sheet.there, mx, my)
    nominal = _first_change(t, g, to_field == 0, np.zeros_like(middle))
    rows, columns = sheet.there.shape
    ix, iy = (np.clip(np.floor(m).astype(int) + 1, 0, size - 1) for m, size in ((mx, columns), (my, rows)))
    rise = slack * tall[:, None] + shift[:, None] * sheet.steepness[iy, ix]
    latest = _first_change(t, g, to_gap > shift[:, None], rise)
    earliest = _first_within(t, g, to_field <= shift[:, None], rise)

    hit = np.isfinite(nominal)
    found = np.where(hit, nominal, 0)
    nearest = np.argmin(np.abs(middle - found[:, None]), axis=1)
    return OracleHit(
        status=np.where(hit, HIT, MISS),
        t=nominal,
        place=_place(sheet, corner, unit, co[:, :2] + found[:, None] * cd[:, :2]),
        decided=np.isfinite(latest) | np.isinf(earliest),
        earliest=earliest,
        latest=latest,
        shift=shift,
        rise=rise[np.arange(len(rise)), nearest],
    )


def _nodes(sheet: _Sheet, o: np.ndarray, d: np.ndarray, shift: np.ndarray, depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """t and g at every crossing over the sheet, in order, shape (n, crossings); all the same t where a ray passes by.

    Lines x = i and y = j count three times, in their place and shifted to both sides. Below and above the field the ray
    is followed as far as `depth`.
    """
    rows, columns = sheet.there.shape
    near, far = within_slabs(o, d, [(-1.0, columns - 1.0), (-1.0, rows - 1.0), (-depth, sheet.z.max() + depth)])
    passes = near <= far
    near, far = np.where(passes, near, 0)[:, None], np.where(passes, far, 0)[:, None]
    with np.errstate(all="ignore"):
        lines = [(np.arange(-1, columns), 0, 0), (np.arange(-1, rows), 1, 1), (np.arange(-rows, columns + 1), 0, 2)]
        crossings = [near, far]
        for numbers, first, kind in lines:
            place = o[:, 0] - o[:, 1] if kind == 2 else o[:, first]
            speed = d[:, 0] - d[:, 1] if kind == 2 else d[:, first]
            for side in (0,) if kind == 2 else (-1, 0, 1):
                crossings.append((numbers + side * shift[:, None] - place[:, None]) / speed[:, None])
        t = np.concatenate(crossings, axis=1)
    t = np.sort(np.clip(np.where(np.isfinite(t), t, near), near, far), axis=1)
    x, y = o[:, :1] + t * d[:, :1], o[:, 1:2] + t * d[:, 1:2]
    return t, o[:, 2:] + t * d[:, 2:] - _height(sheet, x, y)[0]


def within_slabs(o: np.ndarray, d: np.ndarray, slabs: list[tuple]) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """t >= 0 between which rays are in all slabs, one to an axis; in the wrong order where they never are."""
    near, far = np.zeros(len(o)), np.full(len(o), np.inf)
    with np.errstate(all="ignore"):
        for axis, (low, high) in enumerate(slabs):
            one, two = (low - o[:, axis]) / d[:, axis], (high - o[:, axis]) / d[:, axis]
            within = (low <= o[:, axis]) & (o[:, axis] <= high)
            parallel = d[:, axis] == 0
            near = np.maximum(near, np.where(parallel, np.where(within, 0, np.inf), np.minimum(one, two)))
            far = np.minimum(far, np.where(parallel, np.where(within, np.inf, -np.inf), np.maximum(one, two)))
    return near, far


def _first_change(t: np.ndarray, g: np.ndarray, open_: np.ndarray, rise: np.ndarray) -> np.ndarray:
    """The first t at which g, having been beyond `rise` on one side, is beyond it on the other, within `open_` intervals."""
    first = np.full(len(t), np.inf)
    side = np.zeros(len(t))
    for k in range(t.shape[1] - 1):
        side = np.where(open_[:, k], side, 0)
        begin, end, bound = g[:, k], g[:, k + 1], rise[:, k]
        first = np.where(side * begin < -bound, np.minimum(first, t[:, k]), first)  # the bound has just become smaller
        side = np.where(np.abs(begin) > bound, np.sign(begin), side)
        changes = open_[:, k] & (side * end < -bound)
        rate = np.where(changes, end - begin, 1)
        along = np.clip((-side * bound - begin) / rate, 0, 1)
        first = np.where(changes, np.minimum(first, t[:, k] + along * (t[:, k + 1] - t[:, k])), first)
    return first


def _first_within(t: np.ndarray, g: np.ndarray, open_: np.ndarray, rise: np.ndarray) -> np.ndarray:
    """The first t in an `open_` interval at which |g| is no more than `rise`."""
    begin, end = g[:, :-1], g[:, 1:]
    side = np.where(begin < 0, -1, 1)
    starts = np.abs(begin) <= rise
    comes = open_ & (starts | (side * end <= rise))
    rate = np.where(begin == end, 1, end - begin)
    along = np.where(starts, 0, np.clip((side * rise - begin) / rate, 0, 1))
    return np.where(comes, t[:, :-1] + along * np.diff(t, axis=1), np.inf).min(axis=1)


def _place(sheet: _Sheet, corner: np.ndarray, unit: np.ndarray, at: Float[np.ndarray, "n 2"]) -> Place:
    """The surface over points given in cells."""
    nx, ny = np.array(sheet.z.shape[::-1]) - 2
    x, y = np.clip(at[:, 0], 0, nx - 1), np.clip(at[:, 1], 0, ny - 1)
    z, a, b = _height(sheet, x, y)
    ix, iy = np.clip(np.floor(x), 0, nx - 2), np.clip(np.floor(y), 0, ny - 2)
    u, v = x - ix, y - iy
    upper = v > u
    n = np.stack([-a / unit[0], -b / unit[1], np.ones_like(a)], axis=1)
    return Place(
        p=np.stack([x, y, z], axis=1) * unit + corner,
        n=n / np.linalg.norm(n, axis=1)[:, None],
        uv=np.stack([x / (nx - 1), y / (ny - 1)], axis=1),
        cell=np.stack([ix, iy], axis=1).astype(int),
        triangle=upper.astype(int),
        inside=np.minimum(np.abs(u - v), np.where(upper, np.minimum(u, 1 - v), np.minimum(v, 1 - u))),
    )


def _triangles_at(scheme: str) -> list[tuple[tuple[int, int], tuple[int, int]]]:
    """Offsets (ix, iy) of the two other corners of each triangle that counts at a vertex, counter-clockwise."""
    right, up, left, down, right_up, left_down = (1, 0), (0, 1), (-1, 0), (0, -1), (1, 1), (-1, -1)
    if scheme == "four":
        return [(right, up), (up, left), (left, down), (down, right)]
    return [(right, right_up), (right_up, up), (up, left), (left, left_down), (left_down, down), (down, right)]


def vertex_normals(heights: np.ndarray, dx: float, dy: float, scheme: str) -> tuple[np.ndarray, np.ndarray]:
    """Normals at the vertices, on the +z side, shape (ny, nx, 3), and the summed lengths of the vectors that make each.

    They are sums, not means: a vertex at the border has fewer triangles, and weighs less in an interpolation. Those of
    "six-angle" have length 1.
    """
    heights = np.asarray(heights, np.float64)
    ny, nx = heights.shape
    normals, lengths = np.zeros((ny, nx, 3)), np.ones((ny, nx))
    for iy in range(ny):
        for ix in range(nx):
            if scheme == "central":
                slopes = [_slope_at(heights, ix, iy, step, size) for step, size in (((1, 0), dx), ((0, 1), dy))]
                normals[iy, ix] = -slopes[0], -slopes[1], 1
                lengths[iy, ix] = np.linalg.norm(normals[iy, ix])
            else:
                parts = _normals_round(heights, ix, iy, dx, dy, scheme)
                normals[iy, ix] = np.sum(parts, axis=0) if parts else (0, 0, 1)
                lengths[iy, ix] = np.linalg.norm(parts, axis=1).sum() if parts else 1
                if scheme == "six-angle":
                    size = np.linalg.norm(normals[iy, ix])
                    normals[iy, ix], lengths[iy, ix] = normals[iy, ix] / size, lengths[iy, ix] / size
    return normals, lengths


def _height_at(heights: np.ndarray, ix: int, iy: int) -> float:
    """nan beyond the border and in a hole."""
    ny, nx = heights.shape
    height = heights[iy, ix] if 0 <= ix < nx and 0 <= iy < ny else np.nan
    return float(height) if np.isfinite(height) else np.nan


def _slope_at(heights: np.ndarray, ix: int, iy: int, step: tuple[int, int], size: float) -> float:
    here = _height_at(heights, ix, iy)
    ahead, behind = _height_at(heights, ix + step[0], iy + step[1]), _height_at(heights, ix - step[0], iy - step[1])
    if not np.isnan(here + ahead + behind):
        return (ahead - behind) / (2 * size)
    one_sided = [difference / size for difference in (ahead - here, here - behind) if not np.isnan(difference)]
    return one_sided[0] if one_sided else 0.0


def _normals_round(heights: np.ndarray, ix: int, iy: int, dx: float, dy: float, scheme: str) -> list[np.ndarray]:
    here = _height_at(heights, ix, iy)
    parts = []
    for (ax, ay), (bx, by) in _triangles_at(scheme):
        one, two = _height_at(heights, ix + ax, iy + ay), _height_at(heights, ix + bx, iy + by)
        if np.isnan(here + one + two):
            continue
        e1, e2 = np.array([ax * dx, ay * dy, one - here]), np.array([bx * dx, by * dy, two - here])
        area = np.cross(e1, e2)
        if scheme == "six":
            parts.append(area)
            continue
        length = np.linalg.norm(area)
        angle = np.arctan2(length, e1 @ e2)
        parts.append(area / length * (angle if scheme == "six-angle" else 1))
    return parts


def shading_normals(
    heights: np.ndarray, dx: float, dy: float, place: Place, scheme: str
) -> tuple[Vectors, np.ndarray, np.ndarray]:
    """Interpolated unit normals, how far they turn over one cell, and how much of them cancels.

    The interpolation is the barycentric mean of the triangle's three. The last value is the length of all that was added up
    over the length of the sum: rounding in the result grows by as much.
    """
    ny, nx = np.shape(heights)
    normals, lengths = vertex_normals(heights, dx, dy, scheme)
    result, turns, cancels = [], [], []
    for (u, v), (ix, iy), upper in zip(place.uv * [nx - 1, ny - 1] - place.cell, place.cell, place.triangle, strict=True):
        other, weights = ((ix, iy + 1), (1 - v, u, v - u)) if upper else ((ix + 1, iy), (1 - u, v, u - v))
        corners = [(ix, iy), (ix + 1, iy + 1), other]
        three = np.array([normals[row, column] for column, row in corners])
        added = np.dot(weights, [lengths[row, column] for column, row in corners])
        mean = np.dot(weights, three)
        length = np.linalg.norm(mean)
        result.append(mean / length)
        turns.append(sum(np.linalg.norm(three[i] - three[j]) for i, j in ((0, 1), (1, 2), (2, 0))) / length)
        cancels.append(added / length)
    return np.array(result).reshape(-1, 3), np.array(turns), np.array(cancels)


def view_rays(eye, target, fov: float, width: int, height: int, up=(0, 0, 1)) -> Float[np.ndarray, "h w 3"]:
    """Unit directions of a pinhole camera's rays through the centres of its pixels; fov is across the shorter side, degrees."""
    ahead = np.subtract(target, eye) / np.linalg.norm(np.subtract(target, eye))
    right = np.cross(ahead, up)
    right /= np.linalg.norm(right)
    pixel = 2 * np.tan(np.radians(fov / 2)) / min(width, height)
    x, y = np.meshgrid((np.arange(width) + 0.5 - width / 2) * pixel, (np.arange(height) + 0.5 - height / 2) * pixel)
    d = ahead + x[..., None] * right - y[..., None] * np.cross(right, ahead)
    return d / np.linalg.norm(d, axis=-1, keepdims=True)


def sunlit(heights: np.ndarray, dx: float, dy: float, x0: float, y0: float, o: Vectors, d: Vectors, towards) -> np.ndarray:
    """Radiance along rays from above, of matte white triangles in a sun of irradiance pi with shadows; 0 beside the terrain."""
    hit = cast(heights, dx, dy, x0, y0, o, d)
    wi = np.divide(towards, np.linalg.norm(towards))
    cos = hit.place.n @ wi
    lit = (hit.status == HIT) & (cos > 0)
    start = hit.place.p[lit] + 1e-9 * (dx + dy) * hit.place.n[lit]
    hidden = cast(heights, dx, dy, x0, y0, start, np.broadcast_to(wi, start.shape)).status == HIT
    cos[~lit] = 0
    cos[np.flatnonzero(lit)[hidden]] = 0
    return cos
