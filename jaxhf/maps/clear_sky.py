"""What arrives through a cloudless sky of the Earth: the model of the European Solar Radiation Atlas.

Rigollier, Bauer and Wald (On the clear sky model of the ESRA, Solar Energy 68(1), 2000), whose Linke turbidity says how much
haze and vapour the air holds: 1 is clean dry air, 2 to 3 mountains, 3 to 5 lowlands, 6 to 8 cities in summer.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..core.types import AnyArray, ScalarLeaf

Numbers = Float[np.ndarray, "..."]

_SOLAR_CONSTANT = 1361.0  # W/m² at the mean distance (Kopp and Lean, Geophysical Research Letters 38, L01706, 2011)
_SCALE_HEIGHT = 8434.5  # metres over which the air's pressure falls to 1 / e
_LEAST_DIFFUSE = 2e-3  # below which the model's diffuse light of a sun on the horizon becomes too small


def beam(altitude: Float[AnyArray, " n"], height: Float[AnyArray, "..."], turbidity: ScalarLeaf) -> Float[jax.Array, " n"]:
    """The share of the sun's light that comes straight through, on a surface across it (equations 3 to 12).

    The altitude is that of the sun as it is seen, with refraction, degrees, above 0; the height is above the sea, metres.
    """
    pressure = jnp.exp(-height / _SCALE_HEIGHT)
    # Kasten and Young, Revised optical air mass tables and approximation formula, Applied Optics 28, 4735, 1989
    mass = pressure / (jnp.sin(jnp.deg2rad(altitude)) + 0.50572 * (altitude + 6.07995) ** -1.6364)
    # Kasten, The Linke turbidity factor based on improved values of the integral Rayleigh optical thickness, 1996
    low = 6.6296 + mass * (1.7513 + mass * (-0.1202 + mass * (0.0065 - mass * 0.00013)))
    return jnp.exp(-0.8662 * turbidity * mass / jnp.where(mass > 20, 10.4 + 0.718 * mass, low))


def diffuse(altitude: Numbers, turbidity: float) -> Numbers:
    """The share of the sun's light that arrives from the sky, on level ground (equations 13 to 18)."""
    at_zenith = np.polyval([3.797e-4, 3.0543e-2, -1.5843e-2], turbidity)
    parts = [
        np.polyval(coefficients, turbidity)
        for coefficients in (
            [8.5079e-3, 3.9231e-2, -1.3025],
            [-1.1161e-2, 1.8945e-2, 2.0402],
            [3.1408e-3, -6.1581e-2, 2.6463e-1],
        )
    ]
    parts[2] = max(parts[2], _LEAST_DIFFUSE / at_zenith)
    return np.maximum(at_zenith * np.polyval(parts, np.sin(np.deg2rad(altitude))), 0)


def above_the_air(time: Any) -> Numbers:
    """The sun's irradiance outside of the atmosphere, W/m², by its distance at these datetime64 (equation 2)."""
    day = (time - time.astype("datetime64[Y]")) / np.timedelta64(1, "D") + 1
    return _SOLAR_CONSTANT * (1 + 0.03344 * np.cos(2 * np.pi * day / 365.25 - 0.048869))
