"""A value with the derivative of another."""

import jax


@jax.custom_jvp
def with_tangent(value: jax.Array, carrier: jax.Array) -> jax.Array:
    """`value`, with the derivative of value + carrier.

    Adding carrier - stop_gradient(carrier) would need exact cancellation, which fused multiply-adds break; and where
    nothing is differentiated, this way the carrier is never computed.
    """
    return value


@with_tangent.defjvp
def _with_tangent_jvp(primals, tangents):
    return primals[0], tangents[0] + tangents[1]
