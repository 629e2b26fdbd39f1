"""Derivatives at the extremes of heights, cameras and lights: always finite, in forward and in reverse mode.

In single precision, whose range is the smaller, and with the points on edges, whose derivative is added to the interior's.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxhf
from jaxhf import Settings

VERTICES = 9
ROUGH = np.random.default_rng(3).uniform(size=(VERTICES, VERTICES))
TALL = np.diag([1.0, 1.0, 1e20, 1.0])
LOW = np.diag([1.0, 1.0, 1e-20, 1.0])


OUTSIDE = (0.6, -0.7, 0.7), (0.5, 0.5, 0.05), 45.0


def beside(z: float) -> tuple[Any, Any, float]:
    """Looks level at the side of terrain that is as high as one likes."""
    return (0.6, -0.7, z), (0.5, 0.5, z), 45.0


def random_bits(seed: int) -> np.ndarray:
    """float32 numbers of all magnitudes, with nan and infinities."""
    bits = np.random.default_rng(seed).integers(0, 2**32, (VERTICES, VERTICES), dtype=np.uint32)
    heights = bits.view(np.float32).copy()
    heights[3:6, 3] = np.nan, np.inf, -np.inf
    return heights


def holes() -> np.ndarray:
    return np.where(np.arange(VERTICES**2).reshape(VERTICES, VERTICES) % 7 == 3, np.nan, 0.2 * ROUGH)


# Heights, how they are placed, and from where they are seen.
EXTREMES: dict[str, tuple[np.ndarray, np.ndarray, tuple[Any, Any, float]]] = {
    "flat": (0 * ROUGH, np.eye(4), OUTSIDE),
    "holes": (holes(), np.eye(4), OUTSIDE),
    "all holes": (np.nan * ROUGH, np.eye(4), OUTSIDE),
    "eye inside": (0.2 * ROUGH, np.eye(4), ((0.5, 0.5, 0.12), (0.9, 0.8, 0.1), 45.0)),
    "eye on a vertex": (0 * ROUGH, np.eye(4), ((0.5, 0.5, 0.0), (0.9, 0.8, 0.1), 45.0)),
    "seen from its plane": (0 * ROUGH, np.eye(4), ((0.5, -1, 0.0), (0.5, 0.5, 0.0), 45.0)),
    "grazing": (0.2 * ROUGH, np.eye(4), ((0.5, -1, 0.2), (0.5, 0.5, 0.2), 45.0)),
    "far away": (0.2 * ROUGH, np.eye(4), ((0.6e6, -0.7e6, 0.7e6), (0.5, 0.5, 0.05), 1e-4)),
    "tiny heights": (1e-20 * ROUGH, np.eye(4), OUTSIDE),
    "tiny heights made tall": (1e-20 * ROUGH, TALL, OUTSIDE),
    "tall": (1e6 * ROUGH, np.eye(4), beside(0.5e6)),
    "huge heights": (1e20 * ROUGH, np.eye(4), beside(0.5e20)),
    "huge heights made low": (1e20 * ROUGH, LOW, OUTSIDE),
    "random bits": (random_bits(0), np.eye(4), beside(0.0)),
    "random bits, eye inside": (random_bits(1), np.eye(4), ((0.51, 0.52, 0.0), (0.9, 0.8, 0.1), 45.0)),
    "near the largest number": (3e38 * (ROUGH - 0.5), np.eye(4), beside(0.0)),
}


def make_scene(name: str, pixels: int) -> jaxhf.Scene:
    """Lamp at a vertex of flat terrain, sun in its plane."""
    heights, place, (eye, target, fov) = EXTREMES[name]
    scene = jaxhf.Scene(
        [jaxhf.Object(jaxhf.Heightfield(heights.astype(np.float32)), world_from_object=place)],
        jaxhf.Perspective.look_at(eye, target, fov=fov, width=pixels, height=pixels),
        [jaxhf.Directional((1, 0, 0)), jaxhf.Point((0.5, 0.5, 0.0)), jaxhf.Sky(0.2)],
    )
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), scene)


@functools.partial(jax.jit, static_argnames=("settings",))
def forward(scene: jaxhf.Scene, change: jaxhf.Scene, settings: Settings) -> tuple[jax.Array, jax.Array]:
    """The picture, and its derivative."""
    return jax.jvp(lambda scene: jaxhf.render(scene, settings), (scene,), (change,))


@functools.partial(jax.jit, static_argnames=("settings",))
def reverse(scene: jaxhf.Scene, weights: jax.Array, settings: Settings) -> jaxhf.Scene:
    return jax.vjp(lambda scene: jaxhf.render(scene, settings), scene)[1](weights)[0]


def relative_change(leaf: jax.Array) -> jax.Array:
    """In proportion to each number; one where all are zero, and none in a hole."""
    known = np.where(np.isfinite(leaf), leaf, 0)
    change = np.random.default_rng(0).uniform(-1, 1, leaf.shape) * (known if known.any() else np.ones_like(known))
    return jnp.asarray(change, leaf.dtype)


@pytest.mark.parametrize(
    ("pixels", "edge_samples"),
    [
        (16, 0),
        pytest.param(16, 300, marks=pytest.mark.deep),
        *(pytest.param(256, n, marks=pytest.mark.slow) for n in (0, 20_000)),
    ],
)
@pytest.mark.parametrize("name", EXTREMES)
def test_finite(name, pixels, edge_samples):
    """In reverse mode, and in a million pixels of all scenes together in forward mode, too."""
    settings = Settings(edge_samples=edge_samples, chunk=256) if pixels == 16 else Settings(edge_samples=edge_samples)
    scene = make_scene(name, pixels)
    weights = jnp.asarray(np.random.default_rng(1).normal(size=(pixels, pixels, 3)), jnp.float32)
    gradient = reverse(scene, weights, settings)
    for path, leaf in jax.tree.leaves_with_path(gradient):
        where = jax.tree_util.keystr(path)
        # A shear moves heights of 1e38 by that much, beyond the largest number.
        assert np.isfinite(leaf).all() or (name.startswith("random bits") and where.endswith("world_from_object")), where
    np.testing.assert_array_equal(np.asarray(gradient.heights)[~np.isfinite(scene.heights)], 0)
    if pixels == 256:
        image, change = forward(scene, jax.tree.map(relative_change, scene), settings)
        assert np.isfinite(image).all()
        assert np.isfinite(change).all()
        assert np.abs(change).max() > 0
