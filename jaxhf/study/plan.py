"""What a sweep of the settings over one scene measures, and what of it is in the table already."""

import dataclasses
import hashlib
import importlib.metadata
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from ..core.errors import ArgumentError
from ..core.machine import default_devices
from ..core.settings import Settings
from ..io.errors import FileError
from ..io.files import PathLike
from ..io.scenes import load_scene
from ..scene.light import Sky
from ..scene.material import Mirror
from ..scene.scene import Scene
from ..scene.views import resized
from ..trace.world import resolve_settings
from .table import read_rows

FINEST = 256  # samples a pixel of the reference
FINEST_DERIVATIVE = {"samples": 64, "edge_samples": 300_000}
PIXELS = 480  # of a picture's longer side, at most, unless a width is given
SETTINGS = tuple(field.name for field in dataclasses.fields(Settings))
KNOBS = ("precision", *SETTINGS, "tolerance", "levels")
FIGURES = (
    "seconds", "fastest", "cpu_seconds", "against_base", "compile_seconds", "peak_mb",
    "rmse", "p999", "wrong_hits", "cosine", "relative_error", "spread",
)  # fmt: skip
COLUMNS = ("identity", "task", *KNOBS, *FIGURES)

# What each knob is set to besides its value in the base; a scene without mirrors or lights that cast shadows has fewer.
_VALUES: dict[str, tuple[Any, ...]] = {
    "precision": ("float64",),
    "traversal": ("dda",),
    "max_steps": (8, 16, 32, 64, 128),
    "samples": (1, 4, 9, 16, 64),
    "shading": ("flat",),
    "normals": ("central", "four", "six-angle", "six-equal"),
    "shadows": (False,),
    "max_depth": (0, 1, 2),
    "chunk": (256, 4096, 16384),
}
_DERIVATIVE_VALUES: dict[str, tuple[Any, ...]] = {
    "edge_samples": (0, 1000, 100_000),
    "samples": (1, 16),
    "precision": ("float64",),
    "shading": ("flat",),
}
_FIT_VALUES: dict[str, tuple[Any, ...]] = {"tolerance": (1e-2, 1e-3, 1e-5), "levels": ((1.0,),)}
_QUICK: dict[str, tuple[Any, ...]] = {
    "max_steps": (16, 64),
    "samples": (1, 4, 16),
    "normals": ("central",),
    "chunk": (4096,),
    "edge_samples": (0, 100_000),
}


@dataclasses.dataclass(frozen=True)
class Configuration:
    """What one process measures.

    Attributes:
      task: "picture", a frame; "derivative", value and gradient of a loss; "fit".
      precision: "float32" or "float64".
      tolerance, levels: of a fit.
    """

    task: str
    precision: str = "float32"
    settings: Settings = Settings()  # noqa: RUF009 - frozen
    tolerance: float | None = None
    levels: tuple[float, ...] | None = None

    @property
    def knobs(self) -> dict[str, str]:
        """All knobs as they stand in the table; what a task does not have is empty."""
        values = {"precision": self.precision, **dataclasses.asdict(self.settings)}
        knobs = {name: str(value) for name, value in values.items()}
        if self.task != "fit":
            return knobs | {"tolerance": "", "levels": ""}
        levels = "coarse to fine" if self.levels is None else " ".join(str(level) for level in self.levels)
        return knobs | {"tolerance": str(self.tolerance), "levels": levels}

    def with_knob(self, knob: str, value: Any) -> "Configuration":
        if knob in SETTINGS:
            return dataclasses.replace(self, settings=dataclasses.replace(self.settings, **{knob: value}))
        return dataclasses.replace(self, **{knob: value})


