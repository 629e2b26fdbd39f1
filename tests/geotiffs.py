"""GeoTIFFs, written by rasterio."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest


def write(
    path: Path, bands: np.ndarray, place=(30, 0, 5e5, 0, -30, 4.1e6), crs: str | None = "EPSG:32616", about: Any = (), **profile
) -> Path:
    """Bands (count, h, w), or one (h, w), the northern row first; `place` is what GDAL's affine transform begins with.

    `about` names what rasterio's dataset is told once it is written, as {"units": ("ft",)}.
    """
    rasterio = pytest.importorskip("rasterio")
    count, h, w = bands.reshape(-1, *bands.shape[-2:]).shape
    known = {"transform": rasterio.Affine(*place), "crs": crs}
    size = {"count": count, "height": h, "width": w, "dtype": bands.dtype}
    with rasterio.open(path, "w", **{"driver": "GTiff", **known, **size, **profile}) as file:
        file.write(bands.reshape(count, h, w))
        for name, value in dict(about).items():
            setattr(file, name, value)
    return path
