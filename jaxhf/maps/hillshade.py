"""Hillshades: how light a map's surface is under a distant light, in GDAL's bytes."""

import math
import warnings
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, UInt8

from ..core.errors import ArgumentError
from ..core.rules import OneOf, require
from .choices import ALGORITHMS, VARIANTS
from .shadows import lit
from .surface import Heights, require_positive, rotation_of, surface
from .windows import Window, differences, over_windows, spans

_SHADOW = 1  # the darkest byte that is not nodata

_Values = Float[np.ndarray, "k m"]


def hillshade(
    heights: Heights,
    dx: float | None = None,
    dy: float | None = None,
    *,
    azimuth: float = 315.0,
    altitude: float = 45.0,
    z_factor: float = 1.0,
    scale: float | None = None,
    algorithm: str = "horn",
    variant: str = "regular",
    compute_edges: bool = False,
    shadows: bool = False,
) -> UInt8[np.ndarray, "ny nx"]:
    """Shaded relief of shape (ny, nx), uint8: 1 (dark) to 255 (bright), 0 where there is no value; as `gdaldem hillshade`'s.

    A shade whose exact value lies within 5e-5 of the middle between two bytes may come out one apart from GDAL's, which
    takes the reciprocal square root from the processor's estimate of 12 bits.

    Args:
      heights: shape (ny, nx), row 0 in the south, nan where there is none; or a `Terrain`.
      dx, dy: the spacing; None: a terrain's own; an array must have one, which counts for both.
      azimuth: of the light, degrees clockwise from north; without a meaning in "multidirectional".
      altitude: of the light, degrees above the horizon; without a meaning in "igor".
      z_factor: heights are multiplied by it.
      scale: vertical units in a horizontal one; None: 1, and a terrain in degrees is measured in metres at its middle latitude.
      algorithm: of the slope: "horn" (eight neighbours) or "zevenbergen-thorne" (four: smooth terrain).
      variant: "regular": the cosine between surface and light; "combined": that darkened by the slope; "multidirectional":
        lights from 225, 270, 315 and 360 degrees, weighted by the aspect (Mark, USGS Open-File Report 92-422, 1992); "igor":
        shadows as weak as the slope, on white (Brejc, Maperitive).
      compute_edges: also at the border and beside holes, where otherwise there is no value.
      shadows: what the surface keeps the light from is 1, whatever the variant.

    Raises:
      ArgumentError: a number is out of range, a name unknown, or there is no height.
    """
    owner = "hillshade"
    require(owner, "algorithm", algorithm, OneOf(ALGORITHMS))
    require(owner, "variant", variant, OneOf(VARIANTS))
    require_light(owner, azimuth, altitude)
    require_positive(owner, "z_factor", z_factor)
    rotation = rotation_of(heights)
    azimuth = azimuth - rotation  # from the y axis
    ground = surface(owner, heights, dx, dy, scale)
    z_scaled, formula = z_factor / (spans(algorithm) * ground.scale), _FORMULAE[variant]
    light = _Light(ground.dx, ground.dy, z_scaled, math.radians(azimuth), math.radians(altitude), algorithm, rotation)

    def shade(window: Window) -> UInt8[np.ndarray, "k m"]:
        values = formula(light, window).astype(np.float32) + np.float32(0.5)
        return np.clip(values, 0, 255).astype(np.uint8)

    result = over_windows(ground.heights, shade, compute_edges, np.uint8(0))
    if shadows:
        relief = z_factor / ground.scale
        dark = ~lit(ground.heights, ground.dx / relief, ground.dy / relief, azimuth, altitude)
        result[dark & (result > 0)] = _SHADOW
    return result


def require_light(owner: str, azimuth: float, altitude: float) -> None:
    """ArgumentError where the light is not above the horizon; a warning where its altitude is beyond the zenith."""
    if not math.isfinite(azimuth):
        raise ArgumentError(owner, "azimuth", f"must be finite, it is {azimuth}")
    if not 0 < altitude < 180:
        raise ArgumentError(owner, "altitude", f"must be above 0 and at most 90 degrees, it is {altitude}")
    if altitude > 90:
        warnings.warn(
            f"{owner}: altitude is beyond 90 degrees, {altitude}: the light stands opposite the azimuth, {180 - altitude} high",
            stacklevel=3,
        )


