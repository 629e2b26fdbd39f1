"""Why a fit stops, and what it then says of itself: rough terrain, which the derivative describes only nearby."""

import dataclasses
import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
import pytest
from small_fits import EVERYTHING, SETTINGS as SMALL, SIZE, expanded, given as given_with, pictures, posed, scenes

import jaxhf
from jaxhf.fitting.fit import Pace, printed_progress
from jaxhf.fitting.model.expansion import expand
from jaxhf.fitting.model.unknowns import Unknowns
from jaxhf.fitting.solve.stages import first_state, why_ended
from jaxhf.fitting.solve.steps import (
    ConjugateGradients,
    LevenbergMarquardt,
    _arguments,
    advance,
    change_of_loss,
    conjugate_gradients,
    first_position,
)  # fmt: skip

SETTINGS = jaxhf.Settings(shadows=False, samples=1, chunk=256)
# Slopes up to 3, seen from above in one picture of one light; the prior is the terrain smoothed, and says little.
TRUTH = 0.05 * np.random.default_rng(0).standard_normal((16, 16))
PRIOR = np.pad(TRUTH, 1, mode="edge")
PRIOR = (PRIOR[:-2] + 2 * PRIOR[1:-1] + PRIOR[2:]) / 4
PRIOR = (PRIOR[:, :-2] + 2 * PRIOR[:, 1:-1] + PRIOR[:, 2:]) / 4


def scene(heights: np.ndarray) -> jaxhf.Scene:
    camera = jaxhf.Perspective.look_at((0.5, 0.5, 3.0), (0.5, 0.5, 0.0), up=(0, 1, 0), fov=18.0, width=24, height=24)
    return jaxhf.Scene([jaxhf.Object(jaxhf.Heightfield(heights))], camera, [jaxhf.Directional((1, 2, 3))])


def fitted(**options: Any) -> jaxhf.Fit:
    target = np.asarray(jaxhf.render(scene(TRUTH), SETTINGS))
    return jaxhf.fit([scene(PRIOR)], [target], settings=SETTINGS, **{"prior": jaxhf.Prior(PRIOR, 0.2), **options})


def test_what_is_to_come_is_told_by_the_last_steps():
    """The first, which compiles, tells nothing, unless it is said when it began."""
    unknown, known = Pace(), Pace(0.0)
    assert unknown.remaining(60.0, 7) is None
    assert known.remaining(60.0, 7) == 420
    assert unknown.remaining(62.0, 6) == 12
    for end in (63.0, 64.0, 65.0, 66.0, 67.0):
        last = unknown.remaining(end, 3)
    assert last == 3
    assert unknown.remaining(68.0, None) is None


def test_lines_tell_what_is_to_come(capsys):
    tell = printed_progress()
    for k, seconds in ((1, 20.0), (2, 22.0)):
        tell(jaxhf.Step(k, 9, 0.5, k == 1, 0.1, 0.2, seconds, 8))
    first, second = capsys.readouterr().err.splitlines()
    assert first == "step 1: 9 modes a side, loss 0.5, λ 0.1, change 0.2, 20.0 s"
    assert second == "step 2: 9 modes a side, loss 0.5, λ 0.1, change 0.2, 22.0 s, about 16 s to come, not accepted"


@pytest.mark.deep
def test_rejected_steps_are_damped_until_one_is_short_enough():
    """Where the loss is 1e5 standard deviations squared, a damping of 160 still lets steps through that are too long."""
    # Errors of one cell's length: of none the pictures are asked, and then losses before and after do not compare.
    found = fitted(prior=jaxhf.Prior(PRIOR, 0.2, 1 / 15))
    assert found.result is not jaxhf.Stop.MAX_STEPS
    assert sum(step.accepted for step in found.history[1:]) > 3
    assert found.stats["loss"] < 0.3 * found.history[0].loss
    assert max(step.damping for step in found.history if step.accepted) > 160


