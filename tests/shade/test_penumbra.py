"""The sun as a disc: against many suns without a size, the area of a circular segment."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxhf

SIZE, DIAMETER, LOW = 24, 4.0, 12.0
TOWARDS = jaxhf.Directional.from_angles(270, LOW).towards
Y, X = np.mgrid[0:25, 0:33].astype(float)
PEAKS = 3 * np.exp(-((X - 8) ** 2 + (Y - 14) ** 2) / 6) + 2.5 * np.exp(-((X - 7) ** 2 + (Y - 6) ** 2) / 3)
KNIFE = np.where(X == 8, 3.0, 0.0)
SETTINGS = jaxhf.Settings(chunk=576)


def scene(heights, lights):
    """Seen from above where the shadows of a sun in the west end."""
    camera = jaxhf.Orthographic.look_at((21, 12, 90), (21, 12, 0), (0, 1, 0), 10, width=SIZE, height=SIZE)
    return jaxhf.Scene([jaxhf.Object(jaxhf.Heightfield(heights, 1.0), jaxhf.Matte(1.0))], camera, lights)


def spread(count):
    """Directions evenly over the sun's disc, on Vogel's spiral (Mathematical Biosciences 44, 1979)."""
    side = np.array([0, 1.0, 0])
    k = np.arange(count)
    off = np.sqrt((k + 0.5) / count) * np.deg2rad(DIAMETER) / 2
    turn = k * np.pi * (3 - np.sqrt(5))
    return TOWARDS + np.outer(off * np.cos(turn), side) + np.outer(off * np.sin(turn), np.cross(side, TOWARDS))


@jax.jit
def picture(heights, towards):
    sun = jaxhf.Sun(towards, 1.0, DIAMETER)
    return jaxhf.render(scene(heights, [sun]), SETTINGS)[..., 0]


@jax.jit
def mean_of_suns(heights, directions):
    def add(total, towards):
        return total + jaxhf.render(scene(heights, [jaxhf.Directional(towards, 1.0)]), SETTINGS)[..., 0], None

    return jax.lax.scan(add, jnp.zeros((SIZE, SIZE)), directions)[0] / len(directions)


def test_a_sun_is_the_mean_of_1024_suns():
    found, mean = np.asarray(picture(PEAKS, TOWARDS)), np.asarray(mean_of_suns(PEAKS, spread(1024)))
    share = mean / mean.max()  # of the sun that is seen, as all pixels lie in the plane
    penumbra = (share > 0.01) & (share < 0.99)
    assert penumbra.mean() > 0.1
    assert np.mean(np.abs(found - mean)[penumbra] / mean[penumbra]) < 0.01
    np.testing.assert_allclose(found, mean, atol=0.01 * mean.max())
    np.testing.assert_allclose(found[~penumbra], mean[~penumbra], atol=0.003 * mean.max())


def test_behind_a_straight_wall_the_sun_is_a_circular_segment():
    found = np.asarray(picture(KNIFE, TOWARDS))
    x = 16 + (np.arange(SIZE) + 0.5) * 10 / SIZE  # of the pixels' columns
    wall, middle, radius = np.arctan2(3.0, x - 8), np.deg2rad(LOW), np.deg2rad(DIAMETER) / 2
    h = np.clip((wall - middle) / radius, -1, 1)
    share = (np.arccos(h) - h * np.sqrt(1 - h * h)) / np.pi
    lifted = 2 / 3 * np.sqrt(1 - h * h) ** 3 / np.maximum(np.pi * share, 1e-9) * radius  # of the segment's centroid
    expected = share * np.sin(middle + lifted) / np.pi
    assert ((share > 0.05) & (share < 0.95)).sum() > 4
    np.testing.assert_allclose(found, np.broadcast_to(expected, found.shape), atol=0.006 * expected.max())


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: jaxhf.Sun((0, 0, 1), 1.0, 0.0), "Sun: angular_diameter must be above 0 and at most 10 degrees, it is 0.0"),
        (lambda: jaxhf.Sun((0, 0, 1), 1.0, [0.5, 0.6]), "Sun: angular_diameter must be one number"),
        (lambda: jaxhf.Sun((0, 0, 0)), "Sun: towards must not be zero"),
    ],
)
def test_what_is_refused(make, message):
    with pytest.raises(jaxhf.ArgumentError, match=message):
        make()
