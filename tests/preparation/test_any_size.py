"""Pictures of terrains of many sizes from one program, beside those from a program for a terrain's size."""

import dataclasses
import functools
import itertools
import math

import jax
import numpy as np
import pytest

import jaxhf
from jaxhf.preparation import any_size
from jaxhf.preparation.localise import localise
from jaxhf.preparation.world import World, resolve_settings
from jaxhf.rendering import render
from jaxhf.scene.procedural import fractal

SETTINGS = jaxhf.Settings(chunk=64)
SIZES = [(40, 50), (33, 61), (30, 120), (64, 64)]  # one room for all


def scene(shape: tuple[int, int], pixels: int = 72, **more) -> jaxhf.Scene:
    heights = fractal([max(shape)] * 2, seed=4, exponent=2.4, range=(0.0, 0.3)).astype(np.float32)[: shape[0], : shape[1]]
    field = jaxhf.Heightfield(heights, 1 / max(shape), 1 / max(shape))
    camera = jaxhf.Perspective.look_at((0.4, -1.0, 0.9), (0.5, 0.5, 0.1), width=pixels, height=pixels)
    return jaxhf.Scene([jaxhf.Object(field, **more)], camera, [jaxhf.Directional((1.0, 0.3, 0.6))])


def solid(shape: tuple[int, int]) -> jaxhf.Scene:
    """All that has arrays of the terrain's size: colours at the vertices, walls, a sky that mountains hide."""
    colours = np.random.default_rng(1).random((*shape, 3), np.float32)
    image = jaxhf.ImageTexture(colours, at_vertices=True, wrap="clamp")
    plain = scene(shape, material=jaxhf.Matte(image))
    objects = [*plain.objects, jaxhf.Object(jaxhf.Skirt.of(plain.heightfields[0], -0.1))]
    return jaxhf.Scene(objects, plain.camera, [*plain.lights, jaxhf.Sky(0.4, occlusion=4)])


def holed(shape: tuple[int, int]) -> jaxhf.Scene:
    """The same with holes, one of them at the border, and a sun with a size."""
    made = solid(shape)
    heights = np.array(made.heights)
    heights[5:15, 10:20], heights[3:9, -1] = np.nan, np.nan
    return made.with_heights(heights).with_lights([*made.lights, jaxhf.Sun((-0.5, 0.3, 0.6))])


def of_two(shape: tuple[int, int]) -> jaxhf.Scene:
    first, second = scene(shape), scene((20, 90))
    away = np.eye(4)
    away[:3, 3] = 0.3, 0.2, 0.25
    return jaxhf.Scene(
        [*first.objects, jaxhf.Object(second.heightfields[0], world_from_object=away)], first.camera, first.lights
    )


@pytest.mark.deep
def test_a_terrain_with_a_seam_has_no_room_of_another_of_its_size():
    """So what lies far below it changes nothing: neither its normals at the seam nor the horizons of both its parts."""
    x, y = np.meshgrid(np.linspace(-1, 1, 20), np.linspace(-1, 1, 16))
    region = jaxhf.Heightfield((np.sin(3 * x) * np.cos(2 * y)).astype(np.float32), 0.5, 0.5)
    site = jaxhf.Heightfield(np.random.default_rng(0).uniform(0, 1, (17, 17)).astype(np.float32), 0.125, 0.125, 2.0, 2.0)
    surface = [jaxhf.Object(part) for part in jaxhf.nested(site, region)]
    below = jaxhf.Object(jaxhf.Heightfield(np.full((16, 20), -50, np.float32), 0.5, 0.5))
    camera = jaxhf.Orthographic.look_at((3, 3, 9), (3, 3, 0), up=(0, 1, 0), extent=3.0, width=24, height=24)
    lights = [jaxhf.Directional((1.0, 0.3, 0.6)), jaxhf.Sky(0.4, occlusion=4)]
    expected = jaxhf.render(jaxhf.Scene(surface, camera, lights), SETTINGS)
    np.testing.assert_allclose(jaxhf.render(jaxhf.Scene([*surface, below], camera, lights), SETTINGS), expected, atol=1e-6)


@pytest.mark.parametrize("make", [scene, pytest.param(solid, marks=pytest.mark.slow)])
@pytest.mark.parametrize("pixels", [72, 24])  # by the program for any size, by one for this
def test_another_terrain_needs_no_other_program(make, pixels, traced):
    settings = dataclasses.replace(SETTINGS, max_depth=1000 + pixels)  # programs of this test alone
    seen = [make(shape) for shape in SIZES]
    seen = [one.with_camera(dataclasses.replace(one.camera, width=pixels, height=pixels)) for one in seen]
    jaxhf.render(seen[0], settings)
    assert traced.count(()) > 0
    traced.clear()
    for one in seen[1:]:
        image = jaxhf.render(one, settings)
        assert image.std() > 0.03
        ready = jaxhf.prepare(one, settings)
        np.testing.assert_array_equal(jaxhf.render(ready), image)
        darker = [jaxhf.Directional((-1.0, 0.3, 0.6), 0.5), *one.lights[1:]]
        np.testing.assert_array_equal(jaxhf.render(ready.with_lights(darker)), jaxhf.render(one.with_lights(darker), settings))
    assert traced == []
    jaxhf.render(make((65, 65)), settings)  # which has more vertices than there is room for
    assert traced.count(()) > 0


