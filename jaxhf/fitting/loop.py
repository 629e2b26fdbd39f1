"""The loop of a fit: step after step through its stages, watched, kept and resumed."""

import dataclasses
import hashlib
import itertools
import math
import time
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..io.checkpoint import load_arrays, load_facts, save_checkpoint
from ..io.errors import FileError
from ..scene.heightfield import Heightfield
from .basis import Unknowns, make_basis
from .history import Step, Stop, print_step
from .options import FitOptions
from .problem import Problem
from .residuals import pictures_and_influence
from .solvers import Outcome, advance, init_state, make_solver, reset_state, with_rejections

_REJECTIONS = 2  # in a row, at a coarse level: the next one may do better
_HALVINGS = 50  # in a row, in a line search, whose first step is the whole gradient
_FLAT_STEPS = 3  # accepted in a row that hardly lower the loss
_NEAR_FINAL = 1.1  # a robust loss's scale within this factor of the final one is taken for it
_ROBUST_STAGES = 3  # over which the scale of a robust loss comes down to its own


def make_stages(shape: tuple[int, ...], options: FitOptions) -> list[float]:
    """The share of the highest frequency that each stage varies: the levels, then 1 while a robust loss's scale comes down."""
    levels = options.levels
    if levels is None:
        doublings = max(0, math.floor(math.log2(max(shape) / 8))) if options.solver == "lm" else 0
        levels = [0.5**k for k in range(doublings, -1, -1)]
    return [*levels, *[1.0] * (0 if options.loss == "squares" else _ROBUST_STAGES)]


