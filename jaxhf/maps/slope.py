"""Slope and aspect, as `gdaldem slope` and `gdaldem aspect` give them."""

import numpy as np
from jaxtyping import Float32

from ..core.rules import OneOf, require
from .choices import ALGORITHMS
from .surface import Heights, rotation_of, surface
from .windows import Window, differences, over_windows, spans

NODATA = -9999.0


def slope(
    heights: Heights,
    dx: float | None = None,
    dy: float | None = None,
    *,
    percent: bool = False,
    scale: float | None = None,
    algorithm: str = "horn",
    compute_edges: bool = False,
) -> Float32[np.ndarray, "ny nx"]:
    """The steepest slope at each vertex, in degrees (or percent): shape (ny, nx), float32, -9999 where there is no value.

    Args:
      heights, dx, dy, scale, algorithm, compute_edges: see `hillshade`, whose errors it has, too.
      percent: rise over run, times 100.
    """
    require("slope", "algorithm", algorithm, OneOf(ALGORITHMS))
    ground = surface("slope", heights, dx, dy, scale)
    run = spans(algorithm) * ground.scale

    def formula(window: Window) -> np.ndarray:
        west, south = differences(window, algorithm)
        x, y = west / np.float64(ground.dx), south / np.float64(ground.dy)
        rise = np.sqrt(x * x + y * y) / run
        return np.minimum(100 * rise, np.finfo(np.float32).max) if percent else np.arctan(rise) * (180 / np.pi)

    return over_windows(ground.heights, formula, compute_edges, np.float32(NODATA))


def aspect(
    heights: Heights,
    *,
    trigonometric: bool = False,
    zero_for_flat: bool = False,
    algorithm: str = "horn",
    compute_edges: bool = False,
) -> Float32[np.ndarray, "ny nx"]:
    """Where each slope faces, in degrees clockwise from north: shape (ny, nx), float32, -9999 where flat or without a value.

    As in GDAL cells count as square: where they are not, a diagonal slope's aspect is that of the grid, not of the ground. A
    rotated `Terrain` has the aspects of the ground, from the north of its map.

    Args:
      heights, algorithm, compute_edges: see `hillshade`, whose errors it has, too.
      trigonometric: counterclockwise from east.
      zero_for_flat: 0 in place of -9999.
    """
    require("aspect", "algorithm", algorithm, OneOf(ALGORITHMS))
    rotation = rotation_of(heights)
    ground = surface("aspect", heights, None if rotation else 1.0, scale=1.0)
    nothing = np.float32(0.0 if zero_for_flat else NODATA)

    def formula(window: Window) -> Float32[np.ndarray, "k m"]:
        west, south = (values.astype(np.float64) for values in differences(window, algorithm))
        if rotation:
            west, south = west / ground.dx, south / ground.dy
        angle = (np.arctan2(south, west) / (np.pi / 180)).astype(np.float32)
        turn, quarter = np.float32(360), np.float32(90)
        if trigonometric:
            angle = np.where(angle < 0, angle + turn, angle)
        else:
            angle = np.where(angle > quarter, turn + quarter - angle, quarter - angle)
        if rotation:
            angle = np.mod(angle + np.float32(-rotation if trigonometric else rotation), turn)
        angle = np.where(angle == turn, np.float32(0), angle)
        return np.where((west == 0) & (south == 0), nothing, angle)

    return over_windows(ground.heights, formula, compute_edges, nothing)
