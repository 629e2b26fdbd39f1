"""A function as one kernel."""

import re

import jax
import jax.numpy as jnp
import numpy as np

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
    text = inside.lower(x).compile().as_text()
    kept = re.findall(r'= \S+ call\(.*xla_cpu_small_call="true"', text)
    assert len(kept) == 1
    np.testing.assert_array_equal(inside(x), jax.lax.map(halvings, x.reshape(3, 100)))


def test_derivatives_pass_through():
    def scaled(x):
        return one_kernel(lambda x, scale: (jnp.sin(x) * scale, x), x, 2.0)[0].sum()

    x = jnp.linspace(0.0, 1.0, 5)
    np.testing.assert_allclose(jax.grad(scaled)(x), 2 * np.cos(x))
    np.testing.assert_allclose(jax.jvp(scaled, (x,), (jnp.ones(5),))[1], 2 * np.cos(x).sum())
