"""What a sweep of the settings over one scene measures, and what of it is in the table already."""

import csv
import dataclasses
import hashlib
import importlib.metadata
import io
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from ..core.errors import ArgumentError
from ..core.settings import Settings
from ..io.errors import FileError
from ..io.files import PathLike, reading, save_text
from ..io.scenes import load_scene
from ..scene.light import Sky
from ..scene.material import Mirror
from ..scene.scene import Scene
from ..scene.views import resized
from ..trace.world import resolve_settings
from ..xla.machine import default_devices

FINEST = 256  # samples a pixel of the picture's reference
PIXELS = 480  # of a picture's longer side, at most, unless a width is given
SETTINGS = tuple(field.name for field in dataclasses.fields(Settings))
KNOBS = ("precision", *SETTINGS, "tolerance", "levels")
COSTS = ("seconds", "fastest", "cpu_seconds", "against_base", "compile_seconds", "peak_mb")
FIGURES = (*COSTS, "rmse", "p999", "wrong_hits", "cosine", "relative_error", "spread")
COLUMNS = ("identity", "task", *KNOBS, *FIGURES)
ERRORS = {"picture": "rmse", "derivative": "relative_error", "fit": "rmse"}
"""What a task's error is, where one number must do."""

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
    "fit": {"tolerance": (1e-2, 1e-3, 1e-5), "levels": ((1.0,),)},
}  # fmt: skip
_QUICK: dict[str, tuple[Any, ...]] = {
    "max_steps": (16, 64), "samples": (1, 4, 16), "normals": ("central",), "chunk": (4096,), "edge_samples": (0, 100_000),
}  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Configuration:
    """What one process measures: a "picture", a "derivative" (value and gradient of a loss) or a "fit".

    Attributes:
      tolerance, levels: of a fit.
      figures: those of `FIGURES` that were measured, if it was.
    """

    task: str
    precision: str = "float32"
    settings: Settings = Settings()  # noqa: RUF009 - frozen
    tolerance: float | None = None
    levels: tuple[float, ...] | None = None
    figures: dict[str, float] = dataclasses.field(default_factory=dict, compare=False)

    @property
    def seconds(self) -> float:
        return self.figures["seconds"]

    @property
    def error(self) -> float:
        return self.figures[ERRORS[self.task]]

    @property
    def knobs(self) -> dict[str, str]:
        """All knobs as they stand in the table; what a task does not have is empty."""
        knobs = {"precision": self.precision} | {name: str(getattr(self.settings, name)) for name in SETTINGS}
        levels = "coarse to fine" if self.levels is None else " ".join(map(str, self.levels))
        fits = (str(self.tolerance), levels) if self.task == "fit" else ("", "")
        return knobs | dict(zip(("tolerance", "levels"), fits, strict=True))

    def replace(self, **values: Any) -> "Configuration":
        """The same with other values of some knobs."""
        settings = {name: values.pop(name) for name in SETTINGS if name in values}
        return dataclasses.replace(self, settings=dataclasses.replace(self.settings, **settings), **values)


@dataclasses.dataclass(frozen=True)
class Sweep:
    """What is to be measured of one scene, the base first, against what, and where it is kept.

    Its identity is a digest of all that a figure depends on but the machine: scene, size, jaxhf's and JAX's version.
    """

    path: Path
    folder: Path
    width: int
    height: int
    devices: int
    identity: str
    configurations: tuple[Configuration, ...]
    references: tuple[Configuration, ...]

    @property
    def table(self) -> Path:
        return self.folder / "tradeoff.csv"

    def reference(self, task: str) -> Path:
        return self.folder / f"{task}-{self.identity}.npz"

    def measured(self) -> list[Configuration]:
        """What the table holds of this sweep, in its order; seconds are the ratio to the base in turn times the base's own."""
        rows = {tuple(row[name] for name in ("identity", "task", *KNOBS)): row for row in read_rows(self.table)}
        keyed = [(one, rows.get((self.identity, one.task, *one.knobs.values()))) for one in self.configurations]
        found = [(one, {name: float(row[name]) for name in FIGURES if row[name]}) for one, row in keyed if row]
        base = found[0][1]["seconds"] if found and found[0][0] == self.configurations[0] else None
        return [
            one.replace(figures=figures | ({} if base is None else {"seconds": figures["against_base"] * base}))
            for one, figures in found
        ]

    def missing(self) -> list[Configuration]:
        """What is still to be measured."""
        there = self.measured()
        return [one for one in self.configurations if one not in there]

    def add(self, one: Configuration, figures: Mapping[str, float]) -> None:
        """Adds a row to the table, whole or not at all."""
        row = {"identity": self.identity, "task": one.task, **one.knobs}
        text = io.StringIO()
        table = csv.DictWriter(text, COLUMNS, restval="", lineterminator="\n")
        table.writeheader()
        table.writerows([*read_rows(self.table), row | {name: f"{value:.9g}" for name, value in figures.items()}])
        save_text(self.table, text.getvalue())


