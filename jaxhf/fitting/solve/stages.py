"""The stages of a fit: which heights and which modes are varied, one after the other, and when each has done its part."""

import dataclasses
import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from ..given import Given, Stop
from ..model.expansion import surface_of
from ..model.problem import LOSS_SCALE, Problem
from ..model.surface import pad, resample, slope_units
from .state import State

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
