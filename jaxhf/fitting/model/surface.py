"""What a fit varies: the DCT modes of a surface, and what else is unknown about the pictures."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse
from jax import lax
from jaxtyping import Array, Bool, Float

from ...core.errors import ArgumentError
from ...core.precision import numbers, require_fit
from ...scene.heightfield import Heightfield
from .view import KNOWN, View

# The height of a terrain's longest modes, as a share of the footprint's longer side. A mode's height falls as 1 / frequency
# from there: as modes of one slope do.
_STEEPNESS = 0.25


class Unknowns(eqx.Module):
    """What a fit varies; None for what is known.

    Attributes:
      coefficients: of the DCT modes that are added to `Basis.base`, in units of `Basis.scale`, shape (my, mx): that of the
        heights, or more, see `Basis.padding`.
      albedo: a factor for each texel of the albedo (or for all of them: (1, 1)) in each channel (or for all of them: c = 1),
        shape (ty, tx, c); or the modes of their logarithms, see `AlbedoField`.
      exposures: a factor for each picture, shape (pictures,).
      offsets: added to each picture, in units of `Problem.bright`, shape (pictures,).
      view: how far the light and the camera of each picture are moved, in units of `Problem.view_unit`, shapes (pictures, 2)
        and (pictures, 6).
    """

    coefficients: Float[Array, "my mx"]
    albedo: Float[Array, "ty tx c"] | None = None
    exposures: Float[Array, " pictures"] | None = None
    offsets: Float[Array, " pictures"] | None = None
    view: View = KNOWN

    def at_base(self) -> "Unknowns":
        """The same but for the modes, which are 0: those of a surface that has become the base."""
        return self.with_modes(jax.device_put(np.zeros(self.coefficients.shape, self.coefficients.dtype)))

    def with_modes(self, coefficients: Any) -> Any:
        return eqx.tree_at(lambda u: u.coefficients, self, coefficients, is_leaf=lambda leaf: leaf is None)

    def without_modes(self) -> Any:
        """All but the coefficients, which are None."""
        return self.with_modes(None)

    @property
    def count(self) -> int:
        return sum(leaf.size for leaf in jax.tree.leaves(self))


class Window(NamedTuple):
    """Heights of a terrain: ny rows from row y on, nx columns from column x on."""

    y: int
    x: int
    ny: int
    nx: int

    @property
    def place(self) -> tuple[slice, slice]:
        return slice(self.y, self.y + self.ny), slice(self.x, self.x + self.nx)

    def rim(self, shape: tuple[int, ...], depth: int) -> Bool[np.ndarray, "ny nx"]:
        """Where it is at most so many vertices from a side beyond which a terrain of that shape goes on."""
        found = np.zeros((self.ny, self.nx), bool)
        found[:depth] |= self.y > 0
        found[self.ny - depth :] |= self.y + self.ny < shape[0]
        found[:, :depth] |= self.x > 0
        found[:, self.nx - depth :] |= self.x + self.nx < shape[1]
        return found


class Basis(eqx.Module):
    """A surface as `base` plus a sum of DCT-II modes (products of two cosines), each in a unit of its own.

    Shading sees slopes, so modes of one slope change a picture by as much, whatever their wavelength: in units of one slope
    the linear problems are well conditioned, and neighbouring heights move together. That is preconditioning by smoothness as
    in Nicolet et al., Large steps in inverse rendering of geometry (2021), whose (I + λL)⁻¹ is diagonal here, with the power
    that fits shading. `balanced` goes further (Jacobi's preconditioner): units in which the loss has the same curvature
    along every mode.

    The normal derivative of every mode is zero at the edge of the grid. Where that would constrain the heights too much (a
    prior with correlated errors), the grid is padded on each side by vertices that no picture shows.

    Attributes:
      rows, columns: the orthonormal DCT-II matrices of the two axes, a cosine in each row, shapes (my, my) and (mx, mx).
      scale: the height of a mode whose coefficient is 1; zero for modes that are not varied, shape (my, mx).
      base: the surface where all coefficients are zero, shape (my, mx).
      free: 0 where heights are held, else 1, shape (my, mx); None: all are free.
      padding: vertices beyond the terrain on each side: (my - ny) / 2 and (mx - nx) / 2.
    """

    rows: Float[Array, "my my"]
    columns: Float[Array, "mx mx"]
    scale: Float[Array, "my mx"]
    base: Float[Array, "my mx"]
    free: Float[Array, "my mx"] | None
    padding: tuple[int, int] = eqx.field(static=True)

    def heights(self, coefficients: Float[Array, "my mx"]) -> Float[Array, "ny nx"]:
        return self.crop(self.surface(coefficients))

    def surface(self, coefficients: Float[Array, "my mx"]) -> Float[Array, "my mx"]:
        """The heights with their padding."""
        change = self.synthesis(self.scale * coefficients)
        return self.base + (change if self.free is None else self.free * change)

    def crop(self, values: Any) -> Any:
        """An array of shape (my, mx) without its padding, shape (ny, nx)."""
        y, x = self.padding
        my, mx = values.shape
        return values[y : my - y, x : mx - x]

    # Products of matrices, not jax.scipy.fft: in single precision, two cores, one transform and its transpose take 0.02, 0.22,
    # 2.1 and 5.5 ms at 32², 128², 256² and 512², by idctn 0.04, 0.57, 4.8 and 10.8 ms. The FFT rounds to 2e-7 of the largest
    # value, the products to 1e-6, both far below what steps are solved to.
    def synthesis(self, modes: Float[Array, "my mx"]) -> Float[Array, "my mx"]:
        """The sum of modes, of unit length each."""
        return _product(self.rows.T, _product(modes, self.columns))

    def analysis(self, values: Float[Array, "my mx"]) -> Float[Array, "my mx"]:
        """The orthonormal DCT-II of `values`, the inverse of `synthesis`."""
        return _product(self.rows, _product(values, self.columns.T))


def _product(a: jax.Array, b: jax.Array) -> jax.Array:
    return jnp.matmul(a, b, precision=lax.Precision.HIGHEST)


def slope_units(shape: tuple[int, ...], dx: float, dy: float) -> tuple[Float[np.ndarray, "my mx"], Float[np.ndarray, "my mx"]]:
    """The height of each mode of one slope, in a surface of this shape and spacing, and its frequency: how many half periods
    fit into the longer side."""
    ny, nx = shape
    longest = max((ny - 1) * dy, (nx - 1) * dx)
    along = [np.arange(n) * (longest / ((n - 1) * d)) for n, d in ((ny, dy), (nx, dx))]
    frequency = np.hypot(along[0][:, None], along[1][None, :])
    return _STEEPNESS * longest * np.sqrt(ny * nx) / (1 + frequency), frequency


def make_basis(
    field: Heightfield,
    base: Float[np.ndarray, "my mx"],
    units: Float[np.ndarray, "my mx"],
    cutoff: float = 1.0,
    free: Any = None,
) -> Basis:
    """The modes up to a share `cutoff` of the highest frequency about `base`, which may be padded; without the mean of all
    heights, unless the share is 1. `units`: the height of each mode whose coefficient is 1; `free`: see `Basis`."""
    (ny, nx), dtype = base.shape, field.heights.dtype
    padding = ((ny - field.heights.shape[0]) // 2, (nx - field.heights.shape[1]) // 2)
    varied = (np.arange(ny)[:, None] < max(2, cutoff * ny)) & (np.arange(nx)[None, :] < max(2, cutoff * nx))
    # The mean height shows only in how far things shift and grow in the picture: while high frequencies are left out, what
    # they leave unexplained would be taken for it (0.5 of the footprint in a case of 0.1 relief).
    varied[0, 0] = cutoff >= 1
    rows, columns = (jnp.asarray(dct_matrix(n), dtype) for n in (ny, nx))
    free = None if free is None else jnp.asarray(free, dtype)
    return Basis(rows, columns, jnp.asarray(units * varied, dtype), jnp.asarray(base, dtype), free, padding)


def padding(field: Heightfield, length: float | None) -> tuple[int, int]:
    """How many vertices to add beyond each border, in y and in x: one correlation length, at most half of the terrain's size.

    DCT modes have no slope across the edge of their grid, and errors across it are mirrored: at distance zero if the grid
    ended at the border, at two lengths with this padding. Matérn's correlation has its inflection at 0 to 2 lengths, beyond
    which slopes are no longer correlated; so the slopes at the border are free. The errors themselves are correlated over
    longer distances (Lindgren, Rue and Lindström, 2011, A.4), but more padding costs more steps.
    """
    if length is None:
        return 0, 0
    y, x = (min(math.ceil(length / d), n // 2) for n, d in zip(field.heights.shape, (field.dy, field.dx), strict=True))
    return y, x


def pad(values: Float[np.ndarray, "ny nx"], padding: tuple[int, int]) -> Float[np.ndarray, "my mx"]:
    """`values` with their border repeated on each side."""
    return np.pad(values, [(n, n) for n in padding], mode="edge")


def dct_matrix(n: int) -> Float[np.ndarray, "n n"]:
    """The orthonormal DCT-II of n values: a cosine in each row, from the constant one up."""
    k = np.arange(n)
    matrix = np.sqrt(2 / n) * np.cos(np.pi / n * k[:, None] * (k[None, :] + 0.5))
    matrix[0] /= np.sqrt(2)
    return matrix


def laplacian(shape: tuple[int, ...], spacing: Sequence[float]) -> Float[np.ndarray, "my mx"]:
    """The eigenvalue of each DCT mode for minus the Laplacian, by second differences over this spacing (y, x)."""
    y, x = [(2 - 2 * np.cos(np.pi * np.arange(n) / n)) / d**2 for n, d in zip(shape, spacing, strict=True)]
    return y[:, None] + x[None, :]


def make_heights(owner: str, name: str, value: Any, field: Heightfield) -> Float[np.ndarray, "ny nx"]:
    """Heights at the vertices of `field` from a number (flat), or from a grid of any size over the same footprint."""
    shape = field.heights.shape
    heights = np.array(numbers(value), np.float64)
    if heights.shape == ():
        heights = np.full(shape, heights)
    if heights.ndim != 2 or min(heights.shape) < 2:
        raise ArgumentError(owner, name, f"must be a number or heights of at least 2x2, its shape is {heights.shape}")
    if not np.isfinite(heights).all():
        iy, ix = np.argwhere(~np.isfinite(heights))[0]
        raise ArgumentError(owner, name, f"must be finite, row {iy} column {ix} is {heights[iy, ix]}")
    require_fit(heights, field.heights.dtype, owner, name)
    return heights if heights.shape == shape else resample(heights, shape)


def with_seam(field: Heightfield, heights: Float[np.ndarray, "ny nx"]) -> Float[np.ndarray, "ny nx"]:
    """Heights with those of the field where its surface goes on in another one, which a fit holds."""
    if field.seam is None:
        return heights
    return np.where(np.isfinite(np.asarray(field.seam)).all(-1), np.asarray(field.heights), heights)


def resample(heights: Float[np.ndarray, "my mx"], shape: tuple[int, ...]) -> Float[np.ndarray, "ny nx"]:
    """The bilinear surface through a grid over the same footprint, at the vertices of another grid."""
    for count in shape:  # rows and then columns, which each turn makes rows
        heights = (interpolation(np.linspace(0, len(heights) - 1, count), len(heights)) @ heights).T
    return heights


def interpolation(at: Float[np.ndarray, " m"], count: int) -> Any:
    """The sparse matrix that takes so many values in a row to those at places between them, linearly."""
    low = np.minimum(at.astype(int), count - 2)
    entries = np.concatenate([1 - (at - low), at - low])
    places = np.tile(np.arange(at.size), 2), np.concatenate([low, low + 1])
    return scipy.sparse.csr_array((entries, places), shape=(at.size, count))
