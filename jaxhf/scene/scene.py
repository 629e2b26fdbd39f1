"""Scenes: objects, a camera and lights."""

import dataclasses
from collections.abc import Iterable
from typing import Any, get_args

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..core.affine import invertible
from ..core.errors import ArgumentError, UserError, kind_of, require_kind, whole_number
from ..core.rules import Whole
from ..core.settings import MOST_SAMPLES
from ..core.types import AnyArray, MatrixLeaf, float_leaf, height_leaf
from .camera import Camera
from .cylinder import Cylinder
from .heightfield import Heightfield
from .light import Light, Sky, Sun
from .material import Material, Matte, Mirror
from .record import Record, numbers
from .skirt import Skirt

Shape = Heightfield | Cylinder | Skirt


def _listed(values: Any) -> tuple[Any, ...]:
    if not isinstance(values, Iterable):
        raise UserError(f"Scene: objects and lights must be lists of them, here {kind_of(values)} stands alone")
    return tuple(values)


def _with_arrays(material: Any) -> Any:
    """A material whose fields are arrays where they were given as numbers; ArgumentError where one can be no leaf."""
    for field in dataclasses.fields(material) if isinstance(material, Material) else ():
        value, static = getattr(material, field.name), field.metadata.get("static")
        if isinstance(value, str) and not static:
            rule = f"must be numbers or an ImageTexture, unless it is an eqx.field(static=True); it is {value!r}"
            raise ArgumentError(type(material).__name__, field.name, rule)
        if isinstance(value, float | int | np.generic) and not static:
            material = eqx.tree_at(lambda material, name=field.name: getattr(material, name), material, float_leaf(value))
    return material


class Object(Record):
    """A shape with its material and its transform.

    Attributes:
      shape: a `Heightfield`, a `Cylinder` or a `Skirt`.
      material: a `Material`, such as `Matte`, or a `Mirror`.
      world_from_object: 4x4, affine and invertible; None: the object's frame is the world's.
    """

    shape: Shape
    material: Material | Mirror
    world_from_object: MatrixLeaf | None = eqx.field(default=None, metadata={"rule": invertible})

    def __init__(self, shape: Shape, material: Material | Mirror | None = None, world_from_object: Any = None):
        self.shape = shape
        self.material = Matte(0.7) if material is None else _with_arrays(material)
        self.world_from_object = None if world_from_object is None else float_leaf(world_from_object)

    def _require_consistent(self):
        require_kind("Object", "shape", self.shape, get_args(Shape), "a Heightfield, Cylinder or Skirt")
        require_kind("Object", "material", self.material, (Material, Mirror), "a Material or a Mirror")

    def __repr__(self) -> str:
        pose = "" if self.world_from_object is None else f", world_from_object={numbers(self.world_from_object)}"
        return f"Object({self.shape!r}, {self.material!r}{pose})"


