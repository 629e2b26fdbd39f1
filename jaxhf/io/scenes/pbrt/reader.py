"""Reads scenes in the format of pbrt-v2, as far as a heightfield renderer needs it.

What pbrt-v2 would silently ignore is an error here: an unknown directive or parameter, a wrong number of values, a picture
that is not there. What is read means what pbrt-v2 makes of it, but for the names of files: they are relative to the file in
which they stand, not to the first one.
"""

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy.typing import DTypeLike

from ....core.affine import invertible, rotate, scale, translate
from ....core.errors import UserError
from ....core.precision import fitted
from ....core.rules import require
from ....scene.camera import Perspective
from ....scene.cylinder import Cylinder
from ....scene.heightfield import Heightfield
from ....scene.light import Directional, Light, Point
from ....scene.material import Material, Matte, Mirror, OrenNayar
from ....scene.scene import Object, Scene
from ....scene.texture import ImageTexture
from ...errors import SceneError, nearest, resolve_inside
from ...pictures.images import load_image
from .statements import Arguments, Statement, statements
from .tokens import Token, located

Matrix = Float[np.ndarray, "4 4"]


def load_pbrt(path: Path, dtype: DTypeLike = np.float32) -> Scene:
    """The scene that a .pbrt file describes; arguments and errors as those of `load_scene`.

    What it includes, and its images, must lie in its folder or below; a name is relative to the file in which it stands.
    """
    reader = _Reader(root=path.parent.resolve(), dtype=np.dtype(dtype))
    try:
        text = _read_text(path)
    except OSError as error:
        raise SceneError(path, None, error.strerror or str(error)) from error
    reader.run(path, text)
    if reader.world is None:
        raise SceneError(path, max(1, len(text.splitlines())), "the file ends without a WorldBegin")
    if reader.block == "world":
        raise reader.world.error("this WorldBegin has no WorldEnd")
    return Scene(reader.objects, reader.view, reader.lights, reader.samples)


def _read_text(path: Path) -> str:
    """Comments may be in any encoding: what is not UTF-8 is replaced, which spoils nothing but a file's name."""
    return path.read_text(encoding="utf-8-sig", errors="replace")


