"""Rays that leave a hit, `cast(..., leaving=hit)`: they meet what lies before them, and never the triangle that they leave."""

import aimed
import crossings
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compare import DOWN, SLACK

import jaxhf

FLAT = jaxhf.Settings(shading="flat")
HITS, PART = 1000, 100
ROUGH = aimed.Ground(aimed.random_heights((33, 17), 1.0, seed=3), dx=0.3, dy=2.0)
TILTED = (0.25 * np.arange(17) - 0.5 * np.arange(33)[:, None]).astype(np.float32).astype(np.float64)


def hits_all_over(ground: aimed.Ground, dtype: type[np.floating], margin: float) -> tuple[jaxhf.Heightfield, jaxhf.Hit]:
    """From above and from below, inside of triangles, on edges and, without a margin (in cells), at vertices."""
    generator = np.random.default_rng(1)
    (u, v), kind = generator.uniform(margin, 1 - margin, (2, HITS)), generator.integers(0, 6, HITS)
    kind[(kind == 4) & (margin > 0)] = 5
    u, v = np.where((kind == 1) | (kind == 4), 1, u), np.where((kind == 2) | (kind == 4), 1, np.where(kind == 3, u, v))
    x, y = generator.integers(0, ground.cells, (HITS, 2)).T + np.stack([u, v])
    up = np.where(np.arange(HITS) % 2, 1, -1)[:, None]
    field = jaxhf.Heightfield(ground.heights.astype(dtype), *ground[1:])
    hit = jaxhf.cast(field, ground.points(x, y) + up * [0, 0, 3 * ground.range], up * DOWN, FLAT)
    np.testing.assert_array_equal(hit.status, jaxhf.Status.HIT)
    return field, hit


def parts(hit: jaxhf.Hit):
    """Some hits at a time, with an axis for directions."""
    for first in range(0, HITS, PART):
        yield jax.tree.map(lambda leaf, first=first: leaf[first : first + PART, None], hit)


def directions(count: int) -> np.ndarray:
    """Unit vectors all round, float32 numbers."""
    d = np.random.default_rng(2).normal(size=(count, 3))
    return (d / np.linalg.norm(d, axis=1)[:, None]).astype(np.float32).astype(np.float64)


@pytest.mark.parametrize(("dtype", "count"), [(np.float32, 1000), (np.float64, 100)])
@pytest.mark.parametrize("heights", [np.full((33, 17), 0.7), TILTED])
def test_a_plane_is_left_for_good(heights, dtype, count):
    """1000 hits x 1000 directions, to both sides of the plane: nothing meets it again."""
    field, hit = hits_all_over(aimed.Ground(heights, dx=0.3, dy=2.0), dtype, 0.0)
    for part in parts(hit):
        status = jaxhf.cast(field, None, directions(count), FLAT, leaving=part).status
        np.testing.assert_array_equal(status, np.full((PART, count), jaxhf.Status.MISS))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_rays_from_rough_terrain_agree_with_crossings(dtype):
    """In double precision, from the exact place on the triangle: none is lost, and none hits what is not there."""
    field, hit = hits_all_over(ROUGH, dtype, 0.05)
    count, found, near = 100, 0, 0
    d = np.tile(directions(count), (PART, 1))
    for part in parts(hit):
        again = jax.tree.map(
            lambda leaf: leaf.reshape(PART * count, *leaf.shape[2:]), jaxhf.cast(field, None, d[:count], FLAT, leaving=part)
        )
        met, t = np.asarray(again.status) == jaxhf.Status.HIT, np.asarray(again.t, np.float64)
        xy = np.asarray(part.uv, np.float64)[:, 0] * ROUGH.cells
        course = crossings.Course(ROUGH, ROUGH.points(*xy.T).repeat(count, axis=0), d, SLACK[dtype])
        triangle = (np.asarray(leaf).repeat(count, axis=0) for leaf in (part.cell[:, 0], part.triangle[:, 0]))
        side = np.sign((d * np.asarray(part.n, np.float64)[:, 0].repeat(count, axis=0)).sum(1)).astype(int)
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
    assert found > 0.2 * HITS * count
    assert near > 100


