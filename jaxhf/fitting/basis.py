"""What a fit varies: the DCT coefficients of the heights, and what else is unknown about the pictures."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from ..core.errors import ArgumentError
from ..core.precision import numbers, require_fit
from ..scene.heightfield import Heightfield
from .view import KNOWN, View

# The height of a terrain's longest modes, as a share of the footprint's longer side. A mode's height falls as 1 / frequency
# from there: as modes of one slope do.
_STEEPNESS = 0.25
# As a share of the median: along a mode of less curvature the loss counts as flat, and its unit stays as it is.
_LEAST_CURVATURE = 1e-6


class Unknowns(eqx.Module):
    """What a solver varies; None for what is known.

    Attributes:
      coefficients: of the DCT modes that are added to the heights, in units of `Basis.scale`, shape (my, mx): that of the
        heights, or more, see `Basis.padding`.
      albedo: a factor for each texel of the albedo (or for all of them: (1, 1)) in each channel, shape (ty, tx, c).
      exposures: a factor for each picture, shape (pictures,).
      offsets: added to each picture, radiance, shape (pictures,).
      view: how far the light and the camera of each picture are moved, in units of `Problem.view_unit`, shapes (pictures, 2)
        and (pictures, 6).
    """

    coefficients: Float[Array, "my mx"]
    albedo: Float[Array, "ty tx c"] | None = None
    exposures: Float[Array, " pictures"] | None = None
    offsets: Float[Array, " pictures"] | None = None
    view: View = KNOWN


class Basis(eqx.Module):
    """Heights as `base` plus a sum of DCT-II modes (products of two cosines), each in a unit of its own.

    Shading sees slopes, so modes of one slope change a picture by as much, whatever their wavelength: in units of one slope
    the solver's linear problem is well conditioned, and neighbouring heights move together. That is preconditioning by
    smoothness as in Nicolet et al., Large steps in inverse rendering of geometry (2021), whose (I + λL)⁻¹ is diagonal here,
    with the power that fits shading. `balanced_units` goes further (Jacobi's preconditioner): units in which the loss has the
    same curvature along every mode. As a change of variables both serve solvers that take no preconditioner.

    The normal derivative of every mode is zero at the edge of the grid. Where that would constrain the heights too much (a
    prior with correlated errors), the grid is padded on each side by vertices that no picture shows.

    Attributes:
      rows, columns: the orthonormal DCT-II matrices of the two axes, a cosine in each row, shapes (my, my) and (mx, mx).
      scale: the height of a mode whose coefficient is 1; zero for modes that are not varied, shape (my, mx).
      prior_amplitude: the standard deviation of each coefficient over terrains, shape (my, mx).
      base: the surface where all coefficients are zero, shape (my, mx).
      padding: vertices beyond the terrain on each side: (my - ny) / 2 and (mx - nx) / 2.
    """

    rows: Float[Array, "my my"]
    columns: Float[Array, "mx mx"]
    scale: Float[Array, "my mx"]
    prior_amplitude: Float[Array, "my mx"]
    base: Float[Array, "my mx"]
    padding: tuple[int, int] = eqx.field(static=True)

    def heights(self, coefficients: Float[Array, "my mx"]) -> Float[Array, "ny nx"]:
        return self.crop(self.surface(coefficients))

    def surface(self, coefficients: Float[Array, "my mx"]) -> Float[Array, "my mx"]:
        """The heights with their padding."""
        return self.base + _product(self.rows.T, _product(self.scale * coefficients, self.columns))

    def crop(self, values: Any) -> Any:
        """An array of shape (my, mx) without its padding, shape (ny, nx)."""
        y, x = self.padding
        my, mx = values.shape
        return values[y : my - y, x : mx - x]

    def transform(self, values: Float[Array, "my mx"]) -> Float[Array, "my mx"]:
        """The orthonormal DCT-II of `values`."""
        return _product(self.rows, _product(values, self.columns.T))


def _product(a: jax.Array, b: jax.Array) -> jax.Array:
    # Products of matrices, not jax.scipy.fft: in single precision, two cores, one transform and its transpose take 0.02, 0.22,
    # 2.1 and 5.5 ms at 32², 128², 256² and 512², by idctn 0.04, 0.57, 4.8 and 10.8 ms. The FFT rounds to 2e-7 of the largest
    # value, the products to 1e-6, both far below LSMR's tolerance; either is less than 1 % of a picture up to 256².
    return jnp.matmul(a, b, precision=lax.Precision.HIGHEST)


def make_basis(
    field: Heightfield, base: Float[np.ndarray, "my mx"], cutoff: float = 1.0, units: Float[np.ndarray, "my mx"] | None = None
) -> Basis:
    """The modes up to a share `cutoff` of the highest frequency, about `base`.

    Args:
      field: whose heights they are; only its size, spacing and precision count.
      base: may be padded, see `pad`.
      cutoff: modes above are not varied; nor is the mean of all heights, unless it is 1.
      units: the height of each mode whose coefficient is 1; None: those of one slope.
    """
    ny, nx = base.shape
    padding = ((ny - field.heights.shape[0]) // 2, (nx - field.heights.shape[1]) // 2)
    dtype = field.heights.dtype
    longest = max((ny - 1) * field.dy, (nx - 1) * field.dx)
    # Half periods that fit into the longer side.
    frequency = np.hypot(
        np.arange(ny)[:, None] * (longest / ((ny - 1) * field.dy)), np.arange(nx)[None, :] * (longest / ((nx - 1) * field.dx))
    )
    scale = _STEEPNESS * longest * np.sqrt(ny * nx) / (1 + frequency)
    varied = (np.arange(ny)[:, None] < max(2, cutoff * ny)) & (np.arange(nx)[None, :] < max(2, cutoff * nx))
    # The mean height shows only in how far things shift and grow in the picture: while high frequencies are left out, what
    # they leave unexplained would be taken for it (0.5 of the footprint in a case of 0.1 relief).
    varied[0, 0] = cutoff >= 1
    units = scale if units is None else units
    prior_amplitude = scale / units / (1 + frequency)
    rows, columns = jnp.asarray(dct_matrix(ny), dtype), jnp.asarray(dct_matrix(nx), dtype)
    return Basis(
        rows,
        columns,
        jnp.asarray(units * varied, dtype),
        jnp.asarray(prior_amplitude, dtype),
        jnp.asarray(base, dtype),
        padding,
    )


def balanced_units(
    slope_units: Float[np.ndarray, "my mx"], curvature: Float[np.ndarray, "my mx"], mean_only: bool = False
) -> tuple[Float[np.ndarray, "my mx"], float]:
    """Units of the modes in which the loss has the same curvature along each of them, and that curvature.

    It is the median of those in units of one slope. Along the mean of all heights, which pictures hardly show, the curvature in
    units of one slope is ten thousand times less than along other modes.

    Args:
      slope_units: `Basis.scale` of all modes in units of one slope.
      curvature: of the loss along each mode, for a mode of unit height; 0: unknown.
      mean_only: leave all but the mean in units of one slope.
    """
    per_slope = curvature * slope_units**2
    if not (per_slope > 0).any():
        return slope_units, 1.0
    typical = float(np.median(per_slope[per_slope > 0]))
    relative = per_slope / typical
    balanced = slope_units / np.sqrt(np.where(relative > _LEAST_CURVATURE, relative, 1))
    if mean_only:
        mean = max(balanced[0, 0], slope_units[0, 0])
        balanced = slope_units.copy()
        balanced[0, 0] = mean
    return balanced, typical


def pad(values: Float[np.ndarray, "ny nx"], padding: tuple[int, int]) -> Float[np.ndarray, "my mx"]:
    """`values` with their border repeated on each side."""
    return np.pad(values, [(n, n) for n in padding], mode="edge")


def dct_matrix(n: int) -> Float[np.ndarray, "n n"]:
    """The orthonormal DCT-II of n values: a cosine in each row, from the constant one up."""
    k = np.arange(n)
    matrix = np.sqrt(2 / n) * np.cos(np.pi / n * k[:, None] * (k[None, :] + 0.5))
    matrix[0] /= np.sqrt(2)
    return matrix


def make_heights(name: str, value: Any, field: Heightfield) -> Float[np.ndarray, "ny nx"]:
    """Heights at the vertices of `field` from a number (flat), or from a grid of any size over the same footprint."""
    shape = field.heights.shape
    heights = np.array(numbers(value), np.float64)
    if heights.shape == ():
        heights = np.full(shape, heights)
    if heights.ndim != 2 or min(heights.shape) < 2:
        raise ArgumentError("fit", name, f"must be a number or heights of at least 2x2, its shape is {heights.shape}")
    if not np.isfinite(heights).all():
        iy, ix = np.argwhere(~np.isfinite(heights))[0]
        raise ArgumentError("fit", name, f"must be finite, row {iy} column {ix} is {heights[iy, ix]}")
    require_fit(heights, field.heights.dtype, f"fit, {name}")
    return heights if heights.shape == shape else resample(heights, shape)


def resample(heights: Float[np.ndarray, "my mx"], shape: tuple[int, ...]) -> Float[np.ndarray, "ny nx"]:
    """The bilinear surface through a grid over the same footprint, at the vertices of another grid."""
    for axis, count in enumerate(shape):
        old = heights.shape[axis]
        at = np.linspace(0, old - 1, count)
        low = np.minimum(at.astype(int), old - 2)
        share = np.expand_dims(at - low, 1 - axis)
        heights = (1 - share) * np.take(heights, low, axis) + share * np.take(heights, low + 1, axis)
    return heights
