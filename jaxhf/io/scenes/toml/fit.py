"""Reads what to recover from which pictures: a scene with tables about pictures; `docs/guides/fit-files.md` describes it."""

import dataclasses
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float32
from numpy.typing import DTypeLike

from ....core.errors import ArgumentError, UserError
from ....core.rules import OneOf, Whole
from ....core.settings import Settings
from ....scene.camera import Camera
from ....scene.heightfield import Heightfield
from ....scene.light import Light
from ....scene.scene import Object, Scene
from ...files import PathLike, by_ending, require_file, require_precision
from ...pictures.images import load_numbers
from ..pbrt.reader import load_pbrt
from .checks import Part
from .priors import Provenance, known_heights
from .scene import open_toml, read_camera, read_image, read_lights, read_samples, read_world
from .tables import SCENE, Key, Keys, optional
from .values import flag, not_negative, number, number_or_word, numbers, positive, positive_or_table, table, tables, whole, word

# A scene, or where one stands, and what is known about it.
_CASE: Keys = {
    "scene": Key(word),
    **SCENE,
    "camera": Key(table),
    "objects": Key(tables),
    "pictures": Key(tables, needed=True),
    **optional("fit", "settings", kind=table),
}
_PICTURE: Keys = {
    "image": Key(word, needed=True),
    **optional("transfer", "mask", "weights", kind=word),
    **optional("noise", kind=positive_or_table),
    **optional("camera", kind=table),
    **optional("lights", kind=tables),
}
_ABOUT = {"targets": ("image",), "weights": ("mask", "weights")}  # what an argument of `fit` is in such a table
# Those of `fit`, `Prior` and `Unknown`, whose defaults they have and who check their values.
_FIT: Keys = {
    **optional("start", kind=number_or_word),
    **optional("noise", kind=positive_or_table),
    **optional("draws", "max_steps", kind=whole),
    **optional("prior", "unknown", kind=table),
}
_NOISE: Keys = {
    "read": Key(positive, needed=True),
    **optional("gain", kind=not_negative),
    **optional("saturation", kind=positive),
    **optional("nodata", kind=number),
}
_PRIOR: Keys = {**dict.fromkeys(("heights", "std"), Key(number_or_word, needed=True)), **optional("length", kind=number)}
_UNKNOWN: Keys = {
    **optional("albedo", kind=word),
    **optional("albedo_std", "albedo_length", "sky_std", "light_std", kind=number),
    **optional("albedo_shared", "exposures", "offsets", kind=flag),
    **optional("camera_std", kind=numbers(2)),
    **optional("material_std", kind=table),
}
_SETTINGS: Keys = {
    knob.name: Key({OneOf: word, Whole: whole}.get(type(knob.metadata["rule"]), flag)) for knob in dataclasses.fields(Settings)
}
_ARGUMENTS = {("fit",): _FIT, ("fit", "prior"): _PRIOR, ("fit", "unknown"): _UNKNOWN}


@dataclasses.dataclass(frozen=True, eq=False)
class Case:
    """What a file asks `fit` for, as that takes it; a grey picture has shape (h, w)."""

    scenes: tuple[Scene, ...]
    targets: tuple[np.ndarray, ...]
    weights: tuple[np.ndarray | None, ...]
    noise: tuple[float | dict[str, float | int], ...] | None  # numbers, or the arguments of `Noise`; None: it is not known
    settings: Settings
    options: dict[str, Any]  # `start`, `draws` and `max_steps`, those that the file gives
    prior: dict[str, Any]  # the same of `Prior`; empty: there is no such table
    unknown: dict[str, Any]  # and of `Unknown`
    names: tuple[str, ...]  # the pictures' files, as written
    like: Path | None  # the GeoTIFF whose georeference the heights have
    part: Part  # the file, for errors

    def located(self, error: ArgumentError) -> UserError:
        """An error about an argument of `fit`, `Prior` or `Unknown`, on the line where that stands; others as they are."""
        name, _, index = error.argument.removesuffix("]").partition("[")
        if name == "scenes":  # those of a case differ in cameras and lights only
            place = self.part.at("objects" if "objects" in self.part.table else "scene")
            return place.error(f"{place.name}: {error.rule}")
        if index:
            given = self.part.table["pictures"][int(index)]
            place = self.part.at("pictures", int(index), next(key for key in _ABOUT[name] if key in given))
        elif within := next((within for within, keys in _ARGUMENTS.items() if name in keys), None):
            place = self.part.at(*within, name)
        else:
            return error
        return place.error(f"{place.name} {error.rule}")


class _Base(NamedTuple):
    """What the pictures have in common."""

    objects: Sequence[Object]
    lights: Sequence[Light]
    field: Provenance  # of the first heightfield, which the fit recovers
    samples: int
    view: Part | Camera | None  # the camera, or its table


