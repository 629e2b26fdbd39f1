"""Numbers of a caller's or of a file in NumPy's own kinds, and heights in the precision of what is made of them."""

import math
import warnings
from typing import Any

import numpy as np
from numpy.typing import DTypeLike

from .errors import ArgumentError

WORTH_A_WARNING = 1e-3  # of the relief


def numbers(value: Any) -> np.ndarray:
    """An array of a caller's with nan where it is masked, in this machine's byte order; it may share the caller's memory.

    float16 and bfloat16 become float32, longdouble becomes float64. Whole numbers stay, but where some are masked; so does what
    is no number, for the caller to refuse.
    """
    masked = isinstance(value, np.ma.MaskedArray)
    given = np.ma.getdata(value) if masked else np.asarray(value)
    kind = given.dtype.kind
    if given.dtype.name not in ("float32", "float64") or not given.dtype.isnative:
        if kind in "fV" and np.can_cast(given.dtype, np.float32):  # V: bfloat16 and its like
            given = given.astype(np.float32)
        elif kind == "f":
            given = given.astype(np.float64)
    if masked and np.ma.is_masked(value) and given.dtype.kind in "fiu":
        return np.where(np.ma.getmaskarray(value), np.float32(np.nan), given)
    return given


def fitted(heights: np.ndarray, dtype: DTypeLike, owner: str = "") -> np.ndarray:
    """A copy of the heights in another precision, see `require_fit`."""
    require_fit(heights, dtype, owner)
    return heights.astype(dtype)


def require_fit(heights: np.ndarray, dtype: DTypeLike, owner: str = "", name: str = "heights") -> None:
    """Warns where a height moves by more than a thousandth of their relief in another precision.

    Args:
      heights: of any shape; what is not finite is a hole.
      dtype: float32 or float64.
      owner, name: see `ArgumentError`, which is raised where a height does not fit, as an infinite one would count as a hole.
    """
    moved = rounding(heights, dtype)
    if moved == math.inf:
        largest = np.abs(heights[np.isfinite(heights)]).max()
        raise ArgumentError(owner, name, f"must fit into {np.dtype(dtype)}, the largest is {largest:.3g}")
    if moved > WORTH_A_WARNING:
        place = f"{owner}: {name}" if owner else name
        warnings.warn(
            f"{place} are rounded to {np.dtype(dtype)}, which moves one by {100 * moved:.3g} % of the relief: subtract a "
            "constant from them, such as the lowest",
            stacklevel=3,
        )


def rounding(heights: np.ndarray, dtype: DTypeLike) -> float:
    """By how much of their relief heights move at most in another precision.

    0 where that is certainly not `WORTH_A_WARNING`, which takes no more than their range; inf where one does not fit.
    """
    kind = np.finfo(dtype)
    if not heights.size or np.can_cast(heights.dtype, kind.dtype):
        return 0.0
    low, high = (float(of.reduce(heights, axis=None)) for of in (np.fmin, np.fmax))
    if not math.isfinite(high - low):
        heights = heights[np.isfinite(heights)]
        if not heights.size:
            return 0.0
        low, high = float(heights.min()), float(heights.max())
    largest, relief = max(abs(low), abs(high)), high - low
    with np.errstate(over="ignore", under="ignore"):
        if np.isinf(kind.dtype.type(largest)):
            return math.inf
        if max(largest * kind.eps, kind.tiny) <= WORTH_A_WARNING * relief or relief == 0:
            return 0.0
        moved = heights.astype(dtype).astype(np.float64) - heights
    return float(np.fmax.reduce(np.abs(moved[np.isfinite(moved)]), axis=None)) / relief