def test_leaving_at_an_offset_costs_no_accuracy():
    """At 5e6 float32 has steps of 0.5, more than a cell: `p` is useless there, the place in the footprint is not."""
    far = ROUGH._replace(x0=5e6, y0=4e6)
    d = directions(20)
    results = []
    for ground in (ROUGH, far):
        field = jaxhf.Heightfield(ground.heights.astype(np.float32), *ground[1:])
        o = np.add([1.1, 31.7, 9.0], [ground.x0, ground.y0, 0])
        results.append(jaxhf.cast(field, None, d, leaving=jaxhf.cast(field, o, DOWN)))
    one, two = results
    for name in ("status", "t", "uv", "n", "cell", "triangle", "side"):
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name), name)
    assert np.sum(np.asarray(one.status) == jaxhf.Status.HIT) > 3


def test_leaving_broadcasts_and_differentiates():
    """One hit and many directions, many and one; and dt by hand: from z = 0 at x along (1, 0, 1) to a wall of slope 2."""
    heights = jnp.array([[0.0, 0.0, 0.0, 2.0]] * 2)

    def travelled(heights, x):
        field = jaxhf.Heightfield(heights, 1.0)
        hit = jaxhf.cast(field, jnp.stack([x, jnp.asarray(0.25), jnp.asarray(9.0)]), DOWN, FLAT)
        return jaxhf.cast(field, None, np.array([1.0, 0, 1.0]), FLAT, leaving=hit).t

    # z = t meets z = 2 (x + t - 2) at t = 4 - 2 x.
    x = jnp.asarray(1.5)
    t, (to_heights, to_x) = jax.jit(jax.value_and_grad(travelled, (0, 1)))(heights, x)
    np.testing.assert_allclose(t, 1.0, rtol=1e-14)
    np.testing.assert_allclose(to_x, -2.0, rtol=1e-14)

    @jax.jit
    def along(change):
        return jax.jvp(lambda z: travelled(z, x), (heights,), (change,))[1]

    lift, tilt = jnp.ones_like(heights), jnp.array([[0.0, 0, 0, 1]] * 2)
    np.testing.assert_allclose(along(lift), 0, atol=1e-14)  # the origin goes up with the surface
    np.testing.assert_allclose(along(tilt), -0.5, rtol=1e-14)  # t = h (x + t - 2) at h = 2: dt (1 - h) = x + t - 2
    np.testing.assert_allclose([jnp.vdot(to_heights, lift), jnp.vdot(to_heights, tilt)], [0, -0.5], atol=1e-14)

    field = jaxhf.Heightfield(heights, 1.0)
    one = jaxhf.cast(field, [1.5, 0.25, 9.0], DOWN, FLAT)
    many = jaxhf.cast(
        field, np.array([[1.25, 0.25, 9.0], [1.5, 0.25, 9.0], [2.5, 0.25, -9.0]]), [[0, 0, -1], [0, 0, -1], [0, 0, 1]]
    )
    assert jaxhf.cast(field, None, np.ones((4, 5, 3)), FLAT, leaving=one).t.shape == (4, 5)
    np.testing.assert_allclose(jaxhf.cast(field, None, np.array([1.0, 0, 1.0]), FLAT, leaving=many).t, [1.5, 1, np.inf])


def test_leaving_what_is_no_hit_is_invalid():
    field = jaxhf.Heightfield(np.zeros((2, 2)), 1.0)
    hit = jaxhf.cast(field, [[0.5, 0.25, 1.0], [2.5, 0.25, 1.0]], DOWN, FLAT)
    status = jaxhf.cast(field, None, -DOWN, FLAT, leaving=hit).status
    np.testing.assert_array_equal(status, [jaxhf.Status.MISS, jaxhf.Status.INVALID])
    for o, leaving in ((None, None), (np.zeros(3), hit)):
        with pytest.raises(ValueError, match="one of the two must be None"):
            jaxhf.cast(field, o, DOWN, leaving=leaving)
