"""`jaxhf tradeoff`: what each setting costs and gains on one scene, measured."""

import argparse
import sys
from typing import TYPE_CHECKING

from ...core.errors import UserError, counted
from .. import interruption
from ..arguments import flag, number, option, whole
from ..command import Command

if TYPE_CHECKING:
    from ...study.table import Sweep


def run(options: argparse.Namespace) -> None:
    from ...core.extras import import_extra
    from ...study.pareto import advice, markdown
    from ...study.plan import plan
    from ...study.plots import save_plot
    from ..limits import require_devices

    for name in ("error", "time", "repeats", "width", "devices"):
        value = getattr(options, name)
        if value is not None and not value > 0:
            raise UserError(f"--{name} must be positive, it is {value}")
    require_devices(options.devices)
    import_extra("matplotlib", "tradeoff draws with", "plot")
    sweep = plan(
        options.scene, options.output, width=options.width, devices=options.devices, knobs=options.knobs, quick=options.quick
    )  # fmt: skip
    interruption.raise_from_now_on()
    failures = _watched(sweep, options.repeats) if sweep.missing() else []
    measured = sweep.measured()
    if failures:
        print("\n".join(f"failed: {failure}" for failure in failures), file=sys.stderr)
    if not measured:
        raise UserError(f"{sweep.path}: nothing could be measured")
    plot = save_plot(sweep, measured)
    asks = options.error is not None or options.time is not None
    if options.markdown:
        print(markdown(measured), end="\n\n")
    if asks or not options.markdown:
        print("\n".join(advice(measured, options.error, options.time)))
    print(f"{counted(len(measured), 'configuration')}: {sweep.table}, {plot}")
    if failures:
        raise UserError(f"{counted(len(failures), 'configuration')} failed")


def _watched(sweep: "Sweep", repeats: int) -> list[str]:
    """Measures what is missing, under a bar on a terminal; returns what failed."""
    from ...study import sweep as sweeping
    from ..progress import bar, is_quiet

    with bar(total=len(sweep.missing())) as shown:

        def progress(done: int, total: int, what: str) -> None:
            shown.n, shown.total = done, total
            shown.set_postfix_str(what)

        def tell(line: str) -> None:
            if not is_quiet():
                shown.write(line, file=sys.stderr)  # standard output may be a table on its way into a file

        return sweeping.run(sweep, repeats, tell, progress)


_ABOUT = (
    "Sweep each over a scene: error against a reference in double precision, time, compilation and peak memory; print the "
    "Pareto front of the settings, and keep a table and a plot. What was measured is kept: the same command goes on after "
    "Ctrl-C, and only prints when all is there. It says how long it will take."
)
COMMAND = Command(
    "tradeoff",
    "measure what each setting costs and gains",
    examples=("scene.toml --quick", "scene.toml --error 0.01 --knobs samples shading"),
    options={
        "": (
            option("scene", metavar="SCENE", help="a .toml or .pbrt scene"),
            option("-o", "--output", metavar="FOLDER", help="for table, references and plot [NAME-tradeoff]"),
        ),
        "what is asked": (
            number("--error", "E", "recommend the cheapest settings within this error"),
            number("--time", "SECONDS", "recommend the most exact settings within this time"),
            flag("--markdown", "print all figures as tables"),
        ),
        "what is measured": (
            flag("--quick", "fewer values, a smaller picture, a coarser reference"),
            option("--knobs", nargs="+", default=(), metavar="KNOB", help="sweep only these"),
            whole("--width", "PIXELS", "size [the scene's, at most 480 for the longer side]"),
            whole("--devices", "N", "cores that share the work [all, at most 16]"),
            whole("--repeats", "N", "runs whose median is taken [5]", default=5),
        ),
    },
    run=run,
    about=_ABOUT,
)
