"""What a fit varies: heights as a sum of cosines of all wavelengths, and what else is unknown about the pictures."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from ._heightfield import Heightfield

# The size of the longest waves of a terrain, as a share of the footprint's longer side. It falls with the square of the
# frequency, as in most fractals and landscapes.
_STEEPNESS = 0.25


class Unknowns(eqx.Module):
    """What a solver varies; None for what is known.

    Attributes:
      waves: amplitudes of the cosines that are added to the heights, in units of `Basis.scale`, shape (ny, nx).
      albedo: a factor for each texel of the albedo (or for all of them: (1, 1)) in each channel, shape (ty, tx, c).
      exposures: a factor for each picture, shape (pictures,).
      offsets: added to each picture, radiance, shape (pictures,).
    """

    waves: Float[Array, "ny nx"]
    albedo: Float[Array, "ty tx c"] | None = None
    exposures: Float[Array, " pictures"] | None = None
    offsets: Float[Array, " pictures"] | None = None


class Basis(eqx.Module):
    """Heights as `base` plus a sum of cosines, the DCT-II, each in units of about one slope.

    Shading sees slopes, so waves of one slope change a picture by as much, whatever their length, and the solver's
    linear problem is well conditioned; neighbouring heights move together. That is preconditioning by smoothness as in Nicolet
    et al., Large steps in inverse rendering of geometry (2021), whose (I + λL)⁻¹ is diagonal here, with the power that fits
    shading; as a change of variables it serves solvers that take no preconditioner.

    Attributes:
      rows, columns: the orthonormal cosines, a row each, shapes (ny, ny) and (nx, nx).
      scale: the height of a wave of amplitude 1; zero for those that are left out, shape (ny, nx).
      usual: the amplitude that a wave may have in some terrain, in those units, shape (ny, nx).
      base: heights where all amplitudes are zero, shape (ny, nx).
    """

    rows: Float[Array, "ny ny"]
    columns: Float[Array, "nx nx"]
    scale: Float[Array, "ny nx"]
    usual: Float[Array, "ny nx"]
    base: Float[Array, "ny nx"]

    def heights(self, waves: Float[Array, "ny nx"]) -> Float[Array, "ny nx"]:
        # Two products of matrices cost less than 1 % of a picture up to 256 x 256 heights, and are real throughout.
        return self.base + _product(self.rows.T, _product(self.scale * waves, self.columns))

    def amplitudes(self, values: Float[Array, "ny nx"]) -> Float[Array, "ny nx"]:
        """Of the orthonormal cosines whose sum is `values`."""
        return _product(self.rows, _product(values, self.columns.T))


def _product(a: jax.Array, b: jax.Array) -> jax.Array:
    return jnp.matmul(a, b, precision=lax.Precision.HIGHEST)


def make_basis(field: Heightfield, base: Float[np.ndarray, "ny nx"], cut: float = 1.0, lift: float = 1.0) -> Basis:
    """The waves up to a share `cut` of the highest frequency, about `base`; `lift` enlarges the constant one's unit."""
    ny, nx = field.heights.shape
    dtype = field.heights.dtype
    longest = max((ny - 1) * field.dy, (nx - 1) * field.dx)
    # Half periods that fit into the longer side.
    frequency = np.hypot(
        np.arange(ny)[:, None] * (longest / ((ny - 1) * field.dy)), np.arange(nx)[None, :] * (longest / ((nx - 1) * field.dx))
    )
    scale = _STEEPNESS * longest * np.sqrt(ny * nx) / (1 + frequency)
    kept = (np.arange(ny)[:, None] < max(2, cut * ny)) & (np.arange(nx)[None, :] < max(2, cut * nx))
    # The height of everything shows only in how far things shift and grow in the picture: while short waves are left
    # out, what they leave unexplained would be taken for it (0.5 of the footprint in a case of 0.1 relief).
    kept[0, 0] = cut >= 1
    usual = 1 / (1 + frequency)
    scale[0, 0] *= lift
    usual[0, 0] /= lift
    return Basis(*(jnp.asarray(value, dtype) for value in (cosines(ny), cosines(nx), scale * kept, usual, base)))


def cosines(n: int) -> Float[np.ndarray, "n n"]:
    """The orthonormal DCT-II of n values, a cosine each row, from the constant one up."""
    k = np.arange(n)
    waves = np.sqrt(2 / n) * np.cos(np.pi / n * k[:, None] * (k[None, :] + 0.5))
    waves[0] /= np.sqrt(2)
    return waves


def resample(heights: Float[np.ndarray, "my mx"], shape: tuple[int, ...]) -> Float[np.ndarray, "ny nx"]:
    """The bilinear surface through a grid over the same footprint, at the vertices of another grid."""
    for axis, count in enumerate(shape):
        old = heights.shape[axis]
        at = np.linspace(0, old - 1, count)
        low = np.minimum(at.astype(int), old - 2)
        share = np.expand_dims(at - low, 1 - axis)
        heights = (1 - share) * np.take(heights, low, axis) + share * np.take(heights, low + 1, axis)
    return heights
