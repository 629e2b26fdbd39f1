"""A shaded map in NumPy: for small ones this ends long before the compiler of the renderer would."""

import math

import numpy as np
from jaxtyping import Bool, Float

from ..io.terrain import Terrain

_MOST = 2e7  # crossings, which take two seconds; the renderer's program compiles for four
_GRAZING = 0.01  # that of shade/lighting.py, which imports JAX

_Points = tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]


def small(terrain: Terrain, rays: int, altitude: float) -> bool:
    """Whether NumPy is the faster way to a map of so many camera rays; False where the terrain has holes.

    Args:
      altitude: of the light, whose rays end where they are above all of the terrain.
    """
    heights = terrain.heights
    if terrain.nodata.any():
        return False
    reach = float(np.ptp(heights)) / math.tan(math.radians(altitude)) / min(terrain.dx, terrain.dy)
    return rays * (1 + min(2 * reach, sum(heights.shape))) < _MOST


def relief(
    terrain: Terrain,
    azimuth: float,
    altitude: float,
    sky: float,
    width: int,
    height: int,
    extent: float,
    side: int,
    shadows: bool,
) -> Float[np.ndarray, "h w 3"]:
    """What `render` makes of `hillshade_scene`, but for rounding; computed in double precision.

    Args:
      terrain: one without holes.
      azimuth, altitude, sky: those of `hillshade_scene`.
      width, height, extent: see `picture_above`.
      side: samples a pixel, each way.
      shadows: whether terrain casts any.
    """
    z = np.asarray(terrain.heights, np.float64)
    dx, dy, (ny, nx) = terrain.dx, terrain.dy, z.shape
    pixel = extent / min(width, height)
    x = (nx - 1) / 2 + ((np.arange(width * side) + 0.5) / side - width / 2) * pixel / dx
    y = (ny - 1) / 2 - ((np.arange(height * side) + 0.5) / side - height / 2) * pixel / dy
    x, y = (values.ravel() for values in np.meshgrid(x, y))
    met = (x >= 0) & (x <= nx - 1) & (y >= 0) & (y <= ny - 1)
    azimuth, altitude = np.deg2rad(azimuth), np.deg2rad(altitude)
    light = np.array([np.sin(azimuth) * np.cos(altitude), np.cos(azimuth) * np.cos(altitude), np.sin(altitude)])
    radiance = np.full(x.size, sky)
    radiance[met] = _radiance(z, dx, dy, (x[met], y[met]), light, sky, shadows)
    pixels = radiance.reshape(height, side, width, side).mean((1, 3))
    return np.repeat(pixels[..., None], 3, axis=-1).astype(terrain.heights.dtype)


def _radiance(
    z: Float[np.ndarray, "ny nx"], dx: float, dy: float, at: _Points, light: Float[np.ndarray, "3"], sky: float, shadows: bool
) -> Float[np.ndarray, " n"]:
    """Of white ground at points of the grid, in cells, seen from above."""
    (x, y), (ny, nx) = at, z.shape
    ix, iy = np.minimum(x.astype(int), nx - 2), np.minimum(y.astype(int), ny - 2)
    u, v = x - ix, y - iy
    upper = v > u
    corners = (iy, ix), (iy + upper, ix + ~upper), (iy + 1, ix + 1)
    first, second = np.where(upper, v, u), np.where(upper, u, v)
    weights = np.stack([1 - first, first - second, second])
    z00, between, z11 = (z[corner] for corner in corners)
    rise_x, rise_y = np.where(upper, z11 - between, between - z00) / dx, np.where(upper, between - z00, z11 - between) / dy
    lit = light[2] - rise_x * light[0] - rise_y * light[1] > 0
    if shadows:
        there = np.flatnonzero(lit)
        start = np.sum(weights * np.stack([z00, between, z11]), axis=0)
        lit[there] = ~_blocked(z, (x[there], y[there]), start[there], (light[0] / dx, light[1] / dy, light[2]))
    normals = _vertex_normals(z, dx, dy)
    normal = sum(weight[:, None] * normals[corner] for weight, corner in zip(weights, corners, strict=True))
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    cosine = np.abs(normal @ light)
    cosine = np.where(cosine < _GRAZING, (cosine**2 + _GRAZING**2) / (2 * _GRAZING), cosine)  # see `rounded_abs`
    return np.where(lit, cosine, 0) + sky * (1 + normal[:, 2]) / 2


