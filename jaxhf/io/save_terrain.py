"""Heights to terrain files that `load_heights` reads back as they were."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from .errors import FileError
from .files import PathLike, by_ending, reading, replacing, require_file, require_folder, write_npy
from .rasters import georeference_of, geotiff, require_rasterio
from .terrain import Terrain


def save_heights(path: PathLike, terrain: Terrain | ArrayLike, like: PathLike | None = None) -> None:
    """Writes heights, .npy, .npz or .tif, with their spacing and origin (.npy: without). The file appears whole or not at all.

    .tif starts in the north and is a GeoTIFF, in the coordinates of the file that `terrain` is from, with its reference system
    and its value for holes; without one, in those of `terrain`, of no named system.

    Args:
      path: the file.
      terrain: the heights; nan and inf are kept. For .npy, which holds no more, floats of shape (ny, nx) will do.
      like: a GeoTIFF of the same shape, whose place and reference system a .tif takes over.

    Raises:
      FileNotFoundError, PermissionError, ValueError: as `require_writable_heights`; or `terrain` is neither, or `like` has
        another shape.
    """
    path = require_writable_heights(path)
    terrain = _terrain(path, terrain)
    if like is not None and path.suffix.lower() in (".tif", ".tiff"):
        terrain = _placed_like(terrain, require_file(like))
    with replacing(path) as temporary:
        _WRITERS[path.suffix.lower()](temporary, terrain)


def _placed_like(terrain: Terrain, like: Path) -> Terrain:
    with reading(like):
        place, shape = georeference_of(like)
        if shape != terrain.heights.shape:
            raise FileError(f"it must have the shape of the heights, {terrain.heights.shape}; it has {shape}")
    return dataclasses.replace(place, heights=terrain.heights)


def _terrain(path: Path, given: Any) -> Terrain:
    if isinstance(given, Terrain):
        return given
    if path.suffix.lower() != ".npy":
        raise FileError(f"{path}: what is written must be a Terrain, whose place goes with it; it is a {type(given).__name__}")
    heights = np.asarray(given)
    if heights.dtype not in (np.float32, np.float64) or heights.ndim != 2:
        raise FileError(
            f"{path}: heights must be a Terrain, or float32 or float64 of shape (ny, nx); "
            f"they are {heights.dtype} of shape {heights.shape}"
        )
    return Terrain(heights)


def require_writable_heights(path: PathLike) -> Path:
    """Checks that `save_heights` can write to `path`, so that nobody fits for an hour first.

    Raises:
      ValueError: the ending is not known, rasterio is missing, or `path` is a folder.
      FileNotFoundError: the folder does not exist.
      PermissionError: the folder cannot be written to.
    """
    path = Path(path)
    by_ending(_WRITERS, path, "write heights with")
    require_folder(path, "heights")
    require_rasterio(path)
    return path


def _write_npy(path: Path, terrain: Terrain) -> None:
    write_npy(path, terrain.heights)


def _write_npz(path: Path, terrain: Terrain) -> None:
    place: dict[str, Any] = {name: getattr(terrain, name) for name in ("dx", "dy", "x0", "y0")}
    if (known := terrain.georeference) is not None:
        place |= {"crs": known.wkt, "crs_scale": known.scale, "crs_offset": known.offset, "point": known.point}
        place |= {} if known.nodata is None else {"nodata": known.nodata}
    with path.open("wb") as file:
        np.savez(file, heights=terrain.heights, **place)


def _write_tiff(path: Path, terrain: Terrain) -> None:
    heights, nodata = terrain.heights, terrain.georeference and terrain.georeference.nodata
    if nodata is not None and (not np.isfinite(nodata) or np.any(heights == heights.dtype.type(nodata))):
        nodata = None  # after scaling it may be a height
    if nodata is not None:
        heights = np.where(np.isnan(heights), heights.dtype.type(nodata), heights)
    path.write_bytes(geotiff(heights, terrain, np.nan if nodata is None else nodata))


_WRITERS: dict[str, Callable[[Path, Terrain], None]] = {
    ".npy": _write_npy,
    ".npz": _write_npz,
    ".tif": _write_tiff,
    ".tiff": _write_tiff,
}
