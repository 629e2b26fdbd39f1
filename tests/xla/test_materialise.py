"""`materialise`: a value that XLA on the CPU computes once, whatever its users do with it."""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxhf.xla.materialise import materialise, unfolded, value_at, values_at


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


def test_what_an_index_consists_of_is_computed_apart_from_the_gather():
    """LLVM would compute it number by number there, on processors without AVX-512."""
    values, places = jnp.linspace(0, 1, 100) ** 2, jnp.arange(32)

    def parts_that_gather(look_up) -> list[str]:
        text = jax.jit(jax.vmap(lambda k: look_up((3 * k) ^ 5) + 1)).lower(places).compile().as_text() or ""
        return [part for part in text.split("\n\n") if " gather(" in part]

    for look_up, apart in ((lambda place: value_at(values, place), True), (lambda place: values[place], False)):
        parts = parts_that_gather(look_up)
        assert parts
        assert all(("xor(" not in part) == apart for part in parts)


@pytest.mark.parametrize("shape", [(100,), (100, 3)])
def test_values_at_places_and_their_derivatives(shape):
    """The last value among them; a step that is data."""
    values = jnp.linspace(0, 1, math.prod(shape)).reshape(shape)
    places, step = jnp.array([0, 41, 93, 96], jnp.int32), jnp.int32(3)

    def found(values: jax.Array) -> jax.Array:
        return jnp.stack(jax.vmap(lambda place: values_at(values, place, (1, step)))(places))

    def expected(values: jax.Array) -> jax.Array:
        return jnp.stack([values[places], values[places + 1], values[places + step]])

    def loss(look_up, values: jax.Array) -> jax.Array:
        return jnp.sum(jnp.cos(3 * look_up(values)))

    assert int(places.max() + step) == len(values) - 1
    np.testing.assert_array_equal(found(values), expected(values))
    for mode in (jax.grad, jax.jacfwd):
        mine, theirs = (mode(functools.partial(loss, look_up))(values) for look_up in (found, expected))
        np.testing.assert_allclose(mine, theirs, rtol=1e-6)


def test_large_constants_are_not_computed_with_while_compiling():
    """XLA would do so by an interpreter, for seconds, and say so in the user's terminal."""
    table = np.linspace(0, 1, 1025)
    for made, folded in ((lambda x: x + jnp.sin(unfolded(table)).sum(), False), (lambda x: x + jnp.sin(table).sum(), True)):
        text = jax.jit(made).lower(1.0).compile().as_text() or ""
        assert ("sine(" not in text) == folded
