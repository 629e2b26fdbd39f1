"""Measures what a sweep lacks: error and cost of each configuration, in processes of their own, kept in a table."""

import contextlib
import dataclasses
import math
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ..core.machine import available_bytes
from .measure import LEAST_SECONDS
from .plan import COLUMNS, FIGURES, FINEST_DERIVATIVE, Configuration, Sweep, describe
from .table import append_row, known_reference
from .worker import MeasurementError, Worker

_SWOLLEN = 3  # the peak of a derivative's process, of a picture's


def run(sweep: Sweep, repeats: int, tell: Callable[[str], None], progress: Callable[[int, int, str], None]) -> list[str]:
    """Measures what is missing; each configuration's row is in the table as soon as it is known.

    As many configurations as there are devices (at most four) are compiled at once, each in its process; then their runs take
    turns with those of the base, whose process lives through all of it, so that a machine whose speed drifts favours none.

    Args:
      repeats: how many runs each; those of a slow configuration end after 15 seconds, at the third run at the earliest.
      tell: is given lines for the user: what will be done, and how long it should take.
      progress: called with (done, of how many, what now).

    Returns:
      What failed, a line each: processes that died. Where that of the derivative's reference did, no derivative is measured.

    Raises:
      MeasurementError: the base or the picture's reference failed.
    """
    missing = sweep.missing()
    if not missing:
        return []
    sweep.folder.mkdir(parents=True, exist_ok=True)
    base = sweep.configurations[0]
    failures = []
    progress(0, len(missing), "the base")
    begin = time.perf_counter()
    with Worker("jaxhf.study.measure", _job(sweep, base)) as yardstick:
        peak_mb = yardstick.answer()["peak_mb"]
        start = time.perf_counter() - begin
        frame = yardstick.ask("frame")["seconds"]
        lacking = _lacking_references(sweep, missing)
        minutes = _minutes(sweep, missing, lacking, start, frame, repeats)
        tell(
            f"{sweep.path}: {len(missing)} of {len(sweep.configurations)} configurations to measure, "
            f"{sweep.width} x {sweep.height} pixels; about {minutes} minutes"
        )
        for task in lacking:
            progress(0, len(missing), f"the {task}'s reference, in double precision")
            try:
                _make_reference(sweep, task)
            except MeasurementError as error:
                if task == "picture":
                    raise
                failures.append(f"{task}, the reference, and so all else of it: {error}")
                missing = [one for one in missing if one.task != task]
        together = max(1, int(min(_together(sweep), available_bytes() / 2**20 / (_SWOLLEN * peak_mb))))
        for done in range(0, len(missing), together):
            batch = missing[done : done + together]
            names = [describe(one.task, one.knobs, base.knobs) for one in batch]
            progress(done, len(missing), "; ".join(names))
            for configuration, name, figures in zip(batch, names, _measure(sweep, batch, yardstick, repeats), strict=True):
                if isinstance(figures, MeasurementError):
                    if configuration == base:
                        raise figures
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
        workers = [stack.enter_context(Worker("jaxhf.study.measure", _job(sweep, one))) for one in batch]
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


def _lacking_references(sweep: Sweep, missing: Sequence[Configuration]) -> list[str]:
    """Of which tasks a reference is to be made; one of another scene, or damaged, does not count."""
    there = known_reference(sweep.reference, sweep.identity)
    tasks = {one.task for one in missing}
    return [task for task, part in (("picture", "hits"), ("derivative", "gradient")) if task in tasks and part not in there]


def _make_reference(sweep: Sweep, task: str) -> None:
    finest = {"samples": sweep.reference_samples} if task == "picture" else FINEST_DERIVATIVE
    job = _job(sweep, dataclasses.replace(sweep.configurations[0], precision="float64"))
    with Worker("jaxhf.study.measure", job | {"task": "reference", "of": task, "finest": finest}) as worker:
        worker.answer()


def _minutes(
    sweep: Sweep, missing: Sequence[Configuration], lacking: Sequence[str], start: float, frame: float, repeats: int
) -> int:
    """About how long it takes, lacking references included, from the base's start (with compilation) and frame."""
    samples = sweep.configurations[0].settings.samples or 1
    starts, runs = 0.0, 0.0
    for one in missing:
        starts += {"picture": 1.5, "derivative": 8, "fit": 12}[one.task] * start
        share = (one.settings.samples or 1) / samples * (2 if one.precision == "float64" else 1)
        share = share if one.task == "picture" else 1
        runs += (repeats + 1) * (max(frame, LEAST_SECONDS) + max(frame * share, LEAST_SECONDS))
    total = starts / _together(sweep) + runs
    if "picture" in lacking:
        total += 2 * start + 2 * frame * sweep.reference_samples / samples
    if "derivative" in lacking:
        total += 8 * start
    return max(1, math.ceil(1.2 * total / 60))  # rather too many than too few
