"""Cameras that have all of a terrain in their picture, and textures with a colour for each vertex."""

import math

import jax.numpy as jnp
import numpy as np
import pytest

import jaxhf

RNG = np.random.default_rng(3)
HEIGHTS = RNG.uniform(0, 3, (7, 12))
HEIGHTS[2, 3] = np.nan
FIELD = jaxhf.Heightfield(HEIGHTS.astype(np.float32), 2.0, 1.0, 100.0, -50.0)


@pytest.mark.parametrize(
    ("azimuth", "altitude", "fov", "width", "height", "base"),
    [(135.0, 30.0, 30.0, 512, 512, None), (20.0, 60.0, 50.0, 640, 360, -4.0), (300.0, 5.0, 80.0, 300, 500, -1.0),
     (0.0, 90.0, 20.0, 64, 64, None), (77.0, -20.0, 40.0, 400, 300, None)],
)  # fmt: skip
def test_a_framing_camera_sees_all_of_a_terrain(azimuth, altitude, fov, width, height, base):
    camera = jaxhf.Perspective.framing(FIELD, azimuth, altitude, fov, width=width, height=height, margin=0.1, base=base)
    y, x = np.mgrid[: HEIGHTS.shape[0], : HEIGHTS.shape[1]]
    points = np.stack([100 + 2 * x, -50 + y, HEIGHTS], -1).reshape(-1, 3)
    points = points[np.isfinite(points).all(1)]
    if base is not None:
        points = np.concatenate([points, [(px, py, base) for px in (100, 122) for py in (-50, -44)]])
    film = camera.film_from_world()
    x, y, w, depth = np.asarray(film.linear, float) @ points.T + np.asarray(film.offset, float)[:, None]
    share = np.stack([np.abs(2 * x / w / width - 1), np.abs(2 * y / w / height - 1)])
    assert (depth > 0).all()
    assert share.max() == pytest.approx(0.9, abs=2e-3)  # the nearest one: something touches the margin
    for values, size in ((x / w, width), (y / w, height)):  # and all of it stands in the middle
        assert values.min() + values.max() == pytest.approx(size, abs=0.01 * size)
    eye, forward = np.asarray(camera.world_from_camera)[:3, 3], np.asarray(camera.world_from_camera)[:3, 2]
    assert math.degrees(math.asin(-forward[2])) == pytest.approx(altitude)
    if altitude < 90:
        assert math.degrees(math.atan2(-forward[0], -forward[1])) % 360 == pytest.approx(azimuth)
    looking = jaxhf.Perspective.look_at(eye, eye + forward, up=(0, 0, 1) if altitude < 90 else (0, 1, 0))
    if altitude < 90:
        np.testing.assert_allclose(camera.world_from_camera, looking.world_from_camera, atol=1e-9)


def test_large_terrain_is_seen_by_its_blocks(monkeypatch):
    """A little farther away than by its vertices, never nearer."""
    heights = np.cumsum(np.random.default_rng(5).normal(size=(61, 83)), axis=1)
    heights[10:14, 20:24] = np.nan
    field = jaxhf.Heightfield(heights.astype(np.float32), 1.0)
    near = np.asarray(jaxhf.Perspective.framing(field, 200.0, 40.0).world_from_camera)
    monkeypatch.setattr("jaxhf.scene.framing._MOST", 30)
    camera = jaxhf.Perspective.framing(field, 200.0, 40.0)
    far = np.asarray(camera.world_from_camera)
    assert 0 < np.dot(near[:3, 3] - far[:3, 3], far[:3, 2]) < 0.05 * 61
    y, x = np.mgrid[:61, :83]
    points = np.stack([x, y, heights], -1)[np.isfinite(heights)]
    film = camera.film_from_world()
    seen = np.asarray(film.linear, float) @ points.T + np.asarray(film.offset, float)[:, None]
    assert max(np.abs(2 * seen[k] / seen[2] / 512 - 1).max() for k in (0, 1)) < 0.95


def test_a_camera_that_goes_round_keeps_its_distance():
    x, y = np.meshgrid(100 + 2.0 * np.arange(12), -50 + 1.0 * np.arange(7))
    points = np.stack([x, y, HEIGHTS], -1).reshape(-1, 3)
    points = points[np.isfinite(points).all(1)]
    middle = (points.min(0) + points.max(0)) / 2
    distances, farthest = [], []
    for azimuth in range(0, 360, 15):
        camera = jaxhf.Perspective.framing(FIELD, float(azimuth), 25.0, width=300, height=200, margin=0.0, around=True)
        film = camera.film_from_world()
        seen = np.asarray(film.linear, float) @ points.T + np.asarray(film.offset, float)[:, None]
        farthest.append(max(np.abs(2 * seen[0] / seen[2] / 300 - 1).max(), np.abs(2 * seen[1] / seen[2] / 200 - 1).max()))
        distances.append(np.linalg.norm(np.asarray(camera.world_from_camera)[:3, 3] - middle))
    np.testing.assert_allclose(distances, distances[0], rtol=1e-3)
    assert 0.8 < max(farthest) <= 1


@pytest.mark.parametrize(
    ("options", "said"),
    [({"altitude": 91.0}, "altitude must be from -90 to 90"), ({"fov": 0.0}, "fov must be"),
     ({"margin": 1.0}, "margin must be"), ({"azimuth": math.inf}, "azimuth must be finite")],
)  # fmt: skip
def test_a_view_that_cannot_be_is_refused(options: dict, said: str):
    with pytest.raises(jaxhf.ArgumentError, match=said):
        jaxhf.Perspective.framing(FIELD, **options)


def test_a_terrain_without_heights_has_no_view():
    with pytest.raises(jaxhf.ArgumentError, match="must have a height"):
        jaxhf.Perspective.framing(jaxhf.Heightfield(np.full((3, 3), np.nan, np.float32)))


def test_a_texture_at_vertices_gives_each_its_colour():
    texels = RNG.uniform(size=(4, 6, 3))
    texture = jaxhf.ImageTexture(texels, at_vertices=True)
    for iy, ix in np.ndindex(4, 6):
        np.testing.assert_allclose(texture(jnp.array([ix / 5, iy / 3])), texels[iy, ix], atol=1e-6)
    between = texture(jnp.array([1.5 / 5, 0.0]))
    np.testing.assert_allclose(between, (texels[0, 1] + texels[0, 2]) / 2, atol=1e-6)


def test_bytes_are_no_texture():
    with pytest.raises(jaxhf.ArgumentError, match="must hold linear colours in floats, 1 being white; theirs are uint8"):
        jaxhf.ImageTexture(np.zeros((2, 2, 3), np.uint8))
