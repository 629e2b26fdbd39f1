"""Where a fit stands, and the stages that it goes through: which heights and which modes are varied, one after the other, in
which units, and when each has done its part."""

import dataclasses
import itertools
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...io.checkpoint import digest, load_arrays, load_facts_of, save_checkpoint
from ..given import Given, Step, Stop
from ..model.expansion import Expansion
from ..model.problem import LOSS_SCALE, Problem, surface_of
from ..model.terms import OCTAVES
from ..model.unknowns import Unknowns, make_basis, pad, resample, slope_units

_REJECTIONS = 2  # in a row, at a coarse stage: the next one may do better
_FLAT_GAIN = 1e-3  # for each height: then heights change by 0.05 of the deviation that their noise leaves them with
_FIELD_GAIN = 1e-4  # the same beside an `AlbedoField`, which leaves pictures little to say: sun and sky are still 8 degrees off
_LEFT_GAIN = 2e-4  # the same at the end, where steps are whole ones: by 0.02 of it
_COARSE_GAIN = 0.02  # of the loss, where another stage follows
_COARSE_STEPS = 8  # at most, where another stage follows: what is left there is mostly for shorter modes to explain
_USUAL_STEPS, _USUAL_COARSE_STEPS, _USUAL_BY_FACTORS = 5, 4, 2  # of a stage, for what progress says is to come
_LAST_STAGES = 3  # at most, over which the scale of the robust loss comes down to its own, and the noise is estimated
_MOST_BY_FACTORS = 10  # steps; one to four are usual
_COARSEST = 8  # modes a side
# As a share of the median: along a mode of less curvature the loss counts as flat, and its unit stays as it is.
_LEAST_CURVATURE = 1e-6


@dataclasses.dataclass(frozen=True)
class State:
    """Immutable; a step makes another one.

    Attributes:
      unknowns: those that were accepted last, about `base`.
      begin: those at which the present stage began, with coefficients 0.
      base: the surface there, shape (my, mx).
      units: of the modes, see `Basis.scale`, shape (my, mx).
      others: the curvature along the other unknowns, see `balanced`.
      noise, loss_scale: see `Problem`.
      widths: how many times wider than their prior heights vary, see `Estimate`; 1 where that is not estimated.
      step_size: 1 / λ of the next step.
      stage: the number of the stage, from 0; -1: none has begun.
      stage_start: steps taken before it.
      edge_samples: points on edges.
      loss: at `unknowns`.
      predicted: by how much the next step is to lower it, see `Outcome`.
      seconds: since the fit began, a resumed one goes on counting.
      history: a `Step` for each step.
    """

    unknowns: Unknowns
    begin: Unknowns
    base: Float[Array, "my mx"]
    units: Float[np.ndarray, "my mx"]
    others: Any
    noise: Float[np.ndarray, " pictures"]
    widths: Float[np.ndarray, " octaves"]
    loss_scale: Float[Array, ""]
    step_size: Float[Array, ""]
    stage: int = -1
    stage_start: int = 0
    edge_samples: int = 0
    loss: float = float("inf")
    predicted: float = 0.0
    seconds: float = 0.0
    history: tuple[Step, ...] = ()

    @property
    def steps(self) -> tuple[Step, ...]:
        """Those of the present stage."""
        return self.history[self.stage_start :]

    @property
    def rejections(self) -> int:
        """How many of them were rejected since the last accepted one."""
        return len(list(itertools.takewhile(lambda step: not step.accepted, reversed(self.steps))))

    def posed(self, problem: Problem, share: float) -> Problem:
        """The problem of this stage, which varies such a share of the modes, but for the noise."""
        basis = make_basis(problem.field, np.asarray(self.base), self.units, share, problem.basis.free)
        problem = dataclasses.replace(problem.widened(self.widths), basis=basis, loss_scale=self.loss_scale)
        return problem.with_edge_samples(self.edge_samples)


_ARRAYS = ("unknowns", "begin", "base", "units", "others", "noise", "widths", "loss_scale", "step_size")


