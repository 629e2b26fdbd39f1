"""Tables from which a horizon tells how much of the sun's and the sky's light it lets through in a time."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from ..core.types import AnyArray, ScalarLeaf
from ..preparation.crossings import even_azimuths
from ..preparation.sky import sky_vector
from ..scene.sun import sun
from .clear_sky import above_the_air, beam, diffuse

_ALTITUDES = 360  # steps of the tables from the horizontal to the zenith
_HEIGHTS = 5  # of which tables are made; between two light is linear
_MOST_SUNS = 2**18  # two minutes of a year from one to the next
_LEAST_STEP = np.timedelta64(60, "s")


class Suns(NamedTuple):
    """What comes from the sun in a time, outside of the air; None: it does not count."""

    # By sector of azimuth and step of altitude, the sum over its suns of their light times the direction towards them (c = 3),
    # kWh/m², or, where only their time counts, of that (c = 1), hours.
    light: Float[AnyArray, "c k altitudes"] | None
    # What an even sky sends on level ground from which all of it is seen, kWh/m².
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
    stands between the middles of two, and so on in proportion. `turned` is by how much y points clockwise of north, degrees;
    see `insolation` for the others.
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
    """What arrives in a time, see `Suns`, on heights at even steps."""

    # For each of these heights, by sector and altitude, the sum over the suns that stand higher, those of one step of altitudes
    # being spread evenly over it: one altitude more than there.
    suns: Float[jax.Array, "c heights k altitudes"] | None
    sky: ScalarLeaf | None


def through_air(suns: Suns, lowest: ScalarLeaf, highest: ScalarLeaf, turbidity: ScalarLeaf) -> Sunlight:
    """What is left of them on heights from the lowest to the highest, metres above the sea."""
    if suns.light is None:
        return Sunlight(None, suns.sky)
    light = jnp.asarray(suns.light)[:, None]
    if light.shape[0] == 3:
        middles = jnp.asarray((np.arange(_ALTITUDES) + 0.5) * (90 / _ALTITUDES), light.dtype)
        heights = lowest + (highest - lowest) * jnp.linspace(0, 1, _HEIGHTS, dtype=light.dtype)
        light = light * jnp.stack([beam(middles, height, turbidity) for height in heights])[None, :, None]
    else:
        light = jnp.repeat(light, _HEIGHTS, axis=1)
    return Sunlight(jnp.pad(jnp.cumsum(light[..., ::-1], axis=-1)[..., ::-1], ((0, 0),) * 3 + ((0, 1),)), suns.sky)


def received(
    slopes: Float[jax.Array, "k *at"],
    light: Sunlight,
    ground: tuple[Float[jax.Array, "3 *at"], Float[jax.Array, "*at"]],
) -> Float[jax.Array, "*at"]:
    """What arrives at places by their horizons' slopes, in azimuths at even steps from north on, and by their own slope.

    Slopes are at least 0, or nan, where what is returned means nothing; of the ground these are the upward unit normals, and
    how far each height is from the lowest to the highest, 0 to 1.
    """
    normal, share = ground
    k, dtype = slopes.shape[0], slopes.dtype
    turns = np.deg2rad(even_azimuths(k)).reshape(-1, *[1] * (slopes.ndim - 1))
    east, north = (jnp.asarray(f(turns), dtype) for f in (np.sin, np.cos))
    own = -(normal[0][None] * east + normal[1][None] * north) / normal[2][None]
    # One choice for both: at the border they are often the same, and XLA rounds them anew wherever it compares them.
    slopes = jnp.where(slopes > own, slopes, own)  # own where they are nan
    total = jnp.zeros(share.shape, dtype)
    if light.sky is not None:
        total = total + light.sky * jnp.maximum(jnp.sum(sky_vector(slopes) * normal, 0), 0)
    if light.suns is None:
        return total
    altitude, beyond = _step(jnp.arctan(slopes) * (2 / np.pi), _ALTITUDES)
    height, above = _step(share, _HEIGHTS - 1)
    sector = jnp.arange(k, dtype=jnp.int32).reshape(turns.shape)
    first = (height[None] * k + sector) * (_ALTITUDES + 1) + altitude  # in a row of all
    direct = jnp.zeros_like(total)
    for table, weight in zip(light.suns, normal if len(light.suns) == 3 else jnp.ones((1, *share.shape), dtype), strict=True):
        row = table.reshape(-1)
        low, high = (_between(row, first + further * k * (_ALTITUDES + 1), beyond) for further in (0, 1))
        direct = direct + weight * jnp.sum(low + above[None] * (high - low), 0)
    return total + jnp.maximum(direct, 0)


def _step(share: Float[jax.Array, "*at"], count: int) -> tuple[Int[jax.Array, "*at"], Float[jax.Array, "*at"]]:
    """Which of so many even steps a share of 0 to 1 lies in, and how far along it."""
    number = jnp.clip((share * count).astype(jnp.int32), 0, count - 1)
    return number, share * count - number.astype(share.dtype)


def _between(row: Float[jax.Array, " n"], first: Int[jax.Array, "k *at"], beyond: Float[jax.Array, "k *at"]) -> jax.Array:
    here, there = (row.at[place].get(mode="promise_in_bounds") for place in (first, first + 1))
    return here + beyond * (there - here)
