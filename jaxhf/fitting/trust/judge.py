"""What a fit's end is worth: what its pictures leave unexplained, how sure its heights are, and what speaks against them."""

import dataclasses
from collections.abc import Callable, Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from ...core.errors import counted
from ...core.settings import Settings
from ...core.types import AnyArray
from ...scene.record import number, span
from ...scene.scene import Scene
from ..given import Given, Step, Stop
from ..model.expansion import Expansion, found_scenes
from ..solve.noise import Freedom, Restricted, explains_noise
from ..solve.run import Ended
from . import facts
from .deviations import standard_deviations, with_unexplained
from .words import FAR_FROM_ONE, Findings, Region, warnings, where_residuals_are, worst_regions

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
    if not (ended.whole and np.isfinite(ended.state.loss) and explains_noise(expansion.problem)):
        return expansion, None
    restricted = Restricted(expansion)
    estimate = restricted.noise(given.noise is None, ended.state.widths)
    if given.noise is None:
        expansion = expansion.with_noise(estimate.noise)
    return expansion, restricted.freedom(estimate)


def _in_shape(image: Float[np.ndarray, "h w c"], shape: tuple[int, ...]) -> np.ndarray:
    """An image in the shape of its target; a grey one that was given with three channels is compared as one."""
    return np.broadcast_to(image, (*image.shape[:2], *shape[2:])).copy() if len(shape) == 3 else image[..., 0]
