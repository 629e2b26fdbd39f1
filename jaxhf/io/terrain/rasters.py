"""GeoTIFF and the other rasters of GDAL, read and written through rasterio."""

import dataclasses
import math
import warnings
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ...core.errors import ArgumentError
from ...core.extras import import_extra
from ..errors import FileError
from ..files import PathLike, reading, replacing, require_writable, write_npy
from ..gdal import opened
from ..pictures.codecs import write_png
from .georeference import Georeference, coordinate_system
from .sidecars import beside
from .terrain import Box, Nodata, Terrain, heights_of, places_within


def read_raster(path: Path, nodata: Nodata, band: int | None = None, box: Box | None = None) -> Terrain:
    """The heights in a raster, in its own coordinates; of a band, from 1, and of a part, see `load_heights`."""
    with opened(path) as dataset:
        if band is None and dataset.count != 1:
            raise FileError(f"heights must be one band, it has {dataset.count}: band must say which")
        number = 1 if band is None else band
        if number > dataset.count:
            raise FileError(f"it has no band {number}, it has {dataset.count}")
        scale, offset = dataset.scales[number - 1], dataset.offsets[number - 1]
        if not (math.isfinite(scale) and math.isfinite(offset) and scale != 0):
            raise FileError(f"its scale and offset must be finite, the scale not zero; they are {scale} and {offset}")
        used, place = nodata(dataset.nodatavals[number - 1]), _placed(np.zeros((2, 2), np.float32), dataset, None)
        dx, dy, x0, y0 = place.dx, place.dy, place.x0, place.y0
        rows, columns = places_within(box, (dataset.height, dataset.width), (x0, y0), (dx, dy))
        a, e = dataset.transform.a, dataset.transform.e
        # From the order of `Terrain` to that of the file.
        top = rows.start if e > 0 else dataset.height - rows.stop
        left = columns.start if a > 0 else dataset.width - columns.stop
        window = (top, top + rows.stop - rows.start), (left, left + columns.stop - columns.start)
        heights = heights_of(dataset.read(number, window=window), used, scale, offset)
        if any(flag.name == "per_dataset" for flag in dataset.mask_flag_enums[number - 1]):
            heights[dataset.dataset_mask(window=window) == 0] = np.nan
        terrain = _placed(heights, dataset, used)
        terrain = dataclasses.replace(terrain, x0=x0 + columns.start * dx, y0=y0 + rows.start * dy)
        if terrain.georeference is None:
            return terrain
        named = terrain.georeference._replace(z_unit=dataset.units[number - 1] or "")
        return dataclasses.replace(terrain, georeference=named)


def placed_like(terrain: Terrain, like: Path) -> Terrain:
    """The heights of a terrain where a raster of their shape lies; FileError where it has another."""
    with reading(like), opened(like) as dataset:
        place, shape = _placed(np.zeros((2, 2), np.float32), dataset, dataset.nodata), (dataset.height, dataset.width)
        if shape != terrain.heights.shape:
            raise FileError(f"it must have the shape of the heights, {terrain.heights.shape}; it has {shape}")
    return dataclasses.replace(place, heights=terrain.heights)


def _placed(heights: np.ndarray, dataset: Any, nodata: float | None) -> Terrain:
    """The heights, whose rows are in the file's order, where GDAL's geotransform puts the pixels' centres."""
    a, b, c, d, e, f = dataset.transform[:6]
    if b or d or not (a and e):
        raise FileError(f"its pixels must lie along x and y (gdalwarp makes it so), its geotransform is rotated: {b}, {d}")
    if dataset.gcps[0]:
        raise FileError("it must be placed by a geotransform, it has ground control points (gdalwarp makes it so)")
    wkt = "" if dataset.crs is None else dataset.crs.to_wkt()
    if dataset.transform.is_identity and not wkt:  # of a file without a place
        return Terrain(heights[::-1])
    ny, nx = dataset.height, dataset.width
    heights = heights[:: 1 if e > 0 else -1, :: 1 if a > 0 else -1]
    x0, y0 = c + (0.5 if a > 0 else nx - 0.5) * a, f + (0.5 if e > 0 else ny - 0.5) * e
    point = dataset.tags().get("AREA_OR_POINT") == "Point"
    crs = coordinate_system(wkt)
    return Terrain(heights, abs(a), abs(e), x0, y0, crs, Georeference(wkt, nodata=nodata, point=point))


require_writable_raster = partial(require_writable, "save_raster", "a map", (".npy", ".png", ".tif", ".tiff"))


def save_raster(path: PathLike, values: Any, like: Terrain, nodata: float | None = None) -> None:
    """Writes a map of a terrain: a value or a colour at each of its vertices. The file appears whole or not at all.

    .tif is a GeoTIFF in the coordinates of the file that `like` is from, with its reference system; .png has its place in a
    world file beside it (.pgw), as GIS programs read it; .npy holds the values alone, in the order of `values`.

    Args:
      path: the file; it begins with the northern row, but for .npy.
      values: row 0 in the south, as in `Terrain`: uint8 of shape (ny, nx), (ny, nx, 3) or (ny, nx, 4), red, green, blue and
        opacity; uint16 or, not for .png, float32 or float64 of shape (ny, nx).
      like: the terrain, which says where the map lies.
      nodata: the value that means that there is none, for .tif.

    Raises:
      FileNotFoundError, PermissionError, ValueError: as `require_writable`; or `values` are of another shape or kind.
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
        raise ArgumentError(
            "save_raster", "values", f"must have the terrain's shape, {like.heights.shape}, theirs is {values.shape}"
        )
    with replacing(path, beside(path, like)) as temporary:
        if ending == ".npy":
            write_npy(temporary, values)
        elif ending == ".png":
            write_png(temporary, values[::-1])
        else:
            temporary.write_bytes(geotiff(values, like, nodata))


def geotiff(values: np.ndarray, like: Terrain, nodata: float | None, unit: str = "") -> memoryview:
    """The bytes of a GeoTIFF; see `save_raster`. In memory first, as GDAL does not always say that a disk is full."""
    rasterio = import_extra("rasterio", "writing .tif needs", "geo")
    dx, dy, x0, y0 = like.in_file
    place = like.georeference or Georeference(point=True)
    bands = values[::-1, :, None] if values.ndim == 2 else values[::-1]
    ny, nx, count = bands.shape
    profile = {
        "driver": "GTiff", "width": nx, "height": ny, "count": count, "dtype": values.dtype, "nodata": nodata,
        "crs": rasterio.crs.CRS.from_wkt(place.wkt) if place.wkt else None,
        "transform": rasterio.Affine(dx, 0, x0 - dx / 2, 0, -dy, y0 + (ny - 0.5) * dy),
        "photometric": "rgb" if count > 1 else "minisblack", "interleave": "pixel", "bigtiff": "if_safer",
    }  # fmt: skip
    with warnings.catch_warnings(), rasterio.io.MemoryFile() as memory:
        warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)  # pixels of 1 x 1 in a corner at 0, 0
        with memory.open(**profile) as dataset:
            dataset.update_tags(AREA_OR_POINT="Point" if place.point else "Area")
            dataset.write(np.moveaxis(bands, -1, 0))
            if unit:
                dataset.units = (unit,)
        return memoryview(memory.read())
