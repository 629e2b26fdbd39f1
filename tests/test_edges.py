"""What moving boundaries add to the derivative: silhouettes, terminators and shadows, each where nothing else changes.

Boundaries whose speed is known in closed form; then whole pictures, against central differences of pictures with 24 x 24
samples a pixel. Those are compared after weighting with a smooth function of the place in the picture: pixel by pixel the
differences are noisy, as few of a pixel's samples change sides.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxhf
from jaxhf import _edges

EDGES = jaxhf.Settings(samples=16, edge_samples=2000)
INTERIOR = jaxhf.Settings(samples=16)
SIZE = 16  # pixels
# A plateau of this height on x < 0.25 slopes down to the ground at x = 0.375. Light comes from -x, TAN up for one along.
HEIGHT, EDGE, TAN = 0.1, 0.25, 0.4
SHADOW = EDGE + HEIGHT / TAN


def plateau(height=HEIGHT) -> jax.Array:
    return jnp.zeros((9, 9)).at[:, :3].set(height)


def from_above(x: Any, extent=0.1, y=0.5) -> jaxhf.Orthographic:
    """A square of `extent` around (x, y), with x to the right and y up."""
    frame = jnp.array([[1.0, 0, 0, 0], [0, 1, 0, y], [0, 0, -1, 2], [0, 0, 0, 1]]).at[0, 3].set(x)
    return jaxhf.Orthographic(frame, extent, width=SIZE, height=SIZE)


def tangent(picture: Callable[[Any], jax.Array], at: float = 0.0) -> np.ndarray:
    return np.asarray(jax.jvp(picture, (jnp.asarray(at),), (jnp.ones(()),))[1])


def rendered(scene: jaxhf.Scene, settings: jaxhf.Settings = EDGES) -> jax.Array:
    return jaxhf.render(scene, settings)[..., 0]


def shadow_scene(height=HEIGHT, towards=(-1, 0, TAN), camera=None, light=None) -> jaxhf.Scene:
    """The picture shows flat ground, half of it in the shadow of a plateau outside of the picture."""
    field = jaxhf.Object(jaxhf.Heightfield(plateau(height)), jaxhf.Matte(0.7))
    return jaxhf.Scene([field], camera or from_above(SHADOW + 0.01), [light or jaxhf.Directional(towards)])


LIT = 0.7 * TAN / np.hypot(1, TAN)  # radiance of the ground
PIXEL = 0.1 / SIZE


def assert_column(change: np.ndarray, rate: float, rtol: float = 0.05) -> None:
    """All of the change is in the column of the boundary, and the same in each row."""
    # rtol: one row has some 40 of the points, drawn one a stratum.
    column = int(np.argmax(np.abs(change).sum(0)))
    np.testing.assert_allclose(change[:, column], rate, rtol=rtol)
    np.testing.assert_allclose(change.sum(), rate * SIZE, rtol=0.02)
    assert np.abs(np.delete(change, column, 1)).max() < 1e-9 * abs(rate)


def test_cast_shadow_alone_moves_with_heights():
    """Raising the occluder by dh moves its shadow by dh / TAN, over lit ground."""
    interior = tangent(lambda height: rendered(shadow_scene(height), INTERIOR), HEIGHT)
    assert np.abs(interior).max() == 0
    assert_column(tangent(lambda height: rendered(shadow_scene(height)), HEIGHT), -LIT / TAN / PIXEL)


def test_cast_shadow_moves_with_the_light():
    """The shadow's end is at EDGE + HEIGHT / tan; the ground's radiance changes too, in proportion to the lit part."""

    def picture(tan: Any, settings: jaxhf.Settings) -> jax.Array:
        return rendered(shadow_scene(towards=jnp.stack([-jnp.ones(()), jnp.zeros(()), tan])), settings)

    boundary = tangent(lambda tan: picture(tan, EDGES) - picture(tan, INTERIOR), TAN)
    assert_column(boundary, LIT * HEIGHT / TAN**2 / PIXEL)


def test_cast_shadow_moves_with_a_point_light():
    """Light at (x, z) casts the plateau's edge to EDGE + (EDGE - x) HEIGHT / (z - HEIGHT)."""
    x, z = -0.5, 0.4
    shadow = EDGE + (EDGE - x) * HEIGHT / (z - HEIGHT)
    camera = from_above(shadow + 0.01)

    def picture(x: Any, settings: jaxhf.Settings) -> jax.Array:
        light = jaxhf.Point(jnp.stack([x, jnp.full((), 0.5), jnp.full((), z)]), 1.0)
        return rendered(shadow_scene(light=light, camera=camera), settings)

    boundary = tangent(lambda x: picture(x, EDGES) - picture(x, INTERIOR), x)
    square = (shadow - x) ** 2 + z**2 + (0.1 / 2 * np.linspace(-1, 1, SIZE)) ** 2
    lit = 0.7 / np.pi * z / square**1.5
    np.testing.assert_allclose(boundary.sum(1), lit * HEIGHT / (z - HEIGHT) / PIXEL, rtol=0.05)


