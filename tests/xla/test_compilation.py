"""Programs that are compiled in less time, wherever they are called from."""

import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxhf.xla import compilation
from jaxhf.xla.compilation import compiled, compiler_options


def test_options_are_used_at_the_top_level_alone():
    given = []

    def spied(fun, **options):
        given.append(options)
        return jax.jit(fun, **options)

    doubled = compiled(lambda x: 2 * x, jit=spied)
    assert given == [{}]
    for inside in (jax.jit(doubled), jax.vmap(doubled), jax.checkpoint(doubled), jax.vmap(jax.grad(doubled))):
        np.testing.assert_array_equal(inside(jnp.ones(3)), 2)
    assert given == [{}]
    assert doubled(1.0) == 2
    assert given == [{}, {"compiler_options": compiler_options()}]
    assert compiler_options() is not None


def test_the_options_leave_functions_right():
    """Wide vectors and XLA's newer emitters do not, in jaxlib 0.10 and 0.11."""
    x = np.linspace(-4, 4, 1000, dtype=np.float32)
    for newer in (False, True):
        np.testing.assert_allclose(compiled(jnp.arctan, newer=newer)(x), np.arctan(x), rtol=1e-5)


@pytest.mark.parametrize("others", [{}, {"xla_cpu_enable_fast_math": False}])
def test_an_option_that_xla_does_not_know_is_left_out(others, monkeypatch):
    compiler_options.cache_clear()
    monkeypatch.setattr(compilation, "_OPTIONS", {"xla_cpu_no_such_option": False, **others})
    try:
        assert compiler_options() == (others or None)
        assert compiled(lambda x: 2 * x)(1.0) == 2
    finally:
        compiler_options.cache_clear()


@pytest.mark.deep
def test_the_first_use_may_be_within_a_trace():
    """All is imported late: here while the user's function is being traced."""
    script = """
import jax, numpy as np, jaxhf
def top(z):
    camera = jaxhf.Perspective.look_at((0.5, 0.5, 3.0), (0.5, 0.5, 0.0), up=(0, 1, 0), width=4, height=4)
    return jaxhf.render(jaxhf.Scene([jaxhf.Object(jaxhf.Heightfield(z))], camera, [jaxhf.Directional((0.0, 0.0, 1.0))]))
z = np.zeros((3, 3), np.float32)
inside = jax.jit(top)(z)
from jaxhf.xla import compilation
made, options = [], compilation.compiler_options
compilation.compiler_options = lambda newer: made.append(1) or options(newer)
np.testing.assert_allclose(inside, top(z), rtol=1e-6)
assert made == [1, 1, 1], made  # tried out, for the world and for its picture
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
