"""What a fit says of its steps, and why it stopped."""

import collections
import enum
import sys
from collections.abc import Callable
from typing import NamedTuple


class Stop(enum.Enum):
    """Why a fit stopped; the values say it in words.

    Attributes:
      CONVERGED: what a step still changes is below the tolerance.
      MAX_STEPS: it took as many steps as it was allowed.
      STALLED: no step along the derivative lowers the loss any more.
      NON_FINITE: the loss is not finite; the heights are the best before that.
    """

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
      damping: Levenberg-Marquardt's λ; 0 of the last steps, see docs/concepts/recovery.md.
      change: of the heights, root mean square, height units.
      seconds: since the fit began; a resumed one goes on counting.
      to_come: about how many steps will follow, by what fits take as a rule; None in `Fit.history`.
    """

    step: int
    level: int
    loss: float
    accepted: bool
    damping: float
    change: float
    seconds: float
    to_come: int | None = None


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


class Pace:
    """How long steps take, by when the last few of them ended.

    `begin`: when the first step began; None: how long that took, compilation above all, says nothing.
    """

    def __init__(self, begin: float | None = None):
        self._ends = collections.deque([] if begin is None else [begin], maxlen=6)

    def remaining(self, end: float, to_come: int | None) -> float | None:
        """The seconds that so many steps will take after one that ended now; None: not known."""
        self._ends.append(end)
        steps = len(self._ends) - 1
        return None if steps < 1 or to_come is None else (self._ends[-1] - self._ends[0]) / steps * to_come


def printed_progress() -> Callable[[Step | Draws], None]:
    """A function that prints a line on standard error for each step, and for each sample of the deviations."""
    pace = Pace()

    def line(done: Step | Draws) -> str:
        if isinstance(done, Draws):
            return f"sample {done.drawn} of {done.wanted}, {done.seconds:.1f} s, {done.remaining:.1f} s to come"
        remaining = pace.remaining(done.seconds, done.to_come)
        to_come = "" if remaining is None else f", about {remaining:.0f} s to come"
        return (
            f"step {done.step}: {done.level} modes a side, loss {done.loss:.6g}, λ {done.damping:.2g}, "
            f"change {done.change:.3g}, {done.seconds:.1f} s{to_come}{'' if done.accepted else ', not accepted'}"
        )

    return lambda done: print(line(done), file=sys.stderr, flush=True)
