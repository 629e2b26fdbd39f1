"""How much sunlight arrives at a terrain in a day, a month or a year."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.sharding import Mesh
from jaxtyping import Float

from ..core.errors import ArgumentError
from ..core.rules import OneOf, Whole, require
from ..core.types import AnyArray, ScalarLeaf
from ..io.terrain.georeference import coordinate_system
from ..io.terrain.terrain import Terrain
from ..preparation.crossings import even_azimuths
from ..preparation.horizon import Besides
from ..scene.sun import utc
from ..trace.normals import vertex_normals
from ..xla.compilation import compiled
from ..xla.devices import takes_numbers
from .choices import SUNLIGHT
from .horizons import field_of, map_over_horizons
from .sunlight import Suns, suns_of, through_air

_MOST_YEARS = 10
_MOST_TURBIDITY = 10.0


@takes_numbers
def insolation(
    terrain: Any,
    begin: Any,
    end: Any,
    place: tuple[float, float] | None = None,
    *,
    wanted: str = "energy",
    turbidity: float = 3.0,
    azimuths: int = 64,
    dx: float | None = None,
    dy: float | None = None,
    progress: Callable[[int, int], None] | None = None,
    mesh: Mesh | None = None,
) -> Float[jax.Array, "ny nx"]:
    """The energy that the sun and a cloudless sky send to each vertex in a time, kWh/m² of its own tilted surface.

    The terrain casts its shadows and hides the sky. Horizons are exact, as those of `horizon`, in so many azimuths; a sun
    between two of them counts with both. What is on its way through the air is after the European Solar Radiation Atlas
    (Rigollier, Bauer and Wald, On the clear sky model of the ESRA, Solar Energy 68(1), 2000), the sky is equally bright
    everywhere, and light that the terrain sends on to itself does not count. One place stands for the whole terrain. Where
    suns follow each other by a minute, or by a 2¹⁸th of long times, docs/measurements/maps.md has errors and times.

    Args:
      terrain: see `horizon`. Heights and cells in metres: the air is that above the sea.
      begin, end: a `datetime` with a time zone, or NumPy's datetime64 in UTC; ten years apart at most.
      place: latitude and longitude, degrees, north and east positive; None: those of a `Terrain`'s middle. Its y points to
        the north or, where its georeference says so, aside by its `convergence`.
      wanted: "energy", or its parts "direct" (from the sun) and "diffuse" (from the sky); "hours": for how long the sun
        shines there, hours.
      turbidity: how much haze and vapour the air holds, after Linke: 1 (clean and dry) to 10; mountains 2, lowlands 3 to 5.
      azimuths: how many directions, from north on at even steps.
      dx, dy, progress, mesh: see `horizon`.

    Returns:
      Shape (ny, nx), nan where there is no height; differentiable in the heights.

    Raises:
      ValueError: an argument has a value that it cannot have; a terrain does not say where it lies.
    """
    field = field_of("insolation", terrain, dx, dy)
    require("insolation", "wanted", wanted, OneOf(SUNLIGHT))
    require("insolation", "azimuths", azimuths, Whole(4))
    if not 1 <= turbidity <= _MOST_TURBIDITY:
        raise ArgumentError("insolation", "turbidity", f"must be from 1 to {_MOST_TURBIDITY:g}, it is {turbidity}")
    first, last = (utc("insolation", name, time) for name, time in (("begin", begin), ("end", end)))
    if first.shape or last.shape or not np.timedelta64(0) < last - first <= _MOST_YEARS * np.timedelta64(366, "D"):
        raise ArgumentError("insolation", "end", f"must come after begin, {begin}, by ten years at most, it is {end}")
    suns = suns_of(
        first[()], last[()], _place_of(terrain, place), _turned(terrain), float(turbidity), int(azimuths), wanted,
        field.heights.dtype,
    )  # fmt: skip
    ground = field.heights if isinstance(field.heights, jax.Array) else np.asarray(field.heights)
    besides = _besides(ground, suns, np.asarray(turbidity, ground.dtype), field.dx, field.dy)
    return map_over_horizons("insolation", "received", field, even_azimuths(int(azimuths)), 0.0, progress, mesh, besides)


@functools.partial(compiled, newer=True, static_argnames=("dx", "dy"))
def _besides(heights: Float[AnyArray, "ny nx"], suns: Suns, turbidity: ScalarLeaf, dx: float, dy: float) -> Besides:
    """What `received` takes besides the horizons."""
    there = jnp.isfinite(heights)
    lowest, highest = jnp.min(jnp.where(there, heights, jnp.inf)), jnp.max(jnp.where(there, heights, -jnp.inf))
    normals = vertex_normals(heights, dx, dy, "six")
    normals = normals / lax.stop_gradient(jnp.max(jnp.abs(normals), -1, keepdims=True))  # whose squares are numbers
    normals = normals / jnp.linalg.norm(normals, axis=-1, keepdims=True)
    share = jnp.where(there, heights - lowest, 0) / jnp.where(highest > lowest, highest - lowest, 1)
    light = through_air(suns, jnp.stack([lowest, highest]), turbidity)
    return Besides(light, (jnp.moveaxis(normals, -1, 0), share))


def _place_of(terrain: Any, place: tuple[float, float] | None) -> tuple[float, float]:
    if place is None:
        if not isinstance(terrain, Terrain):
            raise ArgumentError("insolation", "place", "must be latitude and longitude, unless a Terrain says where it lies")
        return terrain.place
    if np.shape(place) != (2,):
        raise ArgumentError("insolation", "place", f"must be latitude and longitude, degrees, it is {place!r}")
    latitude, longitude = place
    return latitude, longitude


def _turned(terrain: Any) -> float:
    """By how much y points clockwise of north, degrees; 0 where that is not known."""
    wkt = terrain.georeference.wkt if isinstance(terrain, Terrain) and terrain.georeference else ""
    if not wkt or coordinate_system(wkt).degrees:
        return 0.0
    return float(np.nan_to_num(terrain.convergence))
