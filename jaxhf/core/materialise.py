"""Keeping XLA on the CPU from computing a value anew for each of its users."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax


def materialise(tree: Any) -> Any:
    """The arrays of `tree`, computed once and kept in memory, where XLA on the CPU would repeat their arithmetic in every user.

    XLA fuses an elementwise producer into each of its consumers, so a chain of values with several users each doubles at
    every link, and `lax.optimization_barrier` round the values is gone before the fusion. A conditional is not fused
    through. Its predicate is True behind a barrier of its own, which stands until conditionals have been simplified: always
    true at run time, but unknown to the compiler. With this at the borders of the stages a scene with three objects takes
    between a quarter and a ninth of the time (docs/measurements/experiments.md).
    """
    if jax.default_backend() != "cpu":  # `lax.platform_dependent` would have both forms traced and differentiated
        return tree
    return lax.cond(_opaque_true(), lambda tree: tree, lambda tree: jax.tree.map(jnp.zeros_like, tree), tree)


def apart(fun: Callable[..., Any], *args: Any) -> Any:
    """`fun(*args)` between two such borders: `args` are in memory before, and the result afterwards.

    For gathers. XLA on the CPU fuses one into its only user; one with several users becomes a loop over its elements, some
    twenty times as slow.
    """
    if jax.default_backend() != "cpu":
        return fun(*args)
    shapes = jax.eval_shape(fun, *args)
    return lax.cond(_opaque_true(), fun, lambda *_: jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes), *args)


def _opaque_true() -> jax.Array:
    return lax.optimization_barrier(jnp.ones((), bool))
