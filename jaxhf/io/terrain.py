"""Terrain files to heights with their place in the world.

Whatever the file's order, in memory row 0 is the southernmost: `heights[iy, ix]` has iy growing to the north.
"""

import dataclasses
import math
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from ..core.errors import ArgumentError, UserError
from .files import PathLike, by_ending, read_npy, reading, require_file
from .georeference import WGS84, Place
from .geotiff import Raw, read_tiff
from .png import read_png, samples_16


@dataclasses.dataclass(frozen=True, eq=False)
class Terrain:
    """Heights on a regular grid, in NumPy.

    Attributes:
      heights: shape (ny, nx), float32 or float64, row 0 in the south, column 0 in the west; nan where there is no data.
      dx, dy: cell size, in the unit of x and y.
      x0, y0: where vertex (0, 0), the one in the south-west, stands.
    """

    heights: Float[np.ndarray, "ny nx"]
    dx: float = 1.0
    dy: float = 1.0
    x0: float = 0.0
    y0: float = 0.0

    def __post_init__(self):
        if self.heights.ndim != 2 or min(self.heights.shape) < 2:
            raise ArgumentError("", "heights", f"must have shape (ny, nx) of at least 2x2, theirs is {self.heights.shape}")
        for name in ("dx", "dy", "x0", "y0"):
            value = getattr(self, name)
            if not math.isfinite(value) or (name in ("dx", "dy") and value <= 0):
                rule = "positive and finite" if name in ("dx", "dy") else "finite"
                raise ArgumentError("", name, f"must be {rule}, it is {value}")

    @property
    def nodata(self) -> Bool[np.ndarray, "ny nx"]:
        """Where there is no height: bool, shape (ny, nx)."""
        return np.isnan(self.heights)


def load_heights(
    path: PathLike,
    *,
    dx: float | None = None,
    dy: float | None = None,
    x0: float | None = None,
    y0: float | None = None,
    z_scale: float = 1.0,
    nodata: float | None = None,
) -> Terrain:
    """Reads heights from a file.

    - .npy: shape (ny, nx), in jaxhf's order (row 0 in the south), spacing 1.
    - .npz: the array `heights`, or the only one, in jaxhf's order, with dx, dy, x0, y0 where the file has them. Or an
      array `elevation` as in matplotlib's `jacksboro_fault_dem.npz`: north row first, bounds and spacing in degrees.
    - .png: 16-bit grey, north row first, spacing 1; a height is the stored whole number.
    - .tif, .tiff (needs tifffile): one band of numbers, north row first, placed by its GeoTIFF tags. A height stands at
      its pixel's centre: half a pixel inside the raster's corner where the tags say PixelIsArea. GDAL's scale and
      offset are applied.

    Degrees become metres at the mean latitude, with vertex (0, 0) at the origin: on the ellipsoid whose axes the GeoTIFF
    gives, else on WGS84. nan and inf are holes, as is what the file's GDAL_NODATA tag names.

    Args:
      path: the file.
      dx, dy, x0, y0: overrule what the file says.
      z_scale: heights are multiplied by it.
      nodata: a stored value, before any scale, that means that there is no height; overrules the file's tag.

    Raises:
      FileNotFoundError: no file is there.
      ValueError: the ending is not known, the file is not a whole grid of heights, or its degrees are on a globe of unknown
        size (not the Earth, and without axes) and dx or dy is not given.
    """
    given = {"dx": dx, "dy": dy, "x0": x0, "y0": y0}
    terrain, _ = load_placed(path, {name: value for name, value in given.items() if value is not None}, z_scale, nodata)
    return terrain


def load_placed(
    path: PathLike,
    given: Mapping[str, float],
    z_scale: float = 1.0,
    nodata: float | None = None,
    nodata_overrules: bool = True,
) -> tuple[Terrain, Place]:
    """As `load_heights`, where `given` are those of dx, dy, x0, y0 that overrule the file; with what the file says itself.

    Without `nodata_overrules`, `nodata` counts only where the file names no such value.
    """
    path = require_file(path)
    reader = by_ending(_READERS, path, "read heights from")
    with reading(path):
        if not math.isfinite(z_scale) or z_scale == 0:
            raise ValueError(f"z_scale must be finite and not zero, it is {z_scale}")
        raw = reader(path)
        if nodata is not None and (nodata_overrules or raw.nodata is None):
            raw = raw._replace(nodata=nodata)
        heights = _heights(raw, z_scale)
        place = raw.place.with_metres(len(heights), given)._asdict()
        known = {name: float(place[name]) for name in _GRID if place[name] is not None}
        return Terrain(heights, **known), raw.place


