"""The loop of a fit: step after step through its stages, watched, kept and resumed."""

import dataclasses
import hashlib
import itertools
import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..core.settings import Settings
from ..io.checkpoint import load_arrays, load_facts, save_checkpoint
from ..io.errors import FileError
from ..scene.heightfield import Heightfield
from .basis import Unknowns, balanced_units, make_basis
from .history import Step, Stop, print_progress
from .normal_matrix import is_sparse
from .options import FitOptions
from .problem import Problem, mode_curvature
from .residuals import heights_of, linearised, pictures_and_influence, surface_of
from .solvers import (
    DEFAULT_TOLERANCE,
    FIRST_DAMPING,
    Outcome,
    advance,
    evaluated_at,
    init_state,
    make_solver,
    reset_state,
    with_rejections,
)

_REJECTIONS = 2  # in a row, at a coarse level: the next one may do better
_HALVINGS = 50  # in a row, in a line search, whose first step is the whole gradient
_FLAT_STEPS = 3  # accepted in a row that hardly lower the loss
_FLAT_GAIN = 1e-3  # for each height: then heights change by 0.05 of the deviation that their noise leaves them with
_COARSE_GAIN = 0.02  # of the loss, where another stage follows
_COARSE_STEPS = 8  # at most, where another stage follows: what is left there is mostly for shorter modes to explain
_LEAST_CHANGE = 1.1  # a noise or a robust loss's scale that would change by less than this factor stays
_LAST_STAGES = 3  # at most, over which the scale of a robust loss comes down to its own, and the noise is estimated
_PROBES = 8  # of the pictures' curvature


