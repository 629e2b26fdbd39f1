"""What is allowed in a scene, but hardly meant: said before it is rendered."""

import sys
from collections.abc import Iterable, Iterator

import numpy as np
from jaxtyping import Float

from ..maps.viewshed import height_at
from ..scene.camera import Camera, Perspective
from ..scene.heightfield import Heightfield
from ..scene.light import Directional
from ..scene.material import Matte
from ..scene.scene import Object, Scene

_NARROW = 1.0  # degrees
_WIDE = 170.0
_MOST_HEIGHT = 1e18


def warn(scenes: Iterable[Scene]) -> None:
    """Prints what speaks against these scenes on standard error, each line once."""
    for line in dict.fromkeys(line for scene in scenes for line in scene_warnings(scene)):
        print(f"jaxhf: warning: {line}", file=sys.stderr)


def scene_warnings(scene: Scene) -> Iterator[str]:
    """A line for each thing that makes a picture black or odd without being an error."""
    if not scene.lights:
        yield "the scene has no lights: the picture is black"
    camera = scene.camera
    looks_down = float(np.asarray(camera.world_from_camera)[2, 2]) < 0
    for k, light in enumerate(scene.lights):
        if isinstance(light, Directional) and (z := float(np.asarray(light.towards)[2])) < 0 and looks_down:
            yield f"lights[{k}]: it shines from below the horizon, its z is {z:.3g}: ground that is seen from above stays dark"
    if isinstance(camera, Perspective) and float(camera.fov) < _NARROW:
        yield f"camera: fov is {float(camera.fov):.4g} degrees, less than {_NARROW:g}; it is not in radians"
    if isinstance(camera, Perspective) and float(camera.fov) > _WIDE:
        yield f"camera: fov is {float(camera.fov):.4g} degrees, more than {_WIDE:g}; what it looks at is a dot in the middle"
    corners = []
    for k, item in enumerate(scene.objects):
        if not isinstance(item.shape, Heightfield):
            return  # the rest asks whether anything can be seen
        albedo = item.material.albedo if isinstance(item.material, Matte) else 0.0
        brightest = float(np.max(np.asarray(getattr(albedo, "texels", albedo))))
        if brightest > 1:
            yield f"objects[{k}]: albedo is {brightest:.4g}, more than 1: it sends out more light than it gets"
        heights = np.asarray(item.shape.heights)
        finite = heights[np.isfinite(heights)]
        if not finite.size:
            yield f"objects[{k}]: none of its heights is finite, there is nothing to see"
            continue
        lowest, highest = float(finite.min()), float(finite.max())
        if max(-lowest, highest) > _MOST_HEIGHT:
            far = lowest if -lowest > highest else highest
            yield f"objects[{k}]: heights reach {far:.7g}; is that a value that means no height (nodata)?"
        elif isinstance(camera, Perspective) and item.world_from_object is None:
            eye = np.asarray(camera.world_from_camera, np.float64)[:3, 3]
            field = item.shape
            ground = height_at(heights, (eye[0] - field.x0) / field.dx, (eye[1] - field.y0) / field.dy)
            if eye[2] <= ground:  # nan beside the footprint and in holes
                below = f"{ground - eye[2]:.4g} below the surface of objects[{k}], whose height there is {ground:.6g}"
                yield f"camera: eye stands {below}: it is seen from below"
        corners.append(_box(item, item.shape, lowest, highest))
    if corners and all(_out_of_view(camera, points) for points in corners):
        low, high = np.concatenate(corners).min(axis=0), np.concatenate(corners).max(axis=0)
        spans = ", ".join(f"{axis} {a:.6g} to {b:.6g}" for axis, a, b in zip("xyz", low, high, strict=True))
        yield f"camera: none of the terrain is in the picture, it spans {spans}"


def _box(item: Object, field: Heightfield, lowest: float, highest: float) -> Float[np.ndarray, "8 3"]:
    """The corners of a heightfield's bounding box, in the world."""
    ny, nx = field.heights.shape
    xs, ys = (field.x0, field.x0 + (nx - 1) * field.dx), (field.y0, field.y0 + (ny - 1) * field.dy)
    points = np.array([(x, y, z) for x in xs for y in ys for z in (lowest, highest)], np.float64)
    matrix = np.eye(4) if item.world_from_object is None else np.asarray(item.world_from_object, np.float64)
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def _out_of_view(camera: Camera, points: Float[np.ndarray, "n 3"]) -> bool:
    """Whether all points lie beyond one and the same side of what a camera sees: then so does their convex hull."""
    matrix = np.asarray(camera.world_from_camera, np.float64)
    x, y, z = np.linalg.inv(matrix[:3, :3]) @ (points - matrix[:3, 3]).T
    short = min(camera.width, camera.height)
    half = np.tan(np.radians(float(camera.fov)) / 2) * z if isinstance(camera, Perspective) else float(camera.extent) / 2
    right, up = half * camera.width / short, half * camera.height / short
    return any(side.all() for side in (z <= 0, x > right, -x > right, y > up, -y > up))
