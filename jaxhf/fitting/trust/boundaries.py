"""How far boundaries are off in the measured pictures."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import scipy.optimize
from jaxtyping import Bool, Float

from ..model.expansion import Expansion
from ..model.normal_matrix import in_row

_SIMULATED = 20  # draws by which a displacement is estimated, at most


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
