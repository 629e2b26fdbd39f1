"""What moving boundaries add to the derivative: silhouettes, terminators and shadows, each where nothing else changes.

Boundaries whose speed is known in closed form; then whole pictures, against central differences of pictures with 24 x 24 or
more samples a pixel. Those are compared after weighting with a smooth function of the place in the picture: pixel by pixel the
differences are noisy, as few of a pixel's samples change sides.
"""

import dataclasses
import functools
import operator
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxhf
from jaxhf.boundary.guiding import initial_weights
from jaxhf.boundary.jump import boundary_segment, pass_edge, radiance_jump
from jaxhf.boundary.sample import BoundarySample
from jaxhf.fitting.model.pictures import choose_edge_samples
from jaxhf.preparation.localise import localise
from jaxhf.preparation.world import make_world, resolve_settings
from jaxhf.trace.edges import STEPS

EDGES = jaxhf.Settings(samples=16, edge_samples=4000)
INTERIOR = jaxhf.Settings(samples=16)
KEY = jax.random.key(0)  # that of a render without one
SIZE = 16  # pixels
# A plateau of this height on x < 0.25 slopes down to the ground at x = 0.375. Light comes from -x, TAN up for one along.
HEIGHT, EDGE, TAN = 0.1, 0.25, 0.4
SHADOW = EDGE + HEIGHT / TAN
PLATEAU = np.zeros((9, 9))
PLATEAU[:, :3] = 1
WIDE = 0.1  # of the picture, world units
PIXEL = WIDE / SIZE


def from_above(x: float) -> jaxhf.Orthographic:
    """A small square around (x, 0.5), with x to the right and y up."""
    frame = np.array([[1.0, 0, 0, x], [0, 1, 0, 0.5], [0, 0, -1, 2], [0, 0, 0, 1]])
    return jaxhf.Orthographic(frame, WIDE, width=SIZE, height=SIZE)


def small_scene(heights: Any, camera: jaxhf.Orthographic, light: Any, limb: float = 0.0) -> jaxhf.Scene:
    """All of one structure, so that they share their compiled programs; as traced leaves, which keep their derivatives.

    The material is Lambert's with a limb of 0, and Lommel's and Seeliger's with 1.
    """
    field = jaxhf.Object(jaxhf.Heightfield(jnp.asarray(heights)), jaxhf.LunarLambert(0.7, limb), np.eye(4))
    light = light if isinstance(light, jaxhf.Point) else jaxhf.Directional(light)
    return jax.tree.map(jnp.asarray, jaxhf.Scene([field], camera, [light]))


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


def heights_of(scene: jaxhf.Scene) -> Any:
    return scene.heightfields[0].heights


@functools.partial(jax.jit, static_argnames=("settings",))
def whole_change(
    scene: jaxhf.Scene, direction: jaxhf.Scene, settings: jaxhf.Settings = EDGES, key: jax.Array = KEY
) -> jax.Array:
    """The derivative of the picture."""
    return jax.jvp(lambda scene: jaxhf.render(scene, settings, key=key)[..., 0], (scene,), (direction,))[1]


