"""How sure a fit is of its heights: standard deviations from the normal matrix, by samples or by a dense inverse."""

import dataclasses
import math
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp
import lineax as lx
import numpy as np
import scipy.optimize
from jax import lax
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from ..core.errors import ArgumentError
from ..xla.devices import on_every_device
from .basis import Unknowns
from .history import Draws
from .jacobian import in_rows
from .normal_matrix import NormalMatrix
from .problem import Problem
from .quadratic import is_sparse
from .residuals import linearised, picture_residuals, prior_residuals
from .robust import influence_function, robust_weight
from .solvers import count_unknowns
from .view import KNOWN

_INNER_TOLERANCE = 1e-6
_SIMULATED = 20  # draws by which a displacement of boundaries is estimated, at most
EXACT_UNKNOWNS = 4096
"""Up to so many unknowns the normal matrix is inverted where "exact" is asked for: 128 MiB, some 10 s."""
EXACT_ENTRIES = 2**24
"""The same of residuals times unknowns, where J is not sparse and is formed first."""


class Deviations(NamedTuple):
    """See `standard_deviations`.

    Attributes:
      std: shape (ny, nx), height units.
      drawn: how many samples were drawn: fewer than asked for after Ctrl-C, None for "exact".
      displacement: τ of `_Boundaries`, height units; 0 where residuals are as small as the noise says.
      raised: by which factor, root mean square, that made the deviations larger.
    """

    std: Float[np.ndarray, "ny nx"]
    drawn: int | None
    displacement: float = 0.0
    raised: float = 1.0


def standard_deviations(
    unknowns: Unknowns,
    problem: Problem,
    samples: int | str,
    inner_steps: int,
    report: Callable[[Draws], None] | None = None,
) -> Deviations:
    """The standard deviation of each height, given what the pictures and the prior say.

    The normal matrix is H = JᵀJ, J all residuals' derivative in the unknowns, weighted as the robust loss weighs
    them; its inverse is the covariance (Laplace's approximation). Albedo, exposures, offsets, lights and cameras vary
    along, so their doubt counts too. Besides, each DCT coefficient has the prior N(0, `Basis.prior_amplitude`²), and the
    albedo, each exposure and each offset N(0, 1): a direction on which no picture depends, such as the mean of all heights,
    then gets a large deviation, not an infinite one. Where pictures bear it out, boundaries are displaced, see `_Boundaries`.

    Args:
      unknowns: at which the fit ended; all modes are varied.
      problem: `linearised` there, or it is here.
      samples: "exact" inverts H as a dense matrix. A number, without any dense matrix: that many x = argmin |J x - z|², z
        normal, are drawn; their covariance is H⁻¹ (Papandreou and Yuille, Gaussian sampling by local perturbations, 2010), so
        each deviation is right to 1 / √(2 · samples), however the heights are correlated.
      inner_steps: of LSMR, each, at most five times as many as in a step of the fit; only where J is not sparse, see
        `NormalMatrix`.
      report: called after each sample.

    Raises:
      KeyboardInterrupt: Ctrl-C before there were two samples, or one of displaced boundaries.
    """
    unknowns, problem = on_every_device((unknowns, linearised(unknowns, problem)), problem.mesh)
    matrix = NormalMatrix(unknowns, problem) if is_sparse(problem) else None
    scale = np.inf if problem.loss_scale is None else float(problem.loss_scale)
    boundaries = None if matrix is None else _Boundaries(matrix, _on_boundaries(problem), scale)
    total, drawn, count = np.zeros(problem.basis.crop(np.asarray(problem.basis.base)).shape), 0, 0
    if samples == "exact":
        total = np.asarray(_exact_variance(unknowns, problem) if matrix is None else matrix.variance())
    else:
        count = int(samples)
    begin = time.perf_counter()
    try:
        while drawn < count:
            if matrix is None or boundaries is None:
                draw = _draw_by_lsmr(unknowns, problem, drawn, 5 * inner_steps)
            else:
                draw, left = matrix.draw(drawn)
                boundaries.keep(left)
            total, drawn = total + draw * draw, drawn + 1
            if report is not None:
                seconds = time.perf_counter() - begin
                report(Draws(drawn, count, seconds, seconds / drawn * (count - drawn)))
    except KeyboardInterrupt:
        if drawn < 2:
            raise
    variance, displacement, more = total / max(drawn, 1), 0.0, 0.0
    if boundaries is not None:
        displacement, more = boundaries.variance()
    raised = float(np.sqrt(np.mean(variance + more) / np.mean(variance)))
    return Deviations(np.sqrt(variance + more), None if samples == "exact" else drawn, displacement, raised)


