"""What `jaxhf fit` does: a file's pictures to files of heights, watched on a terminal and safe from interruption."""

import dataclasses
import sys
from pathlib import Path
from typing import Any

import numpy as np

from ..core.extras import require_matplotlib
from ..fitting.fit import Fit, fit
from ..fitting.history import Step
from ..io.files import require_writable_text, save_text
from ..io.images import save_image
from ..io.save_terrain import require_writable_heights, save_heights
from ..io.terrain import Terrain
from ..io.toml.fit import Case, load_case
from .fit_report import report


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
        for path in (self.heights, self.std):
            require_writable_heights(path)
        if self.report is not None:
            require_writable_text(self.report, ".html")
            require_matplotlib("a report needs")
        if self.checkpoint.exists() and not self.resume:
            raise ValueError(
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


def fit_file(path: str, outputs: Outputs, precision: str) -> str:
    """Fits what a file asks for and writes the results; returns lines about them, the last of them why the fit stopped.

    Raises:
      FileNotFoundError, ValueError: anything that is wrong in the file, before anything is traced.
      KeyboardInterrupt: Ctrl-C; its text says how to go on.
    """
    case = load_case(path, np.dtype(precision))
    options: dict[str, Any] = {"checkpoint": outputs.checkpoint, "resume": outputs.resume, **case.options}
    try:
        with _Progress() as progress:
            found = fit(
                case.scenes, case.targets, settings=case.settings, weights=case.weights, noise=case.noise,
                progress=progress, **options,
            )  # fmt: skip
    except KeyboardInterrupt:
        if not outputs.checkpoint.exists():
            raise
        raise KeyboardInterrupt(f"interrupted; the same command with --resume goes on from {outputs.checkpoint}") from None
    except ValueError as error:
        raise case.located(error) from error
    _write(path, case, found, outputs)
    outputs.checkpoint.unlink(missing_ok=True)
    ny, nx = found.heights.shape
    count = len(case.targets)
    lines = [
        f"{name}: {', '.join(f'{float(value):.6g}' for value in values)}"
        for name, values in (("exposures", found.exposures), ("offsets", found.offsets))
        if values is not None
    ]
    lines.append(
        f"{outputs.heights}: {ny} x {nx} heights from {count} picture{'s' * (count > 1)}, {found.result.value}; "
        f"{found.stats['steps']} steps, {found.stats['seconds']:.3g} s, loss {found.stats['loss']:.6g}, "
        f"chi2 {found.stats['chi2']:.4g}"
    )
    return "\n".join(lines)


def _write(path: str, case: Case, found: Fit, outputs: Outputs) -> None:
    field = case.scenes[0].heightfields[0]
    for place, heights in ((outputs.heights, found.heights), (outputs.std, found.std)):
        if heights is not None:
            terrain = Terrain(np.asarray(heights), float(field.dx), float(field.dy), float(field.x0), float(field.y0))
            save_heights(place, terrain, case.like)
    if found.albedo is not None:
        factors = np.asarray(found.albedo)[::-1]  # a texture begins at v = 0, an image at its top
        save_image(outputs.albedo, factors if factors.shape[-1] == 3 else factors[..., 0])
    if outputs.report is not None:
        page = report(f"Heights from {path}", found, field, case.targets, case.noise, case.names)
        save_text(outputs.report, page)


class _Progress:
    """One line that changes with each step, on a terminal only."""

    def __init__(self) -> None:
        self.shown = sys.stderr.isatty()

    def __enter__(self) -> "_Progress":
        self._show("compiling")
        return self

    def __call__(self, step: Step) -> None:
        self._show(f"step {step.step}: {step.level} modes a side, loss {step.loss:.6g}, {step.seconds:.1f} s")

    def __exit__(self, *_: object) -> None:
        self._show("")
        if self.shown:
            print("\r", end="", file=sys.stderr, flush=True)

    def _show(self, text: str) -> None:
        if self.shown:
            print(f"\r{text:70}", end="", file=sys.stderr, flush=True)
