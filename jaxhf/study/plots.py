"""A sweep as one page of plots."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ..io.files import replacing
from .pareto import by_task, pareto_front
from .table import Row, Sweep, changes, in_words

_ERRORS = {
    "picture": "RMSE, of the mean radiance",
    "derivative": "relative error of the gradient",
}
_BASE, _ONE, _SEVERAL = "#000000", "#0072b2", "#e69f00"  # of Okabe and Ito's colours, which the colour-blind tell apart
_LINE = 0.26  # inches of a row with its name


def save_plot(sweep: Sweep, measured: Sequence[Row]) -> Path:
    """Draws what was measured into the sweep's folder."""
    path = sweep.folder / "tradeoff.png"
    figure = plot(measured, f"{sweep.path.name}, {sweep.width} x {sweep.height} pixels, {sweep.devices} devices")
    with replacing(path) as temporary:
        figure.savefig(temporary, format="png")
    return path


def plot(measured: Sequence[Row], title: str) -> Any:
    """A figure: for each task error over time with the Pareto front, then time and error of each configuration by name."""
    from matplotlib.figure import Figure

    tasks = by_task(measured)
    heights = [max(3.2, 1.0 + _LINE * len(rows)) for rows in tasks]
    figure: Any = Figure(figsize=(13, 0.4 + sum(heights)), layout="constrained")
    figure.suptitle(title)
    panels = figure.subplots(len(tasks), 3, squeeze=False, height_ratios=heights, width_ratios=[1.5, 1, 1])
    for (front, time, error), rows in zip(panels, tasks, strict=True):
        _draw_front(front, rows)
        _draw_lines(time, error, rows)
    return figure


def _error(row: Row) -> float:
    """An error of zero has a place on a logarithmic axis, too."""
    return max(row["error"], 1e-9)


def _colour(row: Row, base: Row) -> str:
    return (_BASE, _ONE, _SEVERAL)[min(len(changes(row, base)), 2)]


def _draw_front(axes: Any, rows: Sequence[Row]) -> None:
    base, best = rows[0], pareto_front(rows)
    seconds, errors = [row["seconds"] for row in best], [_error(row) for row in best]
    axes.step(seconds, errors, where="post", color="0.6", label="Pareto front")
    for count, (name, marker) in enumerate({"the base": "*", "one knob changed": "o", "several": "D"}.items()):
        mine = [row for row in rows if min(len(changes(row, base)), 2) == count]
        if mine:
            seconds, errors = [row["seconds"] for row in mine], [_error(row) for row in mine]
            axes.plot(seconds, errors, marker, ms=6 if count else 14, color=_colour(mine[0], base), label=name)
    axes.set(xlabel="seconds a run", ylabel=_ERRORS[base["task"]], title=base["task"])
    _logarithmic(axes, "xy")
    axes.legend()


def _draw_lines(time: Any, error: Any, rows: Sequence[Row]) -> None:
    """A line for each configuration, the nearest on top; those of the Pareto front are bold."""
    base, best, places = rows[0], pareto_front(rows), range(len(rows))
    ordered = sorted(rows, key=_error, reverse=True)
    colours = [_colour(row, base) for row in ordered]
    times, errors = [row["against_base"] for row in ordered], [_error(row) for row in ordered]
    for axes, values, title in ((time, times, "time, of the base"), (error, errors, "error")):
        axes.hlines(places, 0.7 * min(values), values, color="0.85")
        axes.scatter(values, places, c=colours, s=36, zorder=2)
        axes.set(ylim=(-0.7, len(rows) - 0.3), title=f"{base['task']}: {title}")
        _logarithmic(axes, "x")
        axes.set_yticks(places, [in_words(row, base) for row in ordered] if axes is time else [])
    for row, name in zip(ordered, time.get_yticklabels(), strict=True):
        name.set_weight("bold" if row in best else "normal")


def _logarithmic(axes: Any, directions: str) -> None:
    """With numbers in full at 1 and 3 of each decade, so that they do not run into each other."""
    from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

    for direction in directions:
        axes.set(**{f"{direction}scale": "log"})
        axis = getattr(axes, f"{direction}axis")
        axis.set_major_locator(LogLocator(subs=(1, 3)))
        axis.set_major_formatter(StrMethodFormatter("{x:g}"))
        axis.set_minor_formatter(NullFormatter())
        axes.grid(True, axis=direction, alpha=0.3)
