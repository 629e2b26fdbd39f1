"""A scene prepared once for many pictures."""

import copy
import dataclasses
import pickle

import equinox as eqx
import jax
import numpy as np
import pytest

import jaxhf
from jaxhf.core.affine import translate
from jaxhf.rendering import render
from jaxhf.scene.procedural import fractal
from jaxhf.xla.compilation import Compiled
from jaxhf.xla.devices import local_mesh

CORNER = (5e6, 4.5e6)  # far from the origin: the camera has to be moved in double precision
SETTINGS = jaxhf.Settings(normals="four", chunk=256)
AOVS = ("normal", "cell")


def camera(turn: float) -> jaxhf.Perspective:
    eye = (CORNER[0] + 0.5 + turn, CORNER[1] - 1.2, 1.0)
    return jaxhf.Perspective.look_at(eye, (CORNER[0] + 0.5, CORNER[1] + 0.5, 0.1), width=40, height=30)


def scene(turn: float = 0.0) -> jaxhf.Scene:
    heights = fractal([17, 17], seed=2, exponent=2.0, range=(0.0, 0.3)).astype(np.float32)
    field = jaxhf.Heightfield(heights, dx=1 / 16, x0=CORNER[0], y0=CORNER[1])
    return jaxhf.Scene([jaxhf.Object(field)], camera(turn), [jaxhf.Directional((1, -1, 0.5)), jaxhf.Point((*CORNER, 2.0))])


def test_another_camera_compiles_nothing_and_moves_the_picture(compilations):
    """To the bits of the scene that is seen so from the start."""
    prepared = jaxhf.prepare(scene(), SETTINGS)
    first, _ = jaxhf.render(prepared, aovs=AOVS)
    compilations.clear()
    moved, aovs = jaxhf.render(prepared.with_camera(camera(0.3)), aovs=AOVS)
    assert not compilations
    image, expected = jaxhf.render(scene(0.3), SETTINGS, aovs=AOVS)
    np.testing.assert_array_equal(moved, image)
    for name, value in expected.items():
        np.testing.assert_array_equal(aovs[name], value, name)
    assert np.abs(np.asarray(moved) - np.asarray(first)).max() > 0.1


@pytest.mark.parametrize("side", [24, 140])  # the latter has more tiles than a program for its size traces
@pytest.mark.parametrize("aovs", [(), AOVS])
def test_the_picture_is_compiled_beside_the_world(programs, side, aovs):
    """By `render`, and by `jaxhf view`; and neither of them twice."""
    seen = scene().with_camera(dataclasses.replace(camera(0.0), width=side, height=side))
    expected = ["_made_world", "trace_picture" if side == 24 else "trace_tiles"]
    for make in (lambda: seen, lambda: render.prepare_to_render(seen, SETTINGS, aovs=aovs)):
        jax.clear_caches()
        programs.clear()
        jaxhf.render(make(), SETTINGS, aovs=aovs)
        assert sorted(name for name, other in programs if other) == expected
        assert {name for name, other in programs if not other} <= {"_assembled"}


@pytest.mark.parametrize("seed", [None, 1])
@pytest.mark.parametrize("progress", [None, lambda *_: None])
def test_with_points_on_edges_the_picture_is_compiled_once(programs, seed, progress):
    key, settings = None if seed is None else jax.random.key(seed), dataclasses.replace(SETTINGS, edge_samples=64)
    jax.clear_caches()
    jaxhf.render(scene(), settings, key=key, progress=progress)
    assert sorted(programs) == [("_made_world", True), ("trace_picture", True)]


def test_for_heights_that_lie_on_a_device_the_picture_is_compiled_once(programs):
    jax.clear_caches()
    heights = jax.device_put(scene().heights, jax.devices()[0])
    jaxhf.render(scene().with_heights(heights), SETTINGS)
    assert sorted(programs) == [("_made_world", True), ("trace_picture", True)]


@pytest.mark.deep
def test_another_light_keeps_the_hidden_sky(monkeypatch):
    """The same bits as the scene in that light prepared anew; another occlusion is looked for."""
    looks, meanwhile = [], Compiled.meanwhile

    def noted(self, *args, **named):
        if self is render._make_world_with_horizons:
            looks.append(args)
        return meanwhile(self, *args, **named)

    monkeypatch.setattr(Compiled, "meanwhile", noted)
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


