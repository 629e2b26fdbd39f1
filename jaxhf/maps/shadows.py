"""Cast shadows: which vertices of a heightfield a distant light reaches, exact on its triangles, in NumPy."""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

_OFF = 1e-9  # cells: more than rounding moves a ray


class _Light(NamedTuple):
    """A light's direction on a grid that is turned so that it stands ahead, where rows grow, and not towards lower columns."""

    across: float  # columns by which a ray moves while it crosses a row, 0 to 1
    rise: float  # of the ray meanwhile
    falling: bool  # whether cells are split along (i, j + 1)-(i + 1, j), and not along (i, j)-(i + 1, j + 1)


def lit(
    heights: Float[np.ndarray, "ny nx"], dx: float, dy: float, azimuth: float, altitude: float
) -> Bool[np.ndarray, "ny nx"]:
    """Where the light reaches the surface's vertices: shape (ny, nx), True also where there is no height.

    A vertex is dark where its ray to the light passes below the surface of two triangles a cell, next to it or far off. A
    bound from above and one from below settle most vertices in one sweep over the rows (see `_bounds`); the rays from the
    others walk from row to row, from one crossing with an edge to the next, until a bound settles them too. As between edges
    ray and surface are straight, only crossings have to be looked at. A cell at a hole has no surface, as for the renderer.

    The arguments are those of `hillshade`; `dx` and `dy` are in the unit of the heights.
    """
    azimuth, altitude = math.radians(azimuth), math.radians(altitude)
    x, y = math.sin(azimuth) * math.cos(altitude) / dx, math.cos(azimuth) * math.cos(altitude) / dy
    columns = abs(x) > abs(y)
    along, beside = (x, y) if columns else (y, x)
    if along == 0:
        return np.ones(heights.shape, bool)
    light = _Light(abs(beside / along), math.sin(altitude) / abs(along), along * beside < 0)

    def turned(grid: np.ndarray) -> np.ndarray:  # its own inverse, but for the transposition
        return grid[:: -1 if along < 0 else 1, :: -1 if beside < 0 else 1]

    z = np.ascontiguousarray(turned(heights.T if columns else heights), np.float64)
    found = turned(_lit(z, light))
    return found.T if columns else found


class _Edges(NamedTuple):
    """Which edges have a triangle beside them; each one counts for the vertex with its lowest numbers."""

    along: Bool[np.ndarray, "rows columns"]  # from a vertex along its row
    up: Bool[np.ndarray, "rows columns"]  # to the next row
    diagonal: Bool[np.ndarray, "rows columns"]  # across the cell
    vertex: Bool[np.ndarray, "rows columns"]  # whether a triangle touches it


def _edges(z: Float[np.ndarray, "rows columns"]) -> _Edges:
    there = np.isfinite(z)
    cells = np.pad(there[1:, 1:] & there[1:, :-1] & there[:-1, 1:] & there[:-1, :-1], 1)  # with none round them
    along, up = cells[:-1, 1:] | cells[1:, 1:], cells[1:, :-1] | cells[1:, 1:]
    return _Edges(along, up, cells[1:, 1:], along | cells[:-1, :-1] | cells[1:, :-1])


def _lit(z: Float[np.ndarray, "rows columns"], light: _Light) -> Bool[np.ndarray, "rows columns"]:
    (rows, columns), (across, rise, _) = z.shape, light
    rounding = 8 * np.finfo(float).eps * float(np.nanmax(np.abs(z)))
    starts = np.floor(across * np.arange(rows + 1) - _OFF).astype(np.int64)  # the first column that bin 0 touches
    edges = _edges(z)
    upper, lower = _bounds(z, edges.along, light, starts)
    width = upper.shape[1]
    result = np.ones(z.shape, bool)
    open_rays = []
    for row in range(rows):
        at = np.arange(columns) - math.ceil(across * row - _OFF) + starts[row] + _PAD  # the places of the vertices' bins
        height = z[row] + rounding
        dark = lower[row, at] > height
        result[row] = ~dark
        open_rays.append(row * columns + np.flatnonzero(~dark & (upper[row, at] > height)))
    rays = np.concatenate(open_rays)
    row, column = np.divmod(rays, columns)
    bins = column - np.ceil(across * row - _OFF).astype(np.int64) + _PAD
    padded = np.pad(z, ((0, 1), (0, 3)), constant_values=np.nan).ravel()
    edges = _Edges(*(np.pad(edge, ((0, 1), (0, 3))).ravel() for edge in edges))
    at, height = row * (columns + 3) + column, z.ravel()[rays]
    step = 0
    while rays.size:
        blocked = _crossing(padded, edges, columns + 3, at, height + rounding, step, light)
        step += 1
        row = row + 1
        place = row * width + np.minimum(bins + starts[row], width - 1)
        above = height + step * rise + rounding
        blocked |= lower.ravel()[place] > above
        result.ravel()[rays[blocked]] = False
        on = ~blocked & (upper.ravel()[place] > above)
        rays, row, bins, at, height = (values[on] for values in (rays, row, bins, at, height))
    return result


_PAD = 3  # columns before the first in which bins begin that still touch the grid


