"""Height scans against MuJoCo's rays, walks, the closed form of a plane and central differences."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hfields import SIZE, Reference, heights, matrix

import jaxhf
from jaxhf.core.errors import ArgumentError
from jaxhf.mujoco import Geoms, HField, grid_pattern, height_scan, ray

GROUNDS = np.stack([heights(9, 6, seed) for seed in (1, 2)]).astype(np.float64)
TURN, PLACE = (0.8, 0, 0, -0.6), np.array([[0.0, 0, 0], [7, -3, 0.4]])
FIELDS = HField(GROUNDS.astype(np.float32), SIZE, PLACE, TURN)
DOUBLE = [pytest.mark.x64, pytest.mark.deep]
PLACES = grid_pattern()[:175]  # with 16 robots as many rays as in the tests of rays, and the same program


def robots(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Of each height field, some of which stand so near its border that a part of their scan misses it."""
    random = np.random.default_rng(0)
    pos = PLACE[:, None] + random.uniform([-3, -3, 0.5], [3, 3, 1], (2, count, 3))
    quat = random.normal(size=(2, count, 4)) * [1, 0.2, 0.2, 1]
    return pos, quat


def test_isaac_labs_grid():
    """As its patterns.grid_pattern makes them: 17 x 11 places, x fastest."""
    places = grid_pattern()
    assert places.shape == (187, 2)
    np.testing.assert_allclose(places[[0, 1, 17, -1]], [[-0.8, -0.5], [-0.7, -0.5], [-0.8, -0.4], [0.8, 0.5]], atol=1e-12)


def walking(field: HField) -> HField:
    """As where its quat is traced."""
    field = HField(field.data, field.size, field.pos, field.quat)
    object.__setattr__(field, "upright", False)
    return field


@pytest.mark.parametrize(("align", "offset"), [("yaw", 20.0), ("base", 20.0), ("world", 20.0), ("world", 1.5), ("base", 1.5)])
def test_scans_are_those_of_mujocos_rays(align, offset):
    """Of two height fields with 16 robots each; some rays miss, and from so low an offset some start below the surface."""
    pos, quat = robots(16)
    scan = height_scan(FIELDS, pos, quat, PLACES, align=align, offset=offset)
    assert scan.dist.shape == (2, 16, 175)
    assert 0.5 < np.mean(scan.mask) < 0.95
    for k, robot in ((0, 1), (0, 14), (1, 2), (1, 5)):
        turn = matrix(quat[k, robot])
        heading = matrix([np.cos(np.arctan2(turn[1, 0], turn[0, 0]) / 2), 0, 0, np.sin(np.arctan2(turn[1, 0], turn[0, 0]) / 2)])
        turn = {"yaw": heading, "base": turn, "world": np.eye(3)}[align]
        o = pos[k, robot] + np.column_stack([PLACES, np.full(len(PLACES), offset)]) @ turn.T
        stands = " ".join(map(str, PLACE[k]))
        t, n = Reference(GROUNDS[k], SIZE, f'pos="{stands}" quat=".8 0 0 -.6"')(o, np.tile(-turn[:, 2], (len(PLACES), 1)))
        np.testing.assert_array_equal(scan.mask[k, robot], t >= 0)
        np.testing.assert_allclose(scan.dist[k, robot], t, atol=2e-5)
        np.testing.assert_allclose(scan.n[k, robot], n, atol=1e-4)
        p = np.where((t < 0)[:, None], o, o - t[:, None] * turn[:, 2])
        np.testing.assert_allclose(scan.p[k, robot], p, atol=2e-5)
        np.testing.assert_array_equal(scan.heights[k, robot], scan.p[k, robot, :, 2])


@pytest.mark.deep
@pytest.mark.optimised
def test_look_up_has_the_walks_bits():
    """The last four robots stand on vertices: a rounding settles on whose plane their places are, or if beside the border."""
    field = jax.tree.map(lambda leaf: leaf[1], FIELDS)
    pos, quat = (value[1] for value in robots(16))
    pos[-4:], quat[-4:] = PLACE[1] + [[0, 0, 0.8], [0, 1.25, 0.8], [0, -2.5, 0.8], [1.2, 1.25, 0.8]], TURN
    assert field.upright
    looked_up, walked = (height_scan(one, pos, quat, PLACES) for one in (field, walking(field)))
    for name in ("mask", "p", "dist"):
        np.testing.assert_array_equal(getattr(looked_up, name)[:12], getattr(walked, name)[:12], name)
        close, exact = (np.asarray(getattr(scan, name))[looked_up.mask & walked.mask] for scan in (looked_up, walked))
        np.testing.assert_allclose(close, exact, rtol=0, atol=1e-5, err_msg=name)
    assert np.mean(looked_up.mask != walked.mask) < 0.01
    np.testing.assert_allclose(looked_up.n[:12], walked.n[:12], rtol=0, atol=5e-7)
    np.testing.assert_array_equal(looked_up.dist[~looked_up.mask], -1)
    np.testing.assert_array_equal(looked_up.n[~looked_up.mask], 0)


