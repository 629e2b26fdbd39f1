"""GeoTIFF and the other rasters of GDAL, read and written through rasterio."""

import contextlib
import dataclasses
import errno
import math
import os
import warnings
import zlib
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ...core.errors import ArgumentError
from ...core.extras import import_extra
from ...core.rules import Whole, require
from ..errors import FileError
from ..files import PathLike, reading, replacing, require_pixels, require_writable, utf8_name, write_npy
from ..gdal import opened
from ..pictures.codecs import write_png
from .georeference import CoordinateSystem, Georeference, coordinate_system
from .parts import Box, Window
from .sidecars import beside
from .terrain import Nodata, Terrain, heights_of


class Rows(NamedTuple):
    """A terrain whose heights are read when they are needed."""

    place: Terrain  # with zeros for heights, which take no memory
    read: Callable[[slice, int], Terrain]  # some rows, counted from the south, of each `step`-th row and column

    def whole(self) -> Terrain:
        """All of it; FileError where that is too much."""
        ny, nx = self.place.heights.shape
        require_pixels(ny, nx)
        return self.read(slice(0, ny), 1)


@contextlib.contextmanager
def raster_rows(path: Path, nodata: Nodata, band: int | None, box: Box | None, window: Window | None) -> Iterator[Rows]:
    """The heights in a raster, in its own coordinates, while the file is open; of a band and a part, see `load_heights`."""
    with opened(path) as dataset:
        if band is None and dataset.count != 1:
            raise FileError(f"heights must be one band, it has {dataset.count}: band must say which")
        number = 1 if band is None else band
        require("load_heights", "band", number, Whole(1))
        if number > dataset.count:
            raise FileError(f"it has no band {number}, it has {dataset.count}")
        scale, offset = dataset.scales[number - 1], dataset.offsets[number - 1]
        if not (math.isfinite(scale) and math.isfinite(offset) and scale != 0):
            raise FileError(f"its scale and offset must be finite, the scale not zero; they are {scale} and {offset}")
        used = nodata(dataset.nodatavals[number - 1])
        whole, north_first, east_first = _place(dataset, used, dataset.units[number - 1] or "")
        rows, columns = whole.places(box, window, north_first, east_first)
        place = whole.cut(rows, columns)
        left = dataset.width - columns.stop if east_first else columns.start
        masked = any(flag.name == "per_dataset" for flag in dataset.mask_flag_enums[number - 1])

        def read(part: slice, step: int) -> Terrain:
            first, last = rows.start + part.start, rows.start + part.stop
            top = dataset.height - last if north_first else first
            pixels = (top, top + last - first), (left, left + columns.stop - columns.start)
            shape = tuple(-(-(end - start) // step) for start, end in pixels)
            heights = heights_of(dataset.read(number, window=pixels, out_shape=shape), used, scale, offset)
            if masked:
                heights[dataset.dataset_mask(window=pixels, out_shape=shape) == 0] = np.nan
            heights = heights[:: -1 if north_first else 1, :: -1 if east_first else 1]
            return dataclasses.replace(place, heights=heights, y0=place.y0 + part.start * place.dy)

        yield Rows(place, read)


def placed_like(terrain: Terrain, like: Path) -> Terrain:
    """The heights of a terrain where a raster of their shape lies; FileError where it has another."""
    with reading(like), opened(like) as dataset:
        place, *_ = _place(dataset, dataset.nodata)
    if place.heights.shape != terrain.heights.shape:
        shape = place.heights.shape
        raise FileError(f"{like}: it must have the shape of the heights, {terrain.heights.shape}; it has {shape}")
    return dataclasses.replace(place, heights=terrain.heights)


def _place(dataset: Any, nodata: float | None, z_unit: str = "") -> tuple[Terrain, bool, bool]:
    """A terrain of no heights where GDAL's geotransform puts the pixels' centres, and whether the file's rows begin in the
    north and its columns in the east."""
    a, b, c, d, e, f = dataset.transform[:6]
    if max(abs(b) * dataset.height, abs(d) * dataset.width) < _UNROTATED * min(abs(a), abs(e)):  # by rounding
        b = d = 0.0
    if dataset.gcps[0]:
        raise FileError("it must be placed by a geotransform, it has ground control points (gdalwarp makes it so)")
    ny, nx = dataset.height, dataset.width
    nothing, wkt = np.broadcast_to(np.float32(0), (ny, nx)), "" if dataset.crs is None else dataset.crs.to_wkt()
    if dataset.transform.is_identity:  # of a file without a place
        return Terrain(nothing), True, False
    point = dataset.tags().get("AREA_OR_POINT") == "Point"
    place, crs = Georeference(wkt, nodata=nodata, point=point, z_unit=z_unit), coordinate_system(wkt)
    if not b and not d and a and e:
        x0, y0 = c + (0.5 if a > 0 else nx - 0.5) * a, f + (0.5 if e > 0 else ny - 0.5) * e
        return Terrain(nothing, abs(a), abs(e), x0, y0, crs, place), e < 0, a < 0
    dx, dy, area = math.hypot(a, d), math.hypot(b, e), a * e - b * d
    if crs.degrees or abs(a * b + d * e) > _SHEAR * dx * dy or not area:
        rule = "its pixels must lie along x and y, or be rotated without shear, and in lengths (gdalwarp makes them so)"
        raise FileError(f"{rule}; its geotransform has {a}, {b}, {d}, {e}")
    row = ny - 0.5 if area < 0 else 0.5
    place = place._replace(offset=(c + 0.5 * a + row * b, f + 0.5 * d + row * e), rotation=math.degrees(math.atan2(-d, a)))
    return Terrain(nothing, dx, dy, crs=CoordinateSystem(), georeference=place), area < 0, False


_SHEAR = 1e-6  # cosine of the angle between rows and columns, of which transforms in text have some
_UNROTATED = 1e-6  # cells by which rows and columns leave x and y


require_writable_raster = partial(require_writable, "save_raster", "a map", (".npy", ".png", ".tif", ".tiff"))


def save_raster(path: PathLike, values: Any, like: Terrain, nodata: float | None = None) -> None:
    """Writes a map of the terrain `like`: a value or a colour at each of its vertices, row 0 in the south.

    .tif is a GeoTIFF in the coordinates of the file that `like` is from, with its reference system, and `nodata` for no value;
    .png has its place in a world file beside it (.pgw), as GIS programs read it; .npy holds the values alone.
    """
    path = require_writable_raster(path)
    values = np.asarray(values)
    ending = path.suffix.lower()
    kinds = (np.uint8, np.uint16) if ending == ".png" else (np.uint8, np.uint16, np.float32, np.float64)
    channels = ((), (3,), (4,)) if values.dtype == np.uint8 else ((),)
    if values.dtype not in kinds:
        known = ", ".join(np.dtype(kind).name for kind in kinds)
        raise ArgumentError("save_raster", "values", f"must be of {known} for {ending}, they are {values.dtype}")
    if values.shape[:2] != like.heights.shape or values.shape[2:] not in channels:
        rule = f"must have the terrain's shape, {like.heights.shape}, theirs is {values.shape}"
        raise ArgumentError("save_raster", "values", rule)
    with replacing(path, beside(path, like)) as temporary:
        if ending == ".npy":
            write_npy(temporary, values)
        elif ending == ".png":
            write_png(temporary, values[::-1])
        else:
            temporary.write_bytes(geotiff(values, like, nodata))


@contextlib.contextmanager
def writing_strips(path: Path, like: Terrain, nodata: float | None) -> Iterator[Callable[[slice, np.ndarray], None]]:
    """As `save_raster`, for maps that memory may not hold: takes rows, counted from the south, and the values there.

    A .tif takes them in any order; a .npy from the south on. Once a .tif is closed it is read again, as GDAL does not always
    say that a disk is full.
    """
    with replacing(path) as temporary:
        if path.suffix.lower() == ".npy":
            with temporary.open("wb") as file:

                def append(rows: slice, values: np.ndarray) -> None:
                    if not rows.start:
                        header = np.lib.format.header_data_from_array_1_0(values)
                        shape = *like.heights.shape, *values.shape[2:]
                        np.lib.format.write_array_header_1_0(file, header | {"shape": shape, "fortran_order": False})
                    file.write(np.ascontiguousarray(values).data)

                yield append
            return
        rasterio, sums = import_extra("rasterio", "writing .tif needs", "geo"), {}
        with utf8_name(temporary) as name, contextlib.ExitStack() as open_files:
            datasets: list[Any] = []

            @_disk_full(rasterio)
            def put(rows: slice, values: np.ndarray) -> None:
                bands = np.ascontiguousarray(_bands(values))
                if not datasets:
                    dataset = _created(partial(rasterio.open, name, "w"), bands, like, nodata)
                    datasets.append(open_files.enter_context(dataset))
                top = len(like.heights) - rows.stop
                window = (top, top + len(values)), (0, values.shape[1])
                datasets[0].write(bands, window=window)
                sums[window] = zlib.crc32(bands.data)

            yield put
            with _disk_full(rasterio):
                open_files.close()
                with rasterio.open(name) as dataset:
                    if any(zlib.crc32(dataset.read(window=window).data) != found for window, found in sums.items()):
                        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@contextlib.contextmanager
def _disk_full(rasterio: Any) -> Iterator[None]:
    """What GDAL says of a file that it writes is that of a full disk, as its place was looked at before."""
    try:
        yield
    except rasterio.errors.RasterioError as error:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)) from error


