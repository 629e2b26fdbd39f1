"""The order of a fit: step after step through its stages, from coarse to fine."""

import dataclasses
import math
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from ..given import Given, Step, Stop
from ..model.expansion import Expansion, expand
from ..model.problem import LOSS_SCALE, Problem, surface_of
from ..model.unknowns import Unknowns, make_basis
from .noise import Estimate, Restricted, explains_noise, rms, spreads
from .stages import Stage, State, balanced, on_finer, stages, varies_all, why_ended
from .steps import (
    FIRST_DAMPING,
    LAST,
    RELAXED,
    SHORTER,
    Outcome,
    WholeStep,
    advance,
    compile_steps_ahead,
    first_position,
    relaxed,
    whole_step,
)  # fmt: skip

_LEAST_CHANGE = 1.1  # a noise or a robust loss's scale that would change by less than this factor stays
_MOST_WIDTH = 1e3  # times wider or narrower than they were said to be, as errors of an octave may be found
_FEW_HEIGHTS = 2**17  # of 512² steps by factors took as long again as all before, and came no nearer


class Ended(NamedTuple):
    """How a fit ended: where, why, the pictures there, about which all modes of the finest heights are varied, and whether its
    last stage varied all of them."""

    state: State
    stop: Stop
    expansion: Expansion
    varied_all: bool


class _Place(NamedTuple):
    """What belongs to a `State` and follows from it, so that no checkpoint holds it: the expansion at its unknowns, and
    optimistix's state or, where the stage's steps are by factors, the step from there."""

    expansion: Expansion
    position: Any = None
    whole_step: WholeStep | None = None


def run(problems: Sequence[Problem], state: State, given: Given, watch: Callable[[State], None]) -> Ended:
    """From one state to the last one, through problems from coarse to fine; `watch` is called after each step and each change
    of stage."""
    begin, order = time.perf_counter() - state.seconds, stages(problems)
    place = _resumed(problems, state) if state.stage >= 0 else None
    while True:
        stop = None if place is None else why_ended(state, problems, given.max_steps, _ends_by_factors(place.expansion))
        if stop is None and place is not None:
            state, place = _stepped(state, place, order[state.stage], begin)
        else:
            following = None if stop in (Stop.MAX_STEPS, Stop.NON_FINITE) else _next_stage(problems, state, place, given)
            if following is None:
                assert stop is not None
                assert place is not None
                last = _with_all_modes(state, place.expansion, problems, given)
                return Ended(state, stop, last, varies_all(state, problems))
            state, place = following
        watch(state)


