"""The derivative inside triangles, pixel by pixel, for every number in a scene; two scenes hold all kinds of things.

No leaf is named here: they are found in the pytree, so that a new one is tested as soon as it is in a scene. Derivatives are
those of users, in single precision; what they are held against, central differences of pictures, is in double.
"""

import dataclasses
import functools
import math
import re
from typing import Any, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxhf
from jaxhf.scene.camera import Camera
from jaxhf.scene.light import Light
from jaxhf.scene.material import SCATTERING
from jaxhf.scene.scene import Shape

SIZE = 16  # pixels
STEP = 1e-4


def matrix(linear: Any, offset: Any) -> np.ndarray:
    return np.block([[np.asarray(linear, float), np.reshape(offset, (3, 1))], [np.zeros((1, 3)), np.ones((1, 1))]])


def waves(ny: int, nx: int, seed: int, height: float) -> np.ndarray:
    """Generic smooth heights: no two cells alike."""
    y, x = np.mgrid[0:ny, 0:nx] / max(ny, nx)
    a, b, c = np.random.default_rng(seed).uniform(1, 5, (3, 4))[:, :, None, None]
    return height * np.sum(np.sin(a * x + b * y + c), axis=0)


def reflected() -> jaxhf.Scene:
    """A mirror that stands in a textured cylinder, under a lamp."""
    texels = np.random.default_rng(1).uniform(0.2, 0.9, (3, 4, 3))
    return jaxhf.Scene(
        [
            jaxhf.Object(
                jaxhf.Heightfield(waves(5, 6, 2, 0.03)),
                jaxhf.Mirror((0.7, 0.8, 0.9)),
                matrix([[1, 0.1, 0.05], [-0.1, 0.9, 0.1], [0.1, 0.1, 0.8]], (0, 0, 0)),
            ),
            jaxhf.Object(
                jaxhf.Cylinder(radius=1.2, z_min=-0.9, z_max=4.0),
                jaxhf.Matte(jaxhf.ImageTexture(texels)),
                matrix([[1, 0.1, 0], [-0.05, 1, 0.1], [0.02, 0, 1]], (0.4, 0.4, 0)),
            ),
        ],
        jaxhf.Perspective.look_at((0.6, -0.5, 0.7), (0.5, 0.5, 0.1), fov=50.0, width=SIZE, height=SIZE),
        [jaxhf.Point((0.4, 0.3, 1.2), (0.9, 0.8, 0.7))],
    )


def parallel() -> jaxhf.Scene:
    """Terrain with walls in two suns, one of them wide, and under a sky, seen by parallel rays."""
    place = matrix([[0.9, 0.1, 0], [-0.1, 0.9, 0], [0, 0, 0.8]], (0.1, 0, 0))
    field = jaxhf.Heightfield(waves(9, 8, 5, 0.06))
    return jaxhf.Scene(
        [
            jaxhf.Object(field, jaxhf.Matte((0.3, 0.5, 0.7)), place),
            jaxhf.Object(jaxhf.Skirt.of(field, -0.4), jaxhf.Matte((0.6, 0.5, 0.4)), place),
        ],
        jaxhf.Orthographic.look_at((0.6, -0.7, 0.9), (0.5, 0.5, 0.0), extent=0.9, width=SIZE, height=SIZE),
        [jaxhf.Directional((-0.7, -0.4, 0.4), (2, 3, 4)), jaxhf.Sky((0.1, 0.2, 0.4)), jaxhf.Sun((-0.3, 1, 0.1), (4, 3, 2), 9)],
    )


def plain() -> jaxhf.Scene:
    """Turned terrain with a texture, under a lamp, as most scenes are: a third of the others' programs."""
    scene = reflected()
    field, cylinder = scene.objects
    ground = jaxhf.Object(field.shape, cylinder.material, field.world_from_object)
    return jaxhf.Scene([ground], scene.camera, scene.lights)


