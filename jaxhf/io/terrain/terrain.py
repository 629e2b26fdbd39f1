"""Heights on the host, with their spacing, origin and reference system."""

import dataclasses
import math
import re
import warnings
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import DTypeLike

from ...core.errors import ArgumentError
from ...core.precision import WORTH_A_WARNING, fitted, numbers, rounding
from ...core.rules import finite, positive, require
from ..errors import FileError
from .georeference import (
    WGS84,
    WGS84_DEGREES,
    CoordinateSystem,
    Ellipsoid,
    Georeference,
    coordinate_system,
    geographic,
    metres_per_degree,
    on_globe,
)
from .parts import Box, Window, places_in_window, places_within

if TYPE_CHECKING:
    from ...scene.heightfield import Heightfield

Nodata = Callable[[float | None], float | None]  # what means no height, where a file names this value, or none, for it


@dataclasses.dataclass(frozen=True, eq=False)
class Terrain:
    """Heights on a regular grid, in NumPy; the caller's own array, not a copy, where it is of one of these kinds.

    Attributes:
      heights: shape (ny, nx), float32 or float64, row 0 in the south, column 0 in the west; nan where there is no data,
        and where they are masked.
      dx, dy: cell size, in the unit of x and y.
      x0, y0: where vertex (0, 0), the one in the south-west, stands.
      crs: the reference system of x and y; None: the four numbers above are not known, but assumed.
      georeference: how x and y become the coordinates of the file that the heights are from; None: it has none. It goes with
        the heights into GeoTIFF and .npz files, also those of a part of the grid, if x0 and y0 say which.
    """

    heights: Float[np.ndarray, "ny nx"]
    dx: float = 1.0
    dy: float = 1.0
    x0: float = 0.0
    y0: float = 0.0
    crs: CoordinateSystem | None = None
    georeference: Georeference | None = None

    def __post_init__(self):
        object.__setattr__(self, "heights", numbers(self.heights))
        if self.heights.ndim != 2 or min(self.heights.shape) < 2:
            raise ArgumentError("", "heights", f"must have shape (ny, nx) of at least 2x2, theirs is {self.heights.shape}")
        for name in ("dx", "dy", "x0", "y0"):
            require("", name, getattr(self, name), positive if name in ("dx", "dy") else finite)

    @classmethod
    def from_xarray(cls, array: Any, nodata: float | None = None) -> "Terrain":
        """The terrain in a `DataArray` of xarray, or of rioxarray with its reference system.

        Its dimensions are y and x, northing and easting, or lat and lon, in any order and either direction, besides those of
        length 1, with evenly spaced coordinates. The reference system and the value of holes are those of its `rio` accessor,
        else of CF's `spatial_ref` coordinate and of `_FillValue`; lat and lon without a system are WGS84. Degrees become metres
        as in `load_heights`.

        Args:
          array: read by its `dims`, `coords`, `values` and `attrs`; xarray is not needed.
          nodata: a value that means no height; overrules the array's.

        Raises:
          ValueError: `array` is no DataArray, or has other dimensions, or no coordinates, or they are not evenly spaced.
        """
        owner = "Terrain.from_xarray"
        if not all(hasattr(array, name) for name in ("dims", "coords", "values", "attrs")) or callable(array.values):
            raise ArgumentError(owner, "array", f"must be an xarray.DataArray, it is a {type(array).__name__}")
        values = np.asarray(array.values)
        names = [str(name) for name, size in zip(array.dims, values.shape, strict=True) if size > 1]
        axes = [axis for words in _AXES for axis in range(len(names)) if names[axis].lower() in words]
        if len(names) != 2 or len(axes) != 2:
            raise ArgumentError(owner, "array", f"must have dimensions y and x, or lat and lon, it has {tuple(array.dims)}")
        values = values.squeeze().transpose(axes)
        (y0, dy), (x0, dx) = (_even(owner, array, names[axis]) for axis in axes)
        values = values[:: 1 if dy > 0 else -1, :: 1 if dx > 0 else -1]
        x0, y0 = min(x0, x0 + (values.shape[1] - 1) * dx), min(y0, y0 + (values.shape[0] - 1) * dy)
        rio, attrs, reference = getattr(array, "rio", None), array.attrs, array.coords.get("spatial_ref")
        found = getattr(rio, "crs", None)
        wkt = "" if reference is None else str(reference.attrs.get("crs_wkt", ""))
        wkt = found.to_wkt() if found else wkt
        if not wkt and names[axes[0]].lower() in _AXES[0][2:]:
            wkt = WGS84_DEGREES
        own = getattr(rio, "nodata", None)
        own = attrs.get("_FillValue") if own is None else own
        nodata = nodata if nodata is not None or own is None else float(own)
        heights = heights_of(values, nodata, float(attrs.get("scale_factor", 1)), float(attrs.get("add_offset", 0)))
        crs = coordinate_system(wkt)
        return cls(heights, abs(dx), abs(dy), x0, y0, crs, Georeference(wkt, nodata=nodata)).in_metres()

    @property
    def nodata(self) -> Bool[np.ndarray, "ny nx"]:
        """Where there is no height: bool, shape (ny, nx)."""
        return np.isnan(self.heights)

    @property
    def rotation(self) -> float:
        """By how much its y axis points clockwise of its file's, degrees: 0 but for rotated rasters.

        An azimuth from the north of a map minus this counts from the y axis.
        """
        return self.georeference.rotation if self.georeference else 0.0

    @property
    def file_from_terrain(self) -> Float[np.ndarray, "2 3"]:
        """The affine map of x, y and 1 to the coordinates of its file, which may be degrees."""
        place = self.georeference or Georeference()
        turn = math.radians(place.rotation)
        rotated = np.array([[math.cos(turn), math.sin(turn)], [-math.sin(turn), math.cos(turn)]])
        return np.column_stack([rotated * place.scale, place.offset])

    @property
    def in_file(self) -> tuple[float, float, float, float]:
        """Its dx, dy, x0 and y0 in the coordinates of its file, which may be degrees."""
        scale_x, scale_y = self.georeference.scale if self.georeference else (1.0, 1.0)
        x0, y0 = self.file_from_terrain @ (self.x0, self.y0, 1)
        return float(scale_x * self.dx), float(scale_y * self.dy), float(x0), float(y0)

    def geotransform(self, pixel: float = 0.5) -> tuple[float, ...]:
        """The six numbers of its Affine in rasterio: of columns and rows, the northern one first, to its file's coordinates.

        Column 0 and row 0 stand for the corner of the first pixel, or with 0 for `pixel` for its centre.
        """
        (right, up), ny = (self.file_from_terrain[:, :2] * (self.dx, self.dy)).T, len(self.heights)
        corner = self.in_file[2:] - pixel * right + (ny - 1 + pixel) * up
        return tuple((np.column_stack([right, -up, corner]) + 0.0).ravel().tolist())  # + 0.0: none is -0.0

    def require_unrotated(self, name: str = "it") -> None:
        """ValueError where its rows and columns do not lie along its file's x and y."""
        if self.rotation:
            rule = f"{name} must lie along x and y (gdalwarp makes it so)"
            raise FileError(f"{rule}; the raster is rotated by {self.rotation:.6g} degrees")

    @property
    def place(self) -> tuple[float, float]:
        """The latitude and longitude of its middle, degrees, as `sun` and lights by date take them: `Sun.at(time, *place)`.

        ValueError where its georeference does not say; where x and y are lengths on a map, that needs rasterio.
        """
        (ny, nx), wkt = self.heights.shape, self.georeference.wkt if self.georeference else ""
        middle = self.x0 + (nx - 1) / 2 * self.dx, self.y0 + (ny - 1) / 2 * self.dy
        x, y = (self.file_from_terrain @ (*middle, 1)).tolist()
        latitude, longitude = geographic(wkt, x, y) if wkt else (math.nan, math.nan)
        if not (-90 <= latitude <= 90 and -360 <= longitude <= 360):
            found = f"it is in {self.georeference.name}" if self.georeference and wkt else "it has no georeference"
            raise ArgumentError("Terrain", "place", f"must be given as latitude and longitude, {found}")
        return latitude, longitude

    @property
    def convergence(self) -> float:
        """By how much its y axis points clockwise of true north at its middle, degrees; needs rasterio.

        An azimuth from true north, as of `sun` and of pictures' metadata, minus this counts from the y axis. nan where its
        georeference does not say.
        """
        (ny, nx), step = self.heights.shape, 1e-3 * (len(self.heights) - 1) * self.dy
        y = self.y0 + (ny - 1) / 2 * self.dy + step * np.array([-1, 1])
        latitude, longitude, _ = self.geodetic(self.x0 + (nx - 1) / 2 * self.dx, y, 0)
        east = (longitude[1] - longitude[0] + 180) % 360 - 180
        per_east, per_north = metres_per_degree(float(latitude.mean()))
        return math.degrees(math.atan2(east * per_east, (latitude[1] - latitude[0]) * per_north))

    @property
    def turned_from_north(self) -> float:
        """`convergence`, and `rotation` where that is not known or y counts in degrees, to the north."""
        wkt = self.georeference.wkt if self.georeference else ""
        if not wkt or coordinate_system(wkt).degrees:
            return self.rotation
        return float(np.nan_to_num(self.convergence, nan=self.rotation))

    def geodetic(self, x: Any, y: Any, z: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Latitudes and longitudes of points in its x and y, degrees, and z in metres; needs rasterio.

        On WGS84, or on the globe of another body; nan where its georeference does not say. z is in the unit of its heights, and
        counts from their zero.
        """
        place = self.georeference or Georeference()
        x, y, z = np.broadcast_arrays(*(np.asarray(values, np.float64) for values in (x, y, z)))
        x, y = (a * x + b * y + c for a, b, c in self.file_from_terrain)
        latitude, longitude = on_globe(place.wkt, x, y) if place.wkt else (x + np.nan, y + np.nan)
        feet = re.search(r"foot|feet|\bft", (place.height_unit or place.unit).lower())
        return latitude, longitude, z * (0.3048 if feet else 1)

    def heightfield(self, dtype: DTypeLike | None = None) -> "Heightfield":
        """The surface, to be rendered.

        Args:
          dtype: of its heights, float32 or float64; None: the terrain's own, or float32 where JAX's x64 mode is off.

        Raises:
          ValueError: heights do not fit into `dtype`, or there are more than a `Heightfield` holds.
        """
        from ...scene.heightfield import Heightfield  # with JAX, which converting a file does without

        heights = self.heights if dtype is None else fitted(self.heights, dtype)
        return Heightfield(heights, self.dx, self.dy, self.x0, self.y0)

    def within(self, box: Box | None, window: Window | None = None) -> "Terrain":
        """The heights that stand within west, south, east and north, in the coordinates of its file, or in a window of it."""
        return self.cut(*self.places(box, window))

    def cut(self, rows: slice, columns: slice) -> "Terrain":
        """Its heights in these rows and columns, counted from vertex (0, 0), where they stand."""
        corner = self.x0 + columns.start * self.dx, self.y0 + rows.start * self.dy
        return dataclasses.replace(self, heights=self.heights[rows, columns], x0=corner[0], y0=corner[1])

    def places(
        self, box: Box | None, window: Window | None, north_first: bool = True, east_first: bool = False
    ) -> tuple[slice, slice]:
        """The rows and columns that `within` takes; a window counts from where the file begins, which these say."""
        dx, dy, x0, y0 = self.in_file
        if window is None:
            if box is not None:
                self.require_unrotated("a terrain that bbox cuts (window cuts any)")
            return places_within(box, self.heights.shape, (x0, y0), (dx, dy))
        if box is not None:
            raise FileError(f"bbox or window must say which heights are taken, not both: {box} and {window}")
        return places_in_window(window, self.heights.shape, north_first, east_first)

    def in_metres(self, **given: float) -> "Terrain":
        """The terrain with degrees turned into metres from vertex (0, 0), and then with `given` for its dx, dy, x0 and y0."""
        crs, grid = self.crs, {"dx": self.dx, "dy": self.dy, "x0": self.x0, "y0": self.y0}
        if crs is not None and crs.degrees:
            if not (-360 <= self.x0 <= 360 and -90 <= self.y0 <= 90):
                corner = f"the south-western corner is at longitude {self.x0}, latitude {self.y0}"
                raise FileError(f"degrees must lie on a globe, {corner}")
            if crs.globe is None and not {"dx", "dy"} <= given.keys():
                raise FileError("its degrees are on a globe of unknown size: dx and dy must be given, in metres")
            middle = self.y0 + (len(self.heights) - 1) / 2 * self.dy
            along_x, along_y = metres_per_degree(middle, crs.globe or WGS84)
            if "dx" not in given:
                _warn_of_many_latitudes(self.y0, 2 * middle - self.y0, crs.globe or WGS84)
            crs, grid = CoordinateSystem(), {"dx": self.dx * along_x, "dy": self.dy * along_y, "x0": 0.0, "y0": 0.0}
        if grid.keys() <= given.keys():
            crs = crs or CoordinateSystem()
        grid, place = {name: float(value) for name, value in {**grid, **given}.items()}, self.georeference
        if place is not None and min(grid["dx"], grid["dy"]) > 0:
            dx, dy, x0, y0 = self.in_file
            place = place._replace(scale=(dx / grid["dx"], dy / grid["dy"]), offset=(0.0, 0.0))
            corner = dataclasses.replace(self, **grid, georeference=place).in_file[2:]
            place = place._replace(offset=(x0 - corner[0], y0 - corner[1]))
        return dataclasses.replace(self, **grid, crs=crs, georeference=place)


def _warn_of_many_latitudes(south: float, north: float, globe: Ellipsoid) -> None:
    """UserWarning where a degree of longitude, measured in the middle, is far from that at an end."""
    middle = (south + north) / 2
    here, *ends = (metres_per_degree(latitude, globe)[0] for latitude in (middle, south, north))
    off = max(abs(end / here - 1) for end in ends) if here else 0.0
    if off > _FAR_OFF:
        warnings.warn(
            f"degrees from latitude {south:.4g} to {north:.4g} are measured in metres at {middle:.4g}: farther north or south "
            f"a column's width is off by up to {100 * off:.0f} % (gdalwarp projects a terrain)",
            stacklevel=3,
        )


_FAR_OFF = 0.05
_AXES = ("y", "northing", "lat", "latitude"), ("x", "easting", "lon", "longitude")


def _even(owner: str, array: Any, name: str) -> tuple[float, float]:
    """The first coordinate along a dimension, and the step."""
    if name not in array.coords:
        raise ArgumentError(owner, "array", f"must have coordinates along {name}")
    stored = np.asarray(array.coords[name].values)
    values = stored.astype(np.float64)
    step = (values[-1] - values[0]) / (len(values) - 1)
    noise = 4 * np.finfo(stored.dtype if stored.dtype.kind == "f" else np.float64).eps * np.abs(values).max()
    steps = np.diff(values)
    if not np.abs(steps - step).max() <= max(1e-3 * abs(step), noise):
        rule = f"must have evenly spaced coordinates along {name}, their steps go from {steps.min()} to {steps.max()}"
        raise ArgumentError(owner, "array", rule)
    return float(values[0]), float(step)


def heights_of(values: np.ndarray, nodata: float | None, scale: float = 1.0, offset: float = 0.0) -> Float[np.ndarray, "ny nx"]:
    """Stored values as heights: value * scale + offset, in float32 where that holds the values exactly and moves no height by
    more than a thousandth of the relief, else in float64.

    What is not finite, and what equals `nodata`, becomes nan.
    """
    if values.dtype.kind not in "fiu":
        raise FileError(f"heights must be numbers, they are {values.dtype}")
    if values.ndim != 2:
        raise FileError(f"heights must have shape (ny, nx), theirs is {values.shape}")
    exact_in_float32 = values.dtype.itemsize <= (4 if values.dtype.kind == "f" else 2)
    heights = values.astype(np.float32 if exact_in_float32 else np.float64)
    holes = ~np.isfinite(heights)
    if nodata is not None:
        # Compared in the file's own precision: a tag may say -3.4028235e+38 for the lowest float32.
        with np.errstate(over="ignore"):
            holes |= values == (values.dtype.type(nodata) if values.dtype.kind == "f" else nodata)
    heights[holes] = np.nan
    if (scale, offset) != (1, 0):
        scaled = heights.astype(np.float64) * scale + offset
        heights = scaled if rounding(scaled, heights.dtype) > WORTH_A_WARNING else scaled.astype(heights.dtype)
    return heights
