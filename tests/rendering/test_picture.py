"""Pictures of any size from one program, beside those from a program for their size."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxhf
from jaxhf.rendering import picture
from jaxhf.scene.camera import of_any_size
from jaxhf.scene.procedural import fractal

SETTINGS = jaxhf.Settings(chunk=64)  # tiles of 8 x 8 pixels
SIZES = [(72, 64), (65, 97), (200, 33)]  # 72, 117 and 125 of them


def scene(cells: int = 12, kind: type = jaxhf.Perspective) -> jaxhf.Scene:
    heights = fractal([cells, cells], seed=4, exponent=2.4, range=(0.0, 0.3)).astype(np.float32)
    camera = kind.look_at((0.4, -1.0, 0.9), (0.5, 0.5, 0.1), width=40, height=40)
    return jaxhf.Scene([jaxhf.Object(jaxhf.Heightfield(heights))], camera, [jaxhf.Directional((1.0, 0.3, 0.6))])


def seen(scene: jaxhf.Scene, width: int, height: int) -> jaxhf.Scene:
    return scene.with_camera(dataclasses.replace(scene.camera, width=width, height=height))


def test_another_size_needs_no_other_program(traced, monkeypatch):
    monkeypatch.setattr(picture, "_PIXELS", 2**9)
    ready = jaxhf.prepare(scene(13), SETTINGS)
    jaxhf.render(ready.with_camera(seen(ready.scene, *SIZES[0]).camera))
    assert traced.count(()) > 0
    traced.clear()
    for width, height in (*SIZES[1:], (3, 600), (400, 300)):  # the last has 1900 tiles
        image = jaxhf.render(ready.with_camera(seen(ready.scene, width, height).camera))
        assert image.shape == (height, width, 3)
        assert image.std() > 0.005
    counts = []
    larger = ready.with_camera(seen(ready.scene, *SIZES[2]).camera)
    image = jaxhf.render(larger, progress=lambda done, total: counts.append(done))
    np.testing.assert_array_equal(image, jaxhf.render(larger))
    assert (len(counts), counts[-1]) == (16, 6600)
    assert traced == []
    small = jaxhf.render(ready)  # by its own
    assert traced.count(()) > 0
    traced.clear()
    counts.clear()
    np.testing.assert_array_equal(jaxhf.render(ready, progress=lambda done, total: counts.append(done)), small)
    assert (traced, counts) == ([], [1600])


@pytest.mark.parametrize(
    ("kind", "size"), list(zip((jaxhf.Perspective, jaxhf.Orthographic, jaxhf.Perspective), SIZES, strict=True))
)
def test_pictures_and_aovs_are_those_of_a_program_for_their_size(kind, size, monkeypatch):
    """Up to rounding: XLA may divide by a size that it knows in another way."""
    of_its_size = seen(scene(kind=kind), *size)
    aovs = tuple(jaxhf.AOVS)
    found, also = jaxhf.render(of_its_size, SETTINGS, aovs=aovs)
    monkeypatch.setattr(picture, "_OF_ITS_SIZE", 10**6)
    expected, besides = jaxhf.render(of_its_size, SETTINGS, aovs=aovs)
    assert found.sharding == expected.sharding
    same = np.isclose(found, expected, atol=1e-5).all(-1)
    assert same.mean() > 0.998  # beside an edge a ray may see the other side
    assert expected.std() > 0.05
    for name in aovs:
        assert also[name].dtype == besides[name].dtype
        few = 3e-6 if name == "normal" else 1e-6  # roundings of a unit vector's smaller components
        np.testing.assert_allclose(also[name][same], besides[name][same], rtol=2e-5, atol=few, err_msg=name)


@pytest.mark.parametrize("size", [(1, 1), (3, 600), (701, 300)])
@pytest.mark.parametrize("kind", [jaxhf.Perspective, jaxhf.Orthographic])
def test_rays_of_a_camera_of_any_size_are_its_own(kind, size):
    camera = jax.tree.map(lambda leaf: np.asarray(leaf, np.float32), seen(scene(kind=kind), *size).camera)
    for x, y in [(0.5, 0.5), (size[0] - 0.5, 0.25), (0.0, size[1] / 3)]:
        own, other = (c.ray(jnp.float32(x), jnp.float32(y)) for c in (camera, of_any_size(camera)))
        np.testing.assert_allclose(own.d, other.d, rtol=1e-6, atol=1e-7)
        np.testing.assert_allclose(own.o, other.o, rtol=1e-6, atol=1e-7)


def test_derivatives_are_taken_of_programs_for_a_size():
    """Eagerly, by heights and by the camera: a loop of so many turns as data has no reverse derivative."""
    large = seen(scene(), *SIZES[0])

    def mean(heights, matrix):
        moved = dataclasses.replace(large.camera, world_from_camera=matrix)
        return jaxhf.render(large.with_heights(heights).with_camera(moved), SETTINGS).mean()

    matrix = np.asarray(large.camera.world_from_camera, np.float32)
    slopes = jax.grad(mean, (0, 1))(large.heights, matrix)
    assert all(np.isfinite(slope).all() and np.abs(slope).max() > 0 for slope in slopes)
    both = jax.vmap(lambda heights: jaxhf.render(large.with_heights(heights), SETTINGS))(np.stack([large.heights] * 2))
    np.testing.assert_array_equal(both[0], both[1])
