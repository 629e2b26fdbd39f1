"""A scene moved to the terrain's corner, in the precision of its heights."""

import dataclasses
import functools
import math
from collections.abc import Iterable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from ..core.affine import affine, translate
from ..scene.camera import Camera
from ..scene.heightfield import Heightfield
from ..scene.light import Light, Point
from ..scene.record import changed
from ..scene.scene import Object, Scene, Shape
from ..scene.skirt import Skirt
from ..xla.compilation import compiled


def localise(scene: Scene) -> Scene:
    """The same scene seen from an origin at the first heightfield's corner, every leaf in the precision of its heights.

    Where positions are still NumPy numbers the move happens in double precision, so that a terrain in UTM coordinates
    (northings of 5e6, where single precision has steps of 0.5) renders to the same bits as one at the origin.
    """
    origin, dtype = anchor(scene), precision(scene)

    def moved_object(obj: Object) -> Object:
        shape, corner = obj.shape, _grid_corner(obj.shape)
        if isinstance(shape, Heightfield):
            shape = Heightfield(shape.heights, shape.dx, shape.dy, seam=shape.seam)
        elif isinstance(shape, Skirt):
            shape = dataclasses.replace(shape, x0=0.0, y0=0.0)
        world: Any = np.eye(4) if obj.world_from_object is None else obj.world_from_object
        shift = affine(world).vector(_like(world, corner)) - _like(world, origin)
        if obj.world_from_object is None and not np.any(shift):
            return Object(shape, obj.material)
        return Object(shape, obj.material, _shifted(world, shift))

    moved = Scene(
        objects=tuple(moved_object(obj) for obj in scene.objects),
        camera=scene.camera,
        lights=localise_lights(scene.lights, origin, dtype),
        samples=scene.samples,
    )
    objects = jax.tree.map(lambda leaf: _in_precision(leaf, dtype), moved.objects)
    return changed(moved, objects=objects, camera=localise_camera(scene.camera, scene, origin, dtype))


def precision(scene: Scene) -> Any:
    """The dtype in which a scene is rendered: that of its first heights."""
    return scene.heightfields[0].heights.dtype if scene.heightfields else jnp.result_type(float)


def localise_lights(lights: Iterable[Light], origin: np.ndarray, dtype: Any) -> tuple[Light, ...]:
    """Lights for a `localise`d scene whose origin that is."""
    moved = tuple(
        Point(light.p - _like(light.p, origin), light.intensity) if isinstance(light, Point) else light for light in lights
    )
    return jax.tree.map(lambda leaf: _in_precision(leaf, dtype), moved)


def localise_camera(camera: Camera, scene: Scene | None, origin: np.ndarray, dtype: Any) -> Camera:
    """A camera for `localise(scene)`, whose origin and precision these are.

    From 700 km single precision tells places apart to 0.06. So of a camera that is far from all that it sees, and whose pose
    is still NumPy's, rays begin on a plane in front of that: the matrix is moved there in double precision, and `_ahead` says
    by how much, in units of its third column. Not where the scene is not known.
    """
    matrix: Any = camera.world_from_camera
    moved = _shifted(matrix, -_like(matrix, origin))
    far = None if scene is None else _far(matrix, scene)
    if scene is not None and far is not None:
        distance, size, shares = far
        moved[:3, 3] += distance * moved[:3, 2]
        shapes = tuple(obj.shape for obj in scene.objects)
        numbers = (np.asarray(value, dtype) for value in (shares, moved, distance, size))
        moved, ahead = _in_front(shapes, *numbers)
        camera = dataclasses.replace(camera, _ahead=ahead)
    return jax.tree.map(lambda leaf: _in_precision(leaf, dtype), changed(camera, world_from_camera=moved))


_FAR = 16  # times the size of the scene: nearer cameras see well enough from where they are