@jax.jit
def changes(scene: jaxhf.Scene, direction: jaxhf.Scene, key: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The interior part of the derivative, from as many samples as are taken at boundaries, and what these add."""
    interior = whole_change(scene, direction, jaxhf.Settings(samples=64), key)
    return interior, whole_change(scene, direction, EDGES, key) - interior


def assert_line(change: Any, rate: float, elsewhere: float = 1e-6) -> None:
    """All of the change is in the column, or the row, of the boundary, and the same all along it."""
    # 0.05: one row has some 40 of the points, drawn one a stratum. Elsewhere: single precision.
    change = np.asarray(change)
    change = change if np.abs(change.sum(0)).max() > np.abs(change.sum(1)).max() else change.T
    column = int(np.argmax(np.abs(change).sum(0)))
    np.testing.assert_allclose(change[:, column], rate, rtol=0.05)
    np.testing.assert_allclose(change.sum(), rate * SIZE, rtol=0.02)
    assert np.abs(np.delete(change, column, 1)).max() < elsewhere * abs(rate)


LIT = 0.7 * TAN / np.hypot(1, TAN)  # radiance of the ground
TILTED = np.pi / 18
RIDGE = 0.5 - np.abs(np.linspace(-0.5, 0.5, 9))[None].repeat(9, axis=0)


def shadow_scene(light: Any = (-1.0, 0.0, TAN), at: float = SHADOW) -> jaxhf.Scene:
    """The picture shows flat ground, half of it in the shadow of a plateau outside of the picture."""
    return small_scene(HEIGHT * PLATEAU, from_above(at + 0.01), light)


def seen_aslant(
    heights: Any, target: Any, towards: Any, tilt: float, light: Any = (0.0, 0.0, 1.0), limb: float = 0.0
) -> jaxhf.Scene:
    """Looked at along a horizontal direction and downwards by an angle."""
    x, y = towards
    eye = np.array(target) + 2 * np.array([-x * np.cos(tilt), -y * np.cos(tilt), np.sin(tilt)])
    camera = jaxhf.Orthographic.look_at(eye, target, (0, 0, 1), WIDE, width=SIZE, height=SIZE)
    return small_scene(heights, camera, light, limb)


# The border of a flat sheet, x = 1, seen from above; and its far border, y = 1.
sheet_scene = functools.partial(small_scene, np.zeros((9, 9)), from_above(1.01), (0.0, 0.0, 1.0))
far_border_scene = functools.partial(seen_aslant, np.zeros((9, 9)), (0.5, 1.0, 0.01), (0, 1), np.pi / 6)
# A ridge before the black background, lit on both sides: a silhouette for the eye only. And one that is seen from above with
# one side dark: its crest is nobody's silhouette but the light's.
crest_scene = functools.partial(seen_aslant, RIDGE, (0.5, 0.5, 0.51), (1, 0), TILTED)
terminator_scene = functools.partial(small_scene, RIDGE, from_above(0.49), (-1.0, 0.0, 0.2))
camera_of, extent_of = operator.attrgetter("camera.world_from_camera"), operator.attrgetter("camera.extent")


def world_of(scene: jaxhf.Scene) -> Any:
    return scene.objects[0].world_from_object


# The scene, what changes, and the radiance that comes or goes times the boundary's speed. Raising the occluder by dh, by itself
# or by its transform, moves its shadow by dh / TAN over lit ground; the shadow ends at EDGE + HEIGHT / tan, 0.01 left of the
# picture's middle. Raising a sheet or a ridge moves its outline by the cosine of the tilt. A crest's smooth normal points up.
ALONE = {
    "shadow by heights": (shadow_scene, moved(heights_of, PLATEAU), -LIT / TAN),
    "shadow by a stretch": (shadow_scene, moved(world_of, np.diag([0, 0, 1, 0])), -LIT * HEIGHT / TAN),
    "shadow by a shift": (shadow_scene, moved(world_of, shift(1, 0, 0)), -LIT),
    "shadow by the camera": (shadow_scene, moved(camera_of, shift(1, 0, 0)), LIT),
    "shadow by the extent": (shadow_scene, moved(extent_of, 1), -LIT * 0.01 / WIDE),
    "shadow by the light": (shadow_scene, moved(lambda scene: scene.lights[0].towards, (0, 0, 1)), LIT * HEIGHT / TAN**2),
    "border by heights": (far_border_scene, moved(heights_of, 1), 0.7 * np.cos(np.pi / 6)),
    "border by a stretch": (sheet_scene, moved(world_of, np.diag([1, 0, 0, 0])), 0.7),
    "border by a shift": (sheet_scene, moved(world_of, shift(1, 0, 0)), 0.7),
    "border by the camera": (sheet_scene, moved(camera_of, shift(1, 0, 0)), -0.7),
    "border by the extent": (sheet_scene, moved(extent_of, 1), 0.7 * 0.01 / WIDE),
    "crest by heights": (crest_scene, moved(heights_of, 1), 0.7 * np.cos(TILTED)),
    "terminator by the camera": (terminator_scene, moved(camera_of, shift(1, 0, 0)), -0.7 * 0.2 / np.hypot(1, 0.2)),
}
SHADED = {"crest by heights", "terminator by the camera"}  # radiance changes beside the boundary: 4 x 4 samples for 8 x 8


@pytest.mark.parametrize("name", ALONE)
def test_a_boundary_moves_alone(name):
    make, direction, flow = ALONE[name]
    scene = make()
    interior, boundary = changes(scene, direction(scene), KEY)
    if name not in SHADED and name != "shadow by the light":
        assert np.abs(interior).max() < 1e-6 * abs(flow) / PIXEL
    assert_line(boundary, flow / PIXEL, 1e-3 if name in SHADED else 1e-6)


def test_a_shadow_takes_what_the_material_sends_to_the_eye():
    """Seen aslant, across the way in which the shadow moves."""
    scene = seen_aslant(HEIGHT * PLATEAU, (SHADOW + 0.01, 0.5, 0), (0, 1), np.arcsin(0.8), (-1.0, 0.0, TAN), 1.0)
    interior, boundary = changes(scene, moved(heights_of, PLATEAU)(scene), KEY)
    law = 2 / (TAN / np.hypot(1, TAN) + 0.8)
    assert np.abs(interior).max() < 1e-6 * LIT / TAN / PIXEL
    assert_line(boundary, -LIT * law / TAN / PIXEL)


@pytest.mark.deep  # another program
def test_cast_shadow_moves_with_a_point_light():
    """Light at (x, z) casts the plateau's edge to EDGE + (EDGE - x) HEIGHT / (z - HEIGHT)."""
    x, z = -0.5, 0.4
    shadow = EDGE + (EDGE - x) * HEIGHT / (z - HEIGHT)
    scene = shadow_scene(jaxhf.Point((x, 0.5, z), 1.0), shadow)
    _, boundary = changes(scene, moved(lambda scene: scene.lights[0].p, (1, 0, 0))(scene), KEY)
    square = (shadow - x) ** 2 + z**2 + (WIDE / 2 * np.linspace(-1, 1, SIZE)) ** 2
    lit = 0.7 / np.pi * z / square**1.5
    np.testing.assert_allclose(np.asarray(boundary).sum(1), lit * HEIGHT / (z - HEIGHT) / PIXEL, rtol=0.05)


@pytest.mark.deep
def test_edges_of_facets_move():
    """With flat shading radiance jumps at every edge: here at the crest of a low ridge, seen and lit on both sides."""
    scene = small_scene(0.1 * RIDGE, from_above(0.49), (-1.0, 0.0, 1.0))
    settings = dataclasses.replace(EDGES, shading="flat", shadows=False)
    change = whole_change(scene, moved(camera_of, shift(1, 0, 0))(scene), settings)
    assert_line(change, -0.7 * (1.1 - 0.9) / np.hypot(1, 0.1) / np.sqrt(2) / PIXEL)


def test_points_are_refused_beside_a_skirt():
    """In both modes, and in a fit; a picture by itself, and a derivative without points, stay what they were."""
    field = jaxhf.Heightfield(jnp.asarray(HEIGHT * PLATEAU, jnp.float32))
    objects = [jaxhf.Object(field), jaxhf.Object(jaxhf.Skirt.of(field, -0.1))]
    scene = jaxhf.Scene(objects, from_above(SHADOW), [jaxhf.Directional((-1.0, 0.0, TAN))])

    def picture(heights: jax.Array, points: int) -> jax.Array:
        return jaxhf.render(scene.with_heights(heights), jaxhf.Settings(edge_samples=points))

    def refused(points: int) -> Any:
        said = rf"Settings: edge_samples must be 0 where a scene with a Skirt is differentiated.*; it is {points}\b"
        return pytest.raises(jaxhf.ArgumentError, match=said)

    with refused(400):
        jax.grad(lambda heights: picture(heights, 400).sum())(scene.heights)
    with refused(9):
        jax.jvp(lambda heights: picture(heights, 9), (scene.heights,), (scene.heights,))
    with refused(300):
        jaxhf.fit([scene], [np.zeros((SIZE, SIZE))], settings=jaxhf.Settings(edge_samples=300))
    assert choose_edge_samples([localise(scene)], jaxhf.Settings(), shadows=True) == 0
    jax.eval_shape(lambda heights: picture(heights, 400), scene.heights)
    jax.eval_shape(jax.grad(lambda heights: picture(heights, 0).sum()), scene.heights)


def test_boundary_pixels_are_looked_at_again():
    """Radiance is in proportion to albedo: where the shadow ends, 8 x 8 samples say how much of a pixel is lit."""
    scene = shadow_scene()
    finer, difference = changes(scene, moved(lambda scene: scene.objects[0].material.albedo, 1)(scene), KEY)
    assert np.abs(difference).max() < 1e-6
    assert np.abs(finer - jaxhf.render(scene, INTERIOR)[..., 0] / 0.7).max() > 0.1 * LIT


@pytest.mark.slow  # each agrees with a truth: here forwards, in rendering/test_users.py in reverse
def test_forward_and_reverse_agree():
    scene = shadow_scene()
    rng = np.random.default_rng(0)
    direction = jax.tree.map(lambda leaf: jnp.asarray(rng.normal(size=leaf.shape), leaf.dtype), scene)
    weights = rng.normal(size=(SIZE, SIZE))
    forward = np.vdot(weights, whole_change(scene, direction))

    @jax.jit
    def gradient(scene):
        return jax.grad(lambda scene: jnp.vdot(jnp.asarray(weights), jaxhf.render(scene, EDGES)[..., 0]))(scene)

    dots = jax.tree.leaves(jax.tree.map(np.vdot, gradient(scene), direction))
    np.testing.assert_allclose(sum(dots), forward, rtol=2e-5)
    assert abs(forward) > 1


def test_picture_keeps_its_bits():
    scene = shadow_scene()
    np.testing.assert_array_equal(jaxhf.render(scene, EDGES), jaxhf.render(scene, INTERIOR))


def test_key_decides():
    scene = shadow_scene()
    direction = moved(heights_of, PLATEAU)(scene)
    first, again, other = (np.asarray(changes(scene, direction, jax.random.key(k))[1]) for k in (1, 1, 2))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)


