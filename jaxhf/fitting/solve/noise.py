"""How large the noise of pictures is, by what a fit leaves of them and by how much of the noise the heights explain."""

import math
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from ..model.expansion import Expansion
from ..model.normal_matrix import Flat, NormalMatrix, in_row
from ..model.problem import Problem

_FAR = 6.0  # times the median: four standard deviations of normal errors; what is farther off is not explained
_FINE = 0.5  # of the noise: an error of samples that hardly counts beside it
_NO_WEIGHT = 1e-3  # of a value that is far off
_LEAST_SHARE = 0.1  # of heights in values: of fewer heights noise would be told by 5 % too small at most
_LEAST_FREE = 0.1  # of a picture's noise: where heights explain more, what is left does not tell the noise
OCTAVES = 6  # into which the prior's modes are divided, at most
_ROUNDS = 8  # at most; three or four are usual
_NOISE_CHANGE, _WIDTH_CHANGE = 1.02, 1.1  # by less in a round: it has converged
_DRAWN_VALUES = 8192  # from which the mean square of simulated residuals is taken: right to 2 %
_MOST_DRAWS = 8
_TOLERANCE = 0.02  # of linear problems, each from the one before: noise is within 2 % of that at 0.01, at 0.05 within 3 %

Labels = Int[np.ndarray, " rows"]


class Estimate(NamedTuple):
    """The noise of each picture at weight 1, radiance, and how many times wider than their prior heights vary, by octave."""

    noise: Float[np.ndarray, " pictures"]
    widths: Float[np.ndarray, " octaves"]


class Freedom(NamedTuple):
    """How much of the noise of each picture a fit leaves, and how much goes into what it seeks.

    Attributes:
      free: mean square of the residuals that a fit leaves of noise of deviation 1, shape (pictures,).
      explained: trace of the hat matrix over the number of values, shape (pictures,).
    """

    free: Float[np.ndarray, " pictures"]
    explained: Float[np.ndarray, " pictures"]


def spreads(expansion: Expansion) -> Float[np.ndarray, " pictures"]:
    """The standard deviation of each picture's values at weight 1, by its residuals; radiance.

    By their median, as some are unexplained, or by their root mean square, which is less where they are all of one size, as
    those from rounding to 8 bits.
    """
    groups = expansion.problem.groups
    pairs = zip(expansion.pictures(), groups, strict=True)
    left = in_row([np.asarray(group.given) * (np.asarray(picture) - np.asarray(group.targets)) for picture, group in pairs])
    labels = _values_that_tell(expansion)
    with np.errstate(over="ignore"):
        return np.array([_spread(left[labels == k]) for k in range(expansion.problem.count)])


def _spread(left: Float[np.ndarray, " n"]) -> float:
    return float(min(1.4826 * np.median(np.abs(left)), np.sqrt(np.mean(left * left))))


def explains_noise(problem: Problem) -> bool:
    """Whether heights may explain so much of the noise that degrees of freedom count."""
    return problem.field.heights.size > _LEAST_SHARE * problem.values


def estimated_noise(expansion: Expansion, sought: bool, widths: Float[np.ndarray, " octaves"]) -> Estimate:
    """The noise of each picture by restricted maximum likelihood.

    Residuals r of a picture with n values have |r|² = σ² (n - tr A), A the hat matrix (Patterson and Thompson, Biometrika 58,
    545, 1971; Harville, JASA 72, 320, 1977). The trace is that of simulated fits: what they leave of noise. The prior decides
    how much of the noise heights explain, and is seldom quite the terrain's (Wahba, Annals of Statistics 13, 1378, 1985), so
    the deviations of its modes are estimated too, octave by octave: τ² = |u|² / g, u the modes in units of the prior, g how
    many of them the pictures tell. All that is in the linear model about the expansion; the fit itself keeps the prior.

    Args:
      expansion: where the fit stands, all modes varied.
      sought: whether the noise is to be found, or only how the heights vary.
      widths: those of an estimate before; 1 where there is none.
    """
    problem, sampling, labels = expansion.problem, expansion.sampling, _values_that_tell(expansion)
    noise, bands = problem.noise.copy(), octaves(problem.basis.base.shape)
    far, change, draws = np.zeros(labels.size, bool), None, [None] * _draws(labels)
    for _ in range(_ROUNDS):
        here = expansion.of(_widened(problem.with_noise(noise, sampling), widths[bands]))
        rows, matrix = in_row(here.left()), NormalMatrix(here, np.where(far, _NO_WEIGHT, 1.0))
        change = matrix.solved(-matrix.gradient(matrix.roots * rows), _TOLERANCE, change)
        left = rows + matrix.seen(change) / matrix.roots
        modes = matrix.modes_before() + matrix.modes_of(change)
        draws = [_simulated(matrix, seed, 1.0, None if draw is None else draw.change) for seed, draw in enumerate(draws)]
        factors, before = np.ones(widths.size), noise
        if sought:
            noise, deviations = noise.copy(), _deviations(here.problem)
            for k, which in _each_picture(labels):
                simulated = np.concatenate([draw.left[which] for draw in draws])
                if np.mean(simulated**2) > _LEAST_FREE:
                    noise[k] = _rms(deviations[which]) * _bounded(left[which]) / _bounded(simulated)
            noise = np.maximum(noise, problem.least_noise)
        far = _far_off(left, labels, problem)
        if problem.known:
            told = np.mean([draw.told for draw in draws], axis=0)
            squares, count = (np.bincount(bands.ravel(), part.ravel(), widths.size) for part in (modes**2, told))
            factors = np.sqrt((squares + 1) / (np.maximum(count, 0) + 1))
            widths = widths * factors
        changes = [np.abs(np.log(part)).max() for part in (noise / before, factors)]
        if changes[0] < math.log(_NOISE_CHANGE) and changes[1] < math.log(_WIDTH_CHANGE):
            break
    return Estimate(noise, widths)


