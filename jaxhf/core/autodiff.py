"""What a derivative is taken of, and what is stored for it."""

from collections.abc import Callable
from typing import Any

import jax
from jax.ad_checkpoint import checkpoint_name

_STORED = "stored"


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


def recomputed(fun: Callable[..., Any]) -> Callable[..., Any]:
    """`fun`, of which a reverse derivative stores the arguments and what is `stored` within, and computes the rest again.

    A picture's loop otherwise writes every intermediate value of its shading into memory, by a kernel for each: gradients took
    twice as long, and compiled for 1.2 s longer.
    """
    return jax.checkpoint(fun, policy=jax.checkpoint_policies.save_only_these_names(_STORED))


def stored(tree: Any) -> Any:
    """The arrays of `tree`, which a function that is `recomputed` does not compute again; for what takes long, as walks do."""
    return jax.tree.map(lambda leaf: checkpoint_name(leaf, _STORED), tree)