def make_stages(shape: tuple[int, ...], options: FitOptions) -> list[float]:
    """The share of the highest frequency that each stage varies.

    The levels, then 1 while the loss is sharpened and the noise estimated.
    """
    levels = options.levels
    if levels is None:
        doublings = max(0, math.floor(math.log2(max(shape) / 8))) if options.solver == "lm" else 0
        levels = [0.5**k for k in range(doublings, -1, -1)]
    return [*levels, *[1.0] * (0 if options.loss == "squares" and options.noise is not None else _LAST_STAGES)]


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
        self.progress = print_progress if options.progress is True else options.progress or None
        self.stage = -1
        self.history: list[Step] = []
        self.stage_start = 0  # steps taken before this stage
        self.best = (math.inf, unknowns)
        self.converged = False  # the last step says so
        self.predicted = 0.0  # see `Outcome`
        self.snapshot: tuple[dict[str, Any], Any] | None = None  # for the next checkpoint
        self.final_loss_scale = None if problem.loss_scale is None else float(problem.loss_scale)
        self.units: np.ndarray | None = None  # see `make_basis`
        self.views: list[tuple[list[np.ndarray], Any]] = []  # linearised pictures, with the unknowns that they belong to
        self.seconds = 0.0  # spent before a resumption

    def run(self) -> Stop:
        self.started = time.perf_counter()
        self.fingerprint = _fingerprint(self.problem, self.unknowns, self.options) if self.path else ""
        self.initial_state = init_state(self.solver, self.unknowns, self.known(self.unknowns))
        self.state = self.initial_state
        if self.path and self.options.resume and self.path.exists():
            self._load()
        else:
            self._next_stage()
        try:
            while True:
                stop = self._stage_ended()
                while stop is not None:
                    if stop in (Stop.MAX_STEPS, Stop.NON_FINITE) or not self._next_stage():
                        self._save()  # what comes now, standard deviations, may take long
                        self.unknowns = self.best[1]
                        return stop
                    stop = self._stage_ended()
                self._step()
                if len(self.history) % self.options.checkpoint_every == 0:
                    self._save()
        except KeyboardInterrupt:
            self._save()
            raise

    def known(self, unknowns: Unknowns) -> Problem:
        """The problem, `linearised` at these unknowns; the pictures of the best unknowns and of the last ones are kept."""
        at, best = self._place(unknowns), self._place(self.best[1])
        found = next((found for place, found in self.views if _same_place(place, at)), None)
        if found is None:
            found = linearised(unknowns, self.problem).linearised
        kept = [view for view in self.views if view[1] is not found and _same_place(view[0], best)]
        self.views = [(at, found), *kept]
        return dataclasses.replace(self.problem, linearised=found)

    def _place(self, unknowns: Unknowns) -> list[np.ndarray]:
        """The heights and the other unknowns, on which pictures depend; not how the heights are made of modes."""
        others = eqx.tree_at(lambda u: u.coefficients, unknowns, None, is_leaf=lambda leaf: leaf is None)
        return [np.asarray(heights_of(unknowns, self.problem.basis)), *map(np.asarray, jax.tree.leaves(others))]

    def elapsed(self) -> float:
        """Seconds since the fit began, with those before a resumption."""
        return self.seconds + time.perf_counter() - self.started

    def _next_stage(self) -> bool:
        """Makes the best surface the base, and varies more modes about it, or sharpens the loss and estimates the noise again.

        Returns whether there is such a stage: not after the last, nor where it would repeat the one before.
        """
        if self.stage + 1 == len(self.stages):
            return False
        unknowns = self.best[1]
        surface = np.asarray(surface_of(unknowns, self.problem.basis))
        unknowns = eqx.tree_at(lambda u: u.coefficients, unknowns, jnp.zeros_like(unknowns.coefficients))
        share, repeats = self.stages[self.stage + 1], self.stage >= 0 and self.stages[self.stage] == 1
        known = self.known(self.best[1])
        refined = repeats and self._take_more_edges(surface)
        if refined:
            known = self.known(self.best[1])
        pictures, _ = pictures_and_influence(self.best[1], known)
        spreads = _spreads(pictures, known)  # radiance
        noise = self._estimated_noise(spreads, share)
        spread = float(np.sqrt(np.mean(np.square(spreads / noise))))
        scale = None
        if self.final_loss_scale is not None:
            scale = max(self.final_loss_scale, 3 * spread)
            if scale <= _LEAST_CHANGE * self.final_loss_scale or self.stage + 2 == len(self.stages):
                scale = self.final_loss_scale
        if (
            repeats
            and not refined
            and np.array_equal(noise, self.problem.noise)
            and (scale is None or scale == self._loss_scale())
        ):
            return False
        self.stage += 1
        self.unknowns, self.stage_start = unknowns, len(self.history)
        self._set_noise(noise, known)
        self.units, curvature = self._measured_units(self.best[1])
        self._set_basis(surface)
        if scale is not None:
            self.problem = dataclasses.replace(self.problem, loss_scale=jnp.asarray(scale, self.field.heights.dtype))
        self.best = (self.best[0], self.unknowns)
        step_size = jnp.asarray(1 / (FIRST_DAMPING * curvature), self.field.heights.dtype)
        self.state = reset_state(self.initial_state, self.unknowns, step_size if self._damped() else None)
        self._take_snapshot()
        return True

    def _take_more_edges(self, surface: np.ndarray) -> bool:
        """Whether the heights that were found call for many more points on edges than those of the start did."""
        heights = jnp.asarray(self.problem.basis.crop(surface), self.field.heights.dtype)
        problem = self.problem.with_edge_samples(heights, self.options)
        if problem.settings == self.problem.settings:
            return False
        self._set_settings(problem.settings)
        return True

    def _set_settings(self, settings: Settings) -> None:
        """Renders otherwise; the solver's state has another structure then."""
        self.problem, self.views = dataclasses.replace(self.problem, settings=settings, linearised=None), []
        self.initial_state = init_state(self.solver, self.best[1], self.known(self.best[1]))

    def _loss_scale(self) -> float | None:
        return None if self.problem.loss_scale is None else float(self.problem.loss_scale)

    def _set_basis(self, base: np.ndarray) -> None:
        basis = make_basis(self.field, base, self.stages[self.stage], self.units)
        self.problem = eqx.tree_at(lambda problem: problem.basis, self.problem, basis)

    def _set_noise(self, noise: np.ndarray, known: Problem) -> None:
        """Weighs residuals by this noise and by the error of the samples of the pictures that are known."""
        self.problem = dataclasses.replace(known.with_noise(noise), linearised=None)

    def _estimated_noise(self, spreads: np.ndarray, share: float) -> np.ndarray:
        """The noise of each picture by its residuals, where none is given; unchanged where it would hardly change.

        Args:
          spreads: of each picture's residuals, radiance.
          share: of the modes that the stage to come varies.
        """
        before = self.problem.noise
        if self.options.noise is not None:
            return before
        noise = np.maximum(spreads, self.problem.least_noise)
        changes = np.maximum(noise / before, before / noise)
        return before if share == 1 and changes.max() < _LEAST_CHANGE else noise

    def _measured_units(self, unknowns: Unknowns) -> tuple[np.ndarray, float]:
        """Units of the modes by the curvature of the loss at these unknowns, and that curvature, see `balanced_units`."""
        known = self.known(unknowns)
        influences = [np.asarray(pictures_and_influence(unknowns, known, key)[1]) for key in range(_PROBES)]
        basis = make_basis(self.field, np.asarray(self.problem.basis.base))
        curvature = mode_curvature(self.problem, influences)
        return balanced_units(np.asarray(basis.scale, np.float64), curvature, mean_only=self.options.solver != "lm")

    def set_all_modes(self) -> None:
        """Varies all modes about the present surface, whatever the level at which the fit stopped."""
        surface = np.asarray(surface_of(self.unknowns, self.problem.basis))
        known = self.known(self.unknowns)
        if self.options.uncertainty is not None and not is_sparse(known):  # for LSMR, of which draws are then made
            self.units, _ = self._measured_units(self.unknowns)
        basis = make_basis(self.field, surface, 1.0, self.units)
        self.problem = dataclasses.replace(known, basis=basis)
        self.unknowns = eqx.tree_at(lambda u: u.coefficients, self.unknowns, jnp.zeros_like(self.unknowns.coefficients))

    def _step(self) -> None:
        solver = with_rejections(self.solver, self._rejections())
        known = self.known(evaluated_at(self.unknowns, self.state))
        self.unknowns, self.state, outcome = advance(solver, self.unknowns, self.state, known)
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
        self.converged = bool(outcome.converged)
        self.predicted = float(outcome.predicted)
        self._take_snapshot()
        if self.progress:
            self.progress(step)

    def _stage_ended(self) -> Stop | None:
        """Why this stage is over, or None; one that another follows ends sooner."""
        steps = self.history[self.stage_start :]
        if not steps:
            return None if len(self.history) < self.options.max_steps else Stop.MAX_STEPS
        if not math.isfinite(steps[-1].loss):
            return Stop.NON_FINITE
        sharp = self._loss_scale() == self.final_loss_scale
        fine = self.stage + 1 == len(self.stages) or (self.stages[self.stage] == 1 and sharp)
        rejections = self._rejections()
        if len(steps) > 1 and self._flat(steps, fine):  # the first only evaluates where the stage begins
            return Stop.CONVERGED
        if rejections and self._damped():
            # Damping that grows with each rejection leaves less and less to be gained, until that would not count. (LSMR may
            # break down before: where damping is all that counts it ends in one iteration, and single precision in nan.)
            if not self.predicted >= self._enough(steps[-1].loss, fine) or (rejections >= _REJECTIONS and not fine):
                return Stop.CONVERGED if rejections == 1 else Stop.STALLED
        elif rejections >= _HALVINGS:
            return Stop.STALLED
        if not fine and self._damped() and len(steps) > _COARSE_STEPS:
            return Stop.CONVERGED
        return Stop.MAX_STEPS if len(self.history) >= self.options.max_steps else None

    def _damped(self) -> bool:
        """Whether rejected steps raise a λ."""
        return hasattr(self.initial_state, "num_steps_since_acceptance")

    def _flat(self, steps: Sequence[Step], fine: bool) -> bool:
        """Whether accepted steps hardly lower the loss any more."""
        enough, rejections = self._enough(steps[-1].loss, fine), self._rejections()
        if self.options.tolerance is None and self._damped():
            count, ended = 1, rejections == 0 and not self.predicted >= enough
        else:
            count, ended = _FLAT_STEPS if fine else 1, self.converged
        gains = [a.loss - b.loss for a, b in itertools.pairwise(steps) if b.accepted]
        return ended or (len(gains) >= count and rejections == 0 and max(map(abs, gains[-count:])) < enough)

    def _enough(self, loss: float, fine: bool) -> float:
        """By how much a step must lower the loss to count."""
        tolerance = self.options.tolerance
        if tolerance is None:
            if self._damped():
                return _FLAT_GAIN * self.field.heights.size if fine else _COARSE_GAIN * loss
            tolerance = DEFAULT_TOLERANCE
        return (tolerance if fine else max(tolerance, _COARSE_GAIN)) * loss

    def _arrays(self) -> Any:
        """The arrays of a checkpoint; of the state of Levenberg-Marquardt only 1 / λ, as one step makes the rest anew."""
        state = self.state.search_state.step_size if self._damped() else eqx.filter(self.state, eqx.is_array)
        place = (self.problem.basis.base, self.problem.loss_scale, self.problem.noise, self.units)
        return self.unknowns, self.best[1], place, state

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
            "converged": self.converged,
            "predicted": self.predicted,
            "edge_samples": self.problem.settings.edge_samples,
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
        settings = dataclasses.replace(self.problem.settings, edge_samples=facts["edge_samples"])
        if settings != self.problem.settings:
            self._set_settings(settings)
        self.units = np.zeros(self.problem.basis.base.shape)
        self.unknowns, best, (base, loss_scale, noise, self.units), state = load_arrays(self.path, self._arrays())
        self.stage, self.stage_start, self.converged = facts["stage"], facts["stage_start"], facts["converged"]
        self.best, self.seconds, self.predicted = (facts["best"], best), facts["seconds"], facts["predicted"]
        self.history = [Step(*line) for line in facts["history"]]
        self._set_basis(np.asarray(base))
        base_unknowns = eqx.tree_at(lambda u: u.coefficients, best, jnp.zeros_like(best.coefficients))
        self._set_noise(np.asarray(noise), self.known(base_unknowns))
        self.problem = dataclasses.replace(self.problem, loss_scale=loss_scale)
        if self._damped():
            self.state = reset_state(self.initial_state, self.unknowns, state)
            if len(self.history) > self.stage_start:
                solver = with_rejections(self.solver, 0)
                known = self.known(evaluated_at(self.unknowns, self.state))
                self.unknowns, self.state, _ = advance(solver, self.unknowns, self.state, known)
        else:
            self.state = eqx.combine(state, self.initial_state)


