"""Vectors of three numbers: lengths and directions that neither over- nor underflow."""

import jax.numpy as jnp
from jax import lax

from .types import Flag, Scalar, Vector


def dot(a: Vector, b: Vector) -> Scalar:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def lesser(a: Scalar, b: Scalar) -> Scalar:
    """The minimum of two numbers: one instruction, where that by NumPy's rules for nan and signed zeros takes four."""
    return jnp.where(a < b, a, b)


def greater(a: Scalar, b: Scalar) -> Scalar:
    return jnp.where(a > b, a, b)


def within(x: Scalar, least: Scalar | float, most: Scalar | float) -> Scalar:
    """`x`, or the bound that it is beyond.

    The derivatives of `jnp.clip` and `jnp.maximum` ask which argument equals the result: where XLA computes an argument anew
    and rounds it otherwise none does, and the derivative is zero.
    """
    return lesser(greater(x, jnp.asarray(least, x.dtype)), jnp.asarray(most, x.dtype))


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
