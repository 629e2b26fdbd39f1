"""`cast` at the extremes: a right answer or a clear status, never a nan.

All fields have the shape of ROUGH and its cells, and all batches COUNT rays, so that two programs do for nearly everything.
"""

import re

import aimed
import jax
import jax.numpy as jnp
import numpy as np
import oracle
import pytest
from compare import COUNT, DOWN, ROUGH, compare_with_oracle, every_family, heightfield, numpied

import jaxhf
import jaxhf.mujoco

HIT, MISS, INVALID = jaxhf.Status.HIT, jaxhf.Status.MISS, jaxhf.Status.INVALID
AT_ZERO = ROUGH._replace(x0=0.0, y0=0.0)


def cast(field: jaxhf.Heightfield, o, d, settings: jaxhf.Settings | None = None) -> dict[str, np.ndarray]:
    """`jaxhf.cast` with rays padded to COUNT: any other number would be compiled anew."""
    o, d = np.broadcast_arrays(np.asarray(o, float), d)
    o, d = (np.concatenate([v, np.broadcast_to(v[0], (COUNT - len(v), 3))]) for v in (o, d))
    return numpied(jaxhf.cast(field, o, d, settings))


def field_of(heights: np.ndarray, dtype=np.float32, **corner: float) -> jaxhf.Heightfield:
    return jaxhf.Heightfield(heights.astype(dtype), ROUGH.dx, ROUGH.dy, **corner)


