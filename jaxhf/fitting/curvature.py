"""How curved the loss of a fit is along each mode of the heights."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from .problem import Problem


def mode_curvature(problem: Problem, influences: Sequence[np.ndarray]) -> Float[np.ndarray, "my mx"]:
    """The curvature of the loss along each DCT mode of unit height.

    That of the pictures, the diagonal of JᵀJ, is the mean square of Jᵀz over draws of z, and over neighbouring modes; in that
    of the prior, weights count by their mean square.

    Args:
      problem: see there.
      influences: Jᵀz in the heights, (ny, nx) each, see `pictures_and_influence`.
    """
    basis = problem.basis
    rows, columns = np.asarray(basis.rows, np.float64), np.asarray(basis.columns, np.float64)
    padding = [(n, n) for n in basis.padding]
    squares = np.mean([(rows @ np.pad(influence, padding) @ columns.T) ** 2 for influence in influences], axis=0)
    curvature = _over_neighbours(squares)
    curvature[0, 0] = squares[0, 0]  # unlike any other
    if problem.prior is not None:
        weight = float(np.mean(np.square(np.asarray(problem.prior.weight))))
        stiffness = 1.0 if problem.prior.stiffness is None else np.asarray(problem.prior.stiffness, np.float64)
        curvature += weight * stiffness**2
    if problem.smoothness is not None:
        y, x = (2 - 2 * np.cos(np.pi * np.arange(n) / n) for n in curvature.shape)
        curvature += (float(problem.smoothness) * (y[:, None] + x[None, :])) ** 2
    return curvature


def _over_neighbours(values: Float[np.ndarray, "my mx"]) -> Float[np.ndarray, "my mx"]:
    """The mean over 3 x 3 values, without [0, 0] but in its own."""
    padded = np.pad(values, 1, mode="reflect")
    padded[1, 1] = np.mean([values[0, 1], values[1, 0]])
    ny, nx = values.shape
    return np.mean([padded[y : y + ny, x : x + nx] for y in range(3) for x in range(3)], axis=0)
