"""How sure a fit is of its heights: standard deviations from the normal matrix, by samples or by a dense inverse."""

import dataclasses
import time
from collections.abc import Callable
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
from .history import Draws
from .linearise import can_be_linearised
from .normal_matrix import NormalMatrix
from .problem import Problem
from .quadratic import is_sparse
from .residuals import linearised, picture_residuals, prior_residuals
from .robust import influence_function, robust_weight
from .solvers import count_unknowns
from .view import KNOWN

_INNER_TOLERANCE = 1e-6
EXACT_UNKNOWNS = 4096
"""Up to so many unknowns the normal matrix is inverted where "exact" is asked for: 128 MiB, some 10 s."""
EXACT_ENTRIES = 2**24
"""The same of residuals times unknowns, where J is not sparse and is formed first."""


def standard_deviations(
    unknowns: Unknowns,
    problem: Problem,
    samples: int | str,
    inner_steps: int,
    report: Callable[[Draws], None] | None = None,
) -> tuple[Float[np.ndarray, "ny nx"], int | None]:
    """The standard deviation of each height, given what the pictures and the prior say; shape (ny, nx), height units.

    The normal matrix is H = JᵀJ, J all residuals' derivative in the unknowns, weighted as the robust loss weighs
    them; its inverse is the covariance (Laplace's approximation). Albedo, exposures, offsets, lights and cameras vary
    along, so their doubt counts too. Besides, each DCT coefficient has the prior N(0, `Basis.prior_amplitude`²), and the
    albedo, each exposure and each offset N(0, 1): a direction on which no picture depends, such as the mean of all heights,
    then gets a large deviation, not an infinite one.

    Args:
      unknowns: at which the fit ended; all modes are varied.
      problem: `linearised` there, or it is here.
      samples: "exact" inverts H as a dense matrix. A number, without any dense matrix: that many x = argmin |J x - z|², z
        normal, are drawn; their covariance is H⁻¹ (Papandreou and Yuille, Gaussian sampling by local perturbations, 2010), so
        each deviation is right to 1 / √(2 · samples), however the heights are correlated.
      inner_steps: of LSMR, each, at most five times as many as in a step of the fit; only where J is not sparse, see
        `NormalMatrix`.
      report: called after each sample.

    Returns:
      The deviations; and how many samples were drawn: fewer than asked for after Ctrl-C, None for "exact".

    Raises:
      KeyboardInterrupt: Ctrl-C before there were two samples.
    """
    unknowns, problem = on_every_device((unknowns, linearised(unknowns, problem)), problem.mesh)
    matrix = NormalMatrix(unknowns, problem) if is_sparse(problem) else None
    if samples == "exact":
        variance = _exact_variance(unknowns, problem) if matrix is None else matrix.variance()
        return np.sqrt(np.asarray(variance)), None
    total, drawn, count = np.zeros(problem.basis.crop(np.asarray(problem.basis.base)).shape), 0, int(samples)
    begin = time.perf_counter()
    try:
        while drawn < count:
            draw = _draw_by_lsmr(unknowns, problem, drawn, 5 * inner_steps) if matrix is None else matrix.draw(drawn)
            total, drawn = total + draw * draw, drawn + 1
            if report is not None:
                seconds = time.perf_counter() - begin
                report(Draws(drawn, count, seconds, seconds / drawn * (count - drawn)))
    except KeyboardInterrupt:
        if drawn < 2:
            raise
    return np.sqrt(total / drawn), drawn


def with_unexplained(problem: Problem, residuals: Float[np.ndarray, " n"]) -> tuple[Problem, float]:
    """The problem with the noise that its residuals bear out, and the factor on the noise, at least 1.

    An M-estimate's covariance is f² (JᵀWJ)⁻¹, with f² = N / (N - p) · mean(ψ²) · mean(w) / mean(ψ')² over the N residuals r in
    units of the noise, ψ = ρ', w = ψ / r, p unknowns (Huber, Robust statistics, 1981, section 7.6; for least squares it is
    chi2 by degree of freedom, Birge's ratio squared, Physical Review 40, 207, 1932). The noise is multiplied by f, the scale of
    the loss divided, so that W stays; the prior keeps its own deviations.

    Args:
      problem: of the fit.
      residuals: of the pictures, in units of the noise, without those of a background that is explained.
    """
    if len(residuals) == 0:
        return problem, 1.0
    influence = influence_function(jnp.asarray(residuals), problem.loss, problem.loss_scale)
    psi, slope, weight = map(np.asarray, influence)
    free = max(1 - problem.basis.crop(np.asarray(problem.basis.base)).size / len(residuals), 0.5)
    factor = float(np.sqrt(np.mean(psi**2) * np.mean(weight) / np.mean(slope) ** 2 / free))
    if not factor > 1:
        return problem, 1.0
    scale = None if problem.loss_scale is None else problem.loss_scale / factor
    return dataclasses.replace(problem.with_noise(factor * problem.noise), loss_scale=scale), factor


def require_small(unknowns: Unknowns, problem: Problem) -> None:
    """Raises ValueError where "exact" would make a matrix above `EXACT_UNKNOWNS` or `EXACT_ENTRIES`."""
    count = count_unknowns(unknowns)
    if unknowns.albedo is None and all(can_be_linearised(group.scenes, problem.settings) for group in problem.groups):
        if count > EXACT_UNKNOWNS:
            rule = f"'exact' takes at most {EXACT_UNKNOWNS} unknowns, there are {count}; give a number of samples"
            raise ArgumentError("fit", "uncertainty", rule)
        return
    rows = sum(group.targets.size for group in problem.groups) + 4 * problem.basis.base.size
    if (entries := rows * count) > EXACT_ENTRIES:
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


def _draw_by_lsmr(unknowns: Unknowns, problem: Problem, seed: int, steps: int) -> Float[np.ndarray, "ny nx"]:
    return np.asarray(_draw(unknowns, problem, jax.random.key(seed), steps), np.float64)


@eqx.filter_jit
def _draw(unknowns: Unknowns, problem: Problem, key: PRNGKeyArray, steps: int) -> Float[Array, "ny nx"]:
    operator, structure = _operator(unknowns, problem)
    leaves, tree = jax.tree.flatten(structure)
    keys = jax.random.split(key, len(leaves))
    z = jax.tree.unflatten(tree, [jax.random.normal(k, leaf.shape, leaf.dtype) for k, leaf in zip(keys, leaves, strict=True)])
    # A share of the matrix's Frobenius norm, far above what a height changes that no picture shows. In balanced units it leaves
    # an error below a hundredth in a sample. With 1e-5 heights that pictures show had one of 2 to 5 %, others 20 %.
    solver = lx.LSMR(rtol=_INNER_TOLERANCE, atol=0.0, max_steps=steps, conlim=1e16)
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
