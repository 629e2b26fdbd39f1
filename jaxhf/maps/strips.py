"""Maps of terrain that memory may not hold, strip after strip, with the bytes of the whole."""

import dataclasses
import inspect
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from ..io.terrain.rasters import Rows
from ..io.terrain.terrain import Terrain
from .ramp import as_ramp
from .surface import require_heights


def by_strips(
    function: Callable[..., np.ndarray], rows: Rows, strip: int, from_north: bool, options: dict[str, Any]
) -> Iterator[tuple[slice, np.ndarray]]:
    """A map of a terrain in strips of so many rows: rows, counted from the south, and the values there.

    The function makes it of a `Terrain`, from the eight neighbours of each vertex at most. Of its options cell sizes and a ramp
    of colours are those of the whole terrain.
    """
    place = rows.place
    ny = len(place.heights)
    if ny <= strip:
        yield slice(0, ny), function(rows.read(slice(0, ny), 1), **options)
        return
    parts = [slice(first, min(first + strip, ny)) for first in range(0, ny, strip)]
    parts = parts[::-1] if from_north else parts
    takes = inspect.signature(function).parameters
    if "dx" in takes and options.get("scale") is None:
        metres = place.in_metres(**{name: options[name] for name in ("dx", "dy") if name in options})
        options = options | {"dx": metres.dx, "dy": metres.dy}
    if "ramp" in takes:
        ends = [_ends(rows.read(_with_neighbours(part, ny), 1).heights) for part in parts]
        low, high = min(low for low, _ in ends), max(high for _, high in ends)
        require_heights(function.__name__, low <= high)
        options = options | {"ramp": as_ramp(options.get("ramp"), low, high)}
    found = False
    for part in parts:
        around = _with_neighbours(part, ny)
        terrain = rows.read(around, 1)
        inside = slice(part.start - around.start, part.stop - around.start)
        found |= bool(np.isfinite(terrain.heights[inside]).any())
        make = function if np.isfinite(terrain.heights).any() else _without_heights(function)
        yield part, make(terrain, **options)[inside]
    require_heights(function.__name__, found)


def _with_neighbours(part: slice, ny: int) -> slice:
    """The rows with one more on either side, where there is one."""
    return slice(max(part.start - 1, 0), min(part.stop + 1, ny))


def _ends(heights: np.ndarray) -> tuple[float, float]:
    there = heights[np.isfinite(heights)]
    return float(there.min(initial=np.inf)), float(there.max(initial=-np.inf))


def _without_heights(function: Callable[..., np.ndarray]) -> Callable[..., np.ndarray]:
    """The function for a strip of holes alone, which it refuses: beside a row of heights, whose values are left out."""

    def make(terrain: Terrain, **options: Any) -> np.ndarray:
        heights = np.concatenate([np.zeros_like(terrain.heights[:1]), terrain.heights])
        return function(dataclasses.replace(terrain, heights=heights), **options)[1:]

    return make
