"""Gauss-Newton steps by factors: each against a dense solution, and how they go on and end."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_fits import EVERYTHING, SETTINGS, TRUTH, dense, edges_in, expanded, pictures, rms, scenes

import jaxhf
from jaxhf.fitting.model.expansion import prior_residuals
from jaxhf.fitting.model.normal_matrix import in_row
from jaxhf.fitting.solve import run as _run
from jaxhf.fitting.solve.stages import Stage, first_state
from jaxhf.fitting.solve.steps import WholeStep, relaxed, whole_step

HELD = np.where(np.indices(TRUTH.shape).sum(0) % 5 == 0, 0.0, 0.05)


def test_a_whole_step_solves_the_linear_problem():
    """Of all unknowns, with the weights of the robust loss; heights that are held stay."""
    measured = [picture.copy() for picture in pictures()]
    measured[0][3:9] += 0.02
    prior = jaxhf.Prior(TRUTH, HELD, 0.2)
    here = expanded(scenes(TRUTH + 0.03), measured, prior=prior, unknown=EVERYTHING, settings=SETTINGS, noise=0.01)
    step, left, basis = whole_step(here), in_row(here.left()), here.problem.basis
    roots = 1 / (1 + (left / 3) ** 2)
    by_pictures, by_priors, free = dense(here, roots)
    off = np.concatenate([np.ravel(part) for part in prior_residuals(here.unknowns, here.problem)])
    gradient, matrix = by_pictures.T @ (roots * left) + by_priors.T @ off, by_pictures.T @ by_pictures + by_priors.T @ by_priors
    expected = np.zeros(free.size)
    expected[free] = -np.linalg.solve(matrix[np.ix_(free, free)], gradient[free])
    moved = np.ravel(basis.surface(step.change.coefficients) - basis.base)
    others = np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(step.change.without_modes())])
    count = moved.size
    np.testing.assert_allclose(moved, expected[:count], atol=5e-3 * rms(expected[:count]))
    np.testing.assert_allclose(others, expected[count:], atol=5e-3 * np.abs(expected[count:]).max())
    assert not moved[~free[:count]].any()
    assert step.length == pytest.approx(rms(basis.crop(expected[:count].reshape(basis.base.shape))), rel=5e-3)
    assert step.predicted == pytest.approx(-gradient @ expected / 2, rel=5e-3)
    assert step.loss == pytest.approx((roots @ left**2 + off @ off) / 2, rel=1e-5)  # by Geman and McClure
    there = relaxed(here.unknowns, step)
    np.testing.assert_allclose(there.coefficients, 0.75 * step.change.coefficients, atol=1e-6)


@pytest.mark.parametrize(
    ("lengths", "accepted", "goes_on"),
    [
        ((1.0, 0.5, 0.46), [True, False], [True, True]),
        ((1.0, 2.0), [False], [True]),
        ((1.0, np.nan), [False], [True]),
        ((1.0, 0.7), [True], [False]),
    ],
)
def test_a_step_counts_where_the_next_is_shorter(lengths, accepted, goes_on, monkeypatch):
    """Whatever becomes of the loss: else all stays as it was. Where it is hardly shorter, nothing is left to be gained."""
    here = expanded(scenes(), pictures(), settings=SETTINGS, noise=0.01)
    ones = jax.tree.map(jnp.ones_like, here.unknowns)
    steps = [WholeStep(ones, length, 10 * length, 7.0 + number) for number, length in enumerate(lengths)]
    state = dataclasses.replace(first_state(here.problem, here.unknowns), stage=4)
    place: Any = _run._Place(here, None, steps[0])
    monkeypatch.setattr(_run, "expand", lambda unknowns, problem: dataclasses.replace(here, unknowns=unknowns))
    for number, (taken, more) in enumerate(zip(accepted, goes_on, strict=True), 1):
        monkeypatch.setattr(_run, "whole_step", lambda _, number=number: steps[number])
        before, there = state.unknowns, place.expansion
        state, place = _run._stepped(state, place, Stage(0, 1.0, by_factors=True), 0.0)
        kept = steps[number if taken else number - 1]
        assert (state.history[-1].accepted, state.history[-1].step) == (taken, number)
        assert (state.loss, state.predicted, place.whole_step) == (kept.loss, kept.predicted if more else 0, kept)
        assert state.history[-1].change == (0.75 * lengths[number - 1] if taken else 0)
        assert (place.expansion is there) != taken
        np.testing.assert_allclose(state.unknowns.coefficients, before.coefficients + (0.75 if taken else 0))


def test_fits_of_few_heights_with_points_on_edges_end_so(monkeypatch):
    here = expanded(scenes(), pictures(), settings=SETTINGS, noise=0.01)
    assert not _run._ends_by_factors(here)
    (known,), one = here.linearised, np.zeros((3, 1))
    assert known is not None
    here = dataclasses.replace(here, linearised=(dataclasses.replace(known, edges=edges_in(one, one, one)),))
    assert _run._ends_by_factors(here)
    monkeypatch.setattr(_run, "_FEW_HEIGHTS", here.problem.basis.base.size - 1)
    assert not _run._ends_by_factors(here)
