"""What is known of the heights beforehand."""

import math
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..core.errors import ArgumentError
from ..core.precision import numbers
from ..scene.heightfield import Heightfield
from .basis import dct_matrix, make_heights, pad


class Prior(eqx.Module):
    """Heights that are known beforehand, and how well.

    Attributes:
      heights: shape (my, mx), padded as `Basis.base` is.
      weight: 1 / their standard deviation, shape (my, mx). Where errors are correlated: 1 / the standard deviation that is left
        when each DCT coefficient of the errors is divided by its amplitude.
      stiffness: 1 / the amplitude of each DCT coefficient of the errors over their deviation; None: errors are independent.
    """

    heights: Float[Array, "my mx"]
    weight: Float[Array, "my mx"]
    stiffness: Float[Array, "my mx"] | None = None


def make_prior(field: Heightfield, prior: Any, std: Any, length: float | int | None, exponent: float | int) -> Prior | None:
    """The prior of the heights of `field`; `length` and `exponent` are `fit`'s prior_length and prior_exponent."""
    shape, dtype = field.heights.shape, field.heights.dtype
    if prior is None:
        for name, value in (("prior_std", std), ("prior_length", length)):
            if value is not None:
                raise ArgumentError("fit", name, "must stand with a prior, there is none")
        return None
    if std is None:
        raise ArgumentError("fit", "prior", "must stand with prior_std, how far it may be off")
    std = np.asarray(numbers(std), np.float64)
    if std.shape not in ((), shape):
        raise ArgumentError(
            "fit", "prior_std", f"must be a number or of shape {shape}, as the heights; its shape is {std.shape}"
        )
    if not (std > 0).all():
        given = f"{std:g}" if std.ndim == 0 else f"{std.min():g} to {std.max():g}"
        raise ArgumentError("fit", "prior_std", f"must be positive, it is {given}")
    padding = prior_padding(field, length)
    if length is not None:
        _require_plausible(field, length)
    heights = pad(make_heights("prior", prior, field), padding)
    weight, stiffness = pad(np.broadcast_to(1 / std, shape), padding), None
    if length is not None:
        stiffness = _stiffness(field, heights.shape, length, exponent)
        rows, columns = (dct_matrix(n) ** 2 for n in heights.shape)
        weight = weight * np.sqrt(rows.T @ stiffness**-2 @ columns)
        stiffness = jnp.asarray(stiffness, dtype)
    return Prior(jnp.asarray(heights, dtype), jnp.asarray(weight, dtype), stiffness)


def _require_plausible(field: Heightfield, length: float) -> None:
    """Refuses a correlation length that no terrain of this size and spacing can show, such as one in cells."""
    cell = min(field.dx, field.dy)
    side = max((n - 1) * d for n, d in zip(field.heights.shape, (field.dy, field.dx), strict=True))
    if not cell * (1 - 1e-6) <= length <= side * (1 + 1e-6):
        raise ArgumentError(
            "fit",
            "prior_length",
            f"must lie from one cell to the terrain's longer side, {cell:.6g} to {side:.6g}; it is {length:.6g}, or "
            f"{length / cell:.3g} cells. It is in the unit of dx and dy: {length:.6g} cells would be {length * cell:.6g}",
        )


def prior_padding(field: Heightfield, length: float | None) -> tuple[int, int]:
    """How many vertices to add beyond each border, in y and in x: one correlation length, at most half of the terrain's size.

    DCT modes have no slope across the edge of their grid, and errors across it are mirrored: at distance zero if the grid
    ended at the border, at two lengths with this padding. Whatever its exponent, Matérn's correlation has its inflection at 0
    to 2 lengths, beyond which slopes are no longer correlated; so the slopes at the border are free. The errors themselves are
    correlated over longer distances (Lindgren, Rue and Lindström, 2011, A.4), but more padding costs more steps.
    """
    if length is None:
        return 0, 0
    steps = (field.dy, field.dx)
    y, x = (min(math.ceil(length / d), n // 2) for n, d in zip(field.heights.shape, steps, strict=True))
    return y, x


def _stiffness(field: Heightfield, shape: tuple[int, ...], length: float, exponent: float) -> Float[np.ndarray, "my mx"]:
    """(1 - length² · Laplacian)^(exponent / 2) of each DCT mode, the Laplacian being that of second differences."""
    steps = [(2 - 2 * np.cos(np.pi * np.arange(n) / n)) / d**2 for n, d in zip(shape, (field.dy, field.dx), strict=True)]
    return (1 + length**2 * (steps[0][:, None] + steps[1][None, :])) ** (exponent / 2)
