"""Leaving out what none of the rays of a batch needs."""

import math
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax

from ..core.types import Flag
from .materialise import materialise


def only_where(needed: Flag, fun: Callable[..., Any], *args: Any, skips: bool = True) -> Any:
    """`fun(*args)`; under `vmap` zeros instead, without computing anything, where not one of the rays needs it.

    Half of a picture's tiles may show nothing but background. Without `vmap` the function is simply called. It takes part in
    forward and reverse differentiation; zeros have the derivative zero.

    Args:
      needed: whether this ray's result is going to be used. Others must not look at theirs.
      fun: a function of one ray, with no other traced values than its arguments.
      args: pytrees of arrays.
      skips: False computes it in any case, by the same program but for that.
    """
    if not skips:
        needed = lax.optimization_barrier(jnp.ones((), bool))

    once = jax.jit(fun)

    @jax.custom_batching.custom_vmap
    def run(needed: jax.Array, args: tuple[Any, ...]) -> Any:
        return once(*args)

    @run.def_vmap
    def run_many(axis_size: int, in_batched: Any, needed: jax.Array, args: tuple[Any, ...]) -> Any:
        batched, shared = eqx.partition(args, in_batched[1])
        many = jax.jit(jax.vmap(lambda batched: once(*eqx.combine(batched, shared)), axis_size=axis_size))
        shapes = jax.eval_shape(many, batched)

        def nothing(_: Any) -> Any:
            return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)

        return lax.cond(_any(needed), many, nothing, batched), jax.tree.map(lambda _: True, shapes)

    return run(needed, args)


def _any(flags: jax.Array) -> jax.Array:
    """Whether one of them is set: by one kernel, where XLA reduces an axis of more than 32 in two or three."""
    sides = [32] * max(1, math.ceil(math.log(flags.size, 32)))
    return materialise(jnp.pad(flags.ravel(), (0, math.prod(sides) - flags.size)).reshape(sides)).any()
