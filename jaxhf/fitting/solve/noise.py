"""How large the noise of pictures is, by what a fit leaves of them and by how much of the noise the heights explain."""

import itertools
import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ..model.expansion import Expansion
from ..model.normal_matrix import MOST_OTHERS, Flat, NormalMatrix, in_row
from ..model.problem import Problem
from ..model.rows import first_vertices, has_rows, part_by_heights
from ..model.terms import OCTAVES, by_mode, octaves
from ..model.unknowns import Window

_FAR = 6.0  # times the median: four standard deviations of normal errors; what is farther off is not explained
_FINE = 0.5  # of the noise: an error of samples that hardly counts beside it
_NO_WEIGHT = 1e-3  # of a value that is far off
_LEAST_SHARE = 0.1  # of heights in values: of fewer heights noise would be told by 5 % too small at most
_LEAST_FREE = 0.1  # of a picture's noise: where heights explain more, what is left does not tell the noise
_SAID = 1.0  # modes for which the prior's std counts, in an octave whose errors are larger
_ROUNDS = 8  # at most; three or four are usual
_NOISE_CHANGE, _WIDTH_CHANGE = 1.02, 1.1  # by less in a round: it has converged
_DRAWN_VALUES = 8192  # from which the mean square of simulated residuals is taken: right to 2 %
_MOST_DRAWS = 8
_TOLERANCE = 0.02  # of linear problems, each from the one before: noise is within 2 % of that at 0.01, at 0.05 within 3 %
_MOST_SIDE = 192  # of heights with their padding, of which all values are taken
_BLOCK = 128  # heights a side, of more
_LEAST_TOLD = 4096  # values of each picture in it: they tell the noise to a few percent

Labels = Int[np.ndarray, " rows"]


class Estimate(NamedTuple):
    """The noise of each picture at weight 1, radiance, and how many times wider than their prior heights vary, by octave."""

    noise: Float[np.ndarray, " pictures"]
    widths: Float[np.ndarray, " octaves"]


class Freedom(NamedTuple):
    """Of each picture the mean square of what a fit leaves of noise of deviation 1, and how much of the noise goes into what it
    seeks: the trace of the hat matrix over the number of values."""

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
    """Whether heights may explain so much of the noise that degrees of freedom count; not beside an `AlbedoField`, which
    explains most of it."""
    return problem.albedo is None and problem.field.heights.size > _LEAST_SHARE * problem.values


