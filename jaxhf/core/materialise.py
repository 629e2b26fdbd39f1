"""Keeping XLA on the CPU from computing a value anew for each of its users."""

from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from .types import Flag


def stored(tree: Any, sure: Flag) -> Any:
    """The arrays of `tree`, computed once and kept, where XLA on the CPU would repeat their arithmetic in every user.

    It fuses an elementwise producer into each of its consumers, so a chain of values with several users each doubles at
    every link, and `lax.optimization_barrier` is gone before the fusion. A conditional is not fused through. With these at
    the borders of the stages a scene with three objects takes between a quarter and a ninth of the time
    (docs/performance.md).

    Args:
      tree: any pytree of arrays.
      sure: an unbatched scalar that is always true, but not to the compiler.
    """
    leaves, structure = jax.tree.flatten(tree)

    def kept(*leaves: Any) -> tuple[Any, ...]:
        return lax.cond(sure, lambda *leaves: leaves, lambda *leaves: tuple(jnp.zeros_like(leaf) for leaf in leaves), *leaves)

    return jax.tree.unflatten(structure, lax.platform_dependent(*leaves, cpu=kept, default=lambda *leaves: leaves))