def against_differences(scene: jaxhf.Scene, direction: jaxhf.Scene, step: float, side: int, *derivatives: Any) -> list[float]:
    """How far images of the derivative are from a central difference, all weighted smoothly, as shares of its norm."""
    fine = jaxhf.Settings(samples=side * side)
    ahead, behind = (
        np.asarray(jaxhf.render(jax.tree.map(lambda a, b, s=s: a + s * b, scene, direction), fine), np.float64).mean(-1)
        for s in (step, -step)
    )
    height, width = ahead.shape  # weights are three smooth functions of the place
    place = np.arange(width)[None] / width * 2 + np.arange(height)[:, None] / height * 3
    weights = np.stack([np.cos(place), np.sin(2 * place), np.ones_like(place)])
    numeric = np.sum(weights * (ahead - behind) / (2 * step), axis=(1, 2))
    found = [np.sum(weights * np.asarray(image, np.float64), axis=(1, 2)) for image in derivatives]
    return [float(np.linalg.norm(each - numeric) / np.linalg.norm(numeric)) for each in found]


X, Y = np.meshgrid(np.linspace(0, 1, 9), np.linspace(0, 1, 9))
BUMPS = 0.12 * np.exp(-((X - 0.4) ** 2 + (Y - 0.6) ** 2) / 0.02) + 0.15 * np.exp(-((X - 0.75) ** 2 + (Y - 0.3) ** 2) / 0.015)
SUN = (-0.8, 0.2, 0.45)


