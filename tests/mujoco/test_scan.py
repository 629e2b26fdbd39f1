"""Height scans against walks, against MuJoCo's rays and against central differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hfields import SIZE, Reference, heights, mujoco

import jaxhf
from jaxhf.core.errors import ArgumentError
from jaxhf.mujoco import HField, grid_pattern, height_scan, ray

GROUNDS = np.stack([heights(9, 6, seed) for seed in (1, 2)]).astype(np.float64)
TURN, PLACE = (0.8, 0, 0, -0.6), np.array([[0.0, 0, 0], [7, -3, 0.4]])
FIELDS = HField(GROUNDS, SIZE, PLACE, TURN)
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


def test_look_up_has_the_walks_bits_in_single_precision():
    field = HField(GROUNDS[1].astype(np.float32), SIZE, PLACE[1], TURN)
    pos, quat = (value[1] for value in robots(16))
    looked_up, walked = (height_scan(one, pos, quat, PLACES) for one in (field, walking(field)))
    for name in ("mask", "p", "dist"):
        np.testing.assert_array_equal(getattr(looked_up, name), getattr(walked, name), name)
    np.testing.assert_allclose(looked_up.n, walked.n, rtol=0, atol=5e-7)


def test_look_up_equals_walk_and_mujoco():
    field = jax.tree.map(lambda leaf: leaf[1], FIELDS)
    pos, quat = (value[1] for value in robots(16))
    # The last ones stand on vertices, so that their places are on edges of triangles, up to a rounding.
    pos[-4:], quat[-4:] = PLACE[1] + [[0, 0, 0.8], [0, 1.25, 0.8], [0, -2.5, 0.8], [1.2, 1.25, 0.8]], [0.8, 0, 0, -0.6]
    assert field.upright
    looked_up = height_scan(field, pos, quat, PLACES)
    assert looked_up.dist.shape == (16, 175)
    assert 0.5 < np.mean(looked_up.mask) < 0.95
    walked = height_scan(walking(field), pos, quat, PLACES)
    np.testing.assert_array_equal(looked_up.mask, walked.mask)
    np.testing.assert_array_equal(looked_up.p[:12], walked.p[:12])
    np.testing.assert_array_equal(looked_up.dist[:12], walked.dist[:12])
    np.testing.assert_allclose(looked_up.n[:12], walked.n[:12], rtol=0, atol=1e-15)
    for name in ("p", "dist"):  # on an edge a rounding settles whose plane it is, and whose normal
        np.testing.assert_allclose(getattr(looked_up, name), getattr(walked, name), rtol=0, atol=2e-14, err_msg=name)
    np.testing.assert_array_equal(looked_up.dist[~looked_up.mask], -1)
    np.testing.assert_array_equal(looked_up.n[~looked_up.mask], 0)

    tilted = height_scan(field, pos, quat, PLACES, align="base")
    place = " ".join(map(str, PLACE[1]))
    reference = Reference(GROUNDS[1].astype(np.float32), SIZE, f'pos="{place}" quat=".8 0 0 -.6"')
    for robot in (1, 2, 5):
        matrix = np.empty(9)
        mujoco.mju_quat2Mat(matrix, quat[robot] / np.linalg.norm(quat[robot]))
        matrix = matrix.reshape(3, 3)
        heading = np.arctan2(matrix[1, 0], matrix[0, 0])
        level = np.array([[np.cos(heading), -np.sin(heading), 0], [np.sin(heading), np.cos(heading), 0], [0, 0, 1]])
        for scan, turn in ((looked_up, level), (tilted, matrix)):
            o = pos[robot] + np.column_stack([PLACES, np.full(len(PLACES), 20.0)]) @ turn.T
            t, n = reference(o, np.tile(-turn[:, 2], (len(PLACES), 1)))
            np.testing.assert_allclose(scan.dist[robot], t, atol=1e-10)
            np.testing.assert_allclose(scan.n[robot], n, atol=1e-10)
            np.testing.assert_allclose(scan.heights[robot][t >= 0], (o - t[:, None] * turn[:, 2])[t >= 0, 2], atol=1e-10)


def test_gradient_matches_central_differences():
    """In the heights, size and place of the height fields and in the robots' poses."""
    pos, quat = robots(3)
    numbers = tuple(map(jnp.asarray, (GROUNDS, np.tile(SIZE, (2, 1)), PLACE, np.tile(TURN, (2, 1)), pos, quat)))
    weights = jnp.asarray(np.random.default_rng(1).normal(size=(2, 3, 187)))

    def weighted(numbers):
        fields = jax.tree.unflatten(jax.tree.structure(FIELDS), numbers[:4])
        assert fields.upright
        scan = height_scan(fields, numbers[4], numbers[5])
        return (weights * (scan.heights + scan.n.sum(-1) - scan.dist)).sum(), scan.mask.mean()

    program = jax.jit(jax.value_and_grad(weighted, has_aux=True), compiler_options=jaxhf.compiler_options())
    (_, seen), slopes = program(numbers)
    assert 0.1 < seen < 0.95
    random, eps = np.random.default_rng(2), 1e-7
    tangents = [jnp.asarray(random.normal(size=value.shape)) for value in numbers]
    tangents[3] = tangents[3].at[:, 1:3].set(0)  # else the field is upright no longer; its tilt is in the test of rays
    along = [jnp.vdot(slope, tangent) for slope, tangent in zip(slopes, tangents, strict=True)]
    assert all(abs(part) > 1e-2 for part in along)
    (ahead, _), (behind, _) = (
        program(tuple(value + sign * eps * tangent for value, tangent in zip(numbers, tangents, strict=True)))[0]
        for sign in (1, -1)
    )
    np.testing.assert_allclose(sum(along), (ahead - behind) / (2 * eps), rtol=1e-6)


