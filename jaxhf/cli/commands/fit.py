"""`jaxhf fit`: a file's pictures to files of heights, watched on a terminal and safe from interruption."""

import argparse
import dataclasses
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...core.errors import ArgumentError, counted
from .. import arguments, interruption
from ..arguments import flag, option, output
from ..command import Command
from ..overwriting import require_no_input

if TYPE_CHECKING:
    from ...fitting.fit import Fit
    from ...fitting.history import Draws, Step
    from ...io.toml.fit import Case

_USUAL_STEPS = 30  # of a fit, until it says what is to come
_EARLY = 50.0  # seconds: most fits compile no longer, and JAX reports a compilation only when it is done


def run(options: argparse.Namespace) -> None:
    outputs = Outputs(Path(options.output), Path(options.report) if options.report else None, options.resume)
    require_no_input(options, outputs.std, outputs.albedo)
    arguments.set_up_jax(options)
    report, warnings = fit_file(options.case, outputs, options.precision)
    print(report)
    for warning in warnings:
        print(f"jaxhf: warning: {warning}", file=sys.stderr)


@dataclasses.dataclass(frozen=True)
class Outputs:
    """Where the results go. All are refused before the fit that could not be written after it.

    Attributes:
      heights: see `save_heights`.
      report: an .html page; None: none.
      resume: whether to go on from a checkpoint, if there is one.
    """

    heights: Path
    report: Path | None
    resume: bool

    def __post_init__(self):
        from ...core.extras import import_extra
        from ...io.errors import FileError
        from ...io.files import require_writable_text
        from ...io.save_terrain import require_writable_heights

        for path in (self.heights, self.std):
            require_writable_heights(path, (".npy", ".npz", ".tif", ".tiff"))  # which hold any heights, and holes
        if self.report is not None:
            require_writable_text(self.report, ".html")
            import_extra("matplotlib", "a report needs", "plot")
        if self.checkpoint.exists() and not self.resume:
            raise FileError(
                f"{self.checkpoint}: an interrupted fit left this checkpoint; --resume goes on from it, to begin anew remove it"
            )

    @property
    def std(self) -> Path:
        return self.heights.with_stem(f"{self.heights.stem}_std")

    @property
    def albedo(self) -> Path:
        return self.heights.with_name(f"{self.heights.stem}_albedo.npy")

    @property
    def checkpoint(self) -> Path:
        return self.heights.with_name(f"{self.heights.name}.checkpoint")


def fit_file(path: str, outputs: Outputs, precision: str) -> tuple[str, Sequence[str]]:
    """Fits what a file asks for and writes the results.

    Returns:
      Lines about them, the last of them why the fit stopped; and what speaks against trusting them.

    Raises:
      FileNotFoundError, ValueError: anything that is wrong in the file, before anything is traced.
      KeyboardInterrupt: Ctrl-C; its text says how to go on.
    """
    import jax
    import numpy as np

    from ...fitting.fit import fit
    from ...io.toml.fit import load_case
    from ..limits import require_memory
    from ..progress import told
    from ..scene_warnings import warn

    case = load_case(path, np.dtype(precision))
    warn(case.scenes)
    require_memory(case.scenes[0], jax.local_device_count())
    options: dict[str, Any] = {"checkpoint": outputs.checkpoint, "resume": outputs.resume, **case.options}
    interruption.raise_from_now_on()
    try:
        progress = _Progress(", then deviations" if "uncertainty" in case.options else "")
        with told(progress.line) as tell:
            found = fit(
                case.scenes, case.targets, settings=case.settings, weights=case.weights, noise=case.noise,
                progress=lambda done: (progress.note(done), tell())[1], **options,
            )  # fmt: skip
    except KeyboardInterrupt:
        if not outputs.checkpoint.exists():
            raise
        raise KeyboardInterrupt(f"interrupted; the same command with --resume goes on from {outputs.checkpoint}") from None
    except ArgumentError as error:
        raise case.located(error) from error
    _write(path, case, found, outputs)
    outputs.checkpoint.unlink(missing_ok=True)
    ny, nx = found.heights.shape
    lines = []
    if case.noise is None:
        lines.append(f"noise, estimated: {', '.join(f'{value:.3g}' for value in found.noise)}")
    lines += [
        f"{name}: {', '.join(f'{float(value):.6g}' for value in values)}"
        for name, values in (("exposures", found.exposures), ("offsets", found.offsets))
        if values is not None
    ]
    lines += _views(case, found)
    lines.append(
        f"{outputs.heights}: {ny} x {nx} heights from {counted(len(case.targets), 'picture')}, {found.result.value}; "
        f"{counted(int(found.stats['steps']), 'step')}, {found.stats['seconds']:.3g} s, loss {found.stats['loss']:.6g}, "
        f"chi2 {found.stats['chi2']:.4g}"
    )
    return "\n".join(lines), found.warnings


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


def _views(case: "Case", found: "Fit") -> list[str]:
    """The lights' directions and the cameras' positions, where they were sought, and how far they are from those given."""
    import numpy as np

    from ...fitting.view import differences, sun

    lights, cameras = [], []
    for given, scene in zip(case.scenes, found.scenes, strict=True):
        turned, moved, rotated = differences(given, scene)
        light = sun(scene.lights)
        if light is not None:
            x, y, z = np.asarray(light.towards, np.float64)
            azimuth, altitude = np.degrees(np.arctan2(x, y)) % 360, np.degrees(np.arctan2(z, np.hypot(x, y)))
            lights.append(f"azimuth {azimuth:.2f} altitude {altitude:.2f} (turned by {turned:.2f} degrees)")
        eye = " ".join(f"{value:.9g}" for value in np.asarray(scene.camera.world_from_camera)[:3, 3])
        cameras.append(f"eye {eye} (moved by {moved:.4g}, turned by {rotated:.2f} degrees)")
    return [
        f"{name}: {', '.join(values)}"
        for name, values in (("light", lights), ("camera", cameras))
        if f"{name}_std" in case.options
    ]


def _write(path: str, case: "Case", found: "Fit", outputs: Outputs) -> None:
    import numpy as np

    from ...io.files import save_text
    from ...io.images import save_image
    from ...io.save_terrain import save_heights
    from ...io.terrain import Terrain
    from ..fit_report import report

    field = case.scenes[0].heightfields[0]
    for place, heights in ((outputs.heights, found.heights), (outputs.std, found.std)):
        if heights is not None:
            terrain = Terrain(np.asarray(heights), float(field.dx), float(field.dy), float(field.x0), float(field.y0))
            save_heights(place, terrain, case.like)
    if found.albedo is not None:
        factors = np.asarray(found.albedo)[::-1]  # a texture begins at v = 0, an image at its top
        save_image(outputs.albedo, factors if factors.shape[-1] == 3 else factors[..., 0])
    if outputs.report is not None:
        page = report(f"Heights from {path}", found, field, case.targets, case.names)
        save_text(outputs.report, page)


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
        ),
        **arguments.MACHINE,
    },
    run=run,
    about="Beside OUT stand OUT_std and OUT_albedo.npy, where they are asked for.",
)
