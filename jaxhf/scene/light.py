"""Lights."""

import warnings
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from ..core.errors import ArgumentError, whole_number
from ..core.types import VectorLeaf, float_leaf, require_finite, rgb_leaf
from .show import fields
from .sun import sun


class Directional(eqx.Module):
    """Parallel light from infinitely far away.

    Attributes:
      towards: the vector from the scene towards the light, world frame; its length does not matter.
      irradiance: of a surface that faces the light, one number or (r, g, b); None: pi, under which a white matte surface
        that faces the light has radiance 1.
      radiance: what the argument `irradiance` was called until 0.1; gives a DeprecationWarning.
    """

    towards: VectorLeaf
    irradiance: VectorLeaf

    def __init__(self, towards: Any, irradiance: Any = None, *, radiance: Any = None):
        self.towards = float_leaf(towards)
        self.irradiance = rgb_leaf(_chosen(irradiance, radiance, 5))  # two frames between are Equinox's
        _require_vector("Directional", "towards", self.towards)
        _require_vector("Directional", "irradiance", self.irradiance)
        if isinstance(self.towards, np.ndarray) and not self.towards.any():
            raise ArgumentError("Directional", "towards", "must not be zero, it is [0, 0, 0]")

    def __repr__(self) -> str:
        return fields(self)

    @classmethod
    def from_angles(
        cls, azimuth: Any = 315.0, altitude: Any = 45.0, irradiance: Any = None, *, radiance: Any = None
    ) -> "Directional":
        """Light from a compass direction, as cartographers give it: x is east, y north, z up.

        Args:
          azimuth: the direction in which the light stands, degrees clockwise from north.
          altitude: its height above the horizon, degrees.
          irradiance, radiance: as for the class.
        """
        azimuth, altitude = float_leaf(azimuth), float_leaf(altitude)
        xp = np if isinstance(azimuth, np.ndarray) and isinstance(altitude, np.ndarray) else jnp
        a, h = xp.deg2rad(azimuth), xp.deg2rad(altitude)
        towards = xp.stack([xp.sin(a) * xp.cos(h), xp.cos(a) * xp.cos(h), xp.sin(h)])
        return cls(towards, _chosen(irradiance, radiance, 3))

    @classmethod
    def at(cls, time: Any, latitude: Any, longitude: Any, irradiance: Any = None, *, refraction: bool = False) -> "Directional":
        """Light from where the sun stands at a time and place; y counts as true north.

        Args:
          time, latitude, longitude, refraction: one of each, as for `sun`.
          irradiance: as for the class; it does not depend on the altitude.

        Raises:
          ValueError: the sun is not above the horizon, or `sun` raises it.
        """
        azimuth, altitude = sun(time, latitude, longitude, refraction=refraction)
        if np.ndim(altitude):
            raise ArgumentError("Directional", "time", f"and place must be one of each, they make {np.size(altitude)} lights")
        if not altitude > 0:
            rule = f"must be one at which the sun is up, its altitude is {altitude:.2f} degrees at {time}"
            raise ArgumentError("Directional", "time", rule)
        return cls.from_angles(azimuth, altitude, irradiance)


class Point(eqx.Module):
    """A point that shines equally in every direction.

    Attributes:
      p: its position, world frame.
      intensity: power per solid angle, one number or (r, g, b); the irradiance at distance r is intensity / r².
    """

    p: VectorLeaf = eqx.field(converter=float_leaf)
    intensity: VectorLeaf = eqx.field(converter=rgb_leaf, default=1.0)

    def __check_init__(self):
        _require_vector("Point", "p", self.p)
        _require_vector("Point", "intensity", self.intensity)

    def __repr__(self) -> str:
        return fields(self)


class Sky(eqx.Module):
    """A sky of one colour: the background of the picture, and diffuse light from the upper hemisphere.

    A surface tilted by beta against the horizontal sees the share (1 + cos beta) / 2 of the sky, the isotropic sky of
    Liu and Jordan (The interrelationship and characteristic distribution of direct, diffuse and total solar radiation,
    Solar Energy 4(3), 1960). Other terrain hides none of it unless `occlusion` is given.

    Attributes:
      radiance: one number or (r, g, b).
      occlusion: in how many azimuths, at even steps, each heightfield hides the sky from its own upper side, see `horizon`: 16
        are good for some per cent. The visible sky is computed at the vertices and interpolated between them. None: in none.
    """

    radiance: VectorLeaf = eqx.field(converter=rgb_leaf)
    occlusion: int | None = eqx.field(converter=whole_number, static=True, default=None)

    def __check_init__(self):
        _require_vector("Sky", "radiance", self.radiance)
        if self.occlusion is not None and (type(self.occlusion) is not int or self.occlusion < 1):
            raise ArgumentError("Sky", "occlusion", f"must be a whole number from 1 on, or None, it is {self.occlusion!r}")

    def __repr__(self) -> str:
        return fields(self).replace(", occlusion=None)", ")")


Light = Directional | Point | Sky


def _chosen(irradiance: Any, radiance: Any, stacklevel: int) -> Any:
    """The irradiance of a directional light, whichever of its two names it was given by."""
    if radiance is None:
        return np.pi if irradiance is None else irradiance
    if irradiance is not None:
        raise ArgumentError("Directional", "radiance", "must stand without irradiance, whose old name it is")
    warnings.warn("Directional: radiance is now called irradiance", DeprecationWarning, stacklevel=stacklevel)
    return radiance


def _require_vector(owner: str, name: str, leaf: VectorLeaf) -> None:
    if leaf.shape != (3,):
        raise ArgumentError(owner, name, f"must hold three numbers, its shape is {leaf.shape}")
    require_finite(owner, name, leaf)