def laws() -> jaxhf.Scene:
    """Small tilted terrains side by side, each with a law of reflectance."""
    materials = (
        jaxhf.LommelSeeliger((0.3, 0.5, 0.7)),
        jaxhf.LunarLambert((0.3, 0.5, 0.7), 0.4),
        jaxhf.Minnaert((0.3, 0.5, 0.7), 0.6),
        jaxhf.OrenNayar((0.3, 0.5, 0.7), 25.0),
        jaxhf.Hapke((0.3, 0.5, 0.7), 0.3, 0.6, 1.2, 0.07, 20.0),
    )
    fields = (jaxhf.Heightfield(waves(3, 3, 5, 0.06), dx=0.1, x0=0.2 * k) for k in range(len(materials)))
    scene = parallel()
    objects = [jaxhf.Object(field, material) for field, material in zip(fields, materials, strict=True)]
    camera = jaxhf.Orthographic.look_at((0.5, -0.9, 0.9), (0.5, 0.1, 0.0), extent=0.2, width=4 * SIZE, height=SIZE)
    return jaxhf.Scene(objects, camera, scene.lights[:2])


SCENES = {"reflected": reflected, "parallel": parallel, "plain": plain, "laws": laws}
SETTINGS = jaxhf.Settings(max_depth=1, chunk=SIZE * SIZE)


def test_scenes_hold_every_kind_of_thing():
    """What has leaves of its own, and is in none of the scenes, would go untested."""
    kinds = (*get_args(Shape), *SCATTERING.values(), jaxhf.Mirror, *get_args(Light), *get_args(Camera), jaxhf.ImageTexture)
    held = {type(node) for make in SCENES.values() for node in nodes(make())}
    assert set(kinds) <= held


def nodes(tree: Any) -> list[Any]:
    """All modules in a pytree."""
    below, found = jax.tree.leaves(tree, is_leaf=lambda node: node is not tree), []
    for node in below:
        if isinstance(node, eqx.Module | tuple | list):
            found += [node, *nodes(node)]
    return found


def random_change(leaf: np.ndarray, upright: bool) -> np.ndarray:
    """As large as the leaf; `upright` ones of a matrix do not tilt what stands. Numbers of single precision."""
    change = np.random.default_rng(6).uniform(-1, 1, leaf.shape) * np.abs(leaf).max()
    if leaf.shape == (4, 4):
        change[3] = 0  # the last row of an affine matrix stays
        if upright:
            change[2, :2] = change[:2, 2] = 0
    return change.astype(np.float32)


def in_precision(tree: Any, dtype: Any) -> Any:
    return jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf, np.float32), dtype), tree)


@functools.partial(jax.jit, static_argnames=("settings",))
def differences(scene: jaxhf.Scene, change: jaxhf.Scene, settings: jaxhf.Settings) -> tuple[jax.Array, jax.Array]:
    """Central differences of the picture, with STEP and with half of it."""

    def at(step: jax.Array) -> jax.Array:
        return jaxhf.render(jax.tree.map(lambda a, b: a + step * b, scene, change), settings)

    ahead, behind, near, before = jax.lax.map(at, STEP * jnp.array([1, -1, 0.5, -0.5]))
    return (ahead - behind) / (2 * STEP), (near - before) / STEP


@functools.partial(jax.jit, static_argnames=("settings",))
def forward(scene: jaxhf.Scene, change: jaxhf.Scene, settings: jaxhf.Settings) -> jax.Array:
    return jax.jvp(lambda scene: jaxhf.render(scene, settings), (scene,), (change,))[1]


@functools.partial(jax.jit, static_argnames=("settings",))
def reverse(scene: jaxhf.Scene, weights: jax.Array, settings: jaxhf.Settings) -> jaxhf.Scene:
    return jax.vjp(lambda scene: jaxhf.render(scene, settings), scene)[1](weights)[0]


def test_reverse_mode_keeps_no_heights_a_tile():
    """A conditional that returned the derivative of all heights or normals would cost every tile a pass over them."""
    scene = parallel()
    place = scene.objects[0].world_from_object
    field = jaxhf.Heightfield(waves(37, 53, 5, 0.06).astype(np.float32))
    # Under a directional light one conditional a picture, not a tile, has all of a terrain's bounds.
    light = jaxhf.Point((0.5, 0.5, 3.0), 10.0)
    scene = jaxhf.Scene([jaxhf.Object(field, jaxhf.Matte(0.5), place)], scene.camera, [light])
    gradient = jax.jit(jax.grad(lambda heights: jnp.sum(jaxhf.render(scene.with_heights(heights), SETTINGS))))
    program = gradient.lower(jnp.asarray(scene.heights)).compile().as_text()
    assert program is not None
    results = [line.split(" conditional(")[0] for line in program.splitlines() if " conditional(" in line]
    sizes = [math.prod(map(int, shape.split(","))) for result in results for shape in re.findall(r"\[([\d,]+)\]", result)]
    assert sizes
    assert max(sizes) < 37 * 53


