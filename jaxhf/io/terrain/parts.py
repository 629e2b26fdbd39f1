"""Which rows and columns of a grid a box or a window takes."""

import math
import numbers
from collections.abc import Sequence

import numpy as np

from ..errors import FileError

Box = Sequence[float]  # west, south, east, north
Window = Sequence[int]  # the first column and row, and how many of each, as GDAL's -srcwin


def places_within(
    box: Box | None, shape: tuple[int, ...], corner: tuple[float, float], steps: tuple[float, float]
) -> tuple[slice, slice]:
    """Rows and columns of the heights within west, south, east and north, None: all; corner and steps are those of x and y."""
    if box is None:
        return slice(0, shape[0]), slice(0, shape[1])
    if np.shape(box) != (4,) or not np.isfinite(box).all() or not (box[0] < box[2] and box[1] < box[3]):
        raise FileError(f"bbox must be west, south, east and north, finite and in this order, it is {box}")
    found = []
    for low, high, first, step, count in zip(box[1::-1], box[:1:-1], corner[::-1], steps[::-1], shape, strict=True):
        begin, end = ((at - first) / step for at in (low, high))
        # What stands on the side is within, however the division rounds.
        found.append(slice(max(0, math.ceil(begin - 1e-6)), max(0, min(count, math.floor(end + 1e-6) + 1))))
    if min(part.stop - part.start for part in found) < 2:
        ends = [(first, first + step * (count - 1)) for first, step, count in zip(corner, steps, shape[::-1], strict=True)]
        span = " and ".join(f"{name} from {low:.10g} to {high:.10g}" for name, (low, high) in zip("xy", ends, strict=True))
        raise FileError(f"within bbox, {tuple(box)}, there must be heights, 2 x 2 at least; they stand at {span}")
    return found[0], found[1]


def places_in_window(window: Window, shape: tuple[int, ...], north_first: bool, east_first: bool) -> tuple[slice, slice]:
    """The same of a window, which counts from where the file begins, as the last two say."""
    if np.shape(window) != (4,) or not all(isinstance(value, numbers.Real) and value % 1 == 0 for value in window):
        raise FileError(f"window must be a column, a row, and how many columns and rows, whole numbers; it is {window}")
    left, top, width, height = map(int, window)
    (ny, nx), right, bottom = shape, left + width, top + height
    if min(left, top) < 0 or min(width, height) < 2 or right > nx or bottom > ny:
        raise FileError(
            f"window must lie within the file's {nx} columns and {ny} rows, and be 2 x 2 or larger; it is {tuple(window)}"
        )
    rows, columns = slice(top, bottom), slice(left, right)
    return slice(ny - bottom, ny - top) if north_first else rows, slice(nx - right, nx - left) if east_first else columns
