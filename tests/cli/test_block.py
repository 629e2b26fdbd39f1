"""What a view makes of a terrain before it is rendered, and its haze."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

import jaxhf
from jaxhf.cli.block import Look, _in_haze as in_haze, block, exaggeration, has_sea, with_water
from jaxhf.scene.camera import cropped

RAMP = np.linspace(0, 1, 101)[:, None] * np.ones(101)


@pytest.mark.parametrize(
    ("relief", "factor"), [(10.0, 1.0), (5.0, 1.5), (1.0, 7.0), (0.1, 70.0), (60.0, 1.0), (700.0, 0.03), (0.0, 1.0)]
)
def test_heights_are_exaggerated_where_they_would_look_flat(relief: float, factor: float):
    assert exaggeration(RAMP * relief, 1.0, 1.0) == pytest.approx(factor)
    assert exaggeration(RAMP * relief * 30, 30.0, 30.0) == pytest.approx(factor)


def test_water_is_level_and_darkens_with_depth():
    heights = np.array([[5.0, 3, 1], [np.nan, 2, 9]], np.float32)
    colours = np.full((2, 3, 3), 0.5)
    level, tinted = with_water(heights, colours, 3.0)
    np.testing.assert_array_equal(level, np.array([[5, 3, 3], [np.nan, 3, 9]], np.float32))
    np.testing.assert_array_equal(tinted[[0, 1, 1], [0, 0, 2]], 0.5)
    shades = tinted[[0, 1, 0], [2, 1, 1]]  # of depths 2, 1 and 0
    assert (np.diff(shades, axis=0) > 0).all()
    assert (shades < 0.5).all()


def test_a_sea_is_wide_and_level_at_0_beside_land():
    heights = np.maximum(np.arange(-10.0, 190.0), 0)[:, None] * np.ones(30)
    assert has_sea(heights)
    assert has_sea(np.where(heights > 100, np.nan, heights))
    assert not has_sea(heights[10:])  # a shore
    assert not has_sea(heights + 1)
    assert not has_sea(0 * heights)


def test_haze_grows_with_distance_before_a_background():
    image = np.full((4, 3, 3), 0.2)
    depth = np.array([[np.inf] * 3, [10, 20, 30], [10, 10, 10], [np.inf] * 3])
    hazy = in_haze(image, depth, 20.0, 0.5)
    np.testing.assert_allclose(hazy[1, 0], 0.2)  # the nearest point has none
    np.testing.assert_allclose(hazy[1, 2], 0.5 * 0.2 + 0.5 * np.array((0.78, 0.84, 0.90)))
    assert (hazy[1, 1] > hazy[1, 0]).all()
    assert not np.allclose(hazy[0], hazy[3])
    np.testing.assert_array_equal(in_haze(image, depth, 20.0, 0.0)[1:3], 0.2)
    np.testing.assert_array_equal(in_haze(image, np.full_like(depth, np.inf), 20.0, 0.5)[[0, 3]], hazy[[0, 3]])


@pytest.mark.parametrize(("name", "value"), [("altitude", 0.0), ("altitude", 91.0), ("haze", 1.0), ("haze", -0.1)])
def test_a_look_that_cannot_be_is_refused(name: str, value: float):
    with pytest.raises(ValueError, match=f"view: {name} .*it is {value}"):
        dataclasses.replace(Look(), **{name: value})


def test_a_camera_looks_past_the_centres_of_its_pixels():
    camera = jaxhf.Perspective.look_at((3, -2, 4), (0, 1, 0), fov=50, width=60, height=40)
    for dx, dy in ((0.25, -0.375), (-0.5, 0.0)):
        past = cropped(camera, dx, dy, 60, 40)
        for x, y in ((0.5, 39.5), (17.0, 3.0)):
            np.testing.assert_allclose(past.ray(*jnp.array([x, y])).d, camera.ray(*jnp.array([x + dx, y + dy])).d, atol=1e-6)


@pytest.mark.deep
def test_a_picture_laid_over_a_terrain_has_no_rim_of_the_opposite_border():
    field = jaxhf.Heightfield(np.zeros((17, 17), np.float32), 1.0)
    camera = jaxhf.Perspective.look_at((8, 8, 100), (8, 8, 0), up=(0, 1, 0), fov=9.1, width=32, height=32)
    ramp = np.repeat(np.linspace(1, 0, 8)[None, :, None], 8, axis=0) * np.ones(3)
    picture = np.asarray(jaxhf.render(block(field, ramp, camera, Look(), None)))
    assert (np.diff(picture[..., 0], axis=1) <= 1e-6).all()


@pytest.mark.parametrize(("samples", "side", "occlusion"), [(9, 17, 16), (1, 17, None), (9, 1500, None)])
def test_mountains_hide_the_sky_but_in_drafts_and_large_terrains(samples: int, side: int, occlusion: int | None):
    field = jaxhf.Heightfield(np.zeros((side, side), np.float32), 1.0)
    camera = jaxhf.Perspective.framing(field, 205.0, 35.0, width=8, height=8)
    sky = block(field, np.full((2, 2, 3), 0.5), camera, Look(samples=samples), None).lights[1]
    assert isinstance(sky, jaxhf.Sky)
    assert sky.occlusion == occlusion
