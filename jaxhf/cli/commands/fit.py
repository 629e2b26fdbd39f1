"""`jaxhf fit`: a file's pictures to files of heights, watched on a terminal and safe from interruption."""

import argparse
import math
import sys
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np

from ...core.errors import ArgumentError, UserError, counted
from ...core.extras import import_extra
from ...fitting.fit import Pace, fit
from ...fitting.given import Checkpoint, Draws, Noise, Prior, Step, Unknown
from ...fitting.trust.judge import Fit
from ...fitting.windows import Mosaic, fit_windows
from ...io.errors import FileError
from ...io.files import require_writable, save_text
from ...io.pictures.images import save_image
from ...io.scenes.toml.fit import Case, load_case
from ...io.terrain.save import require_writable_heights, save_heights
from ...io.terrain.terrain import Terrain
from .. import interruption, limits
from ..fit_report import facts, report
from ..overwriting import require_no_input
from ..progress import CompileTime, duration, told
from ..scene_warnings import warn


def run(options: argparse.Namespace) -> None:
    if options.window is None and options.overlap is not None:
        raise UserError("--overlap must stand with --window")
    if options.window is not None and options.report:
        raise UserError("--report must stand without --window: it shows one fit")
    heights, checkpoint = Path(options.output), Path(f"{options.output}.checkpoint")
    std, albedo = heights.with_stem(f"{heights.stem}_std"), heights.with_name(f"{heights.stem}_albedo.npy")
    for path in (heights, std):  # before the fit, not after it
        require_writable_heights(path, (".npy", ".npz", ".tif", ".tiff"))  # which hold any heights, and holes
    if options.report:
        require_writable("save_text", "a page", (".html",), options.report)
        import_extra("matplotlib", "a report needs", "plot")
    if checkpoint.exists() and not options.resume:
        raise FileError(
            f"{checkpoint}: an interrupted fit left this checkpoint; --resume goes on from it, to begin anew remove it"
        )
    require_no_input(options, std, albedo)
    limits.set_up_jax(options)
    case = load_case(options.case, np.dtype(options.precision))
    warn(case.scenes)
    limits.require_memory(case.scenes[0], jax.local_device_count())
    begin = time.monotonic()
    found = _fit(case, checkpoint, options)
    field = case.scenes[0].heightfields[0]
    for path, values in ((heights, found.heights), (std, found.std)):
        if values is not None:
            terrain = Terrain(np.asarray(values), float(field.dx), float(field.dy), float(field.x0), float(field.y0))
            save_heights(path, terrain, case.like)
    ny, nx = found.heights.shape
    made = f"{heights}: {ny} x {nx} heights from {counted(len(case.targets), 'picture')}"
    if isinstance(found, Mosaic):
        checkpoint.unlink(missing_ok=True)
        print(f"{made} in {counted(len(found.windows), 'window')}, {time.monotonic() - begin:.3g} s")
        return _tell_of_windows(found)
    if found.albedo is not None:
        factors = np.asarray(found.albedo)[::-1]  # a texture begins at v = 0, an image at its top
        save_image(albedo, factors if factors.shape[-1] == 3 else factors[..., 0])
    if options.report:
        save_text(options.report, report(f"Heights from {options.case}", case, found))
    checkpoint.unlink(missing_ok=True)
    _tell_of_fit(made, case, found)


def _fit(case: Case, checkpoint: Path, options: argparse.Namespace) -> Fit | Mosaic:
    """What the file asks for. KeyboardInterrupt says how to go on, an error of an argument in which line it stands."""
    interruption.raise_from_now_on()
    windows = options.window is not None
    drawn = ", then deviations" if case.options.get("draws") else ""
    progress = _Progress(" of this window" if windows else drawn)
    try:
        noise = case.noise and [Noise(**one) if isinstance(one, dict) else one for one in case.noise]
        given: dict[str, Any] = {
            "prior": Prior(**case.prior) if case.prior else None,
            "unknown": Unknown(**case.unknown) if case.unknown else None,
            "noise": noise, "weights": case.weights, "settings": case.settings,
            "checkpoint": Checkpoint(checkpoint, resume=options.resume), **case.options,
        }  # fmt: skip
        with told(progress.line):
            if not windows:
                return fit(case.scenes, case.targets, progress=progress.note, **given)
            return fit_windows(
                case.scenes, case.targets, window=options.window, overlap=options.overlap, **given,
                progress=lambda number, count, done: progress.note(done, f"window {number + 1} of {count}: "),
            )  # fmt: skip
    except KeyboardInterrupt:
        if not checkpoint.exists():
            raise
        raise KeyboardInterrupt(f"interrupted; the same command with --resume goes on from {checkpoint}") from None
    except ArgumentError as error:
        raise case.located(error) from error


def _tell_of_fit(made: str, case: Case, found: Fit) -> None:
    for name, text in facts(case, found):
        print(f"{name}: {text}")
    print(
        f"{made}, {found.result.value}; {counted(int(found.stats['steps']), 'step')}, {found.stats['seconds']:.3g} s, "
        f"loss {found.stats['loss']:.6g}, chi2 {found.stats['chi2']:.4g}"
    )
    for warning in found.warnings:
        print(f"jaxhf: warning: {warning}", file=sys.stderr)


def _tell_of_windows(found: Mosaic) -> None:
    for done in found.windows:
        where = f"rows {done.y}-{done.y + done.ny - 1} columns {done.x}-{done.x + done.nx - 1}"
        seam = "" if math.isnan(done.seam) else f", {done.seam:.3g} off its neighbours"
        print(f"{where}: {done.result or 'in no picture'}; {counted(done.steps, 'step')}, chi2 {done.chi2:.4g}{seam}")
        for warning in done.warnings:
            print(f"jaxhf: warning: {where}: {warning}", file=sys.stderr)


class _Progress:
    """What a fit is doing, in a line: how far it is, since when, and what is to come."""

    def __init__(self, later: str):
        self._compiling, self._begin, self._pace, self._later = CompileTime(), time.monotonic(), Pace(0.0), later
        self._done, self._details, self._remaining, self._noted = "compiling, then the first step", "", None, 0.0

    def note(self, done: Step | Draws, place: str = "") -> None:
        self._noted = time.monotonic() - self._begin
        if isinstance(done, Draws):
            self._done, self._details = f"{place}deviations: sample {done.drawn} of {done.wanted}", " (Ctrl-C: enough)"
            self._remaining = done.remaining, self._later if place else ""
        else:
            self._done, self._details = f"{place}step {done.step}", f"; {done.level} DCT modes a side, loss {done.loss:.6g}"
            remaining = self._pace.remaining(self._noted - self._compiling.seconds, done.to_come)
            self._remaining = None if remaining is None else (remaining, self._later)

    def line(self) -> str:
        seconds, to_come = time.monotonic() - self._begin, ""
        if (told := self._remaining) is not None:  # before the first step nothing says it: a compilation is told of afterwards
            remaining, later = told
            to_come = f", about {duration(max(remaining - (seconds - self._noted), 1))} to come{later}"
        return f"{self._done}, {duration(seconds)} so far{to_come}{self._details}"
