"""The normal matrix over heights against products with the residuals' derivative, and draws from its inverse."""

import dataclasses

import jax.flatten_util
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse
from small_fits import HALF, OPTIONS, TRUTH, fit_options, pictures, rms, scenes

from jaxhf.core.errors import ArgumentError
from jaxhf.fitting import uncertainty as _uncertainty
from jaxhf.fitting.jacobian import images_jacobian, picture_values
from jaxhf.fitting.linearise import LinearisedEdges
from jaxhf.fitting.normal_equations import _solved
from jaxhf.fitting.normal_matrix import NormalMatrix
from jaxhf.fitting.problem import make_problem
from jaxhf.fitting.quadratic import Quadratic, loss_at
from jaxhf.fitting.residuals import half_squares, linearised
from jaxhf.fitting.uncertainty import _Boundaries, _on_boundaries, _operator, require_small, standard_deviations

EVERYTHING = {
    "light_std": 1, "camera_std": (0.01, 1), "exposures": True, "offsets": True, "smoothness": 1.0, "loss": "geman",
    "prior": TRUTH, "prior_std": 0.05, "prior_length": 0.2, "prior_exponent": 2.6,
}  # fmt: skip

# What single precision leaves; double leaves no room for an error that it would hide.
PRECISIONS = pytest.mark.parametrize(
    "rounding", [2e-4, pytest.param(1e-8, marks=[pytest.mark.x64, pytest.mark.deep])], ids=["single", "double"]
)


@pytest.mark.deep
@PRECISIONS
def test_it_is_the_square_of_the_residuals_derivative(rounding):
    """With all that can be sought beside heights; an exponent that no polynomial in the Laplacian meets."""
    problem, unknowns = make_problem(scenes(TRUTH + 0.001), pictures(), fit_options(**(OPTIONS | EVERYTHING)))
    problem = linearised(unknowns, problem)
    matrix = NormalMatrix(unknowns, problem)
    flat, unflat = jax.flatten_util.ravel_pytree(unknowns)
    change = np.random.default_rng(0).standard_normal(flat.size).astype(flat.dtype)

    @jax.jit
    def squared(change):
        operator, _ = _operator(unknowns, problem)
        return jax.flatten_util.ravel_pytree(operator.T.mv(operator.mv(unflat(change))))[0]

    expected = squared(change)
    basis, n = problem.basis, unknowns.coefficients.size
    heights = basis.surface(jnp.asarray(change[:n].reshape(basis.base.shape))) - basis.base
    product = matrix.model.product(np.concatenate([np.ravel(heights), change[n:]]))
    modes = basis.scale * basis.transform(jnp.asarray(product[:n].reshape(basis.base.shape)))
    np.testing.assert_allclose(np.concatenate([np.ravel(modes), product[n:]]), expected, rtol=0, atol=rounding * rms(expected))


@pytest.mark.deep
@PRECISIONS
def test_a_step_solves_the_damped_equations_of_the_loss_itself(rounding):
    """Its gradient is JAX's own of the robust loss with all priors; so is the loss."""
    problem, unknowns = make_problem(scenes(TRUTH + 0.001), pictures(), fit_options(**(OPTIONS | EVERYTHING)))
    problem, basis = linearised(unknowns, problem), problem.basis
    values = picture_values(unknowns, problem)
    model = Quadratic(unknowns, problem, images_jacobian(unknowns, problem), values)
    loss, gradient = jax.jit(jax.value_and_grad(lambda unknowns: half_squares(unknowns, problem)[0]))(unknowns)
    np.testing.assert_allclose(loss_at(unknowns, problem, values), loss, rtol=rounding)

    def in_modes(surface: np.ndarray) -> np.ndarray:
        heights = jnp.asarray(surface[: basis.base.size].reshape(basis.base.shape))
        return np.concatenate([np.ravel(basis.scale * basis.transform(heights)), surface[basis.base.size :]])

    expected = np.asarray(jax.flatten_util.ravel_pytree(gradient)[0])
    np.testing.assert_allclose(in_modes(model.gradient), expected, rtol=0, atol=rounding * rms(expected))
    n = basis.base.size

    def curved(step: np.ndarray) -> np.ndarray:
        modes = jnp.asarray(step[:n].reshape(basis.base.shape))
        return in_modes(model.product(np.concatenate([np.ravel(basis.surface(modes) - basis.base), step[n:]])))

    damping = rms(curved(expected)) / rms(expected)  # counts for as much as the curvature
    step, predicted = _solved(model, basis, damping, 2000)
    assert rms(curved(step) + damping * step + expected) < 1e-3 * rms(expected)
    assert predicted > 0


@pytest.mark.deep  # draws hold the truth in test_fit.py
def test_draws_have_its_inverse_as_their_covariance(monkeypatch):
    """In the half that pictures show, and in the other, which only the prior knows; and by LSMR, where J is not sparse."""
    known = {"prior": TRUTH, "prior_std": 0.05, "prior_length": 0.1, "noise": 0.005}
    problem, unknowns = make_problem(scenes(TRUTH, camera=HALF), pictures(camera=HALF), fit_options(**(OPTIONS | known)))
    problem = linearised(unknowns, problem)
    exact, none, *_ = standard_deviations(unknowns, problem, "exact", 60)
    assert none is None
    assert exact[4:8, 1:5].max() < 0.5 * exact[:, 9:].min()

    def off(count: int) -> list[float]:
        sampled, drawn, *_ = standard_deviations(unknowns, problem, count, 60)
        assert drawn == count
        return [rms((sampled / exact - 1)[half]) * np.sqrt(2 * count) for half in (np.s_[:, :7], np.s_[:, 9:])]

    assert max(off(1000)) < 2  # each has a spread of 1 / sqrt(2 n); they hang together
    monkeypatch.setattr(_uncertainty, "is_sparse", lambda problem: False)
    assert max(off(60)) < 3
    by_columns, *_ = standard_deviations(unknowns, problem, "exact", 60)
    np.testing.assert_allclose(by_columns, exact, rtol=1e-3)


