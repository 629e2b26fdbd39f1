"""Terrain files to heights with their place in the world.

Whatever the file's order, in memory row 0 is the southernmost: `heights[iy, ix]` has iy growing to the north.
"""

import dataclasses
import math
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from ._files import PathLike, by_ending, read_npy, reading, require_file, require_pixels
from ._png import read_png, samples_16


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
            raise ValueError(f"heights must have shape (ny, nx) of at least 2x2, theirs is {self.heights.shape}")
        for name in ("dx", "dy", "x0", "y0"):
            value = getattr(self, name)
            if not math.isfinite(value) or (name in ("dx", "dy") and value <= 0):
                rule = "positive and finite" if name in ("dx", "dy") else "finite"
                raise ValueError(f"{name} must be {rule}, it is {value}")

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
      its pixel's centre: half a pixel inside the raster's corner where the tags say PixelIsArea.

    Degrees become metres on the WGS84 ellipsoid at the mean latitude, with vertex (0, 0) at the origin. nan and inf
    are holes, as is what the file's GDAL_NODATA tag names.

    Args:
      path: the file.
      dx, dy, x0, y0: overrule what the file says.
      z_scale: heights are multiplied by it.
      nodata: a stored value, before `z_scale`, that means that there is no height; overrules the file's tag.

    Raises:
      FileNotFoundError: no file is there.
      ValueError: the ending is not known, or the file is not a whole grid of heights.
    """
    path = require_file(path)
    reader = by_ending(_READERS, path, "read heights from")
    with reading(path):
        if not math.isfinite(z_scale) or z_scale == 0:
            raise ValueError(f"z_scale must be finite and not zero, it is {z_scale}")
        raw, place, tagged = reader(path)
        heights = _heights(raw, z_scale, tagged if nodata is None else nodata)
        given = {"dx": dx, "dy": dy, "x0": x0, "y0": y0}
        return Terrain(heights, **{**place, **{name: float(value) for name, value in given.items() if value is not None}})


def jacksboro() -> Terrain:
    """The valley of the Jacksboro fault in Tennessee: 344 x 403 heights in metres, about 74 m by 92 m apart.

    Its origin is the south-western vertex. ValueError where matplotlib, with which the data come, is not installed.
    """
    return load_heights(jacksboro_file())


def jacksboro_file() -> str:
    """Where matplotlib keeps that terrain."""
    try:
        from matplotlib import cbook
    except ImportError as error:
        raise ValueError("the Jacksboro terrain comes with matplotlib: pip install 'jaxhf[plot]'") from error
    return str(cbook.get_sample_data("jacksboro_fault_dem.npz", asfileobj=False))


def metres_per_degree(latitude: float) -> tuple[float, float]:
    """The lengths of a degree of longitude and of latitude, on the WGS84 ellipsoid.

    Snyder, Map Projections: A Working Manual (USGS Professional Paper 1395, 1987), equations 4-21 and 4-19.
    """
    axis, flattening = 6378137.0, 1 / 298.257223563
    squared = flattening * (2 - flattening)  # the eccentricity's square
    phi = math.radians(latitude)
    w = 1 - squared * math.sin(phi) ** 2
    return math.radians(axis * math.cos(phi) / math.sqrt(w)), math.radians(axis * (1 - squared) / w**1.5)


Place = dict[str, float]  # those of dx, dy, x0, y0 that the file gives
Raw = tuple[np.ndarray, Place, float | None]  # stored values with the south first, where they stand, nodata


def _heights(raw: np.ndarray, z_scale: float, nodata: float | None) -> Float[np.ndarray, "ny nx"]:
    if raw.dtype.kind not in "fiu":
        raise ValueError(f"heights must be numbers, they are {raw.dtype}")
    if raw.ndim != 2:
        raise ValueError(f"heights must have shape (ny, nx), theirs is {raw.shape}")
    exact_in_float32 = raw.dtype.itemsize <= (4 if raw.dtype.kind == "f" else 2)
    heights = raw.astype(np.float32 if exact_in_float32 else np.float64)
    holes = ~np.isfinite(heights)
    if nodata is not None:
        # Compared in the file's own precision: a tag may say -3.4028235e+38 for the lowest float32.
        with np.errstate(over="ignore"):
            holes |= raw == (raw.dtype.type(nodata) if raw.dtype.kind == "f" else nodata)
    heights[holes] = np.nan
    with np.errstate(over="ignore"):
        scaled = heights * heights.dtype.type(z_scale)
    if np.isinf(scaled).any():
        raise ValueError(f"heights times z_scale must fit into {heights.dtype}, z_scale is {z_scale}")
    return scaled


def _in_metres(west: float, south: float, dx: float, dy: float, ny: int) -> Place:
    """The place of a grid in degrees, whose vertex (0, 0) becomes the origin."""
    if not (-360 <= west <= 360 and -90 <= south <= 90):
        raise ValueError(f"degrees must lie on the Earth, the south-western corner is at longitude {west}, latitude {south}")
    along_x, along_y = metres_per_degree(south + (ny - 1) / 2 * dy)
    return {"dx": dx * along_x, "dy": dy * along_y}


def _read_npy(path: Path) -> Raw:
    with path.open("rb") as file:
        return read_npy(file, path.stat().st_size), {}, None


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
            return array(name), {key: number(key) for key in ("dx", "dy", "x0", "y0") if key in members}, None
        if "elevation" not in members:
            raise ValueError(f"it must hold an array 'heights', or only one, it holds {', '.join(sorted(members))}")
        missing = {"dx", "dy", "xmin", "ymin", "ymax"} - members.keys()
        if missing:
            raise ValueError(f"beside 'elevation' it must hold {', '.join(sorted(missing))}")
        heights = array("elevation")[::-1]
        south = min(number("ymin"), number("ymax"))  # matplotlib's file has them swapped
        dx, dy = number("dx"), number("dy")
        return heights, _in_metres(number("xmin") + dx / 2, south + dy / 2, dx, dy, len(heights)), None


def _read_png(path: Path) -> Raw:
    png = read_png(path)
    if png.depth != 16 or png.channels != 1:
        raise ValueError(f"heights in a PNG must be 16-bit grey, it has {png.channels} channels of {png.depth} bits")
    return samples_16(png)[::-1, :, 0], {}, None


def _read_tiff(path: Path) -> Raw:
    tifffile = require_tifffile("reading")
    with tifffile.TiffFile(path) as file:
        page: Any = file.pages[0]
        require_pixels(page.imagelength, page.imagewidth)
        if page.samplesperpixel != 1 or page.imagedepth != 1:
            raise ValueError(f"heights in a TIFF must be one band, it has {page.samplesperpixel}")
        end = max((at + count for at, count in zip(page.dataoffsets, page.databytecounts, strict=True)), default=0)
        if end > path.stat().st_size:
            raise ValueError(f"it is cut off: its pixels end at byte {end}, the file at {path.stat().st_size}")
        nodata = _gdal_nodata(page.tags[42113].value) if 42113 in page.tags else None
        if nodata is not None and page.dtype.kind == "f":
            # tifffile fills absent tiles with it, but refuses the usual -3.4028235e+38, which rounds to below float32.
            with np.errstate(over="ignore"):
                page.nodata = page.dtype.type(nodata)
        raw, keys = page.asarray(), page.geotiff_tags or {}
        scale, tie, matrix = (page.tags[code].value if code in page.tags else None for code in (33550, 33922, 34264))
        if scale is not None and tie is not None:
            return raw[::-1], _geo_place(scale, tie, keys, len(raw)), nodata
        if scale is not None or tie is not None or matrix is not None:
            raise ValueError("its GeoTIFF tags must be ModelPixelScale with ModelTiepoint: rotated rasters are not read")
        return raw[::-1], {}, nodata


def require_tifffile(doing: str) -> Any:
    """The package; ValueError where it is not installed."""
    try:
        import tifffile
    except ImportError as error:
        raise ValueError(f"{doing} .tif needs tifffile: pip install 'jaxhf[geo]'") from error
    return tifffile


def _gdal_nodata(text: str) -> float:
    try:
        return float(text.strip("\0 "))
    except ValueError as error:
        raise ValueError(f"its GDAL_NODATA tag must be a number, it is {text!r}") from error


def _geo_place(scale: Sequence[float], tie: Sequence[float], keys: dict[str, Any], ny: int) -> Place:
    """The place of a raster by its GeoTIFF tags (OGC 19-008r4, annex B.6).

    The tie point (column, row, _, x, y, _) and the pixel's size place the raster's corners, or its pixels' centres where
    GTRasterTypeGeoKey is 2, PixelIsPoint.
    """
    (dx, dy), (column, row, _, x, y, _) = scale[:2], tie[:6]
    centre = 0.0 if keys.get("GTRasterTypeGeoKey") == 2 else 0.5
    west, south = x + (centre - column) * dx, y - (ny - 1 + centre - row) * dy
    if keys.get("GTModelTypeGeoKey") == 2:  # geographic: degrees
        return _in_metres(west, south, dx, dy, ny)
    return {"dx": float(dx), "dy": float(dy), "x0": float(west), "y0": float(south)}


_READERS: dict[str, Callable[[Path], Raw]] = {
    ".npy": _read_npy,
    ".npz": _read_npz,
    ".png": _read_png,
    ".tif": _read_tiff,
    ".tiff": _read_tiff,
}