def first_state(problem: Problem, unknowns: Unknowns) -> State:
    """Before the first stage."""
    dtype = problem.field.heights.dtype
    return State(
        unknowns,
        unknowns,
        problem.basis.base,
        np.asarray(problem.basis.scale, np.float64),
        jax.tree.map(np.ones_like, unknowns.without_modes()),
        problem.noise,
        np.ones(OCTAVES),
        problem.loss_scale,
        jnp.ones((), dtype),
        edge_samples=problem.settings.edge_samples or 0,
    )


def save_state(path: Path, state: State, fingerprint: str) -> None:
    facts = {field.name: getattr(state, field.name) for field in dataclasses.fields(state) if field.name not in _ARRAYS}
    arrays = [getattr(state, name) for name in _ARRAYS]
    facts |= {"fingerprint": fingerprint, "shapes": [leaf.shape for leaf in jax.tree.leaves(arrays)]}
    save_checkpoint(path, facts, arrays)


def load_state(path: Path, like: State, fingerprint: str) -> State:
    """The state of a checkpoint; FileError where it is another fit's. `like`: the state before the first stage."""
    facts = load_facts_of(path, fingerprint)
    leaves, structure = jax.tree.flatten([getattr(like, name) for name in _ARRAYS])
    shapes = zip(facts.pop("shapes"), leaves, strict=True)  # those of a finer level may be others
    blank = [(jnp if isinstance(leaf, jax.Array) else np).zeros(shape, leaf.dtype) for shape, leaf in shapes]
    arrays = dict(zip(_ARRAYS, load_arrays(path, jax.tree.unflatten(structure, blank)), strict=True))
    facts["history"] = tuple(Step(*line) for line in facts["history"])
    return State(**arrays, **facts)


def fingerprint(problem: Problem, unknowns: Unknowns, given: Given) -> str:
    """A hash of all that decides on the steps: fits of the same fingerprint take the same ones, in whatever process.

    The structure of the problem and the unknowns at the start says of what classes and sizes all parts are, and how many
    samples a scene asks for. The mesh does not count: another machine may go on.
    """
    parts = {field.name: getattr(problem, field.name) for field in dataclasses.fields(problem) if field.name != "mesh"}
    settings = parts.pop("settings")
    leaves, structure = jax.tree.flatten((parts, unknowns))
    # What is left open is chosen anew on the way, also where it begins with what another fit is given.
    choices = (settings, structure, given.noise is None, given.settings.edge_samples is None)
    return digest(choices, leaves)


class Stage(NamedTuple):
    """Which of the problems, from coarse to fine, and up to what share of its highest frequency modes are varied; whether its
    steps are those by factors, see `steps`."""

    level: int
    share: float
    by_factors: bool = False


def stages(problems: Sequence[Problem]) -> list[Stage]:
    """From 8 modes a side on, twice as many each time, through coarse and then fine heights; then all once more while the loss
    is sharpened and the noise estimated; and in the end by factors."""
    order, modes = [], _COARSEST
    for level, problem in enumerate(problems):
        most = max(problem.field.heights.shape)
        doublings = max(0, math.floor(math.log2(most / modes)))
        order += [Stage(level, 0.5**k) for k in range(doublings, -1, -1)]
        modes = 2 * most
    last = Stage(len(problems) - 1, 1.0)
    return [*order, *[last] * _LAST_STAGES, last._replace(by_factors=True)]


def varies_all(state: State, problems: Sequence[Problem]) -> bool:
    """Whether all modes of the finest heights are varied."""
    return stages(problems)[state.stage][:2] == (len(problems) - 1, 1.0)


