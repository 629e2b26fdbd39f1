"""The picture as a whole: where its pixels look, what its AOVs hold, and its bits; against NumPy in double precision."""

import functools
from typing import Any

import aimed
import jax
import jax.numpy as jnp
import numpy as np
import oracle
import pytest

import jaxhf
from jaxhf.rendering import picture
from jaxhf.rendering.render import require_key
from jaxhf.rendering.tiles import Tiling

EYE, TARGET = (-0.25, -0.75, 1.25), (0.5, 0.5, 0.125)  # exact in binary, so that an offset takes nothing from them
WIDTH, HEIGHT, FOV = 24, 16, 24.0
SKY = np.array([0.1, 0.2, 0.4], np.float32)
SUN, LAMP = (-1, 0.5, 0.5), (1.5, 0.25, 0.5)
ROUNDING = 1e-5  # some hundred operations in single precision
PLAIN = jaxhf.Settings(shadows=False)


def terrain(seed=0, roughness=0.1):
    """Generic smooth heights: no two cells alike, no symmetry."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[0:9, 0:9] / 8
    waves = rng.normal(size=(6, 4))
    a, b, c, d = waves.T[:, :, None, None]
    return roughness * np.sum(a * np.sin(4 * b * x + 4 * c * y + 7 * d), axis=0)


def scene(heights=None, dtype: Any = np.float32, camera: jaxhf.Perspective | None = None, offset=(0.0, 0.0, 0.0), samples=1):
    heights = terrain(roughness=0.2) if heights is None else heights
    if camera is None:
        camera = jaxhf.Perspective.look_at(np.add(EYE, offset), np.add(TARGET, offset), fov=FOV, width=WIDTH, height=HEIGHT)
    field = jaxhf.Heightfield(np.asarray(heights, dtype), x0=offset[0], y0=offset[1])
    lights = [jaxhf.Directional(SUN, (2, 3, 4)), jaxhf.Point(np.add(LAMP, offset), 2.0), jaxhf.Sky(SKY)]
    return jaxhf.Scene([jaxhf.Object(field, jaxhf.Matte((0.5, 0.6, 0.7)))], camera, lights, samples)


@functools.cache
def rendered(dtype: Any = np.float32, offset=(0.0, 0.0, 0.0)):
    """The image and all AOVs of `scene`, in NumPy."""
    image, aovs = jaxhf.render(scene(dtype=dtype, offset=offset), aovs=jaxhf.AOVS)
    return np.asarray(image), {name: np.asarray(value) for name, value in aovs.items()}


# What an AOV is: its shape beyond (h, w), whether it is of floats, and its value where there is nothing.
AOV_KINDS = {
    "depth": ((), "f", np.inf),
    "normal": ((3,), "f", 0),
    "uv": ((2,), "f", 0),
    "status": ((), "i", jaxhf.Status.MISS),
    "object": ((), "i", -1),
    "cell": ((2,), "i", -1),
    "shadow": ((2,), "b", False),
    "steps": ((), "i", 0),
    "exhausted": ((), "i", 0),
}


@aimed.PRECISIONS
def test_shapes_and_dtypes(dtype):
    assert set(AOV_KINDS) == set(jaxhf.AOVS)
    image, aovs = rendered(dtype)
    assert (image.shape, image.dtype) == ((HEIGHT, WIDTH, 3), dtype)
    assert set(aovs) == set(jaxhf.AOVS)
    for name, (tail, kind, _) in AOV_KINDS.items():
        assert aovs[name].shape == (HEIGHT, WIDTH, *tail), name
        assert aovs[name].dtype == {"f": dtype, "i": np.int32, "b": np.bool_}[kind], name


def test_aovs_against_the_oracle():
    """Rays by hand; the sun's and the lamp's shadows by rays towards them."""
    image, aovs = rendered()
    ground = terrain(roughness=0.2).astype(np.float32), 1 / 8, 1 / 8, 0.0, 0.0
    d = oracle.view_rays(EYE, TARGET, FOV, WIDTH, HEIGHT).reshape(-1, 3)
    exact = oracle.cast(*ground, np.broadcast_to(EYE, d.shape), d, slack=1e-6)
    shown = {name: value.reshape(len(d), *value.shape[2:]) for name, value in aovs.items()}
    assert exact.decided.mean() > 0.98
    np.testing.assert_array_equal(shown["status"][exact.decided], exact.status[exact.decided])
    met = shown["status"] == jaxhf.Status.HIT
    assert 0.5 < met.mean() < 0.95
    for name, (_, _, nothing) in AOV_KINDS.items():
        if name != "steps":
            np.testing.assert_array_equal(shown[name][~met], np.broadcast_to(nothing, shown[name][~met].shape), name)
    np.testing.assert_array_equal(image.reshape(-1, 3)[~met], np.broadcast_to(SKY, (np.sum(~met), 3)))
    np.testing.assert_array_equal(shown["object"], np.where(met, 0, -1))
    assert np.all(shown["steps"][met] > 0)

    known, place = met & exact.decided & (exact.spread < 1e-4), exact.place
    inside = known & (place.inside > 1e-3)
    assert inside.sum() > 0.9 * met.sum()
    np.testing.assert_allclose(shown["depth"][known], exact.t[known], rtol=1e-5)
    np.testing.assert_allclose(shown["uv"][known], place.uv[known], atol=1e-5)
    np.testing.assert_array_equal(shown["cell"][inside], place.cell[inside])
    normals, *_ = oracle.shading_normals(*ground[:3], place, "six")
    np.testing.assert_allclose(shown["normal"][inside], normals[inside], atol=1e-4)
    n = -place.n * np.sign((place.n * d).sum(1))[:, None]  # on the side that is seen: at the western border from below
    start = place.p + 1e-6 * n
    for light, (towards, distance) in enumerate(((np.broadcast_to(SUN, d.shape), np.inf), (np.subtract(LAMP, start), 1))):
        hidden = (oracle.cast(*ground, start, towards).t < distance) | ((n * towards).sum(1) < 0)
        assert np.mean((shown["shadow"][:, light] == hidden)[known]) > 0.98
        assert 0.05 < hidden[known].mean() < 0.95


def test_a_view_of_nothing():
    away = jaxhf.Perspective.look_at(EYE, np.subtract(EYE, (1, 1, -1)), fov=FOV, width=WIDTH, height=HEIGHT)
    image, aovs = jaxhf.render(scene(camera=away), aovs=jaxhf.AOVS)
    np.testing.assert_array_equal(image, np.broadcast_to(SKY, image.shape))
    for name, (tail, _, nothing) in AOV_KINDS.items():
        np.testing.assert_array_equal(aovs[name], np.broadcast_to(nothing, (HEIGHT, WIDTH, *tail)), name)


@pytest.mark.parametrize("key", [0, jnp.float32(0), np.zeros(2, int), jax.random.split(jax.random.key(0))])
def test_what_is_no_key_is_refused(key):
    """As `render` does, whose annotations are checked in tests."""
    with pytest.raises(jaxhf.ArgumentError, match=r"^render: key must be one key of JAX's, as jax.random.key\(0\) makes it"):
        require_key(key)


def test_unknown_aov_is_an_error():
    with pytest.raises(ValueError, match=r"aovs must be among depth, .*; one is 'colour'"):
        jaxhf.render(scene(), aovs=("depth", "colour"))


# Where pixels look.


def test_perspective_camera():
    """The middle of the picture shows the target, +x is right, and fov is the angle across the shorter side: here the width."""
    width, height = 9, 15
    eye, target = np.array([1.0, -4.0, 3.0]), np.array([0.5, 0.25, 0.0])
    ground = jaxhf.Heightfield(np.zeros((2, 2), np.float32), dx=40.0, x0=-20.0, y0=-20.0)
    camera = jaxhf.Perspective.look_at(eye, target, fov=30, width=width, height=height)
    _, aovs = jaxhf.render(jaxhf.Scene([jaxhf.Object(ground)], camera), jaxhf.Settings(chunk=64), aovs=("uv", "depth"))
    p = np.asarray(aovs["uv"]) * 40 - 20
    np.testing.assert_allclose(p[height // 2, width // 2], target[:2], atol=40 * 1e-6)
    assert np.all(np.diff(p[..., 0], axis=1) > 0)  # the view is to the north: right is east,
    assert np.all(np.diff(p[..., 1], axis=0) < 0)  # and the upper rows are farther away
    d = oracle.view_rays(eye, target, 30, width, height)
    np.testing.assert_allclose(p, (eye - eye[2] / d[..., 2:] * d)[..., :2], atol=40 * 1e-6)
    np.testing.assert_allclose(aovs["depth"], -eye[2] / d[..., 2], rtol=ROUNDING)
    across = np.degrees(
        np.arccos(d[height // 2, 0] @ d[height // 2, -1])
    )  # from centre to centre: a pixel less than the whole side
    assert 30 * 0.8 < across < 30


def test_orthographic_camera_straight_down():
    """Columns run east, rows run south, and the shorter side spans the extent."""
    width, height = 6, 10
    field = jaxhf.Heightfield(terrain().astype(np.float32), dx=2.0, dy=3.0, x0=-5.0, y0=7.0)
    camera = jaxhf.Orthographic.look_at((2, 18, 9), (2, 18, 0), (0, 1, 0), extent=4.5, width=width, height=height)
    _, aovs = jaxhf.render(jaxhf.Scene([jaxhf.Object(field)], camera), jaxhf.Settings(chunk=64), aovs=("uv",))
    for row in range(height):
        for column in range(width):
            x, y = 2 + (column + 0.5 - width / 2) * 0.75, 18 - (row + 0.5 - height / 2) * 0.75
            np.testing.assert_allclose(aovs["uv"][row, column], ((x + 5) / 16, (y - 7) / 24), rtol=ROUNDING)


# Bits.


def test_an_offset_costs_no_bit():
    """At 5e6 float32 has steps of 0.5, half of this terrain."""
    image, aovs = rendered()
    far_image, far_aovs = rendered(offset=(5e6, 4.5e6, 0.0))
    np.testing.assert_array_equal(far_image, image)
    for name, value in aovs.items():
        np.testing.assert_array_equal(far_aovs[name], value, name)


@pytest.mark.deep
@pytest.mark.x64  # of the whole picture, with smooth normals and three lights
def test_single_precision_agrees_with_double():
    single, single_aovs = rendered()
    double, double_aovs = rendered(np.float64)
    inside = (single_aovs["status"] == double_aovs["status"]) & (single_aovs["shadow"] == double_aovs["shadow"]).all(-1)
    assert inside.mean() > 0.98  # edges
    assert np.abs(single - double)[inside].max() < 1e-4


@pytest.mark.optimised  # two programs, whose bits are the same as users compile them
@pytest.mark.parametrize("transformation", [jax.jit, jax.jacfwd, jax.vmap])
def test_there_is_no_progress_within_a_transformation(transformation):
    heights = jnp.zeros((1, 3, 3) if transformation is jax.vmap else (3, 3), np.float32)
    camera = jaxhf.Perspective.look_at((0, -1, 1), (0, 0, 0), width=4, height=4)
    for owner, fun in (
        ("render", lambda z, **how: jaxhf.render(jaxhf.Scene([jaxhf.Object(jaxhf.Heightfield(z))], camera, ()), **how)),
        ("horizon", lambda z, **how: jaxhf.horizon(z, 4, dx=1.0, **how)),
    ):
        with pytest.raises(ValueError, match=f"^{owner}: progress must be None within jit, grad, vmap and the like, where"):
            transformation(lambda z, fun=fun: fun(z, progress=lambda done, total: None))(heights)


def test_tiles_cover_the_picture_and_no_more():
    camera = jaxhf.Perspective.look_at(EYE, TARGET, width=33, height=17)
    assert Tiling(camera.width, camera.height, jaxhf.Settings(chunk=64)).count == 5 * 3  # of 8 x 8 pixels


def test_tiles_lie_where_they_belong():
    tiling = Tiling(33, 17, jaxhf.Settings(chunk=64))
    tiles = np.random.default_rng(0).random((15, 64, 3))
    whole = np.zeros((24, 40, 3))
    for first in range(2):
        tiling.place(tiles[first::2], np.arange(first, 15, 2), whole)
    np.testing.assert_array_equal(whole[:17, :33], tiling.assemble(tiles))
    tiling.place(tiles[..., :0], np.arange(15), whole[..., :0])  # as shadows under a sky alone, whose last axis counts lights


def test_progress_gives_the_same_bits(monkeypatch):
    monkeypatch.setattr(picture, "_PIXELS", 2**9)  # traced at once
    camera = jaxhf.Perspective.look_at(EYE, TARGET, fov=FOV, width=70, height=67)
    settings = jaxhf.Settings(chunk=64)  # 9 x 9 tiles, the last of each row and column partly outside
    calls = []
    image = jaxhf.render(scene(camera=camera), settings)
    grown, aovs = jaxhf.render(
        scene(camera=camera), settings, aovs=("depth",), progress=lambda done, total: calls.append((done, total))
    )
    np.testing.assert_array_equal(grown, image)
    assert aovs["depth"].shape == (67, 70)
    done, total = np.array(calls).T
    assert np.all(total == 67 * 70)
    assert np.all(np.diff(done) > 0)
    assert 0 < done[0] < done[-1] == 67 * 70


# Samples and steps.


def test_samples_round_up_to_a_square():
    def program(samples, settings=PLAIN):
        return jax.jit(lambda scene: jaxhf.render(scene, settings)).lower(scene(samples=samples)).as_text()

    nine = program(1, jaxhf.Settings(shadows=False, samples=9))  # which stand for the scene's
    assert program(5) == program(9) == nine
    assert program(4) != nine


def test_exhausted_rays_are_no_misses():
    full_image, full = rendered()
    assert full["exhausted"].sum() == 0
    image, cut = jaxhf.render(scene(), jaxhf.Settings(max_steps=1), aovs=jaxhf.AOVS)
    status, out_of_steps = np.asarray(cut["status"]), np.asarray(cut["status"]) == jaxhf.Status.EXHAUSTED
    assert out_of_steps.sum() > 50
    np.testing.assert_array_equal(status[~out_of_steps], full["status"][~out_of_steps])
    np.testing.assert_array_equal(full["status"][status == jaxhf.Status.MISS], jaxhf.Status.MISS)
    assert np.all(np.asarray(cut["exhausted"])[out_of_steps] == 1)
    assert np.all(np.asarray(image)[out_of_steps] == 0)
    assert np.all(np.asarray(cut["steps"]) <= 1)
    spared = np.asarray(cut["exhausted"]) == 0
    np.testing.assert_allclose(np.asarray(image)[spared], full_image[spared], rtol=ROUNDING)


# Holes.


@pytest.mark.parametrize("hole", [np.nan, np.inf, -np.inf])
def test_holes_show_the_background_and_cast_no_shadow(hole):
    # A ridge along x = 1/2, 1/8 high and 1/8 wide at each side, in light from the east at slope 1/2. Its middle is missing.
    heights = np.zeros((9, 9), np.float32)
    heights[:, 4] = 1 / 8
    broken = heights.copy()
    broken[4, 4] = hole
    camera = jaxhf.Perspective.look_at((0.5, 0.5, 2), (0.5, 0.5, 0), (0, 1, 0), fov=18, width=WIDTH, height=HEIGHT)

    def seen(heights):
        # The structure of `scene`: no new program.
        lights = [jaxhf.Directional((1, 0, 0.5)), jaxhf.Point((0.5, 0.5, 9)), jaxhf.Sky(SKY)]
        base = scene(heights, camera=camera)
        image, aovs = jaxhf.render(jaxhf.Scene(base.objects, camera, lights), aovs=jaxhf.AOVS)
        return np.asarray(image), {name: np.asarray(value) for name, value in aovs.items()}

    image, aovs = seen(broken)
    _, whole = seen(heights)
    d = oracle.view_rays((0.5, 0.5, 2), (0.5, 0.5, 0), 18, WIDTH, HEIGHT, up=(0, 1, 0))
    assert np.all(whole["status"] == jaxhf.Status.HIT)
    x, y = (whole["uv"] * 8).transpose(2, 0, 1)
    hole = (np.abs(x - 4) < 1) & (np.abs(y - 4) < 1)
    x, y = ((0.5, 0.5) - 2 / d[..., 2:] * d[..., :2]).transpose(2, 0, 1) * 8  # on the plain, z = 0
    plain = np.abs(x - 4) > 1.2
    np.testing.assert_array_equal(aovs["status"], np.where(hole, jaxhf.Status.MISS, jaxhf.Status.HIT))
    np.testing.assert_array_equal(image[hole], np.broadcast_to(SKY, image[hole].shape))
    assert 4 <= hole.sum() < 100
    # The ridge's edge hides the light from 2/8 west of it on; what would cross the hole's two rows of cells gets through.
    shaded = plain & (x > 2) & (x < 3)
    np.testing.assert_array_equal(whole["shadow"][..., 0][plain], shaded[plain])
    np.testing.assert_array_equal(aovs["shadow"][..., 0][plain], (shaded & (np.abs(y - 4) > 1))[plain])
    assert (shaded & (np.abs(y - 4) < 1)).sum() > 4


# Transformations of JAX.


@pytest.mark.deep
def test_vmap_of_gradients_equals_a_loop():
    many = jnp.stack([jnp.asarray(terrain(seed), np.float32) for seed in range(3)])
    target = jnp.asarray(np.random.default_rng(2).uniform(size=(HEIGHT, WIDTH, 3)), np.float32)

    def loss(heights):
        return jnp.sum((jaxhf.render(scene(heights=terrain()).with_heights(heights), PLAIN) - target) ** 2)

    value_and_grad = jax.jit(jax.value_and_grad(loss))
    values, gradients = jax.jit(jax.vmap(jax.value_and_grad(loss)))(many)
    for heights, value, gradient in zip(many, values, gradients, strict=True):
        alone, alone_gradient = value_and_grad(heights)
        np.testing.assert_allclose(value, alone, rtol=ROUNDING)
        np.testing.assert_allclose(gradient, alone_gradient, atol=1e-4 * np.abs(alone_gradient).max())
    assert np.ptp(values) > 1e-3


def test_with_heights_compiles_nothing(compilations):
    first = scene()
    rendered()
    jaxhf.render(first.with_heights(terrain(3)), aovs=jaxhf.AOVS)  # small things outside the renderer, once
    compilations.clear()
    image, _ = jaxhf.render(first.with_heights(terrain(4)), aovs=jaxhf.AOVS)
    assert not compilations
    jax.jit(lambda x: x + 1)(1.5)
    assert compilations  # this is how a compilation is seen
    assert np.abs(np.asarray(image) - rendered()[0]).max() > 0.1


def test_with_heights_keeps_shape_and_precision():
    with pytest.raises(ValueError, match=r"heights must keep their shape \(9, 9\), theirs is \(9, 8\)"):
        scene().with_heights(np.zeros((9, 8)))
    assert scene().with_heights(terrain()).heights.dtype == np.float32
