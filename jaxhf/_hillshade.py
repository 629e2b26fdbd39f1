"""Shaded maps: terrain from straight above, north up."""

import numpy as np
from jaxtyping import Float

from ._camera import Orthographic
from ._heightfield import Heightfield
from ._light import Directional, Sky
from ._material import Matte
from ._scene import Object, Scene
from ._types import AnyArray
from .io import Terrain
from .io._images import linear_from_srgb


def hillshade_scene(terrain: Terrain, azimuth: float = 315.0, altitude: float = 45.0, sky: float = 0.0) -> Scene:
    """A white map of one pixel a cell (in height as many as keep pixels square), in light as cartographers give it.

    Level ground has the radiance sin(altitude) + sky.

    Args:
      terrain: the heights.
      azimuth, altitude: of the light, degrees clockwise from north, and above the horizon.
      sky: radiance of a sky without shadows, which keeps slopes that face away from being black.

    Raises:
      ValueError: the light is not above the horizon, the sky is not 0 or more, or there is no height.
    """
    if not 0 < altitude <= 90:
        raise ValueError(f"hillshade: altitude must be above 0 and at most 90 degrees, it is {altitude}")
    if not 0 <= sky < np.inf:
        raise ValueError(f"hillshade: sky must be 0 or more, it is {sky}")
    if terrain.nodata.all():
        raise ValueError("hillshade: there is no height in the terrain")
    ny, nx = terrain.heights.shape
    across, up = (nx - 1) * terrain.dx, (ny - 1) * terrain.dy
    width, height = nx - 1, max(1, round((nx - 1) * up / across))
    lowest, highest = np.nanmin(terrain.heights), np.nanmax(terrain.heights)
    x, y, z = terrain.x0 + across / 2, terrain.y0 + up / 2, float(highest + (highest - lowest) + max(terrain.dx, terrain.dy))
    camera = Orthographic.look_at(
        (x, y, z), (x, y, z - 1), up=(0, 1, 0), extent=min(across, across * height / width), width=width, height=height
    )
    field = Heightfield(terrain.heights, terrain.dx, terrain.dy, terrain.x0, terrain.y0)
    lights = [Directional.from_angles(azimuth, altitude), *([Sky(sky)] if sky else [])]
    return Scene([Object(field, Matte(1.0))], camera, lights, samples=1)


def printed(image: Float[AnyArray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
    """The map for a .png whose bytes are to be 255 times its radiance, as GDAL and printed maps have them, not its sRGB."""
    return linear_from_srgb(np.clip(np.asarray(image), 0, 1))
