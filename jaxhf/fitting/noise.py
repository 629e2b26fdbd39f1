"""How large the noise of pictures is, by what a fit leaves of them and by how much of the noise the heights explain."""

import dataclasses
import math
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from .basis import Unknowns
from .jacobian import PictureValues, Sparse, in_rows, picture_values
from .normal_matrix import NormalMatrix
from .problem import Problem
from .robust import influence_function
from .solvers import count_unknowns

_FAR = 6.0  # times the median: four standard deviations of normal errors; what is farther off is not explained
_FINE = 0.5  # of the noise: an error of samples that hardly counts beside it
_NO_WEIGHT = 1e-3  # of a value that is far off
_LEAST_SHARE = 0.1  # of heights in values: of fewer heights noise would be told by 5 % too small at most
_LEAST_FREE = 0.1  # of a picture's noise: where heights explain more, what is left does not tell the noise
_MOST_UNKNOWNS = (
    0.25  # of the values, where it is not known how much of the noise is explained: it is told 13 % too small at most
)
_MOST_EXPLAINED = 0.75  # of a picture's noise: one sun without a prior has 0.8, and 0.65 to 1 of its noise is found
_LEAST_SLOPE = 0.1  # of a robust loss, on average
_OCTAVES = 6  # into which the prior's modes are divided, at most
_ROUNDS = 8  # at most; three or four are usual
_NOISE_CHANGE, _WIDTH_CHANGE = 1.02, 1.1  # by less in a round: it has converged
_DRAWN_VALUES = 8192  # from which the mean square of simulated residuals is taken: right to 2 %
_MOST_DRAWS = 8


class Freedom(NamedTuple):
    """How much of the noise of each picture a fit leaves, and how much goes into what it seeks.

    Attributes:
      free: mean square of the residuals that a fit leaves of noise of deviation 1, shape (pictures,).
      explained: trace of the hat matrix over the number of values, shape (pictures,).
    """

    free: Float[np.ndarray, " pictures"]
    explained: Float[np.ndarray, " pictures"]


def values_that_tell(problem: Problem) -> Int[np.ndarray, " rows"]:
    """Of each value, in the order of `in_rows`, its picture's number where its residual tells of the noise, else -1.

    Pixels that do not change with the heights, such as the background, do not, nor those whose samples differ much: by more
    than half of the noise, and more than those of half of the pixels.
    """
    found = []
    for number, group in enumerate(problem.groups):
        known = None if problem.linearised is None else problem.linearised[number]
        labels = np.full(group.targets.shape, -1)
        for position, k in enumerate(group.indices):
            given = np.asarray(group.given)[position]
            counted = given > 0
            if known is not None:
                shown = counted & np.asarray(known.depends)[position][..., None]
                if shown.any():
                    error = np.broadcast_to(np.asarray(known.sampling)[position][..., None], shown.shape)
                    most = max(np.median(error[shown]), _FINE * problem.noise[k])
                    counted = shown & (error <= most)
            labels[position][counted] = k
        found.append(labels)
    return in_rows(found).astype(int)


def spreads_of(pictures: Sequence[jax.Array], problem: Problem) -> Float[np.ndarray, " pictures"]:
    """The standard deviation of each picture's values at weight 1, by its residuals; radiance.

    By their median, as some are unexplained, or by their root mean square, which is less where they are all of one size, as
    those from rounding to 8 bits.
    """
    pairs = zip(pictures, problem.groups, strict=True)
    left = in_rows([group.given * (np.asarray(picture) - np.asarray(group.targets)) for picture, group in pairs])
    labels = values_that_tell(problem)
    with np.errstate(over="ignore"):
        return np.array([_spread(left[labels == k]) for k in range(problem.count)])


def _spread(left: Float[np.ndarray, " n"]) -> float:
    return float(min(1.4826 * np.median(np.abs(left)), np.sqrt(np.mean(left * left))))


def explains_noise(problem: Problem) -> bool:
    """Whether heights may explain so much of the noise that degrees of freedom count, and these can be found."""
    values = sum(int(np.count_nonzero(np.asarray(group.given))) for group in problem.groups)
    heights = problem.basis.crop(np.asarray(problem.basis.base)).size
    return heights > _LEAST_SHARE * values


