"""Where in a pixel its samples lie, and how they become its value."""

import math

import jax
import jax.numpy as jnp
from jaxtyping import Float, Int


def grid_side(samples: int) -> int:
    """The side n of the n x n samples a pixel that hold at least `samples`."""
    return math.isqrt(samples - 1) + 1


def sample_offset(k: Int[jax.Array, "*n"], side: int, dtype) -> tuple[Float[jax.Array, "*n"], Float[jax.Array, "*n"]]:
    """The k-th sample's position in its pixel, 0..1 each way: the centres of a regular grid.

    With the box filter of a pixel's width, the pixel is the mean of its samples.
    """
    return ((k % side).astype(dtype) + 0.5) / side, ((k // side).astype(dtype) + jnp.asarray(0.5, dtype)) / side