def _stepped(state: State, place: _Place, stage: Stage, begin: float) -> tuple[State, _Place]:
    unknowns, place, outcome = (_step_by_factors if stage.by_factors else _step)(state, place)
    loss = float(outcome.loss)
    done = Step(
        step=len(state.history) + 1,
        level=math.ceil(max(state.base.shape) * stage.share),
        loss=loss,
        accepted=bool(outcome.accepted),
        damping=0.0 if stage.by_factors else 1 / float(outcome.step_size),
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
    return state, place


def _step(state: State, place: _Place) -> tuple[Unknowns, _Place, Outcome]:
    here = place.expansion
    there = expand(place.position.y_eval, here.problem) if state.steps else here  # the first evaluates where the stage begins
    unknowns, position, outcome = advance(
        state.unknowns, place.position, there, state.others, state.rejections, state.predicted
    )
    return unknowns, _Place(there if outcome.accepted else here, position), outcome


def _step_by_factors(state: State, place: _Place) -> tuple[Unknowns, _Place, Outcome]:
    here = place.whole_step
    assert here is not None
    expansion = expand(relaxed(state.unknowns, here), place.expansion.problem)
    there = whole_step(expansion)
    if not there.length <= SHORTER * here.length:
        return state.unknowns, place, Outcome(here.loss, False, here.predicted, state.step_size, 0.0)
    predicted = there.predicted if there.length <= LAST * here.length else 0.0
    outcome = Outcome(there.loss, True, predicted, state.step_size, RELAXED * here.length)
    return expansion.unknowns, _Place(expansion, None, there), outcome


def _next_stage(problems: Sequence[Problem], state: State, place: _Place | None, given: Given) -> tuple[State, _Place] | None:
    """Makes the last surface the base, and varies more modes about it, or sharpens the loss and estimates the noise again.

    None where there is no such stage: after the last, and where that would be by factors, but a fit does not end so.
    """
    order = stages(problems)
    if state.stage + 2 >= len(order):
        return _by_factors(problems, state, place)
    stage = order[state.stage + 1]
    repeats = place is not None and stage == order[state.stage]
    if place is not None and stage.level == order[state.stage].level:
        here = place.expansion
    else:
        if place is not None:
            state = on_finer(state, problems, stage.level, given)
        here = expand(state.unknowns, state.posed(problems[stage.level], 1.0), compile_steps_ahead)
    posed, told = here.problem, _estimated(here, state, order, repeats, given)
    edge_samples, units, others = state.edge_samples, state.units, state.others
    if repeats:
        edge_samples = posed.edge_samples_for(here.heights, given.settings)
        same = all(np.array_equal(getattr(told, name), getattr(state, name)) for name in ("noise", "widths", "loss_scale"))
        if same and edge_samples == state.edge_samples:
            return _by_factors(problems, state, place)
        # λ goes on from where it came to, or begins anew where rejections raised it: the loss is another one
        step_size = max(float(state.step_size), 1 / state.steps[0].damping) * float(np.mean((told.noise / state.noise) ** 2))
    else:
        units, curvature, others = balanced(here.of(posed.widened(told.widths / state.widths)).with_noise(told.noise))
        step_size = 1 / (FIRST_DAMPING * curvature)
        if place is not None and posed.albedo is not None:  # what that can undo curves the loss less: λ goes on
            step_size = float(state.step_size)
    begin = state.unknowns.at_base()
    following = dataclasses.replace(
        told,
        unknowns=begin,
        begin=begin,
        base=surface_of(state.unknowns, posed.basis),
        units=units,
        others=others,
        step_size=jnp.asarray(step_size, posed.field.heights.dtype),
        stage=state.stage + 1,
        stage_start=len(state.history),
        edge_samples=edge_samples,
    )
    begun = _begun(problems, following, here)
    return following, _Place(begun, first_position(begun, following.step_size))


def _ends_by_factors(expansion: Expansion) -> bool:
    """Whether there are factors, and points on edges: these alone make the loss so rough that other steps stop short."""
    few = expansion.problem.basis.base.size <= _FEW_HEIGHTS
    return (
        few and expansion.is_linearised and any(known is not None and known.edges is not None for known in expansion.linearised)
    )


def _by_factors(problems: Sequence[Problem], state: State, place: _Place | None) -> tuple[State, _Place] | None:
    """The last stage, about the same base; None after it, and where a fit does not end so."""
    last = len(stages(problems)) - 1
    if state.stage == last or place is None or not _ends_by_factors(place.expansion):
        return None
    state = dataclasses.replace(state, stage=last, stage_start=len(state.history), begin=state.unknowns)
    here = _begun(problems, state, place.expansion)
    step = whole_step(here)
    return dataclasses.replace(state, predicted=step.predicted), _Place(here, whole_step=step)


def _begun(problems: Sequence[Problem], state: State, known: Expansion | None) -> Expansion:
    """The expansion where a stage begins; `known`: one about the same surface, whose pictures are not rendered again."""
    stage = stages(problems)[state.stage]
    posed = state.posed(problems[stage.level], stage.share)
    if known is None or known.problem.settings != posed.settings:
        known = expand(state.begin, posed, compile_steps_ahead)
    return dataclasses.replace(known, problem=posed, unknowns=state.begin).with_noise(state.noise)


def _resumed(problems: Sequence[Problem], state: State) -> _Place:
    here = _begun(problems, state, None)  # whose errors of samples decide on the weights
    if state.steps:
        here = expand(state.unknowns, here.problem)
    if stages(problems)[state.stage].by_factors:
        return _Place(here, whole_step=whole_step(here))
    position = first_position(here, state.step_size)
    if state.steps:
        _, position, _ = advance(state.unknowns, position, here, state.others, 0, 0.0)
    return _Place(here, position)


def _estimated(here: Expansion, state: State, order: Sequence[Stage], repeats: bool, given: Given) -> State:
    """The state with what the next stage takes for the noise of each picture, where none is given, for how heights vary, where
    their prior does not say how its errors hang together, and for the loss's scale; unchanged where it would hardly change.

    They are estimated from what the stage before left (`here`). Unless that one varied the same modes (`repeats`), most of it
    is for shorter modes to explain.
    """
    stage, posed, spread = order[state.stage + 1], here.problem, spreads(here)
    before = Estimate(state.noise, state.widths)
    by_residuals = before.noise if given.noise is not None else np.maximum(spread, posed.least_noise)
    is_open = given.prior is not None and given.prior.length is None and posed.albedo is None
    sought = given.noise is None and explains_noise(posed)
    found = before._replace(noise=by_residuals)
    if stage == order[-2] and (is_open or (sought and repeats)):  # all modes of the finest heights
        found = Restricted(here if sought else here.with_noise(by_residuals)).noise(sought, state.widths)
        widths = np.clip(state.widths * found.widths, 1 / _MOST_WIDTH, _MOST_WIDTH)
        found = found._replace(widths=widths if is_open else state.widths)
    changes = np.abs(np.log(np.concatenate(found) / np.concatenate(before)))
    if stage.share == 1 and changes.max() < math.log(_LEAST_CHANGE):
        found = before
    scale = max(LOSS_SCALE, 3 * rms(spread / found.noise))
    if scale <= _LEAST_CHANGE * LOSS_SCALE or state.stage + 3 == len(order):
        scale = LOSS_SCALE
    return dataclasses.replace(state, **found._asdict(), loss_scale=jnp.asarray(scale, posed.field.heights.dtype))


def _with_all_modes(state: State, here: Expansion, problems: Sequence[Problem], given: Given) -> Expansion:
    """The expansion at the end, with all modes of the finest heights varied about its surface, wherever the fit stopped."""
    finest, units = problems[-1], state.units if varies_all(state, problems) else None
    if stages(problems)[state.stage].level < len(problems) - 1:
        state = on_finer(state, problems, len(problems) - 1, given)
        here = expand(state.unknowns, state.posed(finest, 1.0)).with_noise(state.noise)
    units = balanced(here)[0] if units is None else units
    basis = make_basis(finest.field, np.asarray(surface_of(state.unknowns, here.problem.basis)), units, 1.0, finest.basis.free)
    return dataclasses.replace(here.of(dataclasses.replace(here.problem, basis=basis)), unknowns=state.unknowns.at_base())
