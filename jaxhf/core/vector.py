"""Vectors, and quotients: lengths, directions, angles and distances that, and whose derivatives, neither over- nor underflow.

A guard `b != 0` does not make a / b safe: where b is tiny, JAX's derivative -a / b² is infinite, and where a `where` passes
over the quotient, that infinity times zero is nan. So whatever may be tiny divides by `quotient` or `time_to`.
"""

import functools
import operator
from collections.abc import Iterable
from typing import TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Float

from .types import Flag, Index, Scalar, Vector

Tree = TypeVar("Tree")

# Along an axis in which it moves less than 1 / FAR, a ray counts as standing still; its distance to the next plane there is
# then large, but finite in single precision whatever it is multiplied with later.
FAR = 1e30
# So near to zero a cosine is rounded off: 0.6 degrees round the horizon of the shading normal.
GRAZING = 0.01


def floor_to_power_of_two(value: Float[jax.Array, "*shape"]) -> Float[jax.Array, "*shape"]:
    """The largest powers of two that are not above positive numbers, without a derivative: a division by them changes no bit.

    They are clamped to 2^-100..2^100, so that their reciprocals are normal numbers, and exact.
    """
    value = jnp.clip(lax.stop_gradient(value), 2.0**-100, 2.0**100)
    integer, exponent_bits = (jnp.uint32, 0x7F800000) if value.dtype == jnp.float32 else (jnp.uint64, 0x7FF0000000000000)
    bits = lax.bitcast_convert_type(value, integer) & jnp.asarray(exponent_bits, integer)
    return lax.bitcast_convert_type(bits, value.dtype)


@jax.custom_jvp
def quotient(a: Float[jax.Array, "*shape"], b: Float[jax.Array, "*of"]) -> Float[jax.Array, "*shape"]:
    """a / b for a b that is not zero; the derivative (da - a / b db) / b has no square of b in it."""
    return a / b


@quotient.defjvp
def _quotient_jvp(primals, tangents):
    (a, b), (da, db) = primals, tangents
    whole = a / b
    return whole, (da - whole * db) / b


def time_to(distance: Scalar, rate: Scalar) -> tuple[Scalar, Flag]:
    """distance / rate, and whether that is below `FAR`; else it is 0 with derivative 0, as where the rate is 0."""
    ever = jnp.abs(distance) < FAR * jnp.abs(rate)
    return quotient(jnp.where(ever, distance, 0), jnp.where(ever, rate, 1)), ever


def angle(y: Scalar, x: Scalar) -> Scalar:
    """atan2(y, x); 0 with derivative 0 where both are 0, and finite where their squares underflow."""
    size = lax.stop_gradient(greater(jnp.abs(y), jnp.abs(x)))
    zero = size == 0
    size = floor_to_power_of_two(jnp.where(zero, 1, size))
    return jnp.arctan2(jnp.where(zero, 0, y) / size, jnp.where(zero, 1, x) / size)


def dot(a: Float[jax.Array, " n"], b: Float[jax.Array, " n"]) -> Scalar:
    """Written out, as XLA on the CPU calls a library for a reduction, however short."""
    return functools.reduce(operator.add, (a[k] * b[k] for k in range(a.shape[0])))


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


def rounded_clamp(cosine: Scalar) -> Scalar:
    """max(cosine, 0), with the corner at zero replaced by a parabola that meets both sides with equal slope.

    Where an interpolated normal faces away from a light that its triangle faces, the surface that it stands for is in its
    own shade. pbrt-v2 takes the absolute value there, which lights coarse cells anew beyond the terminator. This differs from
    max(cosine, 0) only within 0.01 of zero, by at most 0.0025.
    """
    low = within(cosine, -GRAZING, GRAZING)
    return jnp.where(cosine < GRAZING, (low + GRAZING) * (low + GRAZING) / (4 * GRAZING), cosine)


def root(x: Float[jax.Array, "*shape"]) -> Float[jax.Array, "*shape"]:
    """The square root of a number that is not negative, with derivative 0 at 0."""
    positive = x > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, x, 1)), 0)


def select(number: Index, values: Iterable[tuple[int, Tree]], otherwise: Tree | None = None) -> Tree:
    """The pytree that stands beside this number among `values`, and `otherwise` beside none; if that is None, any of them."""
    chosen = otherwise
    for k, value in values:
        if chosen is None:
            chosen = value
        else:
            chosen = jax.tree.map(lambda new, old, k=k: jnp.where(number == k, new, old), value, chosen)
    assert chosen is not None, "nothing to select from"
    return chosen


def largest_component(v: Float[jax.Array, " n"]) -> Scalar:
    """max |v_i|, written out as `dot` is; nan is passed over."""
    return functools.reduce(greater, (jnp.abs(v[k]) for k in range(v.shape[0])))


def finite(v: Vector) -> Flag:
    return jnp.isfinite(v[0]) & jnp.isfinite(v[1]) & jnp.isfinite(v[2])


def unit(v: Float[jax.Array, " n"]) -> Float[jax.Array, " n"]:
    """`v` at length 1; a zero vector stays zero, with zero derivative. Neither over- nor underflows on the way."""
    largest = lax.stop_gradient(largest_component(v))  # any factor does; its own derivative has its square in it
    zero = largest == 0
    largest = jnp.minimum(largest, float(jnp.finfo(v.dtype).max) / 8)  # whose reciprocal is a normal number
    v = v / jnp.where(zero, 1, largest)
    return v / jnp.sqrt(jnp.where(zero, 1, dot(v, v)))
