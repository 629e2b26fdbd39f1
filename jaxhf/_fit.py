"""Recovers heights from pictures."""

import dataclasses
import enum
import hashlib
import itertools
import math
import os
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from ._problem import Albedo, Asked, Loss, Problem, first_unknowns, make_groups, make_heights, make_prior
from ._scene import Scene
from ._settings import Settings
from ._solvers import BFGS_UNKNOWNS, Outcome, Solver, advance, begin, count_unknowns, make_solver, restarted
from ._types import AnyArray
from ._uncertainty import pictures_and_influence, standard_deviations
from ._unknowns import Unknowns, make_basis
from .io._checkpoint import load_arrays, load_facts, save_checkpoint

_REJECTIONS = 8  # in a row: the damping has grown by 4 ** 8
_HALVINGS = 50  # in a row, in a line search, which starts with the whole gradient
_FLAT_STEPS = 3  # accepted in a row that hardly lower the loss
_ROBUST_STAGES = 3  # over which the scale of a robust loss comes down to its own


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
      level: how many waves a side are varied, at most.
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


@dataclasses.dataclass(frozen=True, eq=False)
class Fit:
    """What `fit` found.

    Attributes:
      heights: shape (ny, nx), in the dtype of the scenes' heights.
      result: why it stopped.
      std: standard deviation of each height, shape (ny, nx); infinite where nothing says anything about it. None where
        `uncertainty` was not asked for.
      seen: whether a change of the height would change any picture, shape (ny, nx).
      albedo: what the albedo of the scenes is to be multiplied by, shape (ty, tx, c); None where it was known.
      exposures, offsets: of each picture; None where they were known.
      images: the pictures as they would be measured, (h, w) or (h, w, c) each, as their targets.
      residuals: `images` - targets; 0 where a target has no weight.
      stats: steps, accepted, seconds, loss; chi2, the mean square of the pictures' residuals in units of `noise`: about 1
        where `noise` is right and all is explained.
      history: a `Step` for each step.
    """

    heights: Float[AnyArray, "ny nx"]
    result: Stop
    std: Float[np.ndarray, "ny nx"] | None
    seen: Bool[np.ndarray, "ny nx"]
    albedo: Float[AnyArray, "ty tx c"] | None
    exposures: Float[AnyArray, " pictures"] | None
    offsets: Float[AnyArray, " pictures"] | None
    images: tuple[np.ndarray, ...]
    residuals: tuple[np.ndarray, ...]
    stats: dict[str, int | float]
    history: tuple[Step, ...]


