"""The walks of many rays, taken together."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Int, UInt32

from ._types import Index
from ._walk import Walk, walking

Step = Callable[[jax.Array], jax.Array]

# Blocks of cells that are looked at between two visits to cells.
_SKIPS = 2


def march(walk: Walk, state: jax.Array, budget: int, count: bool) -> tuple[jax.Array, Index | None]:
    """The state in which a walk ends, and the number of its steps if they are to be counted.

    Under `vmap` walks go on until the last of them has ended. This has a rule of its own, as that of `while_loop` would count
    the steps of each ray, and keep an ended one's state by a selection, both of which `Walk` does by itself.
    """

    @jax.custom_batching.custom_vmap
    def run(walk: Walk, state: jax.Array):
        return _until_done(walk.skip, walk.visit, state, budget, count)

    @run.def_vmap
    def run_many(axis_size: int, in_batched, walk: Walk, state: jax.Array):
        lanes, shared = eqx.partition(walk, in_batched[0])
        state = state if in_batched[1] else jnp.broadcast_to(state, (axis_size,))
        skip = jax.vmap(lambda lanes, state: eqx.combine(lanes, shared).skip(state))
        visit = jax.vmap(lambda lanes, state: eqx.combine(lanes, shared).visit(state))
        ended = _until_done(lambda state: skip(lanes, state), lambda state: visit(lanes, state), state, budget, count)
        return ended, jax.tree.map(lambda _: True, ended)

    return run(walk, state)


def _until_done(
    skip: Step, visit: Step, state: UInt32[jax.Array, "*lanes"], budget: int, count: bool
) -> tuple[UInt32[jax.Array, "*lanes"], Int[jax.Array, "*lanes"] | None]:
    """Steps, each of which passes a few blocks and visits one cell, of one ray or of several."""

    def going(carry):
        step, state, _ = carry
        return (step < budget) & walking(state).any()

    def advance(carry):
        step, state, steps = carry
        if steps is not None:
            steps = steps + walking(state).astype(jnp.int32)
        state = lax.fori_loop(0, _SKIPS, lambda _, state: skip(state), state)
        return step + 1, visit(state), steps

    none = jnp.zeros((), jnp.int32)
    steps = jnp.zeros(state.shape, jnp.int32) if count else None
    _, state, steps = lax.while_loop(going, advance, (none, state, steps))
    return state, steps