class Restricted:
    """Restricted maximum likelihood about an expansion, all of whose modes are varied: the noise of pictures, and how much of
    it heights explain.

    Residuals r of a picture with n values have |r|² = σ² (n - tr A), A the hat matrix (Patterson and Thompson, Biometrika 58,
    545, 1971; Harville, JASA 72, 320, 1977). The trace is that of simulated fits: what they leave of noise. The prior decides
    how much of the noise heights explain, and is seldom quite the terrain's (Wahba, Annals of Statistics 13, 1378, 1985), so
    the deviations of its modes are estimated too, octave by octave: τ² = |u|² / g, u the modes in units of the prior, g how
    many of them the pictures tell. All that is in the linear model about the expansion.
    """

    def __init__(self, expansion: Expansion):
        self._expansion, labels = expansion, _values_that_tell(expansion)
        self._values, self._matrix = _told(expansion, labels)
        self._labels, self._numbers = labels[self._values], _pictures(expansion.problem)[self._values]
        self._rows, self._weights = in_row(expansion.left())[self._values], _weights(expansion.problem)[self._values]

    def noise(self, sought: bool, before: Float[np.ndarray, " octaves"]) -> Estimate:
        """The noise of each picture; where it is not `sought`, only how the heights vary. `before`: how many times as wide as
        its owner said the prior is already."""
        problem, labels, bands = self._expansion.problem, self._labels, octaves(self._matrix.shape)
        widths = np.ones(OCTAVES)
        noise, far, change, draws = problem.noise.copy(), np.zeros(labels.size, bool), None, [None] * _draws(labels)
        for _ in range(_ROUNDS):
            here = self._expansion.with_noise(noise).problem
            factors = self._factors(here)
            matrix = self._matrix.weighted(factors * np.where(far, _NO_WEIGHT, 1.0), by_mode(widths, self._matrix.shape))
            change = matrix.solved(-matrix.gradient(matrix.roots * self._rows), _TOLERANCE, change)
            left = factors * (self._rows + matrix.seen(change) / matrix.roots)
            modes = matrix.modes_before() + matrix.modes_of(change)
            draws = [_simulated(matrix, seed, 1.0, None if draw is None else draw.change) for seed, draw in enumerate(draws)]
            growth, noise_before = np.ones(widths.size), noise
            if sought:
                noise, deviations = noise.copy(), _deviations(here)[self._values]
                for k, which in _each_picture(labels):
                    simulated = np.concatenate([draw.left[which] for draw in draws])
                    if np.mean(simulated**2) > _LEAST_FREE:
                        noise[k] = rms(deviations[which]) * _bounded(left[which]) / _bounded(simulated)
                noise = np.maximum(noise, problem.least_noise)
            far = self._far_off(left)
            if problem.known:
                told = np.mean([draw.told for draw in draws], axis=0)
                squares, count = (np.tensordot(bands, part) for part in (modes**2, told))
                # Octaves that are wider than was said are drawn towards that; nothing holds those that are narrower.
                said = _SAID * np.minimum(1 / (before * widths) ** 2, 1)
                growth = np.sqrt((squares + said) / (np.maximum(count, 0) + _SAID))
                widths = widths * growth
            changes = [np.abs(np.log(part)).max() for part in (noise / noise_before, growth)]
            if changes[0] < math.log(_NOISE_CHANGE) and changes[1] < math.log(_WIDTH_CHANGE):
                break
        return Estimate(noise, widths)

    def freedom(self, estimate: Estimate) -> Freedom:
        """How much of its pictures' noise a fit leaves, by simulated fits of heights that vary as was estimated."""
        problem, labels = self._expansion.problem, self._labels
        factors = self._factors(self._expansion.with_noise(estimate.noise).problem)
        roots = factors * np.where(self._far_off(factors * self._rows), _NO_WEIGHT, 1.0)
        matrix = self._matrix.weighted(roots, np.ones(self._matrix.shape))
        wider = by_mode(estimate.widths, matrix.shape)
        draws = [_simulated(matrix, seed, wider) for seed in range(_draws(labels))]
        found = Freedom(np.ones(problem.count), np.zeros(problem.count))
        for k, here in _each_picture(labels):
            found.free[k] = np.mean([np.mean(draw.left[here] ** 2) for draw in draws])
            gone = [np.mean(draw.noise[here] * (draw.noise - draw.left)[here]) for draw in draws]
            found.explained[k] = np.clip(np.mean(gone), 0, 1)
        return found

    def _factors(self, problem: Problem) -> Float[np.ndarray, " rows"]:
        """By how much the weights of a problem are larger than those of the expansion."""
        before = np.where(self._weights > 0, self._weights, 1)
        return np.where(self._weights > 0, _weights(problem)[self._values] / before, 1)

    def _far_off(self, left: Float[np.ndarray, " rows"]) -> Bool[np.ndarray, " rows"]:
        """Which values of each picture are far off, beside those that tell of its noise."""
        typical = np.full(self._expansion.problem.count, np.inf)
        for k, here in _each_picture(self._labels):
            typical[k] = np.median(np.abs(left[here]))
        return np.abs(left) > _FAR * typical[self._numbers]


def _told(expansion: Expansion, labels: Labels) -> tuple[Int[np.ndarray, " values"], NormalMatrix]:
    """The values that are to tell the noise, and the normal matrix of their residuals, all of weight 1: all values or, where
    heights are many, those that show a block of them, as a part of the data tells the noise as well."""
    block, shape = None, expansion.problem.basis.base.shape
    few_others = expansion.unknowns.count - math.prod(shape) <= MOST_OTHERS
    if expansion.is_linearised and max(shape) > _MOST_SIDE and few_others:
        block = _block(expansion, labels)
    rows, values = None, np.arange(labels.size)
    if block is not None or has_rows(expansion):
        rows, values = part_by_heights(expansion, block)
    return values, NormalMatrix(expansion, np.ones(values.size), rows, block)


