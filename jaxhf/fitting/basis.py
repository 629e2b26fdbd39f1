"""What a fit varies: heights as a sum of cosines of all wavelengths, and what else is unknown about the pictures."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from ..scene.heightfield import Heightfield

# The size of the longest waves of a terrain, as a share of the footprint's longer side. It falls with the square of the
# frequency, as in most fractals and landscapes.
_STEEPNESS = 0.25


class Unknowns(eqx.Module):
    """What a solver varies; None for what is known.

    Attributes:
      waves: amplitudes of the cosines that are added to the heights, in units of `Basis.scale`, shape (my, mx): that of
        the heights, or more, see `Basis.margin`.
      albedo: a factor for each texel of the albedo (or for all of them: (1, 1)) in each channel, shape (ty, tx, c).
      exposures: a factor for each picture, shape (pictures,).
      offsets: added to each picture, radiance, shape (pictures,).
    """

    waves: Float[Array, "my mx"]
    albedo: Float[Array, "ty tx c"] | None = None
    exposures: Float[Array, " pictures"] | None = None
    offsets: Float[Array, " pictures"] | None = None


class Basis(eqx.Module):
    """Heights as `base` plus a sum of cosines, the DCT-II, each in units of about one slope.

    Shading sees slopes, so waves of one slope change a picture by as much, whatever their length, and the solver's
    linear problem is well conditioned; neighbouring heights move together. That is preconditioning by smoothness as in Nicolet
    et al., Large steps in inverse rendering of geometry (2021), whose (I + λL)⁻¹ is diagonal here, with the power that fits
    shading; as a change of variables it serves solvers that take no preconditioner.

    Every cosine is level where the surface ends. Where that would say too much (a prior whose errors hang together),
    the surface goes on beyond the terrain by `margin` vertices on each side, which no picture shows.

    Attributes:
      rows, columns: the orthonormal cosines, a row each, shapes (my, my) and (mx, mx).
      scale: the height of a wave of amplitude 1; zero for those that are left out, shape (my, mx).
      usual: the amplitude that a wave may have in some terrain, in those units, shape (my, mx).
      base: the surface where all amplitudes are zero, shape (my, mx).
      margin: (my - ny) / 2 and (mx - nx) / 2.
    """

    rows: Float[Array, "my my"]
    columns: Float[Array, "mx mx"]
    scale: Float[Array, "my mx"]
    usual: Float[Array, "my mx"]
    base: Float[Array, "my mx"]
    margin: tuple[int, int] = eqx.field(static=True)

    def heights(self, waves: Float[Array, "my mx"]) -> Float[Array, "ny nx"]:
        return self.inside(self.surface(waves))

    def surface(self, waves: Float[Array, "my mx"]) -> Float[Array, "my mx"]:
        # Two products of matrices cost less than 1 % of a picture up to 256 x 256 heights, and are real throughout.
        return self.base + _product(self.rows.T, _product(self.scale * waves, self.columns))

    def inside(self, surface: Any) -> Any:
        """What lies on the terrain, of an array of shape (my, mx)."""
        y, x = self.margin
        my, mx = surface.shape
        return surface[y : my - y, x : mx - x]

    def amplitudes(self, values: Float[Array, "my mx"]) -> Float[Array, "my mx"]:
        """Of the orthonormal cosines whose sum is `values`."""
        return _product(self.rows, _product(values, self.columns.T))


def _product(a: jax.Array, b: jax.Array) -> jax.Array:
    return jnp.matmul(a, b, precision=lax.Precision.HIGHEST)


def make_basis(field: Heightfield, base: Float[np.ndarray, "my mx"], cut: float = 1.0, lift: float = 1.0) -> Basis:
    """The waves up to a share `cut` of the highest frequency, about `base`; `lift` enlarges the constant one's unit."""
    ny, nx = base.shape
    margin = ((ny - field.heights.shape[0]) // 2, (nx - field.heights.shape[1]) // 2)
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
    unit = jnp.asarray(scale * kept, dtype)
    rows, columns = jnp.asarray(cosines(ny), dtype), jnp.asarray(cosines(nx), dtype)
    return Basis(rows, columns, unit, jnp.asarray(usual, dtype), jnp.asarray(base, dtype), margin)


def beyond(heights: Float[np.ndarray, "ny nx"], margin: tuple[int, int]) -> Float[np.ndarray, "my mx"]:
    """Goes on as at the border for `margin` vertices on each side."""
    return np.pad(heights, [(n, n) for n in margin], mode="edge")


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
