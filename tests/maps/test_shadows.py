"""Cast shadows: a wall by hand, and every crossing of every ray."""

from typing import Any

import numpy as np
import pytest
from test_skyview import every_crossing

import jaxhf
from jaxhf.maps.shadows import lit

DIRECTIONS = [(0, 20), (45, 5), (60, 35), (90, 20), (135, 45), (200, 10), (225, 20), (270, 70), (301.7, 3), (315, 45)]


@pytest.mark.parametrize("kind", ["hills", "holes", pytest.param("noise", marks=pytest.mark.deep)])
@pytest.mark.parametrize("shape", [(13, 31), pytest.param((31, 13), marks=pytest.mark.deep)])
def test_shadows_are_those_of_every_crossing(kind, shape):
    """Lit is what has its horizon below the light. With abysses for holes horizons are at least what they are."""
    random = np.random.default_rng(5)
    y, x = np.mgrid[: shape[0], : shape[1]]
    z = random.uniform(0, 30, shape) if kind != "hills" else 15 * np.sin(y / 4) + 18 * np.cos(x / 5)
    if kind == "holes":
        z[random.uniform(size=shape) < 0.1] = np.nan
    seen = []
    for azimuth, altitude in DIRECTIONS:
        for dx, dy in ((1.0, 1.0), (3.0, 5.0)):
            found, abysses = lit(z, dx, dy, float(azimuth), float(altitude)), np.where(np.isnan(z), -1e3, z)
            least, most = (every_crossing(ground, azimuth, dx, dy, -90.0) for ground in (z, abysses))
            dark, bright = least > altitude + 1e-3, np.isfinite(z) & (most < altitude - 1e-3)
            np.testing.assert_array_equal(found[dark | bright], bright[dark | bright], str((azimuth, altitude, dx)))
            assert (dark | bright).sum() > 0.9 * np.isfinite(z).sum()
            seen.append(bright.mean())
    assert 0.05 < min(seen) < 0.5 < max(seen)


@pytest.mark.x64
def test_a_cell_at_a_hole_has_no_surface():
    """A vertex is lit where its horizon, which is exact on the triangles that there are, is below the light."""
    random, shadowed = np.random.default_rng(1), 0
    for share in (0.1, 0.4):
        z = random.uniform(0, 30, (20, 20))
        z[random.uniform(size=z.shape) < share] = np.nan
        horizons = jaxhf.horizon(z, [float(azimuth) for azimuth, _ in DIRECTIONS], dx=3.0, dy=5.0)
        for (azimuth, altitude), horizon in zip(DIRECTIONS, np.asarray(horizons), strict=True):
            sure = np.isfinite(z) & (np.abs(horizon - altitude) > 1e-6)
            found = lit(z, 3.0, 5.0, float(azimuth), float(altitude))
            np.testing.assert_array_equal(found[sure], horizon[sure] < altitude, str((share, azimuth)))
            shadowed += np.sum(~found)
    assert shadowed > 500


def test_a_wall_casts_a_shadow_of_its_height_over_the_tangent():
    heights = np.zeros((9, 80))
    heights[:, 60] = 10.0
    distance = 0.5 * (60 - np.arange(80)) + np.zeros((9, 1))
    for altitude in (15, 30, 50):
        dark = (distance > 0) & (distance < 10 / np.tan(np.deg2rad(altitude)))
        np.testing.assert_array_equal(~lit(heights, 0.5, 2.0, 90.0, float(altitude)), dark)
    light: Any = {"azimuth": 90.0, "altitude": 30.0}
    dark = (distance > 0) & (distance < 10 * np.sqrt(3))
    assert dark.sum() == 9 * 34
    level = int(1.5 + 254 / 2)  # the sine of 30 degrees
    shaded = jaxhf.hillshade(heights, 0.5, 2.0, **light, compute_edges=True, shadows=True)
    plain = jaxhf.hillshade(heights, 0.5, 2.0, **light, compute_edges=True)
    np.testing.assert_array_equal(shaded, np.where(dark, 1, plain))
    assert plain[0, 40] == level
    for variant in ("combined", "multidirectional", "igor"):
        drawn, unshadowed = (jaxhf.hillshade(heights, 0.5, 2.0, **light, variant=variant, shadows=on) for on in (True, False))
        np.testing.assert_array_equal(drawn, np.where(dark & (unshadowed > 0), 1, unshadowed))  # 0: the border, of no shade
    taller = jaxhf.hillshade(heights, 1.0, 4.0, **light, z_factor=2.0, compute_edges=True, shadows=True)
    np.testing.assert_array_equal(taller, shaded)

    # Of a tint a shadow leaves a third and a little, and level ground all; slopes are as without shadows.
    tint = jaxhf.color_relief(heights).astype(float)
    flat = np.abs(distance) > 0.5  # beyond the neighbours of the wall
    drawn, unshadowed = (jaxhf.relief(heights, 0.5, 2.0, **light, shadows=on) for on in (True, False))
    np.testing.assert_array_equal(drawn[dark], np.floor(tint * (1 / 3 + 2 / 3 / level) + 0.5)[dark])
    np.testing.assert_array_equal(drawn[flat & ~dark], tint[flat & ~dark])
    np.testing.assert_array_equal(drawn[~dark], unshadowed[~dark])


def test_level_ground_and_an_overhead_sun_are_lit():
    assert lit(np.zeros((5, 7)), 1.0, 1.0, 33.0, 0.1).all()
    assert lit(np.random.default_rng(0).uniform(0, 9, (5, 7)), 1.0, 1.0, 0.0, 90.0).all()