def freedom(expansion: Expansion, widths: Float[np.ndarray, " octaves"]) -> Freedom:
    """How much of its pictures' noise a fit leaves, by simulated fits of heights that vary as `estimated_noise` says."""
    labels, count = _values_that_tell(expansion), expansion.problem.count
    far = _far_off(in_row(expansion.left()), labels, expansion.problem)
    matrix = NormalMatrix(expansion, np.where(far, _NO_WEIGHT, 1.0))
    wider = widths[octaves(matrix.shape)]
    draws = [_simulated(matrix, seed, wider) for seed in range(_draws(labels))]
    found = Freedom(np.ones(count), np.zeros(count))
    for k, here in _each_picture(labels):
        found.free[k] = np.mean([np.mean(draw.left[here] ** 2) for draw in draws])
        gone = [np.mean(draw.noise[here] * (draw.noise - draw.left)[here]) for draw in draws]
        found.explained[k] = np.clip(np.mean(gone), 0, 1)
    return found


class _Simulated(NamedTuple):
    """A fit to noise.

    Attributes:
      noise: of deviation 1, in the pictures.
      left: what it leaves of this noise.
      told: of each mode of the heights' prior, an estimate of the share that the pictures tell, shape (my, mx).
      change: what is found of all unknowns.
    """

    noise: Float[np.ndarray, " rows"]
    left: Float[np.ndarray, " rows"]
    told: Float[np.ndarray, "my mx"]
    change: Flat


def _simulated(
    matrix: NormalMatrix, seed: int, widths: float | Float[np.ndarray, "my mx"], begin: Flat | None = None
) -> _Simulated:
    """What is left of noise in a fit of heights that differ from their prior by so many times its deviations.

    `begin`: what was found in a problem like this one.
    """
    noise = matrix.drawn(seed, widths)
    change = matrix.solved(matrix.gathered(noise), _TOLERANCE, begin)
    left = noise.pictures - matrix.seen(change)
    return _Simulated(noise.pictures, left, noise.modes * (noise.modes - matrix.modes_of(change)), change)


def _widened(problem: Problem, widths: Float[np.ndarray, "my mx"]) -> Problem:
    """The problem with a prior of the heights whose modes have deviations that are so many times as large."""
    spectrum = problem.terms.surface.spectrum
    wider = np.asarray(np.asarray(spectrum) / widths, spectrum.dtype)
    return eqx.tree_at(lambda problem: problem.terms.surface.spectrum, problem, jnp.asarray(wider))


def octaves(shape: tuple[int, ...]) -> Int[np.ndarray, "my mx"]:
    """The octave of each mode's frequency, 0 being that which ends at the highest along an axis."""
    y, x = (np.arange(n) / n for n in shape)
    frequency = np.maximum(np.hypot(y[:, None], x[None, :]), 1e-9)
    return np.clip(np.floor(-np.log2(frequency)), 0, OCTAVES - 1).astype(int)


def _values_that_tell(expansion: Expansion) -> Labels:
    """Of each value its picture's number where its residual tells of the noise, else -1.

    Pixels that do not change with the heights, such as the background, do not, nor those whose samples differ much: by more
    than half of the noise, and more than those of half of the pixels.
    """
    problem, found = expansion.problem, []
    for group, known in zip(problem.groups, expansion.linearised, strict=True):
        labels = np.full(group.targets.shape, -1)
        for position, k in enumerate(group.indices):
            counted = np.asarray(group.given)[position] > 0
            if known is not None:
                shown = counted & np.asarray(known.depends)[position][..., None]
                if shown.any():
                    error = np.broadcast_to(np.asarray(known.sampling)[position][..., None], shown.shape)
                    most = max(np.median(error[shown]), _FINE * problem.noise[k])
                    counted = shown & (error <= most)
            labels[position][counted] = k
        found.append(labels)
    return in_row(found).astype(int)


def _each_picture(labels: Labels) -> list[tuple[int, Bool[np.ndarray, " rows"]]]:
    return [(k, labels == k) for k in np.unique(labels[labels >= 0]).tolist()]


def _draws(labels: Labels) -> int:
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
    return in_row([given / np.where(weights > 0, weights, 1) for given, weights in pairs])


def _far_off(left: Float[np.ndarray, " rows"], labels: Labels, problem: Problem) -> Bool[np.ndarray, " rows"]:
    """Which values of each picture are far off, beside those that tell of its noise."""
    typical = np.full(problem.count, np.inf)
    for k, here in _each_picture(labels):
        typical[k] = np.median(np.abs(left[here]))
    numbers = [np.broadcast_to(np.reshape(group.indices, (-1, 1, 1, 1)), group.targets.shape) for group in problem.groups]
    return np.abs(left) > _FAR * typical[in_row(numbers).astype(int)]