def fit(
    scenes: Sequence[Scene],
    targets: Sequence[Any],
    *,
    settings: Settings = Settings(),
    weights: Sequence[Any] | None = None,
    noise: Any = 0.01,
    start: Any = None,
    prior: Any = None,
    prior_std: Any = None,
    smoothness: float | int | None = None,
    albedo: Albedo | str = "known",
    albedo_smoothness: float | int | None = None,
    exposures: bool = False,
    offsets: bool = False,
    loss: Loss | str = "squares",
    loss_scale: float | int = 3.0,
    solver: Solver | str = "lm",
    levels: Sequence[float] | None = None,
    max_steps: int = 100,
    inner_steps: int = 60,
    tolerance: float | int = 1e-4,
    uncertainty: int | str | None = None,
    progress: Callable[[Step], None] | bool = False,
    checkpoint: str | os.PathLike[str] | None = None,
    checkpoint_every: int = 10,
    resume: bool = False,
) -> Fit:
    """Recovers the heights of a terrain from pictures of it.

    Minimises Σ ρ((exposure · picture(heights) + offset - target) / noise) + Σ ((heights - prior) / prior_std)² / 2
    + Σ (Laplacian / smoothness)² / 2 over the heights and what else is unknown, from coarse to fine, by Levenberg-Marquardt
    steps that never form a matrix. Every term is in standard deviations, so that the result's are those of the heights.

    The derivative is `render`'s, which does not know that shadows and silhouettes move. What shows in nothing else (the
    height of a plain under a vertical view) stays where it began.

    Args:
      scenes: one a picture. Their first heightfields share shape, precision, spacing and origin, and are what is sought.
      targets: linear radiance, shape (h, w), (h, w, 1) or (h, w, 3) as the scene's camera says, top row first. One without or
        with one channel is compared with the mean over a picture's channels.
      settings: how to render.
      weights: for each picture None or a map (h, w) or (h, w, c), from 0 (masked: the target may be nan there)
        on; it divides the noise.
      noise: standard deviation of a target's values at weight 1, radiance; one number or one for each picture.
      start: heights to begin with: a number (flat), a grid over the same footprint, of any size, or None: those of the
        first scene.
      prior: heights known beforehand, as `start`; None: nothing.
      prior_std: how far they may be off, a number or shape (ny, nx), height units.
      smoothness: standard deviation of the sum of a height's differences to its four neighbours, height units; None: no
        such term.
      albedo: "known"; "constant", one unknown factor on the heightfield's albedo; "map", a factor for each texel of its image,
        or for each vertex where it has none.
      albedo_smoothness: as `smoothness`, of those factors.
      exposures, offsets: whether each picture has an unknown factor, an unknown addend. Where the albedo is unknown too, only
        the product of exposure and albedo is known; the fit keeps near 1.
      loss: ρ, see `loss_scale`: "squares", r²/2; "huber", "cauchy" and "geman" make less of what is far off, such as
        pixels that a moved shadow explains. They begin with a scale as wide as the residuals and come down (Black and
        Rangarajan 1996).
      loss_scale: where that begins, in standard deviations.
      solver: "lm"; "bfgs" (4096 unknowns at most) and "lbfgs"; "adam", optax's, for its robustness against a noisy derivative.
      levels: shares of the highest frequency up to which heights are varied, one after the other, the last being 1; None:
        from 8 waves a side, doubled each time, for "lm", all at once for the others.
      max_steps: over all levels.
      inner_steps: LSMR iterations in one step of Levenberg-Marquardt, at most.
      tolerance: of the relative change of unknowns and residuals in one step at which the fit has converged.
      uncertainty: None; the number of samples from which standard deviations are estimated, each to 1 / √(2 · samples); or
        "exact", where pictures times unknowns are few. See `standard_deviations`.
      progress: called after each step; True prints a line to standard error.
      checkpoint: a file in which the state is kept every `checkpoint_every` steps and on Ctrl-C.
      resume: goes on from that file if it is there; the result is bitwise that of a fit that was not interrupted.

    Returns:
      A `Fit`. It is returned however the fit ended; `result` says how.

    Raises:
      ValueError: anything about the arguments, before anything is traced; a checkpoint that is damaged or of another fit.
      KeyboardInterrupt: Ctrl-C, after the checkpoint was written.
    """
    scenes, targets = tuple(scenes), tuple(targets)
    asked = Asked(
        weights, noise, prior, prior_std, smoothness, albedo, albedo_smoothness, exposures, offsets, loss, loss_scale
    )  # fmt: skip
    _check_choices(asked, solver, levels, max_steps, inner_steps, checkpoint_every, tolerance, uncertainty)
    groups = make_groups(scenes, targets, settings, asked)
    first = scenes[0]
    shape, dtype = first.heights.shape, first.heights.dtype
    heights = make_heights("start", np.asarray(first.heights) if start is None else start, shape)
    unknowns = first_unknowns(first, max(group.targets.shape[-1] for group in groups), len(scenes), asked)
    problem = Problem(
        groups,
        make_basis(first.heightfields[0], heights),
        make_prior(shape, dtype, prior, prior_std),
        None if smoothness is None else jnp.asarray(1 / smoothness, dtype),
        None if albedo_smoothness is None else jnp.asarray(1 / albedo_smoothness, dtype),
        None if loss == "squares" else jnp.asarray(loss_scale, dtype),
        loss,
        settings,
    )
    if solver == "bfgs" and count_unknowns(unknowns) > BFGS_UNKNOWNS:
        raise ValueError(
            f"fit: solver bfgs takes at most {BFGS_UNKNOWNS} unknowns, there are {count_unknowns(unknowns)}; take lbfgs"
        )
    run = _Run(
        problem,
        unknowns,
        make_solver(solver, tolerance, inner_steps),
        _stages(shape, solver, levels, loss),
        tolerance,
        max_steps,
        _print_step if progress is True else progress or None,
        None if checkpoint is None else Path(checkpoint),
        checkpoint_every,
        f"{solver} {levels} {inner_steps} {tolerance}",
    )
    result = run.go(first, resume)
    # Whatever the level at which it stopped, all waves are in doubt.
    basis = make_basis(first.heightfields[0], np.asarray(run.problem.basis.heights(run.unknowns.waves)))
    run.problem = eqx.tree_at(lambda problem: problem.basis, run.problem, basis)
    run.unknowns = eqx.tree_at(lambda unknowns: unknowns.waves, run.unknowns, jnp.zeros_like(run.unknowns.waves))
    return _report(run, result, targets, uncertainty, inner_steps)


