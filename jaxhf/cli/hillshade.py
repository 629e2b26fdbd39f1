"""Shaded maps: terrain from straight above, north up."""

import numpy as np
from jaxtyping import Float

from ..core.errors import ArgumentError, UserError
from ..core.types import AnyArray
from ..io.images import linear_from_srgb
from ..io.terrain import Terrain
from ..scene.light import Directional, Sky
from ..scene.material import Matte
from ..scene.scene import Object, Scene
from ..scene.views import from_above


def hillshade_scene(
    terrain: Terrain,
    azimuth: float = 315.0,
    altitude: float = 45.0,
    sky: float = 0.0,
    width: int | None = None,
    height: int | None = None,
) -> Scene:
    """A white map in light as cartographers give it; of one pixel a cell across, unless its size is given.

    Level ground has the radiance sin(altitude) + sky.

    Args:
      terrain: the heights.
      azimuth, altitude: of the light, degrees clockwise from north, and above the horizon.
      sky: radiance of a sky without shadows, which keeps slopes that face away from being black. Holes show it.
      width, height: pixels; see `from_above`.

    Raises:
      ValueError: the light is not above the horizon, the sky is not 0 or more, or there is no height.
    """
    if not 0 < altitude <= 90:
        raise ArgumentError("hillshade", "altitude", f"must be above 0 and at most 90 degrees, it is {altitude}")
    if not 0 <= sky < np.inf:
        raise ArgumentError("hillshade", "sky", f"must be 0 or more, it is {sky}")
    if terrain.nodata.all():
        raise UserError("hillshade: there is no height in the terrain")
    field = terrain.heightfield()
    lights = [Directional.from_angles(azimuth, altitude), *([Sky(sky)] if sky else [])]
    if width is None and height is None:
        width = terrain.heights.shape[1] - 1
    return Scene([Object(field, Matte(1.0))], from_above(field, width, height), lights, samples=1)


def printed(image: Float[AnyArray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
    """The map for a .png whose bytes are to be 255 times its radiance, as GDAL and printed maps have them, not its sRGB."""
    return linear_from_srgb(np.clip(np.asarray(image), 0, 1))