@dataclass
class _Reader:
    """The scene as far as it has been read.

    `matrix` is pbrt's current transformation: camera_from_world before WorldBegin, world_from_object behind it. AttributeBegin
    saves it with `material` and `textures`.
    """

    root: Path
    dtype: np.dtype
    block: str = "options"
    world: Token | None = None
    matrix: Matrix = field(default_factory=lambda: np.eye(4))
    material: Arguments | None = None
    textures: dict[str, tuple[Path, Token]] = field(default_factory=dict)  # the picture, and where it is named
    saved: list[tuple[Token, Matrix, Arguments | None, dict[str, tuple[Path, Token]]]] = field(default_factory=list)
    frames: dict[str, Matrix] = field(default_factory=dict)
    images: dict[Path, ImageTexture] = field(default_factory=dict)
    files: list[Path] = field(default_factory=list)
    resolution: tuple[int, int] = (640, 480)
    samples: int = 4  # of the "lowdiscrepancy" sampler that pbrt-v2 takes where a scene names none
    camera: Arguments | None = None
    view: Perspective = field(init=False)  # from WorldBegin on
    objects: list[Object] = field(default_factory=list)
    lights: list[Light] = field(default_factory=list)

    def run(self, path: Path, text: str) -> None:
        self.files.append(path.parent.resolve() / path.name)  # beside a link, not where it leads
        for statement in statements(path, text):
            with located(statement.word):
                self._execute(statement)
        self.files.pop()

    def _execute(self, statement: Statement) -> None:
        word = statement.word
        if word.text not in _BLOCKS:
            raise word.error(f"unknown directive {str(word)!r}; {nearest(word.text[:60], _BLOCKS)}")
        if self.block == "end" or _BLOCKS[word.text] not in ("any", self.block):
            rules = {"options": "follow WorldBegin", "world": "not follow WorldBegin", "end": "not follow WorldEnd"}
            raise word.error(f"{word} must {rules[self.block]}")
        match word.text:
            case "AttributeBegin" | "TransformBegin":
                self.saved.append((statement.nothing(), self.matrix, self.material, self.textures))
            case "AttributeEnd" | "TransformEnd":
                self._restore(statement.nothing())
            case "WorldBegin":
                self._world_begin(statement.nothing())
            case "WorldEnd":
                self._world_end(statement.nothing())
            case "Include":
                self._include(statement.name())
            case "Identity":
                statement.nothing()
                self.matrix = np.eye(4)
            case "CoordinateSystem":
                self.frames[statement.name().name()] = self.matrix
            case "CoordSysTransform":
                frame = statement.name()
                if frame.name() not in self.frames:
                    raise frame.error(f"unknown coordinate system {frame}; {nearest(frame.name(), self.frames)}")
                self.matrix = self.frames[frame.name()]
            case "Texture":
                self._declare_texture(statement)
            case "Film":
                args = statement.arguments()
                self.resolution = args["integer xresolution"], args["integer yresolution"]
            case "Sampler":
                self._sampler(statement.arguments())
            case "PixelFilter" | "SurfaceIntegrator":
                statement.arguments()  # which may only say what is done anyway
            case "Camera":
                self.camera, self.frames["camera"] = statement.arguments(), np.linalg.inv(self.matrix)
            case "LightSource":
                self._light_source(statement.arguments())
            case "Material":
                self.material = statement.arguments()
            case "Shape":
                self._shape(statement.arguments())
            case _:
                self._concatenate(statement)

    def _include(self, name: Token) -> None:
        with located(name):
            path = resolve_inside(self.root, self.files[-1].parent, name.name())
            if path in self.files:
                raise name.error(f"{name} includes itself")
            text = _read_text(path)
        self.run(path, text)

    def _world_begin(self, word: Token) -> None:
        if self.camera is None:
            raise word.error("there must be a Camera before WorldBegin")
        with located(self.camera.word):
            self.view = Perspective(self.frames["camera"], self.camera["float fov"], *self.resolution)
        self.block, self.world = "world", word
        self.matrix = self.frames["world"] = np.eye(4)

    def _world_end(self, word: Token) -> None:
        if self.saved:
            begin, *_ = self.saved[-1]
            raise begin.error(f"this {begin} has no {begin.text.replace('Begin', 'End')}")
        if not self.objects:
            raise word.error("there must be a Shape before WorldEnd")
        self.block = "end"

    def _restore(self, end: Token) -> None:
        opened = end.text.replace("End", "Begin")
        if not self.saved or self.saved[-1][0].text != opened:
            last = f"; the last to be opened is {self.saved[-1][0]} in line {self.saved[-1][0].line}" if self.saved else ""
            raise end.error(f"this {end} has no {opened}{last}")
        _, self.matrix, material, textures = self.saved.pop()
        if end.text == "AttributeEnd":
            self.material, self.textures = material, textures

    # Transforms: the current one is multiplied from the right, so that the last directive acts first on points.

    def _concatenate(self, statement: Statement) -> None:
        word = statement.word.text
        with np.errstate(all="ignore"):
            if word in _TRANSFORMS:
                count, make = _TRANSFORMS[word]
                matrix = make(*statement.numbers(count))
            else:
                matrix = statement.matrix()
            require("", word, matrix, invertible)
            if word != "Transform":
                matrix = self.matrix @ matrix
                require("", "the current transformation", matrix, invertible)
            self.matrix = matrix

    def _sampler(self, args: Arguments) -> None:
        if args.kind == "bestcandidate":
            self.samples = args["integer pixelsamples"]
            return
        if args["bool jitter"]:
            raise args.error("bool jitter", 'jitter must be "false": jittered samples, the default, are not supported')
        side = args["integer xsamples"]
        if args["integer ysamples"] != side:
            raise args.error("integer ysamples", f"ysamples must equal xsamples, {side}, it is {args['integer ysamples']}")
        self.samples = side * side

    def _light_source(self, args: Arguments) -> None:
        if args.kind == "point":  # pbrt-v2 moves it by "from" after the transformation, so "from" counts in world units
            light = Point(self.matrix[:3, 3] + args["point from"], args["color I"] * args["color scale"])
        else:
            towards = self.matrix[:3, :3] @ (args["point from"] - args["point to"])
            light = Directional(towards, args["color L"] * args["color scale"])
        self.lights.append(light)

    def _declare_texture(self, statement: Statement) -> None:
        name, value_type = statement.string(0), statement.string(1)
        if value_type.name() != "color":
            raise value_type.error(f'the type of a Texture must be "color", it is {value_type}')
        args = statement.arguments(at=2)
        place = args.tokens["string filename"]
        with located(place):
            path = resolve_inside(self.root, self.files[-1].parent, args["string filename"])
        self.textures = {**self.textures, name.name(): (path, place)}

    def _shape(self, args: Arguments) -> None:
        if args.kind == "heightfield":
            shape = _heightfield(args, self.dtype)
        else:
            shape = Cylinder(args["float radius"], args["float zmin"], args["float zmax"])
        world_from_object = None if np.array_equal(self.matrix, np.eye(4)) else self.matrix
        self.objects.append(Object(shape, self._made_material(), world_from_object))

    def _made_material(self) -> Material | Mirror:
        """Made where a shape uses it, with the textures of that place: pbrt-v2 lets a texture follow its material."""
        args = self.material
        if args is None:
            return Matte(0.5)
        with located(args.word):
            if args.kind == "mirror":
                return Mirror(args["color Kr"])
            name, known = args["texture Kd"], self.textures
            matte = functools.partial(OrenNayar, roughness=args["float sigma"]) if args["float sigma"] else Matte
            if name is None:
                return matte(args["color Kd"])
            if name not in known:
                hint = nearest(name[:60], known) if known else "there is none"
                raise args.error("texture Kd", f"unknown texture {name!r}; {hint}")
            path, place = known[name]
            if path not in self.images:
                with located(place):
                    self.images[path] = ImageTexture(load_image(path, transfer="srgb"))
            return matte(self.images[path])


