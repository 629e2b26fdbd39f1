"""Depth images and lidars against MuJoCo's rays."""

from typing import cast

import numpy as np
import pytest
from hfields import SIZE, Reference, heights, matrix

from jaxhf.core.errors import ArgumentError
from jaxhf.mujoco import HField, depth_image, lidar, lidar_pattern

FIELD = HField(heights(9, 6, 1), SIZE)
POS, QUAT = np.array([0.4, -0.3, 1.2]), np.array([0.8, 0.5, 0.1, -0.3])


def sensors(count):
    """Two height fields apart from each other, each with sensors above it that look down and aside, and MuJoCo's of them."""
    random, places = np.random.default_rng(3), np.array([[0.0, 0, 0], [7, -3, 0.4]])
    grounds = np.stack([heights(9, 6, seed) for seed in (1, 2)])
    pos = places[:, None] + random.uniform([-2, -3, 1.2], [2, 3, 2], (2, count, 3))
    quat = random.normal(size=(2, count, 4)) * [1, 0.4, 0.4, 1]
    references = [
        Reference(ground, SIZE, f'pos="{" ".join(map(str, place))}"') for ground, place in zip(grounds, places, strict=True)
    ]
    return HField(grounds, SIZE, places), pos, quat, references


def some(pos, quat, references, pattern):
    """Which field and sensor, its directions, and what MuJoCo says of the rays."""
    assert pattern.shape == (175, 3)
    for k, sensor in ((0, 0), (0, 15), (1, 0), (1, 7)):
        d = pattern @ matrix(quat[k, sensor]).T
        yield (k, sensor), d, *references[k](np.tile(pos[k, sensor], (175, 1)), d)


def test_batched_lidars_meet_what_rays_meet():
    fields, pos, quat, references = sensors(16)
    pattern = lidar_pattern(7, (-60.0, 0.0), (-180.0, 180.0), 14.4)
    np.testing.assert_allclose(pattern[[0, -25]], [[-0.5, 0, -np.sqrt(0.75)], [-1, 0, 0]], atol=1e-12)
    assert lidar_pattern(2, (-10.0, 10.0), (-45.0, 45.0), 30.0).shape == (8, 3)
    scan = lidar(fields, pos, quat, pattern)
    assert 0.2 < np.mean(scan.mask) < 0.8
    for at, d, t, n in some(pos, quat, references, pattern):
        np.testing.assert_array_equal(scan.mask[at], t >= 0)
        np.testing.assert_allclose(scan.dist[at], t, rtol=1e-5, atol=1e-5)
        np.testing.assert_allclose(scan.n[at], n, atol=1e-4)
        np.testing.assert_allclose(scan.p[at], pos[at] + np.maximum(t, 0)[:, None] * d, atol=1e-4)


def test_batched_pictures_with_an_axis_off_their_middle_meet_what_rays_meet():
    fields, pos, quat, references = sensors(16)
    fx, fy, cx, cy = 20.0, 9.0, 3.0, 5.5  # of 25 x 7 pixels, whose middle is 12.5, 3.5
    x, y = np.meshgrid((np.arange(25) + 0.5 - cx) / fx, (cy - np.arange(7) - 0.5) / fy)
    found = depth_image(fields, pos, quat, 25, 7, intrinsics=(fx, fy, cx, cy))
    assert found[0].shape == found[1].shape == (2, 16, 7, 25)
    depth, dist = (np.asarray(value).reshape(2, 16, 175) for value in found)
    assert 0.2 < np.mean(depth >= 0) < 0.8
    for at, d, t, _ in some(pos, quat, references, np.stack([x, y, -np.ones_like(x)], -1).reshape(-1, 3)):
        np.testing.assert_allclose(depth[at], t, rtol=1e-5, atol=1e-5)
        np.testing.assert_allclose(dist[at], np.where(t < 0, -1, t * np.linalg.norm(d, axis=1)), rtol=1e-5, atol=1e-5)


def test_an_angle_of_view_is_one_of_the_intrinsics():
    depth, dist = (np.asarray(value) for value in depth_image(FIELD, POS, QUAT, 70, 40, fovy=80.0))
    assert depth.shape == dist.shape == (40, 70)
    assert 0.2 < (depth < 0).mean() < 0.8
    f = 20 / np.tan(np.radians(40))
    same = depth_image(FIELD, POS, QUAT, 70, 40, intrinsics=(f, f, 35, 20))
    np.testing.assert_array_equal(same, (depth, dist))
    matrix = np.array([[f, 0, 35], [0, f, 20], [0, 0, 1]])
    np.testing.assert_array_equal(depth_image(FIELD, POS, QUAT, 70, 40, intrinsics=matrix), (depth, dist))
    with pytest.raises(ValueError, match="fovy must lie between"):
        depth_image(FIELD, POS, QUAT, 70, 40, fovy=180.0)


@pytest.mark.parametrize(
    ("intrinsics", "message"),
    [
        ((50, 50, 35), r"must be fx, fy, cx and cy, or a matrix of 3 x 3, the shape is \(3,\)"),
        ((0, 50, 35, 20), "must have positive focal lengths, fx is 0 and fy 50"),
        ((50, -50, 35, 20), "must have positive focal lengths, fx is 50 and fy -50"),
        ((50, 50, np.nan, 20), r"must be finite, it is \[50"),
        ([[50, 1, 35], [0, 50, 20], [0, 0, 1]], r"must be \[\[fx, 0, cx\], .* as a matrix, it is \[\[50.0, 1.0"),
        ("K", "must be numbers, it is a str"),
    ],
)
def test_intrinsics_are_those_of_a_pinhole(intrinsics, message):
    with pytest.raises(ArgumentError, match=f"^depth_image: intrinsics {message}"):
        depth_image(FIELD, POS, QUAT, 70, 40, intrinsics=intrinsics)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: depth_image(FIELD, POS, QUAT, 0, 40), "depth_image: width must be a whole number of pixels from 1 on"),
        (lambda: depth_image(FIELD, POS, QUAT, 70, -4), "depth_image: height must be a whole number of pixels from 1 on"),
        (lambda: depth_image(FIELD, FIELD, FIELD, 70, 40), "depth_image: pos must be numbers, it is a HField"),
        (lambda: lidar(cast("HField", POS), POS, QUAT), "lidar: geoms must be a jaxhf.mujoco.HField or Geoms, it is"),
        (lambda: lidar(FIELD, POS, "up"), "lidar: quat must be numbers, it is a str"),
        (lambda: lidar_pattern(0), "lidar_pattern: channels must be a whole number from 1 on, it is 0"),
        (lambda: lidar_pattern(resolution=0.0), "lidar_pattern: resolution must be positive and finite, it is 0.0"),
        (lambda: lidar_pattern(vertical_fov=(0.0, np.nan)), "lidar_pattern: vertical_fov must be finite"),
        (lambda: lidar_pattern(horizontal_fov=(10.0, -10.0)), "lidar_pattern: horizontal_fov must rise from the first"),
    ],
)
def test_sensors_say_what_is_wrong(call, message, as_users_call_it):
    with pytest.raises(ArgumentError, match=f"^{message}"):
        call()
