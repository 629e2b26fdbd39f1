"""The loop of a fit: step after step through its stages, watched, kept and resumed."""

import dataclasses
import hashlib
import itertools
import math
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..io.checkpoint import load_arrays, load_facts, save_checkpoint
from ..io.errors import FileError
from ..scene.scene import Scene
from .basis import Unknowns, make_basis
from .history import Step, Stop
from .problem import Problem
from .residuals import pictures_and_influence
from .solvers import Outcome, advance, begin, impatient, restarted

_REJECTIONS = 5  # in a row: the last trial had 4 · 8 · 16 · 32 times the damping of the first


_HALVINGS = 50  # in a row, in a line search, which starts with the whole gradient


_FLAT_STEPS = 3  # accepted in a row that hardly lower the loss


_SHARP = 1.1  # a robust loss's scale so near to its own is taken for it


_ROBUST_STAGES = 3  # over which the scale of a robust loss comes down to its own


def make_stages(shape: tuple[int, ...], solver: str, levels: Sequence[float] | None, loss: str) -> list[float]:
    """The shares of the highest frequency, one after the other; a robust loss stays at the last while it sharpens."""
    if levels is None:
        doublings = max(0, math.floor(math.log2(max(shape) / 8))) if solver == "lm" else 0
        levels = [0.5**k for k in range(doublings, -1, -1)]
    return [*levels, *[1.0] * (0 if loss == "squares" else _ROBUST_STAGES)]