def _bounds(
    z: Float[np.ndarray, "rows columns"],
    along: Bool[np.ndarray, "rows columns"],
    light: _Light,
    starts: Int[np.ndarray, " rows+1"],
) -> tuple[Float[np.ndarray, "rows bins"], Float[np.ndarray, "rows bins"]]:
    """How high on a row's line a ray is lit for certain, and below which height it is dark for certain.

    Bins are one column wide and lie along the rays, so that a ray stays in its own; bin b of row j stands at the place
    b + starts[j] + _PAD. Both bounds fall by the light's rise from row to row, away from it (a max-plus sweep: Timonen and
    Westerholm, Scalable height field self-shadowing, Computer Graphics Forum 29(2), 2010). A ray that starts on the surface
    cannot be met by a triangle that faces the light, as it rises faster than that: from above counts the highest vertex of the
    cells with another triangle, from below the lowest of the vertices round the bin. `along` is that of `_Edges`.
    """
    (rows, columns), (across, rise, _) = z.shape, light
    nothing = -np.inf
    upper = np.full((rows, columns + 2 * _PAD), nothing)
    lower = np.full_like(upper, nothing)
    for row in range(rows - 1, -1, -1):
        first, last = int(starts[row]), math.floor(across * row + 1 + _OFF)
        lower_ends = np.where(along[row, :-1], np.minimum(z[row, :-1], z[row, 1:]), np.nan)
        ground = np.pad(lower_ends, (_PAD, 2 * _PAD + 1), constant_values=np.nan)
        lowest = ground[: columns + 2 * _PAD]
        for k in range(1, last - first + 1):
            lowest = np.minimum(lowest, ground[k : k + columns + 2 * _PAD])  # nan where one is
        lowest = np.where(np.isnan(lowest), nothing, lowest)
        if row == rows - 1:
            lower[row] = lowest
            continue
        moved = int(starts[row + 1]) - first
        lower[row, : columns + 2 * _PAD - moved] = lower[row + 1, moved:] - rise
        np.maximum(lower[row], lowest, out=lower[row])
        upper[row, : columns + 2 * _PAD - moved] = upper[row + 1, moved:] - rise
        needed = np.pad(_needed(z[row], z[row + 1], light), (_PAD, 2 * _PAD + 1), constant_values=nothing)
        for k in range(math.floor(across * (row + 1) + 1 + _OFF) - first + 1):
            np.maximum(upper[row], needed[k : k + columns + 2 * _PAD], out=upper[row])
    return upper, lower


def _needed(
    near: Float[np.ndarray, " columns"], far: Float[np.ndarray, " columns"], light: _Light
) -> Float[np.ndarray, " cells"]:
    """How high on the near line a ray clears each cell between two lines; -inf where both triangles face the light."""
    across, rise, falling = light
    along, up = (near[1:] - near[:-1], far[1:] - far[:-1]), (far[:-1] - near[:-1], far[1:] - near[1:])
    first, second = up if falling else up[::-1]
    with np.errstate(invalid="ignore"):
        faces = (rise > along[0] * across + first) & (rise > along[1] * across + second)
    highest = np.fmax(near, far - rise)  # nan only where both are
    highest = np.fmax(highest[:-1], highest[1:])
    return np.where(faces | np.isnan(highest), -np.inf, highest)


def _crossing(
    z: Float[np.ndarray, " padded"],
    there: _Edges,
    width: int,
    at: Int[np.ndarray, " n"],
    height: Float[np.ndarray, " n"],
    step: int,
    light: _Light,
) -> Bool[np.ndarray, " n"]:
    """Whether the surface is above the rays where they meet an edge between two rows' lines, the first one excluded.

    All rays start at vertices, so that they meet edges at the same shares of them. `at` are the places of these vertices in the
    flat `z`, whose rows have this width; `step` rows' lines have been passed.
    """
    across, rise, falling = light
    place = math.floor(step * across)
    share = step * across - place
    near, far = at + (step * width + place), at + ((step + 1) * width + place)
    edges = []  # when the row is crossed by this much: the ends of the edge, how far from the first one, and if it is there
    if falling:
        time = (1 - share) / (1 + across)
        edges.append((time, near + 1, far, time, there.diagonal[near]))
        if share + across > 1:
            time = (2 - share) / (1 + across)
            edges.append((time, near + 2, far + 1, time, there.diagonal[near + 1]))
    elif share + across < 1 and share > 0:
        time = share / (1 - across)
        edges.append((time, near, far + 1, time, there.diagonal[near]))
    if share + across > 1:
        time = (1 - share) / across
        edges.append((time, near + 1, far + 1, time, there.up[near + 1]))
    end = share + across
    first, part = (far + 1, end - 1) if end >= 1 else (far, end)
    edges.append((1.0, first, first + 1, part, there.along[first]))
    blocked = np.zeros(at.shape, bool)
    for time, one, other, part, has_triangle in edges:
        if part < _OFF or part > 1 - _OFF:  # beside which there may be no height, as at the border
            place = one if part < 0.5 else other
            ground, has_triangle = z[place], there.vertex[place]
        else:
            ground = z[one] * (1 - part) + z[other] * part
        blocked |= has_triangle & (ground > height + (step + time) * rise)
    return blocked
