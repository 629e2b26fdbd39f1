"""The oracle against closed forms, and rays that hit by construction: whatever is tested with it rests on this."""

import aimed
import numpy as np
import oracle
import pytest

GRIDS = [(2, 2), (9, 2), (2, 7), (17, 33)]
SCALES = pytest.mark.parametrize("scales", [(1.0,), pytest.param((1e-6, 1e6), marks=pytest.mark.deep)], ids=["one", "far"])
COUNT = 150


def ground(shape, scale=1.0, **placement):
    return aimed.Ground(aimed.random_heights(shape, scale, seed=sum(shape)), **placement)


def grounds(scales):
    return [ground(shape, scale, dx=0.5, dy=2.0, x0=-3.0, y0=10.0) for shape in GRIDS for scale in scales]


@SCALES
@pytest.mark.parametrize("name", aimed.FAMILIES)
def test_what_is_aimed_hits(name, scales):
    count = 0
    for field in grounds(scales):
        for roundable in (False, True):
            rays = aimed.aimed(name, field, COUNT, seed=2, roundable=roundable)
            known = rays.expect != aimed.OPEN
            np.testing.assert_array_equal(oracle.cast(*field, rays.o, rays.d).status[known], rays.expect[known])
            count += known.sum()
    assert count > 100 or name not in ("vertices", "x_edges", "y_edges", "diagonals", "vertical", "miss")


def test_holes_let_rays_through():
    field = ground((17, 33))
    heights = field.heights.copy()
    heights[4, 5], heights[10, 20], heights[16, 32], heights[0, :3] = np.nan, np.inf, -np.inf, np.nan
    o = np.array([[4.5, 3.5, -5.0], [5.5, 4.5, -5.0], [19.5, 9.2, -5.0], [6.5, 4.5, -5.0], [3.2, 0.5, -5.0]])
    hit = oracle.cast(*field._replace(heights=heights), o, np.tile([0.0, 0.0, 1.0], (5, 1)))
    np.testing.assert_array_equal(hit.status, np.repeat([oracle.MISS, oracle.HIT], [3, 2]))
    assert hit.decided.all()


def test_plane():
    """z = 3 + x/2 - y/4 by hand: t = (3 + o.x/2 - o.y/4 - o.z) / (d.z - d.x/2 + d.y/4)."""
    x, y = np.meshgrid(2.0 + 0.5 * np.arange(9), -1.0 + 2.0 * np.arange(5))
    field = aimed.Ground(3 + x / 2 - y / 4, dx=0.5, dy=2.0, x0=2.0, y0=-1.0)
    generator = np.random.default_rng(4)
    target = np.stack([generator.uniform(2.1, 5.9, 300), generator.uniform(-0.9, 6.9, 300)], axis=1)
    target = np.column_stack([target, 3 + target[:, 0] / 2 - target[:, 1] / 4])
    o = generator.uniform(-10, 10, (300, 3))
    d = 3 * (target - o)
    hit = oracle.cast(*field, o, d)
    t = (3 + o[:, 0] / 2 - o[:, 1] / 4 - o[:, 2]) / (d[:, 2] - d[:, 0] / 2 + d[:, 1] / 4)
    np.testing.assert_allclose(t, 1 / 3, rtol=1e-9)
    np.testing.assert_allclose(hit.t, t, rtol=1e-9)
    np.testing.assert_allclose(hit.place.p, target, atol=1e-9)
    np.testing.assert_allclose(hit.place.uv, (target[:, :2] - [2, -1]) / [4, 8], atol=1e-9)
    np.testing.assert_allclose(hit.place.n, np.tile(np.array([-2, 1, 4]) / np.sqrt(21), (300, 1)), atol=1e-14)
    for other in (d + 3 * np.array([9.0, 0.0, 4.5]), -d):  # aimed at (x + 9, y) in the same plane; away
        missed = oracle.cast(*field, o, other)
        assert np.all((missed.status == oracle.MISS) & np.isinf(missed.t))


def test_pyramid():
    """One raised vertex: z = max(0, 1 - max(|x|, |y|, |x - y|)), cut by the half-spaces of a convex body."""
    heights = np.zeros((5, 5))
    heights[2, 2] = 1
    generator = np.random.default_rng(5)
    o = np.column_stack([generator.uniform(-3, 3, (400, 2)), generator.uniform(1.1, 3, 400)])
    target = np.column_stack([generator.uniform(-1.9, 1.9, (400, 2)), np.zeros(400)])
    d = target - o
    faces = np.array([[1, 0, 1], [-1, 0, 1], [0, 1, 1], [0, -1, 1], [1, -1, 1], [-1, 1, 1]], float)
    gap, closing = o @ faces.T - 1, d @ faces.T  # outside of a face while gap + t closing > 0
    t = -gap / closing
    enters = np.max(np.where((closing < 0) & (gap > 0), t, 0), axis=1)
    leaves = np.min(np.where(closing > 0, t, np.inf), axis=1)
    expected = np.where((enters < leaves) & (enters < 1), enters, 1)  # else the floor, at the target
    hit = oracle.cast(heights, 1, 1, -2, -2, o, d)
    assert np.sum(expected < 0.999) > 50
    assert np.all(hit.decided)
    np.testing.assert_allclose(hit.t, expected, rtol=1e-12)


