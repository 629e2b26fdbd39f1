"""Projections of points in another frame, and which vertices a framing camera looks at."""

import jax.numpy as jnp
import numpy as np
import pytest

import jaxhf
from jaxhf.core.affine import Affine

CAMERAS = [
    jaxhf.Perspective.look_at((5.0, -7.0, 4.0), (1.0, 2.0, 0.5), fov=40.0, width=64, height=48),
    jaxhf.Orthographic.look_at((5.0, -7.0, 4.0), (1.0, 2.0, 0.5), extent=9.0, width=64, height=48),
]


@pytest.mark.parametrize("camera", CAMERAS)
def test_points_of_another_frame_are_seen_where_the_world_has_them(camera):
    linear = np.array([[2.0, 0.5, 0.25], [-0.75, 1.5, 0.0], [0.25, -0.5, 3.0]], np.float32)
    world = Affine(jnp.asarray(linear), jnp.array([0.5, -1.0, 2.0], jnp.float32))
    p = np.array([0.7, -1.3, 0.4], np.float32)
    film = camera.film_from_world()
    moved = linear.astype(float) @ p.astype(float) + [0.5, -1.0, 2.0]
    expected = np.asarray(film.linear, float) @ moved + np.asarray(film.offset, float)
    largest = np.abs(film.linear) @ (np.abs(linear) @ np.abs(p) + [0.5, 1.0, 2.0]) + np.abs(film.offset)
    # Each sum of a few products in single precision is off by less than 8 roundings of its terms.
    assert (np.abs(film.of(world)(jnp.asarray(p)) - expected) < 8 * 2.0**-24 * largest).all()


def test_ground_at_zero_is_framed_and_infinite_holes_are_not():
    heights = np.random.default_rng(2).uniform(1, 2, (5, 6)).astype(np.float32)
    heights[0, 0] = heights[-1, -1] = 0
    holes = heights.copy()
    holes[2, 2] = np.inf
    poses = [
        np.asarray(jaxhf.Perspective.framing(jaxhf.Heightfield(z, 1.0), 40.0, 35.0).world_from_camera, float)
        for z in (heights, holes, heights + 1)
    ]
    np.testing.assert_allclose(poses[1], poses[0], atol=1e-5)
    poses[2][2, 3] -= 1
    np.testing.assert_allclose(poses[2], poses[0], atol=1e-5)  # a metre higher, all of it, is seen from a metre higher