class _Light(NamedTuple):
    """A light over cells. Differences of heights over `spans` cells are multiplied by `z_scaled`; angles are in radians."""

    dx: float
    dy: float
    z_scaled: float
    azimuth: float
    altitude: float
    algorithm: str
    rotation: float  # see `Terrain.rotation`

    def slopes(self, window: Window) -> tuple[_Values, _Values]:
        """The rise from east to west and, rows being counted to the south, from south to north; over `spans` cells."""
        west, south = differences(window, self.algorithm)
        return west * np.float64(1 / self.dx), south * np.float64(-1 / self.dy)


def _regular(light: _Light, window: Window) -> _Values:
    """1 + 254 max(0, n . l); in GDAL's order of the sums, which is another in square cells."""
    z_scaled, overhead, level = light.z_scaled, 254 * math.sin(light.altitude), math.cos(light.altitude) * light.z_scaled
    east, north = 254 * (math.sin(light.azimuth) * level), 254 * (math.cos(light.azimuth) * level)
    if light.algorithm == "horn" and light.dx == light.dy:
        per_cell = 1 / light.dx
        east, north, steep = east * per_cell, north * per_cell, z_scaled**2 * per_cell * per_cell
        nw, n, ne, w, _, e, sw, s, se = window
        falling, rising, middle_x, middle_y = nw - se, sw - ne, w - e, n - s
        x = (falling + middle_x + middle_x + rising).astype(np.float64)
        y = (falling + middle_y + middle_y - rising).astype(np.float64)
        return 1 + np.maximum((overhead + (x * east - y * north)) / np.sqrt(1 + steep * (x * x + y * y)), 0)
    x, y = light.slopes(window)
    return 1 + np.maximum((overhead - (y * north - x * east)) / np.sqrt(1 + z_scaled**2 * (x * x + y * y)), 0)


def _combined(light: _Light, window: Window) -> _Values:
    overhead, level = math.sin(light.altitude), math.cos(light.altitude) * light.z_scaled
    east, north = math.sin(light.azimuth) * level, math.cos(light.azimuth) * level
    x, y = light.slopes(window)
    steep = (x * x + y * y) * light.z_scaled**2
    cosine = (overhead - (y * north - x * east)) / np.sqrt(1 + steep)
    angle = np.arccos(np.clip(cosine, -1, 1))
    return 1 + 254 * np.maximum(1 - angle * np.arctan(np.sqrt(steep)) / (math.pi / 2) ** 2, 0)


def _multidirectional(light: _Light, window: Window) -> _Values:
    overhead, level = 127 * math.sin(light.altitude), 127 * math.cos(light.altitude) * light.z_scaled
    diagonal = level * math.cos(math.radians(225))
    x, y = light.slopes(window)
    if light.rotation:  # the azimuths are those of the map
        cos, sin = math.cos(math.radians(light.rotation)), math.sin(math.radians(light.rotation))
        x, y = x * cos - y * sin, x * sin + y * cos
    xx, yy = x * x, y * y
    both = xx + yy
    southwest = 0.5 * both - x * y
    lights = (
        southwest * np.maximum(overhead + (x - y) * diagonal, 0)
        + xx * np.maximum(overhead - x * level, 0)
        + (both - southwest) * np.maximum(overhead + (x + y) * diagonal, 0)
        + yy * np.maximum(overhead - y * level, 0)
    )
    flat = both == 0
    shade = lights / np.where(flat, 1, both) / np.sqrt(1 + light.z_scaled**2 * both)
    return 1 + np.where(flat, 2 * overhead, shade)


def _igor(light: _Light, window: Window) -> _Values:
    turn, towards = 2 * math.pi, (1.5 * math.pi - light.azimuth) % (2 * math.pi)
    x, y = light.slopes(window)
    west, south = (x, -y) if light.rotation else differences(window, light.algorithm)  # in which GDAL's cells are square
    slope = np.degrees(np.arctan(np.sqrt(x * x + y * y) * light.z_scaled)) / 90
    apart = np.abs(np.arctan2(south, west, dtype=np.float64) % turn - towards)
    apart = np.where(apart > math.pi, turn - apart, apart)
    return 255 * (1 - slope * (1 - apart / math.pi))


_FORMULAE: dict[str, Callable[[_Light, Window], _Values]] = dict(
    zip(VARIANTS, (_regular, _combined, _multidirectional, _igor), strict=True)
)
