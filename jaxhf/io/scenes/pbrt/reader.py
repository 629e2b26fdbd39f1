"""Reads scenes in the format of pbrt-v2, as far as a heightfield renderer needs it.

What pbrt-v2 would silently ignore is an error here: an unknown directive or parameter, a wrong number of values, a picture
that is not there. What is read means what pbrt-v2 makes of it, but for the names of files: they are relative to the file in
which they stand, not to the first one.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import DTypeLike

from ....core.affine import require_invertible
from ....scene.camera import Perspective
from ....scene.light import Light
from ....scene.material import Material, Matte, Mirror
from ....scene.scene import Object, Scene
from ....scene.texture import ImageTexture
from ...errors import SceneError, nearest, resolve_inside
from ...pictures.images import load_image
from .parts import DEFAULT_SAMPLES, KINDS, LIGHTS, RULES, SAMPLERS, SHAPES, TRANSFORMS, Matrix
from .statements import Arguments, Statement, statements
from .tokens import Token, located


def load_pbrt(path: str | Path, dtype: DTypeLike = np.float32) -> Scene:
    """The scene that a .pbrt file describes; arguments and errors as those of `load_scene`.

    What it includes, and its images, must lie in its folder or below; a name is relative to the file in which it stands.
    """
    path = Path(path)
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
    return reader.scene()


def _read_text(path: Path) -> str:
    """Comments may be in any encoding: what is not UTF-8 is replaced, which spoils nothing but a file's name."""
    return path.read_text(encoding="utf-8-sig", errors="replace")


@dataclass(frozen=True)
class _Graphics:
    """What AttributeBegin saves and AttributeEnd brings back; `world_from_object` is pbrt's current transformation."""

    world_from_object: Matrix = field(default_factory=lambda: np.eye(4))
    material: Arguments | None = None
    textures: Mapping[str, tuple[Path, Token]] = field(default_factory=dict)  # the picture, and where it is named


