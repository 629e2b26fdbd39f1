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


def points_of(heights, x0=0.0, y0=0.0, dx=1.0, dy=1.0):
    y, x = np.mgrid[: heights.shape[0], : heights.shape[1]]
    points = np.stack([x0 + dx * x, y0 + dy * y, heights], -1)
    return points[np.isfinite(heights)]


def seen_by(camera, points):
    """x, y and depth of points in the picture, in pixels."""
    film = camera.film_from_world()
    x, y, w, depth = np.asarray(film.linear, float) @ points.T + np.asarray(film.offset, float)[:, None]
    return x / w, y / w, depth


def farthest(camera, points):
    """How near to the picture's border the outermost point is: 1 at the border, 0 in its middle."""
    x, y, _ = seen_by(camera, points)
    return max(np.abs(2 * x / camera.width - 1).max(), np.abs(2 * y / camera.height - 1).max())


HERE = points_of(HEIGHTS, 100, -50, 2)


@pytest.mark.parametrize(
    ("azimuth", "altitude", "fov", "width", "height", "base"),
    [(135.0, 30.0, 30.0, 512, 512, None), (20.0, 60.0, 50.0, 640, 360, -4.0), (300.0, 5.0, 80.0, 300, 500, -1.0),
     (0.0, 90.0, 20.0, 64, 64, None), (77.0, -20.0, 40.0, 400, 300, None)],
)  # fmt: skip
def test_a_framing_camera_sees_all_of_a_terrain(azimuth, altitude, fov, width, height, base):
    camera = jaxhf.Perspective.framing(FIELD, azimuth, altitude, fov, width=width, height=height, margin=0.1, base=base)
    corners = [(px, py, base) for px in (100, 122) for py in (-50, -44)] if base is not None else []
    points = np.concatenate([HERE, np.reshape(corners, (-1, 3))])
    x, y, depth = seen_by(camera, points)
    assert (depth > 0).all()
    assert farthest(camera, points) == pytest.approx(0.9, abs=2e-3)  # the nearest one: something touches the margin
    for values, size in ((x, width), (y, height)):  # and all of it stands in the middle
        assert values.min() + values.max() == pytest.approx(size, abs=0.01 * size)
    eye, forward = np.asarray(camera.world_from_camera)[:3, 3], np.asarray(camera.world_from_camera)[:3, 2]
    assert math.degrees(math.asin(-forward[2])) == pytest.approx(altitude)
    if altitude < 90:
        looking = jaxhf.Perspective.look_at(eye, eye + forward)
        np.testing.assert_allclose(camera.world_from_camera, looking.world_from_camera, atol=1e-9)
        assert math.degrees(math.atan2(-forward[0], -forward[1])) % 360 == pytest.approx(azimuth)


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
    assert farthest(camera, points_of(heights)) < 0.95


def test_a_camera_that_goes_round_keeps_its_distance():
    middle = (HERE.min(0) + HERE.max(0)) / 2
    cameras = [
        jaxhf.Perspective.framing(FIELD, float(azimuth), 25.0, width=300, height=200, margin=0.0, around=True)
        for azimuth in range(0, 360, 15)
    ]
    distances = [np.linalg.norm(np.asarray(camera.world_from_camera)[:3, 3] - middle) for camera in cameras]
    np.testing.assert_allclose(distances, distances[0], rtol=1e-3)
    assert 0.8 < max(farthest(camera, HERE) for camera in cameras) <= 1


@pytest.mark.parametrize(
    ("options", "said"),
    [({"altitude": 91.0}, "altitude must be from -90 to 90"), ({"fov": 0.0}, "fov must be"),
     ({"margin": 1.0}, "margin must be"), ({"azimuth": math.inf}, "azimuth must be finite"),
     ({"field": jaxhf.Heightfield(np.full((3, 3), np.nan, np.float32))}, "must have a height")],
)  # fmt: skip
def test_a_view_that_cannot_be_is_refused(options: dict, said: str):
    with pytest.raises(jaxhf.ArgumentError, match=said):
        jaxhf.Perspective.framing(**{"field": FIELD, **options})


def test_a_texture_at_vertices_gives_each_its_colour():
    texels = RNG.uniform(size=(4, 6, 3))
    texture = jaxhf.ImageTexture(texels, at_vertices=True)
    for iy, ix in np.ndindex(4, 6):
        np.testing.assert_allclose(texture(jnp.array([ix / 5, iy / 3])), texels[iy, ix], atol=1e-6)
    between = texture(jnp.array([1.5 / 5, 0.0]))
    np.testing.assert_allclose(between, (texels[0, 1] + texels[0, 2]) / 2, atol=1e-6)
