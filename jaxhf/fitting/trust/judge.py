"""What a fit's end is worth: what its pictures leave unexplained, how sure its heights are, and what speaks against them."""

import dataclasses
import math
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import scipy.optimize
from jaxtyping import Bool, Float

from ...core.errors import counted
from ...core.settings import Settings
from ...core.types import AnyArray
from ...scene.record import number, span
from ...scene.scene import Scene
from ..given import Draws, Given, Step, Stop
from ..model.expansion import Expansion, found_scenes, influence_function
from ..model.normal_matrix import Residuals, in_row, robust_matrix
from ..solve.noise import Freedom, Restricted, explains_noise
from ..solve.run import Ended
from . import facts
from .words import FAR_FROM_ONE, Findings, Region, warnings, where_residuals_are, worst_regions

_TOLERANCE = 1e-5  # of a draw's linear problem; the draw is then right to a thousandth
_NEAR_TOLERANCE = 1e-4  # the same, with an inverse that is near
_SIMULATED = 20  # draws by which a displacement of boundaries is estimated, at most
_OFF = 3.0  # standard deviations of the noise by which a background must be off to count


@dataclasses.dataclass(frozen=True, eq=False)
class Fit:
    """What `fit` found.

    Attributes:
      heights: shape (ny, nx), in the dtype of the scenes' heights.
      result: why it stopped.
      std: standard deviation of each height, shape (ny, nx); infinite where nothing says anything about it. None where no
        draws were asked for.
      samples: terrains that pictures and prior allow, one for each draw, shape (draws, ny, nx): what is derived from each, a
        slope or a volume, varies as it is unsure. None as `std`.
      seen: whether a change of the height would change any picture, shape (ny, nx).
      albedo: what the albedo of the scenes is to be multiplied by, shape (ty, tx, c), c = 1 where all channels share it;
        None where it was known.
      exposures, offsets: of each picture; None where they were known.
      noise: standard deviation of each picture's values at weight 1, shape (pictures,): as given, or as estimated. Of a
        `Noise` it is the root mean square over the values that count.
      scenes: as they were given, with all that was found: heights, albedo, lights and cameras.
      settings: those that were given, with all that was chosen: `render` with them makes `images` of `scenes`, but for the
        pixels that a boundary crosses, which have more samples in a fit.
      images: the pictures as they would be measured, (h, w) or (h, w, c) each, as their targets.
      residuals: `images` - targets; 0 where a target has no weight.
      regions: the three blocks of the pictures with the largest residuals.
      warnings: what speaks against trusting the heights, a sentence each; empty where nothing does.
      stats: steps, accepted, seconds, loss; chi2, the mean square of the pictures' residuals, by degree of freedom, in units of
        `noise` and the error of their samples, without a background that is explained: about 1 where `noise` is right and all
        is explained.
      history: a `Step` for each step.
    """

    heights: Float[AnyArray, "ny nx"]
    result: Stop
    std: Float[np.ndarray, "ny nx"] | None
    samples: Float[np.ndarray, "draws ny nx"] | None
    seen: Bool[np.ndarray, "ny nx"]
    albedo: Float[AnyArray, "ty tx c"] | None
    exposures: Float[AnyArray, " pictures"] | None
    offsets: Float[AnyArray, " pictures"] | None
    noise: Float[np.ndarray, " pictures"]
    scenes: tuple[Scene, ...]
    settings: Settings
    images: tuple[np.ndarray, ...]
    residuals: tuple[np.ndarray, ...]
    regions: tuple[Region, ...]
    warnings: tuple[str, ...]
    stats: dict[str, int | float]
    history: tuple[Step, ...]

    def __repr__(self) -> str:
        """In one line, without arrays."""
        ended = f"{self.result.name} after {counted(int(self.stats['steps']), 'step')}, {number(self.stats['seconds'])} s"
        said = f"chi2 {number(self.stats['chi2'])}, {counted(len(self.warnings), 'warning')}"
        return f"Fit({in_short(np.asarray(self.heights), self.std)}, {ended}, {said})"


def in_short(heights: Float[np.ndarray, "ny nx"], std: Float[np.ndarray, "ny nx"] | None) -> str:
    """Heights found, and the median of what deviations are finite: "64 x 64, heights 0.2 .. 1.4 ± 0.0125"."""
    known = np.empty(0) if std is None else std[np.isfinite(std)]
    deviation = f" ± {number(np.median(known))}" if known.size else ""
    return f"{heights.shape[0]} x {heights.shape[1]}, heights {span(heights)}{deviation}"