def test_starts_on_the_surface_and_touches():
    flat = np.zeros((3, 3))
    o = np.array([[0.5, 0.3, 0.0], [0.5, 0.3, 0.0], [-1.0, 1.5, 0.0]])
    d = np.array([[0.0, 0.0, 1.0], [0.2, 0.1, -1.0], [1.0, 0.0, 0.0]])
    hit = oracle.cast(flat, 1, 1, 0, 0, o, d)
    assert np.all(hit.status == oracle.MISS)
    assert not np.any(hit.decided[:2])


def test_decided_knows_silhouettes_and_the_border():
    ridge = np.array([[0.0, 1.0, 0.0], [0.0, 1.0, 0.0], [0.0, 1.0, 0.0]])
    # Over or under the ridge, inside or outside of the border, by this much.
    for by in (0.0, -1e-9, 1e-9, -1e-2, 1e-2):
        o, d = np.array([[-3.0, 0.7, 1 + by], [by, 0.7, 3.0]]), np.array([[1.0, 0.1, 0.0], [0.0, 0.0, -1.0]])
        np.testing.assert_array_equal(oracle.cast(ridge, 1, 1, 0, 0, o, d, slack=1e-6).decided, abs(by) > 1e-3)
    # In front of a wall behind the ridge every ray hits, but not at one t.
    wall = np.column_stack([ridge, [2.0, 2.0, 2.0]])
    hit = oracle.cast(wall, 1, 1, 0, 0, np.array([[-3.0, 0.7, 1 + 1e-9]]), np.array([[1.0, 0.1, 0.0]]), slack=1e-6)
    assert hit.decided[0]
    assert [hit.earliest[0], hit.t[0], hit.latest[0]] == pytest.approx([4, 5.5, 5.5], abs=1e-4)


def test_normals_of_one_cell_by_hand():
    """Heights 0, 0, 0 and 1 at vertex 11: the lower triangle has the normal (0, -1, 1), the upper one (-1, 0, 1)."""
    heights = np.array([[0.0, 0.0], [0.0, 1.0]])
    lower, upper, s = np.array([0, -1, 1]), np.array([-1, 0, 1]), np.sqrt(0.5)
    both, three = (lower + upper) / np.linalg.norm(lower + upper), np.array([-1, -1, 1]) / np.sqrt(3)
    rows = {
        "six": [[lower + upper, lower], [upper, lower + upper]],
        "six-equal": [[s * (lower + upper), s * lower], [s * upper, s * (lower + upper)]],
        "six-angle": [
            [both, s * lower],
            [s * upper, both],
        ],  # of length 1; both triangles have the same angles, at 00 and at 11
        # Right-up at 00 is flat; up-left at 10 goes through 11 and 00; left-down at 11 through 01 and 10, with slopes 1 and 1.
        "four": [[[0, 0, 1], s * lower], [s * upper, three]],
        "central": [[[0, 0, 1], [0, -1, 1]], [[-1, 0, 1], [-1, -1, 1]]],
    }
    for scheme, expected in rows.items():
        np.testing.assert_allclose(oracle.vertex_normals(heights, 1, 1, scheme)[0], expected, atol=1e-15, err_msg=scheme)
    x = np.arange(6) * 0.5
    normals = oracle.vertex_normals(np.tile(x**2, (4, 1)), 0.5, 2.0, "central")[0]
    expected = [-0.5, *(-2 * x[1:-1]), -4.5]  # one-sided at the ends of the parabola
    np.testing.assert_allclose(normals[..., 0], np.tile(expected, (4, 1)), atol=1e-14)


@pytest.mark.parametrize("scheme", ["central", "four", "six", "six-angle", "six-equal"])
def test_normals_beside_holes(scheme):
    heights = np.array([[0.0, 1.0, 5.0], [np.nan, 3.0, 4.0], [7.0, 9.0, 2.0]])
    normals, _ = oracle.vertex_normals(heights, 1, 1, scheme)
    np.testing.assert_array_equal(normals[1, 0], [0, 0, 1])
    assert np.all(np.isfinite(normals))
    if scheme == "central":
        np.testing.assert_array_equal(normals[1, 1, :2], [3 - 4, (1 - 9) / 2])
    if scheme == "six":
        np.testing.assert_array_equal(normals[0, 0], [-1, -2, 1])  # of its two triangles one touches the hole


def test_shading_normal_is_the_barycentric_mean():
    heights = aimed.random_heights((4, 5), 1.0, seed=7)
    field = aimed.Ground(heights, dx=0.5, dy=2.0)
    normals, _ = oracle.vertex_normals(heights, 0.5, 2.0, "six")
    x, y = np.array([1.0, 3.0, 2.7, 2.3, 1.5]), np.array([2.0, 1.0, 1.4, 0.6, 1.5])
    o = field.points(x, y) + np.array([0, 0, 3])
    place = oracle.cast(*field, o, np.tile([0.0, 0.0, -1.0], (5, 1))).place
    ns, turn, cancels = oracle.shading_normals(heights, 0.5, 2.0, place, "six")
    parts = [  # weights of vertices (iy, ix)
        {(2, 1): 1.0}, {(1, 3): 1.0}, {(1, 2): 0.3, (1, 3): 0.3, (2, 3): 0.4}, {(0, 2): 0.4, (1, 2): 0.3, (1, 3): 0.3},
        {(1, 1): 0.5, (2, 2): 0.5},
    ]  # fmt: skip
    mean = np.array([sum(weight * normals[at] for at, weight in part.items()) for part in parts])
    np.testing.assert_allclose(ns, mean / np.linalg.norm(mean, axis=1)[:, None], atol=1e-14)
    assert np.all(cancels >= 1 - 1e-12)
    assert np.all(turn > 0)