def _same_place(one: Sequence[np.ndarray], other: Sequence[np.ndarray]) -> bool:
    return all(map(np.array_equal, one, other))


def _spreads(pictures: Sequence[jax.Array], problem: Problem) -> Float[np.ndarray, " pictures"]:
    """The standard deviation of each picture's values at weight 1, by its residuals; radiance.

    By their median, as some are unexplained, or by their root mean square, which is less where they are all of one size, as
    those from rounding to 8 bits.
    Pixels that do not change with the heights, such as the background, do not count, nor the half of the others whose samples
    differ most.
    """
    spreads = np.zeros(problem.count)
    for number, (picture, group) in enumerate(zip(pictures, problem.groups, strict=True)):
        given = np.asarray(group.given)
        residuals = np.abs(given * (np.asarray(picture) - np.asarray(group.targets)))
        known = None if problem.linearised is None else problem.linearised[number]
        depends, sampling = (None, None) if known is None else (np.asarray(known.depends), np.asarray(known.sampling))
        for position, k in enumerate(group.indices):
            counted = given[position] > 0
            if depends is not None and sampling is not None:
                shown = counted & depends[position][..., None]
                if shown.any():
                    error = np.broadcast_to(sampling[position][..., None], shown.shape)
                    counted = shown & (error <= np.median(error[shown]))
            left = residuals[position][counted].astype(np.float64)
            with np.errstate(over="ignore"):
                spreads[k] = min(1.4826 * np.median(left), np.sqrt(np.mean(left * left)))
    return spreads


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
