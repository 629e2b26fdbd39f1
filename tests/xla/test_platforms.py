"""What another platform's program holds: lowered for GPUs and TPUs where there is neither."""

import inspect

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxhf
from jaxhf.fitting.given import Given
from jaxhf.fitting.model import expansion as _expansion
from jaxhf.fitting.model.edge_points import forms_of_edge_points
from jaxhf.fitting.model.problem import make_problem

HEIGHTS = (0.1 * np.sin(np.arange(40.0)).reshape(5, 8)).astype(np.float32)
CAMERA = jaxhf.Perspective.look_at((0.5, -0.9, 0.8), (0.5, 0.5, 0.0), width=40, height=30)
SUN = jaxhf.Directional((1.0, 0.2, 0.3))
RAYS = np.tile(np.array([0.3, 0.4, 2], np.float32), (1024, 1)), np.tile(np.array([0, 0, -1], np.float32), (1024, 1))


def picture(heights: jax.Array, **knobs) -> jax.Array:
    scene = jaxhf.Scene([jaxhf.Object(jaxhf.Heightfield(heights))], CAMERA, [SUN])
    return jaxhf.render(scene, jaxhf.Settings(**knobs))


def hits(heights: jax.Array) -> jaxhf.Hit:
    return jaxhf.cast(jaxhf.Heightfield(heights), *RAYS)


def linearised(heights: jax.Array) -> list[jax.Array]:
    """What the steps of a fit take of its pictures: these, and their derivatives."""
    with jax.ensure_compile_time_eval():
        scene = jaxhf.Scene([jaxhf.Object(jaxhf.Heightfield(HEIGHTS))], CAMERA, [SUN])
        known = {name: item.default for name, item in inspect.signature(jaxhf.fit).parameters.items()}
        known |= {"settings": jaxhf.Settings(edge_samples=300), "unknown": jaxhf.Unknown(albedo="map")}
        known |= {"weights": [np.ones((30, 40))]}
        given = Given(**{name: known[name] for name in Given.__dataclass_fields__})
        made, unknowns = make_problem([scene], [np.zeros((30, 40), np.float32)], given)
    made = eqx.tree_at(lambda problem: problem.basis.base, made, heights)
    with jax.ensure_compile_time_eval():
        drawn = jax.tree.map(lambda form: np.zeros(form.shape, form.dtype), forms_of_edge_points(made))
    return jax.tree.leaves(_expansion._linearised(unknowns, made, drawn))


PROGRAMS = {
    "picture": picture,
    "gradient": jax.grad(lambda heights: picture(heights).sum()),
    "gradient with points on edges": jax.grad(lambda heights: picture(heights, edge_samples=300).sum()),
    "linearised pictures": linearised,
    "rays": lambda heights: hits(heights).t,
}


LARGE = ("gradient with points on edges", "linearised pictures")


@pytest.mark.parametrize("name", [pytest.param(name, marks=pytest.mark.deep) if name in LARGE else name for name in PROGRAMS])
def test_a_program_for_another_platform_has_nothing_of_the_cpu(name):
    """Neither its kernels, nor the copies that keep values in memory, nor walks that end in parts."""
    marks = "xla_cpu", "in_memory", "x128xui32"

    traced = jax.jit(PROGRAMS[name]).trace(jnp.asarray(HEIGHTS))

    def marked(platform: str) -> list[bool]:
        text = traced.lower(lowering_platforms=(platform,)).as_text()
        return [mark in text for mark in marks]

    assert marked("cuda") == marked("tpu") == [False, False, False]
    assert marked("cpu") == [True, True, True]