class Descent:
    """The loop: its position is what a checkpoint holds."""

    def __init__(self, problem, unknowns, solver, stages, tolerance, max_steps, progress, path, every, options):
        self.problem: Problem = problem
        self.unknowns: Unknowns = unknowns
        self.solver: Any = solver
        self.stages: list[float] = stages
        self.tolerance: float = tolerance
        self.max_steps: int = max_steps
        self.progress: Callable[[Step], None] | None = progress
        self.path: Path | None = path
        self.every: int = every
        self.options: str = options
        self.stage = -1
        self.history: list[Step] = []
        self.stage_start = 0  # steps taken before this stage
        self.best = (math.inf, unknowns)
        self.converged = False  # the last step says so
        self.kept: tuple[dict[str, Any], Any] | None = None  # see `_keep`
        self.sharpest = None if problem.loss_scale is None else float(problem.loss_scale)
        self.lift = 1.0  # see `make_basis`
        self.seconds = 0.0  # spent before a resumption

    def go(self, scene: Scene, resume: bool) -> Stop:
        self.begun = time.perf_counter()
        field = scene.heightfields[0]
        self.fingerprint = _fingerprint(self.problem, self.options) if self.path else ""
        self.fresh = begin(self.solver, self.unknowns, self.problem)
        self.state = self.fresh
        if self.path and resume and self.path.exists():
            self._load(field)
        else:
            self._next_stage(field)
        try:
            while True:
                stop = self._stage_ended()
                while stop is not None:
                    if stop in (Stop.MAX_STEPS, Stop.NON_FINITE) or self.stage + 1 == len(self.stages):
                        self._save()  # what comes now, standard deviations, may take long
                        self.unknowns = self.best[1]
                        return stop
                    self._next_stage(field)
                    stop = self._stage_ended()
                self._step()
                if len(self.history) % self.every == 0:
                    self._save()
        except KeyboardInterrupt:
            self._save()
            raise

    def _next_stage(self, field: Any) -> None:
        """Puts what is known by now into the base, and varies more waves about it, or weighs outliers more sharply."""
        self.unknowns = self.best[1]
        surface = self.problem.basis.surface(self.unknowns.waves)
        self.unknowns = eqx.tree_at(lambda u: u.waves, self.unknowns, jnp.zeros_like(self.unknowns.waves))
        self.stage += 1
        self.stage_start = len(self.history)
        self._set_basis(field, np.asarray(surface))
        pictures, influence = pictures_and_influence(self.unknowns, self.problem)
        spread = _spread(pictures, self.problem)
        if self.stages[self.stage] == 1:
            self.lift = self._lift(field, pictures, np.asarray(influence))
            self._set_basis(field, np.asarray(surface))
        if self.sharpest is not None:
            if min(self.stages[self.stage :]) == 1 and 3 * spread <= _SHARP * self.sharpest:
                self.stage = len(self.stages) - 1  # those between would be this one again
            last = self.stage + 1 == len(self.stages)
            scale = jnp.asarray(self.sharpest if last else max(self.sharpest, 3 * spread), surface.dtype)
            self.problem = eqx.tree_at(lambda problem: problem.loss_scale, self.problem, scale)
        self.best = (math.inf, self.unknowns)
        self.state = restarted(self.fresh, self.unknowns)
        self._keep()

    def _set_basis(self, field: Any, base: np.ndarray) -> None:
        basis = make_basis(field, base, self.stages[self.stage], self.lift)
        self.problem = eqx.tree_at(lambda problem: problem.basis, self.problem, basis)

    def _lift(self, field: Any, pictures: list[jax.Array], influence: np.ndarray) -> float:
        """How many times less the pictures change by the constant wave than by one like any other.

        Without it the solver's linear problem has one direction that is a hundred times weaker than the rest.
        """
        basis = make_basis(field, np.asarray(self.problem.basis.base))
        scale, rows, columns = np.asarray(basis.scale), np.asarray(basis.rows), np.asarray(basis.columns)
        pull = rows @ np.pad(influence, [(n, n) for n in basis.margin]) @ columns.T
        usual = np.sqrt(np.median((scale * pull) ** 2) / 0.455)  # the median of a squared normal
        size = math.sqrt(np.finfo(scale.dtype).eps) * scale[0, 0]
        raised = eqx.tree_at(lambda u: u.waves, self.unknowns, self.unknowns.waves.at[0, 0].add(size / scale[0, 0]))
        moved, _ = pictures_and_influence(raised, eqx.tree_at(lambda p: p.basis, self.problem, basis))
        pairs = zip(self.problem.groups, moved, pictures, strict=True)
        change = np.concatenate([np.ravel(group.weights * (a - b)) for group, a, b in pairs]) / (size / scale[0, 0])
        # A few pixels on edges jump: their share is bounded by that of the others.
        bound = 10 * np.median(np.abs(change[change != 0])) if change.any() else 0.0
        weak = float(np.linalg.norm(np.clip(change, -bound, bound)))
        return float(np.clip(usual / weak, 1.0, 1e3)) if weak > 0 else 1.0

    def _step(self) -> None:
        solver = impatient(self.solver, self._rejected())
        self.unknowns, self.state, outcome = advance(solver, self.unknowns, self.state, self.problem)
        self._note(outcome)

    def _rejected(self) -> int:
        """Steps of this stage in a row, the last of them the latest, that were not accepted."""
        steps = self.history[self.stage_start :]
        rejected = 0
        while rejected < len(steps) and not steps[-1 - rejected].accepted:
            rejected += 1
        return rejected

    def _note(self, outcome: Outcome) -> None:
        loss, accepted = float(outcome.loss), bool(outcome.accepted)
        if math.isfinite(loss) and loss <= self.best[0]:
            self.best = (loss, outcome.unknowns)
        waves = math.ceil(max(self.problem.basis.base.shape) * self.stages[self.stage])
        seconds = self.seconds + time.perf_counter() - self.begun
        line = Step(len(self.history) + 1, waves, loss, accepted, float(outcome.damping), float(outcome.change), seconds)
        self.history.append(line)
        self.converged = bool(outcome.converged)
        self._keep()
        if self.progress:
            self.progress(line)

    def _stage_ended(self) -> Stop | None:
        """Why this stage is over, or None. All but the last are only to come near."""
        steps = self.history[self.stage_start :]
        if not steps:
            return None if len(self.history) < self.max_steps else Stop.MAX_STEPS
        if not math.isfinite(steps[-1].loss):
            return Stop.NON_FINITE
        last = self.stage + 1 == len(self.stages)
        tolerance = self.tolerance if last else max(self.tolerance, 0.02)
        gains = [(a.loss - b.loss) / max(a.loss, 1e-300) for a, b in itertools.pairwise(steps) if b.accepted]
        rejected = self._rejected()
        if self.converged and len(steps) > 1:  # the first only evaluates where the stage begins
            return Stop.CONVERGED
        wanted = _FLAT_STEPS if last else 1
        if len(gains) >= wanted and rejected == 0 and max(map(abs, gains[-wanted:])) < tolerance:
            return Stop.CONVERGED
        damped = hasattr(self.fresh, "num_steps_since_acceptance")
        if rejected >= ((_REJECTIONS if last else 2) if damped else _HALVINGS):
            return Stop.STALLED
        return Stop.MAX_STEPS if len(self.history) >= self.max_steps else None

    def _arrays(self) -> Any:
        """What a checkpoint holds of the state: all but what one step of Levenberg-Marquardt makes anew."""
        lm = hasattr(self.state, "num_steps_since_acceptance")
        state = self.state.search_state.step_size if lm else eqx.filter(self.state, eqx.is_array)
        basis = (self.problem.basis.base, self.problem.loss_scale)
        return self.unknowns, self.best[1], basis, state

    def _keep(self) -> None:
        """Notes where the fit stands, for the next checkpoint; called only where all of that belongs together.

        Ctrl-C may come while a stage changes or a step's numbers are waited for: what is done again then is that stage or step.
        Arrays are never written to, nor donated, so holding on to them is enough.
        """
        if self.path is None:
            return
        facts = {
            "fingerprint": self.fingerprint,
            "stage": self.stage,
            "stage_start": self.stage_start,
            "best": self.best[0],
            "lift": self.lift,
            "converged": self.converged,
            "seconds": self.seconds + time.perf_counter() - self.begun,
            "history": [list(step) for step in self.history],
        }
        self.kept = (facts, self._arrays())

    def _save(self) -> None:
        """A fit that went on from a checkpoint and took no step keeps nothing: the file says it all."""
        if self.path and self.kept:
            save_checkpoint(self.path, *self.kept)

    def _load(self, field: Any) -> None:
        assert self.path is not None
        facts = load_facts(self.path)
        if facts["fingerprint"] != self.fingerprint:
            raise FileError(f"{self.path}: this is the checkpoint of another fit: its pictures, scenes or options differ")
        self.unknowns, best, (base, loss_scale), state = load_arrays(self.path, self._arrays())
        self.stage, self.stage_start, self.converged = facts["stage"], facts["stage_start"], facts["converged"]
        self.best, self.seconds = (facts["best"], best), facts["seconds"]
        self.history = [Step(*line) for line in facts["history"]]
        self.lift = facts["lift"]
        self._set_basis(field, np.asarray(base))
        self.problem = dataclasses.replace(self.problem, loss_scale=loss_scale)
        if hasattr(self.fresh, "num_steps_since_acceptance"):
            self.state = restarted(self.fresh, self.unknowns, state)
            if len(self.history) > self.stage_start:
                solver = impatient(self.solver, 0)
                self.unknowns, self.state, _ = advance(solver, self.unknowns, self.state, self.problem)
        else:
            self.state = eqx.combine(state, self.fresh)


def _spread(pictures: list[jax.Array], problem: Problem) -> float:
    """The standard deviation of the pictures' residuals, by their median: the few that are far off do not count."""
    sizes = []
    for picture, group in zip(pictures, problem.groups, strict=True):
        weights = np.asarray(group.weights)
        sizes.append(np.abs(weights * (np.asarray(picture) - np.asarray(group.targets)))[weights > 0])
    return float(1.4826 * np.median(np.concatenate(sizes)))


def _fingerprint(problem: Problem, options: str) -> str:
    digest = hashlib.sha256(f"{options} {problem.loss} {problem.settings}".encode())
    for leaf in jax.tree.leaves(problem):
        digest.update(np.asarray(leaf).tobytes())
    return digest.hexdigest()
