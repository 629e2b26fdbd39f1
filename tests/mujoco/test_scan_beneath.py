"""Scans whose rays start beneath the surface: within the solid they meet its bottom from inside, below it nothing."""

import numpy as np

from jaxhf.mujoco import HField, height_scan

SIZE = (3.0, 2.0, 1.5, 0.5)  # half of the extent along x and y, height at data 1, depth of the base


def test_rays_from_within_the_base_meet_its_bottom():
    data = np.random.default_rng(4).uniform(0.2, 1, (5, 7)).astype(np.float32)
    above_bottom = np.array([0.125, 0.375, -0.125])
    pos = np.zeros((3, 3), np.float32)
    pos[:, 2] = -SIZE[3] + above_bottom - 20  # a scan's rays start 20 above
    quat = np.tile(np.array([1, 0, 0, 0], np.float32), (3, 1))
    scan = height_scan(HField(data, SIZE), pos, quat, np.array([[0.3, -0.7], [-1.1, 0.9]], np.float32))
    np.testing.assert_array_equal(scan.mask, [[True] * 2] * 2 + [[False] * 2])
    # One unit in the last place of 20 in single precision, where the start is computed.
    np.testing.assert_allclose(scan.dist, [[0.125] * 2, [0.375] * 2, [-1] * 2], atol=2.0**-19)
    np.testing.assert_array_equal(scan.n[:2], np.broadcast_to([0, 0, -1], (2, 2, 3)))