def estimated_noise(
    unknowns: Unknowns, problem: Problem, images: Sparse, sought: bool = True
) -> tuple[Float[np.ndarray, " pictures"], Float[np.ndarray, "my mx"]]:
    """The noise of each picture by restricted maximum likelihood, radiance, and how much wider than the prior heights vary.

    Residuals r of a picture with n values have |r|² = σ² (n - tr A), A the hat matrix (Patterson and Thompson, Biometrika 58,
    545, 1971; Harville, JASA 72, 320, 1977). The trace is that of simulated fits: what they leave of noise. The prior decides
    how much of the noise heights explain, and is seldom quite the terrain's (Wahba, Annals of Statistics 13, 1378, 1985), so
    the deviations of its modes are estimated too, octave by octave: τ² = |u|² / g, u the modes in units of the prior, g how
    many of them the pictures tell. All that is in the linear model about `unknowns`; the fit itself keeps the prior.

    Args:
      unknowns: where the fit stands, all modes varied.
      problem: `linearised` there.
      images: the `images_jacobian` there.
      sought: whether the noise is to be found, or only how the heights vary.
    """
    noise, labels = problem.noise.copy(), values_that_tell(problem)
    bands = octaves(problem.basis.base.shape)
    widths, far = np.ones(bands.max() + 1), np.zeros(labels.size, bool)
    for _ in range(_ROUNDS):
        model = problem.with_noise(noise)
        values, left = _compared(unknowns, model, far)
        matrix = NormalMatrix(unknowns, _widened(model, widths[bands]), images, values)
        change = matrix.step()
        left = left + matrix.seen(change)
        draws = [matrix.simulated(seed) for seed in range(_draws(labels))]
        factors, before = np.ones(widths.size), noise
        if sought:
            noise, deviations = noise.copy(), _deviations(model)
            for k, here in _each_picture(labels):
                simulated = np.concatenate([draw.left[here] for draw in draws])
                if np.mean(simulated**2) > _LEAST_FREE:
                    noise[k] = _rms(deviations[here]) * _bounded(left[here]) / _bounded(simulated)
            noise = np.maximum(noise, problem.least_noise)
        far = _far_off(left, labels, problem)
        if problem.prior is not None:
            told = np.mean([draw.told for draw in draws], axis=0)
            parts = matrix.in_prior(unknowns, model, change) ** 2, told
            squares, count = (np.bincount(bands.ravel(), part.ravel(), widths.size) for part in parts)
            factors = np.sqrt((squares + 1) / (np.maximum(count, 0) + 1))
            widths = widths * factors
        moved = [np.abs(np.log(part)).max() for part in (noise / before, factors)]
        if moved[0] < math.log(_NOISE_CHANGE) and moved[1] < math.log(_WIDTH_CHANGE):
            break
    return noise, widths[bands]


def freedom(unknowns: Unknowns, problem: Problem, images: Sparse, widths: Float[np.ndarray, "my mx"]) -> Freedom:
    """How much of its pictures' noise a fit leaves, by simulated fits of heights that vary as `estimated_noise` says."""
    labels = values_that_tell(problem)
    _, left = _compared(unknowns, problem, np.zeros(labels.size, bool))
    values, _ = _compared(unknowns, problem, _far_off(left, labels, problem))
    matrix = NormalMatrix(unknowns, problem, images, values)
    draws = [matrix.simulated(seed, widths) for seed in range(_draws(labels))]
    found = Freedom(np.ones(problem.count), np.zeros(problem.count))
    for k, here in _each_picture(labels):
        found.free[k] = np.mean([np.mean(draw.left[here] ** 2) for draw in draws])
        found.explained[k] = np.clip(
            np.mean([np.mean(draw.noise[here] * (draw.noise - draw.left)[here]) for draw in draws]), 0, 1
        )
    return found


def _compared(
    unknowns: Unknowns, problem: Problem, far: Bool[np.ndarray, " rows"]
) -> tuple[PictureValues, Float[np.ndarray, " rows"]]:
    """The pictures for least squares without what is far off, and all their residuals in units of the noise."""
    values = picture_values(unknowns, problem)
    pairs = zip(problem.groups, values.images, strict=True)
    residuals = [np.asarray(group.weights) * (np.asarray(image) - np.asarray(group.targets)) for group, image in pairs]
    roots, first = [], 0
    for residual in residuals:
        n, h, w, c = residual.shape
        mask = np.moveaxis(far[first : first + residual.size].reshape(n, c, h, w), 1, -1)
        roots.append(np.where(mask, _NO_WEIGHT, 1.0))
        first += residual.size
    softened = [root * residual for root, residual in zip(roots, residuals, strict=True)]
    return values._replace(softened=softened, slopes=roots, roots=roots), in_rows(residuals)


