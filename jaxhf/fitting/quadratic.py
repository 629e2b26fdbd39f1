"""The loss of a fit to second order in the heights: its value, its gradient and JᵀJ as a sparse matrix."""

import math
from typing import Any

import jax
import numpy as np
import scipy.fft
from jaxtyping import Float

from .basis import Unknowns
from .jacobian import PictureValues, Sparse, in_rows, scaled_rows, sp
from .problem import Problem

fft: Any = scipy.fft

MOST_HEIGHTS = 2**17
"""With their padding. The factors of 512 x 512 take 5 GB."""


def is_sparse(problem: Problem) -> bool:
    """Whether the pictures' derivatives are known as sparse matrices, of a size to be factorised."""
    return problem.linearised is not None and problem.basis.base.size <= MOST_HEIGHTS


class Quadratic:
    """JᵀJ and Jᵀr in double precision, J the derivative of all residuals r in the heights, and then in what else is sought.

    Its variables are the changes of the heights with their padding, and then of the other unknowns.

    Args:
      unknowns: whose albedo is known.
      problem: `linearised` there.
      images: `images_jacobian` there.
      values: `picture_values` there.
      reweighted: take the pictures' residuals times the roots of their robust weights, and these as constants, for the
        deviations; else the softened residuals. Steps by reweighted least squares left the terrain's border in a wrong place:
        far outliers pull ((1 + x²)^-2, not ^-3).

    Attributes:
      jacobian: J without the priors that hang on the cosine transform, a row for each residual.
      matrix: its square.
      gradient: Jᵀr with all priors; means nothing where it is reweighted.
      priors: pairs: what a height is multiplied by, and then its cosine transform, for a residual of deviation 1.
    """

    def __init__(self, unknowns: Unknowns, problem: Problem, images: Sparse, values: PictureValues, reweighted: bool = False):
        basis = problem.basis
        self.shape = basis.base.shape
        padded = math.prod(self.shape)
        within = np.asarray(basis.crop(np.arange(padded).reshape(self.shape))).ravel()
        slopes, residuals = in_rows(values.roots if reweighted else values.slopes), [in_rows(values.softened)]
        rows = scaled_rows(images, slopes * in_rows(values.factors))
        columns = [slopes * in_rows([part[k] for part in values.others]) for k in range(values.others[0].shape[0])]
        blocks = [sp.hstack([rows, sp.csr_array(np.stack(columns, axis=1))]) if columns else rows]
        others = len(columns)
        if problem.smoothness is not None:
            smooth = float(problem.smoothness) * laplacian_matrix(basis.crop(np.asarray(basis.base)).shape, (1.0, 1.0))
            blocks.append(sp.hstack([smooth, sp.csr_array((within.size, others))]))
            residuals.append(smooth @ np.asarray(basis.crop(surface(unknowns, problem)), np.float64).ravel())
        self.jacobian = sp.vstack(blocks, format="csr")
        if padded > within.size:
            places = np.concatenate([within, padded + np.arange(others)])
            self.jacobian = sp.csr_array(
                (self.jacobian.data, places[self.jacobian.indices], self.jacobian.indptr),
                shape=(self.jacobian.shape[0], padded + others),
            )
        self.matrix = (self.jacobian.T @ self.jacobian).tocsr()
        self.gradient = self.jacobian.T @ np.concatenate(residuals)
        self.priors: list[tuple[np.ndarray, np.ndarray]] = []
        if problem.prior is not None:
            stiffness = problem.prior.stiffness
            stiffness = np.ones(self.shape) if stiffness is None else np.asarray(stiffness, np.float64)
            self.priors.append((np.asarray(problem.prior.weight, np.float64), stiffness))
            off = surface(unknowns, problem) - np.asarray(problem.prior.heights, np.float64)
            self.gradient[:padded] += self._by_prior(off, *self.priors[0]).ravel()
        of_views = [
            (np.broadcast_to(np.asarray(weight, np.float64) ** 2, value.shape).ravel(), np.asarray(value, np.float64).ravel())
            for value, weight in zip(jax.tree.leaves(unknowns.view), jax.tree.leaves(problem.view_weight), strict=True)
        ]
        self.precision = np.zeros(padded + others)  # of priors of single numbers
        if of_views:  # the last of the unknowns
            precision, at = (np.concatenate(parts) for parts in zip(*of_views, strict=True))
            self.precision[-precision.size :] = precision
            self.gradient[-precision.size :] += precision * at

    def product(self, x: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """JᵀJ x, with all priors."""
        result = self.matrix @ x + self.precision * x
        heights = x[: math.prod(self.shape)].reshape(self.shape)
        for prior in self.priors:
            result[: heights.size] += self._by_prior(heights, *prior).ravel()
        return result

    def _by_prior(self, heights: np.ndarray, weight: np.ndarray, stiffness: np.ndarray) -> np.ndarray:
        if (stiffness == 1).all():
            return weight**2 * heights
        return weight * fft.idctn(stiffness**2 * fft.dctn(weight * heights, norm="ortho"), norm="ortho")


def surface(unknowns: Unknowns, problem: Problem) -> Float[np.ndarray, "my mx"]:
    """The heights with their padding, in double precision."""
    basis = problem.basis
    modes = np.asarray(basis.scale, np.float64) * np.asarray(unknowns.coefficients, np.float64)
    return np.asarray(basis.base, np.float64) + fft.idctn(modes, norm="ortho")


def loss_at(unknowns: Unknowns, problem: Problem, values: PictureValues) -> float:
    """Half the sum of all squared residuals: that of the pictures and of all priors."""
    total = float(np.sum(in_rows(values.softened) ** 2))
    heights = surface(unknowns, problem)
    if problem.prior is not None:
        off = np.asarray(problem.prior.weight, np.float64) * (heights - np.asarray(problem.prior.heights, np.float64))
        stiffness = problem.prior.stiffness
        off = off if stiffness is None else np.asarray(stiffness, np.float64) * fft.dctn(off, norm="ortho")
        total += float(np.sum(off**2))
    if problem.smoothness is not None:
        inner = problem.basis.crop(heights)
        smooth = float(problem.smoothness) * laplacian_matrix(inner.shape, (1.0, 1.0))
        total += float(np.sum((smooth @ inner.ravel()) ** 2))
    for value, weight in zip(jax.tree.leaves(unknowns.view), jax.tree.leaves(problem.view_weight), strict=True):
        total += float(np.sum((np.asarray(value, np.float64) * np.asarray(weight, np.float64)) ** 2))
    return total / 2


def laplacian_matrix(shape: tuple[int, ...], weights: tuple[float, float]) -> Sparse:
    """Minus the sum of second differences along y and x, with these weights, between neighbours that there are."""
    along = [
        weight * sp.diags_array([np.r_[1.0, np.full(n - 2, 2.0), 1.0], -np.ones(n - 1), -np.ones(n - 1)], offsets=[0, 1, -1])
        for n, weight in zip(shape, weights, strict=True)
    ]
    return (sp.kron(along[0], sp.eye_array(shape[1])) + sp.kron(sp.eye_array(shape[0]), along[1])).tocsr()