@dataclass
class _Reader:
    """The scene as far as it has been read. Before WorldBegin the current transformation is camera_from_world."""

    root: Path
    dtype: np.dtype
    block: str = "options"
    world: Token | None = None
    graphics: _Graphics = field(default_factory=_Graphics)
    saved: list[tuple[Token, _Graphics]] = field(default_factory=list)
    frames: dict[str, Matrix] = field(default_factory=dict)
    images: dict[Path, ImageTexture] = field(default_factory=dict)
    files: list[Path] = field(default_factory=list)
    resolution: tuple[int, int] = (640, 480)
    samples: int = DEFAULT_SAMPLES
    camera: Arguments | None = None
    objects: list[Object] = field(default_factory=list)
    lights: list[Light] = field(default_factory=list)

    def run(self, path: Path, text: str) -> None:
        self.files.append(path.parent.resolve() / path.name)  # beside a link, not where it leads
        for statement in statements(path, text):
            self._execute(statement)
        self.files.pop()

    def scene(self) -> Scene:
        assert self.camera is not None, "WorldBegin demands a camera"
        width, height = self.resolution
        with located(self.camera.word):
            camera = Perspective(self.frames["camera"], self.camera["float fov"], width=width, height=height)
        return Scene(objects=tuple(self.objects), camera=camera, lights=tuple(self.lights), samples=self.samples)

    def _execute(self, statement: Statement) -> None:
        word = statement.word
        directive = _DIRECTIVES.get(word.text)
        if directive is None:
            raise word.error(f"unknown directive {str(word)!r}; {nearest(word.text[:60], _DIRECTIVES)}")
        if self.block == "end":
            raise word.error(f"{word} must not follow WorldEnd")
        block, takes, run = directive
        if block not in ("any", self.block):
            late = self.world is not None
            raise word.error(f"{word} must {'not ' if late else ''}follow WorldBegin")
        run(self, takes(statement))

    # Blocks, files, attributes.

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
        self.block, self.world = "world", word
        self._set_transform(np.eye(4))
        self.frames["world"] = np.eye(4)

    def _world_end(self, word: Token) -> None:
        if self.saved:
            begin, _ = self.saved[-1]
            raise begin.error(f"this {begin} has no {begin.text.replace('Begin', 'End')}")
        if not self.objects:
            raise word.error("there must be a Shape before WorldEnd")
        self.block = "end"

    def _save(self, begin: Token) -> None:
        self.saved.append((begin, self.graphics))

    def _restore(self, end: Token) -> None:
        opened = end.text.replace("End", "Begin")
        if not self.saved or self.saved[-1][0].text != opened:
            last = f"; the last to be opened is {self.saved[-1][0]} in line {self.saved[-1][0].line}" if self.saved else ""
            raise end.error(f"this {end} has no {opened}{last}")
        _, graphics = self.saved.pop()
        if end.text == "TransformEnd":
            graphics = replace(self.graphics, world_from_object=graphics.world_from_object)
        self.graphics = graphics

    # Transforms: the current one is multiplied from the right, so that the last directive acts first on points.

    def _set_transform(self, matrix: Matrix) -> None:
        self.graphics = replace(self.graphics, world_from_object=matrix)

    def _concatenate(self, statement: Statement) -> None:
        word = statement.word
        with np.errstate(all="ignore"), located(word):
            if word.text in TRANSFORMS:
                count, make = TRANSFORMS[word.text]
                matrix = make(*statement.numbers(count))
            else:
                matrix = statement.matrix()
            require_invertible("", word.text, matrix)
            if word.text != "Transform":
                matrix = self.graphics.world_from_object @ matrix
                require_invertible("", "the current transformation", matrix)
            self._set_transform(matrix)

    def _identity(self, _: Token) -> None:
        self._set_transform(np.eye(4))

    def _name_frame(self, name: Token) -> None:
        self.frames[name.name()] = self.graphics.world_from_object

    def _enter_frame(self, name: Token) -> None:
        if name.name() not in self.frames:
            raise name.error(f"unknown coordinate system {name}; {nearest(name.name(), self.frames)}")
        self._set_transform(self.frames[name.name()])

    # The camera and its picture.

    def _film(self, args: Arguments) -> None:
        self.resolution = args["integer xresolution"], args["integer yresolution"]

    def _sampler(self, args: Arguments) -> None:
        self.samples = SAMPLERS[args.kind](args)

    def _only_checked(self, args: Arguments) -> None:
        """Of a directive whose parameters may have one value only."""

    def _camera(self, args: Arguments) -> None:
        with located(args.word):
            self.frames["camera"] = np.linalg.inv(self.graphics.world_from_object)
        self.camera = args

    # The world.

    def _light_source(self, args: Arguments) -> None:
        with located(args.word):
            self.lights.append(LIGHTS[args.kind](args, self.graphics.world_from_object))

    def _declare_texture(self, statement: Statement) -> None:
        name, value_type = statement.string(0), statement.string(1)
        if value_type.name() != "color":
            raise value_type.error(f'the type of a Texture must be "color", it is {value_type}')
        args = statement.arguments(KINDS["Texture"], RULES, at=2)
        place = args.tokens["string filename"]
        with located(place):
            path = resolve_inside(self.root, self.files[-1].parent, args["string filename"])
        self.graphics = replace(self.graphics, textures={**self.graphics.textures, name.name(): (path, place)})

    def _set_material(self, args: Arguments) -> None:
        self.graphics = replace(self.graphics, material=args)

    def _shape(self, args: Arguments) -> None:
        matrix = self.graphics.world_from_object
        with located(args.word):
            shape = SHAPES[args.kind](args, self.dtype)
            self.objects.append(Object(shape, self._material(), None if np.array_equal(matrix, np.eye(4)) else matrix))

    def _material(self) -> Material:
        """Made where a shape uses it, with the textures of that place: pbrt-v2 lets a texture follow its material."""
        args = self.graphics.material
        if args is None:
            return Matte(0.5)
        with located(args.word):
            if args.kind == "mirror":
                return Mirror(args.colour("color Kr"))
            return Matte(self._texture(args) if "texture Kd" in args.tokens else args.colour("color Kd"))

    def _texture(self, args: Arguments) -> ImageTexture:
        name, known = args["texture Kd"], self.graphics.textures
        if name not in known:
            hint = nearest(name[:60], known) if known else "there is none"
            raise args.error("texture Kd", f"unknown texture {name!r}; {hint}")
        path, place = known[name]
        if path not in self.images:
            with located(place):
                self.images[path] = ImageTexture(load_image(path, transfer="srgb"))
        return self.images[path]


def _arguments(statement: Statement) -> Arguments:
    return statement.arguments(KINDS[statement.word.text], RULES)


def _all(statement: Statement) -> Statement:
    return statement


# Where a directive may stand ("options", "world", "any"), what it takes, and what it does.
_DIRECTIVES: Mapping[str, tuple[str, Callable[[Statement], Any], Callable[[_Reader, Any], None]]] = {
    "AttributeBegin": ("world", Statement.nothing, _Reader._save),
    "AttributeEnd": ("world", Statement.nothing, _Reader._restore),
    "Camera": ("options", _arguments, _Reader._camera),
    "CoordSysTransform": ("any", Statement.name, _Reader._enter_frame),
    "CoordinateSystem": ("any", Statement.name, _Reader._name_frame),
    "Film": ("options", _arguments, _Reader._film),
    "Identity": ("any", Statement.nothing, _Reader._identity),
    "Include": ("any", Statement.name, _Reader._include),
    "LightSource": ("world", _arguments, _Reader._light_source),
    "Material": ("world", _arguments, _Reader._set_material),
    "PixelFilter": ("options", _arguments, _Reader._only_checked),
    "Sampler": ("options", _arguments, _Reader._sampler),
    "Shape": ("world", _arguments, _Reader._shape),
    "SurfaceIntegrator": ("options", _arguments, _Reader._only_checked),
    "Texture": ("world", _all, _Reader._declare_texture),
    "TransformBegin": ("world", Statement.nothing, _Reader._save),
    "TransformEnd": ("world", Statement.nothing, _Reader._restore),
    "WorldBegin": ("options", Statement.nothing, _Reader._world_begin),
    "WorldEnd": ("world", Statement.nothing, _Reader._world_end),
    **dict.fromkeys(("ConcatTransform", "Transform", *TRANSFORMS), ("any", _all, _Reader._concatenate)),
}
