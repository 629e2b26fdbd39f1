"""The normal matrix of a fit over heights, and random draws from the normal distribution whose precision it is."""

import math
from typing import Any

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
from .jacobian import Sparse, images_jacobian, in_rows, other_unknowns, picture_values, sp
from .problem import Problem
from .quadratic import Quadratic, laplacian_matrix

fft: Any = scipy.fft

_DEGREE = 3  # of the polynomial in the Laplacian that stands for a prior in the preconditioner
_TOLERANCE = 1e-4  # of a draw's residual; the draw is then right to a thousandth
_MOST_ITERATIONS = 300


class NormalMatrix:
    """H = JᵀJ, J the weighted derivative of all residuals and of the priors of the unknowns, in double precision.

    Its unknowns are the heights with their padding and then what else is sought. The pictures' part is sparse. Priors are
    diagonal under the cosine transform, so they are applied by it; where a polynomial in the Laplacian comes near to them, it
    stands for them in a sparse matrix beside H, whose factors (SuperLU) precondition conjugate gradients: 4 or 5 iterations,
    where LSMR on J took 300.

    Args:
      unknowns: whose albedo is known.
      problem: `linearised` there.

    Attributes:
      residuals: of the pictures, in units of the noise, in the order of `in_rows`.
      roots: of their robust weights.
    """

    def __init__(self, unknowns: Unknowns, problem: Problem):
        basis = problem.basis
        self.basis, self.shape = basis, basis.base.shape
        images, values = images_jacobian(unknowns, problem), picture_values(unknowns, problem)
        self.model = Quadratic(unknowns, problem, images, values, reweighted=True)
        pairs = zip(problem.groups, values.images, strict=True)
        self.residuals = in_rows([group.weights * (image - group.targets) for group, image in pairs])
        self.roots = in_rows(values.roots)
        known = _other_precision(unknowns, problem)
        self.model.precision[basis.base.size :] = known
        self.model.priors.insert(0, (np.ones(self.shape), 1 / np.asarray(basis.scale * basis.prior_amplitude, np.float64)))
        near = self.model.matrix + sp.diags_array(self.model.precision)
        for weight, stiffness in self.model.priors:
            scaled = sp.diags_array(weight.ravel())
            near = near + _on_heights(scaled @ _polynomial(stiffness**2, basis) @ scaled, known.size)
        self.factors = sp.linalg.splu(
            near.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
        )

    def draw(self, seed: int) -> tuple[Float[np.ndarray, "ny nx"], Float[np.ndarray, " rows"]]:
        """A draw from N(0, H⁻¹): x = H⁻¹ Jᵀz, z normal (Papandreou and Yuille, Gaussian sampling by local perturbations, NIPS
        2010, section 3).

        Returns:
          Its heights without their padding, and the residuals that it leaves of noise z in the pictures, as a fit would.
        """
        rng = np.random.default_rng(seed)
        noise = rng.standard_normal(self.model.jacobian.shape[0])
        right = self.model.jacobian.T @ noise
        right += np.sqrt(self.model.precision) * rng.standard_normal(right.size)
        for weight, stiffness in self.model.priors:
            moved = weight * fft.idctn(stiffness * rng.standard_normal(self.shape), norm="ortho")
            right[: moved.size] += moved.ravel()
        x = self._solved(right)
        return self._heights(x), (noise - self.model.jacobian @ x)[: self.roots.size]

    def response(self, noise: Float[np.ndarray, " rows"]) -> tuple[Float[np.ndarray, "ny nx"], Float[np.ndarray, " rows"]]:
        """What this error of the pictures, in units of their noise, makes of the heights, and of the residuals."""
        images = self.model.jacobian[: self.roots.size]
        x = self._solved(images.T @ (self.roots * noise))
        return self._heights(x), noise - (images @ x) / self.roots

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
        n = right.size
        product = sp.linalg.LinearOperator((n, n), self.model.product, dtype=np.float64)
        inverse = sp.linalg.LinearOperator((n, n), self.factors.solve, dtype=np.float64)
        return sp.linalg.cg(product, right, rtol=_TOLERANCE, maxiter=_MOST_ITERATIONS, M=inverse)[0]


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
