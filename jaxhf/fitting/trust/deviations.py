"""How sure a fit is of its heights: standard deviations by draws from the normal distribution about them."""

import dataclasses
import time
from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..history import Draws
from ..model.expansion import Expansion
from ..model.near_inverse import robust_matrix
from ..model.normal_matrix import Residuals
from ..model.robust import influence_function
from .boundaries import Boundaries

_TOLERANCE = 1e-5  # of a draw's linear problem; the draw is then right to a thousandth
_NEAR_TOLERANCE = 1e-4  # the same, with an inverse that is near


class Deviations(NamedTuple):
    """Draws of the heights' errors, height units, fewer than asked for after Ctrl-C; τ of `Boundaries`, 0 where residuals are
    as small as the noise says; and by which factor, root mean square, that made the deviations larger."""

    samples: Float[np.ndarray, "draws ny nx"]
    displacement: float
    raised: float

    @property
    def std(self) -> Float[np.ndarray, "ny nx"]:
        """The standard deviation of each height, height units."""
        return np.sqrt(np.mean(self.samples**2, axis=0))

    @property
    def parts(self) -> tuple[float, float]:
        """The standard deviations of the mean of all heights and, root mean square, of the heights about that mean."""
        means = self.samples.mean(axis=(1, 2))
        return float(np.sqrt(np.mean(means**2))), float(np.sqrt(np.mean((self.samples - means[:, None, None]) ** 2)))


def standard_deviations(expansion: Expansion, count: int, report: Callable[[Draws], None] | None = None) -> Deviations:
    """The standard deviation of each height, given what the pictures and the prior say.

    The normal matrix is H = JᵀJ, J all residuals' derivative in the unknowns, weighted as the robust loss weighs them; its
    inverse is the covariance (Laplace's approximation). Albedo, exposures, offsets, lights and cameras vary along, so their
    doubt counts too. Draws x = H⁻¹ Jᵀz, z normal, have that covariance (Papandreou and Yuille, Gaussian sampling by local
    perturbations, NIPS 2010, section 3), so each deviation is right to 1 / √(2 · count), however the heights are correlated.
    Where pictures bear it out, boundaries are displaced, see `Boundaries`. All modes of the expansion are varied.

    Raises:
      KeyboardInterrupt: Ctrl-C before there were two draws, or one of displaced boundaries.
    """
    matrix = robust_matrix(expansion)
    boundaries, tolerance = (None, _TOLERANCE) if matrix.rows is None else (Boundaries(expansion, matrix.rows), _NEAR_TOLERANCE)
    changes, begin = [], time.perf_counter()
    try:
        while len(changes) < count:
            noise = matrix.drawn(len(changes))
            change = matrix.solved(matrix.gathered(noise), tolerance)
            if boundaries is not None:
                boundaries.keep(noise.pictures - matrix.seen(change))
            changes.append(matrix.heights_of(change))
            if report is not None:
                seconds, drawn = time.perf_counter() - begin, len(changes)
                report(Draws(drawn, count, seconds, seconds / drawn * (count - drawn)))
    except KeyboardInterrupt:
        if len(changes) < 2:
            raise
    before, displacement = np.stack(changes), 0.0
    samples = before
    if boundaries is not None:

        def response(error: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            alone = Residuals(matrix.roots * error, np.zeros(matrix.shape), np.zeros_like(matrix.others_weight))
            change = matrix.solved(matrix.gathered(alone), tolerance)
            return matrix.heights_of(change), error - matrix.seen(change) / matrix.roots

        displacement, moved = boundaries.displacements(response)
        if moved:
            samples = before + np.stack([moved[k % len(moved)] for k in range(len(before))])
    return Deviations(samples, displacement, float(np.sqrt(np.mean(samples**2) / np.mean(before**2))))


def with_unexplained(
    expansion: Expansion, residuals: Float[np.ndarray, " n"], free: float | None = None
) -> tuple[Expansion, float]:
    """The expansion with the noise that its residuals bear out, and the factor on the noise, at least 1.

    An M-estimate's covariance is f² (JᵀWJ)⁻¹, with f² = N / (N - p) · mean(ψ²) · mean(w) / mean(ψ')² over the N residuals r in
    units of the noise, ψ = ρ', w = ψ / r, p unknowns (Huber, Robust statistics, 1981, section 7.6; for least squares it is
    chi2 by degree of freedom, Birge's ratio squared, Physical Review 40, 207, 1932). The noise is multiplied by f, the scale of
    the loss divided, so that W stays; the prior keeps its own deviations. A background that is explained has no part in the
    residuals. `free`: (N - p) / N, see `Freedom`; None: p is how many heights there are.
    """
    problem = expansion.problem
    if len(residuals) == 0:
        return expansion, 1.0
    psi, slope, weight = map(np.asarray, influence_function(jnp.asarray(residuals), problem.loss_scale))
    share = max(1 - problem.field.heights.size / len(residuals), 0.5) if free is None else free
    factor = float(np.sqrt(np.mean(psi**2) * np.mean(weight) / np.mean(slope) ** 2 / share))
    if not factor > 1:
        return expansion, 1.0
    wider = dataclasses.replace(problem, loss_scale=problem.loss_scale / factor)
    return expansion.of(wider).with_noise(factor * problem.noise), factor
