"""The order of a fit: step after step through its stages, from coarse to fine."""

import dataclasses
import math
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..given import Given
from ..history import Step, Stop
from ..model.expansion import Expansion, expand, place_of, surface_of
from ..model.problem import LOSS_SCALE, Problem
from ..model.rows import has_rows
from ..model.surface import Unknowns, make_basis
from ..model.units import balanced
from .newton import RELAXED, SHORTER, WholeStep, relaxed, whole_step
from .noise import Estimate, Restricted, explains_noise, spreads, widened
from .stages import on_finer, stages, varies_all, why_ended
from .state import State
from .steps import FIRST_DAMPING, Outcome, advance, first_position, position_at

_LEAST_CHANGE = 1.1  # a noise or a robust loss's scale that would change by less than this factor stays
_MOST_WIDTH = 1e3  # times wider or narrower than they were said to be, as errors of an octave may be found
_TOLERANCE = 0.1  # of a step's linear problem: solved to 0.01 steps took twice as long, and fits came no nearer
_ITERATIONS = 120  # of conjugate gradients
_FEW_HEIGHTS = 2**17  # of 512² steps by factors took as long again as all before, and came no nearer


class Ended(NamedTuple):
    """How a fit ended: where, why, and the pictures there."""

    state: State
    stop: Stop
    expansion: Expansion


class _Place(NamedTuple):
    """What belongs to a `State` and follows from it, so that no checkpoint holds it.

    Attributes:
      problem: of its stage.
      share: of the modes that this varies.
      expansion: at its unknowns.
      position: optimistix's state; None where the stage's steps are by factors.
      first: that from which it is made anew, see `first_position`.
      whole_step: from the expansion, where the stage's steps are by factors.
    """

    problem: Problem
    share: float
    expansion: Expansion
    position: Any
    first: Any
    whole_step: WholeStep | None = None


def run(problems: Sequence[Problem], state: State, given: Given, watch: Callable[[State], None]) -> Ended:
    """From one state to the last one, through problems from coarse to fine; `watch` is called after each step and each change
    of stage."""
    begin = time.perf_counter() - state.seconds
    place = _resumed(problems, state) if state.stage >= 0 else None
    while True:
        stop = None if place is None else why_ended(state, problems, given.max_steps, _ends_by_factors(place.expansion))
        if stop is None and place is not None:
            step = _step_by_factors if stages(problems)[state.stage].by_factors else _step
            state, place = step(state, place, begin)
        else:
            following = None if stop in (Stop.MAX_STEPS, Stop.NON_FINITE) else _next_stage(problems, state, place, given)
            if following is None:
                assert stop is not None
                assert place is not None
                return Ended(state, stop, place.expansion)
            state, place = following
        watch(state)


def _step(state: State, place: _Place, begin: float) -> tuple[State, _Place]:
    there, problem = place.position.y_eval, place.problem
    expansion = _known(there, problem, place.expansion)
    unknowns, position, outcome = _advanced(state, place.position, expansion, state.rejections)
    accepted, loss = bool(outcome.accepted), float(outcome.loss)
    done = Step(
        step=len(state.history) + 1,
        level=math.ceil(max(problem.basis.base.shape) * place.share),
        loss=loss,
        accepted=accepted,
        damping=1 / float(outcome.step_size),
        change=float(outcome.change),
        seconds=time.perf_counter() - begin,
    )
    state = dataclasses.replace(
        state,
        unknowns=unknowns,
        step_size=outcome.step_size,
        loss=loss if math.isfinite(loss) else state.loss,
        predicted=float(outcome.predicted),
        seconds=done.seconds,
        history=(*state.history, done),
    )
    return state, place._replace(position=position, expansion=expansion if accepted else place.expansion)