@aimed.PRECISIONS
def test_invalid_rays(dtype):
    bad = [np.nan, np.inf, -np.inf]
    o, d = np.tile([0.0, 11.0, 5.0], (COUNT, 1)), np.tile(DOWN, (COUNT, 1))
    for k in range(9):
        o[k, k // 3] = bad[k % 3]
        d[9 + k, k // 3] = bad[k % 3]
    d[18] = 0
    hit = cast(heightfield(ROUGH, dtype), o, d)
    np.testing.assert_array_equal(hit["status"], np.where(np.arange(COUNT) < 19, INVALID, HIT))
    for name, value in hit.items():
        assert np.all(np.isposinf(value[:19]) if name == "t" else np.isfinite(value)), name


def test_where_all_are_holes_nothing_is_met():
    hit = cast(field_of(np.full((33, 17), np.nan)), every_family(AT_ZERO, seed=21)[0].o, DOWN)
    np.testing.assert_array_equal(hit["status"], MISS)


def test_a_large_hole_is_passed_by():
    """By rays that begin within it, too: as cell by cell, in a fraction of the steps."""
    rng = np.random.default_rng(5)
    heights = rng.uniform(size=(70, 130)).astype(np.float32)
    heights[3:60, 5:110] = np.nan
    heights[20:24, 60:65] = rng.uniform(size=(4, 5))  # an island
    o, to = rng.uniform((6, 4, 0.2), (108, 58, 0.8), (2, 4000, 3)).astype(np.float32)
    field = jaxhf.Heightfield(heights, 1.0, 1.0)
    all_cells = jaxhf.cast(field, o, to - o, jaxhf.Settings(traversal="dda"))
    few_steps = jaxhf.cast(field, o, to - o, jaxhf.Settings(max_steps=64))
    met = np.asarray(all_cells.status) == HIT
    np.testing.assert_array_equal(few_steps.status, all_cells.status)
    for one, other in zip(jax.tree.leaves(all_cells), jax.tree.leaves(few_steps), strict=True):
        np.testing.assert_array_equal(np.asarray(one)[met], np.asarray(other)[met])
    assert 800 < met.sum() < 3200


@aimed.PRECISIONS
def test_where_the_ray_starts(dtype):
    """Over z = |x| on a grid whose numbers are all exact: above, below, on a flank, on the ridge, in front of its end."""
    field = field_of(np.tile(np.abs(np.linspace(-4, 4, 17)), (33, 1)), dtype, x0=-4.0)
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
    hit = cast(field, o, d)
    np.testing.assert_array_equal(hit["status"][: len(t)], np.where(np.isfinite(t), HIT, MISS))
    np.testing.assert_allclose(hit["t"][: len(t)], t, rtol=4 * float(np.finfo(dtype).eps))


@aimed.PRECISIONS
def test_exactly_on_the_border(dtype):
    """The footprint is closed: vertical rays at border vertices and edges hit where all numbers are exact, and none beside."""
    x, y = (values.ravel() for values in np.meshgrid(np.arange(0, 16.25, 0.25), np.arange(0, 32.25, 0.25)))
    outwards = np.stack([(x == 16) * 1.0 - (x == 0), (y == 32) * 1.0 - (y == 0), 0 * x], axis=1)
    rim = outwards.any(axis=1)
    o = AT_ZERO.points(x[rim], y[rim]) + np.array([0, 0, 3])
    status = cast(heightfield(AT_ZERO, dtype), np.concatenate([o, o + 1e-5 * outwards[rim]]), DOWN)["status"]
    np.testing.assert_array_equal(status[: 2 * len(o)], np.repeat([HIT, MISS], len(o)))


@pytest.mark.parametrize("offset", [(449_000.5, 5.4e6, 0), (5e6, 5e6, 0)])
def test_an_offset_costs_no_accuracy(offset):
    """In UTM coordinates the same bits as at the origin, when the rays are NumPy's."""
    rays, _ = every_family(AT_ZERO, seed=18)
    o = np.round(rays.o * 2.0**10) / 2.0**10  # so that adding the offset is exact in double precision
    one, two = (cast(field_of(ROUGH.heights, x0=at[0], y0=at[1]), o + at, rays.d) for at in (np.zeros(3), np.array(offset)))
    for name in set(one) - {"p"}:
        np.testing.assert_array_equal(one[name], two[name], err_msg=name)
    assert np.sum(one["status"] == HIT) > 300
    np.testing.assert_allclose(two["p"], one["p"] + offset, atol=0.25 + 1e-3)  # there float32 has steps of 0.5


def test_length_of_the_direction_does_not_matter():
    """t scales with it; powers of two change no bit, from one end of single precision's range to the other."""
    rays, _ = every_family(ROUGH, seed=19)
    d = rays.d / 2.0 ** np.floor(np.log2(np.abs(rays.d).max(1)))[:, None]
    d = np.where(np.abs(d) < 1e-6, 0, d)  # the smallest components must not get lost
    field = heightfield(ROUGH, np.float32)
    plain = cast(field, rays.o, d)
    for exponent in (-90, 90):
        scaled = cast(field, rays.o, d * 2.0**exponent)
        for name in plain:
            np.testing.assert_array_equal(scaled[name] * (2.0**exponent if name == "t" else 1), plain[name], err_msg=name)


@aimed.PRECISIONS
def test_from_a_million_widths_away(dtype):
    """Straight down the place is exact. From elsewhere single precision is off by a tenth of the grid: the middle is hit."""
    field, generator, eps = heightfield(AT_ZERO, dtype), np.random.default_rng(23), float(np.finfo(dtype).eps)
    cells = AT_ZERO.cells
    away = 1e6 * float(max(cells * [ROUGH.dx, ROUGH.dy]))
    x, y = (generator.uniform(0.01, size - 0.01, COUNT) for size in cells)
    target, up = AT_ZERO.points(x, y), np.where(np.arange(COUNT) % 2, 1, -1)[:, None]
    hit = cast(field, target + up * [0, 0, away], up * DOWN)
    np.testing.assert_array_equal(hit["status"], HIT)
    np.testing.assert_allclose(hit["uv"] * cells, np.stack([x, y], axis=1), atol=32 * eps)
    np.testing.assert_allclose(hit["p"], target, atol=128 * eps * ROUGH.slope)
    np.testing.assert_array_equal(hit["side"], up[:, 0])
    np.testing.assert_allclose(hit["t"], away, rtol=2 * eps)

    d = generator.normal(size=(COUNT, 3))
    d = (d / np.linalg.norm(d, axis=1)[:, None]).astype(np.float32).astype(np.float64)
    if dtype is np.float64:
        rays = aimed.Rays(target - away * d, d, np.full(COUNT, aimed.OPEN))
        assert compare_with_oracle(AT_ZERO, rays, np.full(COUNT, "far"), dtype)[0].decided.all()
    uv, steep = generator.uniform(0.3, 0.7, (2, COUNT)), np.add(d, [0, 0, -10])
    hit = cast(field, AT_ZERO.points(*(cells[:, None] * uv)) - away / 10 * steep, steep)
    np.testing.assert_array_equal(hit["status"], HIT)
    np.testing.assert_allclose(hit["uv"], uv.T, atol=0.15 if dtype is np.float32 else 1e-9)  # 0.5 of 8, and 4 / 10 by z


MANY = jax.ShapeDtypeStruct((600, 1025, 1025), jnp.float32)  # whose bounds are 600 * 4192256 > 2^31 numbers


def start() -> jax.Array:
    return jnp.ones((600, 1, 3), jnp.float32)


def fields(heights) -> jaxhf.Heightfield:
    return jax.vmap(lambda z: jaxhf.Heightfield(z, 1.0))(heights)


OF_MANY = {
    "batch": lambda z: jaxhf.cast(fields(z), start(), DOWN).t,
    "prepared": lambda z: jaxhf.cast(jaxhf.prepare(fields(z)), start(), DOWN).t,
    "hfields": lambda z: jaxhf.mujoco.ray(jaxhf.mujoco.HField(z, np.ones(4)), start(), DOWN).dist,
}


@pytest.mark.parametrize("name", OF_MANY)
def test_places_in_what_heightfields_share_are_32_bit_integers(name):
    """Shapes alone: so few share their arrays that no place overflows."""
    arrays = [int(size) for size in re.findall(r"f32\[(\d+)\]", str(jax.make_jaxpr(OF_MANY[name])(MANY)))]
    assert 2**25 < max(arrays) < 2**31


def test_more_heightfields_than_32_bits_address_are_refused():
    cast = jax.vmap(lambda z, o: jaxhf.cast(jaxhf.Heightfield(z, 1.0), o, DOWN).t)
    message = "^600 heightfields under a vmap share an array of 2515353600 numbers, at most 2147483647 can be addressed"
    with pytest.raises(ValueError, match=message):
        jax.eval_shape(cast, MANY, start())
    assert jax.eval_shape(cast, jax.ShapeDtypeStruct((512, 1025, 1025), jnp.float32), start()[:512]).shape == (512, 1)


def random_bits(seed: int) -> np.ndarray:
    """(33, 17) float32 numbers of all magnitudes, with nan, infinities, zeros of both signs and denormals."""
    heights = np.random.default_rng(seed).integers(0, 2**32, (33, 17), dtype=np.uint32).view(np.float32).copy()
    heights[3:6, 3] = np.nan, np.inf, -np.inf
    heights[3:7, 9] = 0.0, -0.0, 1e-45, -1e-40
    return heights


@pytest.mark.parametrize("traversal", ["pyramid", pytest.param("dda", marks=pytest.mark.deep)])
def test_heights_of_random_bits(traversal):
    """Down and up through every triangle: a cell is hit where its four heights are finite, and nowhere else."""
    upper, iy, ix = (values.ravel() for values in np.mgrid[0:2, 0:32, 0:16])
    settings = jaxhf.Settings(traversal=traversal, shading="flat")
    for seed in range(4):
        heights = random_bits(seed)
        present = np.isfinite([heights[iy + j, ix + i] for j in (0, 1) for i in (0, 1)]).all(0)
        assert 16 < np.sum(~present) < 100
        for up in (1, -1):
            o = np.stack([(ix + 0.75 - 0.5 * upper) * 0.5, (iy + 0.25 + 0.5 * upper) * 2.0, np.full(1024, up * 3.4e38)], axis=1)
            hit = cast(field_of(heights), o, np.array([0, 0, -up * 2.0**10]), settings)
            hit = {name: value[:1024] for name, value in hit.items()}
            np.testing.assert_array_equal(hit["status"], np.where(present, HIT, MISS))
            np.testing.assert_array_equal(hit["cell"][present], np.stack([ix, iy], axis=1)[present])
            np.testing.assert_array_equal(hit["triangle"][present], upper[present])
            for name in ("t", "n", "ns", "uv"):  # `p` and the tangents may be larger than any float32
                assert np.isfinite(hit[name][present]).all(), name


# Random bits as far as the range of heights leaves float32 room for slopes and areas.
EXTREMES = {f"{scale:g} high": aimed.random_heights((33, 17), scale, seed=5) for scale in (1e-20, 1e20)}
EXTREMES["flat"] = np.full((33, 17), 7.0)  # where the box of the surface has no height
EXTREMES["random bits"] = np.where(np.abs(random_bits(0)) < 2.0**110, random_bits(0), 0).astype(np.float64)


@aimed.PRECISIONS
@pytest.mark.parametrize("heights", EXTREMES.values(), ids=EXTREMES)
def test_extreme_heights(heights, dtype):
    ground = AT_ZERO._replace(heights=heights)
    rays, names = every_family(ground, seed=24)
    expected, _ = compare_with_oracle(ground, rays, names, dtype)
    assert np.sum(expected.decided & (expected.status == oracle.HIT)) > (300 if np.isfinite(heights).all() else 200)


@aimed.PRECISIONS
def test_tiny_components_of_a_direction(dtype):
    """A zero of either sign and a denormal number count as nothing; a direction of nothing else is not valid."""
    tiny = float(np.finfo(dtype).smallest_normal) / 16
    d = np.array([[0, 0, -1], [-0.0, -0.0, -1], [tiny, -tiny, -1], [-tiny, 0, -1], [tiny, 0, -tiny], [0, 0, tiny]])
    hit = cast(heightfield(ROUGH, dtype), [0.1, 20.3, 5.0], d)
    np.testing.assert_array_equal(hit["status"][:6], [HIT] * 4 + [INVALID] * 2)
    for name, value in hit.items():
        np.testing.assert_array_equal(value[1:4], value[[0, 0, 0]], name)
        assert name == "t" or np.isfinite(value).all(), name


def test_a_ray_that_never_leaves_its_diagonal_meets_the_triangle_before_it():
    """Its distance to the diagonal, 1e-33 to 1e-31 cells, divided by the rate 0, lies within the cell all the same."""
    field = jaxhf.Heightfield(np.array([[0.2, 1, 1], [0.1, 0.4, 1], [1, 1, 1]], np.float32))
    starts = np.array([[0, 1e-33, 3.0], [0, 1e-31, 3.0], [0, 1e-32, 0.9]], np.float32)
    hit = jaxhf.cast(field, starts, np.array([[0, 0, -1], [0, 0, -1], [1, 1, -1]], np.float32))
    np.testing.assert_allclose(hit.t, [2.8, 2.8, 0.5], rtol=1e-6)
    np.testing.assert_allclose(hit.p[:, 2], [0.2, 0.2, 0.4], rtol=1e-6)
