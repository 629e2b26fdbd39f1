"""Powers of two: numbers by which a division changes no bit, and the sizes of blocks."""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Float


def floor_to_power_of_two(value: Float[jax.Array, "*shape"]) -> Float[jax.Array, "*shape"]:
    """The largest powers of two that are not above positive numbers, without a derivative.

    They are clamped to 2^-100..2^100, so that their reciprocals are normal numbers, and exact.
    """
    value = jnp.clip(lax.stop_gradient(value), 2.0**-100, 2.0**100)
    integer, exponent_bits = (jnp.uint32, 0x7F800000) if value.dtype == jnp.float32 else (jnp.uint64, 0x7FF0000000000000)
    bits = lax.bitcast_convert_type(value, integer) & jnp.asarray(exponent_bits, integer)
    return lax.bitcast_convert_type(bits, value.dtype)


def next_power_of_two(count: int) -> int:
    """The least power of two that is at least 2 and `count`."""
    return 1 << max(1, (count - 1).bit_length())