@pytest.mark.parametrize(("dtype", "rtol"), [(np.float32, 1e-4), pytest.param(np.float64, 1e-6, marks=DOUBLE)])
def test_gradient_matches_central_differences(dtype, rtol):
    """In the heights, size and place of the height fields and in the robots' poses; the differences are in double precision."""
    pos, quat = robots(3)
    numbers = GROUNDS, np.tile(SIZE, (2, 1)), PLACE, np.tile(TURN, (2, 1)), pos, quat
    random, eps = np.random.default_rng(2), 1e-7
    weights = random.normal(size=(2, 3, 187))
    tangents = [random.normal(size=value.shape) for value in numbers]
    tangents[3][:, 1:3] = 0  # else the field is upright no longer; its tilt is in the test of rays
    structure = jax.tree.structure(HField(GROUNDS, SIZE, PLACE, TURN))

    def weighted(numbers):
        fields = jax.tree.unflatten(structure, numbers[:4])
        assert fields.upright
        scan = height_scan(fields, numbers[4], numbers[5])
        return (jnp.asarray(weights, numbers[4].dtype) * (scan.heights + scan.n.sum(-1) - scan.dist)).sum(), scan.mask.mean()

    gradient = jax.jit(jax.grad(weighted, has_aux=True), compiler_options=jaxhf.compiler_options())
    slopes, seen = gradient(tuple(value.astype(dtype) for value in numbers))
    assert 0.1 < seen < 0.95
    along = [np.vdot(slope, tangent) for slope, tangent in zip(slopes, tangents, strict=True)]
    assert all(abs(part) > 1e-2 for part in along)
    with jax.enable_x64(True):
        moved = (
            tuple(value + sign * eps * tangent for value, tangent in zip(numbers, tangents, strict=True)) for sign in (1, -1)
        )
        (ahead, _), (behind, _) = map(jax.jit(weighted), moved)
    np.testing.assert_allclose(sum(along), (float(ahead) - float(behind)) / (2 * eps), rtol=rtol)


def test_a_batch_of_none_meets_nothing():
    field = HField(GROUNDS[:0].astype(np.float32), SIZE)
    pos, quat = np.zeros((0, 3)), np.zeros((0, 4))
    for geoms in (field, field.prepared(), Geoms([field], ["sphere"], [(1, 1, 1)], np.zeros((0, 1, 3)))):
        for scan in (ray(geoms, pos, pos), *(height_scan(geoms, pos, quat, PLACES[:5], align=way) for way in ("yaw", "base"))):
            assert scan.p.shape == scan.n.shape == (*scan.dist.shape, 3)
            assert scan.mask.shape == scan.dist.shape in ((0,), (0, 5))
            assert (scan.geom is not None) == isinstance(geoms, Geoms)


def test_rays_from_within_the_base_meet_its_bottom():
    """Within the solid they meet its bottom from inside, below it nothing."""
    size = (3.0, 2.0, 1.5, 0.5)
    data = np.random.default_rng(4).uniform(0.2, 1, (5, 7)).astype(np.float32)
    above_bottom = np.array([0.125, 0.375, -0.125])
    pos = np.zeros((3, 3), np.float32)
    pos[:, 2] = -size[3] + above_bottom - 20  # a scan's rays start 20 above
    quat = np.tile(np.array([1, 0, 0, 0], np.float32), (3, 1))
    scan = height_scan(HField(data, size), pos, quat, np.array([[0.3, -0.7], [-1.1, 0.9]], np.float32))
    np.testing.assert_array_equal(scan.mask, [[True] * 2] * 2 + [[False] * 2])
    # One unit in the last place of 20 in single precision, where the start is computed.
    np.testing.assert_allclose(scan.dist, [[0.125] * 2, [0.375] * 2, [-1] * 2], atol=2.0**-19)
    np.testing.assert_array_equal(scan.n[:2], np.broadcast_to([0, 0, -1], (2, 2, 3)))


POS, QUAT = robots(3)
UNKNOWN = object()


scan_fields = functools.partial(height_scan, FIELDS)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: scan_fields(POS[0], QUAT[0]), r"height_scan: pos must have shape \(2, \.\.\., 3\)"),
        (lambda: scan_fields(POS, 0 * QUAT), "height_scan: quat must not be zero"),
        (lambda: scan_fields(POS, (1, 0, 0, 0)), r"height_scan: quat must have shape \(2, 3, 4\).*, its shape is \(4,\)"),
        (lambda: scan_fields(POS, QUAT, align="roll"), "height_scan: align must be one of yaw, base, world"),
        (lambda: scan_fields(POS, QUAT, np.zeros((3, 3))), r"height_scan: pattern must have shape \(n, 2\)"),
        (lambda: scan_fields(POS, QUAT, offset=np.nan), "height_scan: offset must be finite, it is nan"),
        (lambda: scan_fields(POS, QUAT, offset=(1, 2)), r"height_scan: offset must be one number, its shape is \(2,\)"),
        # Such as MJX's data, whose numbers are meant.
        (lambda: scan_fields(UNKNOWN, UNKNOWN), "height_scan: pos must be numbers, it is an object"),
        (lambda: scan_fields(FIELDS, FIELDS), "height_scan: pos must be numbers, it is a HField"),
        (lambda: scan_fields(None, None), "height_scan: pos must be numbers, it is a NoneType"),
        (lambda: ray(FIELDS, POS, "down"), "ray: vec must be numbers, it is a str"),
        (lambda: HField(UNKNOWN, SIZE), "HField: data must be an array of real numbers, they are an object"),
        (lambda: HField(GROUNDS, "large"), "HField: size must be numbers, it is a str"),
        (lambda: grid_pattern(resolution=0.0), "grid_pattern: resolution must be positive and finite, it is 0.0"),
        (lambda: grid_pattern(resolution=np.nan), "grid_pattern: resolution must be positive and finite, it is nan"),
        (lambda: grid_pattern((-1.0, 1.0)), r"grid_pattern: size must not be negative, it is \(-1.0, 1.0\)"),
        (lambda: grid_pattern((1.0, np.inf)), "grid_pattern: size must be finite"),
    ],
)
def test_says_what_is_wrong(call, message):
    with pytest.raises(ArgumentError, match=f"^{message}"):
        call()
