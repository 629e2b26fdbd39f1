"""Units of the modes of a surface in which the loss of a fit has the same curvature along each of them."""

from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from .expansion import Expansion
from .problem import Problem
from .surface import slope_units

# As a share of the median: along a mode of less curvature the loss counts as flat, and its unit stays as it is.
_LEAST_CURVATURE = 1e-6


def balanced(expansion: Expansion) -> tuple[Float[np.ndarray, "my mx"], float, Any]:
    """The units of the modes, see `Basis.scale`, in which the loss has the same curvature along each of them, that curvature,
    and by how much more it is curved along each number of the other unknowns: a tree as these."""
    problem, unknowns = expansion.problem, expansion.unknowns
    slopes, _ = slope_units(problem.basis.base.shape, problem.field.dx, problem.field.dy)
    gradients, of_others = expansion.random_gradients()
    modes, curvature = _balanced_units(slopes, mode_curvature(problem, gradients))
    others = []
    for (term, values), *draws in zip(problem.terms.others(unknowns), *map(jax.tree.leaves, of_others), strict=True):
        # Of one kind and one place in each picture, as its light's first angle, or of all texels: few draws tell little more.
        squares = np.mean(np.square(draws, dtype=np.float64), axis=0)
        along = tuple(range(squares.ndim)) if squares.ndim != 2 else 0
        total = np.broadcast_to(squares.mean(axis=along, keepdims=True), squares.shape)
        total = total + np.asarray(term.weight, np.float64) ** 2
        others.append(np.asarray(np.maximum(total / curvature, _LEAST_CURVATURE), values.dtype))
    return modes, curvature, jax.tree.unflatten(jax.tree.structure(unknowns.without_modes()), others)


def _balanced_units(
    units: Float[np.ndarray, "my mx"], curvature: Float[np.ndarray, "my mx"]
) -> tuple[Float[np.ndarray, "my mx"], float]:
    """Units of the modes in which the loss has the same curvature along each of them, and that curvature.

    It is the median of those in units of one slope. Along the mean of all heights, which pictures hardly show, the curvature in
    units of one slope is ten thousand times less than along other modes. `units`: `slope_units`; `curvature`: of the loss, for
    modes of unit height, 0 where it is unknown.
    """
    per_slope = curvature * units**2
    if not (per_slope > 0).any():
        return units, 1.0
    typical = float(np.median(per_slope[per_slope > 0]))
    relative = per_slope / typical
    return units / np.sqrt(np.where(relative > _LEAST_CURVATURE, relative, 1)), typical


def mode_curvature(problem: Problem, gradients: Float[np.ndarray, "k ny nx"]) -> Float[np.ndarray, "my mx"]:
    """The curvature of the loss along each DCT mode of unit height.

    That of the pictures, the diagonal of JᵀJ, is the mean square of the `random_gradients` Jᵀz over draws of z, and over
    neighbouring modes; in that of the prior, weights count by their mean square.
    """
    basis, term = problem.basis, problem.terms.surface
    rows, columns = np.asarray(basis.rows, np.float64), np.asarray(basis.columns, np.float64)
    padding = [(n, n) for n in basis.padding]
    squares = np.mean([(rows @ np.pad(gradient, padding) @ columns.T) ** 2 for gradient in gradients], axis=0)
    curvature = _over_neighbours(squares)
    curvature[0, 0] = squares[0, 0]  # unlike any other
    weight = float(np.mean(np.square(np.asarray(term.weight, np.float64))))
    return curvature + weight * np.asarray(term.spectrum, np.float64) ** 2


def _over_neighbours(values: Float[np.ndarray, "my mx"]) -> Float[np.ndarray, "my mx"]:
    """The mean over 3 x 3 values, without [0, 0] but in its own."""
    padded = np.pad(values, 1, mode="reflect")
    padded[1, 1] = np.mean([values[0, 1], values[1, 0]])
    ny, nx = values.shape
    return np.mean([padded[y : y + ny, x : x + nx] for y in range(3) for x in range(3)], axis=0)