def test_bumps_against_central_differences():
    """Silhouettes, shadows, terminators and the border at once, and the light between them."""
    camera = jaxhf.Orthographic.look_at((0.6, -0.9, 0.5), (0.5, 0.5, 0.05), (0, 0, 1), 1.1, width=SIZE, height=SIZE)
    scene = small_scene(BUMPS, camera, SUN)
    direction = moved(heights_of, 0.3 * BUMPS)(scene)
    interior, boundary = changes(scene, direction, KEY)
    whole, without = against_differences(scene, direction, 0.05, 32, interior + boundary, interior)
    assert whole < 0.1, (whole, without)  # 0.042, without the boundaries 0.36 or more
    assert without > 0.3


# A whole scene: bumps under a tilted sheet that shadows them, a sun and a lamp. Each leaf moves boundaries.
SHEET = 0.2 * np.random.default_rng(3).uniform(size=(4, 4))
TILT = np.array([[0.3, 0.05, 0, 0.1], [-0.05, 0.3, 0, 0.15], [0.06, 0.03, 0.2, 0.25], [0, 0, 0, 1]])


def whole_scene() -> jaxhf.Scene:
    ground = jaxhf.Object(jaxhf.Heightfield(BUMPS), jaxhf.Matte(0.7), np.eye(4))
    sheet = jaxhf.Object(jaxhf.Heightfield(SHEET), jaxhf.Matte(0.4), TILT)
    eye = jaxhf.Perspective.look_at((0.6, -0.7, 0.7), (0.5, 0.5, 0.05), fov=50.0, width=24, height=16)
    lights = [jaxhf.Directional(SUN, 2.0), jaxhf.Point((0.9, -0.2, 0.8), 0.7)]
    return jax.tree.map(jnp.asarray, jaxhf.Scene([ground, sheet], eye, lights))