def jacksboro() -> Terrain:
    """The valley of the Jacksboro fault in Tennessee: 344 x 403 heights in metres, about 74 m by 92 m apart.

    Its origin is the south-western vertex. UserError where matplotlib, with which the data come, is not installed.
    """
    return load_heights(jacksboro_file())


def jacksboro_file() -> str:
    """Where matplotlib keeps that terrain."""
    try:
        from matplotlib import cbook
    except ImportError as error:
        raise UserError("the Jacksboro terrain comes with matplotlib: pip install 'jaxhf[plot]'") from error
    return str(cbook.get_sample_data("jacksboro_fault_dem.npz", asfileobj=False))


_GRID = ("dx", "dy", "x0", "y0")


def _heights(raw: Raw, z_scale: float) -> Float[np.ndarray, "ny nx"]:
    values = raw.values
    if values.dtype.kind not in "fiu":
        raise ValueError(f"heights must be numbers, they are {values.dtype}")
    if values.ndim != 2:
        raise ValueError(f"heights must have shape (ny, nx), theirs is {values.shape}")
    exact_in_float32 = values.dtype.itemsize <= (4 if values.dtype.kind == "f" else 2)
    heights = values.astype(np.float32 if exact_in_float32 else np.float64)
    holes = ~np.isfinite(heights)
    if raw.nodata is not None:
        # Compared in the file's own precision: a tag may say -3.4028235e+38 for the lowest float32.
        with np.errstate(over="ignore"):
            holes |= values == (values.dtype.type(raw.nodata) if values.dtype.kind == "f" else raw.nodata)
    heights[holes] = np.nan
    with np.errstate(over="ignore"):
        if (raw.scale, raw.offset) != (1, 0):
            heights = (heights.astype(np.float64) * raw.scale + raw.offset).astype(heights.dtype)
        scaled = heights * heights.dtype.type(z_scale)
    if np.isinf(scaled).any():
        raise ValueError(f"heights times z_scale must fit into {heights.dtype}, z_scale is {z_scale}")
    return scaled


def _read_npy(path: Path) -> Raw:
    with path.open("rb") as file:
        return Raw(read_npy(file, path.stat().st_size))


def _read_npz(path: Path) -> Raw:
    with zipfile.ZipFile(path) as archive:
        members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}

        def array(name: str) -> np.ndarray:
            with archive.open(members[name]) as file:
                return read_npy(file, members[name].file_size)

        def number(name: str) -> float:
            value = array(name)
            if value.size != 1:
                raise ValueError(f"its {name} must be one number, its shape is {value.shape}")
            return float(value.item())

        if "heights" in members or len(members) == 1:
            name = "heights" if "heights" in members else next(iter(members))
            return Raw(array(name), Place()._replace(**{key: number(key) for key in _GRID if key in members}))
        if "elevation" not in members:
            raise ValueError(f"it must hold an array 'heights', or only one, it holds {', '.join(sorted(members))}")
        missing = {"dx", "dy", "xmin", "ymin", "ymax"} - members.keys()
        if missing:
            raise ValueError(f"beside 'elevation' it must hold {', '.join(sorted(missing))}")
        heights = array("elevation")[::-1]
        south = min(number("ymin"), number("ymax"))  # matplotlib's file has them swapped
        dx, dy = number("dx"), number("dy")
        return Raw(heights, Place(dx, dy, number("xmin") + dx / 2, south + dy / 2, degrees=True, globe=WGS84))


def _read_png(path: Path) -> Raw:
    png = read_png(path)
    if png.depth != 16 or png.channels != 1:
        raise ValueError(f"heights in a PNG must be 16-bit grey, it has {png.channels} channels of {png.depth} bits")
    return Raw(samples_16(png)[::-1, :, 0])


_READERS: dict[str, Callable[[Path], Raw]] = {
    ".npy": _read_npy,
    ".npz": _read_npz,
    ".png": _read_png,
    ".tif": read_tiff,
    ".tiff": read_tiff,
}