def test_silhouette_alone_moves_with_heights():
    """A flat sheet seen 30 degrees from above the horizon, its far border in the picture: raising it by dh moves that
    border up by cos 30 dh."""
    up = np.array([0, -np.sin(np.pi / 6), np.cos(np.pi / 6)])

    def picture(height: Any, settings: jaxhf.Settings) -> jax.Array:
        field = jaxhf.Object(jaxhf.Heightfield(jnp.full((3, 3), height)), jaxhf.Matte(0.7))
        target = np.array([0.5, 1.0, 0.01])
        eye = target + 2 * np.array([0, -np.cos(np.pi / 6), np.sin(np.pi / 6)])
        camera = jaxhf.Orthographic.look_at(eye, target, up, 0.1, width=SIZE, height=SIZE)
        return rendered(jaxhf.Scene([field], camera, [jaxhf.Directional((0, 0, 1))]), settings)

    assert np.abs(tangent(lambda height: picture(height, INTERIOR))).max() < 1e-30
    assert_column(tangent(lambda height: picture(height, EDGES)).T, 0.7 * np.cos(np.pi / 6) / PIXEL)


def test_silhouette_alone_moves_with_a_transform():
    """The border of a flat sheet, seen from above, moves with the sheet."""

    def picture(x: Any, settings: jaxhf.Settings) -> jax.Array:
        world = jnp.eye(4).at[0, 3].set(x)
        field = jaxhf.Object(jaxhf.Heightfield(jnp.zeros((3, 3))), jaxhf.Matte(0.7), world)
        return rendered(jaxhf.Scene([field], from_above(1.01), [jaxhf.Directional((0, 0, 1))]), settings)

    assert np.abs(tangent(lambda x: picture(x, INTERIOR))).max() < 1e-30
    assert_column(tangent(lambda x: picture(x, EDGES)), 0.7 / PIXEL)


@pytest.mark.parametrize("settings", [{"shadows": False}, {"shadows": False, "shading": "flat"}], ids=["smooth", "flat"])
def test_terminator_moves_with_the_camera(settings):
    """A ridge, seen from above with one side dark: its crest moves against the camera. Nobody's silhouette but the light's."""
    ridge = jnp.asarray(0.5 - np.abs(np.linspace(-0.5, 0.5, 9)))[None].repeat(9, axis=0)
    still = {"samples": 16, **settings}

    def picture(x: Any, edge_samples: int) -> jax.Array:
        field = jaxhf.Object(jaxhf.Heightfield(ridge), jaxhf.Matte(0.7))
        scene = jaxhf.Scene([field], from_above(x + 0.49), [jaxhf.Directional((-1, 0, 0.2))])
        return rendered(scene, jaxhf.Settings(**still, edge_samples=edge_samples))

    boundary = tangent(lambda x: picture(x, 2000) - picture(x, 0))
    # The lit side's radiance just beside the crest; smooth normals there point straight up.
    cosine = 1.2 / np.sqrt(2) if "shading" in settings else 0.2
    assert_column(boundary, -0.7 * cosine / np.hypot(1, 0.2) / PIXEL)


# A whole scene: bumps under a tilted sheet that shadows them, a sun and a lamp. Each leaf moves boundaries.
SHEET = 0.2 * np.random.default_rng(3).uniform(size=(4, 4))
X, Y = np.meshgrid(np.linspace(0, 1, 9), np.linspace(0, 1, 9))
BUMPS = 0.12 * np.exp(-((X - 0.4) ** 2 + (Y - 0.6) ** 2) / 0.02) + 0.15 * np.exp(-((X - 0.75) ** 2 + (Y - 0.3) ** 2) / 0.015)
TILT = np.array([[0.3, 0.05, 0, 0.1], [-0.05, 0.3, 0, 0.15], [0.06, 0.03, 0.2, 0.25], [0, 0, 0, 1]])
EYES = {
    "perspective": jaxhf.Perspective.look_at((0.6, -0.7, 0.7), (0.5, 0.5, 0.05), fov=50.0, width=24, height=16),
    "orthographic": jaxhf.Orthographic.look_at((0.6, -0.7, 0.7), (0.5, 0.5, 0.05), extent=1.1, width=24, height=16),
}


