"""What a fit says of its steps, and why it stopped."""

import enum
import sys
from typing import NamedTuple


class Stop(enum.Enum):
    """Why a fit stopped, in words."""

    CONVERGED = "converged: what a step still changes is below the tolerance"
    MAX_STEPS = "stopped after max_steps"
    STALLED = "stalled: no step along the derivative lowers the loss any more"
    NON_FINITE = "stopped: the loss is not finite; the heights are the best before that"


class Step(NamedTuple):
    """One line of a fit's history.

    Attributes:
      step: counted over all levels, from 1.
      level: how many DCT modes are varied along the longer side.
      loss: half the sum of squared residuals after it.
      accepted: whether the heights changed.
      damping: Levenberg-Marquardt's λ; 0 for other solvers.
      change: of the heights, root mean square, height units.
      seconds: since the fit began; a resumed one goes on counting.
    """

    step: int
    level: int
    loss: float
    accepted: bool
    damping: float
    change: float
    seconds: float


class Draws(NamedTuple):
    """How far the samples of the standard deviations are.

    Attributes:
      drawn, wanted: samples so far, and in all.
      seconds: that they took.
      remaining: seconds that the others will take.
    """

    drawn: int
    wanted: int
    seconds: float
    remaining: float


def print_progress(done: Step | Draws) -> None:
    if isinstance(done, Draws):
        line = f"sample {done.drawn} of {done.wanted}, {done.seconds:.1f} s, {done.remaining:.1f} s to come"
        print(line, file=sys.stderr, flush=True)
    else:
        _print_step(done)


def _print_step(step: Step) -> None:
    suffix = "" if step.accepted else ", not accepted"
    print(
        f"step {step.step}: {step.level} modes a side, loss {step.loss:.6g}, λ {step.damping:.2g}, "
        f"change {step.change:.3g}, {step.seconds:.1f} s{suffix}",
        file=sys.stderr,
        flush=True,
    )
