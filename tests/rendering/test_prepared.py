"""A scene prepared once for many pictures."""

import numpy as np
import pytest

import jaxhf
from jaxhf.io.procedural import fractal
from jaxhf.rendering import render

CORNER = (5e6, 4.5e6)  # far from the origin: the camera has to be moved in double precision
SETTINGS = jaxhf.Settings(normals="four", chunk=256)
AOVS = ("normal", "cell")


def camera(turn: float, width: int = 40) -> jaxhf.Perspective:
    eye = (CORNER[0] + 0.5 + turn, CORNER[1] - 1.2, 1.0)
    return jaxhf.Perspective.look_at(eye, (CORNER[0] + 0.5, CORNER[1] + 0.5, 0.1), width=width, height=30)


def scene(turn: float = 0.0) -> jaxhf.Scene:
    heights = fractal([17, 17], seed=2, exponent=2.0, range=(0.0, 0.3)).astype(np.float32)
    field = jaxhf.Heightfield(heights, dx=1 / 16, x0=CORNER[0], y0=CORNER[1])
    return jaxhf.Scene([jaxhf.Object(field)], camera(turn), [jaxhf.Directional((1, -1, 0.5)), jaxhf.Point((*CORNER, 2.0))])


def test_prepared_renders_the_same_bits():
    image, aovs = jaxhf.render(scene(), SETTINGS, aovs=AOVS)
    prepared_image, prepared_aovs = jaxhf.render(jaxhf.prepare(scene(), SETTINGS), aovs=AOVS)
    np.testing.assert_array_equal(prepared_image, image)
    for name, value in aovs.items():
        np.testing.assert_array_equal(prepared_aovs[name], value, name)
    assert np.ptp(np.asarray(image)) > 0.1


def test_another_camera_compiles_nothing_and_moves_the_picture(compilations):
    prepared = jaxhf.prepare(scene(), SETTINGS)
    jaxhf.render(prepared)
    compilations.clear()
    moved = jaxhf.render(prepared.with_camera(camera(0.3)))
    assert not compilations
    np.testing.assert_array_equal(moved, jaxhf.render(scene(0.3), SETTINGS))
    assert np.abs(np.asarray(moved) - np.asarray(jaxhf.render(scene(), SETTINGS))).max() > 0.1


@pytest.mark.unoptimised
def test_another_light_keeps_the_hidden_sky(monkeypatch):
    """The same bits as the scene in that light prepared anew; another occlusion is looked for."""
    looks, make = [], render._make_world_with_horizons
    monkeypatch.setattr(render, "_make_world_with_horizons", lambda *args, **named: looks.append(args) or make(*args, **named))
    sky = jaxhf.Sky(0.5, occlusion=4)
    first, then = (scene().with_lights([jaxhf.Directional((x, -1, 0.3)), sky]) for x in (1, -1))
    prepared = jaxhf.prepare(first, SETTINGS)
    moved = prepared.with_lights(then.lights)
    assert len(looks) == 1
    image = jaxhf.render(moved)
    np.testing.assert_array_equal(image, jaxhf.render(jaxhf.prepare(then, SETTINGS)))
    assert np.abs(image - jaxhf.render(prepared)).max() > 0.1
    assert moved.with_lights(scene().lights).scene.sky_occlusion is None
    assert moved.with_lights(scene().lights)._world.sky == (None,)


def test_settings_of_a_prepared_scene_stay():
    prepared = jaxhf.prepare(scene(), SETTINGS)
    np.testing.assert_array_equal(jaxhf.render(prepared, SETTINGS), jaxhf.render(prepared))
    with pytest.raises(ValueError, match=r"prepared with Settings\(.*normals='four'.*cannot be rendered with .*max_depth=2"):
        jaxhf.render(prepared, jaxhf.Settings(max_depth=2))
    with pytest.raises(ValueError, match=r"cannot be rendered with .*normals=None"):
        jaxhf.render(prepared, jaxhf.Settings())