class LinearPictures(NormalMatrix):
    """In place of a `NormalMatrix`: of 200 heights six values tell a little each, and a hundred are told by a boundary as
    well, much more sharply; fitted to measurements in which boundaries are off."""

    def __init__(self, displacement: float, rng: np.random.Generator):
        n, smooth = 200, 1200
        shading = scipy.sparse.random_array((smooth, n), density=2 / n, rng=rng, data_sampler=rng.standard_normal)
        sharp = scipy.sparse.csr_array((np.full(100, 5.0), (np.arange(100), rng.integers(n, size=100))), shape=(100, n))
        self.jacobian = scipy.sparse.vstack([shading, sharp, scipy.sparse.eye_array(n)], format="csr")
        self.inverse = np.linalg.inv((self.jacobian.T @ self.jacobian).toarray())
        self.count, self.roots, self.rows = n, np.ones(smooth + 100), np.arange(smooth + 100) >= smooth
        noise = rng.standard_normal(self.roots.size + n)
        noise[: self.roots.size][self.rows] += displacement * 5 * rng.standard_normal(100)
        self.errors, self.residuals = self._fitted(noise)

    def _fitted(self, noise: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        x = self.inverse @ (self.jacobian.T @ noise)
        return x[None], (noise - self.jacobian @ x)[: self.roots.size]

    def draw(self, seed: int) -> tuple[np.ndarray, np.ndarray]:
        return self._fitted(np.random.default_rng(seed).standard_normal(self.roots.size + self.count))

    def response(self, noise: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return self._fitted(np.r_[noise, np.zeros(self.count)])

    def reach(self) -> np.ndarray:
        return np.sqrt(self.jacobian.power(2).sum(axis=1))[: self.roots.size]


@pytest.mark.parametrize(("displacement", "by_noise_alone"), [(0.0, 0.68), (2.0, 0.37)])
def test_boundaries_that_stand_elsewhere_widen_deviations(displacement, by_noise_alone):
    """Heights explain most of what such pixels are off by, so chi2 hardly shows it."""
    found, within, plain = [], [], []
    for seed in range(10):
        pictures = LinearPictures(displacement, np.random.default_rng(seed))
        tau, more = _Boundaries(pictures, pictures.rows, 3.0).variance()
        variance = np.diag(pictures.inverse)[None]
        found.append(tau)
        within.append(np.mean(pictures.errors**2 <= variance + more))
        plain.append(np.mean(pictures.errors**2 <= variance))
    # One displacement is found to about 0.07, or 12 % of it; 10 times 200 shares of 68 % have a spread of 1 %.
    np.testing.assert_allclose(np.mean(found), displacement, atol=0.07 + 0.05 * displacement)
    assert np.mean(within) == pytest.approx(0.683, abs=0.03)
    assert np.mean(plain) == pytest.approx(by_noise_alone, abs=0.03)


def test_values_of_pixels_on_boundaries_are_found():
    """In the order of rows: picture by picture. How far heights move them is the norm of their row of the derivative."""
    problem, unknowns = make_problem(scenes(TRUTH), pictures(), fit_options(**OPTIONS))
    problem = linearised(unknowns, problem)
    none, resampled = jnp.zeros((3, 1), np.int32), jnp.array([[5], [7], [9]])
    edges = LinearisedEdges(jnp.zeros((3, 1, 1, 5, 1)), jnp.zeros((3, 1, 5, 1), np.int32), none, none, resampled)
    assert problem.linearised is not None
    known = dataclasses.replace(problem.linearised[0], edges=edges)
    rows = _on_boundaries(dataclasses.replace(problem, linearised=(known,)))
    np.testing.assert_array_equal(np.flatnonzero(rows), [5, 24 * 24 + 7, 2 * 24 * 24 + 9])
    matrix = NormalMatrix(unknowns, problem)
    jacobian = images_jacobian(unknowns, problem).toarray() / 0.01
    np.testing.assert_allclose(matrix.reach(), np.linalg.norm(jacobian, axis=1), rtol=1e-5)
    change, left = matrix.response(jacobian @ np.ravel(TRUTH))
    assert rms(left) < 0.01 * rms(jacobian @ np.ravel(TRUTH))
    assert rms(change - TRUTH) < rms(TRUTH)


def test_what_is_too_large_to_invert_is_refused():
    """Sooner where J is not sparse."""
    problem, unknowns = make_problem(scenes(np.zeros((60, 60))), pictures(), fit_options(**OPTIONS))
    require_small(unknowns, problem)
    problem, unknowns = make_problem(scenes(np.zeros((60, 60))), pictures(), fit_options(**OPTIONS, albedo="constant"))
    with pytest.raises(ArgumentError, match="uncertainty 'exact' takes at most 16777216 residuals times"):
        require_small(unknowns, problem)