def _step_by_factors(state: State, place: _Place, begin: float) -> tuple[State, _Place]:
    here = place.whole_step
    assert here is not None
    unknowns = relaxed(state.unknowns, here)
    expansion = expand(unknowns, place.problem)
    there = whole_step(expansion)
    accepted = there.length <= SHORTER * here.length
    if accepted:
        state, place = dataclasses.replace(state, unknowns=unknowns), place._replace(expansion=expansion, whole_step=there)
    kept = there if accepted else here
    done = Step(
        step=len(state.history) + 1,
        level=max(place.problem.basis.base.shape),
        loss=kept.loss,
        accepted=accepted,
        damping=0.0,
        change=RELAXED * here.length if accepted else 0.0,
        seconds=time.perf_counter() - begin,
    )
    history = (*state.history, done)
    state = dataclasses.replace(state, loss=kept.loss, predicted=kept.predicted, seconds=done.seconds, history=history)
    return state, place


def _advanced(state: State, position: Any, expansion: Expansion, rejections: int) -> tuple[Unknowns, Any, Outcome]:
    return advance(state.unknowns, position, expansion, state.others, rejections, _TOLERANCE, _ITERATIONS)


def _known(unknowns: Any, problem: Problem, expansion: Expansion | None) -> Expansion:
    """The expansion at these unknowns: the given one, if it is that of the same heights, so that none is rendered twice."""
    if expansion is not None and expansion.problem.settings == problem.settings:
        here, there = place_of(unknowns, problem), place_of(expansion.unknowns, expansion.problem)
        if all(map(np.array_equal, here, there)):
            return dataclasses.replace(expansion, problem=problem, unknowns=unknowns)
    return expand(unknowns, problem)


def _next_stage(problems: Sequence[Problem], state: State, place: _Place | None, given: Given) -> tuple[State, _Place] | None:
    """Makes the last surface the base, and varies more modes about it, or sharpens the loss and estimates the noise again.

    None where there is no such stage: after the last, and where that would be by factors, but a fit does not end so.
    """
    order = stages(problems)
    if state.stage + 2 >= len(order):
        return _by_factors(problems, state, place)
    stage, before = order[state.stage + 1], None if state.stage < 0 else order[state.stage]
    repeats = stage == before
    if place is not None and before is not None and before.level == stage.level:
        here, first = place.expansion, place.first
    else:
        if place is not None:
            state = on_finer(state, problems, stage.level, given)
        here, first = expand(state.unknowns, state.posed(problems[stage.level], 1.0)), None
    posed = here.problem
    spread = spreads(here)
    noise, widths = _estimated(here, spread, state, stage.share, stage == order[-2], repeats, given)
    scale = max(LOSS_SCALE, 3 * _rms(spread / noise))
    if scale <= _LEAST_CHANGE * LOSS_SCALE or state.stage + 3 == len(order):
        scale = LOSS_SCALE
    edge_samples = state.edge_samples
    if repeats:
        edge_samples = posed.edge_samples_for(here.heights, given.settings)
        same = np.array_equal(noise, state.noise) and np.array_equal(widths, state.widths) and scale == float(state.loss_scale)
        if same and edge_samples == state.edge_samples:
            return _by_factors(problems, state, place)
    dtype, units, others = posed.field.heights.dtype, state.units, state.others
    if repeats:  # λ goes on from where it came to, or begins anew where rejections raised it: the loss is another one
        step_size = max(float(state.step_size), 1 / state.steps[0].damping) * float(np.mean((noise / state.noise) ** 2))
    else:
        units, curvature, others = balanced(here.of(widened(posed.with_noise(noise, here.sampling), widths / state.widths)))
        step_size = 1 / (FIRST_DAMPING * curvature)
    begin = state.unknowns.at_base()
    following = dataclasses.replace(
        state,
        unknowns=begin,
        begin=begin,
        base=surface_of(state.unknowns, posed.basis),
        units=units,
        others=others,
        noise=noise,
        widths=widths,
        loss_scale=jnp.asarray(scale, dtype),
        step_size=jnp.asarray(step_size, dtype),
        stage=state.stage + 1,
        stage_start=len(state.history),
        edge_samples=edge_samples,
    )
    return following, _placed(problems, following, here, first)


def _ends_by_factors(expansion: Expansion) -> bool:
    """Whether there are factors, and points on edges: these alone make the loss so rough that other steps stop short."""
    few = expansion.problem.basis.base.size <= _FEW_HEIGHTS
    return few and has_rows(expansion) and any(known is not None and known.edges is not None for known in expansion.linearised)


