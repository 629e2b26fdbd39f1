"""A sweep as one page of plots."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ..io.files import replacing
from .pareto import by_task, one_at_a_time, pareto_front
from .table import ERRORS, Row, Sweep

_LABELS = {
    "picture": "RMSE of the picture, of its mean radiance",
    "derivative": "relative error of the gradient",
}
_COLUMNS = 4


def save_plot(sweep: Sweep, measured: Sequence[Row]) -> Path:
    """Draws what was measured into the sweep's folder."""
    path = sweep.folder / "tradeoff.png"
    figure = plot(measured, f"{sweep.path.name}, {sweep.width} x {sweep.height} pixels, {sweep.devices} devices")
    with replacing(path) as temporary:
        figure.savefig(temporary, format="png")
    return path


def plot(measured: Sequence[Row], title: str) -> Any:
    """A figure: for each task error over time with the Pareto front, then a panel for each knob."""
    from matplotlib.figure import Figure

    tasks = by_task(measured)
    knobs = [(rows, knob, values) for rows in tasks for knob, values in one_at_a_time(rows).items()]
    count = -(-len(knobs) // _COLUMNS)
    figure: Any = Figure(figsize=(15, 5 + 2.9 * count), layout="constrained")
    figure.suptitle(title)
    above, below = figure.subfigures(2, 1, height_ratios=[5, max(2.9 * count, 0.1)])
    for axes, rows in zip(above.subplots(1, len(tasks), squeeze=False)[0], tasks, strict=True):
        _draw_task(axes, rows)
    panels = below.subplots(count, _COLUMNS, squeeze=False).ravel() if knobs else ()
    for axes, (rows, knob, values) in zip(panels, knobs, strict=False):
        _draw_knob(axes, knob, values, _points(rows)[1])
    for axes in panels[len(knobs) :]:
        axes.set_axis_off()
    return figure


def _points(rows: Sequence[Row]) -> tuple[list[float], list[float]]:
    """Seconds and errors; an error of zero has a place on a logarithmic axis, too."""
    return [row["seconds"] for row in rows], [max(row["error"], 1e-9) for row in rows]


def _draw_task(axes: Any, rows: Sequence[Row]) -> None:
    base, *several = rows
    for knob, values in one_at_a_time(rows).items():
        mine = [row for _, row in values if row is not base]
        several = [row for row in several if row not in mine]
        axes.plot(*_points(mine), "o", label=knob)
    if several:
        axes.plot(*_points(several), "x", color="0.4", label="several")
    axes.plot(*_points([base]), "k*", markersize=12, label="base")
    axes.step(*_points(pareto_front(rows)), "k-", where="post", linewidth=1, label="Pareto front")
    axes.set(xscale="log", yscale="log", xlabel="seconds a run", ylabel=_LABELS[base["task"]], title=base["task"])
    axes.grid(True, which="both", alpha=0.2)
    axes.legend(fontsize="small", ncols=2)


def _draw_knob(axes: Any, knob: str, values: Sequence[tuple[str, Row]], errors: Sequence[float]) -> None:
    """Time as bars, error as a line; its axis spans all errors of the task, so that what changes nothing looks level."""
    positions, rows = range(len(values)), [row for _, row in values]
    axes.bar(positions, [row["against_base"] for row in rows], width=0.6, color="0.8")
    axes.set_ylabel("time, of the base", fontsize="small")
    axes.set_xticks(positions, [value for value, _ in values], fontsize="small", rotation=30 if len(values) > 4 else 0)
    axes.set_title(f"{rows[0]['task']}: {knob}", fontsize="medium")
    decades = [math.floor(math.log10(error)) for error in errors]
    right = axes.twinx()
    right.plot(positions, _points(rows)[1], "o-", color="tab:red", markersize=4)
    right.set(yscale="log", ylim=(10.0 ** min(decades), 10.0 ** (max(decades) + 1)))
    right.set_ylabel(ERRORS[rows[0]["task"]].replace("_", " "), color="tab:red", fontsize="small")
