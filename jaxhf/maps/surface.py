"""What the functions of this folder are given: heights as an array or a `Terrain`, with their spacing."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from ..core.errors import ArgumentError
from ..core.precision import numbers
from ..core.rules import positive, require
from ..io.terrain.terrain import Terrain

Heights = ArrayLike | Terrain

_MOST = 1e30  # of a number: beyond, sums of heights overflow in single precision


class Surface(NamedTuple):
    """Heights with their spacing, checked; times `scale` it can be compared with heights."""

    heights: Float[np.ndarray, "ny nx"]  # nan where there is none; row 0 in the south
    dx: float
    dy: float
    scale: float  # vertical units in a horizontal one


def surface(
    owner: str, heights: Heights, dx: float | None = None, dy: float | None = None, scale: float | None = None
) -> Surface:
    """Checks what a function of this folder, the `owner`, got; the other arguments are those of `hillshade`."""
    require_positive(owner, "scale", 1.0 if scale is None else scale)
    heights, dx, dy = with_spacing(owner, heights, dx, dy, in_metres=scale is None)
    values = numbers(heights)
    if values.dtype.kind not in "fiu":
        given = f"of {values.dtype}" if isinstance(heights, np.ndarray) else f"a {type(heights).__name__}"
        raise ArgumentError(owner, "heights", f"must be an array of real numbers or a Terrain, they are {given}")
    if values.ndim != 2 or min(values.shape) < 2:
        raise ArgumentError(owner, "heights", f"must have shape (ny, nx) of at least 2x2, theirs is {values.shape}")
    if values.dtype not in (np.float32, np.float64):
        values = values.astype(np.float32 if values.dtype.itemsize <= 2 else np.float64)
    finite = np.isfinite(values)
    require_heights(owner, finite)
    values = values if finite.all() else np.where(finite, values, np.nan)
    largest = max(-np.fmin.reduce(values, axis=None), np.fmax.reduce(values, axis=None))
    if largest > _MOST:
        raise ArgumentError(owner, "heights", f"must be within -{_MOST:g} and {_MOST:g}, one is {largest:.3g} from 0")
    return Surface(values, dx, dy, 1.0 if scale is None else scale)


def with_spacing(
    owner: str, heights: Any, dx: float | None, dy: float | None, in_metres: bool = True
) -> tuple[Any, float, float]:
    """The heights of an array or a `Terrain` as they are, with dx and dy, see `surface`; `in_metres`: degrees become metres."""
    given = {name: value for name, value in (("dx", dx), ("dy", dy)) if value is not None}
    for name, value in given.items():
        require_positive(owner, name, value)
    if isinstance(heights, Terrain):
        terrain = heights.in_metres(**given) if in_metres else heights
        return terrain.heights, given.get("dx", terrain.dx), given.get("dy", terrain.dy)
    if hasattr(heights, "dims"):
        raise ArgumentError(owner, "heights", "must not be xarray's, whose rows begin anywhere: take Terrain.from_xarray(...)")
    if not given:
        raise ArgumentError(owner, "dx", "must be given for an array: its cell size, in the unit of the heights")
    square = next(iter(given.values()))
    return heights, given.get("dx", square), given.get("dy", square)


def rotation_of(terrain: Any) -> float:
    """What azimuths from the north of a map are turned by to count from the y axis, see `Terrain.rotation`; 0 of an array."""
    return terrain.rotation if isinstance(terrain, Terrain) else 0.0


def require_heights(owner: str, there: Any) -> None:
    """ArgumentError where there are none; `there` says of each whether it is finite."""
    if not np.any(there):
        raise ArgumentError(owner, "heights", "must hold a finite one, all of them are nan or infinite")


def require_positive(owner: str, name: str, value: float) -> None:
    require(owner, name, value, positive)
    if not 1e-30 <= value <= _MOST:
        raise ArgumentError(owner, name, f"must be from 1e-30 to {_MOST:g}, it is {value}")
