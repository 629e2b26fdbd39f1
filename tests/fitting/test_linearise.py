"""The derivative of a picture as a sparse matrix against that of `render`, which other tests hold against differences."""

import dataclasses
import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_fits import rms

import jaxhf
from jaxhf.boundary.sample import BoundarySample, deciding_vertices, picture_point
from jaxhf.fitting.model import linearise as _linearise
from jaxhf.fitting.model.linearise import can_be_linearised, linearise_each, picture_each
from jaxhf.fitting.model.view import View, moved
from jaxhf.preparation.localise import localise
from jaxhf.preparation.world import make_world
from jaxhf.trace.grid import Grid
from jaxhf.xla.devices import local_mesh

PLACE = np.array([[0.9, 0.1, 0.05, 0.1], [-0.1, 0.9, 0.1, 0.2], [0.05, 0.1, 0.8, 0.25], [0, 0, 0, 1]])

CAMERA = jaxhf.Perspective.look_at((0.6, -0.8, 0.9), (0.5, 0.5, 0.1), fov=50.0, width=37, height=22)


def waves(ny: int, nx: int, height: float) -> np.ndarray:
    y, x = np.mgrid[0:ny, 0:nx] / max(ny, nx)
    return height * (np.sin(5 * x + 2 * y) + np.cos(3 * x - 6 * y + 1))


SUN = (jaxhf.Sky(0.1), jaxhf.Directional((0.3, -0.4, 0.5)))
LAMP = (jaxhf.Point((0.1, 0.3, 0.9), (0.9, 0.8, 0.7)),)


def terrains(which: str, material: jaxhf.Matte | jaxhf.Mirror = jaxhf.Matte((0.3, 0.5, 0.7)), lights=LAMP) -> jaxhf.Scene:
    """A turned heightfield with a hole; with "all", after a cylinder and another heightfield."""
    texels = np.random.default_rng(1).uniform(0.2, 0.9, (3, 4, 3))
    painted = jaxhf.Matte(jaxhf.ImageTexture(texels))
    holed = waves(9, 8, 0.05)
    holed[4, 3] = np.nan
    objects = [jaxhf.Object(jaxhf.Heightfield(holed, dx=0.09), material, PLACE)]
    if which == "all":
        tube = jaxhf.Cylinder(radius=0.15, z_min=-0.3, z_max=0.3)
        objects = [jaxhf.Object(tube, painted), jaxhf.Object(jaxhf.Heightfield(waves(12, 10, 0.08)), painted), *objects]
    return jaxhf.Scene(objects, CAMERA, lights)


def pictures(scene: jaxhf.Scene, settings: jaxhf.Settings, channels: int):
    """Functions of all heights and of a view: the linearised picture, the picture by it, and the picture by `render`."""
    scenes = jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], localise(scene))

    def change(unknowns):
        heights, view = unknowns

        def changed(scene):
            for k, new in enumerate(heights):
                scene = eqx.tree_at(lambda scene, k=k: scene.heightfields[k].heights, scene, new)
            lights, camera = moved(scene.lights, scene.camera, view)
            return dataclasses.replace(scene, lights=lights, camera=camera)

        return changed

    def known(unknowns):
        still = jax.tree.map(jnp.zeros_like, unknowns[1])
        return linearise_each(scenes, change(unknowns), settings, local_mesh(), channels, still)

    def by_matrix(known, unknowns):
        return picture_each(known, scenes, change(unknowns), settings, local_mesh())[0]

    def by_render(unknowns):
        image = jaxhf.render(change(unknowns)(localise(scene)), settings)
        return image if channels == 3 else image.mean(-1, keepdims=True)

    return known, by_matrix, by_render


# A light and a camera that were turned already.
TURNED = {"light": np.array([0.02, -0.01]), "camera": np.array([0.01, -0.02, 0.03, 0.02, 0.01, -0.03])}
SMOOTH = jaxhf.Settings(samples=1, chunk=64, edge_samples=300)
FLAT = jaxhf.Settings(samples=1, chunk=64, shading="flat")
DOUBLE = [pytest.mark.x64, pytest.mark.deep]  # leaves no room for an error that rounding would hide


