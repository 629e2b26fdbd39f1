"""Rays that leave a hit, `cast(..., leaving=hit)`: they meet what lies before them, and never the triangle that they leave."""

from collections.abc import Iterator

import aimed
import crossings
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compare import DOWN, SLACK, heightfield

import jaxhf

FLAT = jaxhf.Settings(shading="flat")
HITS, PART = 1000, 100  # and as many directions as hits at a time, so that all rays are of one program
ROUGH = aimed.Ground(aimed.random_heights((33, 17), 1.0, seed=3), dx=0.3, dy=2.0)
LEVEL = np.full((33, 17), 0.7)
TILTED = (0.25 * np.arange(17) - 0.5 * np.arange(33)[:, None]).astype(np.float32).astype(np.float64)


def hits_all_over(ground: aimed.Ground, dtype: type[np.floating], margin: float) -> tuple[jaxhf.Heightfield, jaxhf.Hit]:
    """From above and from below, inside of triangles, on edges and, without a margin (in cells), at vertices."""
    generator = np.random.default_rng(1)
    (u, v), kind = generator.uniform(margin, 1 - margin, (2, HITS)), generator.integers(0, 6, HITS)
    kind[(kind == 4) & (margin > 0)] = 5
    u, v = np.where((kind == 1) | (kind == 4), 1, u), np.where((kind == 2) | (kind == 4), 1, np.where(kind == 3, u, v))
    x, y = generator.integers(0, ground.cells, (HITS, 2)).T + np.stack([u, v])
    up = np.where(np.arange(HITS) % 2, 1, -1)[:, None]
    field = heightfield(ground, dtype)
    hit = jaxhf.cast(field, ground.points(x, y) + up * [0, 0, 3 * ground.range], up * DOWN, FLAT)
    np.testing.assert_array_equal(hit.status, jaxhf.Status.HIT)
    return field, hit


def parts(hit: jaxhf.Hit) -> Iterator[jaxhf.Hit]:
    """Some hits at a time, with an axis for directions."""
    for first in range(0, HITS, PART):
        yield jax.tree.map(lambda leaf, first=first: leaf[first : first + PART, None], hit)


def directions(seed: int) -> np.ndarray:
    """Unit vectors all round, float32 numbers."""
    d = np.random.default_rng(seed).normal(size=(PART, 3))
    return (d / np.linalg.norm(d, axis=1)[:, None]).astype(np.float32).astype(np.float64)


@pytest.mark.parametrize("heights", [LEVEL, TILTED], ids=["level", "tilted"])
@pytest.mark.parametrize(
    ("dtype", "times"),
    [
        (np.float32, 1),
        pytest.param(np.float32, 10, marks=pytest.mark.deep),
        pytest.param(np.float64, 10, marks=[pytest.mark.deep, pytest.mark.x64]),
    ],
)
def test_a_plane_is_left_for_good(heights, dtype, times):
    """1000 hits x 100 directions, or 1000, to both sides of the plane: nothing meets it again."""
    field, hit = hits_all_over(aimed.Ground(heights, dx=0.3, dy=2.0), dtype, 0.0)
    for part in parts(hit):
        for seed in range(times):
            status = jaxhf.cast(field, None, directions(seed), FLAT, leaving=part).status
            np.testing.assert_array_equal(status, np.full((PART, PART), jaxhf.Status.MISS))


@aimed.PRECISIONS
def test_rays_from_rough_terrain_agree_with_crossings(dtype):
    """In double precision, from the exact place on the triangle: none is lost, and none hits what is not there."""
    field, hit = hits_all_over(ROUGH, dtype, 0.05)
    found, near = 0, 0
    d = np.tile(directions(2), (PART, 1))
    for part in parts(hit):
        again = jaxhf.cast(field, None, d[:PART], FLAT, leaving=part)
        again = jax.tree.map(lambda leaf: leaf.reshape(PART * PART, *leaf.shape[2:]), again)
        met, t = np.asarray(again.status) == jaxhf.Status.HIT, np.asarray(again.t, np.float64)
        xy = np.asarray(part.uv, np.float64)[:, 0] * ROUGH.cells
        course = crossings.Course(ROUGH, ROUGH.points(*xy.T).repeat(PART, axis=0), d, SLACK[dtype])
        triangle = (np.asarray(leaf).repeat(PART, axis=0) for leaf in (part.cell[:, 0], part.triangle[:, 0]))
        side = np.sign((d * np.asarray(part.n, np.float64)[:, 0].repeat(PART, axis=0)).sum(1)).astype(int)
        assert not crossings.has_changed_sides(course, side, np.zeros(len(d)), t).any()  # up to the hit, or all the way
        # On the surface, and on the ray.
        height, rise = course.gap(np.where(met, t, 0)[:, None])
        assert np.all(np.abs(height) <= 2 * rise)
        # Some hit at once, where a neighbour stands in the way; they must be below it a thousandth of a cell further on.
        step = 1e-3 / np.abs(course.d[:, :2]).max(1)
        height, rise = course.gap((np.where(met, t, 0) + step)[:, None])
        at_once = met & (t < step)
        assert not np.any(at_once & (side * height[:, 0] > rise[:, 0]))
        same = (np.asarray(again.cell) == next(triangle)).all(1) & (np.asarray(again.triangle) == next(triangle))
        assert not np.any(met & same)
        np.testing.assert_array_equal(np.asarray(again.side)[met], side[met])
        found, near = found + met.sum(), near + at_once.sum()
    assert found > 0.2 * HITS * PART
    assert near > 100


