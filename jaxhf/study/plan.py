"""What a sweep of the settings over one scene measures."""

import dataclasses
import hashlib
import importlib.metadata
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from ..core.errors import ArgumentError
from ..core.settings import Settings
from ..io.errors import FileError
from ..io.files import PathLike
from ..io.scenes.load import load_scene
from ..preparation.world import resolve_settings
from ..scene.light import Sky
from ..scene.material import Mirror
from ..scene.scene import Scene, resized, shrunk
from ..xla.machine import default_devices
from .table import KNOBS, Row, Sweep

FINEST = 256  # samples a pixel of the picture's reference
PIXELS = 480  # of a picture's longer side, at most, unless a width is given

# What each knob is set to besides its value in the base; a scene without mirrors or lights that cast shadows has fewer.
_VALUES: dict[str, dict[str, tuple[Any, ...]]] = {
    "picture": {
        "precision": ("float64",), "traversal": ("dda",), "max_steps": (8, 16, 32, 64, 128), "early_exit": (False,),
        "samples": (1, 4, 9, 16, 64), "shading": ("flat",), "normals": ("central", "four", "six-angle", "six-equal"),
        "shadows": (False,), "max_depth": (0, 1, 2), "chunk": (256, 4096, 16384),
    },
    "derivative": {
        "edge_samples": (0, 1000, 100_000), "samples": (1, 16), "precision": ("float64",), "shading": ("flat",),
    },
}  # fmt: skip
_QUICK: dict[str, tuple[Any, ...]] = {
    "max_steps": (16, 64), "samples": (1, 4, 16), "normals": ("central",), "chunk": (4096,), "edge_samples": (0, 100_000),
}  # fmt: skip


def plan(
    path: PathLike, folder: PathLike | None = None, *, width: int | None = None, devices: int | None = None,
    knobs: Sequence[str] = (), quick: bool = False,
) -> Sweep:  # fmt: skip
    """What is to be measured of a scene file; the keywords are the options of `jaxhf tradeoff`, whose --help tells of them."""
    for knob in knobs:
        if knob not in KNOBS:
            raise ArgumentError("tradeoff", "knobs", f"must be among {', '.join(KNOBS)}; one is {knob!r}")
    path, devices = Path(path), devices or default_devices()
    scene = load_scene(path)
    if not scene.heightfields:
        raise FileError(f"{path}: there is no heightfield whose rendering could be measured")
    for knob, absent in _unused(scene).items():
        if knob in knobs:
            raise ArgumentError("tradeoff", "knobs", f"{knob!r} changes nothing here: the scene has no {absent}")
    scene = resized(scene, width, None) if width else shrunk(scene, PIXELS // 2 if quick else PIXELS)
    rows = list({tuple(row.values()): row for row in _configurations(scene, knobs or KNOBS, quick)}.values())  # each once
    # Four times the base's samples at least, else the reference's error would be that of rounding.
    samples = max(FINEST // 4 if quick else FINEST, 4 * (rows[0]["samples"] or 1))
    exact = rows[0] | {"precision": "float64"}
    references = [exact | {"samples": samples}, exact | {"task": "derivative", "samples": 64, "edge_samples": 300_000}]
    folder = Path(f"{path.stem}-tradeoff") if folder is None else Path(folder)
    identity = _identity(scene, devices, quick)
    return Sweep(path, folder, scene.camera.width, scene.camera.height, devices, identity, rows, references)


def _configurations(scene: Scene, knobs: Collection[str], quick: bool) -> Iterator[Row]:
    """One knob at a time from each task's base; for pictures then samples together with what makes each of them cheaper."""
    knobs = set(knobs) - _unused(scene).keys()

    def one_at_a_time(row: Row, swept: Collection[str]) -> Iterator[Row]:
        yield row
        for knob, values in _VALUES[row["task"]].items():
            for value in (_QUICK.get(knob, values) if quick else values) if knob in swept else ():
                yield row | {knob: value}

    def base(task: str, settings: Settings) -> Row:
        return {"task": task, "precision": "float32", **dataclasses.asdict(settings)}

    picture = base("picture", resolve_settings(Settings(), scene))
    yield from one_at_a_time(picture, knobs)
    if {"early_exit", "max_steps"} <= knobs:
        yield picture | {"early_exit": False, "max_steps": 64}
    for changes in ({"shading": "flat"}, {"shadows": False}, {"shading": "flat", "shadows": False}):
        for samples in (picture["samples"], *((1, 16) if "samples" in knobs else ())):
            if changes.keys() <= knobs:
                yield picture | {"samples": samples, **changes}
    if "edge_samples" in knobs:
        yield from one_at_a_time(base("derivative", Settings(samples=4, edge_samples=10_000)), knobs)


def _unused(scene: Scene) -> dict[str, str]:
    """Knobs that change nothing in this scene, each with what the scene lacks."""
    unused = {}
    if not any(isinstance(obj.material, Mirror) for obj in scene.objects):
        unused["max_depth"] = "mirror"
    if all(isinstance(light, Sky) for light in scene.lights):
        unused["shadows"] = "light but the sky"
    return unused


def _identity(scene: Scene, devices: int, quick: bool) -> str:
    """A digest of all that a figure depends on but the machine: what was measured with another version is measured again."""
    digest = hashlib.sha256()
    for leaf in map(np.asarray, jax.tree.leaves(scene)):
        digest.update(f"{leaf.shape} {leaf.dtype}".encode() + leaf.tobytes())
    versions = [importlib.metadata.version(name) for name in ("jaxhf", "jax", "jaxlib")]
    digest.update(f"{jax.tree.structure(scene)} {devices} {quick} {versions} {jax.default_backend()}".encode())
    return digest.hexdigest()[:16]
