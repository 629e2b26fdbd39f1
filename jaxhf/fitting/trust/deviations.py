"""How sure a fit is of its heights: standard deviations by draws from the normal distribution about them."""

import dataclasses
import math
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy.optimize
from jaxtyping import Bool, Float

from ..given import Draws
from ..model.expansion import Expansion, influence_function
from ..model.normal_matrix import Residuals, in_row, robust_matrix

_TOLERANCE = 1e-5  # of a draw's linear problem; the draw is then right to a thousandth
_NEAR_TOLERANCE = 1e-4  # the same, with an inverse that is near
_SIMULATED = 20  # draws by which a displacement of boundaries is estimated, at most


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
    psi, slope, weight = influence_function(residuals, problem.loss_scale)
    share = max(1 - problem.field.heights.size / len(residuals), 0.5) if free is None else free
    factor = float(np.sqrt(np.mean(psi**2) * np.mean(weight) / np.mean(slope) ** 2 / share))
    if not factor > 1:
        return expansion, 1.0
    wider = dataclasses.replace(problem, loss_scale=problem.loss_scale / factor)
    return expansion.of(wider).with_noise(factor * problem.noise), factor


class Boundaries:
    """How far boundaries are off in the pictures: shadows and silhouettes, as if the heights that make them were displaced.

    Pixels that a boundary crosses tell heights to a hundredth of a pixel, if both pictures have it in the same place. Other
    renderers begin shadow rays beside the surface, the sun is a disk, ground is no triangles; and heights that a few such
    pixels decide on explain them, right or wrong. So the noise of such a pixel has the variance 1 + τ² D, with D its squared
    derivative in heights, in units of the noise, and τ a deviation in height units that all pictures share. τ is that for
    which Σ D / s² min(r / s, k)², s² = 1 + τ² D, is for the residuals r what it is on average for those that a fit would leave
    of such noise (simulated, so that those are small which heights explain); k is the scale of the robust loss. That is the
    equation of restricted maximum likelihood for a variance component, made robust by Huber's proposal 2 (Richardson and
    Welsh, Biometrics 51, 1429, 1995). Heights were fitted without τ, so their covariance is H⁻¹ Jᵀ diag(s²) J H⁻¹.

    `rows`: `pictures_by_heights` of the expansion.
    """

    def __init__(self, expansion: Expansion, rows: Any):
        reach = np.sqrt(np.asarray(rows.power(2).sum(axis=1)).ravel())
        self.rows = np.flatnonzero(_on_boundaries(expansion) & (reach > 0))
        self.reach, self.size = reach[self.rows], reach.size
        self.residuals = in_row(expansion.left())[self.rows]
        self.most = float(expansion.problem.loss_scale) ** 2
        self.left: list[np.ndarray] = []  # of simulated noise, on these rows

    def keep(self, left: Float[np.ndarray, " rows"]) -> None:
        """Takes what a fit would leave of noise in the pictures."""
        if len(self.left) < _SIMULATED:
            self.left.append(left[self.rows])

    def displacements(
        self, response: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
    ) -> tuple[float, list[Float[np.ndarray, "ny nx"]]]:
        """τ, and draws of what that makes of the heights; none where it is 0. `response` takes an error of the pictures, in
        units of their noise, to that of the heights and to what is left of it."""
        if self.rows.size == 0 or self._size(self.residuals, 0.0) <= self._mean_size(self.left, 0.0):
            return 0.0, []
        heights, moved = [], []
        try:
            for seed in range(len(self.left)):
                noise = np.zeros(self.size)
                noise[self.rows] = self.reach * np.random.default_rng((seed, 1)).standard_normal(self.rows.size)
                change, left = response(noise)
                moved.append(left[self.rows])
                heights.append(change)
        except KeyboardInterrupt:
            if not heights:
                raise

        def excess(log: float) -> float:
            tau = math.exp(log)
            both = [one + tau * other for one, other in zip(self.left, moved, strict=False)]
            return float(np.log(self._size(self.residuals, tau) / self._mean_size(both, tau)))

        # From where it makes a hundredth of the noise of the pixel that changes most to where it is all noise in each.
        low, high = np.log(0.01 / self.reach.max()), np.log(100 / self.reach.min())
        found: Any = scipy.optimize.brentq(excess, low, high, xtol=0.01) if excess(low) > 0 > excess(high) else low
        tau = math.exp(found)
        return tau, [tau * change for change in heights]

    def _size(self, residuals: Float[np.ndarray, " n"], tau: float) -> float:
        variance = 1 + (tau * self.reach) ** 2
        return float(np.sum(self.reach**2 / variance * np.minimum(residuals**2 / variance, self.most)))

    def _mean_size(self, drawn: Sequence[Float[np.ndarray, " n"]], tau: float) -> float:
        return float(np.mean([self._size(residuals, tau) for residuals in drawn]))


def _on_boundaries(expansion: Expansion) -> Bool[np.ndarray, " rows"]:
    """Which values of the pictures are of pixels that a boundary crosses."""
    masks = []
    for group, known in zip(expansion.problem.groups, expansion.linearised, strict=True):
        mask = np.zeros(group.targets.shape, bool)
        if known is not None and known.edges is not None:
            for picture, pixels in zip(mask, np.asarray(known.edges.resampled), strict=True):
                picture.reshape(-1, picture.shape[-1])[pixels] = True
        masks.append(mask)
    return in_row(masks) > 0
