"""A function as one kernel, and functions that are called in turn."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxhf
from jaxhf.xla.kernel import in_turn, one_kernel

SMALL_CALL = 'xla_cpu_small_call = "true"'


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


WITHOUT_CODE = {
    "sum": lambda x: x[0] + jnp.sum(x),
    "largest": lambda x: jnp.max(x[None], axis=1),
    "sort": jnp.sort,
    "scatter": lambda x: x.at[jnp.arange(64) % 7].add(1.0),
    "product": lambda x: x.reshape(64, 64) @ x.reshape(64, 64),
    "running sum": jnp.cumsum,
    "transform": lambda x: jnp.fft.rfft(x).real,
    "solution": lambda x: jnp.linalg.solve(jnp.eye(3) * 2, x[:3]),
    "nested": lambda x: jax.lax.fori_loop(0, 3, lambda _, x: x / jax.jit(jnp.sum)(x), x),
}


@pytest.mark.parametrize("name", WITHOUT_CODE)
def test_what_xla_has_no_code_for_within_a_kernel_is_called_as_it_is(name):
    """Within a user's own program nobody could catch the error."""
    x = jnp.linspace(1.0, 2.0, 4096)
    found = jax.jit(lambda x: jax.lax.map(lambda x: one_kernel(WITHOUT_CODE[name], x), jnp.stack([x, x])))
    assert SMALL_CALL not in found.lower(x).as_text()
    np.testing.assert_allclose(found(x)[0], WITHOUT_CODE[name](x), rtol=1e-6)


def test_small_sums_are_within_a_kernel():
    """4095 numbers are few to XLA; so are any that are whole."""
    for x in (jnp.ones(4095), jnp.ones(10_000, jnp.int32)):
        fun = jax.jit(lambda x: one_kernel(lambda x: x[0] + jnp.sum(x, dtype=x.dtype), x))
        assert SMALL_CALL in fun.lower(x).as_text()
        assert fun(x) == x.size + 1


def test_a_batch_of_kernels_may_be_too_large_for_one():
    x = jnp.arange(6 * 1024.0).reshape(6, 1024)
    batch = jax.jit(jax.vmap(lambda x: one_kernel(lambda x: x / jnp.sum(x), x)))
    np.testing.assert_allclose(batch(x), x / x.sum(1, keepdims=True), rtol=1e-6)


def curved(x: jax.Array, scale: jax.Array, table: jax.Array, number: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Nonlinear in two arguments; a gather; and a result that is a whole number."""
    return jnp.sin(scale * x) * table[number] + x**3, number + 1


ARGUMENTS = jnp.linspace(0.3, 1, 8), jnp.asarray(1.7), jnp.linspace(2, 5, 20), jnp.arange(8, dtype=jnp.int32) * 2


@pytest.mark.parametrize("called", [one_kernel, in_turn])
@pytest.mark.parametrize("moving", [(0, 1, 2), *(pytest.param(only, marks=pytest.mark.deep) for only in ((0,), (2,)))])
def test_derivatives_are_those_of_the_function(called, moving):
    def of(fun):
        def value(*moved):
            given = list(ARGUMENTS)
            for place, argument in zip(moving, moved, strict=True):
                given[place] = argument
            return jnp.sum(fun(*given)[0] ** 2)

        moved = [ARGUMENTS[place] for place in moving]
        every = tuple(range(len(moving)))
        return [
            jax.value_and_grad(value, every)(*moved),
            jax.jit(jax.grad(value, every))(*moved),
            jax.jvp(value, moved, [jnp.ones_like(argument) for argument in moved]),
            jax.jacfwd(jax.grad(value, every), every)(*moved),
            jax.vmap(jax.grad(value, every))(*(jnp.stack([argument, 2 * argument]) for argument in moved)),
            jax.grad(lambda *args: jnp.sum(jax.vmap(value)(*args)), every)(*(jnp.stack([argument] * 2) for argument in moved)),
        ]

    found, expected = of(lambda *args: called(curved, *args)), of(curved)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6), found, expected)


def test_under_vmap_one_is_called_after_the_other():
    """A loop of a batch would run for all until the last has ended."""
    x = jnp.asarray([1.0, 9.0, 300.0])
    batch = jax.vmap(lambda x, y: in_turn(lambda x, y: halvings(x[None])[0] + y, x, y), in_axes=(0, None))
    np.testing.assert_array_equal(batch(x, 0), [-1, 4, 9])
    assert [equation.primitive.name for equation in jax.make_jaxpr(batch)(x, 0).eqns] == ["scan"]


def test_a_derivative_may_be_that_of_another_function():
    def fun(x):
        return in_turn(lambda x: x * 2, x, derivative_of=lambda x: x * 2 + 0 * x**2 + x - jax.lax.stop_gradient(x))

    x = jnp.asarray(3.0)
    assert jax.jit(fun)(x) == 6
    assert jax.value_and_grad(fun)(x) == (6, 3)
    assert "sub" not in jax.jit(fun).lower(x).as_text()


def scenes() -> dict[str, tuple[jaxhf.Scene, jaxhf.Settings]]:
    """With each part of a scene that a tile may trace; one that does without a kernel takes it from all beside it."""
    field = jaxhf.Heightfield(np.random.default_rng(0).uniform(0, 0.1, (1024, 5)).astype(np.float32), 1.0)
    camera = jaxhf.Perspective.look_at((2, -500, 900), (2, 500, 0), width=40, height=40)
    terrain = jaxhf.Object(field)
    usual = [terrain], [jaxhf.Directional((1, 2, 3)), jaxhf.Sky(0.5)]
    texture, mirror = jaxhf.ImageTexture(np.full((64, 64, 3), 0.5, np.float32)), jaxhf.Mirror(0.5)
    tube = jaxhf.Object(jaxhf.Cylinder(1.0), mirror)
    parts = {
        "plain": usual,
        "texture, skirt": ([jaxhf.Object(field, jaxhf.Matte(texture)), jaxhf.Object(jaxhf.Skirt.of(field, -1.0))], usual[1]),
        "cylinder, two": ([terrain, jaxhf.Object(field, mirror, np.diag([2.0, 2, 2, 1])), tube], usual[1]),
        "point, sun, hidden sky": ([terrain], [jaxhf.Point((2, 500, 9)), jaxhf.Sun((1, 2, 3)), jaxhf.Sky(0.5, occlusion=8)]),
    }
    knobs = {
        "samples": jaxhf.Settings(samples=4),
        "flat": jaxhf.Settings(shading="flat", shadows=False),
        "whole loops": jaxhf.Settings(early_exit=False),
        "large tiles": jaxhf.Settings(chunk=16384),
    }
    made = {name: (jaxhf.Scene(objects, camera, lights), jaxhf.Settings()) for name, (objects, lights) in parts.items()}
    return made | {name: (made["plain"][0], settings) for name, settings in knobs.items()}


@pytest.mark.deep
@pytest.mark.parametrize("name", scenes())
def test_tiles_of_every_scene_are_kernels(name):
    """In pictures, and as the value within a gradient. Else frames take twice the time, and nobody notices."""
    scene, settings = scenes()[name]

    def picture(heights):
        return jaxhf.render(scene.with_heights(heights), settings, aovs=jaxhf.AOVS)[0]

    for fun in (picture, jax.value_and_grad(lambda heights: picture(heights).sum())):
        assert SMALL_CALL in jax.jit(fun).lower(scene.heights).as_text()
