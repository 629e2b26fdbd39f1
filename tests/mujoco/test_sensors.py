"""Depth images and lidars against MuJoCo's rays."""

import numpy as np
import pytest
from hfields import SIZE, Reference, heights, mujoco

from jaxhf.core.errors import ArgumentError
from jaxhf.mujoco import HField, depth_image, lidar, lidar_pattern

GROUND = heights(9, 6, 1)
FIELD = HField(GROUND.astype(np.float64), SIZE)
REFERENCE = Reference(GROUND, SIZE)
POS, QUAT = np.array([0.4, -0.3, 1.2]), np.array([0.8, 0.5, 0.1, -0.3])


def turn() -> np.ndarray:
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, QUAT / np.linalg.norm(QUAT))
    return matrix.reshape(3, 3)


def test_depth_image_sees_what_rays_meet():
    """70 x 40 pixels: as many rays as in the tests of rays, and the same program."""
    depth, dist = (np.asarray(value) for value in depth_image(FIELD, POS, QUAT, 70, 40, fovy=80.0))
    assert depth.shape == dist.shape == (40, 70)
    f = 20 / np.tan(np.radians(40))
    for row, column in ((0, 0), (39, 69), (20, 35), (30, 3), (38, 60)):
        ray = turn() @ [(column + 0.5 - 35) / f, (20 - row - 0.5) / f, -1]
        t = REFERENCE(POS[None], ray[None])[0][0]
        np.testing.assert_allclose(depth[row, column], t, atol=1e-10)
        np.testing.assert_allclose(dist[row, column], t * np.linalg.norm(ray) if t >= 0 else -1, atol=1e-10)
    assert 0.2 < (depth < 0).mean() < 0.8
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


def test_sensors_say_what_is_wrong():
    for call, message in (
        (
            lambda: depth_image(FIELD, POS, QUAT, 0, 40),
            "depth_image: width must be a whole number of pixels from 1 on",
        ),
        (lambda: depth_image(FIELD, POS, QUAT, 70, -4), "depth_image: height must be a whole number of pixels from 1 on"),
        (lambda: depth_image(FIELD, FIELD, FIELD, 70, 40), "depth_image: pos must be numbers, it is a HField"),
        (lambda: lidar(FIELD, POS, "up"), "lidar: quat must be numbers, it is a str"),
        (lambda: lidar_pattern(0), "lidar_pattern: channels must be a whole number from 1 on, it is 0"),
        (lambda: lidar_pattern(resolution=0.0), "lidar_pattern: resolution must be positive and finite, it is 0.0"),
        (lambda: lidar_pattern(vertical_fov=(0.0, np.nan)), "lidar_pattern: vertical_fov must be finite"),
        (lambda: lidar_pattern(horizontal_fov=(10.0, -10.0)), "lidar_pattern: horizontal_fov must rise from the first"),
    ):
        with pytest.raises(ArgumentError, match=f"^{message}"):
            call()


def test_lidar_meets_what_rays_meet():
    pattern = lidar_pattern(7, (-60.0, 0.0), resolution=0.9)
    assert pattern.shape == (2800, 3)
    np.testing.assert_allclose(pattern[[0, -400]], [[-0.5, 0, -np.sqrt(0.75)], [-1, 0, 0]], atol=1e-12)
    scan = lidar(FIELD, POS, QUAT, pattern)
    some = np.arange(0, 2800, 41)
    t, n = REFERENCE(np.tile(POS, (len(some), 1)), pattern[some] @ turn().T)
    np.testing.assert_allclose(scan.dist[some], t, atol=1e-10)
    np.testing.assert_allclose(scan.n[some], n, atol=1e-9)
    assert 0.1 < (t < 0).mean() < 0.9
    assert lidar_pattern(2, (-10.0, 10.0), (-45.0, 45.0), 30.0).shape == (8, 3)
