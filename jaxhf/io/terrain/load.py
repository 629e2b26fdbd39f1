"""Terrain files to heights with their spacing and origin.

Whatever the file's order, in memory row 0 is the southernmost: `heights[iy, ix]` has iy growing to the north.
"""

import contextlib
import dataclasses
import math
import re
import warnings
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ...core.extras import import_extra
from ..errors import FileError
from ..files import PathLike, by_ending, read_npy, reading, require_file
from ..gdal import DRIVERS
from ..pictures.codecs import read_grey
from .georeference import WGS84, WGS84_DEGREES, CoordinateSystem, Georeference, coordinate_system
from .grids import read_asc, read_hgt, read_mujoco
from .parts import Box, Window
from .rasters import Rows, raster_rows
from .sidecars import by_world_file
from .terrain import Nodata, Terrain, heights_of


def load_heights(
    path: PathLike,
    *,
    dx: float | None = None,
    dy: float | None = None,
    x0: float | None = None,
    y0: float | None = None,
    z_scale: float = 1.0,
    nodata: float | None = None,
    band: int | None = None,
    bbox: Box | None = None,
    window: Window | None = None,
) -> Terrain:
    """Reads heights from a file.

    - .npy: shape (ny, nx), in jaxhf's order (row 0 in the south), spacing 1.
    - .npz: the array `heights`, or the only one, in jaxhf's order, with dx, dy, x0, y0 where the file has them. Or an
      array `elevation` as in matplotlib's `jacksboro_fault_dem.npz`: north row first, bounds and spacing in degrees.
    - .png, of grey with 8 or 16 bits, .pfm (grey), .exr (one channel; needs OpenEXR): north row first, spacing 1; a height is
      the stored number. A .png has the place that a world file (.pgw) beside it gives.
    - .asc (ESRI ASCII grid, its reference system in a .prj beside it), .hgt (a tile of SRTM, placed by its name).
    - .hfield, .bin (MuJoCo's binary height field): row 0 in the south, spacing 1; a height is the stored number.
    - .tif, .tiff and other rasters that GDAL reads (.img, .dt2, .bil, .flt, .dem, .grd, .jp2, .nc, .vrt, .xyz; .img, .lbl and
      .cub of NASA's Planetary Data System and of ISIS; needs rasterio): a band of numbers, placed by its geotransform. A
      height stands at its pixel's centre: half a pixel inside the raster's corner. The file's scale and offset are applied.

    Degrees become metres at the mean latitude, with vertex (0, 0) at the origin: on the ellipsoid that the file's
    reference system names. x and y of a rotated raster lie along its rows and columns, with vertex (0, 0) at the origin; see
    `Terrain.rotation`. nan and inf are holes, as is what the file says means no data.

    Args:
      path: the file.
      dx, dy, x0, y0: overrule what the file says.
      z_scale: heights are multiplied by it.
      nodata: a stored value, before any scale, that means that there is no height; overrules the file.
      band: of a raster, which one, from 1; None: it has but one.
      bbox: west, south, east and north in the coordinates of the file, which may be degrees: only the heights that stand within
        are taken, of a raster only these are read. None: all.
      window: in its place the first column and row, from 0, and how many columns and rows are taken, as GDAL's -srcwin: of a
        raster in its own order, of other files from the north-west.

    Raises:
      FileNotFoundError: no file is there.
      ValueError: the ending is not known, the file is not a whole grid of heights, or its degrees are on a globe of unknown
        size and dx or dy is not given; or a raster is sheared, or rotated in degrees.
    """
    terrain = read_terrain(path, z_scale, nodata, band=band, bbox=bbox, window=window)
    given = {"dx": dx, "dy": dy, "x0": x0, "y0": y0}
    with reading(Path(path)):
        return terrain.in_metres(**{name: value for name, value in given.items() if value is not None})


