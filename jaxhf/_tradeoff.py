"""Sweeps the settings over one scene: error and cost of each, measured in processes of their own, kept in a table."""

import contextlib
import dataclasses
import hashlib
import importlib.metadata
import math
import os
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from ._light import Sky
from ._material import Mirror
from ._measure import resized
from ._render import settle
from ._scene import Scene
from ._settings import Settings
from ._worker import MeasurementError, Worker
from .io import PathLike, load_scene
from .io._sweep import append_row, load_reference, read_rows

FINEST = 256  # samples a pixel of the reference
FINEST_DERIVATIVE = {"samples": 64, "edge_samples": 300_000}
PIXELS = 480  # of a picture's longer side, at most, unless a width is given
SETTINGS = tuple(field.name for field in dataclasses.fields(Settings))
KNOBS = ("precision", *SETTINGS, "tolerance", "levels")
FIGURES = (
    "seconds", "fastest", "cpu_seconds", "against_base", "compile_seconds", "peak_mb",
    "rmse", "p999", "wrong_hits", "cosine", "relative_error",
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
    "chunk": (256, 1024, 16384, 65536),
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
    "chunk": (1024, 16384),
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
        runs of the base in between. seconds: that times the base's own median. fastest: the least by the clock. cpu_seconds:
        the median, of all cores together. compile_seconds: what the first run took beyond a warm one. peak_mb: the process's
        largest size, MiB. rmse, p999, wrong_hits, cosine, relative_error: see docs/tradeoff.md.
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
        return FINEST // 4 if self.quick else FINEST

    def measured(self) -> list[Measured]:
        """What the table holds of this sweep, in the sweep's order."""
        rows = {(row["task"], *(row[knob] for knob in KNOBS)): row for row in self._rows()}
        found = []
        for configuration in self.configurations:
            row = rows.get((configuration.task, *configuration.knobs.values()))
            if row is not None:
                figures = {name: float(row[name]) for name in FIGURES if row[name]}
                found.append(Measured(configuration.task, configuration.knobs, figures))
        base = next((row.figures["seconds"] for row in found if row.knobs == self.configurations[0].knobs), None)
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
      fits: also small fits, over their tolerance and levels.

    Raises:
      ValueError: an unknown knob, a width or a number of devices below 1, or anything about the scene.
    """
    for knob in knobs:
        if knob not in KNOBS:
            raise ValueError(f"tradeoff: knobs must be among {', '.join(KNOBS)}; one is {knob!r}")
    for name, value in (("width", width), ("devices", devices)):
        if value is not None and value < 1:
            raise ValueError(f"tradeoff: {name} must be a whole number from 1 on, it is {value}")
    path = Path(path)
    scene = load_scene(path)
    if not scene.heightfields:
        raise ValueError(f"{path}: there is no heightfield whose rendering could be measured")
    camera = scene.camera
    longest = PIXELS // 2 if quick else PIXELS
    scale = width / camera.width if width else min(1.0, longest / max(camera.width, camera.height))
    size = max(1, round(scale * camera.width)), max(1, round(scale * camera.height))
    devices = devices or min(len(os.sched_getaffinity(0)), 16)
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

    picture = Configuration("picture", settings=settle(Settings(), scene))
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
        for knob, choices in _FIT_VALUES.items():
            for value in choices:
                yield fit.with_knob(knob, value)


def _identity(scene: Scene, devices: int, quick: bool) -> str:
    """A digest of all that a figure depends on but the machine."""
    digest = hashlib.sha256()
    for leaf in jax.tree.leaves(scene):
        array = np.asarray(leaf)
        digest.update(f"{array.shape} {array.dtype}".encode() + array.tobytes())
    here = Path(__file__).parent
    for source in sorted(here.rglob("*.py")):
        digest.update(source.read_bytes())
    versions = [importlib.metadata.version(name) for name in ("jax", "jaxlib")]
    digest.update(f"{jax.tree.structure(scene)} {devices} {quick} {versions} {jax.default_backend()}".encode())
    return digest.hexdigest()[:16]


def run(sweep: Sweep, repeats: int, tell: Callable[[str], None], progress: Callable[[int, int, str], None]) -> list[str]:
    """Measures what is missing; each configuration's row is in the table as soon as it is known.

    As many configurations as there are devices (at most four) are compiled at once, each in its process; then their runs take
    turns with those of the base, whose process lives through all of it, so that a machine whose speed drifts favours none.

    Args:
      repeats: how many runs each; those of a slow configuration end after 15 seconds, at the third run at the earliest.
      tell: is given lines for the user: what will be done, and how long it should take.
      progress: called with (done, of how many, what now).

    Returns:
      What failed, a line each: processes that died.

    Raises:
      MeasurementError: the base or the reference failed.
    """
    missing = sweep.missing()
    if not missing:
        return []
    sweep.folder.mkdir(parents=True, exist_ok=True)
    base = sweep.configurations[0]
    failures = []
    progress(0, len(missing), "the base")
    begin = time.perf_counter()
    with Worker("jaxhf._measure", _job(sweep, base)) as yardstick:
        yardstick.answer()
        start = time.perf_counter() - begin
        frame = yardstick.ask("frame")["seconds"]
        minutes = _minutes(sweep, missing, start, frame, repeats)
        tell(
            f"{sweep.path}: {len(missing)} of {len(sweep.configurations)} configurations to measure, "
            f"{sweep.width} x {sweep.height} pixels; about {minutes} minutes"
        )
        _ensure_reference(sweep, lambda what: progress(0, len(missing), what))
        together = _together(sweep)
        for done in range(0, len(missing), together):
            batch = missing[done : done + together]
            names = [describe(one.task, one.knobs, base.knobs) for one in batch]
            progress(done, len(missing), "; ".join(names))
            for configuration, name, figures in zip(batch, names, _measure(sweep, batch, yardstick, repeats), strict=True):
                if isinstance(figures, MeasurementError):
                    failures.append(f"{name}: {figures}")
                    continue
                row = {"identity": sweep.identity, "task": configuration.task, **configuration.knobs}
                row |= {name: f"{figures[name]:.9g}" if name in figures else "" for name in FIGURES}
                append_row(sweep.table, COLUMNS, row)
    return failures


def _together(sweep: Sweep) -> int:
    return min(sweep.devices, 4)


def _measure(
    sweep: Sweep, batch: Sequence[Configuration], yardstick: Worker, repeats: int
) -> list[dict[str, float] | MeasurementError]:
    """The figures of each, or why its process died."""
    with contextlib.ExitStack() as stack:
        workers = [stack.enter_context(Worker("jaxhf._measure", _job(sweep, one))) for one in batch]
        found: list[dict[str, float] | MeasurementError] = [_attempt(worker.answer) for worker in workers]
        runs: list[list[dict[str, float]]] = [[] for _ in workers]
        base_runs: list[list[float]] = [[] for _ in workers]
        for turn in range(repeats):
            going = [k for k in range(len(batch)) if not isinstance(found[k], MeasurementError)]
            going = [k for k in going if batch[k].task != "fit" or turn == 0]
            going = [k for k in going if turn < 3 or sum(run["seconds"] for run in runs[k]) < 15]
            for k in going:
                frame = yardstick.ask("frame")["seconds"]
                answer = _attempt(lambda worker=workers[k]: worker.ask("frame"))
                if isinstance(answer, MeasurementError):
                    found[k] = answer
                else:
                    base_runs[k].append(frame)
                    runs[k].append(answer)
        for k, first in enumerate(found):
            if not isinstance(first, MeasurementError):
                found[k] = _costs(first, runs[k], base_runs[k])
                workers[k].send("errors")
        for k, costs in enumerate(found):
            if not isinstance(costs, MeasurementError):
                errors = _attempt(workers[k].answer)
                found[k] = errors if isinstance(errors, MeasurementError) else costs | errors
        return found


def _attempt(answer: Callable[[], dict[str, float]]) -> dict[str, float] | MeasurementError:
    try:
        return answer()
    except MeasurementError as error:
        return error


def _costs(first: dict[str, float], runs: list[dict[str, float]], base_runs: list[float]) -> dict[str, float]:
    seconds = np.array([run["seconds"] for run in runs])
    return {
        "seconds": float(np.median(seconds)),
        "fastest": float(seconds.min()),
        "cpu_seconds": float(np.median([run["cpu_seconds"] for run in runs])),
        "against_base": float(np.median(seconds / np.array(base_runs))),
        "compile_seconds": max(0.0, first["first_seconds"] - float(np.median(seconds))),
        "peak_mb": first["peak_mb"],
    }


def _job(sweep: Sweep, configuration: Configuration) -> dict[str, Any]:
    return {
        **dataclasses.asdict(configuration),
        "scene": str(sweep.path),
        "width": sweep.width,
        "height": sweep.height,
        "devices": sweep.devices,
        "reference": str(sweep.reference),
        "identity": sweep.identity,
    }


def _ensure_reference(sweep: Sweep, progress: Callable[[str], None]) -> None:
    """One that is there and is this sweep's has all parts that its configurations need, or is made again."""
    base = sweep.configurations[0]
    parts: dict[str, dict[str, Any]] = {"picture": {"samples": sweep.reference_samples}}
    needed = {"picture", "hits"}
    if any(configuration.task == "derivative" for configuration in sweep.configurations):
        parts["derivative"] = FINEST_DERIVATIVE
        needed.add("gradient")
    try:
        if needed <= load_reference(sweep.reference, sweep.identity).keys():
            return
    except (FileNotFoundError, ValueError):
        pass  # of another scene, or damaged: it is made again
    progress(f"the reference, in double precision, {sweep.reference_samples} samples a pixel")
    job = _job(sweep, dataclasses.replace(base, precision="float64"))
    with Worker("jaxhf._measure", job | {"task": "reference", "parts": parts}) as worker:
        worker.answer()


def _minutes(sweep: Sweep, missing: Sequence[Configuration], start: float, frame: float, repeats: int) -> int:
    """About how long it takes, from the base's start (with compilation) and frame."""
    samples = sweep.configurations[0].settings.samples or 1
    starts, runs = 0.0, 0.0
    for one in missing:
        starts += {"picture": 1.5, "derivative": 8, "fit": 12}[one.task] * start
        share = (one.settings.samples or 1) / samples * (2 if one.precision == "float64" else 1)
        runs += (repeats + 1) * frame * (1 + (share if one.task == "picture" else 1))
    total = starts / _together(sweep) + runs
    if not sweep.reference.exists():
        total += 2 * start + 2 * frame * sweep.reference_samples / samples
        total += 8 * start if any(one.task == "derivative" for one in sweep.configurations) else 0
    return max(1, math.ceil(total / 60))


def describe(task: str, knobs: dict[str, str], base: dict[str, str]) -> str:
    """Task and the knobs that differ from the base's, in words."""
    changed = [f"{name} {value}" for name, value in knobs.items() if value and value != base[name]]
    return f"{task}, {', '.join(changed) or 'the base'}"
