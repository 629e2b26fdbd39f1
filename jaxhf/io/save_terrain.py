"""Heights to terrain files that `load_heights` reads back as they were."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from .errors import FileError
from .files import PathLike, by_ending, reading, replacing, require_folder
from .geotiff import import_tifffile
from .terrain import Terrain

# ModelPixelScale, ModelTiepoint, ModelTransformation and the three tags of GeoKeys: the georeference.
_GEOREFERENCE_TAGS = (33550, 33922, 34264, 34735, 34736, 34737)


def save_heights(path: PathLike, terrain: Terrain | ArrayLike, like: PathLike | None = None) -> None:
    """Writes heights, .npy, .npz or .tif, with their spacing and origin (.npy: without). The file appears whole or not at all.

    .tif starts in the north and is a GeoTIFF (OGC 19-008r4): its coordinates are those of `terrain`, of no named system, or
    those of `like`.

    Args:
      path: the file.
      terrain: the heights; nan and inf are kept. For .npy, which holds no more, floats of shape (ny, nx) will do.
      like: a GeoTIFF of the same shape, whose georeference a .tif takes over tag by tag.

    Raises:
      FileNotFoundError, PermissionError, ValueError: as `require_writable_heights`; or `terrain` is neither, or `like` has
        another shape.
    """
    path = require_writable_heights(path)
    terrain = _terrain(path, terrain)
    with replacing(path) as temporary:
        _WRITERS[path.suffix.lower()](temporary, terrain, None if like is None else Path(like))


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
      ValueError: the ending is not known, tifffile is missing, or `path` is a folder.
      FileNotFoundError: the folder does not exist.
      PermissionError: the folder cannot be written to.
    """
    path = Path(path)
    by_ending(_WRITERS, path, "write heights with")
    require_folder(path, "heights")
    if path.suffix.lower() in (".tif", ".tiff"):
        with reading(path):
            import_tifffile("writing")
    return path


def _write_npy(path: Path, terrain: Terrain, _: Path | None) -> None:
    with path.open("wb") as file:
        np.save(file, terrain.heights)


def _write_npz(path: Path, terrain: Terrain, _: Path | None) -> None:
    with path.open("wb") as file:
        np.savez(file, heights=terrain.heights, dx=terrain.dx, dy=terrain.dy, x0=terrain.x0, y0=terrain.y0)


def _write_tiff(path: Path, terrain: Terrain, like: Path | None) -> None:
    tifffile = import_tifffile("writing")
    tags = _own_tags(terrain) if like is None else _tags_of(tifffile, like, terrain.heights.shape)
    tifffile.imwrite(path, terrain.heights[::-1], photometric="minisblack", metadata=None, extratags=tags)


def _own_tags(terrain: Terrain) -> list[tuple[Any, ...]]:
    ny, _ = terrain.heights.shape
    scale, tie = (terrain.dx, terrain.dy, 0.0), (0.0, 0.0, 0.0, terrain.x0, terrain.y0 + (ny - 1) * terrain.dy, 0.0)
    # GTModelType 32767: coordinates of the user's own; GTRasterType 2, PixelIsPoint: a vertex is a pixel's centre.
    keys = (1, 1, 0, 2, 1024, 0, 1, 32767, 1025, 0, 1, 2)
    return [(33550, "d", 3, scale, True), (33922, "d", 6, tie, True), (34735, "H", len(keys), keys, True)]


def _tags_of(tifffile: Any, like: Path, shape: tuple[int, ...]) -> list[tuple[Any, ...]]:
    with tifffile.TiffFile(like) as file:
        page = file.pages[0]
        if (page.imagelength, page.imagewidth) != shape:
            raise FileError(
                f"{like}: it must have the shape of the heights, {shape}; it has {(page.imagelength, page.imagewidth)}"
            )
        found = [page.tags[code] for code in _GEOREFERENCE_TAGS if code in page.tags]
        return [(tag.code, int(tag.dtype), tag.count, tag.value, True) for tag in found]


_WRITERS: dict[str, Callable[[Path, Terrain, Path | None], None]] = {
    ".npy": _write_npy,
    ".npz": _write_npz,
    ".tif": _write_tiff,
    ".tiff": _write_tiff,
}
