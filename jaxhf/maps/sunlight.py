"""Tables from which a horizon tells how much of the sun's and the sky's light it lets through in a time."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..core.types import AnyArray, ScalarLeaf
from ..core.vector import greater
from ..preparation.crossings import even_azimuths
from ..preparation.sky import sky_vector
from ..scene.sun import sun
from .clear_sky import above_the_air, beam, diffuse

_ALTITUDES = 360  # steps of the tables from the horizontal to the zenith
_MOST_SUNS = 2**18  # two minutes of a year from one to the next
_LEAST_STEP = np.timedelta64(60, "s")


class Suns(NamedTuple):
    """What comes from the sun in a time, outside of the air.

    Attributes:
      light: by sector of azimuth and step of altitude, the sum over its suns of their light times the direction towards them
        or, where only their time counts, of that: kWh/m² or hours. Shape (c, k, altitudes), c = 3 or 1; None: they do not
        count.
      sky: what an even sky sends on level ground from which all of it is seen, kWh/m²; None: it does not count.
    """

    light: Float[AnyArray, "c k altitudes"] | None
    sky: ScalarLeaf | None


def suns_of(
    begin: np.datetime64,
    end: np.datetime64,
    place: tuple[float, float],
    turned: float,
    turbidity: float,
    azimuths: int,
    wanted: str,
    dtype: Any,
) -> Suns:
    """The suns of a time at a place.

    They follow each other by a minute, in long times by more. Each counts half in a sector and half in the next where it
    stands between the middles of two, and so on in proportion.

    Args:
      begin, end: in UTC.
      place: latitude and longitude, degrees.
      turned: by how much y points clockwise of north, degrees.
      turbidity: see `beam`.
      azimuths: how many sectors there are.
      wanted: see `insolation`.
    """
    count = int(np.ceil((end - begin) / max(_LEAST_STEP, (end - begin) / _MOST_SUNS)))
    times = begin + ((np.arange(count) + 0.5) * ((end - begin) / np.timedelta64(1, "us") / count)).astype("timedelta64[us]")
    azimuth, altitude = sun(times, *place, refraction=True)
    up = altitude > 0
    azimuth, altitude, hours = azimuth[up] - turned, altitude[up], (end - begin) / np.timedelta64(1, "h") / count
    energy = above_the_air(times[up]) * hours / 1000
    sky: Any = None
    if wanted in ("energy", "diffuse"):
        sky = np.asarray(np.sum(energy * diffuse(altitude, turbidity)), dtype)
    if wanted == "diffuse":
        return Suns(None, sky)
    turn, height = np.deg2rad(azimuth), np.deg2rad(altitude)
    parts = np.stack([np.sin(turn) * np.cos(height), np.cos(turn) * np.cos(height), np.sin(height)]) * energy
    if wanted == "hours":
        parts = np.full((1, altitude.size), hours)
    sector = azimuth % 360 / 360 * azimuths
    first, share = np.floor(sector).astype(int), sector % 1
    level = np.minimum((altitude / 90 * _ALTITUDES).astype(int), _ALTITUDES - 1)
    light: Any = np.zeros((len(parts), azimuths, _ALTITUDES))
    for k, part in ((first, 1 - share), (first + 1, share)):
        for table, values in zip(light, part * parts, strict=True):
            np.add.at(table, (k % azimuths, level), values)
    return Suns(light.astype(dtype), sky)


class Sunlight(eqx.Module):
    """What arrives in a time, on two heights between which all others lie.

    Attributes:
      suns: see `Suns`: by sector and altitude, the sum over the suns that stand higher, those of one step of altitudes being
        spread evenly over it; shape (2, c, k, altitudes + 1).
      sky: as there.
    """

    suns: Float[jax.Array, "2 c k altitudes"] | None
    sky: ScalarLeaf | None


def through_air(suns: Suns, heights: Float[jax.Array, "2"], turbidity: ScalarLeaf) -> Sunlight:
    """What is left of them on two heights, metres above the sea."""
    if suns.light is None:
        return Sunlight(None, suns.sky)
    light = jnp.asarray(suns.light)
    if light.shape[0] == 3:
        middles = (np.arange(_ALTITUDES) + 0.5) * (90 / _ALTITUDES)
        shares = jnp.stack([beam(jnp.asarray(middles, light.dtype), height, turbidity) for height in heights])
        light = light[None] * shares[:, None, None]
    else:
        light = jnp.stack([light, light])
    return Sunlight(jnp.pad(jnp.cumsum(light[..., ::-1], axis=-1)[..., ::-1], ((0, 0),) * 3 + ((0, 1),)), suns.sky)


def received(
    slopes: Float[jax.Array, "k *at"],
    light: Sunlight,
    ground: tuple[Float[jax.Array, "3 *at"], Float[jax.Array, "*at"]],
) -> Float[jax.Array, "*at"]:
    """What arrives at places with these horizons, at least horizontal, and their own surface; of azimuths even from north on.

    Args:
      light: see `through_air`.
      ground: the upward unit normals, and how far each height is from the lowest to the highest, 0 to 1.
    """
    normal, share = ground
    k, dtype = slopes.shape[0], slopes.dtype
    turns = np.deg2rad(even_azimuths(k)).reshape(-1, *[1] * (slopes.ndim - 1))
    east, north = (jnp.asarray(f(turns), dtype) for f in (np.sin, np.cos))
    own = -(normal[0][None] * east + normal[1][None] * north) / normal[2][None]
    # One choice for both: at the border they are often the same, and XLA rounds them anew wherever it compares them.
    slopes = greater(jnp.where(jnp.isnan(slopes), 0, slopes), own)
    total = jnp.zeros(share.shape, dtype)
    if light.sky is not None:
        seen = jnp.sum(sky_vector(slopes) * normal, 0)
        total = total + light.sky * seen
    if light.suns is not None:
        at = jnp.arctan(slopes) * (2 / np.pi * _ALTITUDES)
        level = jnp.clip(at.astype(jnp.int32), 0, _ALTITUDES - 1)
        beyond, sector = at - level.astype(dtype), jnp.arange(k, dtype=jnp.int32).reshape(turns.shape)
        level = level + sector * (_ALTITUDES + 1)  # in a row of all sectors
        weights = normal if light.suns.shape[1] == 3 else jnp.ones((1, *share.shape), dtype)
        tables = light.suns.reshape(*light.suns.shape[:2], -1)
        for component, weight in enumerate(weights):
            low, high = (_between(table[component], level, beyond) for table in tables)
            total = total + weight * jnp.sum(low + share[None] * (high - low), 0)
    return jnp.maximum(total, 0)


def _between(table: Float[jax.Array, " n"], level: Any, beyond: Float[jax.Array, "k *at"]) -> Float[jax.Array, "k *at"]:
    first, second = (table.at[place].get(mode="promise_in_bounds") for place in (level, level + 1))
    return first + beyond * (second - first)