# Turns about a generic axis.
TURN = np.array([[0, -0.3, 0.2, 0], [0.3, 0, -0.1, 0], [-0.2, 0.1, 0, 0], [0, 0, 0, 0]])


def sheet_of(scene: jaxhf.Scene) -> Any:
    return scene.objects[1].world_from_object


# Every kind of leaf that moves boundaries.
DIRECTIONS = {
    "heights": moved(heights_of, 0.3 * BUMPS),
    "heights of the sheet": moved(lambda scene: scene.objects[1].shape.heights, X[:4, :4] + 0.3),
    "place of the sheet": moved(sheet_of, shift(0.05, 0.02, 0.05)),
    "turn of the sheet": lambda scene: moved(sheet_of, TURN @ np.asarray(sheet_of(scene)))(scene),
    "stretch of the ground": moved(world_of, np.diag([0.1, 0.05, 0.5, 0])),
    "sun": moved(lambda scene: scene.lights[0].towards, (0.1, 0.1, 0.1)),
    "lamp": moved(lambda scene: scene.lights[1].p, (0.2, 0.1, -0.2)),
    "place of the camera": moved(camera_of, shift(0.1, -0.05, 0.05)),
    "turn of the camera": lambda scene: moved(camera_of, TURN @ np.asarray(camera_of(scene)))(scene),
    "zoom": moved(lambda scene: scene.camera.fov, 12.5),
}


@pytest.mark.slow
def test_whole_picture_against_central_differences():
    """Every leaf that moves boundaries, seen in perspective; the interior part alone is far off."""
    scene, errors = whole_scene(), {}
    interior, edges = (jaxhf.Settings(samples=16, edge_samples=n) for n in (0, 40_000))
    for name, direction in DIRECTIONS.items():
        d = direction(scene)
        both = whole_change(scene, d, edges), whole_change(scene, d, interior)
        errors[name], without = against_differences(scene, d, 0.05, 24, *both)
        assert without > 0.1, name
    assert max(errors.values()) < 0.12, errors  # 0.088 for the heights of the sheet, 0.067 for the sun, else 0.033


