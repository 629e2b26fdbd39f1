"""Heights to terrain files that `load_heights` reads back as they were."""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..errors import FileError
from ..files import PathLike, replacing, require_file, require_writable, write_npy
from ..pictures.codecs import write_png
from ..pictures.exr import write_channels
from .grids import write_asc
from .rasters import geotiff, placed_like
from .sidecars import beside
from .terrain import Terrain


def save_heights(path: PathLike, terrain: Terrain | ArrayLike, like: PathLike | None = None) -> None:
    """Writes heights with their place: spacing, origin and, where they are known, reference system and value for holes.

    The file appears whole or not at all. Its coordinates are those of the file that `terrain` is from, which may be degrees.

    - .npz: all that a `Terrain` holds. .npy: the heights alone.
    - .tif: a GeoTIFF, in the terrain's precision (needs rasterio). .asc: an ESRI ASCII grid.
    - .png: whole heights of 0 to 65535, as 16-bit grey, rounded; its place is in a world file (.pgw) beside it.
    - .exr: one channel Y in float32, without a place (needs OpenEXR).

    The reference system of a .png or an .asc is in a .prj beside it.

    Args:
      path: the file.
      terrain: the heights. For .npy, which holds no more, floats of shape (ny, nx) will do.
      like: a GeoTIFF of the same shape, whose place and reference system a .tif takes over.

    Raises:
      FileNotFoundError, PermissionError: the folder is not there, or nothing can be written into it.
      ValueError: the ending is not known, or a package for it is missing; `terrain` is neither, or `like` has another shape.
    """
    path = require_writable_heights(path)
    terrain = _terrain(path, terrain)
    if like is not None and path.suffix.lower() in (".tif", ".tiff"):
        terrain = placed_like(terrain, require_file(like))
    with replacing(path, beside(path, terrain)) as temporary:
        try:
            _WRITERS[path.suffix.lower()](temporary, terrain)
        except FileError as error:
            raise FileError(f"{path}: {error}") from error


def _terrain(path: Path, given: Any) -> Terrain:
    if isinstance(given, Terrain):
        return given
    if path.suffix.lower() != ".npy":
        raise FileError(f"{path}: what is written must be a Terrain, whose place goes with it; it is a {type(given).__name__}")
    heights = np.asarray(given)
    if heights.dtype not in (np.float32, np.float64) or heights.ndim != 2:
        rule = "heights must be a Terrain, or float32 or float64 of shape (ny, nx)"
        raise FileError(f"{path}: {rule}; they are {heights.dtype} of shape {heights.shape}")
    return Terrain(heights)


def _write_npz(path: Path, terrain: Terrain) -> None:
    place: dict[str, Any] = {name: getattr(terrain, name) for name in ("dx", "dy", "x0", "y0")}
    if (known := terrain.georeference) is not None:
        place |= {"crs": known.wkt, "crs_scale": known.scale, "crs_offset": known.offset, "point": known.point}
        place |= {"z_unit": known.z_unit} if known.z_unit else {}
        place |= {"crs_rotation": known.rotation} if known.rotation else {}
        place |= {} if known.nodata is None else {"nodata": known.nodata}
    with path.open("wb") as file:
        np.savez(file, heights=terrain.heights, **place)


def _write_tiff(path: Path, terrain: Terrain) -> None:
    heights, nodata = terrain.heights, terrain.georeference and terrain.georeference.nodata
    if nodata is not None and (not np.isfinite(nodata) or np.any(heights == heights.dtype.type(nodata))):
        nodata = None  # after scaling it may be a height
    if nodata is not None:
        heights = np.where(np.isnan(heights), heights.dtype.type(nodata), heights)
    unit = terrain.georeference.z_unit if terrain.georeference else ""
    path.write_bytes(geotiff(heights, terrain, np.nan if nodata is None else nodata, unit))


def _write_png(path: Path, terrain: Terrain) -> None:
    terrain.require_unrotated("the terrain in a .png")
    low, high = (float(bound(terrain.heights)) for bound in (np.min, np.max))
    if not (low >= -0.5 and high < 65535.5):
        span = "has holes" if terrain.nodata.any() else f"goes from {low:.6g} to {high:.6g}"
        raise FileError(f"a .png holds whole heights of 0 to 65535 everywhere, this terrain {span}")
    write_png(path, np.clip(np.rint(terrain.heights[::-1]), 0, 65535).astype(np.uint16))


_WRITERS: dict[str, Callable[[Path, Terrain], None]] = {
    ".asc": write_asc,
    ".exr": lambda path, terrain: write_channels(path, {"Y": terrain.heights[::-1]}),
    ".png": _write_png,
    ".npy": lambda path, terrain: write_npy(path, terrain.heights),
    ".npz": _write_npz,
    **dict.fromkeys((".tif", ".tiff"), _write_tiff),
}
HEIGHTS = tuple(_WRITERS)


def require_writable_heights(path: PathLike, endings: Iterable[str] = HEIGHTS) -> Path:
    """As `require_writable`, for `save_heights` and those endings that the caller takes."""
    return require_writable("save_heights", "heights", endings, path)