class FitLoop:
    """Step after step through the stages of a fit; a checkpoint holds where it stands."""

    def __init__(self, problem: Problem, unknowns: Unknowns, field: Heightfield, options: FitOptions):
        self.problem = problem
        self.unknowns = unknowns
        self.field = field
        self.options = options
        self.solver = make_solver(options)
        self.stages = make_stages(field.heights.shape, options)
        self.path = None if options.checkpoint is None else Path(options.checkpoint)
        self.progress = print_step if options.progress is True else options.progress or None
        self.stage = -1
        self.history: list[Step] = []
        self.stage_start = 0  # steps taken before this stage
        self.best = (math.inf, unknowns)
        self.converged = False  # the last step says so
        self.predicted = 0.0  # share of the loss by which the last step was to lower it
        self.snapshot: tuple[dict[str, Any], Any] | None = None  # for the next checkpoint
        self.final_loss_scale = None if problem.loss_scale is None else float(problem.loss_scale)
        self.mean_scale = 1.0  # see `make_basis`
        self.seconds = 0.0  # spent before a resumption

    def run(self) -> Stop:
        self.started = time.perf_counter()
        self.fingerprint = _fingerprint(self.problem, self.unknowns, self.options) if self.path else ""
        self.initial_state = init_state(self.solver, self.unknowns, self.problem)
        self.state = self.initial_state
        if self.path and self.options.resume and self.path.exists():
            self._load()
        else:
            self._next_stage()
        try:
            while True:
                stop = self._stage_ended()
                while stop is not None:
                    if stop in (Stop.MAX_STEPS, Stop.NON_FINITE) or self.stage + 1 == len(self.stages):
                        self._save()  # what comes now, standard deviations, may take long
                        self.unknowns = self.best[1]
                        return stop
                    self._next_stage()
                    stop = self._stage_ended()
                self._step()
                if len(self.history) % self.options.checkpoint_every == 0:
                    self._save()
        except KeyboardInterrupt:
            self._save()
            raise

    def elapsed(self) -> float:
        """Seconds since the fit began, with those before a resumption."""
        return self.seconds + time.perf_counter() - self.started

    def _next_stage(self) -> None:
        """Makes the best surface the base, and varies more modes about it, or lowers the scale of the robust loss."""
        self.unknowns = self.best[1]
        surface = self.problem.basis.surface(self.unknowns.coefficients)
        self.unknowns = eqx.tree_at(lambda u: u.coefficients, self.unknowns, jnp.zeros_like(self.unknowns.coefficients))
        self.stage += 1
        self.stage_start = len(self.history)
        self._set_basis(np.asarray(surface))
        pictures, influence = pictures_and_influence(self.unknowns, self.problem)
        spread = _spread(pictures, self.problem)
        if self.stages[self.stage] == 1:
            self.mean_scale = self._mean_scale(pictures, np.asarray(influence))
            self._set_basis(np.asarray(surface))
        if self.final_loss_scale is not None:
            if min(self.stages[self.stage :]) == 1 and 3 * spread <= _NEAR_FINAL * self.final_loss_scale:
                self.stage = len(self.stages) - 1  # those between would be this one again
            last = self.stage + 1 == len(self.stages)
            scale = jnp.asarray(self.final_loss_scale if last else max(self.final_loss_scale, 3 * spread), surface.dtype)
            self.problem = eqx.tree_at(lambda problem: problem.loss_scale, self.problem, scale)
        self.best = (self.best[0], self.unknowns)
        self.state = reset_state(self.initial_state, self.unknowns)
        self._take_snapshot()

    def _set_basis(self, base: np.ndarray) -> None:
        basis = make_basis(self.field, base, self.stages[self.stage], self.mean_scale)
        self.problem = eqx.tree_at(lambda problem: problem.basis, self.problem, basis)

    def _mean_scale(self, pictures: list[jax.Array], influence: np.ndarray) -> float:
        """Sensitivity of the pictures to a typical DCT mode divided by that to the mean height, from 1 to 1000.

        Without it the solver's linear problem has one direction that is a hundred times weaker than the rest.
        """
        basis = make_basis(self.field, np.asarray(self.problem.basis.base))
        scale, rows, columns = np.asarray(basis.scale), np.asarray(basis.rows), np.asarray(basis.columns)
        gradient = rows @ np.pad(influence, [(n, n) for n in basis.padding]) @ columns.T
        typical = np.sqrt(np.median((scale * gradient) ** 2) / 0.455)  # the median of a squared normal
        height = math.sqrt(np.finfo(scale.dtype).eps) * scale[0, 0]
        raised = eqx.tree_at(
            lambda u: u.coefficients, self.unknowns, self.unknowns.coefficients.at[0, 0].add(height / scale[0, 0])
        )
        moved, _ = pictures_and_influence(raised, eqx.tree_at(lambda p: p.basis, self.problem, basis))
        pairs = zip(self.problem.groups, moved, pictures, strict=True)
        change = np.concatenate([np.ravel(group.weights * (a - b)) for group, a, b in pairs]) / (height / scale[0, 0])
        # A few pixels on edges jump: their share is bounded by that of the others.
        bound = 10 * np.median(np.abs(change[change != 0])) if change.any() else 0.0
        of_mean = float(np.linalg.norm(np.clip(change, -bound, bound)))
        return float(np.clip(typical / of_mean, 1.0, 1e3)) if of_mean > 0 else 1.0

    def _step(self) -> None:
        solver = with_rejections(self.solver, self._rejections())
        self.unknowns, self.state, outcome = advance(solver, self.unknowns, self.state, self.problem)
        self._record(outcome)

    def _rejections(self) -> int:
        """How many of this stage's steps were rejected since the last accepted one."""
        steps = reversed(self.history[self.stage_start :])
        return sum(1 for _ in itertools.takewhile(lambda step: not step.accepted, steps))

    def _record(self, outcome: Outcome) -> None:
        loss, accepted = float(outcome.loss), bool(outcome.accepted)
        first = len(self.history) == self.stage_start  # another stage's loss may have another scale
        if math.isfinite(loss) and (first or loss <= self.best[0]):
            self.best = (loss, outcome.unknowns)
        level = math.ceil(max(self.problem.basis.base.shape) * self.stages[self.stage])
        damping, change = float(outcome.damping), float(outcome.change)
        step = Step(len(self.history) + 1, level, loss, accepted, damping, change, self.elapsed())
        self.history.append(step)
        self.converged, self.predicted = bool(outcome.converged), float(outcome.predicted)
        self._take_snapshot()
        if self.progress:
            self.progress(step)

    def _stage_ended(self) -> Stop | None:
        """Why this stage is over, or None; all stages but the last have a tolerance of at least 0.02."""
        steps = self.history[self.stage_start :]
        if not steps:
            return None if len(self.history) < self.options.max_steps else Stop.MAX_STEPS
        if not math.isfinite(steps[-1].loss):
            return Stop.NON_FINITE
        last = self.stage + 1 == len(self.stages)
        tolerance = self.options.tolerance if last else max(self.options.tolerance, 0.02)
        gains = [(a.loss - b.loss) / max(a.loss, 1e-300) for a, b in itertools.pairwise(steps) if b.accepted]
        rejections = self._rejections()
        if self.converged and len(steps) > 1:  # the first only evaluates where the stage begins
            return Stop.CONVERGED
        count = _FLAT_STEPS if last else 1
        if len(gains) >= count and rejections == 0 and max(map(abs, gains[-count:])) < tolerance:
            return Stop.CONVERGED
        if rejections and hasattr(self.initial_state, "num_steps_since_acceptance"):
            # Damping that grows with each rejection leaves less and less to be gained, until that would not count.
            if self.predicted < tolerance or (rejections >= _REJECTIONS and not last):
                return Stop.CONVERGED if rejections == 1 else Stop.STALLED
        elif rejections >= _HALVINGS:
            return Stop.STALLED
        return Stop.MAX_STEPS if len(self.history) >= self.options.max_steps else None

    def _arrays(self) -> Any:
        """The arrays of a checkpoint; of the state of Levenberg-Marquardt only 1 / λ, as one step makes the rest anew."""
        lm = hasattr(self.state, "num_steps_since_acceptance")
        state = self.state.search_state.step_size if lm else eqx.filter(self.state, eqx.is_array)
        basis = (self.problem.basis.base, self.problem.loss_scale)
        return self.unknowns, self.best[1], basis, state

    def _take_snapshot(self) -> None:
        """Holds on to the present position for the next checkpoint; only after a whole step or change of stage.

        Ctrl-C may come while a stage changes or a step's numbers are waited for: that stage or step is then done again. Arrays
        are never written to, nor donated, so references to them are enough.
        """
        if self.path is None:
            return
        facts = {
            "fingerprint": self.fingerprint,
            "stage": self.stage,
            "stage_start": self.stage_start,
            "best": self.best[0],
            "mean_scale": self.mean_scale,
            "converged": self.converged,
            "predicted": self.predicted,
            "seconds": self.elapsed(),
            "history": [list(step) for step in self.history],
        }
        self.snapshot = (facts, self._arrays())

    def _save(self) -> None:
        """Writes the last snapshot; a fit that was resumed and took no step has none, and leaves its file as it is."""
        if self.path and self.snapshot:
            save_checkpoint(self.path, *self.snapshot)

    def _load(self) -> None:
        assert self.path is not None
        facts = load_facts(self.path)
        if facts["fingerprint"] != self.fingerprint:
            raise FileError(f"{self.path}: this is the checkpoint of another fit: its pictures, scenes or options differ")
        self.unknowns, best, (base, loss_scale), state = load_arrays(self.path, self._arrays())
        self.stage, self.stage_start = facts["stage"], facts["stage_start"]
        self.converged, self.predicted = facts["converged"], facts["predicted"]
        self.best, self.seconds = (facts["best"], best), facts["seconds"]
        self.history = [Step(*line) for line in facts["history"]]
        self.mean_scale = facts["mean_scale"]
        self._set_basis(np.asarray(base))
        self.problem = dataclasses.replace(self.problem, loss_scale=loss_scale)
        if hasattr(self.initial_state, "num_steps_since_acceptance"):
            self.state = reset_state(self.initial_state, self.unknowns, state)
            if len(self.history) > self.stage_start:
                solver = with_rejections(self.solver, 0)
                self.unknowns, self.state, _ = advance(solver, self.unknowns, self.state, self.problem)
        else:
            self.state = eqx.combine(state, self.initial_state)