def load_case(path: PathLike, dtype: DTypeLike = np.float32) -> Case:
    """Reads a .toml file with pictures, and the files that it names; arguments and errors as those of `load_scene`."""
    dtype, path = require_precision(dtype), require_file(path)
    by_ending({".toml": None}, path, "read what to fit from")
    part = open_toml(path)
    if "pictures" not in part.table and "camera" in part.table:
        part.require_known(_CASE)
        raise part.error("a fit must have 'pictures', those that were measured; this is a scene, for `jaxhf render`")
    values = part.read(_CASE)
    chosen = part.at("settings")
    settings = chosen.made(Settings, **chosen.read(_SETTINGS))
    base = _base(part, values, dtype)
    if not values["pictures"]:
        raise part.at("pictures").error("pictures must hold at least one picture, they are empty")
    chosen = part.at("fit")
    options, unknown = chosen.read(_FIT), chosen.at("unknown").read(_UNKNOWN)
    prior = chosen.at("prior").read(_PRIOR) if "prior" in options else {}
    noise = _noise(chosen, options)
    for name in ("noise", "prior", "unknown"):
        options.pop(name, None)
    for place, given in ((chosen, options), (chosen.at("prior"), prior)):
        for name, value in given.items():
            if isinstance(value, str):
                given[name] = place.file(name, partial(known_heights, base.field, name == "std"))
    pictures = [_picture(picture, base, noise) for picture in part.all("pictures")]
    scenes, targets, weights, noises, names = zip(*pictures, strict=True)
    known = [value for value in noises if value is not None]
    if known and len(known) < len(noises):
        place = part.at("pictures", noises.index(None))
        raise place.must("have a noise, as another picture has one; or none, then it is estimated")
    return Case(
        scenes, targets, weights, tuple(known) or None, settings, options, prior, unknown, names, base.field.like, part
    )  # fmt: skip


def _noise(part: Part, given: dict[str, Any]) -> float | dict[str, float | int] | None:
    """That of a table: a number, or arguments of `Noise`."""
    noise = given.get("noise")
    return part.at("noise").read(_NOISE) if isinstance(noise, dict) else noise


def _picture(
    part: Part, base: _Base, noise: float | dict[str, float | int] | None
) -> tuple[Scene, np.ndarray, np.ndarray | None, float | dict[str, float | int] | None, str]:
    """A picture's scene, radiance, weights, noise and name; `noise` is that of pictures that state none."""
    given = part.read(_PICTURE)
    target = read_image(part)
    lights = read_lights(part, base.field.stored) if "lights" in given else base.lights
    scene = part.made(Scene, base.objects, _camera(part, base, target.shape[:2]), lights, base.samples)
    return scene, target, _weights(part, target), _noise(part, given) if "noise" in given else noise, given["image"]


def _base(part: Part, values: dict[str, Any], dtype: np.dtype) -> _Base:
    samples = values.get("samples", 1)
    if "scene" in values:
        for name in SCENE:
            if name in part.table:
                raise part.at(name).error(f"{name} must stand without scene, whose file has its own")
        place = part.at("scene")
        path = part.file("scene", Path)
        if place.made(by_ending, {".toml": False, ".pbrt": True}, path, "read a scene from"):
            scene = load_pbrt(path, dtype)
            fields = (Provenance.of(item.shape) for item in scene.objects if isinstance(item.shape, Heightfield))
            return _Base(scene.objects, scene.lights, next(fields, Provenance()), scene.samples, scene.camera)
        part = open_toml(path)
        samples = read_samples(part)
    elif "objects" not in values:
        raise part.error("a fit must have 'scene', the name of a scene file, or 'objects', both are missing")
    return _Base(*read_world(part, dtype), samples, part.at("camera") if "camera" in part.table else None)


def _weights(picture: Part, target: np.ndarray) -> Float32[np.ndarray, "h w"] | None:
    present = picture.at_most_one("mask", "weights")
    size = target.shape[:2]
    declares = Path(picture.table["image"]).suffix.lower() in (".tif", ".tiff")  # a nan elsewhere is for `fit` to refuse
    there = ~np.isnan(target[..., 0]) if declares else np.ones(size, bool)
    if present is None:
        return None if there.all() else there.astype(np.float32)
    weights = picture.file(present, load_numbers).mean(axis=-1)
    if weights.shape != size:
        raise picture.at(present).must(f"have the size of the image, {_by(size)}; it is {_by(weights.shape)}")
    weights = (weights > 0).astype(np.float32) if present == "mask" else weights
    return np.where(there, weights, np.zeros_like(weights))


def _camera(picture: Part, base: _Base, size: tuple[int, ...]) -> Camera:
    """The camera of a picture with so many rows and columns, which are its own where its table states none."""
    view, (height, width) = picture.at("camera") if "camera" in picture.table else base.view, size
    if view is None:
        raise picture.must("have a camera: there is none for all pictures")
    if isinstance(view, Part) and view.table.keys().isdisjoint(("width", "height")):
        view = view._replace(table={**view.table, "height": height, "width": width})
    camera = read_camera(view) if isinstance(view, Part) else view
    if height != round(width * camera.height / camera.width) and width != round(height * camera.width / camera.height):
        stated = _by((camera.height, camera.width))
        raise picture.at("image").must(f"have the proportions of its camera, {stated}; it is {_by(size)}")
    return dataclasses.replace(camera, width=width, height=height)


def _by(size: tuple[int, ...]) -> str:
    return f"{size[1]} x {size[0]} pixels"
