"""What a fit's end is worth: what its pictures leave unexplained, how sure its heights are, and what speaks against them."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ..given import Given
from ..history import Stop
from ..model.expansion import Expansion
from ..model.problem import Problem
from ..solve.noise import Freedom, Restricted, explains_noise
from ..solve.run import Ended
from ..solve.stages import varies_all
from .deviations import standard_deviations, with_unexplained
from .facts import (
    Left,
    boundary_places,
    chi_squared,
    dependent_channels,
    informing_values,
    light_directions,
    misfit_of_length,
    shows_mean,
    strayed,
    unlike_noise,
    what_may_help,
    why_noise_is_unsure,
)
from .words import FAR_FROM_ONE, Findings, Region, warnings, where_residuals_are, worst_regions

_OFF = 3.0  # standard deviations of the noise by which a background must be off to count


class Judgement(NamedTuple):
    """See `Fit`, whose attributes these are; images and residuals have shape (h, w, c).

    Attributes:
      expansion: at the end, all modes varied.
    """

    expansion: Expansion
    images: list[Float[np.ndarray, "h w c"]]
    residuals: list[Float[np.ndarray, "h w c"]]
    regions: tuple[Region, ...]
    seen: Bool[np.ndarray, "ny nx"]
    std: Float[np.ndarray, "ny nx"] | None
    samples: Float[np.ndarray, "draws ny nx"] | None
    chi2: float
    warnings: tuple[str, ...]


@np.errstate(over="ignore")  # of a fit that ended as not finite
def judged(ended: Ended, problems: Sequence[Problem], given: Given, report: Callable[..., None] | None) -> Judgement:
    """The judgement; `problems` are those of `run`. `report` is called after each draw."""
    fitted = varies_all(ended.state, problems) and bool(np.isfinite(ended.state.loss))
    expansion, free = _restricted(ended.expansion, fitted, given)
    problem = expansion.problem
    left, residuals = _left(expansion)
    in_noise = [picture.residual for picture in left]
    counts = [picture.informing | (np.abs(picture.residual) > _OFF) for picture in left]
    counted = np.concatenate([values[which] for values, which in zip(in_noise, counts, strict=True)]).astype(np.float64)
    regions, where = worst_regions(in_noise), where_residuals_are(in_noise, boundary_places(expansion))
    chi2, share = chi_squared(problem, counted, [int(which.sum()) for which in counts], free)
    gradients, _ = expansion.random_gradients()
    seen, heights = (gradients != 0).any(axis=0), np.asarray(expansion.heights, np.float64)
    std, samples, scaled, displaced, parts = None, None, None, None, None
    if given.draws and ended.stop is not Stop.NON_FINITE:
        borne_out, scaled = with_unexplained(expansion, counted, share)
        found = standard_deviations(borne_out, given.draws, report)
        std, samples, displaced, parts = found.std, heights + found.samples, (found.displacement, found.raised), found.parts
        if not problem.known:
            std = np.where(seen, std, np.inf)
    findings = Findings(
        result=ended.stop,
        chi2=chi2,
        noise_given=given.noise is not None,
        where=where,
        regions=regions,
        help=what_may_help(expansion, left, given) if chi2 > FAR_FROM_ONE else "",
        unlike_noise=unlike_noise(left, given),
        channels=dependent_channels(left),
        strayed=strayed(problem, heights, seen, given),
        seen=seen,
        mean_shown=shows_mean(gradients),
        noise_share=float(np.min(problem.noise / problem.brightness)),
        lights=light_directions(problem),
        unsure_noise=None if given.noise is not None else why_noise_is_unsure(problem, expansion.unknowns.count, free),
        length=misfit_of_length(problem, given),
        scaled=scaled,
        displaced=displaced,
        draws=(0, 0) if samples is None else (given.draws, len(samples)),
        parts=parts,
    )
    images = [picture.image for picture in left]
    return Judgement(expansion, images, residuals, regions, seen, std, samples, chi2, warnings(findings))


def _restricted(expansion: Expansion, fitted: bool, given: Given) -> tuple[Expansion, Freedom | None]:
    """The expansion with the noise of restricted maximum likelihood, and what of it the heights explain; None where they are
    few, or were not all `fitted`."""
    if not (fitted and explains_noise(expansion.problem)):
        return expansion, None
    restricted = Restricted(expansion)
    estimate = restricted.noise(given.noise is None)
    if given.noise is None:
        expansion = expansion.with_noise(estimate.noise)
    return expansion, restricted.freedom(estimate)


def _left(expansion: Expansion) -> tuple[list[Left], list[Float[np.ndarray, "h w c"]]]:
    """What is left of each picture, and picture - target."""
    problem, informing = expansion.problem, informing_values(expansion)
    found: dict[int, Left] = {}
    residuals: dict[int, np.ndarray] = {}
    for group, simulated in zip(problem.groups, expansion.pictures(), strict=True):
        simulated, weights, measured = np.asarray(simulated), np.asarray(group.weights), np.asarray(group.targets)
        difference = np.where(weights > 0, simulated - measured, 0)
        for k, image, target, values, weight in zip(group.indices, simulated, measured, difference, weights, strict=True):
            residuals[k] = values
            numbers = float(problem.noise[k]), float(problem.brightness[k])
            found[k] = Left(image, target, values * weight, informing[k], *numbers)
    return [found[k] for k in sorted(found)], [residuals[k] for k in sorted(residuals)]