def test_leaving_at_an_offset_costs_no_accuracy():
    """At 5e6 float32 has steps of 0.5, more than a cell: `p` is useless there, the place in the footprint is not."""
    x, y = np.random.default_rng(4).uniform(0.05, 0.95, (2, HITS))
    o = np.round(ROUGH.points(16 * x, 32 * y) * 2.0**10) / 2.0**10 + [0, 0, 9]  # so that an offset is added exactly
    results = []
    for at in (np.zeros(3), np.array([5e6, 4e6, 0])):
        field = jaxhf.Heightfield(ROUGH.heights.astype(np.float32), ROUGH.dx, ROUGH.dy, at[0], at[1])
        part = next(parts(jaxhf.cast(field, o + at, np.tile(DOWN, (HITS, 1)), FLAT)))
        results.append(jaxhf.cast(field, None, directions(2), FLAT, leaving=part))
    one, two = results
    for name in ("status", "t", "uv", "n", "cell", "triangle", "side"):
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name), name)
    assert np.sum(np.asarray(one.status) == jaxhf.Status.HIT) > 1000


RAMP = np.array([[0.0, 0.0, 0.0, 2.0]] * 2, np.float32)  # z = 0, and a wall of slope 2 from x = 2 to x = 3


@pytest.mark.deep  # rendering/test_cast.py has derivatives of hits
@pytest.mark.parametrize("mode", [jax.jacrev, jax.jacfwd])
def test_leaving_differentiates(mode):
    """dt by hand: from z = 0 at x along (1, 0, 1) to the wall, where z = t meets z = 2 (x + t - 2) at t = 4 - 2 x."""

    def travelled(heights, x):
        field = jaxhf.Heightfield(heights, 1.0)
        hit = jaxhf.cast(field, jnp.stack([x, jnp.asarray(0.25), jnp.asarray(9.0)]), DOWN, FLAT)
        return jaxhf.cast(field, None, np.array([1.0, 0, 1.0]), FLAT, leaving=hit).t

    x, heights = jnp.asarray(1.5), jnp.asarray(RAMP)
    to_heights, to_x = jax.jit(mode(travelled, (0, 1)))(heights, x)
    np.testing.assert_allclose(to_x, -2, rtol=1e-6)
    # The origin goes up with the surface; t = h (x + t - 2) at h = 2: dt (1 - h) = x + t - 2.
    np.testing.assert_allclose((to_heights.sum(), np.vdot(to_heights, RAMP / 2)), (0, -0.5), rtol=1e-6, atol=1e-6)


@pytest.mark.deep
def test_hits_and_directions_broadcast():
    """One hit and many directions, many hits and one; what leaves no hit is not valid."""
    field = jaxhf.Heightfield(RAMP, 1.0)
    o = np.array([[1.25, 0.25, 9.0], [1.5, 0.25, 9.0], [2.5, 0.25, -9.0], [3.5, 0.25, -9.0]])
    many = jaxhf.cast(field, o, np.array([[0, 0, -1], [0, 0, -1], [0, 0, 1], [0, 0, 1.0]]), FLAT)
    left = jaxhf.cast(field, None, np.array([1.0, 0, 1.0]), FLAT, leaving=many)
    np.testing.assert_allclose(left.t, [1.5, 1, np.inf, np.inf], rtol=1e-6)
    np.testing.assert_array_equal(left.status, [1, 1, jaxhf.Status.MISS, jaxhf.Status.INVALID])
    one = jax.tree.map(lambda leaf: leaf[1], many)
    again = jaxhf.cast(field, None, np.tile([1.0, 0, 1.0], (2, 2, 1)), FLAT, leaving=one)
    np.testing.assert_allclose(again.t, np.ones((2, 2)), rtol=1e-6)
    for o, leaving in ((None, None), (np.zeros(3), many)):
        with pytest.raises(ValueError, match="one of the two must be None"):
            jaxhf.cast(field, o, DOWN, leaving=leaving)
