"""`cast` against the oracle, closed forms and central differences: which rays hit, where, and how that moves.

In single precision, as users cast; the same in double is deep. Rays come in two numbers on two fields: others compile anew.
"""

import functools

import aimed
import jax
import jax.numpy as jnp
import numpy as np
import oracle
import pytest
from compare import COUNT, DOWN, ROUGH, SLACK, assert_none, compare_with_oracle, every_family, heightfield, numpied

import jaxhf
from jaxhf.core.affine import translate
from jaxhf.rendering.cast import cast_camera
from jaxhf.xla.compilation import compiler_options

SINGLE = np.float32
EPS = float(np.finfo(SINGLE).eps)
HIT, MISS, EXHAUSTED = jaxhf.Status.HIT, jaxhf.Status.MISS, jaxhf.Status.EXHAUSTED


# Which rays hit, and where: on ROUGH ground.


@aimed.PRECISIONS
@pytest.mark.parametrize("shape", [(2, 2), pytest.param((2, 9), marks=pytest.mark.deep), (33, 17)])
def test_agrees_with_oracle(shape, dtype):
    for scale in (1e-6, 1.0, 1e6):
        ground = aimed.Ground(aimed.random_heights(shape, scale, seed=1), dx=0.5, dy=2.0, x0=-3.0, y0=10.0)
        rays, names = every_family(ground, seed=2)
        expected, sharp = compare_with_oracle(ground, rays, names, dtype)
        if min(shape) > 2:
            for name in aimed.FAMILIES:  # the border itself is a third of its family
                assert expected.decided[names == name].mean() > (0.6 if name == "border" else 0.8)
            assert sharp[(expected.status == oracle.HIT) & (names == "random")].mean() > 0.9


@aimed.PRECISIONS
def test_agrees_with_oracle_over_holes(dtype):
    rays, names = every_family(ROUGH, seed=4)
    heights = ROUGH.heights.copy()
    heights[4, 5], heights[9, 12], heights[32, 16], heights[0, :3], heights[::7, 8] = np.nan, np.inf, -np.inf, np.nan, np.nan
    whole = oracle.cast(*ROUGH, rays.o, rays.d)
    expected, _ = compare_with_oracle(ROUGH._replace(heights=heights), rays, names, dtype)
    assert np.sum(expected.decided & (expected.status != whole.status)) > 15


@aimed.PRECISIONS
@pytest.mark.optimised  # to the bit, which other compilations need not keep
def test_traversals_agree(dtype):
    """The pyramid of bounds passes over cells in which nothing happens, and over no others: not a bit may change.

    Nor may it in a loop of fixed length.
    """
    for ground in (ROUGH, ROUGH._replace(heights=np.where(ROUGH.heights > 1, np.nan, ROUGH.heights))):
        rays, names = every_family(ROUGH, seed=22)
        one, *others = (
            numpied(jaxhf.cast(heightfield(ground, dtype), rays.o, rays.d, settings))
            for settings in (None, jaxhf.Settings(traversal="dda"), jaxhf.Settings(early_exit=False))
        )
        for other in others:
            for name in one:
                assert_none((one[name] != other[name]).reshape(COUNT, -1).any(1), names, rays)