FLAT = jaxhf.Settings(shading="flat", shadows=False)  # a small program, of which there are six


def placed(albedo=0.5, fov=40.0) -> jaxhf.Scene:
    """A scene whose origin is an object's transform, which `jit` traces where it is an argument.

    So it does the camera, in single precision, of which its place is a number: another would be moved by up to 6e-5.
    """
    heights = fractal([9, 9], seed=2, exponent=2.0, range=(0.0, 0.3)).astype(np.float32)
    world = jaxhf.Object(jaxhf.Heightfield(heights), jaxhf.Matte(albedo), translate(1000.0, 2000.0, 5.0))
    eye = jaxhf.Perspective.look_at((1000.5, 1998.75, 6), (1000.5, 2000.5, 5), fov=fov, width=24, height=16)
    return jaxhf.Scene([world], eye, [jaxhf.Directional((1, 0, 0.4)), jaxhf.Point((1000, 2000, 8), 3)])


WAYS = {
    "pickle": lambda ready: jaxhf.render(pickle.loads(pickle.dumps(ready))),
    "deepcopy": lambda ready: jaxhf.render(copy.deepcopy(ready)),
    "tree.map": lambda ready: jaxhf.render(jax.tree.map(lambda leaf: leaf, ready)),
    "argument of jit": jax.jit(jaxhf.render),
    "lights in jit": jax.jit(lambda ready: jaxhf.render(ready.with_lights(placed().lights))),
}


@pytest.mark.parametrize("way", WAYS)
def test_a_prepared_scene_stays_the_same(way):
    ready = jaxhf.prepare(placed(), FLAT)
    expected = jaxhf.render(placed(), FLAT)
    np.testing.assert_allclose(WAYS[way](ready), expected, atol=1e-5)
    assert np.ptp(np.asarray(expected)) > 0.1


def test_what_is_prepared_is_read_back():
    ready = jaxhf.prepare(scene(), SETTINGS)
    read = pickle.loads(pickle.dumps(ready))
    assert (read.mesh, read.settings) == (ready.mesh, ready.settings)
    np.testing.assert_array_equal(read.scene.heights, ready.scene.heights)
    field = jaxhf.prepare(scene().heightfields[0])
    rays = np.array([*CORNER, 9.0]) + 0.3, np.array([0, 0, -1.0])
    np.testing.assert_array_equal(
        jaxhf.cast(pickle.loads(pickle.dumps(field)), *rays).p, jaxhf.cast(scene().heightfields[0], *rays).p
    )


def test_a_mesh_that_another_process_lacks_becomes_its_own():
    ready = jaxhf.prepare(placed(), FLAT)
    state = ready.__getstate__()
    numbers, *rest = state["mesh"]
    read = object.__new__(jaxhf.Prepared)
    read.__setstate__({**state, "mesh": (numbers + 1000, *rest)})
    assert read.mesh == local_mesh()


def test_a_change_that_no_picture_would_show_is_refused():
    ready = jaxhf.prepare(placed(), FLAT)
    with pytest.raises(ValueError, match=r"^Prepared: scene is no part of its pytree: change the scene"):
        eqx.tree_at(lambda ready: ready.scene.objects[0].shape.heights, ready, ready.scene.heights * 0)
    assert not any(leaf is ready.scene.heights for leaf in jax.tree.leaves(ready))


@pytest.mark.deep
def test_derivatives_by_what_is_prepared_are_those_by_the_scene():
    found = eqx.filter_grad(lambda ready: jaxhf.render(ready).mean())(jaxhf.prepare(placed(), FLAT))
    of_albedo, of_fov = jax.grad(lambda *values: jaxhf.render(placed(*values), FLAT).mean(), (0, 1))(0.5, 40.0)
    np.testing.assert_allclose(found._world.materials[0].albedo.sum(), of_albedo, rtol=1e-4)
    np.testing.assert_allclose(found.camera.fov, of_fov, rtol=1e-3)
    assert abs(of_albedo) > 0.01
    assert abs(of_fov) > 1e-5
