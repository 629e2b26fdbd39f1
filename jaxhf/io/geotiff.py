"""GeoTIFF rasters of heights (OGC 19-008r4), and what GDAL adds to them."""

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..core.extras import import_extra
from .errors import FileError
from .files import require_pixels
from .georeference import WGS84, CoordinateSystem, Ellipsoid
from .terrain import Terrain, heights_of


def read_tiff(path: Path, nodata: float | None, overrules: bool) -> Terrain:
    """The heights in a .tif, in its own coordinates; `nodata` counts where the file names none, or where it `overrules`."""
    tifffile = import_tifffile("reading")
    with tifffile.TiffFile(path) as file:
        page: Any = file.pages[0]
        require_pixels(page.imagelength, page.imagewidth)
        if page.samplesperpixel != 1 or page.imagedepth != 1:
            raise FileError(f"heights in a TIFF must be one band, it has {page.samplesperpixel}")
        end = max((at + count for at, count in zip(page.dataoffsets, page.databytecounts, strict=True)), default=0)
        if end > path.stat().st_size:
            raise FileError(f"it is cut off: its pixels end at byte {end}, the file at {path.stat().st_size}")
        tagged = _gdal_nodata(page.tags[42113].value) if 42113 in page.tags else None
        nodata = tagged if nodata is None or (tagged is not None and not overrules) else nodata
        if nodata is not None and page.dtype.kind == "f":
            # tifffile fills absent tiles with it, but refuses the usual -3.4028235e+38, which rounds to below float32.
            with np.errstate(over="ignore"):
                page.nodata = page.dtype.type(nodata)
        factors = _gdal_factors(page.tags[42112].value) if 42112 in page.tags else {}
        heights = heights_of(page.asarray()[::-1], nodata, **factors)
        scale, tie, matrix = (page.tags[code].value if code in page.tags else None for code in (33550, 33922, 34264))
        if scale is not None and tie is not None:
            return _placed(heights, scale, tie, page.geotiff_tags or {})
        if scale is not None or tie is not None or matrix is not None:
            raise FileError("its GeoTIFF tags must be ModelPixelScale with ModelTiepoint: rotated rasters are not read")
        return Terrain(heights)


def import_tifffile(doing: str) -> Any:
    return import_extra("tifffile", f"{doing} .tif needs", "geo")


def _gdal_nodata(text: str) -> float:
    try:
        return float(text.strip("\0 "))
    except ValueError as error:
        raise FileError(f"its GDAL_NODATA tag must be a number, it is {text!r}") from error


def _gdal_factors(text: str | bytes) -> dict[str, float]:
    """Those of `scale` and `offset` that GDAL_METADATA, a tag of XML, gives for the first band."""
    text = text.encode() if isinstance(text, str) else text
    try:
        items = list(ElementTree.fromstring(text.strip(b"\0 ")).iter("Item"))
    except ElementTree.ParseError as error:
        raise FileError(f"its GDAL_METADATA tag must be XML: {error}") from error
    roles = {item.get("role"): item.text for item in items if item.get("sample", "0") == "0"}
    factors = {}
    for role in {"scale", "offset"} & roles.keys():
        try:
            factors[role] = float(roles[role] or "")
        except ValueError as error:
            raise FileError(f"the {role} in its GDAL_METADATA must be a number, it is {roles[role]!r}") from error
        if not math.isfinite(factors[role]):
            raise FileError(f"the {role} in its GDAL_METADATA must be finite, it is {factors[role]}")
    return factors


def _placed(heights: np.ndarray, scale: Sequence[float], tie: Sequence[float], keys: Mapping[str, Any]) -> Terrain:
    """The heights where the GeoTIFF tags put them (OGC 19-008r4, annex B.6).

    The tie point (column, row, _, x, y, _) and the pixel's size place the raster's corners, or its pixels' centres where
    GTRasterTypeGeoKey is 2, PixelIsPoint.
    """
    (dx, dy), (column, row, _, x, y, _) = scale[:2], tie[:6]
    centre = 0.0 if keys.get("GTRasterTypeGeoKey") == 2 else 0.5
    west, south = x + (centre - column) * dx, y - (len(heights) - 1 + centre - row) * dy
    degrees = keys.get("GTModelTypeGeoKey") == 2  # geographic
    if degrees and keys.get("GeogAngularUnitsGeoKey", 9102) not in (0, 9102, 9122):  # undefined, or EPSG's codes of degrees
        raise FileError(f"its coordinates must be in degrees, GeogAngularUnitsGeoKey is {int(keys['GeogAngularUnitsGeoKey'])}")
    code = keys.get("GeographicTypeGeoKey" if degrees else "ProjectedCSTypeGeoKey")
    code = None if code is None or code == _USER_DEFINED else int(code)
    crs = CoordinateSystem(degrees, _globe(keys) if degrees else None, code)
    return Terrain(heights, float(dx), float(dy), float(west), float(south), crs)


_USER_DEFINED = 32767


def _globe(keys: Mapping[str, Any]) -> Ellipsoid | None:
    """The ellipsoid of geographic coordinates; None where it is not known.

    Its axes say it. Else EPSG's codes are all of the Earth, for which WGS84 will do: the ellipsoids in use differ from it by
    0.02 % at most. They lie below 19000; those of the International Astronomical Union, for other bodies, above.
    """
    axis = keys.get("GeogSemiMajorAxisGeoKey")
    if axis is not None:
        polar, inverse = keys.get("GeogSemiMinorAxisGeoKey"), keys.get("GeogInvFlatteningGeoKey")
        if polar is None and inverse is None:
            return None
        flattening = 1 - polar / axis if inverse is None else 1 / inverse if inverse else 0.0  # GDAL: 0 is a sphere
        if not (axis > 0 and 0 <= flattening < 1):
            raise FileError(f"its ellipsoid must be flattened by 0 to 1, its axis is {axis} m, its flattening {flattening}")
        return Ellipsoid(float(axis), float(flattening))
    code = keys.get("GeographicTypeGeoKey", 4326)
    if code == _USER_DEFINED:
        code = keys.get("GeogEllipsoidGeoKey", _USER_DEFINED)
    return WGS84 if code < 19000 else None