def _check_choices(asked, solver, levels, max_steps, inner_steps, every, tolerance, uncertainty) -> None:
    for name, value, kind in (("solver", solver, Solver), ("loss", asked.loss, Loss), ("albedo", asked.albedo, Albedo)):
        if value not in get_args(kind):
            raise ValueError(f"fit: {name} must be one of {', '.join(get_args(kind))}; it is {value!r}")
    for name, value in (("max_steps", max_steps), ("inner_steps", inner_steps), ("checkpoint_every", every)):
        if not isinstance(value, int) or isinstance(value, bool) or value < 1:
            raise ValueError(f"fit: {name} must be a whole number from 1 on, it is {value!r}")
    numbers = {
        "smoothness": asked.smoothness, "albedo_smoothness": asked.albedo_smoothness, "loss_scale": asked.loss_scale,
        "tolerance": tolerance,
    }  # fmt: skip
    for name, value in numbers.items():
        if value is not None and not (math.isfinite(value) and value > 0):
            raise ValueError(f"fit: {name} must be positive and finite, it is {value!r}")
    if levels is not None and not (len(levels) and all(0 < level <= 1 for level in levels) and levels[-1] == 1):
        raise ValueError(f"fit: levels must be shares above 0, the last of them 1; they are {levels!r}")
    whole = isinstance(uncertainty, int) and not isinstance(uncertainty, bool) and uncertainty >= 2
    if not (uncertainty is None or uncertainty == "exact" or whole):
        raise ValueError(f"fit: uncertainty must be None, 'exact' or a number of samples from 2 on, it is {uncertainty!r}")


def _stages(shape: tuple[int, ...], solver: str, levels: Sequence[float] | None, loss: str) -> list[float]:
    """The shares of the highest frequency, one after the other; a robust loss stays at the last while it sharpens."""
    if levels is None:
        doublings = max(0, math.floor(math.log2(max(shape) / 8))) if solver == "lm" else 0
        levels = [0.5**k for k in range(doublings, -1, -1)]
    return [*levels, *[1.0] * (0 if loss == "squares" else _ROBUST_STAGES)]


def _print_step(step: Step) -> None:
    word = "" if step.accepted else ", not accepted"
    print(
        f"step {step.step}: {step.level} waves, loss {step.loss:.6g}, λ {step.damping:.2g}, "
        f"change {step.change:.3g}, {step.seconds:.1f} s{word}",
        file=sys.stderr,
        flush=True,
    )