def _heightfield(args: Arguments, dtype: np.dtype) -> Heightfield:
    """The surface of a `Shape "heightfield"`."""
    nu, nv, z = args["integer nu"], args["integer nv"], args["float Pz"]
    if z.size != nu * nv:
        raise args.error("float Pz", f"Pz must hold nu * nv = {nu} * {nv} = {nu * nv} heights, it holds {z.size}")
    with np.errstate(over="ignore"):
        heights = z.astype(dtype)
    bad = np.flatnonzero(~np.isfinite(heights))
    if bad.size:
        k = int(bad[0])
        message = f"Pz[{k}] (column {k % nu}, row {k // nu}) must be finite in {dtype}, it is {z[k]}"
        raise args.error("float Pz", message, k)
    return Heightfield(fitted(z, dtype).reshape(nv, nu))


def _look_at(*numbers: float) -> Matrix:
    """camera_from_world of pbrt-v2: x right, y up, z forward, left-handed in a right-handed world."""
    eye, target, up = np.reshape(numbers, (3, 3))
    if not np.any(target - eye):
        raise UserError(f"LookAt: the target must differ from the eye, both are {eye.tolist()}")
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(up, forward)
    length = np.linalg.norm(right)
    if not length > 1e-9 * np.linalg.norm(up):
        raise UserError(f"LookAt: up must not point along the view, it is {up.tolist()} for the view {forward.tolist()}")
    right = right / length
    world_from_camera = np.eye(4)
    world_from_camera[:3] = np.stack([right, np.cross(forward, right), forward, eye], axis=1)
    return np.linalg.inv(world_from_camera)


_TRANSFORMS: Mapping[str, tuple[int, Callable[..., Any]]] = {
    "LookAt": (9, _look_at),
    "Rotate": (4, rotate),
    "Scale": (3, scale),
    "Translate": (3, translate),
}
_BLOCKS: Mapping[str, str] = {  # where a directive may stand
    **dict.fromkeys(("Camera", "Film", "PixelFilter", "Sampler", "SurfaceIntegrator", "WorldBegin"), "options"),
    **dict.fromkeys(("AttributeBegin", "AttributeEnd", "TransformBegin", "TransformEnd", "WorldEnd"), "world"),
    **dict.fromkeys(("LightSource", "Material", "Shape", "Texture"), "world"),
    **dict.fromkeys(("CoordSysTransform", "CoordinateSystem", "Identity", "Include"), "any"),
    **dict.fromkeys(("ConcatTransform", "Transform", *_TRANSFORMS), "any"),
}
