"""How sure a fit is of its heights: standard deviations from the Gauss-Newton matrix, by samples or by a dense inverse."""

from typing import Any

import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jax import lax
from jaxtyping import Array, Float, PRNGKeyArray

from ..core.devices import on_every_device
from ..core.errors import ArgumentError
from .basis import Unknowns
from .problem import Problem
from .residuals import linearised, picture_residuals, prior_residuals
from .robust import robust_weight
from .view import KNOWN

EXACT_ENTRIES = 2**24
"""Up to so many residuals times unknowns the matrix is formed where "exact" is asked for: 128 MiB in double precision."""


def standard_deviations(
    unknowns: Unknowns, problem: Problem, samples: int | str, inner_steps: int
) -> Float[np.ndarray, "ny nx"]:
    """The standard deviation of each height, given what the pictures and the prior say; shape (ny, nx), height units.

    The Gauss-Newton matrix is H = JᵀJ, J all residuals' derivative in the unknowns, weighted as the robust loss weighs
    them; its inverse is the covariance (Laplace's approximation). Albedo, exposures, offsets, lights and cameras vary
    along, so their doubt counts too. Besides, each DCT coefficient has the prior N(0, `Basis.prior_amplitude`²), and the
    albedo, each exposure and each offset N(0, 1): a direction on which no picture depends, such as the mean of all heights,
    then gets a large deviation, not an infinite one.

    Args:
      samples: "exact" forms J as a dense matrix and inverts H. A number, without any dense matrix: that many
        x = argmin |J x - z|², z normal, are drawn; their covariance is H⁻¹ (Papandreou and Yuille, Gaussian sampling by local
        perturbations, 2010), so each deviation is right to 1 / √(2 · samples), however the heights are correlated.
      inner_steps: of LSMR, each; five times as many as in a step of the fit are allowed.
    """
    unknowns, problem = on_every_device((unknowns, linearised(unknowns, problem)), problem.mesh)
    if samples == "exact":
        return np.sqrt(np.asarray(_exact_variance(unknowns, problem)))
    total = np.zeros(problem.basis.crop(problem.basis.base).shape)
    for k in range(int(samples)):
        draw = np.asarray(_draw(unknowns, problem, jax.random.key(k), 5 * inner_steps), np.float64)
        total += draw * draw
    return np.sqrt(total / int(samples))


def require_small(unknowns: Unknowns, problem: Problem) -> None:
    """Raises ValueError where "exact" would make a matrix above `EXACT_ENTRIES`."""
    rows = sum(group.targets.size for group in problem.groups) + 4 * problem.basis.base.size
    entries = rows * sum(leaf.size for leaf in jax.tree.leaves(unknowns))
    if entries > EXACT_ENTRIES:
        raise ArgumentError(
            "fit",
            "uncertainty",
            f"'exact' takes at most {EXACT_ENTRIES} residuals times unknowns, they are {entries}; give a number of samples",
        )


def _operator(unknowns: Unknowns, problem: Problem) -> tuple[lx.AbstractLinearOperator, Any]:
    """J of all residuals and of the priors of the unknowns, and the structure of its products."""
    parts, pictures = jax.linearize(lambda u: picture_residuals(u, problem), unknowns)
    _, prior = jax.linearize(lambda u: prior_residuals(u, problem), unknowns)
    roots = [jnp.sqrt(robust_weight(part, problem.loss, problem.loss_scale)) for part in parts]

    def normalised(change: Unknowns) -> Unknowns:
        change = eqx.tree_at(lambda change: change.view, change, KNOWN)  # which has a prior of its own
        return eqx.tree_at(lambda change: change.coefficients, change, change.coefficients / problem.basis.prior_amplitude)

    def product(change: Unknowns) -> Any:
        return [root * part for root, part in zip(roots, pictures(change), strict=True)], prior(change), normalised(change)

    operator = lx.FunctionLinearOperator(product, jax.eval_shape(lambda: unknowns))
    return operator, operator.out_structure()


@eqx.filter_jit
def _draw(unknowns: Unknowns, problem: Problem, key: PRNGKeyArray, steps: int) -> Float[Array, "ny nx"]:
    operator, structure = _operator(unknowns, problem)
    leaves, tree = jax.tree.flatten(structure)
    keys = jax.random.split(key, len(leaves))
    z = jax.tree.unflatten(tree, [jax.random.normal(k, leaf.shape, leaf.dtype) for k, leaf in zip(keys, leaves, strict=True)])
    # Its tolerance is a share of the matrix's Frobenius norm, far above what a height changes that no picture shows.
    solver = lx.LSMR(rtol=1e-7, atol=0.0, max_steps=steps, conlim=1e16)
    change = lx.linear_solve(operator, z, solver, throw=False).value
    return _height_change(problem, change.coefficients)


@eqx.filter_jit
def _exact_variance(unknowns: Unknowns, problem: Problem) -> Float[Array, "ny nx"]:
    operator = _operator(unknowns, problem)[0]
    flat, unflat = jax.flatten_util.ravel_pytree(unknowns)

    # One after the other: all at once they would take room for every sample of the pictures, not for every residual.
    def column(_: None, k: jax.Array) -> tuple[None, Array]:
        change = operator.mv(unflat(jnp.zeros_like(flat).at[k].set(1)))
        return None, jnp.concatenate([leaf.ravel() for leaf in jax.tree.leaves(change)])

    matrix = lax.scan(column, None, jnp.arange(flat.size))[1].T
    n = unknowns.coefficients.size
    # QᵀQ = 1 of J = QR leaves (JᵀJ)⁻¹ = R⁻¹R⁻ᵀ; coefficients are the first of the unknowns.
    root = jnp.linalg.qr(matrix, mode="r")
    inverse = jax.scipy.linalg.solve_triangular(root, jnp.eye(root.shape[0], dtype=root.dtype))
    scale, rows, columns = problem.basis.scale, problem.basis.rows, problem.basis.columns
    modes = (rows[:, None, :, None] * columns[None, :, None, :] * scale[:, :, None, None]).reshape(n, -1)
    spread = jnp.matmul(modes.T, inverse[:n], precision=lax.Precision.HIGHEST)
    return problem.basis.crop(jnp.sum(spread * spread, axis=1).reshape(problem.basis.base.shape))


def _height_change(problem: Problem, coefficients: Float[Array, "my mx"]) -> Float[Array, "ny nx"]:
    return problem.basis.heights(coefficients) - problem.basis.crop(problem.basis.base)