def test_a_picture_of_several_samples_has_the_derivative_of_their_mean():
    """Samples of a pixel are the pixels of a picture of twice the size. Where it is differentiated, tiles and samples are one
    loop; sums over a pixel's samples may be rounded otherwise."""
    heights, change = (jnp.asarray(waves(9, 7, waves_of, 0.06).astype(np.float32)) for waves_of in (5, 3))

    def render(heights: jax.Array, finer: int, samples: int) -> tuple[jax.Array, dict[str, jax.Array]]:
        camera = dataclasses.replace(parallel().camera, width=20 * finer, height=12 * finer)
        scene = jaxhf.Scene([jaxhf.Object(jaxhf.Heightfield(heights))], camera, [jaxhf.Directional((0.3, 0.4, 1.0))])
        return jaxhf.render(scene, jaxhf.Settings(samples=samples, chunk=64), aovs=("depth",))

    image, aovs = render(heights, 1, 4)
    (same, others), (moved, _) = jax.jvp(lambda heights: render(heights, 1, 4), (heights,), (change,))
    _, (finer, _) = jax.jvp(lambda heights: render(heights, 2, 1), (heights,), (change,))
    assert float(image.std()) > 0.01
    np.testing.assert_allclose(same, image, rtol=0, atol=1e-6)
    np.testing.assert_allclose(others["depth"], aovs["depth"], rtol=1e-6)
    np.testing.assert_allclose(moved, finer.reshape(12, 2, 20, 2, 3).mean((1, 3)), rtol=0, atol=1e-5 * float(abs(moved).max()))


@functools.cache
def changes(name: str) -> dict[str, tuple[jaxhf.Scene, np.ndarray, np.ndarray]]:
    """Of each leaf: a change of it alone, and central differences along that with STEP and with half of it."""
    with jax.enable_x64(True):
        scene = in_precision(SCENES[name](), np.float64)
        leaves, structure = jax.tree.flatten_with_path(scene)
        upright = any(isinstance(light, jaxhf.Sun) for light in scene.lights)  # it is seen in upright planes
        found = {}
        for k, (path, leaf) in enumerate(leaves):
            change = [np.zeros(other.shape, np.float32) for _, other in leaves]
            change[k] = random_change(np.asarray(leaf), upright)
            direction = jax.tree.unflatten(structure, change)
            both = differences(scene, in_precision(direction, np.float64), SETTINGS)
            found[jax.tree_util.keystr(path)] = (direction, *map(np.asarray, both))
    return found


SINGLE, DOUBLE = (np.float32, 5e-5, 1e-4, 1e-4), (np.float64, 1e-6, 1e-10, 1e-5)
DEEP, SLOW, X64 = pytest.mark.deep, pytest.mark.slow, pytest.mark.x64
PRECISIONS = [
    pytest.param("plain", *SINGLE, id="plain, single"),
    pytest.param("plain", *DOUBLE, marks=[DEEP, X64], id="plain, double"),
    pytest.param("parallel", *SINGLE, marks=SLOW, id="parallel, single"),
    pytest.param("parallel", *DOUBLE, marks=[DEEP, X64], id="parallel, double"),
    pytest.param("reflected", *SINGLE, marks=SLOW, id="reflected, single"),
    pytest.param("reflected", *DOUBLE, marks=[DEEP, SLOW, X64], id="reflected, double"),
    pytest.param("laws", *SINGLE, marks=SLOW, id="laws, single"),
    pytest.param("laws", *DOUBLE, marks=[DEEP, SLOW, X64], id="laws, double"),
]


