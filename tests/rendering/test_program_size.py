"""How large the programs are that are traced: each equation is compiled, and compiling is what users wait for.

The bounds are a few per cent above what there is. Whoever passes one should know why, and what it costs:
`python benchmarks/compile.py`.
"""

from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxhf

HEIGHTS = np.random.default_rng(0).uniform(0, 0.1, (17, 17)).astype(np.float32)
SCENE = jaxhf.Scene(
    [jaxhf.Object(jaxhf.Heightfield(HEIGHTS))],
    jaxhf.Perspective.look_at((0.5, -1.2, 1.1), (0.5, 0.5, 0.05), fov=45.0, width=64, height=32),
    [jaxhf.Directional((-0.5, 0.3, 0.5))],
)


def inner(equation: Any) -> Iterator[Any]:
    for value in equation.params.values():
        for found in value if isinstance(value, (tuple, list)) else (value,):
            jaxpr = getattr(found, "jaxpr", found)
            if hasattr(jaxpr, "eqns"):
                yield jaxpr


def equations(jaxpr: Any) -> Iterator[Any]:
    """All of them, those of inner programs included."""
    for equation in jaxpr.eqns:
        yield equation
        for part in inner(equation):
            yield from equations(part)


def traced(settings: jaxhf.Settings, transform: Callable[..., Any]) -> list[Any]:
    def loss(heights: jax.Array) -> jax.Array:
        return jnp.sum(jaxhf.render(SCENE.with_heights(heights), settings) ** 2)

    return list(equations(jax.make_jaxpr(transform(loss))(HEIGHTS).jaxpr))


@pytest.mark.parametrize(
    ("settings", "transform", "bound"),
    [
        pytest.param(jaxhf.Settings(), lambda loss: loss, 4050, id="frame"),
        pytest.param(jaxhf.Settings(samples=4), jax.value_and_grad, 5350, id="gradient"),
        pytest.param(
            jaxhf.Settings(samples=4, edge_samples=1000), jax.value_and_grad, 15950, id="edges", marks=pytest.mark.deep
        ),
    ],
)
def test_programs_stay_small(settings, transform, bound):
    count = len(traced(settings, transform))
    assert 0.9 * bound < count < bound


def test_aovs_of_one_sample_a_pixel_take_no_walk_of_their_own():
    def program(samples: int, aovs: tuple[str, ...]) -> list[Any]:
        settings = jaxhf.Settings(samples=samples)
        return list(equations(jax.make_jaxpr(lambda scene: jaxhf.render(scene, settings, aovs=aovs))(SCENE).jaxpr))

    alone = len(program(1, ()))
    observed = ("depth", "normal", "uv", "status", "object", "cell", "steps")
    assert len(program(1, observed)) < alone + 50
    assert len(program(4, observed)) > alone + 500  # which look at the centre, where there is no sample


def test_a_gradient_stores_little_of_each_sample():
    """Of each sample only what its walks found is stored for the way back; its shading is computed again. Tiles and samples are
    one loop: in two, each tile would add a derivative by all heights to that of the others."""
    loops = [
        (equation.params["length"], sum(leaf.aval.size for leaf in equation.outvars))
        for equation in traced(jaxhf.Settings(samples=4), jax.value_and_grad)
        if equation.primitive.name == "scan"
    ]
    tiles, samples = 2, 4
    assert samples not in dict(loops)
    stored = [size for length, size in loops if length == tiles * samples]
    assert stored
    assert max(stored) < 12 * tiles * samples * 1024  # numbers, of tiles of 1024 pixels


@pytest.mark.deep
def test_no_matrix_product_has_the_accelerators_precision():
    """By default TPUs multiply matrices in bfloat16 and GPUs in TF32: 8 and 11 bits of an offset or a direction."""
    field = jaxhf.Heightfield(HEIGHTS, x0=5e5, y0=4e6)
    lights = [jaxhf.Point((1, 2, 3)), jaxhf.Sun((1, 2, 3)), jaxhf.Sky(1, occlusion=4)]

    def loss(heights: jax.Array, world: jax.Array, pose: jax.Array) -> jax.Array:
        objects = [
            jaxhf.Object(field, world_from_object=world),
            jaxhf.Object(jaxhf.Skirt.of(field, -1.0), world_from_object=world),
        ]
        scene = jaxhf.Scene(objects, jaxhf.Perspective(pose, width=32, height=32), lights).with_heights(heights)
        plain = jaxhf.Scene(objects[:1], scene.camera, lights).with_heights(heights)
        points = jaxhf.render(plain, jaxhf.Settings(edge_samples=64))
        return jnp.sum(jaxhf.render(scene)) + jnp.sum(points) + jnp.sum(jaxhf.sky_view(heights, dx=1.0))

    arguments = HEIGHTS, np.eye(4, dtype=np.float32), np.asarray(SCENE.camera.world_from_camera, np.float32)
    program = jax.make_jaxpr(jax.value_and_grad(loss, argnums=(0, 1, 2)))(*arguments).jaxpr
    products = [str(equation) for equation in equations(program) if equation.primitive.name == "dot_general"]
    assert not [product for product in products if "HIGHEST" not in product]