def test_says_what_is_wrong():
    pos, quat = robots(3)
    with pytest.raises(ValueError, match=r"height_scan: pos must have shape \(2, \.\.\., 3\)"):
        height_scan(FIELDS, pos[0], quat[0])
    with pytest.raises(ValueError, match="quat must not be zero"):
        height_scan(FIELDS, pos, np.zeros((*pos.shape[:-1], 4)))
    with pytest.raises(ValueError, match=r"height_scan: quat must have shape \(2, 3, 4\).*, its shape is \(4,\)"):
        height_scan(FIELDS, pos, (1, 0, 0, 0))
    with pytest.raises(ValueError, match="align must be one of yaw, base, world"):
        height_scan(FIELDS, pos, quat, align="roll")
    with pytest.raises(ValueError, match=r"pattern must have shape \(n, 2\)"):
        height_scan(FIELDS, pos, quat, np.zeros((3, 3)))
    with pytest.raises(ArgumentError, match=r"^height_scan: offset must be finite, it is nan"):
        height_scan(FIELDS, pos, quat, offset=np.nan)
    with pytest.raises(ArgumentError, match=r"^height_scan: offset must be one number, its shape is \(2,\)"):
        height_scan(FIELDS, pos, quat, offset=(1, 2))
    for given in (object(), FIELDS, "robot", None):  # such as MJX's data, whose numbers are meant
        with pytest.raises(ArgumentError, match=r"^height_scan: pos must be numbers, it is an? "):
            height_scan(FIELDS, given, given)
    with pytest.raises(ArgumentError, match=r"^ray: vec must be numbers, it is a str"):
        ray(FIELDS, pos, "down")
    with pytest.raises(ArgumentError, match=r"^HField: data must be an array of real numbers, they are an object"):
        HField(object(), SIZE)
    with pytest.raises(ArgumentError, match=r"^HField: size must be numbers, it is a str"):
        HField(GROUNDS, "large")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"resolution": 0.0}, "resolution must be positive and finite, it is 0.0"),
        ({"resolution": np.nan}, "resolution must be positive and finite, it is nan"),
        ({"size": (-1.0, 1.0)}, r"size must not be negative, it is \(-1.0, 1.0\)"),
        ({"size": (1.0, np.inf)}, "size must be finite"),
    ],
)
def test_patterns_say_what_is_wrong(arguments, message):
    with pytest.raises(ArgumentError, match=f"^grid_pattern: {message}"):
        grid_pattern(**arguments)