def whole_scene(kind: str) -> jaxhf.Scene:
    scene = jaxhf.Scene(
        [
            jaxhf.Object(jaxhf.Heightfield(BUMPS), jaxhf.Matte(0.7), np.eye(4)),
            jaxhf.Object(jaxhf.Heightfield(SHEET), jaxhf.Matte(0.4), TILT),
        ],
        EYES[kind],
        [jaxhf.Directional((-0.8, 0.2, 0.45), 2.0), jaxhf.Point((0.9, -0.2, 0.8), 0.7)],
    )
    return jax.tree.map(jnp.asarray, scene)


def moved(leaf: Callable[[Any], Any], change: Any) -> Callable[[jaxhf.Scene], jaxhf.Scene]:
    """The direction in which one leaf changes and all others stand."""

    def direction(scene: jaxhf.Scene) -> jaxhf.Scene:
        still = jax.tree.map(jnp.zeros_like, scene)
        return eqx.tree_at(leaf, still, jnp.broadcast_to(jnp.asarray(change, float), leaf(scene).shape))

    return direction


def shift(x: float, y: float, z: float) -> np.ndarray:
    matrix = np.zeros((4, 4))
    matrix[:3, 3] = x, y, z
    return matrix


DIRECTIONS = {
    "heights": moved(lambda scene: scene.objects[0].shape.heights, 0.3 * BUMPS),
    "heights of the sheet": moved(lambda scene: scene.objects[1].shape.heights, X[:4, :4] + 0.3),
    "transform of the sheet": moved(lambda scene: scene.objects[1].world_from_object, shift(0.05, 0.02, 0.05)),
    "sun": moved(lambda scene: scene.lights[0].towards, (0.1, 0.1, 0.1)),
    "lamp": moved(lambda scene: scene.lights[1].p, (0.2, 0.1, -0.2)),
    "camera": moved(lambda scene: scene.camera.world_from_camera, shift(0.1, -0.05, 0.05)),
}
WIDTH, ROWS, STEP = 24, 16, 0.1
PLACE = np.arange(WIDTH)[None] / WIDTH * 2 + np.arange(ROWS)[:, None] / ROWS * 3
WEIGHTS = np.stack([np.cos(PLACE), np.sin(2 * PLACE), np.ones_like(PLACE)])[..., None]


def weighted(image: Any) -> Any:
    return jnp.sum(WEIGHTS * image[None], axis=(1, 2, 3))


@pytest.mark.parametrize("kind", EYES)
def test_whole_picture_against_central_differences(kind):
    """Every leaf that moves boundaries; the interior part alone is far off."""
    scene = whole_scene(kind)
    interior, edges = (jaxhf.Settings(samples=16, edge_samples=n) for n in (0, 8000))
    fine = jaxhf.Settings(samples=24 * 24)

    @jax.jit
    def change(scene: jaxhf.Scene, direction: jaxhf.Scene) -> list[jax.Array]:
        def along(settings: jaxhf.Settings) -> jax.Array:
            return jax.jvp(lambda scene: weighted(jaxhf.render(scene, settings)), (scene,), (direction,))[1]

        return [along(interior), along(edges)]

    errors = {}
    for name, direction in DIRECTIONS.items():
        d = direction(scene)
        ahead, behind = (jax.tree.map(lambda a, b, step=step: a + step * b, scene, d) for step in (STEP, -STEP))
        numeric = (weighted(jaxhf.render(ahead, fine)) - weighted(jaxhf.render(behind, fine))) / (2 * STEP)
        without, whole = change(scene, d)
        size = np.linalg.norm(numeric)
        print(kind, name, np.linalg.norm(whole - numeric) / size, np.linalg.norm(without - numeric) / size)
        errors[name] = np.linalg.norm(whole - numeric) / size
        assert np.linalg.norm(without - numeric) > 0.2 * size, name
    assert max(errors.values()) < 0.25, errors  # noise: some shadows here move a hundred times faster than most


