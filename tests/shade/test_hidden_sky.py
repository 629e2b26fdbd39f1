"""A sky that terrain hides, against many shadowed suns over the hemisphere, and its derivative against differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxhf

Y, X = np.mgrid[0:9, 0:12].astype(float)
RIDGES = 2 * np.abs(np.sin(0.9 * X + 0.3 * Y)) + 0.1 * Y  # walls of up to 60 degrees
TURNED = np.array([[0, -2, 0, 5], [2, 0, 0, -3], [0, 0, 3, 100], [0, 0, 0, 1.0]])


def scene(heights, lights, world=None):
    """Seen from above; the pixels' centres lie on the inner vertices."""
    camera = jaxhf.Orthographic.look_at((5.5, 4, 90), (5.5, 4, 0), (0, 1, 0), 7, width=10, height=7)
    if world is TURNED:  # the same picture of a scene that is turned, doubled, and higher
        camera = jaxhf.Orthographic.look_at((-3, 8, 400), (-3, 8, 0), (-1, 0, 0), 14, width=10, height=7)
    return jaxhf.Scene([jaxhf.Object(jaxhf.Heightfield(heights, 1.0), jaxhf.Matte(1.0), world)], camera, lights)


@pytest.mark.deep  # maps/test_skyview.py has its share of the sky against every crossing
def test_a_hidden_sky_is_that_of_many_suns():
    """In as many azimuths, each for its part of the hemisphere.

    Where the ground bends, suns light the triangles, the sky their vertices: at 64 cells to a wave they differ by 0.01.
    """
    y, x = np.mgrid[0:65, 0:65] * (2 * np.pi / 64)
    field = jaxhf.Heightfield(16 * np.sin(x) + 10 * np.sin(1.3 * y + x), 1.0)
    camera = jaxhf.Orthographic.look_at((32, 32, 90), (32, 32, 0), (0, 1, 0), 58, width=12, height=12)

    def picture(light):
        ground = jaxhf.Scene([jaxhf.Object(field, jaxhf.Matte(1.0))], camera, [light])
        return np.asarray(jaxhf.render(ground, jaxhf.Settings(chunk=256)))[..., 0]

    count, bands = 16, 16
    hidden, total = picture(jaxhf.Sky(1.0, occlusion=count)), 0
    for azimuth in np.arange(count) * 360 / count:
        for altitude in (np.arange(bands) + 0.5) * 90 / bands:
            solid_angle = 2 * np.pi / count * np.deg2rad(90 / bands) * np.cos(np.deg2rad(altitude))
            total += picture(jaxhf.Directional.from_angles(azimuth, altitude, solid_angle))
    assert np.mean(picture(jaxhf.Sky(1.0)) - hidden) > 0.12
    np.testing.assert_allclose(hidden, total, atol=0.02)
    assert abs(np.mean(hidden - total)) < 0.004


def test_an_object_may_be_turned_and_scaled_but_not_tilted():
    plain = jaxhf.render(scene(RIDGES, [jaxhf.Sky(1.0, occlusion=4)], np.diag([1, 1, 1.5, 1])))
    turned = jaxhf.render(scene(RIDGES, [jaxhf.Sky(1.0, occlusion=4)], TURNED))
    np.testing.assert_allclose(turned, plain, atol=1e-6)
    tilted = TURNED.copy()
    tilted[0, 2] = 0.1
    with pytest.raises(jaxhf.ArgumentError, match=r"Scene: objects\[0\].world_from_object must keep heights upright"):
        scene(RIDGES, [jaxhf.Sky(1.0, occlusion=4)], tilted)
    with pytest.raises(jaxhf.ArgumentError, match="Sky: occlusion must be a whole number from 1 on, it is 0"):
        jaxhf.Sky(1.0, occlusion=0)


@pytest.mark.deep
@pytest.mark.x64  # for differences of 1e-6
def test_its_derivative_is_that_of_differences():
    base = scene(jnp.asarray(RIDGES), [jaxhf.Sky(1.0, occlusion=4)])
    dz = np.random.default_rng(1).normal(size=RIDGES.shape)
    weights = np.random.default_rng(2).normal(size=(7, 10, 3))

    @jax.jit
    def value(z):
        return jax.value_and_grad(lambda z: jnp.sum(jaxhf.render(base.with_heights(z)) * weights))(z)

    eps = 1e-6
    numeric = (value(RIDGES + eps * dz)[0] - value(RIDGES - eps * dz)[0]) / (2 * eps)
    assert abs(numeric) > 1e-2
    np.testing.assert_allclose(np.sum(value(jnp.asarray(RIDGES))[1] * dz), numeric, rtol=1e-6)
