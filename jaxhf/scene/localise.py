"""A scene moved to the terrain's corner, in the precision of its heights."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..core.affine import affine, translate
from .camera import Camera
from .heightfield import Heightfield
from .light import Light, Point
from .scene import Object, Scene, Shape
from .skirt import Skirt


def localise(scene: Scene) -> Scene:
    """The same scene seen from an origin at the first heightfield's corner, every leaf in the precision of its heights.

    Where positions are still NumPy numbers the move happens in double precision, so that a terrain in UTM coordinates
    (northings of 5e6, where single precision has steps of 0.5) renders to the same bits as one at the origin.
    """
    origin = anchor(scene)

    def moved_object(obj: Object) -> Object:
        shape, corner = obj.shape, _grid_corner(obj.shape)
        if isinstance(shape, Heightfield):
            shape = Heightfield(shape.heights, shape.dx, shape.dy)
        elif isinstance(shape, Skirt):
            shape = dataclasses.replace(shape, x0=0.0, y0=0.0)
        world: Any = np.eye(4) if obj.world_from_object is None else obj.world_from_object
        shift = affine(world).vector(_like(world, corner)) - _like(world, origin)
        if obj.world_from_object is None and not np.any(shift):
            return Object(shape, obj.material)
        return Object(shape, obj.material, _shifted(world, shift))

    def moved_light(light: Light) -> Light:
        return Point(light.p - _like(light.p, origin), light.intensity) if isinstance(light, Point) else light

    moved = Scene(
        objects=tuple(moved_object(obj) for obj in scene.objects),
        camera=scene.camera,
        lights=tuple(moved_light(light) for light in scene.lights),
        samples=scene.samples,
    )
    dtype = scene.heights.dtype if scene.heightfields else jnp.result_type(float)
    moved = jax.tree.map(lambda leaf: _in_precision(leaf, dtype), moved)
    return eqx.tree_at(lambda moved: moved.camera, moved, localise_camera(scene.camera, scene))


def localise_camera(camera: Camera, scene: Scene) -> Camera:
    """A camera for `localise(scene)`."""
    matrix = camera.world_from_camera
    moved = eqx.tree_at(lambda camera: camera.world_from_camera, camera, _shifted(matrix, -_like(matrix, anchor(scene))))
    dtype = scene.heights.dtype if scene.heightfields else jnp.result_type(float)
    return jax.tree.map(lambda leaf: _in_precision(leaf, dtype), moved)


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