def _block(expansion: Expansion, labels: Labels) -> Window | None:
    """Heights that many values show of each picture that tells of its noise; None: there is no block that shows enough."""
    shape, vertices = expansion.problem.field.heights.shape, first_vertices(expansion)
    shown, told = (vertices >= 0) & (labels >= 0), np.unique(labels[labels >= 0])
    y, x = np.divmod(vertices, shape[1])
    begins = [range(0, max(n - _BLOCK, 0) + 1, _BLOCK // 2) for n in shape]
    best, most = None, _LEAST_TOLD
    for row, column in itertools.product(*begins):
        here = shown & (y >= row) & (y < row + _BLOCK) & (x >= column) & (x < column + _BLOCK)
        least = np.bincount(labels[here], minlength=expansion.problem.count)[told].min(initial=labels.size)
        if least > most:
            best, most = Window(row, column, *(min(_BLOCK, n) for n in shape)), least
    return best


class _Simulated(NamedTuple):
    """A fit to noise of deviation 1 in the pictures: the noise, what is left of it, for each mode of the heights' prior an
    estimate of the share that the pictures tell, and the change of all unknowns."""

    noise: Float[np.ndarray, " rows"]
    left: Float[np.ndarray, " rows"]
    told: Float[np.ndarray, "my mx"]
    change: Flat


def _simulated(
    matrix: NormalMatrix, seed: int, widths: float | Float[np.ndarray, "my mx"], begin: Flat | None = None
) -> _Simulated:
    """What is left of noise in a fit of heights that differ from their prior by so many times its deviations; `begin`: the
    change in a problem like this one."""
    noise = matrix.drawn(seed, widths)
    change = matrix.solved(matrix.gathered(noise), _TOLERANCE, begin)
    left = noise.pictures - matrix.seen(change)
    return _Simulated(noise.pictures, left, noise.modes * (noise.modes - matrix.modes_of(change)), change)


def _values_that_tell(expansion: Expansion) -> Labels:
    """Of each value its picture's number where its residual tells of the noise, else -1.

    Pixels that do not change with the heights, such as the background, do not, nor those whose samples differ much: by more
    than half of the noise, and more than those of half of the pixels.
    """
    problem, found = expansion.problem, []
    for group, known, informing in zip(problem.groups, expansion.linearised, expansion.informing(), strict=True):
        labels = np.full(group.targets.shape, -1)
        for position, (k, told) in enumerate(zip(group.indices, informing, strict=True)):
            if not told.any():
                told = np.asarray(group.given)[position] > 0
            elif known is not None:
                error = np.broadcast_to(np.asarray(known.sampling)[position][..., None], told.shape)
                told = told & (error <= max(np.median(error[told]), _FINE * problem.noise[k]))
            labels[position][told] = k
        found.append(labels)
    return in_row(found).astype(int)


def _each_picture(labels: Labels) -> list[tuple[int, Bool[np.ndarray, " rows"]]]:
    return [(k, labels == k) for k in np.unique(labels[labels >= 0]).tolist()]


def _draws(labels: Labels) -> int:
    return int(np.clip(math.ceil(_DRAWN_VALUES / labels.size), 1, _MOST_DRAWS))


def _bounded(values: Float[np.ndarray, " n"]) -> float:
    """The root mean square of what is not far off."""
    sizes = np.abs(values)
    return rms(sizes[sizes <= _FAR * np.median(sizes)])


def rms(values: Float[np.ndarray, " n"]) -> float:
    return float(np.sqrt(np.mean(values * values)))


def _deviations(problem: Problem) -> Float[np.ndarray, " rows"]:
    """Of each value at weight 1, radiance: its noise, and the error of its samples, which counts as noise."""
    pairs = [(np.asarray(group.given, np.float64), np.asarray(group.weights)) for group in problem.groups]
    return in_row([given / np.where(weights > 0, weights, 1) for given, weights in pairs])


def _weights(problem: Problem) -> Float[np.ndarray, " rows"]:
    return in_row([np.asarray(group.weights) for group in problem.groups])


def _pictures(problem: Problem) -> Labels:
    """The number of its picture, for each value."""
    numbers = np.arange(problem.count)
    return in_row([np.broadcast_to(group.each(numbers), group.targets.shape) for group in problem.groups]).astype(int)
