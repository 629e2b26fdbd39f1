"""Where on a map, or in degrees on a globe, the vertices of a grid stand."""

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from .errors import FileError


class Ellipsoid(NamedTuple):
    """A globe: its equatorial radius in metres, and the share by which the polar one is shorter."""

    axis: float
    flattening: float


WGS84 = Ellipsoid(6378137.0, 1 / 298.257223563)


def metres_per_degree(latitude: float, globe: Ellipsoid = WGS84) -> tuple[float, float]:
    """The lengths of a degree of longitude and of latitude.

    Snyder, Map Projections: A Working Manual (USGS Professional Paper 1395, 1987), equations 4-21 and 4-19.
    """
    axis, flattening = globe
    squared = flattening * (2 - flattening)  # the eccentricity's square
    phi = math.radians(latitude)
    w = 1 - squared * math.sin(phi) ** 2
    return math.radians(axis * math.cos(phi) / math.sqrt(w)), math.radians(axis * (1 - squared) / w**1.5)


class Place(NamedTuple):
    """What a file says about the place of its heights; None: nothing.

    Attributes:
      dx, dy: cell size.
      x0, y0: where vertex (0, 0) stands.
      degrees: whether all of these are degrees of longitude and latitude.
      globe: that they are measured on; None: it is not known.
      system: the EPSG code of the coordinates.
    """

    dx: float | None = None
    dy: float | None = None
    x0: float | None = None
    y0: float | None = None
    degrees: bool = False
    globe: Ellipsoid | None = None
    system: int | None = None

    @property
    def known(self) -> bool:
        return None not in (self.dx, self.dy, self.x0, self.y0)

    @property
    def sides(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """(y0, dy), (x0, dx), where the place is known."""
        y0, dy, x0, dx = (math.nan if value is None else value for value in (self.y0, self.dy, self.x0, self.dx))
        return (y0, dy), (x0, dx)

    def with_metres(self, rows: int, given: Mapping[str, float]) -> "Place":
        """The place in a scene: `given` overrules the file, and degrees become metres from vertex (0, 0)."""
        if not self.degrees:
            return self._replace(**given)
        (south, dy), (west, dx) = self.sides
        if not (-360 <= west <= 360 and -90 <= south <= 90):
            raise FileError(f"degrees must lie on a globe, the south-western corner is at longitude {west}, latitude {south}")
        if self.globe is None and not {"dx", "dy"} <= given.keys():
            raise FileError("its degrees are on a globe of unknown size: dx and dy must be given, in metres")
        along_x, along_y = metres_per_degree(south + (rows - 1) / 2 * dy, self.globe or WGS84)
        return Place(dx * along_x, dy * along_y, 0.0, 0.0)._replace(**given)


def at_vertices(
    heights: Float[np.ndarray, "my mx"], place: Place, wanted: Place, shape: tuple[int, ...]
) -> Float[np.ndarray, "ny nx"]:
    """The bilinear surface through `heights` at the vertices of another grid, in the same coordinates.

    Half a cell beyond the outermost vertices, as far as pixels reach, the outermost heights hold: the centres of a coarse
    raster's pixels lie further inside than those of a fine one with the same corners.

    Args:
      heights: nan where there is none; so are vertices with a share in them.
      place: theirs.
      wanted: the place of the other grid; both are known.
      shape: the other grid's.

    Raises:
      FileError: the other grid goes further, or its coordinates are of another system.
    """
    if None not in (place.system, wanted.system) and place.system != wanted.system:
        raise FileError(f"it must have the terrain's coordinates, EPSG:{wanted.system}; it has EPSG:{place.system}")
    turns = 0
    if place.degrees:  # longitudes may count from -180 or from 0
        turns = round((_middle(wanted.sides[1], shape[1]) - _middle(place.sides[1], heights.shape[1])) / 360)
    names = ("latitude", "longitude") if place.degrees else ("y", "x")
    for axis, ((first, step), (other, other_step)) in enumerate(zip(place.sides, wanted.sides, strict=True)):
        count, others = heights.shape[axis], shape[axis]
        first = first + 360 * turns * axis
        at = (other - first) / step + np.arange(others) * (other_step / step)  # in its cells
        vertex = np.rint(at)
        at = np.where(np.abs(at - vertex) < 1e-6, vertex, at)  # without a share in the next one, which may be a hole
        if at[0] < -0.5 or at[-1] > count - 0.5:
            last, others_last = first + (count - 1) * step, other + (others - 1) * other_step
            raise FileError(
                f"it must cover the terrain, whose {names[axis]} goes from {other:.10g} to {others_last:.10g}; "
                f"its own goes from {first:.10g} to {last:.10g}"
            )
        at = np.clip(at, 0, count - 1)
        low, high = np.floor(at).astype(int), np.ceil(at).astype(int)
        share = np.expand_dims(at - low, 1 - axis)
        heights = (1 - share) * np.take(heights, low, axis) + share * np.take(heights, high, axis)
    return heights


def _middle(side: tuple[float, float], count: int) -> float:
    return side[0] + (count - 1) / 2 * side[1]
