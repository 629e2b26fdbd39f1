"""What XLA on the CPU is kept from: computing a value anew for each of its users, the place of a gather number by number, and
constants as it compiles."""

from typing import Any

import jax
import jax.numpy as jnp
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


def values_at(values: jax.Array, place: jax.Array, further: tuple[Any, ...]) -> tuple[jax.Array, ...]:
    """The values at a place and at places so much further on, all in range, along the first axis of an array.

    For a processor without AVX-512 LLVM computes number by number, not in vectors, whatever stands in a gather's loop and has a
    part in its index. A place that comes from memory has no parts in that loop: frames take about half of the time
    (docs/measurements/experiments.md). XLA confines each index to the array, a signed one from below and from above, an
    unsigned one only from above, by two instructions a number. Where the array's length is a power of two, the index is masked
    here by length - 1, which changes none that is in range and takes one instruction; XLA's two are then left out.
    """
    place = materialise(place).astype(jnp.uint32)
    places = [place, *(place + jnp.asarray(step).astype(jnp.uint32) for step in further)]
    last = len(values) - 1
    if last & len(values) == 0:
        places = [place & jnp.uint32(last) for place in places]
    return tuple(values.at[place].get(mode="promise_in_bounds", wrap_negative_indices=False) for place in places)


def value_at(values: jax.Array, place: jax.Array) -> jax.Array:
    """The value in a place that is in range, see `values_at`."""
    return values_at(values, place, ())[0]


def unfolded(tree: Any) -> Any:
    """The arrays of `tree`, of which the large ones that are constants of a program are hidden from XLA, which else computes
    all that depends on them alone as it compiles, by an interpreter: for 1024 x 1024 heights that takes seconds."""
    large = 1024

    def hidden(leaf: Any) -> Any:
        constant = isinstance(leaf, jax.Array | np.ndarray) and not isinstance(leaf, Tracer)
        return lax.optimization_barrier(leaf) if constant and leaf.size > large else leaf

    return jax.tree.map(hidden, tree)
