"""Cameras hundreds of kilometres away, in single precision: against the oracle's hits of rays that begin at the eye."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import oracle
import pytest

import jaxhf
from jaxhf.fitting.model.unknowns import View, moved
from jaxhf.preparation.localise import localise
from jaxhf.rendering.cast import cast_camera

CELL, CELLS, AWAY = 0.5, 64, 7e5
HEIGHTS = np.random.default_rng(0).standard_normal((CELLS + 1, CELLS + 1)).cumsum(0).cumsum(1).astype(np.float32) / 40
CORNER = np.array([5e5, 4e6, 0])
TOWARDS = np.array([0.35, -0.3, 0.89])  # from the terrain, so that few points hide another
KINDS = (jaxhf.Perspective, jaxhf.Orthographic)
Y, X = (values.ravel() for values in np.mgrid[0.5:32, 0.5:32])


def camera(kind, away=AWAY):
    middle = CORNER + np.array([16, 16, 0])
    lens = 24.0 if kind is jaxhf.Orthographic else float(np.degrees(2 * np.arctan(12 / away)))
    return kind.look_at(middle + away * TOWARDS, middle, (0, 0, 1), lens, width=32, height=32)


def scene(kind, heights, *others, away=AWAY):
    field = jaxhf.Heightfield(heights, CELL, CELL, *CORNER[:2])
    return jaxhf.Scene([jaxhf.Object(field), *others], camera(kind, away), [jaxhf.Directional((1, 1, 2))])


def by_hand(kind, away=AWAY, heights=HEIGHTS) -> tuple[oracle.OracleHit, np.ndarray, np.ndarray]:
    """The oracle's hits of the camera's rays, their unit directions, and which of them meet the ground."""
    seen = camera(kind, away)
    right, up, ahead, eye = np.asarray(seen.world_from_camera, np.float64)[:3].T
    half = float(seen.extent) / 2 if isinstance(seen, jaxhf.Orthographic) else np.tan(np.radians(float(seen.fov)) / 2)
    aside = half * ((X / 16 - 1)[:, None] * right + (1 - Y / 16)[:, None] * up)
    o, d = (eye + aside, ahead + 0 * aside) if kind is jaxhf.Orthographic else (eye + 0 * aside, ahead + aside)
    d /= np.linalg.norm(d, axis=1)[:, None]
    hit = oracle.cast(heights.astype(np.float64), CELL, CELL, float(CORNER[0]), float(CORNER[1]), o, d)
    return hit, d, hit.status == oracle.HIT


@pytest.mark.parametrize(("away", "tall"), [(7e3, None), (AWAY, None), (4e7, None), (AWAY, 1e5)])
@pytest.mark.parametrize("kind", KINDS)
def test_hits_are_where_the_oracle_has_them(kind, away, tall):
    """To a thousandth of a cell; from 700 km they were 0.06 off in the middle, 3 at most. A tower, too."""
    heights = HEIGHTS.copy()
    heights[20:24, 30:36] = heights[20:24, 30:36] if tall is None else tall
    expected, _, met = by_hand(kind, away, heights)
    found = cast_camera(scene(kind, heights, away=away), X, Y)
    assert met.mean() > 0.9
    np.testing.assert_array_equal(found.status, expected.status)
    atol = 1e-3 + 1.2e-7 * (tall or 0) / CELL  # heights are rounded relative to the highest
    np.testing.assert_allclose((np.asarray(found.uv) * CELLS)[met], (expected.place.uv * CELLS)[met], atol=atol)
    np.testing.assert_allclose(found.t, expected.t, rtol=3e-7)


@pytest.mark.deep
@pytest.mark.parametrize("kind", [KINDS[0], pytest.param(KINDS[1], marks=pytest.mark.deep)])
def test_depth_and_its_derivative_where_heights_are_traced(kind):
    """By hand: a vertex that rises by dz lifts the plane of a triangle by w dz, its weight at the hit."""
    made = scene(kind, HEIGHTS)

    @jax.jit
    def depths(z):
        def total(z):
            depth = jaxhf.render(made.with_heights(z).with_lights(()), aovs=("depth",))[1]["depth"]
            depth = jnp.where(jnp.isfinite(depth), depth - AWAY, 0)
            return depth.sum(), depth

        return jax.value_and_grad(total, has_aux=True)(z)

    (_, found), slopes = depths(HEIGHTS)
    hit, d, met = by_hand(kind)
    np.testing.assert_allclose(found.ravel(), np.where(met, hit.t - AWAY, 0), atol=0.2)  # three steps at 7e5
    (u, v), (ix, iy), upper = (hit.place.uv * CELLS - hit.place.cell).T, hit.place.cell.T, hit.place.triangle
    rate = np.where(met, hit.place.n[:, 2] / (d * hit.place.n).sum(1), 0)
    expected = np.zeros(HEIGHTS.shape)
    for row, column, weight in ((0, 0, 1 - np.maximum(u, v)), (1, 1, np.minimum(u, v)), (upper, 1 - upper, np.abs(u - v))):
        np.add.at(expected, (iy + row, ix + column), weight * rate)
    np.testing.assert_allclose(slopes, expected, atol=1e-3)
    assert np.abs(expected).sum() > 500  # each of the hits moves by about 1


@pytest.mark.deep
@pytest.mark.x64  # as its truth is `cast` in double precision
@pytest.mark.parametrize(
    ("kind", "tall"), [pytest.param(KINDS[0], 30.0, marks=pytest.mark.slow), (KINDS[0], 3e6), (KINDS[1], 1e5)]
)
def test_nothing_is_lost_in_front_of_the_ground(kind, tall):
    """Peaks that reach towards the camera, and beyond it; walls; a second terrain on the way, which is turned and larger."""
    heights = HEIGHTS.astype(np.float64)
    heights[20:24, 30:36] = tall
    world = np.diag([3.0, 3.0, 2.0, 1.0])
    world[:3, 3] = CORNER + 16 + 4e3 * TOWARDS
    second = jaxhf.Object(jaxhf.Heightfield(HEIGHTS[:9, :9], CELL), None, world)
    skirt = jaxhf.Object(jaxhf.Skirt.of(jaxhf.Heightfield(heights, CELL, CELL, *CORNER[:2]), -200.0))
    made = scene(kind, heights, second, skirt)
    rays, found = jax.vmap(made.camera.ray)(X, Y), jax.jit(lambda z: cast_camera(made.with_heights(z), X, Y))(heights)
    expected = jaxhf.cast(made, np.asarray(rays.o), np.asarray(rays.d))
    for name in ("status", "object", "cell"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name), name)
    assert len(np.unique(found.object)) > 1
    np.testing.assert_allclose(found.t, expected.t, rtol=1e-9)


@pytest.mark.parametrize("kind", KINDS)
def test_points_are_projected_to_where_they_are_seen(kind):
    local = localise(scene(kind, HEIGHTS)).camera
    hit, _, met = by_hand(kind)
    points = jnp.asarray((hit.place.p - CORNER)[met], jnp.float32)
    x, y, w, depth = np.asarray(jax.vmap(local.film_from_world())(points)).T
    np.testing.assert_allclose(np.stack([x / w, y / w]), [X[met], Y[met]], atol=1e-3)
    np.testing.assert_allclose(depth, AWAY * np.linalg.norm(TOWARDS), rtol=1e-4)
    eye, at_place = camera(kind).viewpoint()
    np.testing.assert_allclose(local.viewpoint()[0], np.asarray(eye) - at_place * CORNER, rtol=1e-6)


@pytest.mark.deep
@pytest.mark.x64  # to see motions of 1e-6 rad
def test_a_fit_turns_a_far_camera_about_its_eye():
    """As it turns one whose rays begin there."""
    local = localise(scene(jaxhf.Perspective, HEIGHTS.astype(np.float64))).camera
    pose = np.array(camera(jaxhf.Perspective).world_from_camera)
    pose[:3, 3] -= CORNER
    assert isinstance(local, jaxhf.Perspective)
    assert local._ahead is not None
    plain = jaxhf.Perspective(pose, local.fov, width=32, height=32)
    view, point = View(camera=jnp.array([3.0, -2.0, 5.0, 1e-6, 2e-6, -1e-6])), jnp.array([16.0, 20.0, 1.0])

    def seen(given):
        x, y, w, _ = moved((), given, view)[1].film_from_world()(point)
        return x / w, y / w

    np.testing.assert_allclose(seen(local), seen(plain), atol=1e-4)


def test_other_cameras_stay_as_they_are():
    """Near ones, and those whose numbers are JAX's, which a derivative may be taken in."""
    near = scene(jaxhf.Perspective, HEIGHTS, away=100.0)
    assert localise(near).camera._ahead is None
    far = scene(jaxhf.Perspective, HEIGHTS)
    traced = dataclasses.replace(far.camera, world_from_camera=jnp.asarray(far.camera.world_from_camera, jnp.float32))
    assert localise(far).camera._ahead is not None
    assert localise(far.with_camera(traced)).camera._ahead is None
    assert far.camera._ahead is None