class _Boundaries:
    """How far boundaries are off in the pictures: shadows and silhouettes, as if the heights that make them were displaced.

    Pixels that a boundary crosses tell heights to a hundredth of a pixel, if both pictures have it in the same place. Other
    renderers begin shadow rays beside the surface, the sun is a disk, ground is no triangles; and heights that a few such
    pixels decide on explain them, right or wrong. So the noise of such a pixel has the variance 1 + τ² D, with D its squared
    derivative in heights, in units of the noise, and τ a deviation in height units that all pictures share. τ is that for
    which Σ D / s² min(r / s, k)², s² = 1 + τ² D, is for the residuals r what it is on average for those that a fit would leave
    of such noise (simulated, so that those are small which heights explain); k is the scale of the robust loss. That is the
    equation of restricted maximum likelihood for a variance component, made robust by Huber's proposal 2 (Richardson and
    Welsh, Biometrics 51, 1429, 1995). Heights were fitted without τ, so their covariance is H⁻¹ Jᵀ diag(s²) J H⁻¹.
    """

    def __init__(self, matrix: NormalMatrix, rows: Bool[np.ndarray, " rows"], loss_scale: float):
        self.matrix, reach = matrix, matrix.reach()
        self.rows = np.flatnonzero(rows & (reach > 0))
        self.reach = reach[self.rows]
        self.most = loss_scale**2
        self.left: list[np.ndarray] = []  # of simulated noise, on these rows

    def keep(self, left: Float[np.ndarray, " rows"]) -> None:
        if len(self.left) < _SIMULATED:
            self.left.append(left[self.rows])

    def variance(self) -> tuple[float, Float[np.ndarray, "ny nx"] | float]:
        """τ, and what it adds to the variance of each height."""
        if self.rows.size == 0:
            return 0.0, 0.0
        for seed in range(0 if self.left else _SIMULATED):  # for "exact"
            self.keep(self.matrix.draw(seed)[1])
        residuals = self.matrix.residuals[self.rows]
        if self._size(residuals, 0.0) <= self._mean_size(self.left, 0.0):
            return 0.0, 0.0
        heights, moved = [], []
        try:
            for seed in range(len(self.left)):
                noise = np.zeros(self.matrix.roots.size)
                noise[self.rows] = self.reach * np.random.default_rng((seed, 1)).standard_normal(self.rows.size)
                change, left = self.matrix.response(noise)
                moved.append(left[self.rows])
                heights.append(change)
        except KeyboardInterrupt:
            if not heights:
                raise

        def excess(log: float) -> float:
            tau = math.exp(log)
            both = [one + tau * other for one, other in zip(self.left, moved, strict=False)]
            return float(np.log(self._size(residuals, tau) / self._mean_size(both, tau)))

        # From where it makes a hundredth of the noise of the pixel that changes most to where it is all noise in each.
        low, high = np.log(0.01 / self.reach.max()), np.log(100 / self.reach.min())
        found: Any = scipy.optimize.brentq(excess, low, high, xtol=0.01) if excess(low) > 0 > excess(high) else low
        tau = math.exp(found)
        return tau, tau**2 * np.mean(np.square(heights), axis=0)

    def _size(self, residuals: Float[np.ndarray, " n"], tau: float) -> float:
        variance = 1 + (tau * self.reach) ** 2
        return float(np.sum(self.reach**2 / variance * np.minimum(residuals**2 / variance, self.most)))

    def _mean_size(self, drawn: Sequence[Float[np.ndarray, " n"]], tau: float) -> float:
        return float(np.mean([self._size(residuals, tau) for residuals in drawn]))


def _on_boundaries(problem: Problem) -> Bool[np.ndarray, " rows"]:
    """Which values of the pictures, in the order of `in_rows`, are of pixels that a boundary crosses."""
    masks = []
    for group, known in zip(problem.groups, problem.linearised or (), strict=True):
        mask = np.zeros(group.targets.shape, bool)
        if known.edges is not None:
            for picture, pixels in zip(mask, np.asarray(known.edges.resampled), strict=True):
                picture.reshape(-1, picture.shape[-1])[pixels] = True
        masks.append(mask)
    return in_rows(masks) > 0


def with_unexplained(problem: Problem, residuals: Float[np.ndarray, " n"], free: float | None = None) -> tuple[Problem, float]:
    """The problem with the noise that its residuals bear out, and the factor on the noise, at least 1.

    An M-estimate's covariance is f² (JᵀWJ)⁻¹, with f² = N / (N - p) · mean(ψ²) · mean(w) / mean(ψ')² over the N residuals r in
    units of the noise, ψ = ρ', w = ψ / r, p unknowns (Huber, Robust statistics, 1981, section 7.6; for least squares it is
    chi2 by degree of freedom, Birge's ratio squared, Physical Review 40, 207, 1932). The noise is multiplied by f, the scale of
    the loss divided, so that W stays; the prior keeps its own deviations.

    Args:
      problem: of the fit.
      residuals: of the pictures, in units of the noise, without those of a background that is explained.
      free: (N - p) / N, see `Freedom`; None: p is how many heights there are.
    """
    if len(residuals) == 0:
        return problem, 1.0
    influence = influence_function(jnp.asarray(residuals), problem.loss, problem.loss_scale)
    psi, slope, weight = map(np.asarray, influence)
    heights = problem.basis.crop(np.asarray(problem.basis.base)).size
    share = max(1 - heights / len(residuals), 0.5) if free is None else free
    factor = float(np.sqrt(np.mean(psi**2) * np.mean(weight) / np.mean(slope) ** 2 / share))
    if not factor > 1:
        return problem, 1.0
    scale = None if problem.loss_scale is None else problem.loss_scale / factor
    return dataclasses.replace(problem.with_noise(factor * problem.noise), loss_scale=scale), factor


def require_small(unknowns: Unknowns, problem: Problem) -> None:
    """Raises ValueError where "exact" would make a matrix above `EXACT_UNKNOWNS` or `EXACT_ENTRIES`."""
    count = count_unknowns(unknowns)
    if unknowns.albedo is None and problem.can_be_linearised:
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
