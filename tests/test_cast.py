"""`cast` against the oracle, closed forms and central differences: which rays hit, where, and how that moves.

A ray may end in another way than the oracle says only where a rounding decides. How far rounding goes is `SLACK`, the shift
of a ray against the surface relative to the largest lengths that occur (see `oracle.OracleHit`). Behind a height over the
surface stand about a dozen operations, each rounded to half of `eps`: into the frame of the grid, to the box, along the ray,
along an edge. In double precision the oracle's own rounding is part of it.
"""

import dataclasses

import aimed
import jax
import jax.numpy as jnp
import numpy as np
import oracle
import pytest

import jaxhf

DTYPES = [np.float32, np.float64]
SLACK = {np.float32: 8 * 2.0**-24, np.float64: 8 * 2.0**-53}
SCHEMES = ("central", "four", "six", "six-angle", "six-equal")
DOWN = np.array([0.0, 0.0, -1.0])
# One size of field and of batch for many tests: each other one is compiled anew.
ROUGH = aimed.Ground(aimed.random_heights((33, 17), 1.0, seed=3), dx=0.5, dy=2.0, x0=-3.0, y0=10.0)
PER_FAMILY = 100
COUNT = PER_FAMILY * len(aimed.FAMILIES)


def heightfield(ground: aimed.Ground, dtype: type[np.floating] = np.float64) -> jaxhf.Heightfield:
    return jaxhf.Heightfield(ground.heights.astype(dtype), *ground[1:])


def numpied(hit):
    """The fields of a Hit as NumPy arrays in double precision or integers."""
    fields = {field.name: getattr(hit, field.name) for field in dataclasses.fields(hit)}
    arrays = {name: np.asarray(value) for name, value in fields.items() if value is not None}
    return {name: value.astype(np.float64) if value.dtype.kind == "f" else value for name, value in arrays.items()}


def every_family(ground: aimed.Ground, seed: int) -> tuple[aimed.Rays, np.ndarray]:
    """Rays of each family, one after the other, as float32 numbers, and the names that go with them."""
    parts = [aimed.aimed(name, ground, PER_FAMILY, seed, roundable=True) for name in aimed.FAMILIES]
    o, d, expect = (np.concatenate(values) for values in zip(*parts, strict=True))
    return aimed.Rays(o, d, expect), np.repeat(list(aimed.FAMILIES), PER_FAMILY)


def assert_none(wrong, names, rays):
    """Asserts that `wrong` marks no ray; says of which families they are, and gives the first."""
    where = np.flatnonzero(wrong)
    counts = dict(zip(*np.unique(names[where], return_counts=True), strict=True))
    assert len(where) == 0, f"{counts}; first: ray {where[0]}, o = {rays.o[where[0]].tolist()}, d = {rays.d[where[0]].tolist()}"


