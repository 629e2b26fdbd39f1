"""What a sweep's figures say: the Pareto front, which settings to take for an error or a time, and all of them as tables."""

import dataclasses
import math
from collections.abc import Iterator, Sequence
from itertools import groupby

from ..core.settings import Settings
from .table import Row, in_words

_ERRORS = {
    "picture": {"rmse": "RMSE", "p999": "99.9 %", "wrong_hits": "wrong hits"},
    "derivative": {"cosine": "cosine", "relative_error": "relative error", "spread": "spread"},
}
_COSTS = {
    "against_base": ("time, of the base", ".2f"), "seconds": ("seconds", ".3g"), "cpu_seconds": ("core seconds", ".3g"),
    "compile_seconds": ("compiling, s", ".1f"), "peak_mb": ("peak, MiB", ".0f"),
}  # fmt: skip


def by_task(measured: Sequence[Row]) -> list[list[Row]]:
    """The rows of each task, its base first."""
    return [list(rows) for _, rows in groupby(measured, lambda row: row["task"])]


def pareto_front(rows: Sequence[Row]) -> list[Row]:
    """The configurations of a task that no other beats in both time and error, the cheapest first."""
    best: list[Row] = []
    for row in sorted(rows, key=lambda row: (row["seconds"], row["error"])):
        if not best or row["error"] < best[-1]["error"]:
            best.append(row)
    return best


def advice(measured: Sequence[Row], error: float | None, seconds: float | None) -> list[str]:
    """Each task's Pareto front in words; with a bound only the cheapest within an error, or the most exact within a time."""
    bounds = ("error {:g}", error), ("{:g} s", seconds)
    asked = " and ".join(words.format(bound) for words, bound in bounds if bound is not None)
    lines = []
    for rows in by_task(measured):
        best, task = pareto_front(rows), rows[0]["task"]
        if not asked:
            lines += [f"{task}, Pareto front, the cheapest first:", *(f"  {_in_python(row)}" for row in best)]
            continue
        best = best[::-1] if error else best  # the nearest first, the wanted last
        within = [row for row in best if row["error"] <= (error or math.inf) and row["seconds"] <= (seconds or math.inf)]
        else_nearest = "" if within else "nothing that was measured keeps that; nearest is "
        lines.append(f"{task}, {asked}: {else_nearest}{_in_python(within[-1] if within else best[0])}")
    return lines


def _in_python(row: Row) -> str:
    """The settings as they are written in Python, and what they cost."""
    changed = {name: row[name] for name, value in dataclasses.asdict(Settings()).items() if row[name] != value}
    written = [f'{name}="{value}"' if isinstance(value, str) else f"{name}={value}" for name, value in changed.items()]
    costs = f"error {row['error']:.3g}, {row['seconds']:.3g} s, {row['peak_mb']:.0f} MiB"
    return f"Settings({', '.join(written)}), {row['precision']}: {costs}"


def markdown(measured: Sequence[Row]) -> str:
    """A table for each task: every configuration, the Pareto front in bold."""
    return "\n\n".join("\n".join(_table(rows)) for rows in by_task(measured))


def _table(rows: Sequence[Row]) -> Iterator[str]:
    task, best = rows[0]["task"], pareto_front(rows)
    columns = {name: (head, ".4g") for name, head in _ERRORS[task].items()} | _COSTS
    yield "| " + " | ".join([task, *(head for head, _ in columns.values())]) + " |"
    yield "|" + "---|" * (1 + len(columns))
    for row in rows:
        name = in_words(row, rows[0])
        figures = [f"{row[column]:{form}}" for column, (_, form) in columns.items()]
        yield "| " + " | ".join([f"**{name}**" if row in best else name, *figures]) + " |"
