"""Rasters of all kinds, opened by GDAL through rasterio."""

import contextlib
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from ..core.extras import import_extra
from .errors import FileError
from .files import utf8_name

# GDAL's driver by ending: what a file holds does not decide, as some drivers follow addresses on the network.
DRIVERS = {
    **dict.fromkeys((".tif", ".tiff"), "GTiff"),
    **dict.fromkeys((".dt0", ".dt1", ".dt2"), "DTED"),
    **dict.fromkeys((".bil", ".flt"), "EHdr"),
    ".cub": "ISIS3",
    ".dem": "USGSDEM",
    ".grd": "GSBG",
    ".img": "HFA",
    ".jp2": "JP2OpenJPEG",
    ".lbl": "PDS",
    ".nc": "netCDF",
    ".vrt": "VRT",
    ".xyz": "XYZ",
}


@contextlib.contextmanager
def opened(path: Path) -> Iterator[Any]:
    """The dataset of rasterio's in a file; FileError where it is none."""
    rasterio = import_extra("rasterio", f"reading {path.suffix.lower()} needs", "geo")
    try:
        with warnings.catch_warnings(), utf8_name(path) as name:
            warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
            warnings.simplefilter("ignore", PendingDeprecationWarning)  # of its windows' own arithmetic
            with rasterio.open(name, driver=_driver(path)) as dataset:
                yield dataset
    except rasterio.errors.RasterioError as error:
        raise FileError(f"it is cut off, damaged or of another kind: {error.__cause__ or error}") from error


def _driver(path: Path) -> str:
    driver = DRIVERS[path.suffix.lower()]
    if driver in ("EHdr", "HFA"):  # endings that ENVI uses too
        for header in (path.with_suffix(".hdr"), path.with_name(f"{path.name}.hdr")):
            if header.is_file() and header.read_bytes().startswith(b"ENVI"):
                return "ENVI"
    if driver == "HFA":  # NASA's Planetary Data System uses the ending .img, too
        with path.open("rb") as file:
            return "PDS" if b"PDS_VERSION_ID" in file.read(1024) else driver
    return driver