def _vertex_normals(z: Float[np.ndarray, "ny nx"], dx: float, dy: float) -> Float[np.ndarray, "ny nx 3"]:
    """The sums of the cross products of the six triangles round each vertex, as `vertex_normals` has them for "six"."""
    ny, nx = z.shape
    padded = np.pad(z, 1, constant_values=np.nan)
    total = np.zeros((ny, nx, 3))
    fan = ((1, 0), (1, 1), (0, 1), (-1, 0), (-1, -1), (0, -1))
    for (ax, ay), (bx, by) in zip(fan, fan[1:] + fan[:1], strict=True):
        a, b = (padded[1 + iy : 1 + iy + ny, 1 + ix : 1 + ix + nx] - z for ix, iy in ((ax, ay), (bx, by)))
        area = np.full_like(z, (ax * by - ay * bx) * dx * dy)
        normal = np.stack([(ay * b - by * a) * dy, (bx * a - ax * b) * dx, area], axis=-1)
        total += np.where(np.isfinite(a + b)[..., None], normal, 0)
    return total


def _blocked(
    z: Float[np.ndarray, "ny nx"], at: _Points, start: Float[np.ndarray, " n"], light: tuple[float, float, float]
) -> Bool[np.ndarray, " n"]:
    """Whether the surface rises above rays from points on it towards a light above the horizon, all in cells.

    Between the lines x = i, y = j and the diagonals x - y = k both are linear, so that only the crossings have to be looked at.
    """
    (ny, nx), top, rounding = z.shape, z.max(), 8 * np.finfo(float).eps * np.abs(z).max()
    found = np.zeros(start.size, bool)
    for along_x, along_y in ((1, 0), (0, 1), (1, -1)):
        rate = along_x * light[0] + along_y * light[1]
        if rate == 0:
            continue
        step = np.sign(rate)
        rays = np.flatnonzero(~found)
        x, y, height = at[0][rays], at[1][rays], start[rays]
        line = along_x * x + along_y * y
        ahead = np.floor(line) + 1 if step > 0 else np.ceil(line) - 1
        while rays.size:
            t = (ahead - line) / rate
            px, py, above = x + t * light[0], y + t * light[1], height + t * light[2]
            # What is whole along a line stays so: rounding must not move it into the next cell.
            px, py = (ahead, py) if not along_y else (px, ahead) if not along_x else (px, px - ahead)
            inside = (px >= 0) & (px <= nx - 1) & (py >= 0) & (py <= ny - 1) & (above < top)
            ix, iy = (np.clip(p.astype(int), 0, n - 2) for p, n in ((px, nx), (py, ny)))
            if along_x and along_y:
                iy = np.clip(ix - ahead.astype(int), 0, ny - 2)
                share = px - ix
                surface = z[iy, ix] + share * (z[iy + 1, ix + 1] - z[iy, ix])
            elif along_x:
                column = np.clip(ahead.astype(int), 0, nx - 1)
                surface = z[iy, column] + (py - iy) * (z[iy + 1, column] - z[iy, column])
            else:
                row = np.clip(ahead.astype(int), 0, ny - 1)
                surface = z[row, ix] + (px - ix) * (z[row, ix + 1] - z[row, ix])
            met = inside & (surface > above + rounding)
            found[rays[met]] = True
            on = inside & ~met
            rays, x, y, height, line, ahead = (values[on] for values in (rays, x, y, height, line, ahead + step))
    return found