def _by_factors(problems: Sequence[Problem], state: State, place: _Place | None) -> tuple[State, _Place] | None:
    """The last stage, about the same base; None after it, and where a fit does not end so."""
    last = len(stages(problems)) - 1
    if state.stage == last or place is None or not _ends_by_factors(place.expansion):
        return None
    state = dataclasses.replace(state, stage=last, stage_start=len(state.history), begin=state.unknowns)
    place = _placed(problems, state, place.expansion, place.first)
    step = whole_step(place.expansion)
    return dataclasses.replace(state, predicted=step.predicted), place._replace(whole_step=step)


def _placed(problems: Sequence[Problem], state: State, expansion: Expansion | None, first: Any) -> _Place:
    """Where a stage begins."""
    stage = stages(problems)[state.stage]
    posed = state.posed(problems[stage.level], stage.share)
    here = _known(state.begin, posed, expansion)
    if expansion is not None and expansion.problem.settings != posed.settings:
        first = None
    here = here.of(posed.with_noise(state.noise, here.sampling))
    if stage.by_factors:
        return _Place(here.problem, stage.share, here, None, None)
    first = first_position(here) if first is None else first
    return _Place(here.problem, stage.share, here, position_at(first, state.begin, state.step_size), first)


def _resumed(problems: Sequence[Problem], state: State) -> _Place:
    place = _placed(problems, state, None, None)
    here = _known(state.unknowns, place.problem, place.expansion)
    if stages(problems)[state.stage].by_factors:
        return place._replace(expansion=here, whole_step=whole_step(here))
    position = position_at(place.first, state.unknowns, state.step_size)
    if state.steps:
        _, position, _ = _advanced(state, position, here, 0)
    return place._replace(expansion=here, position=position)


def _estimated(
    here: Expansion, spread: np.ndarray, state: State, share: float, last: bool, repeats: bool, given: Given
) -> Estimate:
    """The noise of each picture, where none is given, and how heights vary, where their prior does not say how its errors hang
    together; unchanged where they would hardly change.

    Args:
      here: where the stage before ended.
      spread: of each picture's residuals, radiance.
      state: with what they were taken for.
      share: of the modes that the stage to come varies.
      last: whether these are all, of the finest heights.
      repeats: whether they were varied before; if not, what is left is mostly for shorter ones to explain.
      given: for what is given.
    """
    before, posed = Estimate(state.noise, state.widths), here.problem
    by_residuals = before.noise if given.noise is not None else np.maximum(spread, posed.least_noise)
    is_open = given.prior is not None and given.prior.length is None
    sought = given.noise is None and explains_noise(posed)
    found = before._replace(noise=by_residuals)
    if last and (is_open or (sought and repeats)):
        found = Restricted(here if sought else here.of(posed.with_noise(by_residuals, here.sampling))).noise(sought)
        widths = np.clip(state.widths * found.widths, 1 / _MOST_WIDTH, _MOST_WIDTH)
        found = found._replace(widths=widths if is_open else state.widths)
    changes = np.abs(np.log(np.concatenate(found) / np.concatenate(before)))
    return before if share == 1 and changes.max() < math.log(_LEAST_CHANGE) else found


def with_all_modes(ended: Ended, problems: Sequence[Problem], given: Given) -> Expansion:
    """The expansion at the end, with all modes of the finest heights varied about its surface, wherever the fit stopped."""
    state, here, finest = ended.state, ended.expansion, problems[-1]
    units = state.units if varies_all(state, problems) else None
    if stages(problems)[state.stage].level < len(problems) - 1:
        state = on_finer(state, problems, len(problems) - 1, given)
        posed = state.posed(finest, 1.0)
        here = expand(state.unknowns, posed)
        here = here.of(posed.with_noise(state.noise, here.sampling))
    units = balanced(here).modes if units is None else units
    basis = make_basis(finest.field, np.asarray(surface_of(state.unknowns, here.problem.basis)), units, 1.0, finest.basis.free)
    return dataclasses.replace(here.of(dataclasses.replace(here.problem, basis=basis)), unknowns=state.unknowns.at_base())


def _rms(values: Float[np.ndarray, " n"]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
