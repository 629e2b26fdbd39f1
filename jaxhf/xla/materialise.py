"""Keeping XLA on the CPU from computing a value anew for each of its users, and from computing constants as it compiles."""

from typing import Any

import jax
import numpy as np
from jax import lax
from jax.core import Tracer

from .plain import insides


def materialise(tree: Any) -> Any:
    """The arrays of `tree`, computed once and kept in memory, where XLA on the CPU would repeat their arithmetic in every user.

    XLA fuses an elementwise producer into each of its consumers, so a chain of values with several users each doubles at
    every link, and `lax.optimization_barrier` round the values is gone before the fusion. A call of a function that XLA may
    not inline is not fused through, and one that returns its argument is neither a kernel nor a copy. With this at the borders
    of the stages a scene with three objects takes between a quarter and a ninth of the time
    (docs/measurements/experiments.md).
    """
    module = insides()
    return tree if module is None else jax.tree.map(module.in_memory.bind, tree)


def unfolded(tree: Any) -> Any:
    """The arrays of `tree`, of which the large ones that are constants of a program are hidden from XLA, which else computes
    all that depends on them alone as it compiles, by an interpreter: for 1024 x 1024 heights that takes seconds."""
    large = 1024

    def hidden(leaf: Any) -> Any:
        constant = isinstance(leaf, jax.Array | np.ndarray) and not isinstance(leaf, Tracer)
        return lax.optimization_barrier(leaf) if constant and leaf.size > large else leaf

    return jax.tree.map(hidden, tree)
