"""What is in the picture."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ._camera import Camera
from ._cylinder import Cylinder
from ._heightfield import Heightfield
from ._light import Light, Point, Sky
from ._material import Material, Matte
from ._transform import require_invertible, translate
from ._types import AnyArray, MatrixLeaf, float_leaf

Shape = Heightfield | Cylinder


class Object(eqx.Module):
    """A shape, what it is made of, and where it stands.

    Attributes:
      shape: a `Heightfield` or a `Cylinder`.
      material: `Matte` or `Mirror`.
      world_from_object: 4x4, affine and invertible; None: the object's frame is the world's.
    """

    shape: Shape
    material: Material = eqx.field(default_factory=lambda: Matte(0.7))
    world_from_object: MatrixLeaf | None = None

    def __init__(self, shape: Shape, material: Material | None = None, world_from_object: Any = None):
        self.shape = shape
        self.material = Matte(0.7) if material is None else material
        self.world_from_object = None if world_from_object is None else float_leaf(world_from_object)
        if not isinstance(shape, Shape):
            raise ValueError(f"Object: shape must be a Heightfield or a Cylinder, it is {type(shape).__name__}")
        if not isinstance(self.material, Material):
            raise ValueError(f"Object: material must be Matte or Mirror, it is {type(self.material).__name__}")
        if self.world_from_object is not None:
            require_invertible("Object: world_from_object", self.world_from_object)


class Scene(eqx.Module):
    """Objects, seen by a camera, in light.

    Attributes:
      objects: at least one `Object`.
      camera: a `Perspective` or an `Orthographic`.
      lights: any number of `Directional`, `Point` and at most one `Sky`.
      samples: rays a pixel that the scene asks for; `Settings.samples` overrules it.
    """

    objects: tuple[Object, ...] = eqx.field(converter=tuple)
    camera: Camera
    lights: tuple[Light, ...] = eqx.field(converter=tuple, default=())
    samples: int = eqx.field(static=True, default=1)

    def __check_init__(self):
        if not self.objects:
            raise ValueError("Scene: objects must hold at least one Object, it is empty")
        for place, values, kinds in (
            ("objects", self.objects, Object),
            ("camera", (self.camera,), Camera),
            ("lights", self.lights, Light),
        ):
            for value in values:
                if not isinstance(value, kinds):
                    raise ValueError(f"Scene: {place} does not take a {type(value).__name__}")
        if sum(isinstance(light, Sky) for light in self.lights) > 1:
            raise ValueError("Scene: lights may hold one Sky, they hold more")
        if not isinstance(self.samples, int) or self.samples < 1:
            raise ValueError(f"Scene: samples must be a whole number from 1 on, it is {self.samples!r}")

    @property
    def heightfields(self) -> tuple[Heightfield, ...]:
        """The shapes that are heightfields, in the order of `objects`."""
        return tuple(obj.shape for obj in self.objects if isinstance(obj.shape, Heightfield))

    @property
    def heights(self) -> Float[AnyArray, "ny nx"]:
        """The heights of the first heightfield, shape (ny, nx); ValueError where the scene has none."""
        if not self.heightfields:
            raise ValueError("Scene: there is no heightfield among its objects")
        return self.heightfields[0].heights

    def with_heights(self, heights: Any) -> "Scene":
        """The same scene over other heights of the same shape and precision; nothing is compiled again."""
        old = self.heights
        new = jnp.asarray(heights, old.dtype)
        if new.shape != old.shape:
            raise ValueError(f"with_heights: heights must keep their shape {old.shape}, theirs is {new.shape}")
        return eqx.tree_at(lambda scene: scene.heightfields[0].heights, self, new)


def localise(scene: Scene) -> Scene:
    """The same scene seen from an origin at the first heightfield's corner, every leaf in the precision of its heights.

    Where positions are still NumPy numbers the move happens in double precision, so that a terrain in UTM coordinates
    (northings of 5e6, where single precision has steps of 0.5) renders to the same bits as one at the origin.
    """
    anchor = _anchor(scene)

    def moved_object(obj: Object) -> Object:
        shape, corner = obj.shape, _grid_corner(obj.shape)
        if isinstance(shape, Heightfield):
            shape = Heightfield(shape.heights, shape.dx, shape.dy)
        world: Any = np.eye(4) if obj.world_from_object is None else obj.world_from_object
        shift = world[:3, :3] @ _like(world, corner) - _like(world, anchor)
        if obj.world_from_object is None and not np.any(shift):
            return Object(shape, obj.material)
        return Object(shape, obj.material, _shifted(world, shift))

    def moved_light(light: Light) -> Light:
        return Point(light.p - _like(light.p, anchor), light.intensity) if isinstance(light, Point) else light

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
    moved = eqx.tree_at(lambda camera: camera.world_from_camera, camera, _shifted(matrix, -_like(matrix, _anchor(scene))))
    dtype = scene.heights.dtype if scene.heightfields else jnp.result_type(float)
    return jax.tree.map(lambda leaf: _in_precision(leaf, dtype), moved)


def _in_precision(leaf: Any, dtype: Any) -> Any:
    """A NumPy leaf stays on the host, from where a compiled program takes it sooner than a copy by hand."""
    return jnp.asarray(leaf, dtype) if isinstance(leaf, jax.Array) else np.asarray(leaf, dtype)


def _grid_corner(shape: Shape) -> np.ndarray:
    """Where a heightfield's vertex (0, 0) stands, at height 0, in its object's frame."""
    return np.array([shape.x0, shape.y0, 0.0]) if isinstance(shape, Heightfield) else np.zeros(3)


def _anchor(scene: Scene) -> np.ndarray:
    """The first heightfield's corner in the world; the world's own origin where that is traced or there is none."""
    obj = next((obj for obj in scene.objects if isinstance(obj.shape, Heightfield)), None)
    world: Any = None if obj is None else obj.world_from_object
    if obj is None or isinstance(world, jax.Array):
        return np.zeros(3)
    corner = _grid_corner(obj.shape)
    return corner if world is None else world[:3, :3] @ corner + world[:3, 3]


def _like(leaf: Any, value: np.ndarray) -> Any:
    """`value` as it is beside a NumPy leaf, in the leaf's precision beside a JAX one."""
    return jnp.asarray(value, leaf.dtype) if isinstance(leaf, jax.Array) else value


def _shifted(matrix: Any, shift: Any) -> Any:
    """`matrix` followed by a translation."""
    return matrix.at[:3, 3].add(shift) if isinstance(matrix, jax.Array) else translate(*shift) @ matrix