def _far(matrix: Any, scene: Scene) -> tuple[float, float, list[float]] | None:
    """Of a far camera, in units of its third column: the depth of the nearest corner of what it sees, were heights 0; how large
    that is; and how much nearer a height of 1 may be, for each object. None for other cameras.

    Also where a matrix is JAX's, or there is a cylinder, on the inside of which a camera may be.
    """
    if not isinstance(matrix, np.ndarray):
        return None
    depth, nearest, size, shares = np.linalg.inv(matrix)[2], math.inf, 0.0, []
    for obj in scene.objects:
        shape, world = obj.shape, obj.world_from_object
        if isinstance(world, jax.Array) or not isinstance(shape, Heightfield | Skirt):
            return None
        ny, nx = shape.heights.shape if isinstance(shape, Heightfield) else (len(shape.west), len(shape.south))
        length_x, length_y = shape.dx * (nx - 1), shape.dy * (ny - 1)
        x, y, z, corner = (depth if world is None else depth @ world).tolist()
        nearest = min(nearest, corner + x * shape.x0 + y * shape.y0 + min(0, x * length_x) + min(0, y * length_y))
        stretch = 1.0 if world is None else float(np.abs(world[:3, :2]).sum())
        size = max(size, (length_x + length_y) * stretch * math.hypot(*depth[:3].tolist()))
        shares.append(abs(z))
    return (nearest, size, shares) if nearest > _FAR * size else None


@compiled
def _in_front(shapes: tuple[Shape, ...], shares: Any, matrix: Any, distance: Any, size: Any) -> tuple[jax.Array, jax.Array]:
    """A pose at that distance, moved back until it is in front of all heights, and the distance that is left."""
    reaches = [share * _highest(shape, share.dtype) for shape, share in zip(shapes, shares, strict=True)]
    back = lax.stop_gradient(jnp.minimum(functools.reduce(jnp.maximum, reaches) + size, distance))
    return matrix.at[:3, 3].add(-back * matrix[:3, 2]), distance - back


def _highest(shape: Shape, dtype: Any) -> jax.Array:
    """How far its heights are from 0."""
    leaves = [jnp.asarray(leaf, dtype) for leaf in jax.tree.leaves(shape)]
    return functools.reduce(jnp.maximum, [jnp.max(jnp.where(jnp.isfinite(leaf), jnp.abs(leaf), 0)) for leaf in leaves])


def _in_precision(leaf: Any, dtype: Any) -> Any:
    """A NumPy leaf stays on the host, from where a compiled program takes it sooner than a copy by hand."""
    return jnp.asarray(leaf, dtype) if isinstance(leaf, jax.Array) else np.asarray(leaf, dtype)


def _grid_corner(shape: Shape) -> np.ndarray:
    """The position of a heightfield's vertex (0, 0) at height 0, in its object's frame; also that of its skirt."""
    return np.array([shape.x0, shape.y0, 0.0]) if isinstance(shape, Heightfield | Skirt) else np.zeros(3)


def anchor(scene: Scene) -> np.ndarray:
    """The first heightfield's corner in the world; the world's own origin where that is traced or there is none."""
    obj = next((obj for obj in scene.objects if isinstance(obj.shape, Heightfield)), None)
    world: Any = None if obj is None else obj.world_from_object
    if obj is None or isinstance(world, jax.Array):
        return np.zeros(3)
    corner: Any = _grid_corner(obj.shape)
    return corner if world is None else np.asarray(affine(world).point(corner))


def _like(leaf: Any, value: np.ndarray) -> Any:
    """`value` as it is beside a NumPy leaf, in the leaf's precision beside a JAX one."""
    return jnp.asarray(value, leaf.dtype) if isinstance(leaf, jax.Array) else value


def _shifted(matrix: Any, shift: Any) -> Any:
    """`matrix` followed by a translation."""
    return matrix.at[:3, 3].add(shift) if isinstance(matrix, jax.Array) else translate(*shift) @ matrix
