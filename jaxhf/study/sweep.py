"""Measures what a sweep lacks: error and cost of each configuration, in processes of their own, kept in a table."""

import math
import time
from collections.abc import Callable, Generator

import numpy as np

from ..xla.machine import available_bytes
from .measure import LEAST_SECONDS, prepare
from .table import Row, Sweep, in_words
from .worker import MeasurementError, Worker

_SWOLLEN = 3  # the peak of a derivative's process, of a picture's
_STARTS = {"picture": 1.5, "derivative": 8}  # what a process takes to compile, in starts of the base


def run(sweep: Sweep, repeats: int, tell: Callable[[str], None], progress: Callable[[int, int, str], None]) -> list[str]:
    """Measures what is missing, its row in the table as soon as it is known; returns what failed, a line each.

    As many configurations as there are devices (at most four) are compiled at once, each in its process; then their runs take
    turns with those of the base, whose process lives through all of it, so that a machine whose speed drifts favours none.

    Args:
      repeats: how many runs each; those of a slow configuration end after 15 seconds, at the third run at the earliest.
      tell: is given lines for the user: what will be done, and how long it should take.
      progress: called with (done, of how many, what now).

    Raises:
      MeasurementError: the base or the picture's reference failed. Where another's did, that task is not measured.
    """
    missing, base, failures = sweep.missing(), sweep.configurations[0], []
    if not missing:
        return []
    sweep.folder.mkdir(parents=True, exist_ok=True)
    progress(0, len(missing), "the base")
    begin = time.perf_counter()
    with Worker(prepare, (sweep, base)) as yardstick:
        peak_mb = yardstick.answer()["peak_mb"]
        start = time.perf_counter() - begin
        frame = yardstick.ask("frame")["seconds"]
        together = max(1, int(min(sweep.devices, 4, available_bytes() / 2**20 / (_SWOLLEN * peak_mb))))
        tasks = {one["task"] for one in missing}
        lacking = [one for one in sweep.references if one["task"] in tasks and not sweep.reference(one["task"]).exists()]

        def forecast(one: Row, runs: int) -> float:
            """Seconds, rather too many than too few."""
            share = (one["samples"] or 1) / (base["samples"] or 1) * (2 if one["precision"] == "float64" else 1)
            own = max(frame * (share if one["task"] == "picture" else 1), LEAST_SECONDS)
            return 1.2 * (_STARTS[one["task"]] * start / together + runs * (max(frame, LEAST_SECONDS) + own))

        seconds = sum(forecast(one, repeats + 1) for one in missing) + sum(forecast(one, 2) for one in lacking)
        tell(
            f"{sweep.path}: {len(missing)} of {len(sweep.configurations)} configurations to measure, "
            f"{sweep.width} x {sweep.height} pixels; about {math.ceil(seconds / 60)} minutes"
        )
        for reference in lacking:
            task = reference["task"]
            progress(0, len(missing), f"the {task}'s reference, in double precision")
            try:
                with Worker(prepare, (sweep, reference)) as worker:
                    worker.answer()
                    worker.ask("reference")
            except MeasurementError as error:
                if task == "picture":
                    raise
                failures.append(f"{task}, the reference, and so all else of it: {error}")
                missing = [one for one in missing if one["task"] != task]
        for done in range(0, len(missing), together):
            batch = {f"{one['task']}, {in_words(one, base)}": one for one in missing[done : done + together]}
            progress(done, len(missing), "; ".join(batch))
            turns = {name: _measure(sweep, one, yardstick, repeats) for name, one in batch.items()}
            while turns:
                for name in list(turns):
                    try:
                        next(turns[name])
                        continue
                    except StopIteration as end:
                        sweep.add(batch[name], end.value)
                    except MeasurementError as error:
                        if batch[name] == base:
                            raise
                        failures.append(f"{name}: {error}")
                    del turns[name]
    return failures


def _measure(sweep: Sweep, one: Row, yardstick: Worker, repeats: int) -> Generator[None, None, dict[str, float]]:
    """Returns the figures of one configuration; yields where others take their turn."""
    with Worker(prepare, (sweep, one)) as worker:
        yield
        first = worker.answer()
        yield
        runs: list[dict[str, float]] = []
        for turn in range(repeats):
            if turn < 3 or sum(run["seconds"] for run in runs) < 15:
                runs.append({"base": yardstick.ask("frame")["seconds"], **worker.ask("frame")})
            yield
        worker.send("errors")
        yield
        seconds, cpu_seconds, base = (np.array([run[name] for run in runs]) for name in ("seconds", "cpu_seconds", "base"))
        median = float(np.median(seconds))
        return worker.answer() | {
            "seconds": median, "fastest": float(seconds.min()), "cpu_seconds": float(np.median(cpu_seconds)),
            "against_base": float(np.median(seconds / base)), "compile_seconds": max(0.0, first["first_seconds"] - median),
            "peak_mb": first["peak_mb"],
        }  # fmt: skip