def _spread(pictures: list[jax.Array], problem: Problem) -> float:
    """The standard deviation of the pictures' residuals, by their median: the few that are far off do not count."""
    sizes = []
    for picture, group in zip(pictures, problem.groups, strict=True):
        weights = np.asarray(group.weights)
        sizes.append(np.abs(weights * (np.asarray(picture) - np.asarray(group.targets)))[weights > 0])
    return float(1.4826 * np.median(np.concatenate(sizes)))


def _fingerprint(problem: Problem, unknowns: Unknowns, options: FitOptions) -> str:
    """A hash of all that decides on the steps: fits of the same fingerprint take the same ones, in whatever process.

    Args:
      problem, unknowns: those at the start; the structure of their pytrees says of what classes and sizes all parts are, and
        how many samples a scene asks for. The mesh does not count: another machine may go on.
      options: for what is not in the problem.
    """
    parts: dict[bool, list[Any]] = {True: [], False: []}
    for field in dataclasses.fields(problem):
        if field.name != "mesh":
            parts[field.metadata.get("static", False)].append(getattr(problem, field.name))
    leaves, structure = jax.tree.flatten((parts[False], unknowns))
    levels = None if options.levels is None else list(options.levels)
    choices = (parts[True], structure, options.solver, levels, options.inner_steps, options.tolerance)
    digest = hashlib.sha256(repr(choices).encode())
    for leaf in map(np.asarray, leaves):
        digest.update(repr((leaf.shape, leaf.dtype.str)).encode() + leaf.tobytes())
    return digest.hexdigest()
