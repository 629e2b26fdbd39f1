"""The normal matrix of a fit over heights, and random draws from the normal distribution whose precision it is."""

import functools
import math
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
import scipy.fft
import scipy.linalg
import scipy.optimize
import scipy.sparse.linalg
from jaxtyping import Float

from .basis import Basis, Unknowns
from .jacobian import PictureValues, Sparse, images_jacobian, in_rows, other_unknowns, picture_values, sp
from .problem import Problem
from .quadratic import Quadratic, laplacian_matrix, surface

fft: Any = scipy.fft

_DEGREE = 3  # of the polynomial in the Laplacian that stands for a prior in the preconditioner
_TOLERANCE = 1e-4  # of a draw's residual; the draw is then right to a thousandth
_ROUGH_TOLERANCE = 0.05
_MOST_ITERATIONS = 300


class Simulated(NamedTuple):
    """A fit to noise.

    Attributes:
      noise: of deviation 1, in the pictures.
      left: what it leaves of this noise.
      told: of each mode of the last prior, an estimate of the share that the pictures tell, shape (my, mx).
    """

    noise: Float[np.ndarray, " rows"]
    left: Float[np.ndarray, " rows"]
    told: Float[np.ndarray, "my mx"]


class NormalMatrix:
    """H = JᵀJ, J the weighted derivative of all residuals and of the priors of the unknowns, in double precision.

    Its unknowns are the heights with their padding and then what else is sought. The pictures' part is sparse. Priors are
    diagonal under the cosine transform, so they are applied by it; where a polynomial in the Laplacian comes near to them, it
    stands for them in a sparse matrix beside H, whose factors (SuperLU) precondition conjugate gradients: 4 or 5 iterations,
    where LSMR on J took 300.

    Args:
      unknowns: whose albedo is known.
      problem: `linearised` there.
      images: the `images_jacobian` there; None: it is found.
      values: `picture_values` there whose `slopes` are the roots of weights; None: of robust ones.

    Attributes:
      residuals: of the pictures, in units of the noise, in the order of `in_rows`.
      roots: of their weights.
    """

    def __init__(self, unknowns: Unknowns, problem: Problem, images: Sparse | None = None, values: PictureValues | None = None):
        basis, reweighted = problem.basis, values is None
        self.basis, self.shape = basis, basis.base.shape
        images = images_jacobian(unknowns, problem) if images is None else images
        values = picture_values(unknowns, problem) if values is None else values
        self.model = Quadratic(unknowns, problem, images, values, reweighted)
        pairs = zip(problem.groups, values.images, strict=True)
        self.residuals = in_rows([group.weights * (image - group.targets) for group, image in pairs])
        self.roots = in_rows(values.roots)
        self.model.precision[basis.base.size :] = _other_precision(unknowns, problem)
        self.model.priors.insert(0, (np.ones(self.shape), 1 / np.asarray(basis.scale * basis.prior_amplitude, np.float64)))

    @functools.cached_property
    def factors(self) -> Any:
        """Of a sparse matrix near to H."""
        near = self.model.matrix + sp.diags_array(self.model.precision)
        for weight, stiffness in self.model.priors:
            scaled = sp.diags_array(weight.ravel())
            others = self.model.precision.size - weight.size
            near = near + _on_heights(scaled @ _polynomial(stiffness**2, self.basis) @ scaled, others)
        return sp.linalg.splu(near.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})

    def draw(self, seed: int) -> tuple[Float[np.ndarray, "ny nx"], Float[np.ndarray, " rows"]]:
        """A draw from N(0, H⁻¹): x = H⁻¹ Jᵀz, z normal (Papandreou and Yuille, Gaussian sampling by local perturbations, NIPS
        2010, section 3).

        Returns:
          Its heights without their padding, and the residuals that it leaves of noise z in the pictures, as a fit would.
        """
        right, noise, _ = self._drawn(seed, 1.0)
        x = self._solved(right)
        return self._heights(x), (noise - self.model.jacobian @ x)[: self.roots.size]

    def simulated(self, seed: int, widths: float | Float[np.ndarray, "my mx"] = 1.0) -> "Simulated":
        """What is left of noise in a fit of heights that differ from the last of the priors by so many times its deviations."""
        right, noise, modes = self._drawn(seed, widths)
        x = self._roughly_solved(right)
        noise = noise[: self.roots.size]
        return Simulated(noise, noise - self.seen(x) * self.roots, modes * (modes - self._in_prior(x)))

    def _drawn(
        self, seed: int, widths: float | Float[np.ndarray, "my mx"]
    ) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " residuals"], Float[np.ndarray, "my mx"]]:
        """The right side of a draw's equations, the noise, and the modes of the last prior in units of its deviations."""
        rng = np.random.default_rng(seed)
        noise = rng.standard_normal(self.model.jacobian.shape[0])
        right = self.model.jacobian.T @ noise
        right += np.sqrt(self.model.precision) * rng.standard_normal(right.size)
        modes = np.zeros(self.shape)
        for number, (weight, stiffness) in enumerate(self.model.priors):
            modes = rng.standard_normal(self.shape) * (widths if number + 1 == len(self.model.priors) else 1.0)
            moved = weight * fft.idctn(stiffness * modes, norm="ortho")
            right[: moved.size] += moved.ravel()
        return right, noise, modes

    def step(self) -> Float[np.ndarray, " n"]:
        """About the change of the unknowns to the least loss, were it quadratic, with the pictures' values that were given."""
        return self._roughly_solved(-self.model.gradient)

    def seen(self, x: Float[np.ndarray, " n"]) -> Float[np.ndarray, " rows"]:
        """The change of the pictures, in units of their noise, by this change of the unknowns."""
        return (self.model.jacobian[: self.roots.size] @ x) / self.roots

    def in_prior(self, unknowns: Unknowns, problem: Problem, x: Float[np.ndarray, " n"]) -> Float[np.ndarray, "my mx"]:
        """The modes of the heights' difference to their prior, in units of its deviations, after a change of the unknowns."""
        assert problem.prior is not None
        off = surface(unknowns, problem) - np.asarray(problem.prior.heights, np.float64)
        return self._in_prior(off.ravel() + x[: off.size])

    def _in_prior(self, x: Float[np.ndarray, " n"]) -> Float[np.ndarray, "my mx"]:
        weight, stiffness = self.model.priors[-1]
        return stiffness * fft.dctn(weight * x[: weight.size].reshape(self.shape), norm="ortho")

    def response(self, noise: Float[np.ndarray, " rows"]) -> tuple[Float[np.ndarray, "ny nx"], Float[np.ndarray, " rows"]]:
        """What this error of the pictures, in units of their noise, makes of the heights, and of the residuals."""
        images = self.model.jacobian[: self.roots.size]
        x = self._solved(images.T @ (self.roots * noise))
        return self._heights(x), noise - self.seen(x)

    def reach(self) -> Float[np.ndarray, " rows"]:
        """By how much each value of the pictures changes, in units of its noise, as the heights that it depends on move by
        independent errors of deviation 1."""
        images = self.model.jacobian[: self.roots.size, : math.prod(self.shape)]
        return np.sqrt(images.power(2).sum(axis=1)) / self.roots

    def variance(self) -> Float[np.ndarray, "ny nx"]:
        """The diagonal of H⁻¹ by a dense inverse: the variances of the heights without their padding."""
        dense = np.stack([self.model.product(row) for row in np.eye(self.model.precision.size)])
        inverse = scipy.linalg.cho_solve(scipy.linalg.cho_factor(dense), np.eye(len(dense)))
        return self.basis.crop(np.diag(inverse)[: math.prod(self.shape)].reshape(self.shape))

    def _heights(self, x: Float[np.ndarray, " n"]) -> Float[np.ndarray, "ny nx"]:
        return self.basis.crop(x[: math.prod(self.shape)].reshape(self.shape))

    def _solved(self, right: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        return self._by_conjugate_gradients(right, self.factors.solve, _TOLERANCE)

    def _roughly_solved(self, right: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """As `_solved`, so that residuals are right to a thousandth, in some 40 iterations and without factors."""
        squares = np.asarray(self.basis.scale, np.float64) ** 2

        def inverse(x: np.ndarray) -> np.ndarray:
            heights = x[: squares.size].reshape(self.shape)
            return np.concatenate(
                [fft.idctn(squares * fft.dctn(heights, norm="ortho"), norm="ortho").ravel(), x[squares.size :]]
            )

        return self._by_conjugate_gradients(right, inverse, _ROUGH_TOLERANCE)

    def _by_conjugate_gradients(self, right: Float[np.ndarray, " n"], inverse: Any, tolerance: float) -> np.ndarray:
        n = right.size
        product, near = (sp.linalg.LinearOperator((n, n), f, dtype=np.float64) for f in (self.model.product, inverse))
        return sp.linalg.cg(product, right, rtol=tolerance, maxiter=_MOST_ITERATIONS, M=near)[0]


def _on_heights(matrix: Sparse, others: int) -> Sparse:
    return sp.block_diag([matrix, sp.csr_array((others, others))], format="csr") if others else matrix


def _other_precision(unknowns: Unknowns, problem: Problem) -> Float[np.ndarray, " k"]:
    """1 / the variance of each number that is sought besides heights, before the pictures are seen."""
    others = jax.tree.map(jnp.ones_like, other_unknowns(unknowns))
    view = jax.tree.map(lambda one, weight: one * weight[None] ** 2, others.view, problem.view_weight)
    others = eqx.tree_at(lambda unknowns: unknowns.view, others, view)
    return np.asarray(jax.flatten_util.ravel_pytree(others)[0], np.float64)


def _polynomial(precision: Float[np.ndarray, "my mx"], basis: Basis) -> Sparse:
    """A matrix whose eigenvalues, along the modes of `basis`, come near to these ones: a polynomial in the Laplacian.

    Its coefficients are not negative, so that it is positive definite. (1 + length² · Laplacian)^n is met exactly.
    """
    frequency = 1 / np.asarray(basis.scale * basis.prior_amplitude, np.float64)
    frequency = np.sqrt(frequency / frequency[0, 0]) - 1  # half periods in the longer side
    steps = [(2 - 2 * np.cos(np.pi * np.arange(n) / n)) * ((n - 1) / np.pi) ** 2 for n in precision.shape]
    weights = frequency[1, 0] ** 2, frequency[0, 1] ** 2
    eigenvalue = (weights[0] * steps[0][:, None] + weights[1] * steps[1][None, :]).ravel()
    largest = eigenvalue.max()
    powers = (eigenvalue / largest)[:, None] ** np.arange(_DEGREE + 1)
    # Modes evenly over their frequencies' logarithm: most of all modes have the highest.
    chosen = np.searchsorted(np.sort(eigenvalue), np.geomspace(eigenvalue[eigenvalue > 0].min(), largest, 200))
    chosen = np.r_[0, np.argsort(eigenvalue)[np.minimum(chosen, eigenvalue.size - 1)]]
    relative = powers[chosen] / precision.ravel()[chosen, None]
    size = relative.max(axis=0)
    coefficients = scipy.optimize.nnls(relative / size, np.ones(len(chosen)))[0] / size
    spacing = tuple(weight * ((n - 1) / np.pi) ** 2 / largest for weight, n in zip(weights, precision.shape, strict=True))
    laplacian = laplacian_matrix(precision.shape, spacing)
    result = coefficients[-1] * sp.eye_array(precision.size)
    for coefficient in coefficients[-2::-1]:
        result = result @ laplacian + coefficient * sp.eye_array(precision.size)
    return result.tocsr()