def _widened(problem: Problem, widths: Float[np.ndarray, "my mx"]) -> Problem:
    """The problem with a prior whose modes have deviations that are so many times as large."""
    if problem.prior is None:
        return problem
    stiffness = 1.0 if problem.prior.stiffness is None else np.asarray(problem.prior.stiffness, np.float64)
    stiffness = jnp.asarray(stiffness / widths, problem.prior.weight.dtype)
    return dataclasses.replace(problem, prior=dataclasses.replace(problem.prior, stiffness=stiffness))


def octaves(shape: tuple[int, ...]) -> Int[np.ndarray, "my mx"]:
    """The octave of each mode's frequency, 0 being that which ends at the highest along an axis."""
    y, x = (np.arange(n) / n for n in shape)
    frequency = np.maximum(np.hypot(y[:, None], x[None, :]), 1e-9)
    return np.clip(np.floor(-np.log2(frequency)), 0, _OCTAVES - 1).astype(int)


def _each_picture(labels: Int[np.ndarray, " rows"]) -> list[tuple[int, Bool[np.ndarray, " rows"]]]:
    return [(k, labels == k) for k in np.unique(labels[labels >= 0]).tolist()]


def _draws(labels: Int[np.ndarray, " rows"]) -> int:
    return int(np.clip(math.ceil(_DRAWN_VALUES / labels.size), 1, _MOST_DRAWS))


def _bounded(values: Float[np.ndarray, " n"]) -> float:
    """The root mean square of what is not far off."""
    sizes = np.abs(values)
    return _rms(sizes[sizes <= _FAR * np.median(sizes)])


def _rms(values: Float[np.ndarray, " n"]) -> float:
    return float(np.sqrt(np.mean(values * values)))


def _deviations(problem: Problem) -> Float[np.ndarray, " rows"]:
    """Of each value at weight 1, radiance: its noise, and the error of its samples, which counts as noise."""
    pairs = [(np.asarray(group.given, np.float64), np.asarray(group.weights)) for group in problem.groups]
    return in_rows([given / np.where(weights > 0, weights, 1) for given, weights in pairs])


def _far_off(left: Float[np.ndarray, " rows"], labels: Int[np.ndarray, " rows"], problem: Problem) -> Bool[np.ndarray, " rows"]:
    """Which values of each picture are far off, beside those that tell of its noise."""
    typical = np.full(problem.count, np.inf)
    for k, here in _each_picture(labels):
        typical[k] = np.median(np.abs(left[here]))
    numbers = [np.broadcast_to(np.reshape(group.indices, (-1, 1, 1, 1)), group.targets.shape) for group in problem.groups]
    return np.abs(left) > _FAR * typical[in_rows(numbers).astype(int)]


def why_noise_is_unsure(problem: Problem, unknowns: Unknowns, freedom: Freedom | None) -> str | None:
    """Why an estimate of the noise may be too small, in words; None: it is sure."""
    if freedom is not None:
        worst = int(np.argmax(freedom.explained))
        if freedom.explained[worst] <= _MOST_EXPLAINED:
            return None
        return f"heights explain {freedom.explained[worst]:.0%} of the noise of picture {worst}: what is left hardly tells it"
    share = count_unknowns(unknowns) / sum(int(np.count_nonzero(np.asarray(group.given))) for group in problem.groups)
    if share <= _MOST_UNKNOWNS:
        return None
    return f"there are {share:.2g} unknowns to each value of the pictures, which explain an unknown part of its noise"


def chi_squared(
    problem: Problem, residuals: Float[np.ndarray, " n"], counts: Sequence[int], freedom: Freedom | None
) -> tuple[float, float | None]:
    """The mean square of residuals by degree of freedom, about 1 where they are noise; and the mean of `Freedom.free`.

    A value that a robust loss lets go takes no part in the fit, so heights explain none of it, and its residual r is larger
    than by least squares. With ψ = ρ', v the mean of ψ' and h the share that least squares explain, r + h / (1 - h) ψ / v is
    about its residual from the fit to all other values; times 1 - h, that has the size of the residual by least squares (Cook
    and Weisberg, Residuals and influence in regression, 1982, section 2.2).

    Args:
      problem: of the fit.
      residuals: in units of the noise, picture after picture.
      counts: how many of them each picture has.
      freedom: None: heights are few, and explain nothing of the noise.
    """
    if residuals.size == 0 or freedom is None:
        return (float(np.mean(residuals**2)) if residuals.size else 0.0), None
    psi, slope, _ = map(np.asarray, influence_function(residuals, problem.loss, problem.loss_scale))
    explained, free = (np.repeat(values, counts) for values in (freedom.explained, freedom.free))
    left = residuals + explained * (psi / max(np.mean(slope), _LEAST_SLOPE) - residuals)
    return float(np.sum(left**2) / np.sum(free)), float(np.mean(free))
