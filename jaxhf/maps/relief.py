"""Relief in colours: tints by height, as `gdaldem color-relief` gives them, and tints shaded."""

import warnings

import numpy as np
from jaxtyping import UInt8

from ..core.precision import fitted
from ..core.rules import OneOf, require
from ..io.files import PathLike
from .choices import ENTRIES
from .hillshade import hillshade
from .ramp import Ramp, as_ramp, coloured
from .surface import Heights, surface
from .windows import shared


def color_relief(
    heights: Heights, ramp: Ramp | str | PathLike | None = None, *, entries: str = "interpolate", alpha: bool = False
) -> UInt8[np.ndarray, "ny nx bands"]:
    """Tints by height: shape (ny, nx, 3), red, green and blue, or 4 with opacity; uint8, as `gdaldem color-relief`'s.

    Args:
      heights: shape (ny, nx), row 0 in the south, nan where there is none; or a `Terrain`.
      ramp: a colour file as gdaldem reads it (a height, red, green and blue a line), the name of a colour map of
        matplotlib's, or None: green lowlands to pale heights, and blue below 0.
      entries: "interpolate" between the ramp's heights, the "nearest", or the "exact" one only.
      alpha: adds opacity.

    Raises:
      ArgumentError: there is no height, or `entries` is another.
      ValueError, FileNotFoundError: there is no such file or name, or a line of the file is wrong.
    """
    require("color_relief", "entries", entries, OneOf(ENTRIES))
    ground = surface("color_relief", heights, 1.0, scale=1.0)
    z = fitted(ground.heights, np.float32)
    table = as_ramp(ramp, float(np.nanmin(ground.heights)), float(np.nanmax(ground.heights)))
    bands = 4 if alpha else 3
    result = np.empty((*z.shape, bands), np.uint8)

    def fill(rows: slice) -> None:
        result[rows] = coloured(table, z[rows].astype(np.float64), entries)[..., :bands]

    shared(fill, _blocks(z.shape))
    return result


def _blocks(shape: tuple[int, ...]) -> list[slice]:
    """Rows of some 16,000 heights, whose colours stay in a core's cache."""
    rows = max(2**14 // shape[1], 1)
    return [slice(row, row + rows) for row in range(0, shape[0], rows)]


def relief(
    heights: Heights,
    dx: float | None = None,
    dy: float | None = None,
    *,
    ramp: Ramp | str | PathLike | None = None,
    entries: str = "interpolate",
    azimuth: float = 315.0,
    altitude: float = 45.0,
    z_factor: float = 1.0,
    scale: float | None = None,
    algorithm: str = "horn",
    variant: str = "regular",
    shadows: bool = False,
    alpha: bool = False,
) -> UInt8[np.ndarray, "ny nx bands"]:
    """A tinted map, shaded: `color_relief` made darker or lighter by `hillshade`; shape (ny, nx, 3), or 4 with opacity.

    Level ground keeps its tint. Darker shades darken it in proportion, down to a third; lighter ones mix it with up to a
    quarter of white.

    Args, Raises: see `color_relief` and `hillshade`, of which all of the map, also its border, has a value.
    """
    tint = color_relief(heights, ramp, entries=entries, alpha=alpha)
    light = {"azimuth": azimuth, "altitude": altitude, "algorithm": algorithm, "variant": variant}
    shade = hillshade(heights, dx, dy, **light, z_factor=z_factor, scale=scale, compute_edges=True, shadows=shadows)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the light, which has been said
        level = float(hillshade(np.zeros((3, 3)), 1.0, **light)[1, 1])
    there = shade > 0  # what has no height keeps its colour

    def blend(rows: slice) -> None:
        bright, colours = shade[rows, :, None].astype(np.float32), tint[rows, :, :3].astype(np.float32)
        dark = colours * (1 / 3 + 2 / 3 * np.minimum(bright / level, 1))
        mixed = dark + (255 - dark) * np.maximum((bright - level) / (4 * max(255 - level, 1)), 0)
        np.copyto(tint[rows, :, :3], (mixed + 0.5).astype(np.uint8), where=there[rows, :, None])

    shared(blend, _blocks(tint.shape))
    return tint
