"""A camera above a terrain, and scenes with pictures of another size."""

import dataclasses
import math

import numpy as np

from .camera import Orthographic
from .heightfield import Heightfield
from .scene import Scene


def from_above(field: Heightfield, width: int | None, height: int | None) -> Orthographic:
    """A camera that sees a whole heightfield from straight above, north up.

    Args:
      width, height: pixels. Where their proportions are not the field's, the picture shows its surroundings too. One of them
        may be None: as many pixels as make them square, rounded up, so that less than half a pixel on either side shows
        the surroundings.
    """
    width, height, extent = _picture_above(field.heights.shape, field.dx, field.dy, width, height)
    (ny, nx), heights = field.heights.shape, np.asarray(field.heights)
    across, up = (nx - 1) * field.dx, (ny - 1) * field.dy
    x, y, z = field.x0 + across / 2, field.y0 + up / 2, float(heights[np.isfinite(heights)].max()) + max(across, up)
    return Orthographic.look_at((x, y, z), (x, y, z - 1), up=(0, 1, 0), extent=extent, width=width, height=height)


def _picture_above(
    shape: tuple[int, ...], dx: float, dy: float, width: int | None, height: int | None
) -> tuple[int, int, float]:
    """Width and height in pixels, and what the shorter side spans, so that all of a grid is seen in square pixels.

    Args:
      shape: of the heights, (ny, nx).
      dx, dy: between them.
      width, height: pixels; at most one is None, see `from_above`.
    """
    across, up = (shape[1] - 1) * dx, (shape[0] - 1) * dy
    if width is None:
        assert height is not None
        width = _pixels(height * across / up)
    if height is None:
        height = _pixels(width * up / across)
    return width, height, max(across / width, up / height) * min(width, height)


def _pixels(exact: float) -> int:
    return math.ceil(exact - 1e-9)  # of a product that is whole but for rounding


def resized(scene: Scene, width: int, height: int) -> Scene:
    """The same view in a picture of width x height pixels."""
    return dataclasses.replace(scene, camera=dataclasses.replace(scene.camera, width=width, height=height))


def shrunk(scene: Scene, pixels: int) -> Scene:
    """The same view in a picture whose longer side has at most so many pixels."""
    width, height = scene.camera.width, scene.camera.height
    scale = min(1.0, pixels / max(width, height))
    return resized(scene, max(1, round(scale * width)), max(1, round(scale * height)))
