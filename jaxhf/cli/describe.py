"""A scene in words, as `jaxhf info` and `convert` print it."""

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from ..io.terrain import Terrain
    from ..scene.heightfield import Heightfield
    from ..scene.scene import Scene


def scene_lines(scene: "Scene") -> Iterator[str]:
    """A line for the camera, and one for each object and light."""
    from ..scene.heightfield import Heightfield

    eye = np.asarray(scene.camera.world_from_camera)[:3, 3]
    yield f"camera: {type(scene.camera).__name__}, at {_numbers(eye)}"
    for k, obj in enumerate(scene.objects):
        what = heightfield_line(obj.shape) if isinstance(obj.shape, Heightfield) else repr(obj.shape)
        place = "" if obj.world_from_object is None else ", with a transform"
        yield f"object {k}: {what}, {_material(obj.material)}{place}"
    for k, light in enumerate(scene.lights):
        values = ", ".join(f"{name} {_numbers(value)}" for name, value in vars(light).items())
        yield f"light {k}: {type(light).__name__}, {values}"


def heightfield_line(field: "Heightfield | Terrain") -> str:
    heights = np.asarray(field.heights)
    ny, nx = heights.shape
    finite = heights[np.isfinite(heights)]
    span = _numbers([finite.min(), finite.max()]) if finite.size else "none"
    holes = f", {heights.size - finite.size} holes" if finite.size < heights.size else ""
    return (
        f"Heightfield, {ny} x {nx} heights, cells {field.dx:.6g} x {field.dy:.6g}, "
        f"origin {_numbers([field.x0, field.y0])}, range {span}{holes}"
    )


def _material(material: Any) -> str:
    from ..scene.texture import ImageTexture

    (name, value), *_ = vars(material).items()
    what = (
        f"an image of {value.texels.shape[1]} x {value.texels.shape[0]}" if isinstance(value, ImageTexture) else _numbers(value)
    )
    return f"{type(material).__name__.lower()}, {name} {what}"


def _numbers(values: Any) -> str:
    return "(" + ", ".join(f"{float(value):.6g}" for value in values) + ")"