@np.errstate(over="ignore")  # of a fit that ended as not finite
def judged(
    ended: Ended,
    scenes: tuple[Scene, ...],
    targets: Sequence[np.ndarray],
    given: Given,
    report: Callable[..., None] | None,
) -> Fit:
    """What was found; `report` is called after each draw."""
    expansion, free = _restricted(ended, given)
    problem, left = expansion.problem, facts.left_of(expansion)
    in_noise = [picture.residual for picture in left]
    counts = [picture.informing | (np.abs(picture.residual) > _OFF) for picture in left]
    counted = np.concatenate([values[which] for values, which in zip(in_noise, counts, strict=True)]).astype(np.float64)
    regions, where = worst_regions(in_noise), where_residuals_are(in_noise, facts.boundary_places(expansion))
    chi2, share = facts.chi_squared(problem, counted, [int(which.sum()) for which in counts], free)
    gradients, _ = expansion.random_gradients()
    seen, heights = (gradients != 0).any(axis=0), np.asarray(expansion.heights, np.float64)
    std, samples, scaled, displaced, parts = None, None, None, None, None
    if given.draws and ended.stop is not Stop.NON_FINITE:
        borne_out, scaled = with_unexplained(expansion, counted, share)
        drawn = standard_deviations(borne_out, given.draws, report)
        std, samples, displaced, parts = drawn.std, heights + drawn.samples, (drawn.displacement, drawn.raised), drawn.parts
        if not problem.known:
            std = np.where(seen, std, np.inf)
    sought = expansion.unknowns
    found = found_scenes(scenes, sought, problem)
    findings = Findings(
        result=ended.stop,
        chi2=chi2,
        noise_given=given.noise is not None,
        where=where,
        regions=regions,
        help=facts.what_may_help(expansion, left, given) if chi2 > FAR_FROM_ONE else "",
        unlike_noise=facts.unlike_noise(left, given),
        channels=facts.dependent_channels(left),
        strayed=facts.strayed(problem, heights, seen, given),
        seen=seen,
        mean_shown=facts.shows_mean(gradients),
        noise_share=float(np.min(problem.noise / problem.brightness)),
        same_light=facts.have_same_light(found),
        same_view=facts.have_same_view(found),
        unsure_noise=None if given.noise is not None else facts.why_noise_is_unsure(problem, expansion.unknowns.count, free),
        length=facts.misfit_of_length(problem, given),
        scaled=scaled,
        displaced=displaced,
        draws=(0, 0) if samples is None else (given.draws, len(samples)),
        parts=parts,
    )
    state = ended.state
    off = [np.where(picture.residual == 0, 0, picture.image - picture.target) for picture in left]
    images, residuals = (tuple(map(_in_shape, each, map(np.shape, targets))) for each in ([p.image for p in left], off))
    return Fit(
        heights=jnp.asarray(problem.basis.crop(np.asarray(problem.basis.base))),
        result=ended.stop,
        std=std,
        samples=samples,
        seen=seen,
        albedo=problem.factors(sought),
        exposures=sought.exposures,
        offsets=None if sought.offsets is None else sought.offsets * problem.bright,
        noise=problem.noise,
        scenes=found,
        settings=problem.settings,
        images=images,
        residuals=residuals,
        regions=regions,
        warnings=warnings(findings),
        stats={
            "steps": len(state.history),
            "accepted": sum(step.accepted for step in state.history),
            "seconds": state.seconds,
            "loss": state.loss,
            "chi2": chi2,
        },
        history=state.history,
    )


def _restricted(ended: Ended, given: Given) -> tuple[Expansion, Freedom | None]:
    """The expansion with the noise of restricted maximum likelihood, and what of it the heights explain; None where they are
    few, or were not all fitted."""
    expansion = ended.expansion
    if not (ended.varied_all and np.isfinite(ended.state.loss) and explains_noise(expansion.problem)):
        return expansion, None
    restricted = Restricted(expansion)
    estimate = restricted.noise(given.noise is None, ended.state.widths)
    if given.noise is None:
        expansion = expansion.with_noise(estimate.noise)
    return expansion, restricted.freedom(estimate)


def _in_shape(image: Float[np.ndarray, "h w c"], shape: tuple[int, ...]) -> np.ndarray:
    """An image in the shape of its target; a grey one that was given with three channels is compared as one."""
    return np.broadcast_to(image, (*image.shape[:2], *shape[2:])).copy() if len(shape) == 3 else image[..., 0]


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
    left, boundaries, tolerance = in_row(expansion.left()), None, _TOLERANCE
    matrix = robust_matrix(expansion, left)
    if matrix.rows is not None:
        boundaries, tolerance = Boundaries(expansion, matrix.rows, left), _NEAR_TOLERANCE
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

    `rows`, `left`: `pictures_by_heights` of the expansion, and `Expansion.left` in a row.
    """

    def __init__(self, expansion: Expansion, rows: Any, left: Float[np.ndarray, " rows"]):
        reach = np.sqrt(np.asarray(rows.power(2).sum(axis=1)).ravel())
        self.rows = np.flatnonzero((in_row(facts.on_boundaries(expansion)) > 0) & (reach > 0))
        self.reach, self.size = reach[self.rows], reach.size
        self.residuals = left[self.rows]
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
