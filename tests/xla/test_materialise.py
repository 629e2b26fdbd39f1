"""`materialise`: a value that XLA on the CPU computes once, whatever its users do with it."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxhf.xla.materialise import materialise, unfolded


def chain(x: jax.Array, keep=materialise) -> jax.Array:
    """Each link has two users; without `materialise` XLA repeats the whole chain in each of them."""
    for _ in range(3):
        x, _ = keep((jnp.sin(x) * x[::-1], jnp.cos(x)))
    return x


def test_calls_survive_compilation():
    """Else they do nothing: an older or newer XLA may inline them."""
    x = jnp.linspace(0, 1, 8)
    for function in (jax.vmap(chain), jax.vmap(jax.grad(lambda x: chain(x).sum()))):
        text = jax.jit(function).lower(x[None]).compile().as_text()
        assert text is not None
        assert text.count(" call(") >= 3


def test_values_and_derivatives_are_those_without_it():
    x, dx = jnp.linspace(0.3, 1, 8), jnp.linspace(-1, 1, 8)

    def plain(x):
        return chain(x, keep=lambda tree: tree)

    for mode in (lambda f: f(x), lambda f: jax.jvp(f, (x,), (dx,)), lambda f: jax.vjp(f, x)[1](dx)):
        for found, expected in zip(jax.tree.leaves(mode(chain)), jax.tree.leaves(mode(plain)), strict=True):
            np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6)
    assert np.abs(jax.jvp(chain, (x,), (dx,))[1]).max() > 0.01


def test_large_constants_are_not_computed_with_while_compiling():
    """XLA would do so by an interpreter, for seconds, and say so in the user's terminal."""
    table = np.linspace(0, 1, 1025)
    for made, folded in ((lambda x: x + jnp.sin(unfolded(table)).sum(), False), (lambda x: x + jnp.sin(table).sum(), True)):
        text = jax.jit(made).lower(1.0).compile().as_text() or ""
        assert ("sine(" not in text) == folded
