"""`jaxhf fit`: a file's pictures to files of heights, watched on a terminal and safe from interruption."""

import argparse
import contextlib
import math
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...core.errors import ArgumentError, UserError, counted
from .. import arguments, interruption
from ..arguments import flag, option, output, whole
from ..command import Command
from ..overwriting import require_no_input

if TYPE_CHECKING:
    from ...fitting.history import Draws, Step
    from ...fitting.trust.judge import Fit
    from ...io.scenes.toml.fit import Case

_USUAL_STEPS = 30  # of a fit, until it says what is to come
_EARLY = 50.0  # seconds: most fits compile no longer, and JAX reports a compilation only when it is done


def run(options: argparse.Namespace) -> None:
    if options.window is None and options.overlap is not None:
        raise UserError("--overlap must stand with --window")
    if options.window is not None and options.report:
        raise UserError("--report must stand without --window: it shows one fit")
    heights, checkpoint = Path(options.output), Path(f"{options.output}.checkpoint")
    std, albedo = heights.with_stem(f"{heights.stem}_std"), heights.with_name(f"{heights.stem}_albedo.npy")
    _require_writable(options, heights, std)
    if checkpoint.exists() and not options.resume:
        from ...io.errors import FileError

        raise FileError(
            f"{checkpoint}: an interrupted fit left this checkpoint; --resume goes on from it, to begin anew remove it"
        )
    require_no_input(options, std, albedo)
    arguments.set_up_jax(options)
    import jax
    import numpy as np

    from ...io.files import save_text
    from ...io.pictures.images import save_image
    from ...io.scenes.toml.fit import load_case
    from ..fit_report import facts, report
    from ..limits import require_memory
    from ..scene_warnings import warn

    case = load_case(options.case, np.dtype(options.precision))
    warn(case.scenes)
    require_memory(case.scenes[0], jax.local_device_count())
    if options.window is not None:
        _in_windows(case, checkpoint, options, heights, std)
        return
    found = _fit(case, checkpoint, options.resume)
    _save(case, found.heights, found.std, heights, std)
    if found.albedo is not None:
        factors = np.asarray(found.albedo)[::-1]  # a texture begins at v = 0, an image at its top
        save_image(albedo, factors if factors.shape[-1] == 3 else factors[..., 0])
    if options.report:
        save_text(options.report, report(f"Heights from {options.case}", case, found))
    checkpoint.unlink(missing_ok=True)
    for name, text in facts(case, found):
        print(f"{name}: {text}")
    ny, nx = found.heights.shape
    print(
        f"{heights}: {ny} x {nx} heights from {counted(len(case.targets), 'picture')}, {found.result.value}; "
        f"{counted(int(found.stats['steps']), 'step')}, {found.stats['seconds']:.3g} s, loss {found.stats['loss']:.6g}, "
        f"chi2 {found.stats['chi2']:.4g}"
    )
    for warning in found.warnings:
        print(f"jaxhf: warning: {warning}", file=sys.stderr)


def _require_writable(options: argparse.Namespace, *heights: Path) -> None:
    """Refuses before the fit what could not be written after it."""
    from ...core.extras import import_extra
    from ...io.files import require_writable_text
    from ...io.terrain.save import require_writable_heights

    for path in heights:
        require_writable_heights(path, (".npy", ".npz", ".tif", ".tiff"))  # which hold any heights, and holes
    if options.report:
        require_writable_text(options.report, ".html")
        import_extra("matplotlib", "a report needs", "plot")


@contextlib.contextmanager
def _told_where(case: "Case", checkpoint: Path) -> Iterator[None]:
    """KeyboardInterrupt says how to go on, an error of an argument in which line it stands."""
    try:
        yield
    except KeyboardInterrupt:
        if not checkpoint.exists():
            raise
        raise KeyboardInterrupt(f"interrupted; the same command with --resume goes on from {checkpoint}") from None
    except ArgumentError as error:
        raise case.located(error) from error


def _fit(case: "Case", checkpoint: Path, resume: bool) -> "Fit":
    """Fits what the file asks for."""
    from ...fitting.fit import fit
    from ...fitting.given import Checkpoint, Prior, Unknown
    from ..progress import told

    interruption.raise_from_now_on()
    progress = _Progress(", then deviations" if case.options.get("draws") else "")
    with _told_where(case, checkpoint), told(progress.line) as tell:
        return fit(
            case.scenes, case.targets, prior=Prior(**case.prior) if case.prior else None,
            unknown=Unknown(**case.unknown), noise=case.noise, weights=case.weights, settings=case.settings,
            progress=lambda done: (progress.note(done), tell())[1], checkpoint=Checkpoint(checkpoint, resume=resume),
            **case.options,
        )  # fmt: skip