def compare_with_oracle(ground: aimed.Ground, rays: aimed.Rays, names: np.ndarray, dtype: type[np.floating]):
    """Asserts that `cast` is right about every ray; returns what the oracle says."""
    hit = numpied(jaxhf.cast(heightfield(ground, dtype), rays.o, rays.d))
    expected = oracle.cast(*ground, rays.o, rays.d, slack=SLACK[dtype])
    eps = np.finfo(dtype).eps
    met, t = hit["status"] == jaxhf.Status.HIT, hit["t"]
    assert_none(~np.isin(hit["status"], (jaxhf.Status.HIT, jaxhf.Status.MISS)), names, rays)
    assert_none(expected.decided & (hit["status"] != expected.status), names, rays)
    assert_none(met != np.isfinite(t), names, rays)
    assert_none(met & ((t <= 0) | (t < expected.earliest)), names, rays)
    assert_none(met & expected.decided & (t > expected.latest), names, rays)
    for name, value in hit.items():
        assert_none(~np.isfinite(value.reshape(len(t), -1)).all(1) & (met | (name != "t")), names, rays)

    # The point is on the ray and on the surface, each to within a shift; its coordinates are rounded once more, with x0 and y0.
    along = rays.o + np.where(met, t, 0)[:, None] * rays.d
    corner = eps * np.array([abs(ground.x0), abs(ground.y0), abs(ground.low) + ground.range])
    shift = expected.shift[:, None] * [ground.dx, ground.dy]
    assert_none(met & (np.abs(hit["p"] - along) > np.column_stack([shift, 2 * expected.rise]) + corner).any(1), names, rays)

    # Where shifted rays hit close to each other, and away from edges, the triangle is known and with it all the rest.
    cells = ground.cells
    spread = np.where(expected.decided & met, expected.spread, 0)
    reach = np.max(np.abs(rays.d[:, :2]) / [ground.dx, ground.dy], axis=1) * spread + expected.shift
    sharp = met & expected.decided & (reach < expected.place.inside)
    place = expected.place
    assert_none(sharp & (hit["cell"] != place.cell).any(1), names, rays)
    assert_none(sharp & (hit["triangle"] != place.triangle), names, rays)
    assert_none(sharp & (np.abs(hit["uv"] - place.uv) * cells > reach[:, None]).any(1), names, rays)
    # The normal: a length and products, and before them two heights, each rounded relative to the range of all heights.
    off = eps * ground.range * (1 / ground.dx + 1 / ground.dy) * place.n[:, 2]
    assert_none(sharp & (np.abs(hit["n"] - place.n).max(1) > 4 * eps + off), names, rays)
    assert_none(sharp & (hit["side"] * (place.n * rays.d).sum(1) > 0), names, rays)
    return expected, sharp


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("shape", [(2, 2), (2, 9), (33, 17), (64, 64)])
def test_agrees_with_oracle(shape, dtype):
    for scale in (1e-6, 1.0, 1e6):
        ground = aimed.Ground(aimed.random_heights(shape, scale, seed=1), dx=0.5, dy=2.0, x0=-3.0, y0=10.0)
        rays, names = every_family(ground, seed=2)
        expected, sharp = compare_with_oracle(ground, rays, names, dtype)
        if min(shape) > 2:
            for name in aimed.FAMILIES:  # the border itself is a third of its family
                assert expected.decided[names == name].mean() > (0.6 if name == "border" else 0.8)
            assert sharp[(expected.status == oracle.HIT) & (names == "random")].mean() > 0.9


@pytest.mark.parametrize("dtype", DTYPES)
def test_agrees_with_oracle_over_holes(dtype):
    rays, names = every_family(ROUGH, seed=4)
    heights = ROUGH.heights.copy()
    heights[4, 5], heights[9, 12], heights[32, 16], heights[0, :3], heights[::7, 8] = np.nan, np.inf, -np.inf, np.nan, np.nan
    whole = oracle.cast(*ROUGH, rays.o, rays.d)
    expected, _ = compare_with_oracle(ROUGH._replace(heights=heights), rays, names, dtype)
    assert np.sum(expected.decided & (expected.status != whole.status)) > 15


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("scale", [1e-20, 1e20])
def test_extreme_heights(scale, dtype):
    ground = aimed.Ground(aimed.random_heights((33, 17), scale, seed=5), dx=0.5, dy=2.0)
    rays, names = every_family(ground, seed=6)
    expected, _ = compare_with_oracle(ground, rays, names, dtype)
    assert np.sum(expected.decided & (expected.status == oracle.HIT)) > 300


@pytest.mark.parametrize("dtype", DTYPES)
def test_traversals_agree(dtype):
    """The pyramid of bounds passes over cells in which nothing happens, and over no others: not a bit may change."""
    for ground in (ROUGH, ROUGH._replace(heights=np.where(ROUGH.heights > 1, np.nan, ROUGH.heights))):
        rays, names = every_family(ROUGH, seed=22)
        one, two = (
            numpied(jaxhf.cast(heightfield(ground, dtype), rays.o, rays.d, settings=jaxhf.Settings(traversal=traversal)))
            for traversal in ("pyramid", "dda")
        )
        for name in one:
            assert_none((one[name] != two[name]).reshape(COUNT, -1).any(1), names, rays)


