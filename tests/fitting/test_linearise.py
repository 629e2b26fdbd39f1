"""On which heights a point on an edge depends, and how far few samples are off."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_fits import expanded, rms
from test_expansion import CAMERAS, SUN, scene_of, waves

import jaxhf
from jaxhf.boundary.sample import BoundarySample, deciding_vertices, picture_point
from jaxhf.fitting.model.linearise import _errors_of, _sampling_error
from jaxhf.fitting.model.pictures import can_be_linearised
from jaxhf.preparation.localise import localise
from jaxhf.preparation.world import make_world
from jaxhf.trace.grid import Grid


@pytest.fixture(scope="module")
def derivatives():
    """Of a boundary point's place in the picture: in all heights by JAX, and in those of its deciding vertices."""
    settings = jaxhf.Settings(edge_samples=1)
    scene = jax.tree.map(jnp.asarray, localise(scene_of(0, True)))
    world, camera = jax.jit(lambda scene: make_world(scene, settings))(scene), scene.camera

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
        valid=jnp.asarray(True), edge=jnp.int32(0), surface=jnp.int32(surface), light=jnp.int32(2),
        start=jnp.array([5, 6], jnp.int32), end=jnp.array([6, 7], jnp.int32), s=jnp.asarray(0.3), measure=jnp.asarray(1.0),
        receiver=jnp.int32(receiver), cell=jnp.array([2, 1], jnp.int32), upper=jnp.asarray(True), t=jnp.asarray(0.4),
    )  # fmt: skip
    expected, found = derivatives(point)
    assert np.count_nonzero(expected) == 10
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5 * np.abs(expected).max())


def test_what_a_mirror_or_a_sun_with_a_size_shows_has_no_such_matrix():
    def world(material: jaxhf.Matte | jaxhf.Mirror, light: jaxhf.Directional | jaxhf.Sun) -> jaxhf.Scene:
        return jaxhf.Scene([jaxhf.Object(jaxhf.Heightfield(waves(9, 8, 0.05)), material)], CAMERAS[0], [light])

    assert can_be_linearised(world(jaxhf.Matte(0.5), SUN), jaxhf.Settings())
    assert not can_be_linearised(world(jaxhf.Matte(0.5), jaxhf.Sun((0.3, -0.4, 0.5))), jaxhf.Settings())
    assert not can_be_linearised(world(jaxhf.Mirror(0.5), SUN), jaxhf.Settings())
    assert can_be_linearised(world(jaxhf.Mirror(0.5), SUN), jaxhf.Settings(max_depth=0))


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
    known = _sampling_error(samples_of(picture, side), side)[..., 0]
    fine, few = (samples_of(picture, n).reshape(24, n, 24, n).mean((1, 3)) for n in (64, side))
    told = known > 0
    assert least < rms((few - fine)[told]) / rms(known[told]) < most
    assert rms((few - fine)[~told]) <= 0.02


def test_slopes_and_boundaries_between_pixels_make_no_error():
    tilted = samples_of(lambda x, y: 3 * x - 2 * y, 4)
    np.testing.assert_allclose(_sampling_error(tilted, 4)[1:-1, 1:-1], 0, atol=1e-5)
    step = samples_of(lambda x, y: np.where(x < 11, 1.0, 0.0), 2)
    np.testing.assert_array_equal(_sampling_error(step, 2), 0)
    within = samples_of(lambda x, y: np.where(x < 11.5, 1.0, 0.0), 2)
    assert (_sampling_error(within, 2)[:, 11] > 0.1).all()


def test_pixels_that_are_sampled_once_more_have_the_errors_of_squares_alone():
    pixels = np.random.default_rng(0).uniform(size=(5, 64, 3)).astype(np.float32)
    alone = [_sampling_error(pixel.reshape(8, 8, 3), 8)[0, 0] for pixel in pixels]
    np.testing.assert_allclose(_errors_of(pixels), alone, rtol=1e-6)


def test_pictures_that_are_not_finite_end_no_process():
    """Under filters that make errors of NumPy's warnings."""
    lights = [jaxhf.Directional((1, 2, 1), irradiance=1e25)]
    scene = jaxhf.Scene([jaxhf.Object(jaxhf.Heightfield(waves(9, 8, 0.05)))], CAMERAS[0], lights)
    height, width = CAMERAS[0].height, CAMERAS[0].width
    here = expanded([scene], [np.zeros((height, width), np.float32)], noise=0.1)
    assert here.pictures()[0].max() > 1e20


@pytest.mark.deep
def test_the_sky_that_a_terrain_hides_is_what_render_takes(programs):
    """It is looked for once; terrains and pictures of two sizes, and other numbers of points, have the same programs."""
    sun, shared = jaxhf.Directional((1, 2, 1)), {"_draw_edges_of_any", "_made_world", "_rows_of_samples", "_rows_of_points"}
    for side, others in ((12, set()), (15, shared)):
        settings = jaxhf.Settings(samples=4, edge_samples=150 + 5 * side)
        heights = np.random.default_rng(side).uniform(0, 4, (side, side)).astype(np.float32)
        eye, target = (side / 2, -side, side), (side / 2, side / 2, 0.0)
        camera = jaxhf.Orthographic.look_at(eye, target, extent=side - 2.0, width=side, height=side)
        ground = [jaxhf.Object(jaxhf.Heightfield(heights, dx=1.0))]
        hidden, whole = (jaxhf.Scene(ground, camera, [sun, jaxhf.Sky(1.0, occlusion=n)]) for n in (8, None))
        programs.clear()
        here = expanded([hidden], [np.zeros((side, side))], settings=settings, noise=0.1)
        assert {name for name, _ in programs} & shared == shared - others
        shown = [np.asarray(jaxhf.render(scene.with_heights(here.heights), settings))[..., 0] for scene in (hidden, whole)]
        (known,) = here.linearised
        assert known is not None
        assert known.edges is not None
        once = np.isin(np.arange(side * side).reshape(side, side), known.edges.resampled, invert=True)
        assert 20 < once.sum() < once.size
        np.testing.assert_allclose(here.pictures()[0][0, ..., 0][once], shown[0][once], atol=1e-5)
        assert np.abs(shown[1] - shown[0]).max() > 0.1
