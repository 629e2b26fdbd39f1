"""The normal matrix of a fit against a dense one, what is near to its inverse, and draws from that."""

import dataclasses
import functools
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse.linalg
from small_fits import EVERYTHING, SETTINGS, SIZE, TRUTH, dense, edges_in, expanded, pictures, rms, scenes

import jaxhf
from jaxhf.fitting.model import normal_matrix as _normal_matrix
from jaxhf.fitting.model.expansion import prior_residuals
from jaxhf.fitting.model.normal_matrix import NormalMatrix, in_row
from jaxhf.fitting.model.rows import part_by_heights, pictures_by_heights
from jaxhf.fitting.model.unknowns import Window
from jaxhf.fitting.trust.judge import Boundaries, standard_deviations

sp: Any = scipy.sparse  # whose stubs miss much
OPTIONS = {"settings": SETTINGS, "noise": 0.01}
VALUES = 3 * SIZE * SIZE
HELD = np.where(np.indices(TRUTH.shape).sum(0) % 5 == 0, 0.0, 0.05)
APART = np.where(np.indices(TRUTH.shape).sum(0) % 7 == 1, TRUTH + 0.02, np.nan)
PRIORS = {
    "none": None,
    "independent, some held": jaxhf.Prior(TRUTH, HELD),
    "correlated": jaxhf.Prior(TRUTH, 0.05, 0.2),
    "correlated, some held": jaxhf.Prior(TRUTH, HELD, 0.2, APART),
}
BOTH = "correlated, some held"  # of whose terms the others have a part
EACH = pytest.mark.parametrize(
    "prior", [*(pytest.param(name, marks=pytest.mark.deep) for name in PRIORS if name != BOTH), BOTH]
)
# What single precision leaves; double leaves no room for an error that it would hide.
DOUBLE = [pytest.param(name, 1e-9, marks=[pytest.mark.x64, pytest.mark.deep]) for name in PRIORS]


@pytest.mark.parametrize(("prior", "rounding"), [(BOTH, 3e-4), *DOUBLE])
def test_it_is_the_square_of_the_derivative(prior, rounding):
    """Of all residuals in all unknowns; so is the gradient of their squares. What holds heights gives them no row."""
    if prior == "none" and rounding < 1e-6:
        rounding = 1e-8  # of modes whose prior is a hundred thousand times tighter than that of others
    here = expanded(scenes(TRUTH + 0.001), pictures(), prior=PRIORS[prior], unknown=EVERYTHING, **OPTIONS)
    moved = 0.1 * np.random.default_rng(3).standard_normal(here.unknowns.coefficients.shape)  # a step from where it began
    moved = jnp.asarray(moved, here.unknowns.coefficients.dtype)
    here = dataclasses.replace(here, unknowns=eqx.tree_at(lambda u: u.coefficients, here.unknowns, moved))
    roots = np.random.default_rng(1).uniform(0.5, 1.0, VALUES)
    by_pictures, by_priors, free = dense(here, roots)
    x, rows = np.random.default_rng(0).standard_normal(free.size), np.random.default_rng(2).standard_normal(roots.size)
    off = np.concatenate([np.ravel(part) for part in prior_residuals(here.unknowns, here.problem)])
    for kept in (None, pictures_by_heights(here)):  # products by JAX, and by a sparse matrix
        matrix = NormalMatrix(here, roots, kept)
        expected = by_pictures.T @ (by_pictures @ x) + by_priors.T @ (by_priors @ x)
        np.testing.assert_allclose(matrix.product(x), expected, rtol=0, atol=rounding * rms(expected))
        np.testing.assert_allclose(matrix.seen(x), by_pictures @ x, rtol=0, atol=rounding * rms(by_pictures @ x))
        expected = by_pictures.T @ rows + by_priors.T @ off
        np.testing.assert_allclose(matrix.gradient(rows), expected, rtol=0, atol=rounding * rms(expected))
        assert not matrix.product(x)[~free].any()
        assert np.count_nonzero(~free) == (0 if "held" not in prior else np.count_nonzero(matrix.free == 0))


WINDOW = Window(0, 4, 8, 8)


@pytest.mark.parametrize("prior", ["correlated", "independent, some held"])
def test_a_part_of_the_pictures_depends_on_a_part_of_the_heights(prior):
    """On no others, and as all pictures do; so do its products, but for the prior of heights beyond."""
    here = expanded(scenes(TRUTH), pictures(), prior=PRIORS[prior], **OPTIONS)
    whole, (part, values) = pictures_by_heights(here), part_by_heights(here, WINDOW)
    assert whole is not None
    inside = np.zeros(TRUTH.shape, bool)
    inside[WINDOW.place] = True
    rows = whole.toarray()[values]
    assert not rows[:, ~inside.ravel()].any()
    np.testing.assert_array_equal(part.toarray(), rows[:, inside.ravel()])
    # All that is seen of these cells but the outermost: a picture shows 12 x 12 vertices in 24 x 24 pixels.
    assert values.size > 0.6 * VALUES * (7 * 7) / (11 * 11)
    roots = np.random.default_rng(1).uniform(0.5, 1.0, VALUES)
    matrix = NormalMatrix(here, roots[values], part, WINDOW)
    x = np.zeros(here.problem.basis.base.shape)
    change = np.random.default_rng(0).standard_normal(matrix.shape)
    here.problem.basis.crop(x)[WINDOW.place] = change
    np.testing.assert_allclose(matrix.seen(change.ravel()), NormalMatrix(here, roots, whole).seen(x.ravel())[values])
    right = matrix.gathered(matrix.drawn(0))
    np.testing.assert_allclose(matrix.product(matrix.solved(right, 1e-6)), right, rtol=0, atol=1e-5 * rms(right) * right.size)


