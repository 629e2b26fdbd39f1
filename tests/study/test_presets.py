"""What each preset promises, on scenes that took no part in choosing it (benchmarks/presets.py names those that did)."""

import functools
from typing import Any

import jax
import numpy as np
import pytest

import jaxhf
from jaxhf.scene.procedural import bumps, fractal, waves
from jaxhf.study.measure import Derivative, Picture

WIDTH, HEIGHT = 128, 96

# As docs/guides/settings.md says: RMSE over the mean radiance, and the share of wrong hits.
PROMISES = {"draft": (0.35, 1e-3), "balanced": (0.07, 1e-3), "exact": (0.02, 1e-3)}


def mountains(dtype: Any) -> jaxhf.Scene:
    """Rough, in low light, with a part of the sky: silhouettes, long shadows, normals that face away."""
    field = jaxhf.Heightfield(fractal([96, 96], seed=21, exponent=2.0, range=(0.0, 0.3)).astype(dtype))
    camera = jaxhf.Perspective.look_at((0.5, -0.6, 0.6), (0.5, 0.5, 0.05), fov=38, width=WIDTH, height=HEIGHT)
    lights = [jaxhf.Directional.from_angles(azimuth=250, altitude=20), jaxhf.Sky((0.1, 0.15, 0.2))]
    return jaxhf.Scene([jaxhf.Object(field)], camera, lights)


def hills(dtype: Any) -> jaxhf.Scene:
    """Smooth, by a point light and parallel rays, with a black background round it."""
    field = jaxhf.Heightfield(bumps([80, 80], seed=5, count=20, range=(0.0, 0.4)).astype(dtype))
    camera = jaxhf.Orthographic.look_at((0.2, -1.0, 2.0), (0.5, 0.5, 0), extent=1.4, width=WIDTH, height=HEIGHT)
    return jaxhf.Scene([jaxhf.Object(field, jaxhf.Matte((0.8, 0.4, 0.3)))], camera, [jaxhf.Point((1.5, 0.2, 1.0), 3.0)])


def dunes(dtype: Any) -> jaxhf.Scene:
    """Written after the promises, which it therefore cannot have moved: grazing light, seen from near the ground."""
    field = jaxhf.Heightfield(waves([120, 90], seed=11, direction=40.0, range=(0.0, 0.08)).astype(dtype))
    camera = jaxhf.Perspective.look_at((0.5, -0.15, 0.22), (0.45, 0.6, 0.0), fov=55, width=WIDTH, height=HEIGHT)
    lights = [jaxhf.Directional.from_angles(azimuth=80, altitude=12), jaxhf.Sky(0.15)]
    return jaxhf.Scene([jaxhf.Object(field, jaxhf.Matte((0.9, 0.7, 0.4)))], camera, lights)


@functools.cache
def reference(scene: Any) -> dict[str, np.ndarray]:
    with jax.enable_x64(True):  # else a hit that single precision gets wrong is wrong in both
        found = Picture(scene(np.float64), jaxhf.Settings(samples=256))
        reference = found.reference()
        assert found.image.dtype == np.float64
        return reference


@pytest.mark.deep
@pytest.mark.parametrize("preset", PROMISES)
@pytest.mark.parametrize(
    "scene", [pytest.param(mountains, marks=pytest.mark.slow), pytest.param(hills, marks=pytest.mark.slow), dunes]
)
def test_promise(scene, preset):
    picture = Picture(scene(np.float32), getattr(jaxhf.Settings, preset)())
    assert picture.run().dtype == np.float32
    errors = picture.errors(reference(scene))
    assert 0 < errors["rmse"] <= PROMISES[preset][0]
    assert errors["wrong_hits"] <= PROMISES[preset][1]
    assert (reference(scene)["hits"][:, 0] >= 0).mean() > 0.2


@pytest.mark.x64  # of the reference
@pytest.mark.slow
def test_derivatives_come_nearer_from_preset_to_preset():
    finest = jaxhf.Settings(samples=64, edge_samples=300_000)
    exact = Derivative(mountains(np.float64), finest).reference()
    errors = []
    for preset in PROMISES:
        derivative = Derivative(mountains(np.float32), getattr(jaxhf.Settings, preset)())
        errors.append(derivative.errors(exact)["relative_error"])
    assert errors == sorted(errors, reverse=True)
    assert errors[-1] < 0.5
