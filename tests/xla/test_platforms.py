"""What another platform's program holds: lowered for GPUs and TPUs where there is neither."""

import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxhf
from jaxhf.boundary.points import _form_of_points
from jaxhf.fitting.model.sample_rows import Kind, Seen, _rows_of_points, _rows_of_samples
from jaxhf.fitting.model.unknowns import KNOWN
from jaxhf.preparation.localise import localise
from jaxhf.preparation.world import resolve_settings
from jaxhf.rendering.render import prepared_world
from jaxhf.scene.texture import FlatTexture
from jaxhf.xla.devices import local_mesh

ONE = local_mesh(1)
HEIGHTS = (0.1 * np.sin(np.arange(40.0)).reshape(5, 8)).astype(np.float32)
CAMERA = jaxhf.Perspective.look_at((0.5, -0.9, 0.8), (0.5, 0.5, 0.0), width=40, height=30)
SUN = jaxhf.Directional((1.0, 0.2, 0.3))
RAYS = np.tile(np.array([0.3, 0.4, 2], np.float32), (1024, 1)), np.tile(np.array([0, 0, -1], np.float32), (1024, 1))


def picture(heights: jax.Array, **knobs) -> jax.Array:
    scene = jaxhf.Scene([jaxhf.Object(jaxhf.Heightfield(heights))], CAMERA, [SUN])
    return jaxhf.render(scene, jaxhf.Settings(**knobs))


def hits(heights: jax.Array) -> jaxhf.Hit:
    return jaxhf.cast(jaxhf.Heightfield(heights), *RAYS)


@functools.cache
def prepared() -> Any:
    """A world with a map of the albedo, as programs for any size take it."""
    colours = jaxhf.ImageTexture(np.full((*HEIGHTS.shape, 3), 0.5, np.float32), at_vertices=True)
    scene = localise(jaxhf.Scene([jaxhf.Object(jaxhf.Heightfield(HEIGHTS), jaxhf.Matte(colours))], CAMERA, [SUN]))
    return prepared_world(scene, resolve_settings(jaxhf.Settings(), scene))


def linearised(heights: jax.Array) -> list[jax.Array]:
    """What the steps of a fit take of its pictures: these, and their derivatives in heights and an albedo map."""
    world = prepared()
    rows = world.surfaces[0].rows.at[: heights.size].set(heights.ravel())
    world = eqx.tree_at(lambda world: world.surfaces[0].rows, world, rows)
    seen: Any = Seen(world, CAMERA, (world.lights, CAMERA, ()), KNOWN).of_any_size()
    assert isinstance(seen.world.materials[0].albedo, FlatTexture)
    places = np.ones((1, 1024), np.float32)
    form = _form_of_points((3,), 128, np.dtype(np.float32)).contributions
    points = jax.tree.map(lambda form: jnp.zeros(form.shape, form.dtype), form)
    samples = _rows_of_samples(seen, (places, places), np.int32(1), ONE, Kind(1, (True, 1)))
    return jax.tree.leaves((samples, _rows_of_points(seen, points, np.int32(3), ONE, 1)))


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

    prepared()
    traced = jax.jit(PROGRAMS[name]).trace(jnp.asarray(HEIGHTS))

    def marked(platform: str) -> list[bool]:
        text = traced.lower(lowering_platforms=(platform,)).as_text()
        return [mark in text for mark in marks]

    assert marked("cuda") == marked("tpu") == [False, False, False]
    assert marked("cpu") == [True, True, True]