@EACH
def test_its_near_inverse_is_near(prior):
    """Near enough for a few iterations.

    Where a polynomial in the Laplacian meets the prior, it is off by rounding alone: lights and cameras trade against heights
    so freely that single precision makes a tenth of it.
    """
    here = expanded(scenes(TRUTH), pictures(), prior=PRIORS[prior], unknown=EVERYTHING, **OPTIONS)
    roots, rng = np.random.default_rng(1).uniform(0.5, 1.0, VALUES), np.random.default_rng(0)
    matrix, products, others = NormalMatrix(here, roots), [], here.unknowns.count - here.problem.basis.base.size
    matrix.inverse = inverse = NormalMatrix(here, roots, pictures_by_heights(here)).inverse
    asked = np.concatenate([np.ravel(matrix.free * rng.standard_normal(matrix.shape)), rng.standard_normal(others)])
    assert rms(inverse(matrix.product(asked)) - asked) < 0.2 * rms(asked)
    right = matrix.gathered(matrix.drawn(0))
    matrix.product = lambda x: products.append(x) or NormalMatrix.product(matrix, x)
    matrix.solved(right, 1e-4)
    assert len(products) < 8  # without it 300 and more


def test_blocks_solve_with_a_matrix_over_a_grid(monkeypatch):
    """A Laplacian and little more, in which each value depends on all others."""
    for name, value in (("_FACTORED", 0), ("_BLOCK", 16), ("_BEYOND", 4)):
        monkeypatch.setattr(_normal_matrix, name, value)
    shape, rng = (70, 45), np.random.default_rng(0)
    along = [sp.diags_array([-np.ones(n - 1), np.r_[1, 2 * np.ones(n - 2), 1], -np.ones(n - 1)], offsets=[-1, 0, 1])
             for n in shape]  # fmt: skip
    near = sp.kronsum(along[1], along[0], format="csr") + 1e-4 * sp.eye_array(70 * 45)
    solve = _normal_matrix._inverse(near, shape)
    right, other, iterations = rng.standard_normal(70 * 45), rng.standard_normal(70 * 45), []
    assert right @ solve(other) == pytest.approx(other @ solve(right), rel=1e-8)
    inverse = sp.linalg.LinearOperator(near.shape, solve, dtype=np.float64)
    found, _ = sp.linalg.cg(near, right, rtol=1e-6, M=inverse, callback=iterations.append)
    np.testing.assert_allclose(near @ found, right, atol=1e-5 * rms(right))
    assert len(iterations) < 13  # 318 without it


FIELD = jaxhf.Unknown(albedo="map", albedo_std=0.3, albedo_length=0.2, exposures=True)
DRAWS = {
    "by factors": {"prior": PRIORS["correlated, some held"]},
    "by modes": {"prior": PRIORS["independent, some held"]},
    "everything": {"prior": PRIORS["correlated, some held"], "unknown": EVERYTHING},
    "field of the albedo map": {"prior": PRIORS["correlated"], "unknown": FIELD},
    "map of the albedo": {"prior": PRIORS["correlated"], "unknown": jaxhf.Unknown(albedo="map", exposures=True)},
}


@pytest.mark.parametrize("name", [pytest.param(name, marks=pytest.mark.deep) if "map" in name else name for name in DRAWS])
def test_draws_have_its_inverse_as_their_covariance(name, monkeypatch):
    """x = H⁻¹ Jᵀz with z of covariance 1: as a dense matrix has them, with the weights of the robust loss.

    To a hundredth, where the deviations of 20 draws are right to 16 %.
    """
    measured = [picture.copy() for picture in pictures()]
    measured[0][3:9] += 0.02
    here = expanded(scenes(TRUTH), measured, **OPTIONS, **DRAWS[name])
    by_pictures, by_priors, free = dense(here, 1 / (1 + (in_row(here.left()) / 3) ** 2))
    covariance = np.zeros((free.size, free.size))
    covariance[np.ix_(free, free)] = np.linalg.inv((by_pictures.T @ by_pictures + by_priors.T @ by_priors)[np.ix_(free, free)])
    if name == "by modes":
        monkeypatch.setattr(_normal_matrix, "pictures_by_heights", lambda _: None)
    found = standard_deviations(here, 3)
    assert (found.displacement, found.raised) == (0.0, 1.0)
    matrix = NormalMatrix(here, np.ones(VALUES))
    for k, sample in enumerate(found.samples):
        noise = matrix.drawn(k)
        drawn = np.concatenate([noise.pictures, np.ravel(noise.modes), noise.others])
        assert abs(np.mean(drawn**2) - 1) < 4 * np.sqrt(2 / drawn.size)
        expected = matrix.heights_of(covariance @ (np.concatenate([by_pictures, by_priors]).T @ drawn))
        np.testing.assert_allclose(sample, expected, rtol=0, atol=0.01 * rms(expected))
    np.testing.assert_allclose(found.std, np.sqrt(np.mean(found.samples**2, axis=0)), rtol=1e-6)
    means = np.mean(found.samples, axis=(1, 2), keepdims=True)
    np.testing.assert_allclose(found.parts, (rms(means), rms(found.samples - means)), rtol=1e-6)