@dataclasses.dataclass(frozen=True)
class Measured:
    """A row of the table.

    Attributes:
      task: as in `Configuration`.
      knobs: as `Configuration.knobs`.
      figures: those of `FIGURES` that the task has. against_base: how long a warm run takes, as the median of its ratios to
        runs of the base in between. seconds: that times the base's own median; in the table on the disk, the median itself.
        fastest: the least by the clock. cpu_seconds: the median, of all cores together. compile_seconds: what the first run
        took beyond a warm one. peak_mb: the process's largest size, MiB. rmse, p999, wrong_hits, cosine, relative_error,
        spread: see docs/tradeoff.md.
    """

    task: str
    knobs: dict[str, str]
    figures: dict[str, float]


@dataclasses.dataclass(frozen=True)
class Sweep:
    """What is to be measured of one scene, and where it is kept.

    Attributes:
      path: of the scene.
      folder: for the table, the reference and the plot.
      width, height: of the picture.
      devices: that share the work.
      identity: of all that a figure depends on but the machine: scene, size, jaxhf's and JAX's version.
      quick: fewer values against a coarser reference.
      configurations: the base first.
    """

    path: Path
    folder: Path
    width: int
    height: int
    devices: int
    identity: str
    quick: bool
    configurations: tuple[Configuration, ...]

    @property
    def table(self) -> Path:
        return self.folder / "tradeoff.csv"

    @property
    def reference(self) -> Path:
        return self.folder / "reference.npz"

    @property
    def reference_samples(self) -> int:
        """Four times the base's at least, else its error would be that of rounding."""
        return max(FINEST // 4 if self.quick else FINEST, 4 * (self.configurations[0].settings.samples or 1))

    def measured(self) -> list[Measured]:
        """What the table holds of this sweep, in the sweep's order."""
        rows = {(row["task"], *(row[knob] for knob in KNOBS)): row for row in self._rows()}
        found = []
        for configuration in self.configurations:
            row = rows.get((configuration.task, *configuration.knobs.values()))
            if row is not None:
                figures = {name: float(row[name]) for name in FIGURES if row[name]}
                found.append(Measured(configuration.task, configuration.knobs, figures))
        first = self.configurations[0]
        base = next((row.figures["seconds"] for row in found if (row.task, row.knobs) == (first.task, first.knobs)), None)
        for row in found:
            if base is not None and "against_base" in row.figures:
                row.figures["seconds"] = row.figures["against_base"] * base
        return found

    def missing(self) -> list[Configuration]:
        """What is still to be measured."""
        there = {(row.task, *row.knobs.values()) for row in self.measured()}
        return [one for one in self.configurations if (one.task, *one.knobs.values()) not in there]

    def _rows(self) -> list[dict[str, str]]:
        return [row for row in read_rows(self.table, COLUMNS) if row["identity"] == self.identity]


def plan(
    path: PathLike,
    folder: PathLike | None = None,
    *,
    width: int | None = None,
    devices: int | None = None,
    knobs: Sequence[str] = (),
    quick: bool = False,
    fits: bool = False,
) -> Sweep:
    """What is to be measured of a scene.

    Args:
      path: a scene file.
      folder: where the results go; None: NAME-tradeoff in the current folder.
      width: of the picture, pixels; the height keeps the scene's proportions. None: the scene's, at most `PIXELS` for the
        longer side, half of that if `quick`.
      devices: None: all cores.
      knobs: which are swept; none: all.
      quick: fewer values, against a reference of a quarter of the samples.
      fits: also small fits, over their tolerance and levels. Either of these two among the knobs says so, too.

    Raises:
      ValueError: an unknown knob, a width or a number of devices below 1, fits of a terrain with holes, or anything about the
        scene.
    """
    for knob in knobs:
        if knob not in KNOBS:
            raise ArgumentError("tradeoff", "knobs", f"must be among {', '.join(KNOBS)}; one is {knob!r}")
    for name, value in (("width", width), ("devices", devices)):
        if value is not None and value < 1:
            raise ArgumentError("tradeoff", name, f"must be a whole number from 1 on, it is {value}")
    path = Path(path)
    scene = load_scene(path)
    if not scene.heightfields:
        raise FileError(f"{path}: there is no heightfield whose rendering could be measured")
    camera = scene.camera
    longest = PIXELS // 2 if quick else PIXELS
    scale = width / camera.width if width else min(1.0, longest / max(camera.width, camera.height))
    size = max(1, round(scale * camera.width)), max(1, round(scale * camera.height))
    devices = devices or default_devices()
    fits = fits or not _FIT_VALUES.keys().isdisjoint(knobs)
    if fits and not np.isfinite(scene.heights).all():
        raise FileError(f"{path}: a fit's terrain must be without holes, this one has {np.sum(~np.isfinite(scene.heights))}")
    configurations = tuple(dict.fromkeys(_configurations(scene, frozenset(knobs or KNOBS), quick, fits)))
    folder = Path(f"{path.stem}-tradeoff") if folder is None else Path(folder)
    identity = _identity(resized(scene, *size), devices, quick)
    return Sweep(path, folder, *size, devices, identity, quick, configurations)


def _configurations(scene: Scene, knobs: frozenset[str], quick: bool, fits: bool) -> Iterator[Configuration]:
    """One knob at a time from the base, then what interacts: the samples with what makes each of them cheaper."""

    def values(knob: str, all_values: tuple[Any, ...]) -> tuple[Any, ...]:
        if knob not in knobs:
            return ()
        return _QUICK.get(knob, all_values) if quick else all_values

    picture = Configuration("picture", settings=resolve_settings(Settings(), scene))
    yield picture
    absent = set() if any(isinstance(obj.material, Mirror) for obj in scene.objects) else {"max_depth"}
    if all(isinstance(light, Sky) for light in scene.lights):
        absent.add("shadows")
    for knob, choices in _VALUES.items():
        for value in () if knob in absent else values(knob, choices):
            yield picture.with_knob(knob, value)
    for changes in ({"shading": "flat"}, {"shadows": False}, {"shading": "flat", "shadows": False}):
        if changes.keys() <= knobs - absent:
            for samples in (picture.settings.samples, *((1, 16) if "samples" in knobs else ())):
                settings = dataclasses.replace(picture.settings, samples=samples, **changes)
                yield dataclasses.replace(picture, settings=settings)
    if "edge_samples" in knobs:
        derivative = Configuration("derivative", settings=dataclasses.replace(Settings(), samples=4, edge_samples=10_000))
        yield derivative
        for knob in _DERIVATIVE_VALUES:
            for value in values(knob, _DERIVATIVE_VALUES[knob]):
                yield derivative.with_knob(knob, value)
    if fits:
        fit = Configuration("fit", settings=dataclasses.replace(Settings(), samples=4), tolerance=1e-4)
        yield fit
        swept = _FIT_VALUES if knobs.isdisjoint(_FIT_VALUES) else knobs & _FIT_VALUES.keys()
        for knob, choices in _FIT_VALUES.items():
            for value in choices if knob in swept else ():
                yield fit.with_knob(knob, value)


def _identity(scene: Scene, devices: int, quick: bool) -> str:
    """A digest of all that a figure depends on but the machine."""
    digest = hashlib.sha256()
    for leaf in jax.tree.leaves(scene):
        array = np.asarray(leaf)
        digest.update(f"{array.shape} {array.dtype}".encode() + array.tobytes())
    package = Path(__file__).parents[1]
    for source in sorted(package.rglob("*.py")):
        digest.update(source.read_bytes())
    versions = [importlib.metadata.version(name) for name in ("jax", "jaxlib")]
    digest.update(f"{jax.tree.structure(scene)} {devices} {quick} {versions} {jax.default_backend()}".encode())
    return digest.hexdigest()[:16]


def describe(task: str, knobs: dict[str, str], base: dict[str, str]) -> str:
    """Task and the knobs that differ from the base's, in words."""
    changed = [f"{name} {value}" for name, value in knobs.items() if value and value != base[name]]
    return f"{task}, {', '.join(changed) or 'the base'}"