def read_terrain(
    path: PathLike,
    z_scale: float = 1.0,
    nodata: float | None = None,
    nodata_overrules: bool = True,
    band: int | None = None,
    bbox: Box | None = None,
    window: Window | None = None,
) -> Terrain:
    """As `load_heights`, but in the file's own coordinates, which may be degrees.

    Without `nodata_overrules`, `nodata` counts only where the file names no such value.
    """

    def chosen(named: float | None) -> float | None:
        return named if nodata is None or (named is not None and not nodata_overrules) else nodata

    path = require_file(path)
    reader = by_ending(_READERS, path, "read heights from")
    with reading(path):
        if not math.isfinite(z_scale) or z_scale == 0:
            raise FileError(f"z_scale must be finite and not zero, it is {z_scale}")
        if reader is None:
            with raster_rows(path, chosen, band, bbox, window) as rows:
                terrain = rows.whole()
        elif band is not None:
            raise FileError(f"it has no bands, band must be left out; it is {band}")
        else:
            terrain = reader(path, chosen).within(bbox, window)
        stored = terrain
        if z_scale != 1:
            with np.errstate(over="ignore", invalid="ignore"):
                scaled = terrain.heights * terrain.heights.dtype.type(z_scale)
            if np.isinf(scaled).any():
                raise FileError(f"heights times z_scale must fit into {scaled.dtype}, z_scale is {z_scale}")
            place = stored.georeference and stored.georeference._replace(z_unit="")  # they are in another unit now
            terrain = dataclasses.replace(terrain, heights=scaled, georeference=place)
    _warn_of(path, stored, z_scale)
    return terrain


def _warn_of(path: Path, terrain: Terrain, z_scale: float = 1.0) -> None:
    for hint in _hints(terrain, z_scale):
        warnings.warn(f"{path}: {hint}", stacklevel=4)


STRIP = 2**24  # heights that are read at once, of a raster that holds more
_SAMPLE = 2**22  # about how many of these are looked at for values that may mean no height, see `_hints`


@contextlib.contextmanager
def terrain_rows(
    path: PathLike,
    nodata: float | None = None,
    band: int | None = None,
    bbox: Box | None = None,
    window: Window | None = None,
) -> Iterator[Rows]:
    """As `read_terrain`, for what needs a few rows at once: of a raster of more than `STRIP` heights only these are read."""
    path = require_file(path)
    with contextlib.ExitStack() as stack:
        if by_ending(_READERS, path, "read heights from") is None:
            with reading(path):
                stack.enter_context(import_extra("rasterio", f"reading {path.suffix} needs", "geo").Env(GDAL_CACHEMAX=_CACHE))
                used = (lambda named: named) if nodata is None else lambda _: nodata
                rows = stack.enter_context(raster_rows(path, used, band, bbox, window))
            (ny, nx), read = rows.place.heights.shape, reading(path)(rows.read)
            if ny * nx > STRIP:
                step = math.ceil(math.sqrt(ny * nx / _SAMPLE))
                _warn_of(path, read(slice(0, ny), step))
                yield Rows(rows.place, read)
                return
        yield rows_of(read_terrain(path, nodata=nodata, band=band, bbox=bbox, window=window))


_CACHE = 2**27  # bytes of GDAL's for blocks of a file, of which it else takes a share of the memory


def rows_of(terrain: Terrain) -> Rows:
    """The rows of a terrain in memory."""
    return Rows(terrain, lambda part, step: terrain.cut(slice(part.start, part.stop, step), slice(0, None, step)))


_UNDECLARED = (-999, -9999, -99999, -32767, -32768, 9999, 32767, 65535)  # what often means no height


def _hints(terrain: Terrain, z_scale: float) -> Iterator[str]:
    """What is hardly meant in a file, in words."""
    heights, place = terrain.heights, terrain.georeference or Georeference()
    for value in (float(end.reduce(heights, axis=None)) for end in (np.fmin, np.fmax)):
        if value in _UNDECLARED or abs(value) > 1e30:
            others = heights[np.isfinite(heights) & (heights != value)]
            below, above = float(others.min(initial=np.inf)), float(others.max(initial=-np.inf))
            if others.size and max(below - value, value - above) > 0.1 * (above - below):
                count = heights.size - others.size - int(np.isnan(heights).sum())
                span = f"{count} of {heights.size} heights, the others go from {below:.6g} to {above:.6g}"
                yield f"{value:.10g} stands for {span}; where it means that there is none, nodata is to say so"
    across, up = (re.search(r"foot|feet|\bft", unit.lower()) is not None for unit in (place.unit, place.height_unit))
    if z_scale == 1 and up and not across:
        yield f"its heights are in {place.height_unit}, x and y are not: in metres they would be 0.3048 times that"
    if z_scale == 1 and across and not up:
        yield f"x and y are in {place.unit}, and heights count as such: in metres they must be multiplied by 3.28084"