def steps_to_come(state: State, problems: Sequence[Problem], given: Given) -> int:
    """About how many: as many as stages take as a rule."""
    most, done = given.max_steps - len(state.history), len(state.steps)
    usual, *later = [
        _USUAL_BY_FACTORS if stage.by_factors else _USUAL_STEPS if stage.share == 1 else _USUAL_COARSE_STEPS
        for stage in stages(problems)[state.stage :]
    ]
    return min(most, max(usual - done, 1 + done // 3) + sum(later))


def on_finer(state: State, problems: Sequence[Problem], level: int, given: Given) -> State:
    """The state on the heights of a finer level: those of its own start, and what was found on the coarser one's."""
    stage, fine = stages(problems)[state.stage], problems[level]
    coarse = problems[stage.level]
    there = surface_of(state.unknowns, state.posed(coarse, stage.share).basis)
    change = coarse.basis.crop(np.asarray(there, np.float64) - np.asarray(coarse.basis.base, np.float64))
    shape, dtype = fine.field.heights.shape, fine.field.heights.dtype
    free = 1.0 if fine.basis.free is None else np.asarray(fine.basis.free, np.float64)
    base = np.asarray(fine.basis.base, np.float64) + free * pad(resample(change, shape), fine.basis.padding)
    unknowns = state.unknowns.with_modes(jnp.zeros_like(fine.basis.base))
    factors = coarse.factors(unknowns)
    if factors is not None and factors.shape != fine.albedo_shape:  # one factor for each vertex
        channels = np.moveaxis(np.asarray(factors, np.float64), -1, 0)
        finer = np.stack([resample(channel, shape) for channel in channels], -1)
        finer = jnp.asarray(finer, dtype)
        finer = finer if fine.albedo is None else fine.albedo.modes(finer)
        unknowns = eqx.tree_at(lambda u: u.albedo, unknowns, finer)
    return dataclasses.replace(
        state,
        unknowns=unknowns,
        begin=unknowns,
        base=jnp.asarray(base, dtype),
        units=slope_units(base.shape, fine.field.dx, fine.field.dy)[0],
        edge_samples=fine.edge_samples_for(jnp.asarray(fine.basis.crop(base), dtype), given.settings),
    )


def why_ended(state: State, problems: Sequence[Problem], max_steps: int, has_factors: bool) -> Stop | None:
    """Why the present stage is over, or None; one that another follows ends sooner.

    `has_factors`: whether the last stage is not left out.
    """
    steps, order = state.steps, stages(problems)
    if order[state.stage].by_factors:
        return _why_factors_ended(state, problems, max_steps)
    if not steps:
        return None if len(state.history) < max_steps else Stop.MAX_STEPS
    loss, rejections = steps[-1].loss, state.rejections
    if not math.isfinite(loss):
        return Stop.NON_FINITE
    sharp = float(state.loss_scale) == LOSS_SCALE
    fine = varies_all(state, problems) and (sharp or state.stage + 2 == len(order))
    flat = _FLAT_GAIN if problems[-1].albedo is None else _FIELD_GAIN
    enough = flat * problems[-1].field.heights.size if fine else _COARSE_GAIN * loss
    if len(steps) > 1 and _is_flat(state, enough):  # the first only evaluates where the stage begins
        return Stop.CONVERGED
    # Damping that grows with each rejection leaves less and less to be gained, until that would not count.
    if rejections and (not state.predicted >= enough or (rejections >= _REJECTIONS and (has_factors or not fine))):
        return Stop.CONVERGED if rejections == 1 else Stop.STALLED
    if not fine and len(steps) > _COARSE_STEPS:
        return Stop.CONVERGED
    return Stop.MAX_STEPS if len(state.history) >= max_steps else None


def _why_factors_ended(state: State, problems: Sequence[Problem], max_steps: int) -> Stop | None:
    steps = state.steps
    if state.predicted < _LEFT_GAIN * problems[-1].field.heights.size or len(steps) == _MOST_BY_FACTORS:
        return Stop.CONVERGED
    if steps and not steps[-1].accepted:
        return Stop.CONVERGED if len(steps) > 1 else Stop.STALLED
    return Stop.MAX_STEPS if len(state.history) >= max_steps else None


def _is_flat(state: State, enough: float) -> bool:
    """Whether accepted steps hardly lower the loss any more."""
    if state.rejections:
        return False
    gains = [a.loss - b.loss for a, b in itertools.pairwise(state.steps) if b.accepted]
    return not state.predicted >= enough or bool(gains and abs(gains[-1]) < enough)


def balanced(expansion: Expansion) -> tuple[Float[np.ndarray, "my mx"], float, Any]:
    """The units of the modes, see `Basis.scale`, in which the loss has the same curvature along each of them, that curvature,
    and by how much more it is curved along each number of the other unknowns: a tree as these."""
    problem, unknowns = expansion.problem, expansion.unknowns
    slopes, _ = slope_units(problem.basis.base.shape, problem.field.dx, problem.field.dy)
    gradients, of_others = expansion.random_gradients()
    modes, curvature = _balanced_units(slopes, mode_curvature(problem, gradients))
    others = []
    for (term, values), *draws in zip(problem.terms.others(unknowns), *map(jax.tree.leaves, of_others), strict=True):
        # Of one kind and one place in each picture, as its light's first angle, or of all texels: few draws tell little more.
        squares = np.mean(np.square(draws, dtype=np.float64), axis=0)
        along = tuple(range(squares.ndim)) if squares.ndim != 2 else 0
        total = np.broadcast_to(squares.mean(axis=along, keepdims=True), squares.shape)
        total = total + np.asarray(term.weight, np.float64) ** 2
        others.append(np.asarray(np.maximum(total / curvature, _LEAST_CURVATURE), values.dtype))
    return modes, curvature, jax.tree.unflatten(jax.tree.structure(unknowns.without_modes()), others)


def _balanced_units(
    units: Float[np.ndarray, "my mx"], curvature: Float[np.ndarray, "my mx"]
) -> tuple[Float[np.ndarray, "my mx"], float]:
    """Units of the modes in which the loss has the same curvature along each of them, and that curvature.

    It is the median of those in units of one slope. Along the mean of all heights, which pictures hardly show, the curvature in
    units of one slope is ten thousand times less than along other modes. `units`: `slope_units`; `curvature`: of the loss, for
    modes of unit height, 0 where it is unknown.
    """
    per_slope = curvature * units**2
    if not (per_slope > 0).any():
        return units, 1.0
    typical = float(np.median(per_slope[per_slope > 0]))
    relative = per_slope / typical
    return units / np.sqrt(np.where(relative > _LEAST_CURVATURE, relative, 1)), typical


def mode_curvature(problem: Problem, gradients: Float[np.ndarray, "k ny nx"]) -> Float[np.ndarray, "my mx"]:
    """The curvature of the loss along each DCT mode of unit height.

    That of the pictures, the diagonal of JᵀJ, is the mean square of the `random_gradients` Jᵀz over draws of z, and over
    neighbouring modes; in that of the prior, weights count by their mean square.
    """
    basis, term = problem.basis, problem.terms.surface
    rows, columns = np.asarray(basis.rows, np.float64), np.asarray(basis.columns, np.float64)
    padding = [(n, n) for n in basis.padding]
    squares = np.mean([(rows @ np.pad(gradient, padding) @ columns.T) ** 2 for gradient in gradients], axis=0)
    curvature = _over_neighbours(squares)
    curvature[0, 0] = squares[0, 0]  # unlike any other
    weight = float(np.mean(np.square(np.asarray(term.weight, np.float64))))
    return curvature + weight * np.asarray(term.spectrum, np.float64) ** 2


def _over_neighbours(values: Float[np.ndarray, "my mx"]) -> Float[np.ndarray, "my mx"]:
    """The mean over 3 x 3 values, without [0, 0] but in its own."""
    padded = np.pad(values, 1, mode="reflect")
    padded[1, 1] = np.mean([values[0, 1], values[1, 0]])
    ny, nx = values.shape
    return np.mean([padded[y : y + ny, x : x + nx] for y in range(3) for x in range(3)], axis=0)
