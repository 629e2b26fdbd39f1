"""GeoTIFFs, written by rasterio."""

from pathlib import Path

import numpy as np
import pytest


def write(path: Path, bands: np.ndarray, place=(30, 0, 5e5, 0, -30, 4.1e6), crs: str | None = "EPSG:32616", **profile) -> Path:
    """Bands (count, h, w), or one (h, w), the northern row first; `place` is what GDAL's affine transform begins with."""
    rasterio = pytest.importorskip("rasterio")
    count, h, w = bands.reshape(-1, *bands.shape[-2:]).shape
    place = {"transform": rasterio.Affine(*place), "crs": crs}
    size = {"count": count, "height": h, "width": w, "dtype": bands.dtype}
    with rasterio.open(path, "w", **{"driver": "GTiff", **place, **size, **profile}) as file:
        file.write(bands.reshape(count, h, w))
    return path
