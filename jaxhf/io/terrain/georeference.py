"""What the coordinates of a terrain file mean: lengths on a map, or degrees on a globe."""

import importlib
import math
import re
from typing import NamedTuple

import numpy as np

from ...core.extras import import_extra
from ..errors import FileError


class Ellipsoid(NamedTuple):
    """A globe: its equatorial radius in metres, and the share by which the polar one is shorter."""

    axis: float
    flattening: float


WGS84 = Ellipsoid(6378137.0, 1 / 298.257223563)
WGS84_DEGREES = (
    'GEOGCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",6378137,298.257223563,AUTHORITY["EPSG","7030"]],'
    'AUTHORITY["EPSG","6326"]],PRIMEM["Greenwich",0,AUTHORITY["EPSG","8901"]],'
    'UNIT["degree",0.0174532925199433,AUTHORITY["EPSG","9122"]],AUTHORITY["EPSG","4326"]]'
)


class CoordinateSystem(NamedTuple):
    """The reference system of x and y."""

    degrees: bool = False  # of longitude and latitude, or lengths
    globe: Ellipsoid | None = None  # on which the degrees are measured; None: it is not known
    code: int | None = None  # of EPSG; None: it is not known


class Georeference(NamedTuple):
    """Where a terrain lies in the coordinates of its file: scale * terrain, for x and for y, then rotated, and plus offset."""

    wkt: str = ""  # the file's reference system as well-known text (ISO 19162, or GDAL's older form); "": not known
    scale: tuple[float, float] = (1.0, 1.0)
    offset: tuple[float, float] = (0.0, 0.0)
    nodata: float | None = None  # the stored value that means no height there
    point: bool = False  # whether a pixel is said to be one, PixelIsPoint in GeoTIFF; a height stands at its centre either way
    z_unit: str = ""  # of the heights, where the file names it apart from its reference system
    rotation: float = 0.0  # degrees by which the terrain's y axis points clockwise of the file's

    @property
    def name(self) -> str:
        """That of the reference system, "" where it is not known."""
        found = re.search(r'"([^"]*)"', self.wkt)
        return found[1] if found and found[1] not in ("unnamed", "unknown") else ""

    @property
    def unit(self) -> str:
        """The name of the unit of x and y, "" where it is not known."""
        return _unit(_horizontal(self.wkt))

    @property
    def height_unit(self) -> str:
        """The name of the unit of heights, "" where it is not known."""
        return self.z_unit or _unit(self.wkt[len(_horizontal(self.wkt)) :])


def _unit(wkt: str) -> str:
    """The name of the last unit in well-known text."""
    found = re.findall(r'\b(?:ANGLE|LENGTH)?UNIT\["([^"]*)"', wkt)
    return found[-1] if found and found[-1] != "unknown" else ""


_GEOGRAPHIC = r'\s*(?:COMP\w*\["[^"]*",\s*)?(?:GEOGCS|GEOGCRS|GEODCRS|GEOGRAPHICCRS|GEODETICCRS)\b'


def _horizontal(wkt: str) -> str:
    """The part of well-known text that is not about heights, without what closes it."""
    return re.split(r"VERT_?C\w*\[", wkt)[0].rstrip(", \n]")


def coordinate_system(wkt: str) -> CoordinateSystem:
    """What well-known text says, in either form, of the horizontal coordinates, whose angles must be degrees; "": lengths."""
    horizontal = _horizontal(wkt)
    code = re.search(r'(?:AUTHORITY|\bID)\["EPSG",\s*"?(\d+)"?$', horizontal)
    number = int(code[1]) if code else None
    if not re.match(_GEOGRAPHIC, wkt):
        return CoordinateSystem(code=number)
    units = re.findall(r'\b(?:ANGLE)?UNIT\["([^"]*)",\s*([-+.\deE]+)', horizontal)
    if units and not math.isclose(float(units[-1][1]), math.pi / 180, rel_tol=1e-6):
        raise FileError(f"its coordinates must be in degrees, their unit is {units[-1][0]}")
    return CoordinateSystem(True, _globe(horizontal), number)


def geographic(wkt: str, x: float, y: float) -> tuple[float, float]:
    """The latitude and longitude of a point in a reference system, degrees, see `on_globe`; not finite where it has none."""
    if re.match(_GEOGRAPHIC, wkt):
        return y, x
    latitude, longitude = on_globe(wkt, np.array(x), np.array(y))
    return float(latitude), float(longitude)


def on_globe(wkt: str, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Latitudes and longitudes of points in a reference system, degrees: on WGS84, or on the globe of another body; nan where
    it has none."""
    globe = _globe(wkt) or WGS84
    earth = math.isclose(globe.axis, WGS84.axis, rel_tol=0.01)
    target = "EPSG:4326" if earth else f"+proj=longlat +a={globe.axis} +f={globe.flattening} +no_defs"
    rasterio = import_extra("rasterio", "finding the latitude and longitude of a terrain needs", "geo")
    warp = importlib.import_module("rasterio.warp")
    try:
        longitude, latitude = warp.transform(rasterio.crs.CRS.from_wkt(wkt), target, x.ravel(), y.ravel())
    except rasterio.errors.RasterioError:  # a local system has no place on the globe
        return np.full(x.shape, np.nan), np.full(x.shape, np.nan)
    return np.reshape(latitude, x.shape), np.reshape(longitude, x.shape)


def _globe(wkt: str) -> Ellipsoid | None:
    found = re.search(r'(?:SPHEROID|ELLIPSOID)\["([^"]*)",\s*([-+.\deE]+),\s*([-+.\deE]+)', wkt)
    if found is None or found[1].startswith("unretrievable"):  # GDAL's word where a GeoTIFF names none
        return None
    axis, inverse = float(found[2]), float(found[3])
    if not (axis > 0 and (inverse == 0 or inverse > 1)):  # 0: a sphere
        raise FileError(f"its ellipsoid must be flattened by 0 to 1, its axis is {axis} m, its inverse flattening {inverse}")
    return Ellipsoid(axis, 1 / inverse if inverse else 0.0)


def metres_per_degree(latitude: float, globe: Ellipsoid = WGS84) -> tuple[float, float]:
    """The lengths of a degree of longitude and of latitude.

    Snyder, Map Projections: A Working Manual (USGS Professional Paper 1395, 1987), equations 4-21 and 4-19.
    """
    axis, flattening = globe
    squared = flattening * (2 - flattening)  # the eccentricity's square
    phi = math.radians(latitude)
    w = 1 - squared * math.sin(phi) ** 2
    return math.radians(axis * math.cos(phi) / math.sqrt(w)), math.radians(axis * (1 - squared) / w**1.5)


def corners_said(begin: tuple[float, float], step: tuple[float, float], count: tuple[int, int], rotation: float) -> str:
    """Where the outermost vertices of a rotated grid stand, in words.

    Vertex (0, 0) stands at `begin`, rows and columns are `step` apart in x and y, and y of the grid points `rotation` degrees
    clockwise of the map's.
    """
    cos, sin = math.cos(math.radians(rotation)), math.sin(math.radians(rotation))
    sides = (np.array(count) - 1) * step
    corners = np.array([(0, 0), (1, 0), (1, 1), (0, 1)]) * sides @ [(cos, -sin), (sin, cos)] + begin
    side = "clockwise" if rotation > 0 else "counterclockwise"
    said = ", ".join(f"{x:.10g} {y:.10g}" for x, y in corners)
    return f"x and y of the corners {said}, rotated by {abs(rotation):.6g} degrees {side}"