@pytest.mark.parametrize(("traversal", "max_steps", "status"), [("dda", 19, [EXHAUSTED, HIT]), ("pyramid", 1, [EXHAUSTED] * 2)])
def test_a_budget_that_runs_out_is_reported(traversal, max_steps, status):
    """Twenty cells to a wall or nineteen, none passed by its bounds; "dda" takes a step for each. The rest is as ever."""
    heights = np.zeros((3, 21), SINGLE)
    heights[1], heights[:, -1] = 0.4, 1
    o = np.array([[-1.0, 0.7, 0.3], [1.5, 0.7, 0.35], [0.5, 0.7, 0.5], [-1.0, 0.7, 2.0]])
    d = np.array([[1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
    settings = jaxhf.Settings(traversal=traversal, max_steps=max_steps)
    np.testing.assert_array_equal(jaxhf.cast(jaxhf.Heightfield(heights, 1.0), o, d, settings).status, [*status, HIT, MISS])


# Normals and tangents: on MILD ground, by generic rays.

MILD = aimed.Ground(aimed.random_heights((7, 9), 0.4, seed=9), dx=0.5, dy=2.0, x0=-3.0, y0=10.0)
WIDTH, DEPTH = MILD.cells * [MILD.dx, MILD.dy]
RAYS = 400


@functools.cache
def slanted(count: int = RAYS) -> tuple[np.ndarray, np.ndarray]:
    """Rays that hit, away from the edges of the triangles by a hundredth of a cell."""
    parts = [aimed.aimed(name, MILD, 2 * RAYS, 10, roundable=True) for name in ("through_side", "random", "grazing")]
    o, d = np.concatenate([part.o for part in parts]), np.concatenate([part.d for part in parts])
    hit = oracle.cast(*MILD, o, d, slack=SLACK[SINGLE])
    keep = hit.decided & (hit.status == oracle.HIT) & (hit.place.inside > 0.01) & (hit.spread < 1e-3 * hit.t)
    chosen = np.random.default_rng(10).permutation(np.flatnonzero(keep))[:count]
    assert len(chosen) == count
    return o[chosen], d[chosen]


@functools.cache
def place() -> oracle.Place:
    return oracle.cast(*MILD, *slanted()).place


def steps_along() -> np.ndarray:
    """By hand, how far a triangle's plane goes over the whole field along u, and along v."""
    n, zero = place().n, np.zeros(RAYS)
    return np.array(
        [[zero + WIDTH, zero, -n[:, 0] / n[:, 2] * WIDTH], [zero, zero + DEPTH, -n[:, 1] / n[:, 2] * DEPTH]]
    ).swapaxes(1, 2)


OTHERS = [pytest.param(scheme, SINGLE, marks=pytest.mark.deep) for scheme in ("four", "six", "six-angle", "six-equal")]
DOUBLE = [pytest.param("six-angle", np.float64, marks=[pytest.mark.deep, pytest.mark.x64])]


@pytest.mark.parametrize(("scheme", "dtype"), [(None, SINGLE), ("central", SINGLE), *OTHERS, *DOUBLE])
def test_shading_normals(scheme, dtype):
    """And their derivatives against central differences of the oracle's, in the triangle of each hit."""
    hit = numpied(jaxhf.cast(heightfield(MILD, dtype), *slanted(), jaxhf.Settings(normals=scheme)))

    def normals(u=0.0, v=0.0):
        moved = place()._replace(uv=place().uv + np.array([u, v]))
        return oracle.shading_normals(MILD.heights, MILD.dx, MILD.dy, moved, scheme or "six")

    expected, turn, cancels = normals()
    # About ten roundings of what is added up, and a hit that is off by this many cells on a normal that turns.
    off, eps = np.abs(hit["uv"] - place().uv).max(1) * MILD.cells.max(), float(np.finfo(dtype).eps)
    assert np.all(np.abs(hit["ns"] - expected).max(1) <= 8 * eps * cancels + turn * off)
    assert np.max(off) < (1e-3 if dtype is SINGLE else 1e-11)
    np.testing.assert_allclose(np.linalg.norm(hit["ns"], axis=1), 1, rtol=4 * eps)
    for name, step in (("dn_du", (1e-6, 0)), ("dn_dv", (0, 1e-6))):
        numeric = (normals(*step)[0] - normals(*np.negative(step))[0]) / 2e-6
        # Of second order in the turn over a cell; the differences are right to 1e-9.
        bound = (32 * eps * cancels + 4 * turn * (off + eps)) * (1 + turn) * MILD.cells.max() + 1e-8
        assert np.all(np.abs(hit[name] - numeric).max(1) <= bound), name
        assert np.median(np.linalg.norm(numeric, axis=1)) > 0.1


@aimed.PRECISIONS
def test_flat_shading(dtype):
    """The triangle's own normal, and tangents by hand: those of the plane, the second one made orthogonal to the first."""
    hit, eps = numpied(jaxhf.cast(heightfield(MILD, dtype), *slanted(), jaxhf.Settings(shading="flat"))), np.finfo(dtype).eps
    np.testing.assert_array_equal(hit["ns"], hit["n"])
    np.testing.assert_array_equal([hit["dn_du"], hit["dn_dv"]], 0)
    np.testing.assert_allclose(hit["ns"], place().n, atol=4 * eps)
    per_u, per_v = steps_along()
    per_v = per_v - per_u * ((per_u * per_v).sum(1) / (per_u * per_u).sum(1))[:, None]
    scale = np.linalg.norm(per_u, axis=1).max() + np.linalg.norm(per_v, axis=1).max()
    np.testing.assert_allclose(hit["dp_du"], per_u, atol=16 * eps * scale)
    np.testing.assert_allclose(hit["dp_dv"], per_v, atol=16 * eps * scale)


def test_tangents():
    """Orthogonal to `ns` and to each other, right-handed; along u the step of the surface without its part along `ns`."""
    hit = numpied(jaxhf.cast(heightfield(MILD, SINGLE), *slanted()))
    ns, dp_du, dp_dv = hit["ns"], hit["dp_du"], hit["dp_dv"]
    size = np.linalg.norm(dp_du, axis=1) * np.linalg.norm(dp_dv, axis=1)
    for one, two in ((ns, dp_du), (ns, dp_dv), (dp_du, dp_dv)):
        np.testing.assert_allclose((one * two).sum(1) / np.sqrt((one**2).sum(1) * (two**2).sum(1)), 0, atol=32 * EPS)
    np.testing.assert_allclose((np.cross(dp_du, dp_dv) * ns).sum(1), size, rtol=32 * EPS)
    per_u, per_v = steps_along()
    np.testing.assert_allclose(dp_du, per_u - ns * (ns * per_u).sum(1)[:, None], atol=64 * EPS * WIDTH)
    # dp_dv: per_v, without what lies along ns or dp_du; so that per_v is made of these three.
    np.testing.assert_allclose(((per_v - dp_dv) * np.cross(ns, dp_du)).sum(1), 0, atol=64 * EPS * WIDTH * DEPTH)


# Derivatives.


@jax.jit
def forward_mode(primals, tangents):
    """All that is differentiable, as one matrix of a row to a ray, t in its first column; and its derivative."""
    return jax.jvp(outputs, primals, tangents)


@jax.jit
def reverse_mode(primals, weights):
    return jax.vjp(outputs, *primals)[1](weights)


def outputs(heights, o, d):
    hit = jaxhf.cast(jaxhf.Heightfield(heights, *MILD[1:]), o, d)
    values = (hit.t[:, None], hit.p, hit.n, hit.ns, hit.uv, hit.dp_du, hit.dp_dv, hit.dn_du, hit.dn_dv)
    return jnp.concatenate(values, axis=1)


def primals_and_tangents(dtype):
    primals = tuple(jnp.asarray(value, dtype) for value in (MILD.heights, *slanted(48)))
    generator = np.random.default_rng(13)
    return primals, tuple(jnp.asarray(generator.normal(size=value.shape), dtype) for value in primals)


def test_derivatives_match_the_oracle():
    """Of places and normals, ray by ray, in forward mode; and in reverse mode against forward mode."""
    primals, tangents = primals_and_tangents(SINGLE)

    def exact(step):
        heights, o, d = (np.asarray(x, float) + step * np.asarray(dx, float) for x, dx in zip(primals, tangents, strict=True))
        hit = oracle.cast(heights, *MILD[1:], o, d)
        ns, *_ = oracle.shading_normals(heights, MILD.dx, MILD.dy, hit.place, "six")
        return np.concatenate([hit.t[:, None], hit.place.p, hit.place.n, ns, hit.place.uv], axis=1)

    numeric = (exact(1e-6) - exact(-1e-6)) / 2e-6
    forward = np.asarray(forward_mode(primals, tangents)[1])
    scale = np.maximum(np.abs(numeric), np.abs(numeric).max(axis=1, keepdims=True))
    assert np.all(np.abs(forward[:, : numeric.shape[1]] - numeric) <= 2e-5 * scale)  # 2.4e-6 was seen: 40 roundings
    assert np.all(np.median(np.abs(numeric), axis=0) > 1e-3)
    weights = np.random.default_rng(14).normal(size=forward.shape) / np.abs(forward).max(axis=1, keepdims=True)
    product = sum(np.vdot(*pair) for pair in zip(reverse_mode(primals, jnp.asarray(weights, SINGLE)), tangents, strict=True))
    np.testing.assert_allclose(product, np.vdot(weights, forward), rtol=1e-4)


@pytest.mark.deep
@pytest.mark.x64  # central differences of what is tested, of all outputs
def test_derivatives_match_central_differences():
    primals, tangents = primals_and_tangents(np.float64)
    step = 1e-7
    ahead, behind = (
        forward_mode(tuple(x + s * step * dx for x, dx in zip(primals, tangents, strict=True)), tangents)[0] for s in (1, -1)
    )
    numeric, forward = np.asarray(ahead - behind) / (2 * step), np.asarray(forward_mode(primals, tangents)[1])
    # The differences' own errors: rounding of 1e-16 over the step, and the square of the step times third derivatives.
    scale = np.maximum(np.abs(numeric), np.abs(numeric).max(axis=1, keepdims=True))
    assert np.all(np.abs(forward - numeric) <= 1e-6 * scale)
    assert np.all(np.median(np.abs(numeric), axis=0) > 1e-3)


def test_misses_have_zero_derivatives():
    """Past the box, away from it, level over a flat field, not valid: no nan, and no t that moves, but for hits beside them."""
    rays = aimed.aimed("miss", MILD, 48, seed=14)
    level = np.array([[-4.0, 11.0, 5.0], [-4.0, 11.0, 0.0], [-2.0, 12.0, 0.0], [np.nan, 0, 0], [0, 0, 9.0], [0, 12.0, 1.0]])
    ahead = np.array([[1.0, 0.3, 0.0], [1.0, 0.3, 0.0], [1.0, 0.0, 0.0], [0, 0, 1.0], [0, 0, 0.0], [0, 0, 1.0]])
    flat = np.zeros_like(MILD.heights), np.tile(level, (8, 1)), np.tile(ahead, (8, 1))
    for values in ((MILD.heights, rays.o, rays.d), flat):
        primals = tuple(jnp.asarray(value, SINGLE) for value in values)
        found, forward = forward_mode(primals, jax.tree.map(jnp.ones_like, primals))
        assert np.all(np.isposinf(found[:, 0]))
        np.testing.assert_array_equal(forward[:, 0], 0)
        assert np.all(np.isfinite(forward))
        for gradient in reverse_mode(primals, jnp.zeros_like(forward).at[:, 0].set(1)):
            np.testing.assert_array_equal(gradient, 0)
        for gradient in reverse_mode(primals, jnp.ones_like(forward)):
            assert np.all(np.isfinite(gradient))
    o = np.tile([[0.0, 11.0, 5.0], [50.0, 11.0, 5.0], [np.inf, 0.0, 0.0], [1e30, 11.0, 5.0]], (12, 1))
    primals = tuple(jnp.asarray(value, SINGLE) for value in (MILD.heights, o, np.tile(DOWN, (48, 1))))
    slope = reverse_mode(primals, jnp.zeros_like(forward).at[:, 0].set(1))[0]
    assert slope.sum() == pytest.approx(-12, rel=1e-5)  # lifting the field by 1 brings each hit closer by 1


# What `cast` takes.


def test_shapes_and_precision():
    field = heightfield(MILD, SINGLE)
    o, d = np.broadcast_to([0.0, 11.0, 5.0], (2, RAYS // 2, 3)), DOWN
    hit = jaxhf.cast(field, o, d)
    assert [value.shape[2:] for value in (hit.status, hit.p, hit.uv, hit.cell)] == [(), (3,), (2,), (2,)]
    one = jaxhf.cast(field, o[0, 0], d)
    assert (hit.p.shape[:2], one.status.shape, one.ns.shape) == ((2, RAYS // 2), (), (3,))
    for ray in (hit, one):
        assert {value.dtype for value in (ray.t, ray.p, ray.n, ray.ns, ray.uv, ray.dp_du, ray.dn_du)} == {np.dtype(SINGLE)}
    empty = jaxhf.cast(field, np.zeros((0, 3)), np.zeros((0, 3)))
    assert empty.t.shape == (0,)
    for o, d in ((np.zeros(2), DOWN), (np.zeros(3), np.zeros((3, 2)))):
        with pytest.raises(ValueError, match="must have shape"):
            jaxhf.cast(field, o, d)


def test_rays_from_whole_numbers_start_there():
    """Beside a corner at (-2.5, 9.5); the same in NumPy, where they were floats before it was subtracted."""
    field = heightfield(MILD._replace(x0=-2.5, y0=9.5), SINGLE)
    o, d = np.array([0, 12, 5]), np.array([0, 0, -1])
    expected, found = jaxhf.cast(field, o, d), jaxhf.cast(field, jnp.asarray(o), jnp.asarray(d))
    np.testing.assert_array_equal(found.p, expected.p)
    np.testing.assert_array_equal(found.p[:2], (0, 12))


FAR = MILD._replace(x0=5e5, y0=4.5e6)  # where single precision has steps of 0.03 and of 0.5


FROM = (5e5 + 1, 4.5e6 - 3, 6), (5e5 + 2, 4.5e6 + 6, 0)


def far_scene(world: np.ndarray | None = None) -> jaxhf.Scene:
    camera = jaxhf.Perspective.look_at(*FROM, width=8, height=8)
    return jaxhf.Scene([jaxhf.Object(heightfield(FAR, SINGLE), None, world)], camera)


def test_a_camera_casts_in_the_frame_of_the_world():
    """Its rays by hand: those of the same pixels meet the terrain where the oracle says."""
    x, y = np.array([3.5, 4.5, 4.5]), np.array([3.5, 4.5, 6.5])
    d = oracle.view_rays(*FROM, 45, 8, 8)[y.astype(int), x.astype(int)]
    expected = oracle.cast(*FAR, np.broadcast_to(FROM[0], d.shape), d)
    seen = cast_camera(far_scene(), x, y)
    np.testing.assert_array_equal(seen.status, expected.status)
    np.testing.assert_allclose(seen.t, expected.t, rtol=1e-5)
    np.testing.assert_allclose(seen.uv, expected.place.uv, atol=1e-5)
    assert (expected.status == oracle.HIT).all()


def test_under_jit_and_vmap():
    """The same answers inside of a compiled function, over a batch of heights, and ray by ray."""
    o, d = (jnp.asarray(value, SINGLE) for value in slanted())
    stack = jnp.stack([jnp.asarray(MILD.heights, SINGLE), 2 * jnp.asarray(MILD.heights, SINGLE)])

    @functools.partial(jax.jit, compiler_options=compiler_options(newer=True))  # as users do
    @functools.partial(jax.vmap, in_axes=(0, None, None))
    def mapped(z, o, d):
        return jax.vmap(lambda o, d: jaxhf.cast(jaxhf.Heightfield(z, *MILD[1:]), o, d))(o, d)

    found = mapped(stack, o, d)
    for k in range(2):
        plain, one = numpied(jaxhf.cast(jaxhf.Heightfield(stack[k], *MILD[1:]), o, d)), numpied(found)
        np.testing.assert_array_equal(one["status"][k], plain["status"])
        for name, value in plain.items():  # another program may round elsewhere; t at grazing angles is the most sensitive
            met = plain["status"] == HIT
            np.testing.assert_allclose(one[name][k][met], value[met], rtol=1e-4, atol=1e-4, err_msg=name)
    assert np.any(np.asarray(found.t[0]) != np.asarray(found.t[1]))


def test_into_a_scene():
    """At the vertices of a terrain far from the origin, whose object is moved; the same bits where it was prepared."""
    scene = far_scene(translate(10.0, 0.0, 3.0))
    x, y = np.meshgrid(np.arange(1, 8), np.arange(1, 6))
    o, d = np.stack([5e5 + 10 + 0.5 * x, 4.5e6 + 2.0 * y, 9.0 + 0 * x], -1), DOWN
    hit = jaxhf.cast(scene, o, d)
    np.testing.assert_array_equal(hit.status, HIT)
    np.testing.assert_allclose(hit.p[..., 2], MILD.heights[1:6, 1:8] + 3, rtol=4 * EPS)
    prepared = jaxhf.prepare(scene)
    np.testing.assert_array_equal(jaxhf.cast(prepared, o, d).p, hit.p)
    with pytest.raises(ValueError, match="leaving needs a heightfield alone"):
        jaxhf.cast(scene, None, d, leaving=hit)
    with pytest.raises(ValueError, match="it cannot be cast into with"):
        jaxhf.cast(prepared, o, d, jaxhf.Settings(shading="flat"))


def test_batch_of_heightfields():
    """Each with rays of its own, two in a chunk, with one that is made up: what they meet alone; the same where prepared."""
    o, d = (np.stack([np.roll(value, k, axis=0) for k in range(5)]) for value in slanted())
    heights = np.stack([MILD.heights * scale for scale in (1.0, 0.8, -1.2, 0.5, 2.0)]).astype(SINGLE)
    fields = jax.vmap(lambda z: jaxhf.Heightfield(z, *MILD[1:]))(jnp.asarray(heights))
    settings = jaxhf.Settings(chunk=2 * RAYS)
    together, prepared = jaxhf.cast(fields, o, d, settings), jaxhf.prepare(fields, settings)
    assert together.p.shape == (5, RAYS, 3)
    for name, value in numpied(jaxhf.cast(prepared, o, d)).items():
        np.testing.assert_allclose(value, numpied(together)[name], rtol=1e-5, atol=1e-5, err_msg=name)
    with pytest.raises(ValueError, match=r"the heightfield was prepared with .*, it cannot be cast into with"):
        jaxhf.cast(prepared, o, d, jaxhf.Settings(shading="flat"))
    for k in range(5):
        alone = numpied(jaxhf.cast(jaxhf.Heightfield(heights[k], *MILD[1:]), o[k], d[k]))
        assert (alone["status"] == HIT).mean() > 0.5
        for name in alone:
            np.testing.assert_allclose(numpied(together)[name][k], alone[name], rtol=1e-4, atol=1e-4, err_msg=name)
    with pytest.raises(ValueError, match=r"must begin with the axes \(5,\) of the heightfields"):
        jaxhf.cast(fields, o[0], d[0])
