"""Leaving out what no ray of a batch needs."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxhf.xla.masked import only_where

X = np.linspace(-1, 2, 7)


def through(x, scale, least):
    return only_where(x > least, lambda x, scale: (jnp.sin(x) * scale, x + 1), x, scale)


def test_alone_it_is_a_call():
    np.testing.assert_allclose(through(jnp.asarray(0.5), 2.0, 0.0), (2 * np.sin(0.5), 1.5), rtol=1e-6)


@pytest.mark.parametrize("least", [-2.0, 0.0, 1.9])
def test_one_ray_that_needs_it_is_enough(least):
    values = jax.jit(jax.vmap(through, in_axes=(0, None, None)))(X, 2.0, least)
    np.testing.assert_allclose(values, (2 * np.sin(X), X + 1), rtol=1e-6, atol=1e-6)


def test_nothing_is_computed_where_none_needs_it():
    values = jax.vmap(through, in_axes=(0, None, None))(X, 2.0, 2.5)
    np.testing.assert_array_equal(values, np.zeros((2, 7)))  # and not x + 1


@pytest.mark.parametrize(("least", "slope"), [(0.0, np.cos(X)), (2.5, np.zeros(7))])
def test_derivatives(least, slope):
    def mapped(x, scale):
        return jax.vmap(through, in_axes=(0, None, None))(x, scale, least)[0]

    x, scale = jnp.asarray(X), jnp.asarray(2.0)
    np.testing.assert_allclose(jax.jvp(mapped, (x, scale), (jnp.ones(7), jnp.zeros(())))[1], 2 * slope, rtol=1e-6)
    by_x, by_scale = jax.grad(lambda x, scale: mapped(x, scale).sum(), (0, 1))(x, scale)
    np.testing.assert_allclose(by_x, 2 * slope, rtol=1e-6)
    np.testing.assert_allclose(by_scale, (np.sin(X) * (least == 0.0)).sum(), rtol=1e-6)