@pytest.mark.deep
def test_the_loss_is_that_of_the_last_step_where_max_steps_end_a_level():
    steps = fitted(max_steps=20).history
    level = max(k for k, step in enumerate(steps) if step.level == 8) + 1
    assert level < len(steps)
    found = fitted(max_steps=level)
    assert found.result is jaxhf.Stop.MAX_STEPS
    assert len(found.history) == level
    assert math.isfinite(found.stats["loss"])
    assert found.stats["loss"] == min(step.loss for step in found.history)


LAST, BY_FACTORS = 3, 4  # the number of a stage


@pytest.mark.parametrize(
    ("stage", "factors", "steps", "predicted", "stop"),
    [
        (LAST, False, [7.0], 1.0, None),  # which only evaluates
        (LAST, False, [7.0, 5.0], 1.0, None),
        (LAST, False, [7.0, 5.0], 0.1, jaxhf.Stop.CONVERGED),  # a step counts that gains 0.001 for each of 144 heights
        (LAST, False, [7.0, 6.9], 1.0, jaxhf.Stop.CONVERGED),
        (LAST, False, [7.0, 5.0, None], 0.2, None),
        (LAST, False, [7.0, 5.0, None], 0.1, jaxhf.Stop.CONVERGED),
        (LAST, False, [7.0, 5.0, None, None, None], 0.2, None),
        (LAST, False, [7.0, 5.0, None, None], 0.1, jaxhf.Stop.STALLED),  # λ grew until no step counts
        (LAST, True, [7.0, 5.0, None], 0.2, None),
        (LAST, True, [7.0, 5.0, None, None], 0.2, jaxhf.Stop.STALLED),  # whole steps by factors are to come
        (LAST, False, [math.nan], math.nan, jaxhf.Stop.NON_FINITE),
        (LAST, False, [7.0 - 0.4 * k for k in range(15)], 1.0, jaxhf.Stop.MAX_STEPS),
        # Steps by factors end where they are no shorter.
        (BY_FACTORS, True, [], 0.02, jaxhf.Stop.CONVERGED),  # of 144 heights
        (BY_FACTORS, True, [], 1.0, None),
        (BY_FACTORS, True, [5.0, 6.0], 1.0, None),  # a loss may rise
        (BY_FACTORS, True, [5.0, 6.0], 0.02, jaxhf.Stop.CONVERGED),
        (BY_FACTORS, True, [5.0, None], 1.0, jaxhf.Stop.CONVERGED),
        (BY_FACTORS, True, [None], 1.0, jaxhf.Stop.STALLED),
        (BY_FACTORS, True, [5.0] * 10, 1.0, jaxhf.Stop.CONVERGED),
    ],
    ids=str,
)
def test_a_fit_ends_where_no_step_counts_any_more(stage, factors, steps, predicted, stop):
    """Losses of accepted steps, None for those that were rejected."""
    problem, unknowns = posed(scenes(), [np.zeros((SIZE, SIZE))] * 3, given_with(settings=SMALL))
    history, loss = [], 0.0
    for number, given in enumerate(steps, 1):
        loss = loss if given is None else given
        history.append(jaxhf.Step(number, 12, loss, given is not None, 1.0, 0.1, 1.0))
    state = dataclasses.replace(first_state(problem, unknowns), stage=stage, predicted=predicted, history=tuple(history))
    assert why_ended(state, [problem], 15, factors) is stop


def test_rejections_in_a_row_damp_ever_faster():
    """Twice as much as the one before; and the step that is accepted after them leaves λ as it is."""
    searches = [LevenbergMarquardt(rejections, None).search for rejections in range(4)]
    np.testing.assert_allclose([search.low_constant for search in searches], 0.25 / 2.0 ** np.arange(4))
    np.testing.assert_allclose([search.high_constant for search in searches], [4, 1, 1, 1])


