"""A formula over the 3 x 3 heights round each vertex, with GDAL's rules for borders and holes."""

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import numpy as np
from jaxtyping import Float, Float32

from ..core.precision import fitted
from ..xla.machine import usable_cores

Job = TypeVar("Job")
# Nine views of the same shape: north-west, north, north-east, west, centre, east, south-west, south, south-east.
Window = tuple[Float32[np.ndarray, "k m"], ...]

_AT_ONCE = 2**15  # heights: what a formula makes of them stays in a core's cache


def over_windows(
    heights: Float[np.ndarray, "ny nx"], formula: Callable[[Window], np.ndarray], compute_edges: bool, nodata: np.generic
) -> np.ndarray:
    """The formula's value at each vertex: shape (ny, nx), of the type of `nodata`.

    Where a neighbour is missing there is no value. With `compute_edges` a missing neighbour inside has the height of the
    centre; beyond the border heights go on in a straight line, and at a corner those of the border's row are repeated. Heights
    count in float32, in which GDAL reads all but short integers. The formula is called from several threads.
    """
    z = fitted(heights, np.float32)[::-1]  # in the order of GDAL's rows
    result = np.full(z.shape, nodata)
    holes = bool(np.isnan(z).any())

    def fill(job: tuple[np.ndarray, np.ndarray]) -> None:
        padded, out = job
        k, m = out.shape
        window = tuple(padded[i : i + k, j : j + m] for i in range(3) for j in range(3))
        if not holes:
            out[...] = formula(window)
            return
        missing = [np.isnan(view) for view in window]
        if compute_edges:
            window = tuple(np.where(gone, window[4], view) for gone, view in zip(missing, window, strict=True))
            missing = missing[4:5]
        with np.errstate(invalid="ignore"):
            values = formula(window)
        np.copyto(out, values, where=~np.logical_or.reduce(missing))

    shared(fill, _with_edges(z, result) if compute_edges else _inside(z, result[1:-1, 1:-1]))
    return np.ascontiguousarray(result[::-1])


def shared(work: Callable[[Job], None], jobs: Iterable[Job]) -> None:
    """Does the jobs, a thread a core: NumPy lets others work meanwhile."""
    with ThreadPoolExecutor(usable_cores()) as threads:
        list(threads.map(work, jobs))


def _inside(z: np.ndarray, result: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Blocks of rows, each with a row more on either side, and where what is made of them goes."""
    rows = max(_AT_ONCE // z.shape[1], 1)
    for first in range(0, len(result), rows):
        yield z[first : first + rows + 2], result[first : first + rows]


def _with_edges(z: np.ndarray, result: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    along = np.pad(np.stack([2 * z[0] - z[1], z[0], z[1], z[-2], z[-1], 2 * z[-1] - z[-2]]), ((0, 0), (1, 1)), mode="edge")
    yield along[:3], result[:1]
    yield along[3:], result[-1:]
    across = np.concatenate([2 * z[:, :1] - z[:, 1:2], z, 2 * z[:, -1:] - z[:, -2:-1]], axis=1)
    yield from _inside(across, result[1:-1])


def differences(window: Window, algorithm: str) -> tuple[Float32[np.ndarray, "k m"], Float32[np.ndarray, "k m"]]:
    """By how much the west is higher than the east, and the south higher than the north; in float32, in GDAL's order.

    Over `spans(algorithm)` cells: eight by Horn (Hill shading and the reflectance map, Proceedings of the IEEE 69(1), 1981),
    two by Zevenbergen and Thorne (Quantitative analysis of land surface topography, Earth Surface Processes and Landforms
    12(1), 1987).
    """
    nw, n, ne, w, _, e, sw, s, se = window
    if algorithm == "zevenbergen-thorne":
        return w - e, s - n
    return (nw + w + w + sw) - (ne + e + e + se), (sw + s + s + se) - (nw + n + n + ne)


def spans(algorithm: str) -> int:
    return 2 if algorithm == "zevenbergen-thorne" else 8
