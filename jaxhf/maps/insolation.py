"""How much sunlight arrives at a terrain in a day, a month or a year."""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Float

from ..core.errors import ArgumentError
from ..core.rules import OneOf, Whole, require
from ..core.types import AnyArray, ScalarLeaf
from ..io.terrain.terrain import Terrain
from ..preparation.crossings import even_azimuths
from ..preparation.horizon import Besides
from ..scene.sun import require_place, utc
from ..xla.compilation import compiled, is_traced
from ..xla.devices import takes_numbers
from .choices import SUNLIGHT
from .horizons import field_of, map_over_horizons, unit_normals
from .sunlight import Suns, suns_of, through_air
from .surface import require_heights

_MOST_YEARS = 10


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
    (Rigollier, Bauer and Wald, On the clear sky model of the ESRA, Solar Energy 68(1), 2000), of five heights, between which it
    is linear. The sky is equally bright everywhere, and light that the terrain sends on to itself does not count. One place
    stands for the whole terrain. Suns follow each other by a minute, in more than half a year by a 2¹⁸th of the time. Errors
    and times: docs/measurements/maps.md.

    Args:
      terrain: see `horizon`. Heights and cells in metres: the air is that above the sea.
      begin, end: a `datetime` with a time zone, or NumPy's datetime64 in UTC; ten years apart at most.
      place: latitude and longitude, degrees, north and east positive; None: those of a `Terrain`'s middle. Its y points to
        the north or, where its georeference says so, aside by its `convergence`.
      wanted: "energy", or its parts "direct" (from the sun) and "diffuse" (from the sky); "hours": for how long the sun
        shines there, hours.
      turbidity: how much haze and vapour the air holds, after Linke: 1 (clean and dry) to 10; mountains 2, lowlands 3 to 5.
      azimuths: how many directions, from the y axis on at even steps.
      dx, dy, progress, mesh: see `horizon`.

    Returns:
      Shape (ny, nx), nan where there is no height; differentiable in the heights.

    Raises:
      ValueError: an argument has a value that it cannot have; a terrain does not say where it lies.
    """
    field = field_of("insolation", terrain, dx, dy)
    if not is_traced():
        require_heights("insolation", np.isfinite(field.heights))
    require("insolation", "wanted", wanted, OneOf(SUNLIGHT))
    require("insolation", "azimuths", azimuths, Whole(4))
    require("insolation", "turbidity", turbidity, _turbidity)
    times = {name: utc("insolation", name, time) for name, time in (("begin", begin), ("end", end))}
    for name, time in times.items():
        if time.shape:
            raise ArgumentError("insolation", name, f"must be one time, its shape is {time.shape}")
    first, last = times.values()
    if not first < last <= first + _MOST_YEARS * np.timedelta64(366, "D"):
        raise ArgumentError("insolation", "end", f"must come after begin, {begin}, by ten years at most, it is {end}")
    turned = terrain.turned_from_north if isinstance(terrain, Terrain) else 0.0
    suns = suns_of(
        first[()], last[()], _place_of(terrain, place), turned, float(turbidity), int(azimuths), wanted,
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
    share = jnp.where(there, heights - lowest, 0) / jnp.where(highest > lowest, highest - lowest, 1)
    light, normals = through_air(suns, lowest, highest, turbidity), unit_normals(heights, dx, dy)
    return Besides(light, (jnp.moveaxis(normals, -1, 0), share))


def _turbidity(value: Any) -> str | None:
    holds = isinstance(value, int | float | np.number) and not isinstance(value, bool) and 1 <= value <= 10
    return None if holds else f"must be a number from 1 to 10, it is {value!r}"


def _place_of(terrain: Any, place: tuple[float, float] | None) -> tuple[float, float]:
    if place is None and isinstance(terrain, Terrain):
        return terrain.place
    angles = list(place) if isinstance(place, Sequence | np.ndarray) else []
    if len(angles) != 2 or not all(isinstance(angle, int | float | np.number) for angle in angles):
        given = "unless a Terrain says where it lies" if place is None else f"degrees, it is {place!r}"
        raise ArgumentError("insolation", "place", f"must be latitude and longitude, {given}")
    latitude, longitude = angles
    require_place("insolation", latitude, longitude)
    return float(latitude), float(longitude)