@pytest.mark.parametrize(
    ("which", "lights", "view", "settings", "channels", "derivative", "rounding"),
    [
        pytest.param("one", SUN, TURNED, SMOOTH, 1, "jvp", 1e-4, marks=pytest.mark.deep),  # fits and their matrix rest on it
        pytest.param("all", LAMP, {}, FLAT, 1, "vjp", 1e-4, marks=pytest.mark.deep),
        pytest.param("all", SUN, TURNED, SMOOTH, 1, "jvp", 1e-10, marks=[pytest.mark.x64, pytest.mark.slow]),
        pytest.param("one", LAMP, {}, jaxhf.Settings(samples=4, chunk=256, edge_samples=300), 3, "jvp", 1e-10, marks=DOUBLE),
        pytest.param("all", LAMP, {}, FLAT, 1, "vjp", 1e-10, marks=DOUBLE),
    ],
    ids=["edges", "flat", "all, double", "colour, double", "flat, double"],
)
def test_matrix_is_the_derivative_of_render(which, lights, view, settings, channels, derivative, rounding, monkeypatch):
    """In every pixel, or in every unknown, to rounding; in the other mode by the inner product.

    (The forward derivative of `render` compiles sooner.) The picture itself is `render`'s but where pixels are resampled.
    """
    monkeypatch.setattr(_linearise, "_POINTS_PER_PIXEL", 64)  # then as many are resampled as by `render`
    scene = terrains(which, lights=lights)
    heights = tuple(jnp.asarray(field.heights) for field in scene.heightfields)
    unknowns = heights, View(**jax.tree.map(jnp.asarray, view))
    cotangent = jax.random.normal(jax.random.key(1), (22, 37, channels), heights[0].dtype)
    leaves, tree = jax.tree.flatten(unknowns)
    drawn = [jax.random.normal(jax.random.key(2 + k), leaf.shape, leaf.dtype) for k, leaf in enumerate(leaves)]
    tangent = jax.tree.unflatten(tree, drawn)

    def both(picture):
        if derivative == "jvp":
            return jax.jvp(picture, (unknowns,), (tangent,))
        image, vjp = jax.vjp(picture, unknowns)
        return image, vjp(cotangent)[0]

    known, by_matrix, by_render = pictures(scene, settings, channels)
    linear = jax.jit(known)(unknowns)
    found = jax.jit(lambda linear: both(functools.partial(by_matrix, linear)))(linear)
    expected = jax.jit(lambda: both(by_render))()
    if linear.edges is not None:
        resampled = np.asarray(linear.edges.resampled[0])
        picture = np.array(expected[0]).reshape(-1, channels)
        assert np.abs(np.asarray(found[0]).reshape(-1, channels) - picture)[resampled].max() > 1e-3
        picture[resampled] = np.asarray(found[0]).reshape(-1, channels)[resampled]
        expected = (picture.reshape(22, 37, channels), *expected[1:])
    for mine, theirs in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert np.nanmax(np.abs(theirs)) > 1e-3
        np.testing.assert_allclose(mine, theirs, rtol=0, atol=rounding * np.nanmax(np.abs(theirs)))

    @jax.jit
    def products(linear):
        picture = functools.partial(by_matrix, linear)
        return jax.jvp(picture, (unknowns,), (tangent,))[1], jax.vjp(picture, unknowns)[1](cotangent)[0]

    forward, reverse = products(linear)
    backwards = sum(np.nansum(np.asarray(a) * np.asarray(b)) for a, b in zip(jax.tree.leaves(reverse), drawn, strict=True))
    np.testing.assert_allclose(backwards, np.vdot(cotangent, forward), rtol=10 * rounding)