def test_a_step_is_judged_by_what_was_predicted_of_it():
    """As optimistix predicts it, which multiplies by the derivative once more; step after step, whether it was accepted."""
    here = expanded(scenes(), pictures(), unknown=EVERYTHING, settings=SMALL, noise=0.01)
    others, step_size = jax.tree.map(jnp.ones_like, here.unknowns.without_modes()), jnp.asarray(10.0)
    position: Any = first_position(here, step_size)
    unknowns, predicted, rejections, accepted = here.unknowns, 0.0, 0, []
    for number in range(8):
        there = expand(position.y_eval, here.problem) if number else here
        unknowns, position, outcome = advance(unknowns, position, there, others, rejections, predicted)
        step = jax.tree.map(lambda to, at: to - at, position.y_eval, unknowns)
        expected = eqx.filter_jit(optx.ClassicalTrustRegion().predict_reduction)(step, position.f_info)
        predicted, rejections = float(outcome.predicted), 0 if outcome.accepted else rejections + 1
        assert predicted == pytest.approx(-float(expected), rel=0.02)  # in single precision
        (solver, *_), _ = _arguments(unknowns, position, there, others, rejections, predicted)
        assert float(solver.search.predict_reduction(step, position.f_info)) == -predicted
        accepted.append(bool(outcome.accepted))
    assert accepted[0]
    assert set(accepted[1:]) == {True, False}


def test_a_step_is_taken_at_any_damping():
    """Also where 1 / λ is below the precision's epsilon, as it is for many pixels with little noise in single precision.

    By how much it is to change the loss follows from its equation alone."""
    matrix, right = 1e9 * np.random.default_rng(0).standard_normal((6, 3)), np.ones(6)
    start = Unknowns(jnp.zeros((1, 3)))
    value, linear = jax.linearize(lambda u: jnp.asarray(matrix, jnp.float32) @ u.coefficients[0] - jnp.ones(6), start)
    jacobian = lx.FunctionLinearOperator(linear, jax.eval_shape(lambda: start))
    descent = ConjugateGradients(1e-4, 60, start.without_modes())
    state = descent.query(start, optx.FunctionInfo.ResidualJac(value, jacobian), None)
    for damping in (1e3, 1e17):
        expected = np.linalg.solve(matrix.T @ matrix + damping * np.eye(3), matrix.T @ right)
        found, _ = descent.step(jnp.asarray(1 / damping), state)
        np.testing.assert_allclose(found.coefficients[0], expected, rtol=0.01)
        left = matrix @ expected - right
        told = change_of_loss(found, state[1], jnp.asarray(1 / damping))
        np.testing.assert_allclose(told, (left @ left - right @ right) / 2, rtol=0.01)


@pytest.mark.parametrize(("tolerance", "most"), [(0.3, 60), (1e-2, 60), (1e-5, 60), (1e-5, 4)])
def test_a_linear_problem_is_solved_as_far_as_asked(tolerance, most):
    """As JAX's own conjugate gradients take it, which stop as early; and what such a step is to change is told as well."""
    rng = np.random.default_rng(3)
    jacobian, residual, damping = rng.standard_normal((40, 20)), rng.standard_normal(40), 3.0
    matrix = jnp.asarray(jacobian.T @ jacobian + damping * np.eye(20), jnp.float32)
    gradient, scales = jnp.asarray(jacobian.T @ residual, jnp.float32), jnp.linspace(0.5, 2, 20)

    def inverse(x: jax.Array) -> jax.Array:
        return x / scales

    found = conjugate_gradients(lambda x: matrix @ x, -gradient, inverse, jnp.float32(tolerance), jnp.int32(most))
    expected, _ = jax.scipy.sparse.linalg.cg(lambda x: matrix @ x, -gradient, tol=tolerance, maxiter=most, M=inverse)
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-7)
    left = residual + jacobian @ np.asarray(found, np.float64)
    told = change_of_loss(found, gradient, jnp.float32(1 / damping))
    np.testing.assert_allclose(told, (left @ left - residual @ residual) / 2, rtol=1e-5)
