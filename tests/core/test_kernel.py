"""A function as one kernel."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxhf.core.kernel import one_kernel


def halvings(x: jax.Array) -> jax.Array:
    """How often each must be halved to come below 1: a loop, and a conditional."""

    def halve(carry):
        x, count = carry
        return x / 2, count + (x >= 1).astype(jnp.int32)

    count = jax.lax.while_loop(lambda carry: (carry[0] >= 1).any(), halve, (x, jnp.zeros(x.shape, jnp.int32)))[1]
    return jax.lax.cond(count.max() > 3, lambda count: count, lambda count: -count, count)


def test_it_stays_one_call_and_the_values_are_the_same():
    """Else it does nothing: an older or newer XLA may not know of it."""
    x = jnp.linspace(0.0, 100.0, 300)
    inside = jax.jit(lambda x: jax.lax.map(lambda x: one_kernel(halvings, x), x.reshape(3, 100)))
    text = inside.lower(x).compile().as_text() or ""
    kept = re.findall(r' call\(.*xla_cpu_small_call="true"', text)
    assert kept
    np.testing.assert_array_equal(inside(x), jax.lax.map(halvings, x.reshape(3, 100)))


@pytest.mark.parametrize("within", [lambda fun, x: fun(x), lambda fun, x: jax.lax.map(fun, jnp.stack([x, x]))[0]])
def test_arguments_may_be_constant_or_unused(within):
    """Else XLA ends the process. What the compiler comes to know of them is used no more, either."""
    table = np.arange(5000.0)

    def fun(x):
        place = jnp.arange(5, dtype=jnp.int32)
        return one_kernel(lambda x, table, place, unused: x + table[place & 1], x, table, place, jnp.ones(3))

    np.testing.assert_array_equal(jax.jit(lambda x: within(fun, x))(jnp.zeros(5)), [0, 1, 0, 1, 0])