def _in_windows(case: "Case", checkpoint: Path, options: argparse.Namespace, heights: Path, std: Path) -> None:
    """The same for a terrain that is fitted window by window."""
    from ...fitting.given import Checkpoint, Prior, Unknown
    from ...fitting.windows import fit_windows
    from ..progress import told

    interruption.raise_from_now_on()
    progress, place = _Progress(""), ""

    def note(number: int, count: int, done: "Step | Draws") -> None:
        nonlocal place
        place = f"window {number + 1} of {count}: "
        progress.note(done)
        tell()

    begin = time.monotonic()
    with _told_where(case, checkpoint), told(lambda seconds: place + progress.line(seconds)) as tell:
        found = fit_windows(
            case.scenes, case.targets, prior=Prior(**case.prior) if case.prior else None,
            unknown=Unknown(**case.unknown) if case.unknown else None, noise=case.noise, weights=case.weights,
            settings=case.settings, window=options.window, overlap=options.overlap, progress=note,
            checkpoint=Checkpoint(checkpoint, resume=options.resume), **case.options,
        )  # fmt: skip
    _save(case, found.heights, found.std, heights, std)
    checkpoint.unlink(missing_ok=True)
    ny, nx = found.heights.shape
    print(
        f"{heights}: {ny} x {nx} heights from {counted(len(case.targets), 'picture')} in "
        f"{counted(len(found.windows), 'window')}, {time.monotonic() - begin:.3g} s"
    )
    for done in found.windows:
        where = f"rows {done.y}-{done.y + done.ny - 1} columns {done.x}-{done.x + done.nx - 1}"
        seam = "" if math.isnan(done.seam) else f", {done.seam:.3g} off its neighbours"
        print(f"{where}: {done.result or 'in no picture'}; {counted(done.steps, 'step')}, chi2 {done.chi2:.4g}{seam}")
        for warning in done.warnings:
            print(f"jaxhf: warning: {where}: {warning}", file=sys.stderr)


def _save(case: "Case", heights: Any, std: Any, *paths: Path) -> None:
    import numpy as np

    from ...io.terrain.save import save_heights
    from ...io.terrain.terrain import Terrain

    field = case.scenes[0].heightfields[0]
    for path, values in zip(paths, (heights, std), strict=True):
        if values is not None:
            terrain = Terrain(np.asarray(values), float(field.dx), float(field.dy), float(field.x0), float(field.y0))
            save_heights(path, terrain, case.like)


class _Progress:
    """What a fit is doing, in a line: how far it is, since when, and what is to come."""

    def __init__(self, later: str):
        from ...fitting.history import Pace
        from ..progress import CompileTime

        self._compiling, self._begin, self._pace, self._later = CompileTime(), time.monotonic(), Pace(0.0), later
        self._done, self._details, self._remaining, self._noted = "first step", "", None, 0.0

    def note(self, done: "Step | Draws") -> None:
        from ...fitting.history import Draws

        self._noted = time.monotonic() - self._begin
        if isinstance(done, Draws):
            self._done, self._details = f"deviations: sample {done.drawn} of {done.wanted}", " (Ctrl-C: enough)"
            self._remaining, self._later = done.remaining, ""
        else:
            self._done, self._details = f"step {done.step}", f"; {done.level} DCT modes a side, loss {done.loss:.6g}"
            self._remaining = self._pace.remaining(self._noted - self._compiling.seconds, done.to_come)

    def line(self, seconds: float) -> str:
        from ..progress import duration

        remaining = self._remaining
        if self._noted == 0.0:  # the step that is under way takes this long at least
            remaining = _USUAL_STEPS * (seconds - self._compiling.seconds)
            if seconds < _EARLY or remaining < seconds:
                return f"compiling, {duration(seconds)} so far"
        elif remaining is not None:
            remaining -= seconds - self._noted
        to_come = "" if remaining is None else f", about {duration(max(remaining, 1))} to come{self._later}"
        return f"{self._done}, {duration(seconds)} so far{to_come}{self._details}"


COMMAND = Command(
    "fit",
    "recover heights from pictures",
    examples=("case.toml -o heights.tif --report report.html", "case.toml -o heights.tif --resume"),
    options={
        "": (
            option("case", metavar="CASE", help="a .toml file: a scene, its pictures, and what is known"),
            output("the heights: .npy, .npz or .tif"),
            option("--report", metavar="PAGE", help="an .html page with plots of heights, pictures and convergence"),
            flag("--resume", "go on from OUT.checkpoint, if it is there"),
            whole("--window", "N", "fit windows of N x N heights one after the other: it takes the memory of one", least=32),
            whole("--overlap", "M", "heights that neighbouring windows share [a quarter of N]", least=8),
        ),
        **arguments.MACHINE,
    },
    run=run,
    about="Beside OUT stand OUT_std and OUT_albedo.npy, where they are asked for.",
)