def small(edge_samples: int = 400, **more: Any) -> tuple[jaxhf.Scene, jaxhf.Settings]:
    return whole_scene("perspective"), jaxhf.Settings(samples=1, edge_samples=edge_samples, **more)


def test_forward_and_reverse_agree():
    scene, settings = small()
    rng = np.random.default_rng(0)
    direction = jax.tree.map(lambda leaf: jnp.asarray(rng.normal(size=leaf.shape)), scene)
    picture, forward = jax.jvp(lambda scene: jaxhf.render(scene, settings), (scene,), (direction,))
    weights = rng.normal(size=picture.shape)
    (reverse,) = jax.vjp(lambda scene: jaxhf.render(scene, settings), scene)[1](jnp.asarray(weights))
    expected = np.vdot(weights, forward)
    dots = jax.tree.map(np.vdot, reverse, direction)
    np.testing.assert_allclose(sum(jax.tree.leaves(dots)), expected, rtol=1e-10)
    assert abs(expected) > 1


def test_picture_keeps_its_bits():
    scene, settings = small()
    plain = np.asarray(jaxhf.render(scene, jaxhf.Settings(samples=1)))
    assert np.array_equal(plain, jaxhf.render(scene, settings))
    primal, _ = jax.jvp(lambda scene: jaxhf.render(scene, settings), (scene,), (jax.tree.map(jnp.ones_like, scene),))
    assert np.array_equal(plain, primal)


def test_key_decides():
    scene, settings = small()
    direction = DIRECTIONS["heights"](scene)

    @jax.jit
    def change(key):
        return jax.jvp(lambda scene: jaxhf.render(scene, settings, key=key), (scene,), (direction,))[1]

    first, again, other = (np.asarray(change(jax.random.key(k))) for k in (1, 1, 2))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)


EXTREMES = {
    "flat": (np.zeros((5, 5)), EYES["perspective"]),
    "holes": (np.where(np.arange(25).reshape(5, 5) % 7 == 3, np.nan, 0.1 * X[:5, :5] * Y[:5, :5]), EYES["perspective"]),
    "all holes": (np.full((5, 5), np.nan), EYES["perspective"]),
    "eye inside": (SHEET, jaxhf.Perspective.look_at((0.5, 0.5, 0.12), (0.9, 0.8, 0.1), width=16, height=16)),
    "eye on a vertex": (np.zeros((3, 3)), jaxhf.Perspective.look_at((0.5, 0.5, 0.0), (0.9, 0.8, 0.1), width=16, height=16)),
    "seen from its plane": (np.zeros((3, 3)), jaxhf.Perspective.look_at((0.5, -1, 0.0), (0.5, 0.5, 0.0), width=16, height=16)),
    "steep": (1e6 * SHEET, EYES["perspective"]),
}


@pytest.mark.parametrize("name", EXTREMES)
def test_finite(name):
    heights, camera = EXTREMES[name]
    lamp, sun = jaxhf.Point((0.5, 0.5, 0.0)), jaxhf.Directional((1, 0, 0))  # at a vertex of flat terrain, and in its plane
    scene = jax.tree.map(jnp.asarray, jaxhf.Scene([jaxhf.Object(jaxhf.Heightfield(heights))], camera, [sun, lamp]))
    settings = jaxhf.Settings(edge_samples=300)
    picture, back = jax.vjp(lambda scene: jaxhf.render(scene, settings), scene)
    (gradient,) = back(jnp.ones_like(picture))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))


def test_lottery_is_exact_in_single_precision():
    """A million weights of which a few are large: a running sum in single precision would lose the small ones."""
    weights = np.full(2**20, 1e-9, np.float32)
    weights[::65536] = 1
    lottery = _edges.make_lottery(jnp.asarray(weights), jnp.asarray(1000, jnp.int32))
    tickets = np.diff(np.asarray(lottery.cumulative, np.int64), prepend=0)
    assert tickets.min() == 1
    np.testing.assert_allclose(tickets[::65536], 2**30 / 16, rtol=2e-3)
    assert 1000 * int(lottery.stratum) >= tickets.sum()
    assert tickets.sum() < 2**31


def test_refusals():
    with pytest.raises(ValueError, match="edge_samples must be a whole number from 0 on"):
        jaxhf.Settings(edge_samples=-1)
