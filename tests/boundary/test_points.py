"""Points on edges: how they are drawn, and that programs for any size draw those of programs for one."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxhf
from jaxhf.boundary.guiding import initial_weights, make_distribution, refined_weights
from jaxhf.boundary.points import Points, asked_for, draw_edges, draw_points
from jaxhf.preparation.localise import localise
from jaxhf.preparation.world import make_world, resolve_settings
from jaxhf.rendering.render import prepared_world
from jaxhf.trace.edges import STEPS, step_of
from jaxhf.xla.devices import local_mesh

ONE = local_mesh(1)
PLAIN = jaxhf.Settings(samples=1, edge_samples=0)


SIZES = (9, 12, 20, 16), (13, 7, 31, 24)


def scene(ny: int, nx: int, width: int, height: int, crowded: bool, dtype: Any = np.float32) -> jaxhf.Scene:
    """Steep bumps with a hole; crowded: and a second heightfield that throws shadows on them, by a second light, too."""
    heights = np.random.default_rng(ny).uniform(0, 1.5, (ny, nx)).astype(dtype)
    heights[1, 2] = np.nan
    fields = [jaxhf.Heightfield(heights, dx=1.0)]
    lights: list[Any] = [jaxhf.Directional((1, 2, 1))]
    if crowded:
        fields.append(jaxhf.Heightfield(3 + heights[:4, :5], dx=1.0))
        lights.append(jaxhf.Point((3.0, 3.0, 9.0)))
    camera = jaxhf.Perspective.look_at((-2.0, -3.0, 6.0), (nx / 2, ny / 2, 0.0), fov=50, width=width, height=height)
    return localise(jaxhf.Scene([jaxhf.Object(field) for field in fields], camera, lights))


def by_any(given: jaxhf.Scene, edge_samples: int) -> Points:
    """With 64 draws a chunk, so that there may be several; without what it has but room for."""
    settings = dataclasses.replace(resolve_settings(PLAIN, given), chunk=128)
    points = draw_points(prepared_world(given, settings), given.camera, ONE, edge_samples, still=False)
    chunks, draws = asked_for(edge_samples, settings)
    beyond = points.contributions.unpacked()[0].valid.at[:chunks, :draws].set(False)
    assert not beyond.any()
    return jax.tree.map(lambda leaf: leaf[:chunks, :, :draws], points)


def by_its_own(given: jaxhf.Scene, edge_samples: int) -> Points:
    settings = resolve_settings(jaxhf.Settings(samples=1, edge_samples=edge_samples, chunk=64), given)
    drawn: Any = jax.jit(lambda given: draw_edges(make_world(given, settings), given.camera, None, ONE))
    return drawn(given)


@pytest.mark.parametrize("crowded", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_a_program_for_any_size_draws_the_points_of_one_for_its_size(crowded, programs):
    """Of terrains and pictures of two sizes, and of two numbers of points: of one chunk, and of three."""
    given = [scene(*size, crowded) for size in SIZES]
    few, more = by_any(given[0], 160), by_any(given[1], 700)
    assert sum(name == "_draw_edges_of_any" for name, _ in programs) == 1
    for points, known, edge_samples in ((more, given[1], 700), (few, given[0], 160))[: 1 + crowded]:
        (mine, flow), expected = points.contributions.unpacked(), by_its_own(known, edge_samples)
        theirs, its_flow = expected.contributions.unpacked()
        valid = np.asarray(theirs.valid)
        chunks, draws = valid.shape
        assert valid.sum() > 20
        assert mine.valid.shape[0] == chunks
        np.testing.assert_array_equal(mine.valid[:, :draws], valid)
        assert not mine.valid[:, draws:].any()
        np.testing.assert_allclose(flow[:, :draws][valid], its_flow[valid], rtol=1e-3, atol=1e-4)
        for name in ("start", "end", "surface", "light", "receiver", "cell", "upper"):
            np.testing.assert_array_equal(getattr(mine, name)[:, :draws][valid], getattr(theirs, name)[valid], name)


def test_weights_are_refined_alike_in_both_precisions():
    """By 500 draws, some of them beyond all edges, so that both precisions go on to draw the same edges."""
    rng = np.random.default_rng(0)

    def refined(double: bool) -> np.ndarray:
        with jax.enable_x64(double):
            given = scene(*SIZES[0], crowded=False, dtype=np.float64 if double else np.float32)
            settings = resolve_settings(PLAIN, given)

            def weights(given: jaxhf.Scene, edge: jax.Array, found: jax.Array) -> jax.Array:
                world = make_world(given, settings)
                return refined_weights(world, initial_weights(world, given.camera), edge, found)

            return np.asarray(jax.jit(weights)(given, edge, jnp.asarray(found, given.camera.world_from_camera.dtype)))

    edge, found = rng.integers(0, 700, 500).astype(np.int32), rng.uniform(size=500)
    single, double = refined(False), refined(True)
    assert (single.dtype, double.dtype) == (np.float32, np.float64)
    assert (single > 0).sum() > 100
    np.testing.assert_allclose(single, double, rtol=1e-3, atol=1e-6)


def test_steps_along_edges_without_a_look_up_are_those_of_the_table():
    np.testing.assert_array_equal(jax.vmap(step_of)(jnp.arange(3)), STEPS)


def test_each_unit_of_weight_has_its_edge():
    """Against NumPy's search in the sums of all weights one by one; edges of no weight are passed over."""
    rng = np.random.default_rng(0)
    weights = np.where(rng.uniform(size=1000) < 0.3, rng.uniform(size=1000) ** 4, 0).astype(np.float32)
    weights[:3], weights[-5:] = 0, 0
    guiding = make_distribution(jnp.asarray(weights), 100)
    sums = np.cumsum(np.asarray(guiding.weights, np.int64))
    assert 100 * int(guiding.stratum) >= sums[-1] > 99 * int(guiding.stratum)
    ends = sums[np.nonzero(np.asarray(guiding.weights))[0]]
    chosen = np.unique([0, sums[-1] - 1, *ends[:-1], *(ends - 1), *rng.integers(0, sums[-1], 1000)])
    edge, weight, before = jax.vmap(guiding.at)(jnp.asarray(chosen, jnp.int32))
    expected = np.searchsorted(sums, chosen, side="right")
    np.testing.assert_array_equal(edge, expected)
    np.testing.assert_array_equal(weight, np.asarray(guiding.weights)[expected])
    np.testing.assert_array_equal(before, sums[expected] - np.asarray(guiding.weights)[expected])


def test_distribution_is_exact_in_single_precision():
    """A million weights of which a few are large: a running sum in single precision would lose the small ones."""
    weights = np.full(2**20, 1e-9, np.float32)
    weights[::65536] = 1
    guiding = make_distribution(jnp.asarray(weights), jnp.asarray(1000, jnp.int32))
    integers = np.asarray(guiding.weights, np.int64)
    assert integers.min() == 1
    np.testing.assert_allclose(integers[::65536], 2**30 / 16, rtol=2e-3)
    assert 1000 * int(guiding.stratum) >= integers.sum()
    assert integers.sum() < 2**31
