"""How uneven a terrain is round each vertex, as `gdaldem roughness`, `TRI` and `TPI` give it."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float32

from ..core.rules import OneOf, require
from .choices import RUGGEDNESS
from .slope import NODATA
from .surface import Heights, surface
from .windows import Window, over_windows


def ruggedness(heights: Heights, measure: str = "roughness", *, compute_edges: bool = False) -> Float32[np.ndarray, "ny nx"]:
    """How the eight neighbours differ from each vertex: shape (ny, nx), float32, -9999 where there is no value.

    In the unit of the heights, by `measure`, as collected by Wilson, O'Connell, Brown, Guinan and Grehan (Multiscale terrain
    analysis of multibeam bathymetry data for habitat mapping on the continental slope, Marine Geodesy 30, 2007):

    - "roughness": the highest of the nine minus the lowest.
    - "tri": the terrain ruggedness index, the root of the sum of the squares of the neighbours' differences (Riley, DeGloria
      and Elliot, Intermountain Journal of Sciences 5, 1999).
    - "tri-wilson": the mean of their absolute differences, for bathymetry.
    - "tpi": the topographic position index, the vertex minus the mean of its neighbours: above 0 on ridges, below in valleys.

    Args:
      heights, compute_edges: see `hillshade`, whose errors it has, too. No cell size is needed.
    """
    require("ruggedness", "measure", measure, OneOf(RUGGEDNESS))
    ground = surface("ruggedness", heights, 1.0, scale=1.0)
    return over_windows(ground.heights, _FORMULAS[measure], compute_edges, np.float32(NODATA))


def _apart(window: Window) -> list[Float32[np.ndarray, "k m"]]:
    return [neighbour - window[4] for k, neighbour in enumerate(window) if k != 4]


def _roughness(window: Window) -> np.ndarray:
    return np.maximum.reduce(window) - np.minimum.reduce(window)


def _riley(window: Window) -> np.ndarray:
    return np.sqrt(sum(np.square(apart, dtype=np.float64) for apart in _apart(window)))


def _wilson(window: Window) -> np.ndarray:
    first, *others = map(np.abs, _apart(window))
    return sum(others, first) / np.float32(8)


def _position(window: Window) -> np.ndarray:
    total: np.ndarray = sum((*window[1:4], *window[5:]), window[0])
    return window[4] - total / np.float32(8)


_FORMULAS: dict[str, Callable[[Window], np.ndarray]] = {
    "roughness": _roughness, "tri": _riley, "tri-wilson": _wilson, "tpi": _position
}  # fmt: skip
