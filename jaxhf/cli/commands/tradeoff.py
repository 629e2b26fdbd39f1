"""`jaxhf tradeoff`: what each setting costs and gains on one scene, measured."""

import argparse
import sys

from ...core.errors import UserError, counted
from ...core.extras import import_extra
from ...study import sweep as sweeping
from ...study.pareto import advice, markdown
from ...study.plan import plan
from ...study.plots import save_plot
from ...study.table import Sweep
from .. import arguments, interruption
from ..limits import require_devices
from ..progress import bar, is_quiet


def run(options: argparse.Namespace) -> None:
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
    if options.markdown:
        print(markdown(measured), end="\n\n")
    if not options.markdown or arguments.given(options, "error", "time"):
        print("\n".join(advice(measured, options.error, options.time)))
    print(f"{counted(len(measured), 'configuration')}: {sweep.table}, {plot}")
    if failures:
        raise UserError(f"{counted(len(failures), 'configuration')} failed")


def _watched(sweep: Sweep, repeats: int) -> list[str]:
    """Measures what is missing, under a bar on a terminal; returns what failed."""
    with bar(total=len(sweep.missing())) as shown:

        def progress(done: int, total: int, what: str) -> None:
            shown.n, shown.total = done, total
            shown.set_postfix_str(what)

        def tell(line: str) -> None:
            if not is_quiet():
                shown.write(line, file=sys.stderr)  # standard output may be a table on its way into a file

        return sweeping.run(sweep, repeats, tell, progress)