def jacksboro() -> Terrain:
    """The valley of the Jacksboro fault in Tennessee: 344 x 403 heights in metres, about 74 m by 92 m apart.

    Its origin is the south-western vertex. ValueError where matplotlib, with which the data come, is not installed.
    """
    return load_heights(jacksboro_file())


def jacksboro_file() -> str:
    """Where matplotlib keeps that terrain."""
    matplotlib = import_extra("matplotlib", "the Jacksboro terrain comes with", "plot")
    return str(matplotlib.cbook.get_sample_data("jacksboro_fault_dem.npz", asfileobj=False))


def _read_npy(path: Path, nodata: Nodata) -> Terrain:
    with path.open("rb") as file:
        return Terrain(heights_of(read_npy(file, path.stat().st_size), nodata(None)))


def _read_npz(path: Path, nodata: Nodata) -> Terrain:
    with zipfile.ZipFile(path) as archive:
        members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}

        def array(name: str, kinds: str = "fiub") -> np.ndarray:
            with archive.open(members[name]) as file:
                return read_npy(file, members[name].file_size, kinds)

        def number(name: str) -> float:
            value = array(name)
            if value.size != 1:
                raise FileError(f"its {name} must be one number, its shape is {value.shape}")
            return float(value.item())

        if "heights" in members or len(members) == 1:
            name = "heights" if "heights" in members else next(iter(members))
            grid: dict[str, Any] = {key: number(key) for key in ("dx", "dy", "x0", "y0") if key in members}
            if len(grid) == 4:
                grid["crs"] = CoordinateSystem()
            if "crs" in members:  # as `save_heights` writes it
                scale, offset = ((float(x), float(y)) for x, y in (array("crs_scale"), array("crs_offset")))
                nodata_there = number("nodata") if "nodata" in members else None
                unit = str(array("z_unit", "U")) if "z_unit" in members else ""
                turn = number("crs_rotation") if "crs_rotation" in members else 0.0
                place = Georeference(str(array("crs", "U")), scale, offset, nodata_there, bool(number("point")), unit, turn)
                plain = place[1:3] == Georeference()[1:3] and not turn
                grid |= {"georeference": place, "crs": coordinate_system(place.wkt) if plain else CoordinateSystem()}
            return Terrain(heights_of(array(name), nodata(None)), **grid)
        if "elevation" not in members:
            raise FileError(f"it must hold an array 'heights', or only one, it holds {', '.join(sorted(members))}")
        missing = {"dx", "dy", "xmin", "ymin", "ymax"} - members.keys()
        if missing:
            raise FileError(f"beside 'elevation' it must hold {', '.join(sorted(missing))}")
        heights = heights_of(array("elevation")[::-1], nodata(None))
        south = min(number("ymin"), number("ymax"))  # matplotlib's file has them swapped
        dx, dy = number("dx"), number("dy")
        crs, place = CoordinateSystem(degrees=True, globe=WGS84), Georeference(WGS84_DEGREES)
        return Terrain(heights, dx, dy, number("xmin") + dx / 2, south + dy / 2, crs, place)


def _read_image(path: Path, nodata: Nodata) -> Terrain:
    heights = heights_of(read_grey(path)[::-1], nodata(None))
    return by_world_file(path, heights) if path.suffix.lower() == ".png" else Terrain(heights)


_READERS: dict[str, Callable[[Path, Nodata], Terrain] | None] = {  # None: `raster_rows`
    ".npy": _read_npy,
    ".npz": _read_npz,
    ".asc": read_asc,
    ".hgt": read_hgt,
    **dict.fromkeys((".hfield", ".bin"), read_mujoco),
    **dict.fromkeys((".png", ".exr", ".pfm"), _read_image),
    **dict.fromkeys(DRIVERS),
}
ENDINGS = frozenset(_READERS)