# Steep bumps seen from the side: many silhouettes that are not alone in their pixel, and long shadows.
RIDGES = 0.3 * np.random.default_rng(5).uniform(size=(9, 9))
ASIDE = jaxhf.Orthographic.look_at((1.6, -1.2, 0.9), (0.5, 0.5, 0.1), (0, 0, 1), 1.2, width=SIZE, height=SIZE)


@jax.jit
def flows_at(scene: jaxhf.Scene, s: float) -> tuple[jax.Array, jax.Array]:
    """The flow of light across the boundary at the same place of every edge, and whether the edge is drawn from."""
    scene = localise(scene)
    world, camera = make_world(scene, resolve_settings(EDGES, scene)), scene.camera
    weights = initial_weights(world, camera)
    vertices = jnp.stack(jnp.meshgrid(jnp.arange(9, dtype=jnp.int32), jnp.arange(9, dtype=jnp.int32)), -1).reshape(-1, 2)

    def flow(edge: jax.Array, start: jax.Array, end: jax.Array, light: jax.Array, valid: jax.Array) -> jax.Array:
        none, at = jnp.zeros((), jnp.int32), jnp.asarray(s, weights.dtype)
        sample = BoundarySample(
            valid, edge, none, light, start, end, at, jnp.ones_like(at), none, jnp.zeros(2, jnp.int32), valid, at
        )
        sample, fold, beyond = pass_edge(world, camera, sample)
        segment = boundary_segment(world, camera, sample, fold)
        parts = [radiance_jump(world, camera, sample, fold, beyond, segment.valid, jnp.asarray(k, jnp.int32)) for k in (0, 1)]
        return (parts[0] + parts[1])[0] * segment.across

    starts = jnp.tile(vertices, (6, 1))
    ends = starts + jnp.tile(jnp.repeat(jnp.array(STEPS, jnp.int32), len(vertices), axis=0), (2, 1))
    lights = jnp.repeat(jnp.array([-1, 0], jnp.int32), 3 * len(vertices))
    edges = jnp.arange(len(starts), dtype=jnp.int32)
    return jax.vmap(flow)(edges, starts, ends, lights, weights > 0), weights > 0


@pytest.mark.deep
@pytest.mark.x64  # the truth of single precision
@pytest.mark.parametrize("s", [1e-4, 1 - 1e-4])
def test_jump_at_the_end_of_an_edge_is_its_own(s):
    """There the next edge of a silhouette is 2e-4 pixels away; rays as far beside it would see that one's jump."""
    scene = small_scene(RIDGES, ASIDE, SUN)
    (double, drawn), (single, _) = flows_at(scene, s), flows_at(jax.tree.map(lambda leaf: leaf.astype(np.float32), scene), s)
    assert 100 < drawn.sum() < 300
    np.testing.assert_allclose(single, double, atol=1e-3 * np.abs(double).max())


@pytest.mark.deep  # two objects: another program
def test_border_shared_by_two_sheets_is_no_boundary():
    """Two sheets that go on in one plane, lit and seen from either side: where they meet, nothing jumps."""
    places = np.eye(4), np.eye(4) + shift(1, 0, 0.3)
    sheets = [jaxhf.Object(jaxhf.Heightfield(0.3 * X), jaxhf.Matte(0.7), place) for place in places]
    for eye in ((0.3, -0.6, 1.5), (1.9, -0.6, 1.5)):
        camera = jaxhf.Orthographic.look_at(eye, (1.0, 0.5, 0.3), (0, 0, 1), 0.4, width=SIZE, height=SIZE)
        for light in ((-0.8, 0.2, 0.6), (0.8, 0.2, 1.6)):
            scene = jax.tree.map(jnp.asarray, jaxhf.Scene(sheets, camera, [jaxhf.Directional(light)]))
            assert np.abs(whole_change(scene, moved(camera_of, shift(0.3, 0.2, 0.1))(scene))).max() < 1e-4
