"""What a sweep's figures say: which settings none beats, which to take for an error or a time, and all of them as tables."""

import math
from collections.abc import Iterator, Sequence

from ..core.settings import Settings
from .plan import KNOBS, SETTINGS, Measured, describe

ERRORS = {"picture": "rmse", "derivative": "relative_error", "fit": "rmse"}
"""What a task's error is, where one number must do."""


def front(measured: Sequence[Measured], task: str) -> list[Measured]:
    """Those of a task that no other beats in both time and error (Pareto), the cheapest first."""
    error = ERRORS[task]
    rows = sorted(
        (row for row in measured if row.task == task), key=lambda row: (row.figures["seconds"], row.figures[error])
    )  # fmt: skip
    best: list[Measured] = []
    for row in rows:
        if not best or row.figures[error] < best[-1].figures[error]:
            best.append(row)
    return best


def recommend(measured: Sequence[Measured], error: float | None, seconds: float | None) -> list[str]:
    """For each task a line: the cheapest settings within an error, or the most exact within a time.

    Args:
      error: of `ERRORS`, at most; None: no bound.
      seconds: a run, at most; None: no bound.
    """
    bounds = ("error {:g}", error), ("{:g} s", seconds)
    asked = [words.format(bound) for words, bound in bounds if bound is not None]
    lines = []
    for task in ERRORS:
        rows = front(measured, task)
        if not rows:
            continue
        name = ERRORS[task]
        within = [row for row in rows if error is None or row.figures[name] <= error]
        within = [row for row in within if seconds is None or row.figures["seconds"] <= seconds]
        head = f"{task}, {' and '.join(asked)}: "
        if within:
            lines.append(head + _advice(within[0] if error is not None else within[-1]))
        else:
            nearest = rows[-1] if error is not None else rows[0]
            lines.append(f"{head}nothing that was measured keeps that; nearest is {_advice(nearest)}")
    return lines


def pareto_lines(measured: Sequence[Measured]) -> list[str]:
    """Each task's front, in words."""
    lines = []
    for task in ERRORS:
        rows = front(measured, task)
        lines += [f"{task}, what nothing beats, the cheapest first:"] * bool(rows) + [f"  {_advice(row)}" for row in rows]
    return lines


def _advice(row: Measured) -> str:
    named = _as_settings(row)
    error = ERRORS[row.task]
    return f"{named}: error {row.figures[error]:.3g}, {row.figures['seconds']:.3g} s, {row.figures['peak_mb']:.0f} MiB"


def _as_settings(row: Measured) -> str:
    """What to write in Python to have them."""
    defaults = Settings()
    changed = {}
    for name in SETTINGS:
        value = row.knobs[name]
        if value != str(getattr(defaults, name)):
            changed[name] = value if value in ("True", "False", "None") or _number(value) < math.inf else f'"{value}"'
    options = [f"tolerance={row.knobs['tolerance']}", f"levels {row.knobs['levels']}"] if row.task == "fit" else []
    return ", ".join(
        [f"Settings({', '.join(f'{name}={value}' for name, value in changed.items())})", row.knobs["precision"], *options]
    )


_HEADS = {
    "picture": ("RMSE", "99.9 %", "wrong hits"),
    "derivative": ("cosine", "relative error", "spread"),
    "fit": ("RMSE of the heights",),
}
_COLUMNS = {"picture": ("rmse", "p999", "wrong_hits"), "derivative": ("cosine", "relative_error", "spread"), "fit": ("rmse",)}


def markdown(measured: Sequence[Measured]) -> str:
    """A table for each task: every configuration, what none beats in bold."""
    return "\n\n".join("\n".join(_table(measured, task)) for task in ERRORS if any(row.task == task for row in measured))


def _table(measured: Sequence[Measured], task: str) -> Iterator[str]:
    heads = (task, *_HEADS[task], "time, of the base", "seconds", "core seconds", "compiling, s", "peak, MiB")
    yield "| " + " | ".join(heads) + " |"
    yield "|" + "---|" * len(heads)
    best = front(measured, task)
    rows = [row for row in measured if row.task == task]
    for row in rows:
        name = describe(task, row.knobs, rows[0].knobs).removeprefix(f"{task}, ")
        figures = row.figures
        errors = [f"{figures[column]:.4g}" for column in _COLUMNS[task]]
        costs = [
            f"{figures['against_base']:.2f}", f"{figures['seconds']:.3g}", f"{figures['cpu_seconds']:.3g}",
            f"{figures['compile_seconds']:.1f}", f"{figures['peak_mb']:.0f}",
        ]  # fmt: skip
        yield "| " + " | ".join([f"**{name}**" if row in best else name, *errors, *costs]) + " |"


def curves(measured: Sequence[Measured], task: str) -> dict[str, list[tuple[str, Measured]]]:
    """For each knob that was swept its values and what was measured there, all else as in the task's base, the first row."""
    rows = [row for row in measured if row.task == task]
    if not rows:
        return {}
    base = rows[0]
    found: dict[str, list[tuple[str, Measured]]] = {}
    for row in rows:
        changed = [knob for knob in KNOBS if row.knobs[knob] != base.knobs[knob]]
        if len(changed) == 1:
            found.setdefault(changed[0], [(base.knobs[changed[0]], base)]).append((row.knobs[changed[0]], row))
    for values in found.values():
        values.sort(key=lambda pair: (_number(pair[0]), pair[0]))
    return found


def _number(value: str) -> float:
    """Where a value stands on its knob's axis: numbers by size, the unlimited last, words after that by name."""
    try:
        return float(value)
    except ValueError:
        return math.inf