class LinearPictures:
    """Pictures of 200 heights: six values tell a little of each, and a hundred are told by a boundary as well, much more
    sharply; fitted to measurements in which boundaries are off."""

    def __init__(self, displacement: float, rng: np.random.Generator):
        n, smooth = 200, 1200
        shading = scipy.sparse.random_array((smooth, n), density=2 / n, rng=rng, data_sampler=rng.standard_normal)
        sharp = scipy.sparse.csr_array((np.full(100, 5.0), (np.arange(100), rng.integers(n, size=100))), shape=(100, n))
        self.jacobian = scipy.sparse.vstack([shading, sharp, scipy.sparse.eye_array(n)], format="csr")
        self.inverse = np.linalg.inv((self.jacobian.T @ self.jacobian).toarray())
        self.count, self.size, self.rows = n, smooth + 100, np.arange(smooth, smooth + 100)
        noise = rng.standard_normal(self.size + n)
        noise[self.rows] += displacement * 5 * rng.standard_normal(100)
        self.errors, self.residuals = self.fitted(noise)

    def fitted(self, noise: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        x = self.inverse @ (self.jacobian.T @ noise)
        return x[None], (noise - self.jacobian @ x)[: self.size]

    def boundaries(self) -> Boundaries:
        found = Boundaries.__new__(Boundaries)  # without an expansion
        reach = np.sqrt(self.jacobian.power(2).sum(axis=1))[self.rows]
        found.rows, found.reach, found.size, found.most, found.left = self.rows, reach, self.size, 9.0, []
        found.residuals = self.residuals[self.rows]
        for seed in range(20):
            found.keep(self.fitted(np.random.default_rng(seed).standard_normal(self.size + self.count))[1])
        return found


@pytest.mark.parametrize(("displacement", "by_noise_alone"), [(0.0, 0.68), (2.0, 0.37)])
def test_boundaries_that_stand_elsewhere_widen_deviations(displacement, by_noise_alone):
    """Heights explain most of what such pixels are off by, so chi2 hardly shows it."""
    found, within, plain = [], [], []
    for seed in range(10):
        known = LinearPictures(displacement, np.random.default_rng(seed))
        respond = functools.partial(lambda known, noise: known.fitted(np.r_[noise, np.zeros(known.count)]), known)
        tau, moved = known.boundaries().displacements(respond)
        variance, more = np.diag(known.inverse)[None], np.mean(np.square([*moved, *[0 * known.errors] * (not moved)]), axis=0)
        found.append(tau)
        within.append(np.mean(known.errors**2 <= variance + more))
        plain.append(np.mean(known.errors**2 <= variance))
    # One displacement is found to about 0.07, or 12 % of it; 10 times 200 shares of 68 % have a spread of 1 %.
    np.testing.assert_allclose(np.mean(found), displacement, atol=0.07 + 0.05 * displacement)
    assert np.mean(within) == pytest.approx(0.683, abs=0.03)
    assert np.mean(plain) == pytest.approx(by_noise_alone, abs=0.03)


def test_values_of_pixels_on_boundaries_are_found():
    """In the order of rows: picture by picture. How far heights move them is the norm of their row of the derivative."""
    here = expanded(scenes(TRUTH), pictures(), **OPTIONS)
    edges = edges_in(np.zeros((3, 1)), np.zeros((3, 1)), [[5], [7], [9]])
    (known,), rows = here.linearised, pictures_by_heights(here)
    assert known is not None
    assert rows is not None
    left = in_row(here.left())
    found = Boundaries(dataclasses.replace(here, linearised=(dataclasses.replace(known, edges=edges),)), rows, left)
    np.testing.assert_array_equal(found.rows, [5, 24 * 24 + 7, 2 * 24 * 24 + 9])
    np.testing.assert_allclose(found.reach, np.linalg.norm(rows.toarray(), axis=1)[found.rows], rtol=1e-5)
    np.testing.assert_array_equal(found.residuals, left[found.rows])
    assert Boundaries(here, rows, left).displacements(lambda _: pytest.fail("there are none")) == (0.0, [])
