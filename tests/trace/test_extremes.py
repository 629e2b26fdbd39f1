"""`cast` at the extremes: a right answer or a clear status, never a nan."""

import re

import aimed
import jax
import jax.numpy as jnp
import numpy as np
import oracle
import pytest
from compare import COUNT, DOWN, DTYPES, ROUGH, compare_with_oracle, every_family, heightfield, numpied

import jaxhf
import jaxhf.mujoco


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("scale", [1e-20, 1e20])
def test_extreme_heights(scale, dtype):
    ground = aimed.Ground(aimed.random_heights((33, 17), scale, seed=5), dx=0.5, dy=2.0)
    rays, names = every_family(ground, seed=6)
    expected, _ = compare_with_oracle(ground, rays, names, dtype)
    assert np.sum(expected.decided & (expected.status == oracle.HIT)) > 300


@pytest.mark.parametrize("dtype", DTYPES)
def test_invalid_rays(dtype):
    bad = [np.nan, np.inf, -np.inf]
    o, d = np.tile([0.0, 11.0, 5.0], (COUNT, 1)), np.tile(DOWN, (COUNT, 1))
    for k in range(9):
        o[k, k // 3] = bad[k % 3]
        d[9 + k, k // 3] = bad[k % 3]
    d[18] = 0
    hit = numpied(jaxhf.cast(heightfield(ROUGH, dtype), o, d))
    np.testing.assert_array_equal(hit["status"][:19], jaxhf.Status.INVALID)
    np.testing.assert_array_equal(hit["status"][19:], jaxhf.Status.HIT)
    for name, value in hit.items():
        assert np.all(np.isposinf(value[:19]) if name == "t" else np.isfinite(value)), name


def test_a_hole_lets_rays_through():
    heights = np.zeros((4, 5))
    heights[1, 2], heights[:, 3:] = np.nan, 2.0
    x, y = np.meshgrid(np.arange(4) + 0.5, np.arange(3) + 0.25)
    o, d = np.stack([x.ravel(), y.ravel(), np.full(12, 3.0)], axis=1), np.broadcast_to(DOWN, (12, 3))
    # Across the hole, over and under the sheet behind it: the side on which the ray stands is found anew.
    across = np.array([[0.5, 0.5, 2.75], [0.5, 0.5, 0.5]]), np.array([[1.0, 0.0, -0.25], [1.0, 0.0, 0.0]])
    o, d = np.concatenate([o, across[0]]), np.concatenate([d, across[1]])
    hit = jaxhf.cast(jaxhf.Heightfield(heights.astype(np.float32), 1.0), o, d)
    np.testing.assert_array_equal(hit.status[:12].reshape(3, 4), [[1, 0, 0, 1], [1, 0, 0, 1], [1, 1, 1, 1]])
    np.testing.assert_array_equal(hit.status[12:], [jaxhf.Status.HIT, jaxhf.Status.MISS])
    np.testing.assert_allclose(hit.t[12], 3, rtol=4 * float(np.finfo(np.float32).eps))


def test_nothing_but_holes_is_never_hit():
    rays, _ = every_family(ROUGH, seed=21)
    status = jaxhf.cast(heightfield(ROUGH._replace(heights=np.full_like(ROUGH.heights, np.nan))), rays.o, rays.d).status
    np.testing.assert_array_equal(status, jaxhf.Status.MISS)


@pytest.mark.parametrize("dtype", DTYPES)
def test_where_the_ray_starts(dtype):
    """Over z = |x| on a grid whose numbers are all exact: above, below, on a flank, on the ridge, in front of its end."""
    x, _ = np.meshgrid(np.arange(-4.0, 5), np.arange(4))
    field = jaxhf.Heightfield(np.abs(x).astype(dtype), 1.0, 1.0, x0=-4.0)
    cases = [  # origin, direction, t
        ((2.5, 1.5, 3.5), (0, 0, -1), 1.0),  # above, inside the box
        ((2.5, 1.5, 1.5), (0, 0, 1), 1.0),  # below, inside the box
        ((2.5, 1.5, 1.5), (0, 0, -1), np.inf),
        ((2.5, 1.5, -3.0), (0, 0, 2), 2.75),  # below the box
        ((0.5, 1.5, 2.0), (2, 0, 0), 0.75),  # between the flanks
        ((-3.0, 1.5, 2.0), (1, 0, 0), 1.0),  # under one flank: its back first
        ((2.0, 1.5, 2.0), (-1, 0, 0), 4.0),  # on a flank: not at t = 0, but across the valley
        ((2.0, 1.5, 2.0), (-1, 0, -1.5), np.inf),  # on a flank and through it
        ((2.0, 1.5, 2.0), (0, 0, 1), np.inf),
        ((2.0, 1.5, 2.0), (0, 0, -1), np.inf),
        ((2.0, 1.5, 2.0), (1, 0, 1), np.inf),  # in the plane of the flank
        ((0.0, 1.5, 0.0), (1, 0, 0.5), np.inf),  # in the bottom of the valley, and under it
        ((0.0, 1.5, 0.0), (1, 0.25, 2), np.inf),  # and out of it
        ((-5.0, 1.5, 0.5), (1, 0, 0), 4.5),  # from outside, in under a flank and through its back
        ((5.0, 1.5, 7.0), (-1, 0, -2), 2.0),  # from outside, over the end of a flank
    ]
    o, d, t = (np.array(values, np.float64) for values in zip(*cases, strict=True))
    hit = numpied(jaxhf.cast(field, o, d))
    np.testing.assert_array_equal(hit["status"], np.where(np.isfinite(t), jaxhf.Status.HIT, jaxhf.Status.MISS))
    np.testing.assert_allclose(hit["t"], t, rtol=4 * float(np.finfo(dtype).eps))


@pytest.mark.parametrize("dtype", DTYPES)
def test_flat_field(dtype):
    """z = 7, where the box of the surface has no height."""
    generator = np.random.default_rng(15)
    field = jaxhf.Heightfield(np.full((6, 8), 7, dtype), 0.5, 2.0, x0=-1.0, y0=3.0)
    target = np.column_stack([generator.uniform(-0.9, 2.4, 200), generator.uniform(3.1, 12.9, 200), np.full(200, 7.0)])
    o = target + generator.uniform(-4, 4, (200, 3))
    beside = np.array([[-3.0, 5.0, 7.0], [0.0, 5.0, 7.0], [-3.0, 5.0, 7.5], [0.0, 5.0, 8.0], [0.0, 5.0, 6.0]])
    away = np.array([[1.0, 0.1, 0.0], [1.0, 0.1, 0.0], [1.0, 0.1, 0.0], [0.0, 0.0, 1.0], [1.0, 2.0, -1.0]])
    hit = numpied(jaxhf.cast(field, np.concatenate([o, beside]), np.concatenate([target - o, away])))
    np.testing.assert_array_equal(hit["status"], np.repeat([jaxhf.Status.HIT, jaxhf.Status.MISS], [200, 5]))
    # o is rounded relative to the largest distance, 20, over the smallest step towards the plane.
    np.testing.assert_allclose(hit["t"][:200], 1, rtol=float(np.finfo(dtype).eps) * 20 / np.abs(o[:, 2] - 7).min())
    np.testing.assert_array_equal(hit["n"][:200], [[0, 0, 1]] * 200)
    np.testing.assert_array_equal(hit["side"][:200], np.where(o[:, 2] > 7, 1, -1))


@pytest.mark.parametrize("dtype", DTYPES)
def test_exactly_on_the_border(dtype):
    """The footprint is closed: vertical rays at border vertices and edges hit where all numbers are exact, and none beside."""
    ground = aimed.Ground(aimed.random_heights((5, 4), 1.0, seed=16), dx=0.5, dy=2.0)
    x, y = (values.ravel() for values in np.meshgrid(np.arange(0, 3.25, 0.25), np.arange(0, 4.25, 0.25)))
    rim = (x == 0) | (x == 3) | (y == 0) | (y == 4)
    outwards = np.stack([np.sign(x - 1.5) * (abs(x - 1.5) == 1.5), np.sign(y - 2) * (abs(y - 2) == 2), 0 * x], axis=1)[rim]
    o = ground.points(x[rim], y[rim]) + np.array([0, 0, 3])
    for start, expected in ((o, jaxhf.Status.HIT), (o + 1e-5 * outwards, jaxhf.Status.MISS)):
        status = jaxhf.cast(heightfield(ground, dtype), start, np.broadcast_to(DOWN, o.shape)).status
        np.testing.assert_array_equal(status, expected)


@pytest.mark.parametrize(("offset", "cell"), [((449_000.5, 5.4e6, 0), (0.5, 2.0)), ((5e6, 5e6, 0), (1.0, 1.0))])
def test_an_offset_costs_no_accuracy(offset, cell):
    """In UTM coordinates and single precision the same bits as at the origin, when the rays are NumPy's."""
    offset = np.array(offset)
    near, far = (aimed.Ground(ROUGH.heights, *cell, *corner[:2].tolist()) for corner in (0 * offset, offset))
    rays, _ = every_family(near, seed=18)
    o = np.round(rays.o * 2.0**10) / 2.0**10  # so that adding the offset is exact in double precision
    one, two = (numpied(jaxhf.cast(heightfield(g, np.float32), o + np.array([g.x0, g.y0, 0]), rays.d)) for g in (near, far))
    for name in set(one) - {"p"}:
        np.testing.assert_array_equal(one[name], two[name], err_msg=name)
    assert np.sum(one["status"] == jaxhf.Status.HIT) > 300
    np.testing.assert_allclose(two["p"], one["p"] + offset, atol=0.25 + 1e-3)  # there float32 has steps of 0.5


def test_length_of_the_direction_does_not_matter():
    """t scales with it; powers of two change no bit, from one end of single precision's range to the other."""
    rays, _ = every_family(ROUGH, seed=19)
    d = rays.d / 2.0 ** np.floor(np.log2(np.abs(rays.d).max(1)))[:, None]
    d = np.where(np.abs(d) < 1e-6, 0, d)  # the smallest components must not get lost
    field = heightfield(ROUGH, np.float32)
    plain = numpied(jaxhf.cast(field, rays.o, d))
    for exponent in (-90, 90):
        scaled = numpied(jaxhf.cast(field, rays.o, d * 2.0**exponent))
        for name in plain:
            np.testing.assert_array_equal(scaled[name] * (2.0**exponent if name == "t" else 1), plain[name], err_msg=name)


@pytest.mark.parametrize("dtype", DTYPES)
def test_from_a_million_widths_away(dtype):
    """Straight down the place is exact. From elsewhere single precision is off by a tenth of the grid: the middle is hit."""
    ground, generator = ROUGH._replace(x0=0.0, y0=0.0), np.random.default_rng(23)
    away = 1e6 * float(max(ground.cells * [ground.dx, ground.dy]))
    x, y = (generator.uniform(0.01, cells - 0.01, COUNT) for cells in ground.cells)
    target, up = ground.points(x, y), np.where(np.arange(COUNT) % 2, 1, -1)[:, None]
    hit = numpied(jaxhf.cast(heightfield(ground, dtype), target + up * [0, 0, away], up * DOWN))
    np.testing.assert_array_equal(hit["status"], jaxhf.Status.HIT)
    np.testing.assert_allclose(hit["uv"] * ground.cells, np.stack([x, y], axis=1), atol=32 * float(np.finfo(dtype).eps))
    np.testing.assert_allclose(hit["p"], target, atol=128 * float(np.finfo(dtype).eps) * ground.slope)
    np.testing.assert_array_equal(hit["side"], up[:, 0])
    np.testing.assert_allclose(hit["t"], away, rtol=2 * float(np.finfo(dtype).eps))

    d = generator.normal(size=(COUNT, 3))
    d = (d / np.linalg.norm(d, axis=1)[:, None]).astype(np.float32).astype(np.float64)
    if dtype is np.float64:
        rays = aimed.Rays(target - away * d, d, np.full(COUNT, aimed.OPEN))
        assert compare_with_oracle(ground, rays, np.full(COUNT, "far"), dtype)[0].decided.all()
    uv, steep = generator.uniform(0.3, 0.7, (2, COUNT)), np.add(d, [0, 0, -10])
    hit = numpied(
        jaxhf.cast(heightfield(ground, dtype), ground.points(*(ground.cells[:, None] * uv)) - away / 10 * steep, steep)
    )
    np.testing.assert_array_equal(hit["status"], jaxhf.Status.HIT)
    np.testing.assert_allclose(hit["uv"], uv.T, atol=0.15 if dtype is np.float32 else 1e-9)  # 0.5 of 8, and 4 / 10 by z


MANY = jax.ShapeDtypeStruct((600, 1025, 1025), jnp.float32)  # whose bounds are 600 * 4192256 > 2^31 numbers
STARTS = jnp.ones((600, 1, 3), jnp.float32)


def of_batch(heights):
    return jaxhf.cast(jax.vmap(lambda z: jaxhf.Heightfield(z, 1.0))(heights), STARTS, DOWN).t


def of_prepared(heights):
    return jaxhf.cast(jaxhf.prepare(jax.vmap(lambda z: jaxhf.Heightfield(z, 1.0))(heights)), STARTS, DOWN).t


def of_hfields(heights):
    return jaxhf.mujoco.ray(jaxhf.mujoco.HField(heights, np.ones(4)), STARTS, DOWN)[0]


@pytest.mark.parametrize("traced", [of_batch, of_prepared, of_hfields])
def test_places_in_what_heightfields_share_are_32_bit_integers(traced):
    """Shapes alone: so few share their arrays that no place overflows."""
    arrays = [int(size) for size in re.findall(r"f32\[(\d+)\]", str(jax.make_jaxpr(traced)(MANY)))]
    assert 2**25 < max(arrays) < 2**31


def test_more_heightfields_than_32_bits_address_are_refused():
    cast = jax.vmap(lambda z, o: jaxhf.cast(jaxhf.Heightfield(z, 1.0), o, DOWN).t)
    message = "^600 heightfields under a vmap share an array of 2515353600 numbers, at most 2147483647 can be addressed"
    with pytest.raises(ValueError, match=message):
        jax.eval_shape(cast, MANY, STARTS)
    assert jax.eval_shape(cast, jax.ShapeDtypeStruct((512, 1025, 1025), jnp.float32), STARTS[:512]).shape == (512, 1)


def random_bits(seed: int) -> np.ndarray:
    """(33, 17) float32 numbers of all magnitudes, with nan, infinities, zeros of both signs and denormals."""
    heights = np.random.default_rng(seed).integers(0, 2**32, (33, 17), dtype=np.uint32).view(np.float32).copy()
    heights[3:6, 3] = np.nan, np.inf, -np.inf
    heights[3:7, 9] = 0.0, -0.0, 1e-45, -1e-40
    return heights


@pytest.mark.parametrize("traversal", ["pyramid", "dda"])
def test_heights_of_random_bits(traversal):
    """Down and up through every triangle: a cell is hit where its four heights are finite, and nowhere else."""
    for seed in range(4):
        heights = random_bits(seed)
        ix, iy = (values.ravel() for values in np.meshgrid(np.arange(16), np.arange(32)))
        present = np.isfinite([heights[iy + j, ix + i] for j in (0, 1) for i in (0, 1)]).all(0)
        assert 8 < np.sum(~present) < 50
        for triangle, (u, v) in enumerate([(0.75, 0.25), (0.25, 0.75)]):
            for up in (1, -1):
                o = np.stack([(ix + u) * 0.5, (iy + v) * 2.0, np.full(ix.size, up * 3.4e38)], axis=1)
                settings = jaxhf.Settings(traversal=traversal, shading="flat")
                hit = numpied(jaxhf.cast(jaxhf.Heightfield(heights, 0.5, 2.0), o, np.array([0, 0, -up * 2.0**10]), settings))
                np.testing.assert_array_equal(hit["status"], np.where(present, jaxhf.Status.HIT, jaxhf.Status.MISS))
                np.testing.assert_array_equal(hit["cell"][present], np.stack([ix, iy], axis=1)[present])
                np.testing.assert_array_equal(hit["triangle"][present], triangle)
                for name in ("t", "n", "ns", "uv"):  # `p` and the tangents may be larger than any float32
                    assert np.isfinite(hit[name][present]).all(), name


@pytest.mark.parametrize("dtype", DTYPES)
def test_rays_over_random_bits(dtype):
    """As far as the range of heights leaves float32 room for slopes and areas."""
    heights = random_bits(0).astype(np.float64)
    ground = aimed.Ground(np.where(np.abs(heights) < 2.0**110, heights, 0), 0.5, 2.0)
    rays, names = every_family(ground, seed=24)
    expected, _ = compare_with_oracle(ground, rays, names, dtype)
    assert np.sum(expected.decided & (expected.status == oracle.HIT)) > 200


@pytest.mark.parametrize("dtype", DTYPES)
def test_tiny_components_of_a_direction(dtype):
    """A zero of either sign and a denormal number count as nothing; a direction of nothing else is not valid."""
    o, tiny = np.array([0.1, 20.3, 5.0]), float(np.finfo(dtype).smallest_normal) / 16
    d = np.array([[0, 0, -1], [-0.0, -0.0, -1], [tiny, -tiny, -1], [-tiny, 0, -1], [tiny, 0, -tiny], [0, 0, tiny]])
    hit = numpied(jaxhf.cast(heightfield(ROUGH, dtype), o, d))
    np.testing.assert_array_equal(hit["status"], [jaxhf.Status.HIT] * 4 + [jaxhf.Status.INVALID] * 2)
    for name, value in hit.items():
        np.testing.assert_array_equal(value[1:4], value[[0, 0, 0]], name)
        assert name == "t" or np.isfinite(value).all(), name
