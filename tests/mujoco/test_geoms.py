"""Rays and sensors among several geoms, against MuJoCo's rays, closed forms and differences."""

import dataclasses
import types
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hfields import SIZE, heights, matrix, model_of, mujoco, mujocos_rays

import jaxhf
from jaxhf.core.errors import ArgumentError
from jaxhf.mujoco import Geoms, HField, Scan, depth_image, height_scan, lidar, lidar_pattern, ray
from jaxhf.mujoco.pose import quaternion, rotation

MODEL, DATA = model_of(np.random.default_rng(3), 3, 10)
DOUBLE = [pytest.mark.x64, pytest.mark.deep]


def any_rays(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """From anywhere in the room to anywhere, with directions of any length; a part of them starts within a geom."""
    random = np.random.default_rng(seed)
    o, to = random.uniform(-4, 4, (2, count, 3))
    d = (to - o) * 10 ** random.uniform(-3, 3, (count, 1))
    return tuple(value.astype(np.float32).astype(float) for value in (o, d))


def met_by(scan: Scan) -> np.ndarray:
    assert scan.geom is not None
    return np.asarray(scan.geom)


def in_precision(geoms: Geoms, dtype: Any) -> Geoms:
    fields = [HField(np.asarray(field.data, dtype), field.size, field.pos, field.quat) for field in geoms.hfields]
    return Geoms(fields, geoms.kinds, geoms.size, geoms.pos, geoms.quat, geoms.ids, geoms.fixed)


@pytest.mark.parametrize(("dtype", "tolerance"), [(np.float32, 1e-5), pytest.param(np.float64, 1e-12, marks=DOUBLE)])
def test_the_nearest_is_mujocos(dtype, tolerance):
    o, d = any_rays(8000)
    t, n, geom = mujocos_rays(MODEL, DATA, o, d)
    scan = ray(in_precision(Geoms.from_model(MODEL), dtype).at(DATA), o, d)
    # By the part of a difference that leads away from what was met: along a grazing ray roundings are drawn out.
    off = np.abs(np.asarray(scan.dist) - t) * np.abs((d * n).sum(1))
    wrong = (met_by(scan) != geom) | (off > tolerance) | (np.abs(np.asarray(scan.n) - n).max(1) > 100 * tolerance)
    assert wrong.sum() <= (2 if dtype == np.float32 else 0), np.flatnonzero(wrong)  # past an edge
    assert len(set(geom) - {-1}) >= MODEL.ngeom - 1  # one is hidden by others
    assert 0.1 < np.mean(t < 0) < 0.9
    np.testing.assert_array_equal(scan.mask, scan.dist >= 0)
    right = ~wrong & (t >= 0)
    at = o + np.asarray(scan.dist)[:, None] * d
    np.testing.assert_allclose(scan.p[right], at[right], atol=tolerance * np.abs(at).max())


def test_each_of_a_batch_has_its_own_poses():
    """As MJX's data, with rotations as 3 x 3; the height field that nothing moves is one for all."""
    states = []
    for seed in (0, 1, 2):
        state = mujoco.MjData(MODEL)
        state.qpos[:] = DATA.qpos + 0.3 * np.random.default_rng(seed).normal(size=MODEL.nq)
        mujoco.mj_forward(MODEL, state)
        states.append(state)
    batch = types.SimpleNamespace(
        geom_xpos=jnp.asarray(np.stack([state.geom_xpos for state in states])),
        geom_xmat=jnp.asarray(np.stack([state.geom_xmat.reshape(-1, 3, 3) for state in states])),
    )
    geoms = Geoms.from_model(MODEL)
    assert geoms.fixed == (True, False, False)
    o, d = any_rays(1500, 1)
    o, d = o.reshape(3, 500, 3), d.reshape(3, 500, 3)
    moved = geoms.at(batch)
    assert (moved.batch, moved.hfields[0].batch, moved.hfields[1].batch) == ((3,), (), (3,))
    scan = ray(moved, o, d)
    for k, state in enumerate(states):
        t, _, geom = mujocos_rays(MODEL, state, o[k], d[k])
        off = np.abs(np.asarray(scan.dist[k]) - t) * np.linalg.norm(d[k], axis=1)
        wrong = (met_by(scan)[k] != geom) | (off > 1e-3)
        assert wrong.sum() <= 1

    def within_a_jit(xpos, xmat):
        return ray(geoms.at(types.SimpleNamespace(geom_xpos=xpos, geom_xmat=xmat)), o, d).geom

    found = jax.jit(within_a_jit, compiler_options=jaxhf.compiler_options())(batch.geom_xpos, batch.geom_xmat)
    assert np.mean(found != met_by(scan)) < 1e-3


def test_sensors_meet_what_rays_meet():
    """A scan whose height field is looked up beneath boxes, a lidar and a depth image; and no farther than they reach."""
    ground = HField(heights(9, 6, 1), SIZE)
    geoms = Geoms([ground], ["box", "sphere"], [(0.5, 0.3, 0.2), (0.4, 0, 0)], [(0, 0, 1.2), (1, -0.5, 1)], ids=(7, 5, 6))
    assert geoms.hfields[0].upright
    pos, quat = np.array([0.3, -0.2, 1.5]), np.array([0.8, 0, 0, -0.6])
    scan = height_scan(geoms, pos, quat)
    walked = height_scan(geoms, pos, quat, align="base")  # the same, as the robot stands upright
    np.testing.assert_array_equal(met_by(scan), met_by(walked))
    np.testing.assert_allclose(scan.dist, walked.dist, atol=1e-5)
    assert set(np.unique(met_by(scan))) == {5, 6, 7}
    alone = height_scan(ground, pos, quat)
    assert alone.geom is None
    np.testing.assert_array_equal(alone.heights[met_by(scan) == 7], scan.heights[met_by(scan) == 7])
    np.testing.assert_allclose(scan.heights[met_by(scan) == 5], 1.4, atol=1e-5)

    pattern = lidar_pattern(7, (-60.0, 0.0), (-180.0, 180.0), 14.4)
    met, near = lidar(geoms, pos, quat, pattern), lidar(geoms, pos, quat, pattern, max_range=0.4)
    again = ray(geoms, pos, pattern @ matrix(quat).T)
    np.testing.assert_array_equal(met_by(met), met_by(again))
    within = np.asarray(met.mask & (met.dist <= 0.4))
    assert 10 < within.sum() < int(np.sum(met.mask)) - 10
    np.testing.assert_array_equal(near.mask, within)
    np.testing.assert_array_equal(near.dist, np.where(within, met.dist, -1))
    np.testing.assert_array_equal(met_by(near), np.where(within, met_by(met), -1))
    np.testing.assert_array_equal(near.p[~within], np.broadcast_to(pos.astype(np.float32), (175, 3))[~within])
    # Along the rays, not along the optical axis, and in units of length though directions are longer.
    depth, dist = depth_image(geoms, pos, quat, 25, 7, fovy=120.0)
    cut = depth_image(geoms, pos, quat, 25, 7, fovy=120.0, max_range=1.3)
    within = (dist >= 0) & (dist <= 1.3)
    assert 10 < int(np.sum(within)) < int(np.sum(dist >= 0))
    for kept, all_of_it in zip(cut, (depth, dist), strict=True):
        np.testing.assert_array_equal(kept, np.where(within, all_of_it, -1))


def test_noise_is_along_the_rays():
    ground = HField(heights(9, 6, 1), SIZE)
    pos, quat = np.array([0.3, -0.2, 1.5]), np.array([1.0, 0, 0, 0])
    pattern = 3 * lidar_pattern(7, (-60.0, 0.0), resolution=14.4)
    exact = jax.tree.map(np.asarray, lidar(ground, pos, quat, pattern))
    keys = jax.random.split(jax.random.key(0), 100)
    noisy = jax.vmap(lambda key: lidar(ground, pos, quat, pattern, noise=0.02, key=key))(keys)
    off = 3 * (np.asarray(noisy.dist) - exact.dist)[:, exact.mask]
    assert abs(off.std() / 0.02 - 1) < 0.03
    assert abs(off.mean()) < 4 * 0.02 / np.sqrt(off.size)
    assert abs(np.corrcoef(off[:, :-1].ravel(), off[:, 1:].ravel())[0, 1]) < 4 / np.sqrt(off.size)
    np.testing.assert_allclose(noisy.p[0], pos + np.maximum(noisy.dist[0], 0.0)[:, None] * pattern, atol=1e-5)
    np.testing.assert_array_equal(noisy.dist[:, ~exact.mask], -1)
    depth, dist = depth_image(ground, pos, (1, 0, 0, 0), 25, 7, fovy=120.0, noise=0.02, key=keys[0])
    seen = np.asarray(dist >= 0)
    wanted = depth_image(ground, pos, (1, 0, 0, 0), 25, 7, fovy=120.0)[1]
    assert 0.5 < np.std((dist - wanted)[seen]) / 0.02 < 1.5
    np.testing.assert_allclose(depth[seen] / dist[seen], (depth / dist)[seen])
    loud = lidar(ground, pos, quat, pattern, noise=100.0, key=keys[0])
    assert (np.asarray(loud.dist)[exact.mask] >= 0).all()


def test_derivatives_are_differences():
    """As all geoms move, turn and grow, in double precision; finite where a side meets another geom, too."""
    geoms, random = Geoms.from_model(MODEL), np.random.default_rng(5)
    o, d = any_rays(2000, 2)
    d /= np.linalg.norm(d, axis=1)[:, None]
    turns = random.normal(size=(MODEL.ngeom, 3))

    def met(shift, dtype):
        moved = in_precision(geoms, dtype)
        moved = dataclasses.replace(moved, size=geoms.size * (1 + 0.1 * shift))
        axes = jnp.cross(jnp.asarray(turns, dtype)[:, None], matrices.astype(dtype), axisb=-2, axisc=-2)
        xpos = jnp.asarray(DATA.geom_xpos, dtype) + shift * jnp.asarray(turns[::-1], dtype)
        scan = ray(moved.at(types.SimpleNamespace(geom_xpos=xpos, geom_xmat=matrices.astype(dtype) + shift * axes)), o, d)
        return jnp.column_stack([scan.dist, scan.n, scan.p]), scan.geom

    matrices = DATA.geom_xmat.reshape(-1, 3, 3)
    shift = jnp.float32(0), jnp.float32(1)
    _, along, geom = jax.jvp(lambda shift: met(shift, np.float32), shift[:1], shift[1:], has_aux=True)
    with jax.enable_x64(True):
        sides = [met(jnp.float64(by), np.float64) for by in (-1e-5, 1e-5)]
    same = np.asarray((sides[0][1] == geom) & (sides[1][1] == geom))
    numeric = (np.asarray(sides[1][0]) - np.asarray(sides[0][0])) / 2e-5
    assert same.mean() > 0.99
    assert np.isfinite(along).all()
    off = np.abs(numeric - along).max(1) / (1 + np.abs(numeric).max(1))
    smooth = same & (np.abs(numeric).max(1) < 1e3)  # not beyond an edge between the two
    assert np.quantile(off[smooth], 0.99) < 1e-3
    assert not np.any(np.asarray(along)[np.asarray(geom) < 0, :4])
    assert np.abs(numeric[smooth]).max(0).min() > 0.1


@pytest.mark.parametrize("kind", ["sphere", "ellipsoid", "capsule", "cylinder", "box"])
@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_far_starts_and_directions_of_any_length(kind, scale):
    """A body from a thousand times its size away, and from within, in single precision: off by a few roundings of the way."""
    size = scale * np.array([0.5, 0.5, 0.5])
    geoms = Geoms((), [kind], [size], [(0.0, 0.0, 0.0)])
    for away in (3.0, 30.0, 1000.0):
        for length in (1e-12, 1.0, 1e12):
            o = np.array([away * scale, 0.01 * scale, 0.02 * scale], np.float32).astype(float)
            scan = ray(geoms, o, np.array([-length, 0.0, 0.0]))
            y, z = o[1:] / scale
            x = {
                "sphere": np.sqrt(0.25 - y * y - z * z), "ellipsoid": np.sqrt(0.25 - y * y - z * z),
                "capsule": np.sqrt(0.25 - y * y), "cylinder": np.sqrt(0.25 - y * y), "box": 0.5,
            }[kind] * scale  # fmt: skip
            assert scan.dist * length == pytest.approx(o[0] - x, abs=4e-7 * away * scale)
    scan = ray(geoms, np.zeros(3), np.array([0.0, -3.0, 0.0]))
    assert scan.dist == pytest.approx(0.5 * scale / 3, rel=1e-6)
    np.testing.assert_allclose(scan.n, [0, -1, 0], atol=1e-6)
    nothing = ray(geoms, np.full((3, 3), 2 * scale), np.array([[0.0, 0, 0], [np.nan, 1, 0], [1, 1, 1]]))
    np.testing.assert_array_equal(nothing.dist, -1)
    np.testing.assert_array_equal(met_by(nothing), -1)
    assert not np.any(nothing.n)


def test_no_ray_slips_through_between_two_faces():
    """At the edges and corners of a box that is turned, and at the rims of a cylinder and a capsule, from all sides."""
    random, count = np.random.default_rng(0), 3000
    quat = random.normal(size=4)
    turn = matrix(quat)
    phi, corner = random.uniform(0, 2 * np.pi, count), random.choice([-1.0, 1.0], (count, 3))
    edge = np.where(np.arange(3) == random.integers(0, 3, count)[:, None], random.uniform(-1, 1, (count, 3)), corner)
    rim = np.stack([np.cos(phi), np.sin(phi), random.choice([-1.0, 1.0], count)], 1)
    for kind, places in (("box", corner), ("box", edge), ("cylinder", rim), ("capsule", rim)):
        # Through the rim to a place within, so that a ray that misses one face would have to meet the other.
        o = 3 * places + random.uniform(-0.3, 0.3, (count, 3))
        body, at = Geoms((), [kind], [(1.0, 1.0, 1.0)], [(0.1, 0.2, 0.3)], [quat]), np.array([0.1, 0.2, 0.3])
        scan = ray(body, o @ turn.T + at, (0.99 * places - o) @ turn.T)
        assert np.all(scan.mask)
        assert np.all((scan.dist > 0.5) & (scan.dist < 1.0001))


def test_a_ray_that_touches_a_body_meets_it_or_what_is_behind():
    """Bisected to the silhouette, where a search and its derivatives may round to either side: never nothing."""
    random, count = np.random.default_rng(0), 4000
    for kind in ("sphere", "capsule", "ellipsoid", "cylinder", "box"):
        quat, middle = random.normal(size=4), np.array([0.1, 0.2, 3.0])
        body = Geoms((), [kind, "plane"], [(0.4, 0.7, 0.5), (0, 0, 1)], [middle, (0, 0, -2)], [quat, (1, 0, 0, 0)])
        o = np.array([0.3, 0.1, 30.0]) + random.uniform(-0.1, 0.1, (count, 3))
        phi = random.uniform(0, 2 * np.pi, count)
        inside, outside = np.tile(middle, (count, 1)), middle + 3 * np.stack([np.cos(phi), np.sin(phi), 0 * phi], 1)
        for _ in range(25):
            between = (inside + outside) / 2
            hits = met_by(ray(body, o, between - o))[:, None] == 0
            inside, outside = np.where(hits, between, inside), np.where(hits, outside, between)
        for end in (inside, outside):
            scan = ray(body, o, end - o)
            assert np.all(scan.mask)
            np.testing.assert_allclose(np.linalg.norm(scan.n, axis=1), 1, atol=1e-5)


def test_a_miss_ends_at_its_start():
    far = Geoms((), ["box"], [(1.0, 1, 1)], [(1e6, 3e5, 0)])
    o = np.array([[0.123, 0.456, 0.789], [1, np.nan, 2]], np.float32)
    scan = ray(far, o, np.array([0.0, 0, 1]))
    np.testing.assert_array_equal(scan.p, o)
    assert not np.any(scan.mask)


def test_ranges_of_directions_of_any_length():
    ground = Geoms((), ["plane"], [(0.0, 0, 1)], [(0.0, 0, 0)])
    for length in (1e-25, 1.0, 1e25):
        for most, reached in ((4.0, False), (5.0, True)):
            scan = ray(ground, np.array([0, 0, 4.7]), np.array([0, 0, -length]), max_range=most)
            assert bool(scan.mask) is reached


def test_bounds_at_hand_move_with_a_height_field():
    geoms = Geoms.from_model(MODEL, np.flatnonzero(MODEL.geom_type == mujoco.mjtGeom.mjGEOM_HFIELD)[:2].tolist())
    moved, prepared = geoms.at(DATA), geoms.prepared().at(DATA)
    assert prepared.hfields[1]._grid is not None
    o, d = any_rays(500, 4)
    np.testing.assert_array_equal(met_by(ray(moved, o, d)), met_by(ray(prepared, o, d)))
    two = types.SimpleNamespace(geom_xpos=np.stack([DATA.geom_xpos] * 2), geom_xmat=np.stack([DATA.geom_xmat] * 2))
    both = ray(geoms.prepared().at(two), np.stack([o, o]), np.stack([d, d]))
    np.testing.assert_array_equal(met_by(both), np.stack([met_by(ray(moved, o, d))] * 2))


def test_quaternions_of_rotations():
    """Of all ways in which they may be turned, half turns too."""
    random = np.random.default_rng(0)
    quats = np.concatenate([random.normal(size=(50, 4)), np.eye(4), 1.0 - np.eye(4)])
    for quat in quats:
        np.testing.assert_allclose(rotation(quaternion(jnp.asarray(matrix(quat)))), matrix(quat), atol=1e-6)


def test_a_program_has_the_kinds_that_there_are():
    """One box more changes no operation; a sphere beside it does."""
    o, d = any_rays(4, 3)

    def operations(*kinds):
        geoms = Geoms((), kinds, np.ones((len(kinds), 3)), np.zeros((len(kinds), 3)))
        return str(jax.make_jaxpr(lambda geoms: ray(geoms, o, d).dist)(geoms)).count("sqrt")

    assert operations("box") == operations("box", "box") < operations("box", "sphere")


def test_what_rays_do_not_see_is_left_out():
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><asset><material name="glass" rgba="1 1 1 0"/></asset><worldbody>
        <geom type="box" size="1 1 1" rgba="0 0 0 0"/><geom type="box" size="1 1 1" material="glass"/>
        <geom name="ball" type="sphere" size="1"/></worldbody></mujoco>"""
    )
    assert Geoms.from_model(model).ids == (2,)
    assert Geoms.from_model(model, [0, "ball"]).ids == (0, 2)


MESH = mujoco.MjModel.from_xml_string(
    """<mujoco><asset><mesh name="m" vertex="0 0 0 1 0 0 0 1 0 0 0 1"/></asset><worldbody>
    <geom type="mesh" mesh="m"/></worldbody></mujoco>"""
)


def box(hfields=(), kinds=("box",), size=((1.0, 1.0, 1.0),), pos=((0.0, 0.0, 0.0),), **more):
    return Geoms(hfields, kinds, size, pos, **more)


FIELD = HField(heights(3, 3), SIZE)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: Geoms(), "Geoms: hfields must have one, where there is no primitive either"),
        (lambda: Geoms([cast("HField", SIZE)]), r"Geoms: hfields\[0\] must be a jaxhf.mujoco.HField, it is a"),
        (lambda: box(kinds=["cone"]), r"Geoms: kinds\[0\] must be one of plane, sphere, .*; it is 'cone'"),
        (lambda: box(size=[(1.0, 1)]), r"Geoms: size must have shape \(1, 3\), its shape is \(1, 2\)"),
        (lambda: box(size=[(1.0, 0, 1)]), r"Geoms: size\[0\] must be positive of a box, it is \[1.0, 0.0, 1.0\]"),
        (lambda: box(pos=None), r"Geoms: pos must have shape \(..., 1, 3\), its shape is \(0,\)"),
        (lambda: box(quat=[(0.0, 0, 0, 0)]), "Geoms: quat must not be zero"),
        (lambda: box(quat=[[(1.0, 0, 0, 0)]]), r"Geoms: quat must have shape \(1, 4\), its shape is \(1, 1, 4\)"),
        (lambda: box(ids=(1, 2)), "Geoms: ids must have 1 value, one of each geom, it has 2"),
        (lambda: box([HField(np.stack([heights(3, 3)] * 2), SIZE)], pos=np.zeros((3, 1, 3))),
         r"Geoms: hfields\[0\] must have the axes \(3,\) of the others, or none, it has \(2,\)"),
        (lambda: Geoms.from_model(MESH), "Geoms.from_model: geoms must be height fields and primitives, 0 is a mesh: leave"),
        (lambda: Geoms.from_model(MODEL, "g"), "Geoms.from_model: geoms must be several, in a list, it is 'g'"),
        (lambda: Geoms.from_model(MODEL, cast("list", 1)), "Geoms.from_model: geoms must be several, in a list, it is an int"),
        (lambda: Geoms.from_model(MODEL, [cast("int", 1.5)]), "Geoms.from_model: geoms must be a geom's number or name, it is"),
        (lambda: Geoms.from_model(3), "Geoms.from_model: model must be a mujoco.MjModel, or MJX's, it is an int"),
        (lambda: Geoms(cast("list", FIELD)), "Geoms: hfields must be several, in a list, it is a HField"),
        (lambda: box(kinds="box"), "Geoms: kinds must be several, in a list, it is 'box'"),
        (lambda: box(ids=5), "Geoms: ids must be several, in a list, it is an int"),
        (lambda: box(ids=("a",)), r"Geoms: ids\[0\] must be a whole number from 0 on, it is 'a'"),
        (lambda: box(size=[(1, 2), (3,)]), "Geoms: size must be numbers, it is a list"),
        (lambda: box(pos=np.zeros((3, 1, 3))).at(DATA), r"Geoms.at: data must have the axes \(3,\) of the geoms"),
        (lambda: lidar(FIELD, np.zeros(3), (1.0, 0, 0, 0), noise=0.1, key=cast("jax.Array", 3)), "lidar: key must be"),
        (lambda: Geoms.from_model(MODEL, [99]), r"Geoms.from_model: geoms must be a number from 0 to \d+, it is 99"),
        (lambda: box().at(MODEL), "Geoms.at: data must be a simulation's, .*, it is a MjModel"),
        (lambda: box(ids=(99,)).at(DATA), r"Geoms.at: data must have the geoms .*, 99 among them, it has 13"),
        (lambda: ray(box(), np.zeros(3), np.ones(3), max_range=0.0), "ray: max_range must be positive and finite"),
        (lambda: lidar(FIELD, np.zeros(3), (1.0, 0, 0, 0), noise=0.1), "lidar: key must be one key of jax.random"),
        (lambda: lidar(FIELD, np.zeros(3), (1.0, 0, 0, 0), noise=-1.0, key=jax.random.key(0)), "lidar: noise must be positive"),
    ],
)  # fmt: skip
def test_says_what_is_wrong(call, message, as_users_call_it):
    with pytest.raises(ArgumentError, match=f"^{message}"):
        call()