class _Run:
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
                        self.unknowns = self.best[1]
                        return stop
                    self._next_stage(field)
                    stop = self._stage_ended()
                self._step()
                if self.path and len(self.history) % self.every == 0:
                    self._save()
        except KeyboardInterrupt:
            if self.path:
                self._save()
            raise

    def _next_stage(self, field: Any) -> None:
        """Puts what is known by now into the base, and varies more waves about it, or weighs outliers more sharply."""
        self.unknowns = self.best[1]
        heights = self.problem.basis.heights(self.unknowns.waves)
        self.unknowns = eqx.tree_at(lambda u: u.waves, self.unknowns, jnp.zeros_like(self.unknowns.waves))
        self.stage += 1
        self.stage_start = len(self.history)
        self._set_basis(field, np.asarray(heights))
        last = self.stage + 1 == len(self.stages)
        pictures, pull = pictures_and_influence(self.unknowns, self.problem)
        spread = _spread(pictures, self.problem)
        if self.stages[self.stage] == 1:
            self.lift = self._lift(pictures, np.asarray(pull))
            self._set_basis(field, np.asarray(heights))
        if self.sharpest is not None:
            scale = jnp.asarray(self.sharpest if last else max(self.sharpest, 3 * spread), heights.dtype)
            self.problem = eqx.tree_at(lambda problem: problem.loss_scale, self.problem, scale)
        self.best = (math.inf, self.unknowns)
        self.state = restarted(self.fresh, self.unknowns)

    def _set_basis(self, field: Any, base: np.ndarray) -> None:
        basis = make_basis(field, base, self.stages[self.stage], self.lift)
        self.problem = eqx.tree_at(lambda problem: problem.basis, self.problem, basis)

    def _lift(self, pictures: list[jax.Array], pull: np.ndarray) -> float:
        """How many times less the pictures change by the constant wave than by one like any other.

        Without it the solver's linear problem has one direction that is a hundred times weaker than the rest.
        """
        basis = self.problem.basis
        scale, rows, columns = np.asarray(basis.scale), np.asarray(basis.rows), np.asarray(basis.columns)
        usual = np.sqrt(np.median((scale * (rows @ pull @ columns.T)) ** 2) / 0.455)  # the median of a squared normal
        size = math.sqrt(np.finfo(scale.dtype).eps) * scale[0, 0]
        raised = eqx.tree_at(lambda u: u.waves, self.unknowns, self.unknowns.waves.at[0, 0].add(size / scale[0, 0]))
        moved, _ = pictures_and_influence(raised, self.problem)
        pairs = zip(self.problem.groups, moved, pictures, strict=True)
        change = np.concatenate([np.ravel(group.weights * (a - b)) for group, a, b in pairs]) / (size / scale[0, 0])
        # A few pixels on edges jump: their share is bounded by that of the others.
        bound = 10 * np.median(np.abs(change[change != 0])) if change.any() else 0.0
        weak = float(np.linalg.norm(np.clip(change, -bound, bound)))
        return float(np.clip(usual / weak, 1.0, 1e3)) if weak > 0 else 1.0

    def _step(self) -> None:
        self.unknowns, self.state, outcome = advance(self.solver, self.unknowns, self.state, self.problem)
        self._note(outcome)

    def _note(self, outcome: Outcome) -> None:
        loss, accepted = float(outcome.loss), bool(outcome.accepted)
        if math.isfinite(loss) and loss <= self.best[0]:
            self.best = (loss, outcome.unknowns)
        waves = math.ceil(max(self.problem.basis.base.shape) * self.stages[self.stage])
        seconds = self.seconds + time.perf_counter() - self.begun
        line = Step(len(self.history) + 1, waves, loss, accepted, float(outcome.damping), float(outcome.change), seconds)
        self.history.append(line)
        self.converged = bool(outcome.converged)
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
        rejected = 0
        while rejected < len(steps) and not steps[-1 - rejected].accepted:
            rejected += 1
        if self.converged and len(steps) > 1:  # the first only evaluates where the stage begins
            return Stop.CONVERGED
        wanted = _FLAT_STEPS if last else 1
        if len(gains) >= wanted and rejected == 0 and max(map(abs, gains[-wanted:])) < tolerance:
            return Stop.CONVERGED
        damped = hasattr(self.fresh, "num_steps_since_acceptance")
        if rejected >= ((_REJECTIONS if last else 3) if damped else _HALVINGS):
            return Stop.STALLED
        return Stop.MAX_STEPS if len(self.history) >= self.max_steps else None

    def _arrays(self) -> Any:
        """What a checkpoint holds of the state: all but what one step of Levenberg-Marquardt makes anew."""
        lm = hasattr(self.state, "num_steps_since_acceptance")
        state = self.state.search_state.step_size if lm else eqx.filter(self.state, eqx.is_array)
        basis = (self.problem.basis.base, self.problem.loss_scale)
        return self.unknowns, self.best[1], basis, state

    def _save(self) -> None:
        assert self.path is not None
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
        save_checkpoint(self.path, facts, self._arrays())

    def _load(self, field: Any) -> None:
        assert self.path is not None
        facts = load_facts(self.path)
        if facts["fingerprint"] != self.fingerprint:
            raise ValueError(f"{self.path}: this is the checkpoint of another fit: its pictures, scenes or options differ")
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
                self.unknowns, self.state, _ = advance(self.solver, self.unknowns, self.state, self.problem)
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


def _report(run: _Run, result: Stop, targets: Sequence[Any], uncertainty: int | str | None, inner_steps: int) -> Fit:
    problem, unknowns = run.problem, run.unknowns
    images: list[np.ndarray] = [np.zeros(())] * problem.count
    differences: list[np.ndarray] = [np.zeros(())] * problem.count
    square, count = 0.0, 0
    pictures, influence = pictures_and_influence(unknowns, problem)
    for group, simulated in zip(problem.groups, pictures, strict=True):
        simulated, weights = np.asarray(simulated), np.asarray(group.weights)
        difference = np.where(weights > 0, simulated - np.asarray(group.targets), 0)
        with np.errstate(over="ignore"):
            square += float(np.sum((difference * weights) ** 2))
        count += int(np.sum(weights > 0))
        for place, image, values in zip(group.places, simulated, difference, strict=True):
            shape = np.shape(targets[place])
            images[place], differences[place] = image.reshape(shape), values.reshape(shape)
    seen = np.asarray(influence) != 0
    std = None
    if uncertainty is not None and result is not Stop.NON_FINITE:
        std = standard_deviations(unknowns, problem, uncertainty, inner_steps)
        if problem.prior is None:
            std = np.where(seen, std, np.inf)
    stats = {
        "steps": len(run.history),
        "accepted": sum(step.accepted for step in run.history),
        "seconds": run.seconds + time.perf_counter() - run.begun,
        "loss": run.best[0],
        "chi2": square / count,
    }
    return Fit(
        heights=problem.basis.base,
        result=result,
        std=std,
        seen=seen,
        albedo=unknowns.albedo,
        exposures=unknowns.exposures,
        offsets=unknowns.offsets,
        images=tuple(images),
        residuals=tuple(differences),
        stats=stats,
        history=tuple(run.history),
    )