def read_rows(path: Path) -> list[dict[str, str]]:
    """The table's rows; none where there is no file. ValueError where the columns are others."""
    if not path.exists():
        return []
    with reading(path):
        table = csv.DictReader(path.read_text().splitlines())
        rows = list(table)
        if table.fieldnames != list(COLUMNS):
            raise ValueError("line 1: its columns are not those of this version of jaxhf; name another folder")
        for line, row in enumerate(rows, 2):
            if None in row or None in row.values():
                raise ValueError(f"line {line}: a row must have {len(COLUMNS)} values")
        return rows


def plan(
    path: PathLike, folder: PathLike | None = None, *, width: int | None = None, devices: int | None = None,
    knobs: Sequence[str] = (), quick: bool = False, fits: bool = False,
) -> Sweep:  # fmt: skip
    """What is to be measured of a scene file; the keywords are the options of `jaxhf tradeoff`, whose --help tells of them.

    Raises:
      ValueError: an unknown knob, fits of a terrain with holes, or anything about the scene.
    """
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
    fits = fits or not _VALUES["fit"].keys().isdisjoint(knobs)
    if fits and not np.isfinite(scene.heights).all():
        raise FileError(f"{path}: a fit's terrain must be without holes, this one has {np.sum(~np.isfinite(scene.heights))}")
    camera, longest = scene.camera, PIXELS // 2 if quick else PIXELS
    scale = width / camera.width if width else min(1.0, longest / max(camera.width, camera.height))
    size = max(1, round(scale * camera.width)), max(1, round(scale * camera.height))
    found = tuple(dict.fromkeys(_configurations(scene, knobs or KNOBS, quick, fits)))
    # Four times the base's samples at least, else the reference's error would be that of rounding.
    samples = max(FINEST // 4 if quick else FINEST, 4 * (found[0].settings.samples or 1))
    exact = found[0].replace(precision="float64")
    references = exact.replace(samples=samples), exact.replace(task="derivative", samples=64, edge_samples=300_000)
    folder = Path(f"{path.stem}-tradeoff") if folder is None else Path(folder)
    return Sweep(path, folder, *size, devices, _identity(resized(scene, *size), devices, quick), found, references)


def _configurations(scene: Scene, knobs: Collection[str], quick: bool, fits: bool) -> Iterator[Configuration]:
    """One knob at a time from each task's base; for pictures then samples together with what makes each of them cheaper."""
    knobs = set(knobs) - _unused(scene).keys()

    def one_at_a_time(base: Configuration, swept: Collection[str]) -> Iterator[Configuration]:
        yield base
        for knob, values in _VALUES[base.task].items():
            for value in (_QUICK.get(knob, values) if quick else values) if knob in swept else ():
                yield base.replace(**{knob: value})

    picture = Configuration("picture", settings=resolve_settings(Settings(), scene))
    yield from one_at_a_time(picture, knobs)
    if {"early_exit", "max_steps"} <= knobs:
        yield picture.replace(early_exit=False, max_steps=64)
    for changes in ({"shading": "flat"}, {"shadows": False}, {"shading": "flat", "shadows": False}):
        for samples in (picture.settings.samples, *((1, 16) if "samples" in knobs else ())):
            if changes.keys() <= knobs:
                yield picture.replace(samples=samples, **changes)
    if "edge_samples" in knobs:
        yield from one_at_a_time(Configuration("derivative", settings=Settings(samples=4, edge_samples=10_000)), knobs)
    if fits:
        fit = Configuration("fit", settings=Settings(samples=4), tolerance=1e-4)
        yield from one_at_a_time(fit, _VALUES["fit"] if knobs.isdisjoint(_VALUES["fit"]) else knobs)


def _unused(scene: Scene) -> dict[str, str]:
    """Knobs that change nothing in this scene, each with what the scene lacks."""
    unused = {}
    if not any(isinstance(obj.material, Mirror) for obj in scene.objects):
        unused["max_depth"] = "mirror"
    if all(isinstance(light, Sky) for light in scene.lights):
        unused["shadows"] = "light but the sky"
    return unused


def _identity(scene: Scene, devices: int, quick: bool) -> str:
    """A digest of all that a figure depends on but the machine."""
    digest = hashlib.sha256()
    for leaf in map(np.asarray, jax.tree.leaves(scene)):
        digest.update(f"{leaf.shape} {leaf.dtype}".encode() + leaf.tobytes())
    for source in sorted(Path(__file__).parents[1].rglob("*.py")):
        digest.update(source.read_bytes())
    versions = [importlib.metadata.version(name) for name in ("jax", "jaxlib")]
    digest.update(f"{jax.tree.structure(scene)} {devices} {quick} {versions} {jax.default_backend()}".encode())
    return digest.hexdigest()[:16]


def changes(knobs: dict[str, str], base: dict[str, str]) -> str:
    """The knobs that differ from the base's, in words."""
    return ", ".join(f"{name} {value}" for name, value in knobs.items() if value and value != base[name]) or "the base"
