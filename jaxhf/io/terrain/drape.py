"""Pictures to be laid over a terrain."""

import importlib
import math

import numpy as np
from jaxtyping import Float

from ..errors import FileError
from ..files import PathLike, reading, require_file
from ..gdal import opened
from ..pictures.images import linear_from_srgb, load_image
from .georeference import Georeference
from .terrain import Terrain

_MOST = 4096  # texels along a side


def load_drape(path: PathLike, terrain: Terrain) -> Float[np.ndarray, "h w 3"]:
    """The texels of an `ImageTexture` that shows a picture on a terrain: linear colours, row 0 in the south.

    A GeoTIFF is laid where it lies, which must be in the terrain's reference system; it is black where it does not cover the
    terrain. Any other picture goes from corner to corner, its top in the north.
    """
    path = require_file(path)
    if path.suffix.lower() not in (".tif", ".tiff"):
        return load_image(path, transfer="srgb")[::-1]
    with reading(path), opened(path) as dataset:
        rasterio = importlib.import_module("rasterio")
        if dataset.count not in (1, 3, 4) or set(dataset.dtypes) != {"uint8"}:
            raise FileError(f"it must have 1, 3 or 4 bands of bytes, it has {dataset.count} of {dataset.dtypes[0]}")
        if dataset.colorinterp[0].name == "palette":
            raise FileError("its bands must be colours, it has a palette (gdal_translate -expand rgb makes colours of it)")
        place, crs = terrain.georeference or Georeference(), dataset.crs
        if crs is not None and place.wkt and rasterio.crs.CRS.from_wkt(place.wkt) != crs:
            rule = f"it must be in the terrain's reference system, {place.name}; it is in {crs.to_string()}"
            raise FileError(f"{rule} (gdalwarp changes it)")
        terrain.require_unrotated("a terrain below a GeoTIFF")
        if dataset.transform.b or dataset.transform.d:
            raise FileError("its pixels must lie along x and y (gdalwarp makes it so), they are rotated or sheared")
        dx, dy, x0, y0 = terrain.in_file
        ny, nx = terrain.heights.shape
        west, south, east, north = x0, y0, x0 + (nx - 1) * dx, y0 + (ny - 1) * dy
        if dataset.transform.is_identity:
            west, south, east, north = 0, dataset.height, dataset.width, 0
        window = rasterio.windows.from_bounds(west, south, east, north, dataset.transform)
        covers = window.col_off + window.width >= 0 and window.col_off <= dataset.width
        if not (covers and window.row_off + window.height >= 0 and window.row_off <= dataset.height):
            raise FileError(f"it must cover the terrain; it spans {tuple(dataset.bounds)}, that {(west, south, east, north)}")
        shape = tuple(min(_MOST, max(2, math.ceil(side))) for side in (window.height, window.width))
        bands = dataset.read(
            indexes=[1, 2, 3] if dataset.count > 1 else [1, 1, 1], window=window, out_shape=(3, *shape), boundless=True,
            fill_value=0, resampling=rasterio.enums.Resampling.bilinear,
        )  # fmt: skip
    return linear_from_srgb(np.moveaxis(bands, 0, -1)[::-1] / 255)
