"""Our own tints and their shading by value: sea below land, and the most that light and shade can do."""

import math

import numpy as np

import jaxhf


def test_sea_pales_towards_the_shore_and_land_is_not_blue():
    heights = np.linspace(-3, 2, 400) + np.zeros((2, 1))
    red, green, blue = np.moveaxis(jaxhf.color_relief(heights).astype(int)[0], -1, 0)
    sea = heights[0] < 0
    assert (np.diff((red + green + blue)[sea]) >= 0).all()
    assert (blue[sea] > green[sea]).all()
    assert (blue[~sea] < green[~sea]).all()


def test_light_adds_a_quarter_of_white_and_shade_leaves_a_third():
    """Planes that the light meets at a right angle, and from behind: hillshades of 255 and of 1."""
    x = np.arange(40.0) + np.zeros((3, 1))
    for towards, shade in ((1, 255), (-1, 1)):
        heights = towards * math.tan(math.radians(65)) * x
        tint = jaxhf.color_relief(heights).astype(float)
        level = 1 + 254 * math.sin(math.radians(25))  # of level ground
        expected = tint + (255 - tint) / 4 if shade == 255 else tint * (1 + 2 / level) / 3
        found = jaxhf.relief(heights, 1.0, azimuth=270.0, altitude=25.0)
        if shade == 255:
            np.testing.assert_array_equal(found[:, 1:-1], np.floor(expected + 0.5)[:, 1:-1])
        else:  # hillshades are whole numbers: that of level ground is off by a 200th, and a third by 0.6 of a grey level
            assert (np.abs(found - expected)[:, 1:-1] < 1.1).all()
        assert len(np.unique(tint)) > 60
