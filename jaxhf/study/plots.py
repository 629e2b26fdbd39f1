"""A sweep as one page of plots."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ..core.extras import require_matplotlib
from ..io.files import replacing
from .pareto import ERRORS, curves, front
from .plan import Measured, Sweep

_LABELS = {
    "picture": "RMSE of the picture, of its mean radiance",
    "derivative": "relative error of the gradient",
    "fit": "RMSE of the heights, of their range",
}


def screenless_pyplot() -> Any:
    """matplotlib's pyplot, without a screen; UserError where it is not installed."""
    require_matplotlib("tradeoff draws with")
    import matplotlib

    matplotlib.use("agg")
    import matplotlib.pyplot

    return matplotlib.pyplot


def save_plot(sweep: Sweep, measured: Sequence[Measured]) -> Path:
    """Draws what was measured into the sweep's folder."""
    path = sweep.folder / "tradeoff.png"
    figure = plot(measured, f"{sweep.path.name}, {sweep.width} x {sweep.height} pixels, {sweep.devices} devices")
    with replacing(path) as temporary:
        figure.savefig(temporary, format="png")
    return path


def plot(measured: Sequence[Measured], title: str) -> Any:
    """A figure: for each task error over time with the Pareto front, then a panel for each knob."""
    plt = screenless_pyplot()
    tasks = [task for task in ERRORS if any(row.task == task for row in measured)]
    knobs = [(task, knob, values) for task in tasks for knob, values in curves(measured, task).items()]
    columns = 4
    rows = -(-len(knobs) // columns)
    figure = plt.figure(figsize=(15, 5 + 2.9 * rows), layout="constrained")
    figure.suptitle(title)
    above, below = figure.subfigures(2, 1, height_ratios=[5, max(2.9 * rows, 0.1)])
    for axes, task in zip(above.subplots(1, len(tasks), squeeze=False)[0], tasks, strict=True):
        _draw_front(axes, measured, task)
    if knobs:
        panels = below.subplots(rows, columns, squeeze=False).ravel()
        for axes, (task, knob, values) in zip(panels, knobs, strict=False):
            _draw_knob(axes, task, knob, values, _decades(measured, task))
        for axes in panels[len(knobs) :]:
            axes.set_axis_off()
    return figure


def _draw_front(axes: Any, measured: Sequence[Measured], task: str) -> None:
    error = ERRORS[task]
    rows = [row for row in measured if row.task == task]
    shown: set[int] = set()
    for knob, values in curves(measured, task).items():
        mine = [row for _, row in values if row is not rows[0]]
        shown.update(map(id, mine))
        axes.plot([row.figures["seconds"] for row in mine], [_floor(row.figures[error]) for row in mine], "o", label=knob)
    others = [row for row in rows[1:] if id(row) not in shown]
    if others:
        axes.plot(
            [row.figures["seconds"] for row in others],
            [_floor(row.figures[error]) for row in others],
            "x",
            color="0.4",
            label="several",
        )
    axes.plot(rows[0].figures["seconds"], _floor(rows[0].figures[error]), "k*", markersize=12, label="base")
    best = front(measured, task)
    axes.step(
        [row.figures["seconds"] for row in best], [_floor(row.figures[error]) for row in best], "k-", where="post", linewidth=1,
        label="front",
    )  # fmt: skip
    axes.set(xscale="log", yscale="log", xlabel="seconds a run", ylabel=_LABELS[task], title=task)
    axes.grid(True, which="both", alpha=0.2)
    axes.legend(fontsize="small", ncols=2)


def _floor(error: float) -> float:
    """An error of zero has a place on a logarithmic axis, too."""
    return max(error, 1e-9)


def _decades(measured: Sequence[Measured], task: str) -> tuple[float, float]:
    """Powers of ten around all errors of a task: in each panel the same, so that what changes nothing looks level."""
    errors = [_floor(row.figures[ERRORS[task]]) for row in measured if row.task == task]
    return 10.0 ** math.floor(math.log10(min(errors))), 10.0 ** (math.floor(math.log10(max(errors))) + 1)


def _draw_knob(axes: Any, task: str, knob: str, values: list[tuple[str, Measured]], limits: tuple[float, float]) -> None:
    places = range(len(values))
    axes.bar(places, [row.figures["against_base"] for _, row in values], width=0.6, color="0.8")
    axes.set_ylabel("time, of the base", fontsize="small")
    axes.set_xticks(places, [value for value, _ in values], fontsize="small", rotation=30 if len(values) > 4 else 0)
    axes.set_title(f"{task}: {knob}", fontsize="medium")
    errors = axes.twinx()
    errors.plot(places, [_floor(row.figures[ERRORS[task]]) for _, row in values], "o-", color="tab:red", markersize=4)
    errors.set(yscale="log", ylim=limits)
    errors.set_ylabel(ERRORS[task].replace("_", " "), color="tab:red", fontsize="small")