@pytest.mark.parametrize(
    ("make", "shapes"),
    [
        (scene, [SIZES[1], (17, 40)]),
        pytest.param(holed, SIZES[1:2], marks=pytest.mark.deep),
        pytest.param(of_two, [(17, 40)], marks=pytest.mark.slow),
    ],
)
def test_pictures_are_those_of_a_program_for_their_terrain(make, shapes, monkeypatch):
    """To the bit, of worlds of the same bits; with holes but for the rounding of normals, which programs of other worlds may
    compute otherwise. Terrains without room, which are narrow or have a seam, are prepared by the same program either way."""
    rooms = any_size._rooms
    monkeypatch.setattr(any_size, "_rooms", lambda shapes, squared: rooms(shapes, False))
    for shape in shapes:
        aovs = ("depth", "uv", "cell", "normal", "shadow", "steps", "status")
        found = jaxhf.render(make(shape), SETTINGS, aovs=aovs)
        with monkeypatch.context() as patched:
            patched.setattr(any_size, "_room", lambda *_: None)
            jax.clear_caches()
            assert all(grid.rows.size == math.prod(grid.shape) for _, grid, _ in roomy(make(shape)).grids)
            expected = jaxhf.render(make(shape), SETTINGS, aovs=aovs)
        jax.clear_caches()
        assert expected[0].std() > 0.005
        if make is holed:
            for one, other in ((found[0], expected[0]), (found[1].pop("normal"), expected[1].pop("normal"))):
                np.testing.assert_allclose(one, other, rtol=0, atol=1e-6)
            found, expected = found[1], expected[1]
        jax.tree.map(np.testing.assert_array_equal, found, expected)


def with_holes(shape: tuple[int, int]) -> jaxhf.Scene:
    plain = solid(shape)
    return plain.with_heights(holed(shape).heights).with_lights([jaxhf.Directional((-0.2, 1.0, 0.6)), *plain.lights])


@pytest.mark.parametrize("make", [solid, pytest.param(with_holes, marks=pytest.mark.slow)])
def test_one_program_makes_worlds_of_many_sizes_where_mountains_hide_the_sky(make, compilations, monkeypatch):
    """As one for their size does, but for the rounding of normals; also what is made of them for another light."""
    shapes = (40, 50), (60, 47), (65, 34), (66, 40)  # the last one has a side beyond 65, up to which a program serves
    scenes = [make(shape) for shape in shapes]
    moved = [jaxhf.Directional(light.towards * (-1, 1, 1)) for light in scenes[0].lights[:-1]]
    others = [one.with_lights([*moved, one.lights[-1]]) for one in scenes]
    made = []
    for number, (one, other) in enumerate(zip(scenes, others, strict=True)):
        compilations.clear()
        ready = jaxhf.prepare(one, SETTINGS)
        made += [ready._world, ready.with_lights(other.lights)._world]
        assert bool(compilations) == (number in (0, 3))
    rooms = any_size._rooms
    monkeypatch.setattr(any_size, "_rooms", lambda shapes, squared: rooms(shapes, False))
    for world, one in zip(made, itertools.chain(*zip(scenes, others, strict=True)), strict=True):
        jax.tree.map(functools.partial(np.testing.assert_allclose, rtol=1e-6, atol=4e-6), world, roomy(one))


def roomy(scene: jaxhf.Scene) -> World:
    return render.prepared_world(localise(scene), resolve_settings(SETTINGS, scene))


def test_room_is_bounded():
    """By five times what is needed for vertices and four for bounds; there is none for a narrow terrain, nor within a jit."""
    for shape in [(72, 72), (100, 257), (258, 70), (129, 129), (2049, 2049), (2040, 1030), (800, 20)]:
        room, (ny, nx) = any_size._room(shape), shape
        assert room is not None
        assert nx * ny <= room.vertices <= max(5 * nx * ny, 4096)
        assert (nx - 1) * (ny - 1) + 3 * max(nx, ny) <= room.bins <= 5 / 4 * room.vertices
        blocks = math.prod(2 ** math.ceil(math.log2(n - 1)) for n in shape)
        assert 4 * blocks <= room.bounds <= max(16 * blocks, 2**16)
        assert 2 * (nx + ny) <= room.border
    assert any_size._room((9, 4000)) is any_size._room((2050, 2050)) is None
    (_, grid, _), *_ = roomy(scene((5, 300))).grids
    assert grid.rows.shape == (5 * 300,)
    (_, grid, _), *_ = roomy(scene(SIZES[0])).grids
    assert grid.rows.shape == (4096,)
    np.testing.assert_array_equal(grid.z.shape, SIZES[0])
    lengths = []

    @jax.jit
    def within(heights):
        (_, grid, _), *_ = roomy(scene(SIZES[0]).with_heights(heights)).grids
        lengths.append(grid.rows.size)
        return heights

    within(scene(SIZES[0]).heights)
    assert lengths == [2000]
