"""What the coordinates of a terrain file mean: lengths on a map, or degrees on a globe."""

import math
from typing import NamedTuple


class Ellipsoid(NamedTuple):
    """A globe: its equatorial radius in metres, and the share by which the polar one is shorter."""

    axis: float
    flattening: float


WGS84 = Ellipsoid(6378137.0, 1 / 298.257223563)


class CoordinateSystem(NamedTuple):
    """The reference system of x and y.

    Attributes:
      degrees: whether they are degrees of longitude and latitude, or lengths.
      globe: that the degrees are measured on; None: it is not known.
      code: the EPSG code; None: it is not known.
    """

    degrees: bool = False
    globe: Ellipsoid | None = None
    code: int | None = None


def metres_per_degree(latitude: float, globe: Ellipsoid = WGS84) -> tuple[float, float]:
    """The lengths of a degree of longitude and of latitude.

    Snyder, Map Projections: A Working Manual (USGS Professional Paper 1395, 1987), equations 4-21 and 4-19.
    """
    axis, flattening = globe
    squared = flattening * (2 - flattening)  # the eccentricity's square
    phi = math.radians(latitude)
    w = 1 - squared * math.sin(phi) ** 2
    return math.radians(axis * math.cos(phi) / math.sqrt(w)), math.radians(axis * (1 - squared) / w**1.5)
