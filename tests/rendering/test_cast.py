"""`cast` against the oracle, closed forms and central differences: which rays hit, where, and how that moves."""

import aimed
import jax
import jax.numpy as jnp
import numpy as np
import oracle
import pytest
from compare import COUNT, DOWN, DTYPES, ROUGH, SLACK, assert_none, compare_with_oracle, every_family, heightfield, numpied

import jaxhf
from jaxhf.core.affine import translate
from jaxhf.rendering.cast import cast_camera
from jaxhf.xla.compilation import compiler_options

SCHEMES = ("central", "four", "six", "six-angle", "six-equal")


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("shape", [(2, 2), (2, 9), (33, 17), pytest.param((64, 64), marks=pytest.mark.slow)])
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
def test_traversals_agree(dtype):
    """The pyramid of bounds passes over cells in which nothing happens, and over no others: not a bit may change.

    Nor may it in a loop of fixed length.
    """
    for ground in (ROUGH, ROUGH._replace(heights=np.where(ROUGH.heights > 1, np.nan, ROUGH.heights))):
        rays, names = every_family(ROUGH, seed=22)
        one, *others = (
            numpied(jaxhf.cast(heightfield(ground, dtype), rays.o, rays.d, settings=settings))
            for settings in (jaxhf.Settings(), jaxhf.Settings(traversal="dda"), jaxhf.Settings(early_exit=False))
        )
        for other in others:
            for name in one:
                assert_none((one[name] != other[name]).reshape(COUNT, -1).any(1), names, rays)


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


def test_rays_from_whole_numbers_start_there():
    """Beside a corner at (-2.5, 9.5); the same in NumPy, where they were floats before it was subtracted."""
    field = jaxhf.Heightfield(MILD.heights, 0.5, 2.0, x0=-2.5, y0=9.5)
    o, d = np.array([0, 12, 5]), np.array([0, 0, -1])
    expected, found = jaxhf.cast(field, o, d), jaxhf.cast(field, jnp.asarray(o), jnp.asarray(d))
    np.testing.assert_array_equal(found.p, expected.p)
    np.testing.assert_array_equal(found.p[:2], (0, 12))


def test_a_camera_casts_in_the_frame_of_the_world():
    """Its hits lie where `cast` finds those of the same rays, by a terrain far from the world's origin."""
    field = jaxhf.Heightfield(MILD.heights, 0.5, 2.0, x0=5e5, y0=4.5e6)
    camera = jaxhf.Perspective.look_at((5e5 + 1, 4.5e6 - 3, 6), (5e5 + 2, 4.5e6 + 6, 0), width=8, height=8)
    x, y = np.array([3.5, 4.0, 4.5]), np.array([3.5, 4.5, 6.0])
    seen = cast_camera(jaxhf.Scene([jaxhf.Object(field)], camera), x, y)
    rays = jax.vmap(camera.ray)(jnp.asarray(x), jnp.asarray(y))
    hit = jaxhf.cast(field, rays.o, rays.d)
    assert (np.asarray(hit.status) == jaxhf.Status.HIT).all()
    np.testing.assert_allclose(seen.p, hit.p, rtol=0, atol=1e-8)


def test_under_jit_and_vmap():
    """The same answers inside of a compiled function, over a batch of heights, and ray by ray."""
    o, d = (jnp.asarray(value) for value in slanted(MILD, 48, seed=20))
    plain = jaxhf.cast(heightfield(MILD), o, d)
    compiled = jax.jit(jaxhf.cast, compiler_options=compiler_options(newer=True))(heightfield(MILD), o, d)  # as users do
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


def test_into_a_scene():
    """At the vertices of a terrain far from the origin, whose object is moved; the same bits where it was prepared."""
    field = jaxhf.Heightfield(MILD.heights, 0.5, 2.0, x0=5e5, y0=4.5e6)
    camera = jaxhf.Perspective.look_at((5e5 + 1, 4.5e6 - 3, 6), (5e5 + 2, 4.5e6 + 6, 0), width=8, height=8)
    scene = jaxhf.Scene([jaxhf.Object(field, None, translate(10.0, 0.0, 3.0))], camera)
    x, y = np.meshgrid(np.arange(1, 8), np.arange(1, 6))
    o, d = np.stack([5e5 + 10 + 0.5 * x, 4.5e6 + 2.0 * y, 9.0 + 0 * x], -1), DOWN
    hit = jaxhf.cast(scene, o, d)
    assert (np.asarray(hit.status) == jaxhf.Status.HIT).all()
    np.testing.assert_allclose(hit.p[..., 2], MILD.heights[1:6, 1:8] + 3, atol=1e-12)
    prepared = jaxhf.prepare(scene)
    np.testing.assert_array_equal(jaxhf.cast(prepared, o, d).p, hit.p)
    with pytest.raises(ValueError, match="leaving needs a heightfield alone"):
        jaxhf.cast(scene, None, d, leaving=hit)
    with pytest.raises(ValueError, match="it cannot be cast into with"):
        jaxhf.cast(prepared, o, d, jaxhf.Settings(shading="flat"))


def test_batch_of_heightfields():
    """Each with rays of its own, two in a chunk, with one that is made up: what they meet alone; the same where prepared."""
    o, d = slanted(MILD, 240, seed=21)
    o, d = o.reshape(5, 48, 3), d.reshape(5, 48, 3)
    heights = np.stack([MILD.heights * scale for scale in (1.0, 0.8, -1.2, 0.5, 2.0)])
    fields = jax.vmap(lambda z: jaxhf.Heightfield(z, *MILD[1:]))(jnp.asarray(heights))
    settings = jaxhf.Settings(chunk=100)
    together, prepared = jaxhf.cast(fields, o, d, settings), jaxhf.prepare(fields, settings)
    assert together.p.shape == (5, 48, 3)
    for name, value in numpied(jaxhf.cast(prepared, o, d)).items():
        np.testing.assert_allclose(value, numpied(together)[name], rtol=1e-9, atol=1e-9, err_msg=name)
    with pytest.raises(ValueError, match=r"the heightfield was prepared with .*, it cannot be cast into with"):
        jaxhf.cast(prepared, o, d, jaxhf.Settings(shading="flat"))
    for k in range(5):
        alone, one = numpied(jaxhf.cast(jaxhf.Heightfield(heights[k], *MILD[1:]), o[k], d[k])), numpied(together)
        assert (alone["status"] == jaxhf.Status.HIT).mean() > 0.5
        for name in alone:
            np.testing.assert_allclose(one[name][k], alone[name], rtol=1e-9, atol=1e-9, err_msg=name)
    with pytest.raises(ValueError, match=r"must begin with the axes \(5,\) of the heightfields"):
        jaxhf.cast(fields, o[0], d[0])
