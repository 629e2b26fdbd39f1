"""Lights."""

from typing import Any, TypeGuard, TypeVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from ..core.errors import ArgumentError, whole_number
from ..core.rules import Whole
from ..core.types import COLOUR, VECTOR, Number, ScalarLeaf, VectorLeaf, float_leaf, rgb_leaf
from .record import Record
from .sun import sun

D = TypeVar("D", bound="Directional")
_DIAMETER = Number("be above 0 and at most 10 degrees", lambda value: 0 < value <= 10)


def _irradiance(value: Any) -> Any:
    return rgb_leaf(np.pi if value is None else value)


class Directional(Record):
    """Parallel light from infinitely far away.

    Attributes:
      towards: the vector from the scene towards the light, world frame; its length does not matter.
      irradiance: of a surface that faces the light, one number or (r, g, b); None: pi, under which a white matte surface
        that faces the light has radiance 1.
    """

    towards: VectorLeaf = eqx.field(converter=float_leaf, metadata={"rule": VECTOR})
    irradiance: VectorLeaf = eqx.field(converter=_irradiance, default=None, metadata={"rule": COLOUR})

    def _require_consistent(self):
        if isinstance(self.towards, np.ndarray) and not self.towards.any():
            raise ArgumentError(type(self).__name__, "towards", "must not be zero, it is [0, 0, 0]")

    @classmethod
    def from_angles(cls: type[D], azimuth: Any = 315.0, altitude: Any = 45.0, irradiance: Any = None, **more: Any) -> D:
        """Light from a compass direction, as cartographers give it: x is east, y north, z up.

        Args:
          azimuth: the direction in which the light stands, degrees clockwise from north.
          altitude: its height above the horizon, degrees.
          irradiance, more: as for the class.
        """
        azimuth, altitude = float_leaf(azimuth), float_leaf(altitude)
        xp = np if isinstance(azimuth, np.ndarray) and isinstance(altitude, np.ndarray) else jnp
        a, h = xp.deg2rad(azimuth), xp.deg2rad(altitude)
        towards = xp.stack([xp.sin(a) * xp.cos(h), xp.cos(a) * xp.cos(h), xp.sin(h)])
        return cls(towards, irradiance, **more)

    @classmethod
    def at(
        cls: type[D], time: Any, latitude: Any, longitude: Any, irradiance: Any = None, *, refraction: bool = False, **more: Any
    ) -> D:
        """Light from where the sun stands at a time and place; y counts as true north, see `Terrain.convergence`.

        Args:
          time, latitude, longitude, refraction: one of each, as for `sun`.
          irradiance, more: as for the class; the irradiance does not depend on the altitude.

        Raises:
          ValueError: the sun is not above the horizon, or `sun` raises it.
        """
        azimuth, altitude = sun(time, latitude, longitude, refraction=refraction)
        if np.ndim(altitude):
            raise ArgumentError(cls.__name__, "time", f"and place must be one of each, they make {np.size(altitude)} lights")
        if not altitude > 0:
            rule = f"must be one at which the sun is up, its altitude is {altitude:.2f} degrees at {time}"
            raise ArgumentError(cls.__name__, "time", rule)
        return cls.from_angles(azimuth, altitude, irradiance, **more)


class Sun(Directional):
    """Light from a round disc infinitely far away, of even brightness: its shadows have penumbras.

    A point is lit by the part of the disc that stands above its horizon. The horizon is that of the triangles themselves, taken
    in `chords` azimuths across the disc. Behind slopes a picture equals the mean of those under 1024 directional lights spread
    over the disc to 1 %, without noise; behind upright walls penumbras have steps, which more chords make smaller. In a
    penumbra a picture has a derivative by itself, so shadow edges need no `edge_samples`.

    Heightfields and skirts must be upright. Where one stands alone, with or without its skirt, the ground below it counts as
    solid, and so as dark; several are sheets with two sides. Cylinders cast shadows without penumbras.

    Attributes:
      towards: the vector from the scene towards the middle of the disc, world frame; its length does not matter. It must point
        above the horizon, which is not asked of traced values.
      irradiance: that of all the disc, of a surface that faces it: a Directional of the same irradiance is as bright outside
        penumbras. One number or (r, g, b); None: pi.
      angular_diameter: of the disc, degrees, at most 10; the sun's is 0.53.
      chords: in how many azimuths the disc is seen. The time grows with them, and steps in penumbras are as large as one of
        them: 32 keep behind a tower to 0.8 % what 8 keep to 4 %, see docs/measurements/settings.md.
    """

    angular_diameter: ScalarLeaf = eqx.field(converter=float_leaf, default=0.53, metadata={"rule": _DIAMETER})
    chords: int = eqx.field(converter=whole_number, static=True, default=8, metadata={"rule": Whole(1)})

    def _require_consistent(self):
        super()._require_consistent()
        if isinstance(self.towards, np.ndarray) and not self.towards[2] > 0:
            altitude = np.rad2deg(np.arctan2(self.towards[2], np.hypot(*self.towards[:2])))
            raise ArgumentError("Sun", "towards", f"must point above the horizon, its altitude is {altitude:.2f} degrees")


class Point(Record):
    """A point that shines equally in every direction.

    Attributes:
      p: its position, world frame.
      intensity: power per solid angle, one number or (r, g, b); the irradiance at distance r is intensity / r².
    """

    p: VectorLeaf = eqx.field(converter=float_leaf, metadata={"rule": VECTOR})
    intensity: VectorLeaf = eqx.field(converter=rgb_leaf, default=1.0, metadata={"rule": COLOUR})


class Sky(Record):
    """A sky of one colour: the background of the picture, and diffuse light from the upper hemisphere.

    A surface tilted by beta against the horizontal sees the share (1 + cos beta) / 2 of the sky, the isotropic sky of
    Liu and Jordan (The interrelationship and characteristic distribution of direct, diffuse and total solar radiation,
    Solar Energy 4(3), 1960). Other terrain hides none of it unless `occlusion` is given.

    Attributes:
      radiance: one number or (r, g, b).
      occlusion: in how many azimuths, at even steps, each heightfield hides the sky from its own upper side, see `horizon`, and
        from those with which it is one surface, see `nested`: 16 are good for some per cent. The visible sky is computed at the
        vertices and interpolated between them. None: in none.
    """

    radiance: VectorLeaf = eqx.field(converter=rgb_leaf, metadata={"rule": COLOUR})
    occlusion: int | None = eqx.field(converter=whole_number, static=True, default=None, metadata={"rule": Whole(1)})


Light = Directional | Sun | Point | Sky


def casts_sharp_shadows(light: Light) -> TypeGuard[Directional | Point]:
    """Whether the light reaches a point wholly or not at all, so that its shadows have edges."""
    return not isinstance(light, Sun | Sky)
