"""A picture of a terrain as a solid block, in light, colours and haze that suit most: the look of `jaxhf view`."""

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..core.errors import ArgumentError
from ..rendering.render import Prepared, prepare_to_render, render
from ..scene.camera import Camera, Perspective, cropped
from ..scene.heightfield import Heightfield
from ..scene.light import Directional, Light, Sky
from ..scene.material import Material, Matte
from ..scene.scene import Object, Scene
from ..scene.skirt import Skirt
from ..scene.texture import ImageTexture

# Radiance of white ground that faces the sun, and what the whole sky adds where nothing hides it, or where nobody asks.
_SUN, _SKY, _EVEN_SKY = (0.76, 0.74, 0.70), (0.38, 0.42, 0.48), (0.34, 0.38, 0.44)
_OCCLUSION, _MOST_OCCLUDED = 16, 2**21  # azimuths; heights, beyond which looking round takes longer than the picture
_ABOVE, _BELOW = (0.60, 0.72, 0.86), (0.95, 0.95, 0.93)  # the background's highest and lowest row
_HAZE = (0.78, 0.84, 0.90)
_SHALLOW, _DEEP = (0.16, 0.38, 0.46), (0.02, 0.09, 0.20)
_WALLS = (0.27, 0.245, 0.22)
_AOVS = ("depth",)


@dataclasses.dataclass(frozen=True)
class Look:
    """What a terrain is shown in."""

    azimuth: float = 315.0  # of the sun, degrees clockwise from north
    altitude: float = 45.0  # of the sun, degrees above the horizon
    haze: float = 0.15  # the share of light that it takes over the length of the terrain, 0 to 1
    samples: int = 9  # rays a pixel, a square number; with more than one, mountains hide parts of the sky

    def __post_init__(self):
        if not 0 < self.altitude <= 90:
            raise ArgumentError("view", "altitude", f"of the sun must be above 0 and at most 90 degrees, it is {self.altitude}")
        if not 0 <= self.haze < 1:
            raise ArgumentError("view", "haze", f"must be at least 0 and below 1, it is {self.haze}")


def exaggeration(heights: Float[np.ndarray, "ny nx"], dx: float, dy: float) -> float:
    """A round factor for heights with which a terrain looks neither flat nor like a wall; 1 where it does so as it is.

    Its relief, without a hundredth at either end, is then from 0.06 to 0.6 of its shorter side.
    """
    known = heights[np.isfinite(heights)]
    low, high = np.percentile(known, (1, 99))
    ny, nx = heights.shape
    share = float(high - low) / min((nx - 1) * dx, (ny - 1) * dy)
    if share <= 0 or 0.06 <= share <= 0.6:
        return 1.0
    wanted = (0.06 if share < 0.06 else 0.2) / share
    power = 10.0 ** math.floor(math.log10(wanted))
    return next(step * power for step in (1.0, 1.5, 2.0, 3.0, 5.0, 7.0, 10.0) if step * power >= wanted * (1 - 1e-9))


def has_sea(heights: Float[np.ndarray, "ny nx"]) -> bool:
    """Whether a hundredth of the cells at least is level at 0, as the sea is in most files of land; not of level terrain."""
    zero = heights == 0
    level = zero[1:, 1:] & zero[1:, :-1] & zero[:-1, 1:] & zero[:-1, :-1]
    return bool(level.mean() >= 0.01 and np.nanmax(heights) > 0)


def with_water(
    heights: Float[np.ndarray, "ny nx"], colours: Float[np.ndarray, "h w 3"], level: float
) -> tuple[Float[np.ndarray, "ny nx"], Float[np.ndarray, "h w 3"]]:
    """Heights with a level sheet of water where they are not above it; colours, as those of `block`, darken with its depth."""
    under = np.maximum(level - heights, 0)
    deep = under / max(float(np.nanmax(under)), np.finfo(float).tiny)
    rows = np.round(np.linspace(0, len(heights) - 1, len(colours))).astype(int)
    columns = np.round(np.linspace(0, heights.shape[1] - 1, colours.shape[1])).astype(int)
    deep, wet = (part[np.ix_(rows, columns)][..., None] for part in (np.sqrt(np.nan_to_num(deep)), heights <= level))
    sea = (1 - deep) * np.array(_SHALLOW) + deep * np.array(_DEEP)
    surface = np.fmax(heights, np.where(np.isnan(heights), np.nan, level))
    return surface.astype(heights.dtype), np.where(wet, sea, colours)