@pytest.fixture(scope="module")
def derivatives():
    """Of a boundary point's place in the picture: in all heights by JAX, and in those of its deciding vertices."""
    settings = jaxhf.Settings(edge_samples=1)
    scene = localise(terrains("all"))
    world, camera = make_world(scene, settings), scene.camera

    def by_rows(rows, point):
        surfaces = [
            world.surfaces[0],
            *(eqx.tree_at(lambda g: g.rows, g, r) for g, r in zip(world.surfaces[1:], rows, strict=True)),
        ]
        return picture_point(eqx.tree_at(lambda w: w.surfaces, world, tuple(surfaces)), camera, point, point.s)[0]

    def by_five(perturbation, point):
        return picture_point(world, camera, point, point.s, perturbation=perturbation)[0]

    @jax.jit
    def both(point):
        rows = [grid.rows for grid in world.surfaces if isinstance(grid, Grid)]
        expected = jnp.concatenate(jax.jacrev(by_rows)(rows, point), axis=1)
        vertices = deciding_vertices(world, point)
        return expected, jnp.zeros_like(expected).at[:, vertices].add(jax.jacrev(by_five)(jnp.zeros(5), point))

    return both


@pytest.mark.parametrize("surface", [1, 2])
@pytest.mark.parametrize("receiver", [1, 2])
def test_a_point_on_an_edge_depends_on_its_deciding_vertices_alone(derivatives, surface, receiver):
    point = BoundarySample(
        valid=jnp.asarray(True), edge=jnp.int32(0), surface=jnp.int32(surface), light=jnp.int32(0),
        start=jnp.array([5, 6], jnp.int32), end=jnp.array([6, 7], jnp.int32), s=jnp.asarray(0.3), measure=jnp.asarray(1.0),
        receiver=jnp.int32(receiver), cell=jnp.array([2, 1], jnp.int32), upper=jnp.asarray(True), t=jnp.asarray(0.4),
    )  # fmt: skip
    expected, found = derivatives(point)
    assert np.count_nonzero(expected) == 10
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5 * np.abs(expected).max())


def test_what_a_mirror_shows_has_no_such_matrix():
    mirrored = terrains("one", jaxhf.Mirror((0.7, 0.8, 0.9)))
    assert can_be_linearised(terrains("one"), jaxhf.Settings())
    assert not can_be_linearised(mirrored, jaxhf.Settings())
    assert can_be_linearised(mirrored, jaxhf.Settings(max_depth=0))


def samples_of(picture, side: int, pixels: int = 24) -> np.ndarray:
    """A picture's regular samples, row by row; x to the right, y down, a pixel is 1 wide."""
    y, x = (np.mgrid[0 : pixels * side, 0 : pixels * side] + 0.5) / side
    return picture(x, y)[..., None].astype(np.float32)


@pytest.mark.parametrize("side", [4, *(pytest.param(side, marks=pytest.mark.deep) for side in (2, 8))])
@pytest.mark.parametrize(
    ("picture", "least", "most"),
    [
        (lambda x, y: np.sin(0.9 * x + 0.3 * y) + np.cos(0.5 * y - 0.2 * x), 0.3, 1.5),
        (lambda x, y: np.where(np.hypot(x - 11.7, y - 12.2) < 9.3, 0.8, 0.1), 0.5, 1.5),
    ],
    ids=["smooth", "disc"],
)
def test_errors_of_few_samples_are_known(picture, least, most, side):
    """The root mean squares of errors and of what is expected of them, against 64 x 64 samples, where they are not 0."""
    known = np.asarray(_linearise._sampling_error(jnp.asarray(samples_of(picture, side)), side))[..., 0]
    fine, few = (samples_of(picture, n).reshape(24, n, 24, n).mean((1, 3)) for n in (64, side))
    told = known > 0
    assert least < rms((few - fine)[told]) / rms(known[told]) < most
    assert rms((few - fine)[~told]) <= 0.02


def test_slopes_and_boundaries_between_pixels_make_no_error():
    tilted = samples_of(lambda x, y: 3 * x - 2 * y, 4)
    np.testing.assert_allclose(_linearise._sampling_error(jnp.asarray(tilted), 4)[1:-1, 1:-1], 0, atol=1e-5)
    step = samples_of(lambda x, y: np.where(x < 11, 1.0, 0.0), 2)
    np.testing.assert_array_equal(_linearise._sampling_error(jnp.asarray(step), 2), 0)
    within = samples_of(lambda x, y: np.where(x < 11.5, 1.0, 0.0), 2)
    assert (np.asarray(_linearise._sampling_error(jnp.asarray(within), 2))[:, 11] > 0.1).all()
