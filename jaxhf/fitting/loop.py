"""The loop of a fit: step after step through its stages, watched, kept and resumed."""

import dataclasses
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
from jaxtyping import Float

from ..io.checkpoint import load_arrays, load_facts, save_checkpoint
from ..io.errors import FileError
from ..scene.heightfield import Heightfield
from .basis import Unknowns, balanced_units, make_basis
from .curvature import mode_curvature
from .fingerprint import fingerprint
from .history import Step, Stop, printed_progress
from .jacobian import Sparse, in_rows, picture_values
from .known import Known, KnownPictures, jacobian_at, pictures_and_influence
from .noise import Freedom, estimated_noise, explains_noise, freedom, spreads_of
from .normal_equations import NormalEquations, advance, has_damping, init_state, reset_state, step_size, with_rejections
from .normals import evidence_for_angles
from .options import FitOptions, make_stages
from .problem import Problem
from .quadratic import is_sparse
from .residuals import surface_of
from .solvers import DEFAULT_TOLERANCE, FIRST_DAMPING, Outcome, evaluated_at, make_solver

_REJECTIONS = 2  # in a row, at a coarse level: the next one may do better
_HALVINGS = 50  # in a row, in a line search, whose first step is the whole gradient
_FLAT_STEPS = 3  # accepted in a row that hardly lower the loss
_FLAT_GAIN = 1e-3  # for each height: then heights change by 0.05 of the deviation that their noise leaves them with
_COARSE_GAIN = 0.02  # of the loss, where another stage follows
_COARSE_STEPS = 8  # at most, where another stage follows: what is left there is mostly for shorter modes to explain
_USUAL_STEPS, _USUAL_COARSE_STEPS = 5, 4  # of a stage, for what progress says is to come
_LEAST_CHANGE = 1.1  # a noise or a robust loss's scale that would change by less than this factor stays
_TRIAL_STEPS = 6  # with other normals
_EVIDENCE = 3.0  # for these, standard deviations, to try them
_FAR = 3.0  # standard deviations of the noise: a residual that is larger counts as this
_PROBES = 8  # of the pictures' curvature


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
        self.progress = printed_progress() if options.progress is True else options.progress or None
        self.stage = -1
        self.history: list[Step] = []
        self.stage_start = 0  # steps taken before this stage
        self.best = (math.inf, unknowns)
        self.converged = False  # the last step says so
        self.predicted = 0.0  # see `Outcome`
        self.snapshot: tuple[dict[str, Any], Any] | None = None  # for the next checkpoint
        self.final_loss_scale = None if problem.loss_scale is None else float(problem.loss_scale)
        self.units: np.ndarray | None = None  # see `make_basis`
        self.pictures = KnownPictures()
        self.estimate: tuple[Unknowns, Any] | None = None  # see `_restricted`
        self.freedom: Freedom | None = None  # of the pictures' residuals, where it is known
        self.seconds = 0.0  # spent before a resumption

    def run(self) -> Stop:
        self.started = time.perf_counter()
        self.fingerprint = fingerprint(self.problem, self.unknowns, self.options) if self.path else ""
        facts = self._facts() if self.path and self.options.resume and self.path.exists() else None
        self.state = self.initial_state = self._initial_state(self.unknowns)
        if facts is None:
            self._next_stage()
        else:
            self._load(facts)
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
        return dataclasses.replace(self.problem, linearised=self._known(unknowns).linearised)

    def _known(self, unknowns: Unknowns) -> Known:
        return self.pictures.at(unknowns, self.problem, self.best[1])

    def pictures_and_influence(self, unknowns: Unknowns, key: int = 0) -> tuple[list[jax.Array], Float[np.ndarray, "ny nx"]]:
        """Those of `known` unknowns, see there."""
        return pictures_and_influence(unknowns, self.problem, key, self._known(unknowns))

    def _jacobian(self, unknowns: Unknowns) -> Callable[[], Sparse]:
        return lambda: jacobian_at(unknowns, self.problem, self._known(unknowns))

    def _initial_state(self, unknowns: Unknowns) -> Any:
        """The solver's state before its first step; Levenberg-Marquardt is by normal equations where that can be."""
        known = self.known(unknowns)
        if self.options.solver == "lm" and is_sparse(known):
            self.solver = NormalEquations(self.options.tolerance or DEFAULT_TOLERANCE, self.options.inner_steps)
        return init_state(self.solver, unknowns, known)

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
        refined = repeats and self._take_other_settings(surface)
        known, spreads = self.known(self.best[1]), self._spreads(self.best[1])
        noise = self._estimated_noise(spreads, repeats, share)
        spread = _rms(spreads / noise)
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
        first = jnp.asarray(1 / (FIRST_DAMPING * curvature), self.field.heights.dtype)
        self.state = reset_state(self.initial_state, self.unknowns, first if self._damped() else None)
        self._take_snapshot()
        return True

    def _spreads(self, unknowns: Unknowns) -> Float[np.ndarray, " pictures"]:
        """Of what these unknowns leave of the pictures, radiance."""
        pictures, _ = self.pictures_and_influence(unknowns)
        return spreads_of(pictures, self.known(unknowns))

    def _tried(self, steps: int) -> Unknowns:
        """Where some steps from the best unknowns lead, which are not taken: heights that were fitted with other normals make
        up for these."""
        at, (_, curvature) = self.best[1], self._measured_units(self.best[1])
        size = jnp.asarray(1 / (FIRST_DAMPING * curvature), self.field.heights.dtype)
        state = reset_state(self.initial_state, at, size)
        for _ in range(1 + steps):
            there = evaluated_at(at, state)
            at, state, _ = advance(with_rejections(self.solver, 0, self._jacobian(there)), at, state, self.known(there))
        return at

    def _take_other_settings(self, surface: np.ndarray) -> bool:
        """Whether the heights that were found call for many more points on edges than those of the start did, or other normals
        explain the pictures better, after some steps."""
        heights, before = jnp.asarray(self.problem.basis.crop(surface), self.field.heights.dtype), self.problem
        finer = before.with_edge_samples(heights, self.options)
        left_open = before.by_angle is not None and not bool(before.by_angle)
        if left_open:
            left = self._left(self.best[1])
            if self._evidence_for_angles(heights, left) > _EVIDENCE:
                self._set_problem(dataclasses.replace(finer, by_angle=jnp.asarray(True)))
                left_by_angle = self._left(self._tried(_TRIAL_STEPS))
                if left_by_angle @ left_by_angle < left @ left:
                    return True
                self._set_problem(before)
        if finer.settings != before.settings:
            self._set_problem(finer)
        return finer.settings != before.settings

    def _evidence_for_angles(self, heights: jax.Array, left: Float[np.ndarray, " rows"]) -> float:
        """See there; 0 where the pictures' derivatives are not known."""
        known = self.known(self.best[1])
        return evidence_for_angles(known, heights, left) if is_sparse(known) else 0.0

    def _left(self, unknowns: Unknowns) -> Float[np.ndarray, " rows"]:
        """What these unknowns leave of the pictures, in units of the noise; far off at most `_FAR`."""
        known = self.known(unknowns)
        pairs = zip(known.groups, picture_values(unknowns, known).images, strict=True)
        return np.clip(in_rows([group.weights * (image - group.targets) for group, image in pairs]), -_FAR, _FAR)

    def _set_problem(self, problem: Problem) -> None:
        """Renders otherwise; the solver's state may have another structure then."""
        self.problem = dataclasses.replace(problem, linearised=None)
        self.pictures, self.estimate = KnownPictures(), None
        self.initial_state = self._initial_state(self.best[1])

    def _loss_scale(self) -> float | None:
        return None if self.problem.loss_scale is None else float(self.problem.loss_scale)

    def _set_basis(self, base: np.ndarray) -> None:
        basis = make_basis(self.field, base, self.stages[self.stage], self.units)
        self.problem = eqx.tree_at(lambda problem: problem.basis, self.problem, basis)

    def _set_noise(self, noise: np.ndarray, known: Problem) -> None:
        """Weighs residuals by this noise and by the error of the samples of the pictures that are known."""
        self.problem = dataclasses.replace(known.with_noise(noise), linearised=None)

    def _estimated_noise(self, spreads: np.ndarray, repeats: bool, share: float) -> np.ndarray:
        """The noise of each picture by its residuals, where none is given; unchanged where it would hardly change.

        Args:
          spreads: of each picture's residuals, radiance.
          repeats: whether all modes were varied; before, what is left is mostly for shorter ones to explain.
          share: of the modes that the stage to come varies.
        """
        before = self.problem.noise
        if self.options.noise is not None:
            return before
        restricted = self._restricted(self.best[1]) if repeats else None
        noise = np.maximum(spreads, self.problem.least_noise) if restricted is None else restricted[0]
        changes = np.maximum(noise / before, before / noise)
        return before if share == 1 and changes.max() < _LEAST_CHANGE else noise

    def _restricted(self, unknowns: Unknowns) -> tuple[np.ndarray, np.ndarray] | None:
        """See `estimated_noise`; None where heights explain little of it, or the pictures' derivatives are not known."""
        known = self.known(unknowns)
        if not (is_sparse(known) and explains_noise(known)):
            return None
        if self.estimate is None or self.estimate[0] is not unknowns:
            found = estimated_noise(unknowns, known, self._jacobian(unknowns)(), self.options.noise is None)
            self.estimate = unknowns, found
        return self.estimate[1]

    def _measured_units(self, unknowns: Unknowns) -> tuple[np.ndarray, float]:
        """Units of the modes by the curvature of the loss at these unknowns, and that curvature, see `balanced_units`."""
        influences = [self.pictures_and_influence(unknowns, key)[1] for key in range(_PROBES)]
        basis = make_basis(self.field, np.asarray(self.problem.basis.base))
        curvature = mode_curvature(self.problem, influences)
        return balanced_units(np.asarray(basis.scale, np.float64), curvature, mean_only=self.options.solver != "lm")

    def set_all_modes(self) -> None:
        """Varies all modes about the present surface, whatever the level at which the fit stopped."""
        surface = np.asarray(surface_of(self.unknowns, self.problem.basis))
        fitted = self.stages[self.stage] == 1 and math.isfinite(self.best[0])
        restricted = self._restricted(self.unknowns) if fitted else None
        if restricted is not None:
            self._set_noise(restricted[0], self.known(self.unknowns))
        known = self.known(self.unknowns)
        if restricted is not None:
            self.freedom = freedom(self.unknowns, known, self._jacobian(self.unknowns)(), restricted[1])
        if self.options.uncertainty is not None and not is_sparse(known):  # for LSMR, of which draws are then made
            self.units, _ = self._measured_units(self.unknowns)
        basis = make_basis(self.field, surface, 1.0, self.units)
        self.problem = dataclasses.replace(known, basis=basis)
        self.unknowns = eqx.tree_at(lambda u: u.coefficients, self.unknowns, jnp.zeros_like(self.unknowns.coefficients))

    def _step(self) -> None:
        self.unknowns, self.state, outcome = self._advance(self._rejections())
        self._record(outcome)

    def _advance(self, rejections: int) -> tuple[Unknowns, Any, Outcome]:
        at = evaluated_at(self.unknowns, self.state)
        solver = with_rejections(self.solver, rejections, self._jacobian(at))
        return advance(solver, self.unknowns, self.state, self.known(at))

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
            self.progress(step._replace(to_come=self._steps_to_come()))

    def _steps_to_come(self) -> int:
        """About how many: as many as stages take as a rule, or, of other solvers than Levenberg-Marquardt, as there may be."""
        most, done = self.options.max_steps - len(self.history), len(self.history) - self.stage_start
        if not self._damped():
            return most
        usual, *later = [_USUAL_STEPS if share == 1 else _USUAL_COARSE_STEPS for share in self.stages[self.stage :]]
        return min(most, max(usual - done, 1 + done // 3) + sum(later))

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
        return has_damping(self.initial_state)

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
        state = step_size(self.state) if self._damped() else eqx.filter(self.state, eqx.is_array)
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
            "by_angle": None if self.problem.by_angle is None else bool(self.problem.by_angle),
            "seconds": self.elapsed(),
            "history": [list(step) for step in self.history],
        }
        self.snapshot = (facts, self._arrays())

    def _save(self) -> None:
        """Writes the last snapshot; a fit that was resumed and took no step has none, and leaves its file as it is."""
        if self.path and self.snapshot:
            save_checkpoint(self.path, *self.snapshot)

    def _facts(self) -> dict[str, Any]:
        """Those of the checkpoint to go on from; FileError where it is another fit's."""
        assert self.path is not None
        facts = load_facts(self.path)
        if facts["fingerprint"] != self.fingerprint:
            raise FileError(f"{self.path}: this is the checkpoint of another fit: its pictures, scenes or options differ")
        return facts

    def _load(self, facts: dict[str, Any]) -> None:
        assert self.path is not None
        settings = dataclasses.replace(self.problem.settings, edge_samples=facts["edge_samples"])
        by_angle = None if facts["by_angle"] is None else jnp.asarray(facts["by_angle"])
        if settings != self.problem.settings or by_angle:
            self._set_problem(dataclasses.replace(self.problem, settings=settings, by_angle=by_angle))
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
                self.unknowns, self.state, _ = self._advance(0)
        else:
            self.state = eqx.combine(state, self.initial_state)


def _rms(values: Float[np.ndarray, " n"]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
