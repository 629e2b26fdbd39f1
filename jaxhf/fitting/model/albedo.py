"""An albedo that varies over the terrain: its logarithm as a Gaussian field, by DCT modes."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from .surface import dct_matrix, laplacian


class AlbedoField(eqx.Module):
    """Factors of an albedo by the DCT modes of their logarithms, in units of a root mean square of 1 over the terrain.

    So each changes a picture by about as much as a mode of one slope does; see `Basis`.

    Attributes:
      rows, columns: the DCT-II matrices of the two axes, their rows of root mean square 1, shapes (ty, ty) and (tx, tx).
      weight: 1 / the standard deviation of each mode, shape (ty, tx, 1).
    """

    rows: Float[Array, "ty ty"]
    columns: Float[Array, "tx tx"]
    weight: Float[Array, "ty tx 1"]

    def factors(self, modes: Float[Array, "ty tx c"]) -> Float[Array, "ty tx c"]:
        """What the albedo is multiplied by."""
        return jnp.exp(_transformed(self.rows.T, self.columns.T, modes))

    def modes(self, factors: Float[Array, "ty tx c"]) -> Float[Array, "ty tx c"]:
        """The inverse of `factors`."""
        return _transformed(self.rows, self.columns, jnp.log(factors)) / (len(self.rows) * len(self.columns))


def _transformed(rows: Any, columns: Any, values: Float[Array, "ty tx c"]) -> Float[Array, "ty tx c"]:
    return jnp.einsum("ki,ijc,lj->klc", rows, values, columns, precision=lax.Precision.HIGHEST)


def make_albedo_field(shape: tuple[int, ...], spacing: tuple[float, ...], std: float, length: float, dtype: Any) -> AlbedoField:
    """The field of these texels or vertices, of spacing (y, x), whose logarithm has this deviation and the correlation
    exp(-distance / length).

    That is Matérn's of smoothness 1/2, as patches with sharp borders have it; heights are smoother. The amplitudes of its modes
    go as (1 + (length · frequency)²)^(-3/4).
    """
    amplitude = (1 + length**2 * laplacian(shape, spacing)) ** -0.75
    amplitude = std * amplitude / np.sqrt(np.sum(amplitude**2))  # the squares of all modes add up to the field's variance
    rows, columns = (jnp.asarray(np.sqrt(n) * dct_matrix(n), dtype) for n in shape)
    return AlbedoField(rows, columns, jnp.asarray(1 / amplitude[:, :, None], dtype))
