"""What a fit says about its result: where the pictures are left unexplained, and what its heights cannot be trusted for."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy.ndimage
from jaxtyping import Bool, Float

from ..given import Stop

FAR_FROM_ONE = 1.5  # by which factor chi2 may differ from 1
_STRAYED = 2.0  # standard deviations of the prior, root mean square
_UNSEEN = 0.01  # share of the heights
_NOISY = 0.1  # of the brightness
_REGIONS = 3
_BLOCKS = 16  # along a picture's longer side
_LEAST_BLOCK = 4  # pixels
_AROUND = np.ones((3, 3))  # a pixel and its eight neighbours

ndimage: Any = scipy.ndimage  # whose stubs miss much


class Region(NamedTuple):
    """A block of a picture.

    Attributes:
      picture: its number, from 0.
      row, column: the top left pixel.
      height, width: pixels.
      rms: root mean square of its residuals, in standard deviations of the noise.
    """

    picture: int
    row: int
    column: int
    height: int
    width: int
    rms: float

    def __str__(self) -> str:
        rows, columns = f"{self.row}-{self.row + self.height - 1}", f"{self.column}-{self.column + self.width - 1}"
        return f"picture {self.picture} rows {rows} columns {columns} ({self.rms:.2g} times the noise)"


def worst_regions(residuals: Sequence[Float[np.ndarray, "h w c"]]) -> tuple[Region, ...]:
    """The three blocks, of a sixteenth of a picture's side, with the largest residuals, 0 where a pixel does not count; they do
    not overlap."""
    found = []
    for number, residual in enumerate(residuals):
        squares = np.mean(np.square(residual, dtype=np.float64), axis=-1)
        size = max(_LEAST_BLOCK, max(squares.shape) // _BLOCKS)
        for row in range(0, squares.shape[0], size):
            for column in range(0, squares.shape[1], size):
                block = squares[row : row + size, column : column + size]
                height, width = block.shape
                found.append(Region(number, row, column, height, width, float(np.sqrt(block.mean()))))
    return tuple(sorted(found, key=lambda region: -region.rms)[:_REGIONS])


def where_residuals_are(
    residuals: Sequence[Float[np.ndarray, "h w c"]],
    places: Sequence[tuple[Bool[np.ndarray, "h w"], Bool[np.ndarray, "h w"] | None]],
) -> str:
    """The shares of the squared residuals at silhouettes, at shadows and elsewhere, in words; `places`: `boundary_places`."""
    total = at_silhouettes = at_shadows = 0.0
    for residual, (silhouettes, shadows) in zip(residuals, places, strict=True):
        squares = np.sum(np.square(residual, dtype=np.float64), axis=-1)
        near = ndimage.binary_dilation(silhouettes, _AROUND)
        total += float(squares.sum())
        at_silhouettes += float(squares[near].sum())
        if shadows is not None:
            at_shadows += float(squares[ndimage.binary_dilation(shadows, _AROUND) & ~near].sum())
    if total == 0:
        return "they are all 0"
    rest = f"{(total - at_silhouettes - at_shadows) / total:.0%} elsewhere"
    if all(shadows is None for _, shadows in places):
        return f"{at_silhouettes / total:.0%} of their squares lie beside the background or shadows, {rest}"
    return (
        f"{at_silhouettes / total:.0%} of their squares lie at the terrain's border and silhouettes, "
        f"{at_shadows / total:.0%} at the edges of shadows, {rest}"
    )


class Findings(NamedTuple):
    """What `warnings` are made from; texts and numbers are None where there is nothing to be said, or none were asked for.

    Attributes:
      noise_given: whether the noise is the user's, not estimated.
      channels: which channels are hardly more than one measurement.
      help: what to try where the pictures are not explained.
      seen: which heights the pictures show.
      noise_share: the least noise of a picture over its brightness.
      same_light, same_view: whether light comes from one direction in all pictures; whether they are from one direction.
      scaled: by what the noise was multiplied for the standard deviations.
      displaced: by how much boundaries may be, height units, and what that multiplies the deviations by.
      draws: asked for, made.
      parts: the deviations of the mean height and of the heights about it.
      unsure_noise, length: why the estimated noise may be too small; how the prior's correlation length does not fit.
    """

    result: Stop
    chi2: float
    noise_given: bool
    where: str
    regions: Sequence[Region]
    unlike_noise: str | None
    channels: str | None
    help: str
    strayed: float | None
    seen: Bool[np.ndarray, "ny nx"]
    mean_shown: bool
    noise_share: float
    same_light: bool
    same_view: bool
    scaled: float | None
    displaced: tuple[float, float] | None
    draws: tuple[int, int]
    parts: tuple[float, float] | None
    unsure_noise: str | None
    length: str | None


def warnings(found: Findings) -> tuple[str, ...]:
    """What a user should know before trusting the heights; empty where nothing speaks against it."""
    said = []
    unexplained = found.chi2 > FAR_FROM_ONE
    strays = found.strayed is not None and found.strayed > _STRAYED
    if strays or found.unlike_noise is not None:
        said.append(
            "do not use these heights before the cause is found: the scene does not explain the pictures, and the heights may "
            f"be further off than {'what they began from' if found.strayed is None else 'the prior'}, whatever their deviations"
        )
    if unexplained:
        worst = "; ".join(map(str, found.regions))
        said.append(
            f"chi2 is {found.chi2:.3g}, not about 1: the pictures differ from the measured ones by {found.chi2**0.5:.2g} times "
            f"the noise, root mean square; {found.where}. Worst: {worst}"
        )
    elif found.noise_given and found.chi2 < 1 / FAR_FROM_ONE:
        said.append(
            f"chi2 is {found.chi2:.3g}, not about 1: the noise that was given is {found.chi2**-0.5:.2g} times what is left, so "
            "standard deviations are too large and the prior counts for too much; without a noise the fit estimates it"
        )
    if found.unlike_noise is not None:
        said.append(found.unlike_noise)
    elif found.channels is not None:
        said.append(found.channels)
    if found.result is Stop.MAX_STEPS:
        said.append("the fit was stopped by max_steps before it had converged: allow it more")
    elif found.result is Stop.NON_FINITE:
        said.append("a loss was not finite; the heights are those before it")
    elif unexplained and found.unlike_noise is None and not strays:  # which name a cause
        said.append(f"{'it stalled' if found.result is Stop.STALLED else 'it came no nearer'}: {found.help}")
    if strays:
        said.append(
            f"the heights differ from the prior by {found.strayed:.2g} times its std, root mean square: either std is "
            "too small or the heights are wrong, as where the surface does not reflect as its material does"
        )
    if found.length is not None and found.unlike_noise is None:
        said.append(found.length)
    if found.unsure_noise is not None:
        said.append(f"{found.unsure_noise}: noise= tells the fit, where you know it")
    hidden = int((~found.seen).sum())
    if hidden > _UNSEEN * found.seen.size:
        kept = "what the prior makes of their neighbours"
        if found.strayed is None:
            kept = "a smooth continuation of their neighbours" if found.seen.any() else "the start"
        said.append(f"no picture shows {hidden} of {found.seen.size} heights ({hidden / found.seen.size:.0%}): they are {kept}")
    if found.same_light and found.strayed is None:
        said.append(
            "all pictures have the same light and there is no prior: of slopes across the light only silhouettes and shadows "
            "tell; give a prior, or pictures with other lights"
        )
    elif found.same_light and found.same_view and found.draws[1]:
        said.append(
            "all pictures have the same light: slopes across it hardly show, and standard deviations are often too small (one "
            "held for a fifth to four fifths of the heights of right scenes, not for 68%: docs/measurements/photometry.md); "
            "add pictures under another sun"
        )
    if found.strayed is None and not found.mean_shown and found.seen.any():
        said.append(
            "the pictures show the terrain's shape, not how high all of it stands: its mean height is that of the start; a "
            "prior tells it, or a picture that is not from straight above"
        )
    if found.strayed is None and found.noise_share > _NOISY and found.unlike_noise is None and found.scaled is None:
        said.append(
            f"the noise is {found.noise_share:.0%} of the pictures' brightness, and no prior holds the heights: draws=20 says "
            " how far they may be off"
        )
    if found.scaled is not None and found.scaled > 1.05:
        said.append(
            f"the standard deviations allow for what is left unexplained: they are those of {found.scaled:.2g} times the noise "
            "(M-estimator's covariance, Huber, Robust statistics, 1981, section 7.6; see docs/concepts/recovery.md)"
        )
    if found.displaced is not None and found.displaced[1] > 1.05:
        said.append(
            f"the standard deviations allow for shadows and silhouettes that stand elsewhere in the measured pictures, as if "
            f"heights that make them were off by {found.displaced[0]:.2g}, and are {found.displaced[1]:.2g} times as large for "
            "it (variance component, Richardson and Welsh, Biometrics 51, 1429, 1995; see docs/concepts/recovery.md)"
        )
    if found.parts is not None and found.parts[0] > found.parts[1]:
        mean, shape = found.parts
        said.append(
            f"most of what is unsure of the heights they share: their mean ± {mean:.2g}, their shape ± {shape:.2g}; "
            "Fit.samples has terrains from which slopes and volumes get deviations of their own"
        )
    if found.draws[1] < found.draws[0]:
        said.append(
            f"interrupted after {found.draws[1]} of {found.draws[0]} samples of the standard deviations: they are less sure"
        )
    return tuple(said)