def block(
    field: Heightfield,
    colours: Float[np.ndarray, "h w 3"],
    camera: Perspective,
    look: Look,
    base: float | None,
    material: Callable[[ImageTexture], Material] = Matte,
) -> Scene:
    """A terrain with walls and a floor at the level `base`, under the sun and a sky.

    The colours are linear, 0 to 1: of each vertex (ny, nx, 3), or a picture over all of it (h, w, 3), southern row first.
    """
    at_vertices = colours.shape[:2] == field.heights.shape
    albedo = ImageTexture(jnp.asarray(colours, field.heights.dtype), at_vertices=at_vertices, wrap="clamp")
    objects = [Object(field, material(albedo))]
    if base is not None:
        objects.append(Object(Skirt.of(field, base), Matte(_WALLS)))
    return Scene(objects, camera, lights(field, look))


def lights(field: Heightfield, look: Look) -> list[Light]:
    """The sun and the sky, parts of which mountains hide."""
    sun = Directional.from_angles(look.azimuth, look.altitude, np.array(_SUN) * math.pi)
    occluded = look.samples > 1 and field.heights.size <= _MOST_OCCLUDED
    return [sun, Sky(np.array(_SKY), occlusion=_OCCLUSION) if occluded else Sky(np.array(_EVEN_SKY))]


def prepared(scene: Scene, look: Look) -> Prepared:
    """A `block`, ready for `photograph`."""
    return prepare_to_render(scene.with_camera(_cameras(scene.camera, look)[0]), aovs=_AOVS)


def photograph(
    ready: Prepared, camera: Perspective, look: Look, progress: Callable[[], Any] | None = None
) -> Float[np.ndarray, "h w 3"]:
    """Linear radiance of a `block` that was prepared in the lights of this look, with haze before a background.

    Each of a pixel's samples gets haze by its own distance, so it is a picture of its own, from a camera that looks past the
    pixel's centre; `progress` is called after each.
    """
    field = ready.scene.heightfields[0]
    ny, nx = field.heights.shape
    size = math.hypot((nx - 1) * field.dx, (ny - 1) * field.dy)
    total = np.zeros((camera.height, camera.width, 3), np.float32)
    cameras = _cameras(camera, look)
    for moved in cameras:
        image, aovs = render(ready.with_camera(moved), aovs=_AOVS)
        total += _in_haze(np.asarray(image, np.float32), np.asarray(aovs["depth"], np.float32), size, look.haze)
        if progress is not None:
            progress()
    return total / np.float32(len(cameras))


def _cameras(camera: Camera, look: Look) -> list[Camera]:
    """That of each sample."""
    side = math.isqrt(look.samples)
    places = [(k + 0.5) / side - 0.5 for k in range(side)]
    return [cropped(camera, dx, dy, camera.width, camera.height) for dy in places for dx in places]


def _in_haze(
    image: Float[np.ndarray, "h w 3"], depth: Float[np.ndarray, "h w"], size: float, haze: float
) -> Float[np.ndarray, "h w 3"]:
    met = np.isfinite(depth)
    far = np.subtract(depth, depth.min(where=met, initial=np.inf), out=np.zeros_like(depth), where=met)
    veiled = 1 - np.exp(far * np.float32(math.log1p(-haze) / size))
    rows, found = np.linspace(0, 1, len(image), dtype=np.float32)[:, None], np.empty_like(image)
    for k, colours in enumerate(zip(_HAZE, _ABOVE, _BELOW, strict=True)):  # together they take 1.6 times as long
        veil, above, below = np.array(colours, np.float32)
        hazy = image[..., k] + veiled * (veil - image[..., k])
        found[..., k] = np.where(met, hazy, (1 - rows) * above + rows * below)
    return found