class Scene(Record):
    """Objects, the camera that sees them, and the lights.

    Attributes:
      objects: at least one `Object`.
      camera: a `Perspective` or an `Orthographic`.
      lights: any number of `Directional`, `Sun`, `Point` and at most one `Sky`.
      samples: rays a pixel that the scene asks for; `Settings.samples` overrules it.
    """

    objects: tuple[Object, ...] = eqx.field(converter=_listed)
    camera: Camera
    lights: tuple[Light, ...] = eqx.field(converter=_listed, default=())
    samples: int = eqx.field(converter=whole_number, static=True, default=1, metadata={"rule": Whole(1, MOST_SAMPLES)})

    def _require_consistent(self):
        if not self.objects:
            raise ArgumentError("Scene", "objects", "must hold at least one Object, it is empty")
        for name, values, kinds in (
            ("objects", self.objects, Object),
            ("camera", (self.camera,), Camera),
            ("lights", self.lights, Light),
        ):
            for value in values:
                if not isinstance(value, kinds):
                    hint = ", jaxhf.Object(shape, material) does" if name == "objects" and isinstance(value, Shape) else ""
                    raise ArgumentError("Scene", name, f"does not take a {type(value).__name__}{hint}")
        if sum(isinstance(light, Sky) for light in self.lights) > 1:
            raise ArgumentError("Scene", "lights", "may hold one Sky, they hold more")
        sun = any(isinstance(light, Sun) for light in self.lights)
        if sun or self.sky_occlusion is not None:
            for number, obj in enumerate(self.objects):
                if isinstance(obj.shape, (Heightfield | Skirt) if sun else Heightfield) and not _upright(obj.world_from_object):
                    rule = f"must keep heights upright under a {'Sun' if sun else 'Sky with occlusion'}"
                    raise ArgumentError("Scene", f"objects[{number}].world_from_object", rule)

    @property
    def sky_occlusion(self) -> int | None:
        """That of the `Sky` among the lights; None where there is none."""
        return next((light.occlusion for light in self.lights if isinstance(light, Sky)), None)

    @property
    def heightfields(self) -> tuple[Heightfield, ...]:
        """The shapes that are heightfields, in the order of `objects`."""
        return tuple(obj.shape for obj in self.objects if isinstance(obj.shape, Heightfield))

    @property
    def first_heightfield(self) -> int:
        """The number of the first heightfield among `objects`."""
        return next(number for number, obj in enumerate(self.objects) if isinstance(obj.shape, Heightfield))

    @property
    def heights(self) -> Float[AnyArray, "ny nx"]:
        """The heights of the first heightfield, shape (ny, nx); ValueError where the scene has none."""
        if not self.heightfields:
            raise UserError("Scene: there is no heightfield among its objects")
        return self.heightfields[0].heights

    def __repr__(self) -> str:
        return f"Scene(objects={self.objects!r}, camera={self.camera!r}, lights={self.lights!r}, samples={self.samples})"

    def with_camera(self, camera: Camera) -> "Scene":
        """The same scene seen by another camera.

        Nothing is compiled again if its picture is as large. If both have more than 64 tiles of `Settings.chunk` pixels, only
        what puts these together is, in 0.05 s, and on several devices nothing.
        """
        return dataclasses.replace(self, camera=camera)

    def with_lights(self, lights: Iterable[Light]) -> "Scene":
        """The same scene in another light; nothing is compiled again if these are as many lights of the same types."""
        return dataclasses.replace(self, lights=lights)

    def with_heights(self, heights: Any) -> "Scene":
        """The same scene over other heights of the same shape and precision; nothing is compiled again."""
        old = self.heights
        new = height_leaf("with_heights", "heights", heights, old.dtype)
        if new.shape != old.shape:
            raise ArgumentError("with_heights", "heights", f"must keep their shape {old.shape}, theirs is {new.shape}")
        return eqx.tree_at(lambda scene: scene.heightfields[0].heights, self, new)


def resized(scene: Scene, width: int | None, height: int | None) -> Scene:
    """The same view in a picture of width x height pixels; one of them that is None follows from the proportions."""
    old = scene.camera
    if width is None:
        width = old.width if height is None else max(1, round(height * old.width / old.height))
    if height is None:
        height = max(1, round(width * old.height / old.width))
    return scene.with_camera(dataclasses.replace(old, width=width, height=height))


def shrunk(scene: Scene, pixels: int) -> Scene:
    """The same view in a picture whose longer side has at most so many pixels."""
    width, height = scene.camera.width, scene.camera.height
    scale = min(1.0, pixels / max(width, height))
    return resized(scene, max(1, round(scale * width)), max(1, round(scale * height)))


def _upright(world: MatrixLeaf | None) -> bool:
    """Whether the object's vertical and horizontal directions are the world's; taken for granted of a traced matrix."""
    if not isinstance(world, np.ndarray):
        return True
    size = 1e-6 * np.abs(world[:3, :3]).max()
    return bool(world[2, 2] > 0 and max(abs(world[0, 2]), abs(world[1, 2]), abs(world[2, 0]), abs(world[2, 1])) <= size)