@pytest.mark.parametrize("name", ["vertices", "x_edges", "y_edges", "diagonals", "vertical", "border", "miss"])
def test_float32_loses_no_ray(name):
    """Many rays that hit, or miss, by construction, without a look at the oracle."""
    known = 0
    for scale in (1e-6, 1.0, 1e6):
        ground = aimed.Ground(aimed.random_heights((33, 17), scale, seed=7), dx=0.5, dy=2.0, x0=-3.0, y0=10.0)
        rays = aimed.aimed(name, ground, 20_480, seed=8, roundable=True)
        status = np.asarray(jaxhf.cast(heightfield(ground, np.float32), rays.o, rays.d).status)
        certain = rays.expect != aimed.OPEN
        assert_none(certain & (status != rays.expect), np.full(len(status), name), rays)
        known += certain.sum()
    assert known > 10_000


MILD = aimed.Ground(aimed.random_heights((7, 9), 0.4, seed=9), dx=0.5, dy=2.0, x0=-3.0, y0=10.0)


def slanted(ground: aimed.Ground, count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Generic rays that hit, away from the edges of the triangles by a hundredth of a cell."""
    parts = [aimed.aimed(name, ground, 2 * count, seed, roundable=True) for name in ("through_side", "random", "grazing")]
    o, d = np.concatenate([part.o for part in parts]), np.concatenate([part.d for part in parts])
    hit = oracle.cast(*ground, o, d, slack=SLACK[np.float32])
    keep = hit.decided & (hit.status == oracle.HIT) & (hit.place.inside > 0.01) & (hit.spread < 1e-3 * hit.t)
    chosen = np.random.default_rng(seed).permutation(np.flatnonzero(keep))[:count]
    assert len(chosen) == count
    return o[chosen], d[chosen]


@pytest.mark.parametrize(
    ("scheme", "dtype"), [(scheme, np.float64) for scheme in SCHEMES] + [("six", np.float32), ("six-angle", np.float32)]
)
def test_shading_normals(scheme, dtype):
    o, d = slanted(MILD, 400, seed=10)
    place = oracle.cast(*MILD, o, d).place
    hit = numpied(jaxhf.cast(heightfield(MILD, dtype), o, d, settings=jaxhf.Settings(normals=scheme)))
    expected, turn, cancels = oracle.shading_normals(MILD.heights, MILD.dx, MILD.dy, place, scheme)
    # About ten roundings of what is added up, and a hit that is off by this many cells on a normal that turns.
    off = np.abs(hit["uv"] - place.uv).max(1) * MILD.cells.max()
    tolerance = 8 * np.finfo(dtype).eps * cancels + turn * off
    assert np.all(np.abs(hit["ns"] - expected).max(1) <= tolerance)
    assert np.max(off) < 1e-3 if dtype is np.float32 else np.max(off) < 1e-11
    np.testing.assert_allclose(np.linalg.norm(hit["ns"], axis=1), 1, rtol=4 * float(np.finfo(dtype).eps))


@pytest.mark.parametrize("dtype", DTYPES)
def test_flat_shading(dtype):
    """The triangle's own normal, and tangents by hand: those of the plane, the second one made orthogonal to the first."""
    o, d = slanted(MILD, 400, seed=10)
    place = oracle.cast(*MILD, o, d).place
    hit = numpied(jaxhf.cast(heightfield(MILD, dtype), o, d, settings=jaxhf.Settings(shading="flat")))
    eps = np.finfo(dtype).eps
    np.testing.assert_array_equal(hit["ns"], hit["n"])
    np.testing.assert_array_equal([hit["dn_du"], hit["dn_dv"]], 0)
    np.testing.assert_allclose(hit["ns"], place.n, atol=4 * eps)
    width, depth = MILD.cells * [MILD.dx, MILD.dy]
    slope_x, slope_y = -place.n[:, 0] / place.n[:, 2], -place.n[:, 1] / place.n[:, 2]
    per_u = np.stack([np.full(len(o), width), np.zeros(len(o)), slope_x * width], axis=1)
    per_v = np.stack([np.zeros(len(o)), np.full(len(o), depth), slope_y * depth], axis=1)
    per_v = per_v - per_u * ((per_u * per_v).sum(1) / (per_u * per_u).sum(1))[:, None]
    scale = np.linalg.norm(per_u, axis=1).max() + np.linalg.norm(per_v, axis=1).max()
    np.testing.assert_allclose(hit["dp_du"], per_u, atol=16 * eps * scale)
    np.testing.assert_allclose(hit["dp_dv"], per_v, atol=16 * eps * scale)


def test_tangents():
    """Orthogonal to `ns` and to each other, right-handed; along u the step of the surface without its part along `ns`."""
    o, d = slanted(MILD, 400, seed=10)
    hit = numpied(jaxhf.cast(heightfield(MILD), o, d))
    ns, dp_du, dp_dv = hit["ns"], hit["dp_du"], hit["dp_dv"]
    size = np.linalg.norm(dp_du, axis=1) * np.linalg.norm(dp_dv, axis=1)
    for one, two in ((ns, dp_du), (ns, dp_dv), (dp_du, dp_dv)):
        np.testing.assert_allclose((one * two).sum(1) / size, 0, atol=1e-14)
    np.testing.assert_allclose((np.cross(dp_du, dp_dv) * ns).sum(1), size, rtol=1e-12)
    width, depth = MILD.cells * [MILD.dx, MILD.dy]
    per_u = np.stack([np.full(len(o), width), np.zeros(len(o)), -hit["n"][:, 0] / hit["n"][:, 2] * width], axis=1)
    per_v = np.stack([np.zeros(len(o)), np.full(len(o), depth), -hit["n"][:, 1] / hit["n"][:, 2] * depth], axis=1)
    np.testing.assert_allclose(dp_du, per_u - ns * (ns * per_u).sum(1)[:, None], atol=1e-12 * width)
    # dp_dv: per_v, without what lies along ns or dp_du; so that per_v is made of these three.
    rest = per_v - dp_dv
    normal = np.cross(ns, dp_du)
    np.testing.assert_allclose((rest * normal).sum(1), 0, atol=1e-12 * width * depth)


@pytest.mark.parametrize("scheme", SCHEMES)
def test_derivatives_of_the_shading_normal(scheme):
    """dn_du and dn_dv against central differences of `ns` between vertical rays side by side in one triangle."""
    generator = np.random.default_rng(11)
    x, y = generator.uniform(0, MILD.cells[0], 400), generator.uniform(0, MILD.cells[1], 400)
    field, settings, step = heightfield(MILD), jaxhf.Settings(normals=scheme), 1e-4

    def below(x, y):
        o = MILD.points(x, y) + np.array([0, 0, 1.5])
        return numpied(jaxhf.cast(field, o, np.broadcast_to(DOWN, o.shape), settings=settings))

    hit = below(x, y)
    u, v = np.stack([x, y]) - hit["cell"].T
    far = np.minimum(np.abs(u - v), np.minimum(np.minimum(u, 1 - u), np.minimum(v, 1 - v))) > 2 * step
    along_u = (below(x + step, y)["ns"] - below(x - step, y)["ns"]) / (2 * step) * MILD.cells[0]
    along_v = (below(x, y + step)["ns"] - below(x, y - step)["ns"]) / (2 * step) * MILD.cells[1]
    # The differences' own errors: step**2 / 6 times a third derivative, and rounding over the step.
    np.testing.assert_allclose(hit["dn_du"][far], along_u[far], rtol=1e-5, atol=1e-6 * MILD.cells[0])
    np.testing.assert_allclose(hit["dn_dv"][far], along_v[far], rtol=1e-5, atol=1e-6 * MILD.cells[1])
    assert far.sum() > 300
    assert np.median(np.linalg.norm(along_u[far], axis=1)) > 1


@jax.jit
def outputs(heights, o, d):
    """All that is differentiable, as one matrix of a row to a ray; t is its first column."""
    hit = jaxhf.cast(jaxhf.Heightfield(heights, *MILD[1:]), o, d)
    values = (hit.t[:, None], hit.p, hit.n, hit.ns, hit.uv, hit.dp_du, hit.dp_dv, hit.dn_du, hit.dn_dv)
    return jnp.concatenate(values, axis=1)


@jax.jit
def forward_mode(primals, tangents):
    return jax.jvp(outputs, primals, tangents)[1]


@jax.jit
def reverse_mode(primals, weights):
    return jax.vjp(outputs, *primals)[1](weights)


def test_derivatives_match_central_differences():
    """Of every output, ray by ray, in forward mode, and in reverse mode against forward mode."""
    primals = tuple(jnp.asarray(value) for value in (MILD.heights, *slanted(MILD, 48, seed=12)))
    generator = np.random.default_rng(13)
    tangents = tuple(jnp.asarray(generator.normal(size=value.shape)) for value in primals)
    step = 1e-7
    ahead, behind = (outputs(*(x + s * step * dx for x, dx in zip(primals, tangents, strict=True))) for s in (1, -1))
    numeric = np.asarray(ahead - behind) / (2 * step)
    forward = np.asarray(forward_mode(primals, tangents))
    # The differences' own errors: rounding of 1e-16 over the step, and the square of the step times third derivatives.
    scale = np.maximum(np.abs(numeric), np.abs(numeric).max(axis=1, keepdims=True))
    assert np.all(np.abs(forward - numeric) <= 1e-6 * scale)
    assert np.all(np.median(np.abs(numeric), axis=0) > 1e-3)

    weights = generator.normal(size=numeric.shape)
    reverse = reverse_mode(primals, jnp.asarray(weights))
    product = sum(np.vdot(one, two) for one, two in zip(reverse, tangents, strict=True))
    np.testing.assert_allclose(product, np.vdot(weights, forward), rtol=1e-9)


def test_heights_move_the_hit_of_their_own_triangle_only():
    """dt/dheights by hand: a vertex with weight w in the triangle lifts the surface by w; g = 0 gives dt = w / (dg/dt)."""
    o, d = slanted(MILD, 48, seed=12)
    place = oracle.cast(*MILD, o, d).place
    field = heightfield(MILD)
    jacobian = np.asarray(jax.jit(jax.jacrev(lambda z: jaxhf.cast(jaxhf.Heightfield(z, *MILD[1:]), o, d).t))(field.heights))
    rate = (d * place.n).sum(1) / place.n[:, 2]
    expected = np.zeros_like(jacobian)
    u, v = (place.uv * MILD.cells - place.cell).T
    rays, (ix, iy), upper = np.arange(len(o)), place.cell.T, place.triangle == 1
    expected[rays, iy, ix] = 1 - np.maximum(u, v)
    expected[rays, iy + 1, ix + 1] = np.minimum(u, v)
    expected[rays, iy + upper, ix + ~upper] = np.abs(u - v)
    np.testing.assert_allclose(jacobian, expected / rate[:, None, None], rtol=1e-9, atol=1e-9)


def test_misses_have_zero_derivatives():
    """Past the box, away from it, level over a flat field, not valid: no nan, and no t that moves."""
    rays = aimed.aimed("miss", MILD, 48, seed=14)
    level = np.array([[-4.0, 11.0, 5.0], [-4.0, 11.0, 0.0], [-2.0, 12.0, 0.0], [np.nan, 0, 0], [0, 0, 9.0], [0, 12.0, 1.0]])
    ahead = np.array([[1.0, 0.3, 0.0], [1.0, 0.3, 0.0], [1.0, 0.0, 0.0], [0, 0, 1.0], [0, 0, 0.0], [0, 0, 1.0]])
    flat = np.zeros_like(MILD.heights), np.tile(level, (8, 1)), np.tile(ahead, (8, 1))
    for values in ((MILD.heights, rays.o, rays.d), flat):
        primals = tuple(jnp.asarray(value) for value in values)
        assert np.all(np.isposinf(outputs(*primals)[:, 0]))
        forward = np.asarray(forward_mode(primals, jax.tree.map(jnp.ones_like, primals)))
        np.testing.assert_array_equal(forward[:, 0], 0)
        assert np.all(np.isfinite(forward))
        of_t = jnp.zeros(forward.shape).at[:, 0].set(1)
        for gradient in reverse_mode(primals, of_t):
            np.testing.assert_array_equal(gradient, 0)
        for gradient in reverse_mode(primals, jnp.ones(forward.shape)):
            assert np.all(np.isfinite(gradient))


def test_a_hit_beside_misses_keeps_its_derivative():
    o = np.tile([[0.0, 11.0, 5.0], [50.0, 11.0, 5.0], [np.inf, 0.0, 0.0], [1e30, 11.0, 5.0]], (12, 1))
    primals = tuple(jnp.asarray(value) for value in (MILD.heights, o, np.tile(DOWN, (48, 1))))
    of_t = jnp.zeros(outputs(*primals).shape).at[:, 0].set(1)
    assert reverse_mode(primals, of_t)[0].sum() == pytest.approx(-12)  # lifting the field by 1 brings each hit closer by 1


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


@pytest.mark.parametrize(("traversal", "max_steps", "enough"), [("dda", 19, False), ("dda", 20, True), ("pyramid", 1, False)])
def test_a_budget_that_runs_out_is_reported(traversal, max_steps, enough):
    """Twenty cells to a wall, none of them passed by its bounds; "dda" takes a step for each. The rest is as ever."""
    heights = np.zeros((3, 21))
    heights[1], heights[:, -1] = 0.4, 1
    o = np.array([[-1.0, 0.7, 0.3], [0.5, 0.7, 0.5], [-1.0, 0.7, 2.0]])
    d = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
    settings = jaxhf.Settings(traversal=traversal, max_steps=max_steps)
    status = jaxhf.cast(jaxhf.Heightfield(heights, 1.0), o, d, settings=settings).status
    hit, miss, exhausted = jaxhf.Status.HIT, jaxhf.Status.MISS, jaxhf.Status.EXHAUSTED
    np.testing.assert_array_equal(status, [hit if enough else exhausted, hit, miss])


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


def test_an_offset_costs_no_accuracy():
    """In UTM coordinates and single precision the same bits as at the origin, when the rays are NumPy's."""
    offset = np.array([449_000.5, 5.4e6, 0])
    near, far = (ROUGH._replace(x0=float(corner[0]), y0=float(corner[1])) for corner in (0 * offset, offset))
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


def test_shapes_and_precision():
    dtype = np.float32  # float64 is the test of everything else
    field = heightfield(MILD, dtype)
    o, d = np.broadcast_to([0.0, 11.0, 5.0], (2, 5, 3)), DOWN
    hit = jaxhf.cast(field, o, d)
    assert (hit.status.shape, hit.p.shape, hit.uv.shape, hit.cell.shape) == ((2, 5), (2, 5, 3), (2, 5, 2), (2, 5, 2))
    one = jaxhf.cast(field, o[0, 0], d)
    assert (one.status.shape, one.ns.shape) == ((), (3,))
    for ray in (hit, one):
        assert {value.dtype for value in (ray.t, ray.p, ray.n, ray.ns, ray.uv, ray.dp_du, ray.dn_du)} == {np.dtype(dtype)}
    empty = jaxhf.cast(field, np.zeros((0, 3)), np.zeros((0, 3)))
    assert empty.t.shape == (0,)
    for o, d in ((np.zeros(2), DOWN), (np.zeros(3), np.zeros((3, 2)))):
        with pytest.raises(ValueError, match="must have shape"):
            jaxhf.cast(field, o, d)


def test_under_jit_and_vmap():
    """The same answers inside of a compiled function, over a batch of heights, and ray by ray."""
    o, d = (jnp.asarray(value) for value in slanted(MILD, 48, seed=20))
    plain = jaxhf.cast(heightfield(MILD), o, d)
    compiled = jax.jit(jaxhf.cast)(heightfield(MILD), o, d)
    single = jax.vmap(lambda o, d: jaxhf.cast(heightfield(MILD), o, d))(o, d)
    stack = jnp.stack([jnp.asarray(MILD.heights), 2 * jnp.asarray(MILD.heights)])
    fields = jax.vmap(lambda z: jaxhf.cast(jaxhf.Heightfield(z, *MILD[1:]), o, d))(stack)
    double = jaxhf.cast(jaxhf.Heightfield(stack[1], *MILD[1:]), o, d)
    for one, other in (
        (plain, compiled),
        (plain, single),
        (plain, jax.tree.map(lambda x: x[0], fields)),
        (double, jax.tree.map(lambda x: x[1], fields)),
    ):
        one, other = numpied(one), numpied(other)
        for name in one:  # another program may round elsewhere; t at grazing angles is the most sensitive
            np.testing.assert_allclose(one[name], other[name], rtol=1e-9, atol=1e-9, err_msg=name)
    assert np.any(np.asarray(plain.t) != np.asarray(double.t))