def _bands(values: np.ndarray) -> np.ndarray:
    """Values of shape (ny, nx) or (ny, nx, bands), row 0 in the south, as rasterio takes them: (bands, ny, nx), north first."""
    return np.moveaxis(values[::-1].reshape(*values.shape[:2], -1), -1, 0)


def _created(create: Callable[..., Any], bands: np.ndarray, like: Terrain, nodata: float | None) -> Any:
    """The dataset of a GeoTIFF where a terrain lies, for such bands, that `create` of rasterio makes."""
    rasterio = import_extra("rasterio", "writing .tif needs", "geo")
    (ny, nx), place, count = like.heights.shape, like.georeference, len(bands)
    dataset = create(
        driver="GTiff", width=nx, height=ny, count=count, dtype=bands.dtype, nodata=nodata,
        crs=rasterio.crs.CRS.from_wkt(place.wkt) if place and place.wkt else None,
        transform=rasterio.Affine(*like.geotransform()),
        photometric="rgb" if count > 1 else "minisblack", interleave="pixel", bigtiff="if_safer",
    )  # fmt: skip
    dataset.update_tags(AREA_OR_POINT="Point" if place is None or place.point else "Area")
    return dataset


def geotiff(values: np.ndarray, like: Terrain, nodata: float | None, unit: str = "") -> memoryview:
    """The bytes of a GeoTIFF; see `save_raster`. In memory first, as GDAL does not always say that a disk is full."""
    rasterio = import_extra("rasterio", "writing .tif needs", "geo")
    bands = _bands(values)
    with warnings.catch_warnings(), rasterio.io.MemoryFile() as memory:
        warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)  # pixels of 1 x 1 in a corner at 0, 0
        with _created(memory.open, bands, like, nodata) as dataset:
            dataset.write(bands)
            if unit:
                dataset.units = (unit,)
        return memoryview(memory.read())
