"""Vectors of three numbers: lengths and directions that neither over- nor underflow."""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Float

from .types import Flag, Scalar, Vector


def dot(a: Vector, b: Vector) -> Scalar:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def lesser(a: Scalar, b: Scalar) -> Scalar:
    """The minimum of two numbers: one instruction, where that by NumPy's rules for nan and signed zeros takes four."""
    return jnp.where(a < b, a, b)


def greater(a: Scalar, b: Scalar) -> Scalar:
    return jnp.where(a > b, a, b)


def largest_component(v: Vector) -> Scalar:
    """max |v_i|. Written out, as XLA on the CPU calls a library for a reduction, however short; nan is passed over."""
    return greater(greater(jnp.abs(v[0]), jnp.abs(v[1])), jnp.abs(v[2]))


def finite(v: Vector) -> Flag:
    return jnp.isfinite(v[0]) & jnp.isfinite(v[1]) & jnp.isfinite(v[2])


def unit(v: Vector) -> Vector:
    """`v` at length 1; a zero vector stays zero, with zero derivative. Neither over- nor underflows on the way."""
    largest = lax.stop_gradient(largest_component(v))  # any factor does; its own derivative has its square in it
    zero = largest == 0
    largest = jnp.minimum(largest, float(jnp.finfo(v.dtype).max) / 8)  # whose reciprocal is a normal number
    v = v / jnp.where(zero, 1, largest)
    return v / jnp.sqrt(jnp.where(zero, 1, dot(v, v)))


def length(v: Vector) -> Scalar:
    """Of a vector that is not zero; neither over- nor underflows on the way."""
    largest = largest_component(v)
    v = v / largest
    return largest * jnp.sqrt(dot(v, v))


def power_of_two(value: Float[jax.Array, "*shape"]) -> Float[jax.Array, "*shape"]:
    """The power of two next below positive numbers, clamped to 2^-100..2^100, so that its reciprocal is normal and exact.

    It carries no derivative.
    """
    value = jnp.clip(lax.stop_gradient(value), 2.0**-100, 2.0**100)
    integer, exponent_bits = (jnp.uint32, 0x7F800000) if value.dtype == jnp.float32 else (jnp.uint64, 0x7FF0000000000000)
    bits = lax.bitcast_convert_type(value, integer) & jnp.asarray(exponent_bits, integer)
    return lax.bitcast_convert_type(bits, value.dtype)