@pytest.mark.parametrize(("name", "dtype", "rtol", "between", "corner"), PRECISIONS)
def test_every_leaf_pixel_by_pixel(name, dtype, rtol, between, corner):
    """Against central differences, in forward and in reverse mode.

    A ray counts where the picture is smooth within the step: there the differences with half the step agree but for a third
    derivative, while the border of a cell or of a shadow between the two shows. This asks nothing of the derivative itself.
    By `corner`, a share of the derivative, they may differ: by less in double precision, where a smaller corner would exceed
    `rtol`, such as that of Hapke's roughness where a light stands as high over the surface as the eye (below).
    The two differences together are exact but for a fifth derivative times STEP^4, and a rounding of 1e-16 / STEP. In single
    precision 6e-6 of a picture's largest derivative was seen.
    """
    scene = in_precision(SCENES[name](), dtype)
    weights = np.random.default_rng(7).normal(size=(SIZE, scene.camera.width, 3)).astype(np.float32)
    gradients = jax.tree.leaves(reverse(scene, jnp.asarray(weights, dtype), SETTINGS))
    borders = [f".objects[{k}].shape" for k, obj in enumerate(scene.objects) if isinstance(obj.shape, jaxhf.Skirt)]
    for k, (where, (change, wide, narrow)) in enumerate(changes(name).items()):
        exact = np.asarray(forward(scene, in_precision(change, dtype), SETTINGS), np.float64)
        numeric = (4 * narrow - wide) / 3
        size = np.abs(numeric)
        smooth = np.abs(wide - narrow) < corner * (size + 0.01)
        assert smooth.mean() > 0.9, where
        if any(where.startswith(border) for border in borders):  # which moves only the borders of what is seen
            assert not exact.any(), where
        else:
            assert np.mean(size > 1e-4) > 0.2 / max(2, len(scene.objects)), where  # or all could be zero
        bound = rtol * (size + size.max()) + 1e-9
        assert np.all(np.abs(exact - numeric)[smooth] <= bound[smooth]), where
        backwards = np.vdot(gradients[k], jax.tree.leaves(change)[k])
        assert abs(backwards - np.vdot(weights, exact)) <= between * np.abs(exact).sum(), where


@pytest.mark.deep
@pytest.mark.x64
@pytest.mark.parametrize(("roughness", "corner"), [(None, 0.0), (20.0, 0.04)])
def test_hapkes_roughness_has_a_corner_where_light_and_eye_are_as_high(roughness, corner):
    """Its two cases meet there in value, not in slope: one-sided differences show the corner, and the derivative has it."""
    material = in_precision(jaxhf.Hapke(0.5, 0.3, 0.6, 1.2, 0.07, roughness), np.float64)

    def brdf(off: jax.Array) -> jax.Array:
        sine = jnp.sqrt(1 - (0.8 + off) ** 2)
        wi = jnp.stack([sine * np.cos(2.0), sine * np.sin(2.0), 0.8 + off])
        return material.brdf(wi, jnp.array([0.6, 0.0, 0.8]), jnp.array([0.0, 0.0, 1.0]))[0]

    step = 1e-6
    sides = [float((brdf(jnp.array(2 * s)) - brdf(jnp.array(s))) / s) for s in (-step, step)]
    np.testing.assert_allclose([jax.grad(brdf)(jnp.array(s)) for s in (-1e-9, 1e-9)], sides, rtol=5e-5)
    np.testing.assert_allclose(brdf(jnp.array(1e-12)), brdf(jnp.array(-1e-12)), rtol=1e-11)
    np.testing.assert_allclose(sides[1] / sides[0] - 1, corner, atol=0.005)


@pytest.mark.deep  # two of the largest programs
def test_what_rays_met_has_its_derivative_beside_points_on_edges():
    terrain = parallel()
    scene = in_precision(jaxhf.Scene(terrain.objects[:1], terrain.camera, terrain.lights), np.float32)  # without the skirt

    def depth(heights: jax.Array, edge_samples: int) -> jax.Array:
        settings = dataclasses.replace(SETTINGS, edge_samples=edge_samples)
        return jaxhf.render(scene.with_heights(heights), settings, aovs=("depth",))[1]["depth"]

    plain, beside = (
        jax.jit(jax.grad(lambda heights, count=count: jnp.sum(jnp.where(jnp.isfinite(d := depth(heights, count)), d, 0))))(
            scene.heights
        )
        for count in (0, 64)
    )
    assert np.abs(plain).max() > 0.1
    np.testing.assert_allclose(beside, plain, rtol=1e-4, atol=1e-5)
