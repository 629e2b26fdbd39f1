"""The two ways of the oracle against each other and against closed forms: whatever is tested with it rests on this."""

import aimed
import numpy as np
import oracle
import pytest

GRIDS = [(2, 2), (9, 2), (2, 7), (17, 33)]
COUNT = 150
# Double precision has a rounding of 1.1e-16; a few tens of operations lie behind each g.
SLACK = 1e-13


def ground(shape, scale=1.0, **placement):
    return aimed.Ground(aimed.random_heights(shape, scale, seed=sum(shape)), **placement)


def compare_both_ways(field: aimed.Ground, rays: aimed.Rays, name: str) -> np.ndarray:
    """Asserts that the sweep and the triangles agree wherever rounding has no say; returns for how many rays it has none."""
    swept = oracle.cast(*field, rays.o, rays.d, slack=SLACK)
    t, place = oracle.cast_triangles(*field, rays.o, rays.d)
    decided = swept.decided
    np.testing.assert_array_equal(np.isfinite(t)[decided], (swept.status == oracle.HIT)[decided])
    hit = decided & np.isfinite(t)
    # The triangles' tolerance of 1e-12 of an edge, and what cancels in their products; in units of the ray's way to the hit.
    tolerance = 1e-10 * t[hit]
    assert np.all(t[hit] >= swept.earliest[hit] - tolerance)
    assert np.all(t[hit] <= swept.latest[hit] + tolerance)
    narrow = hit & (swept.spread < 1e-9 * t)
    if min(field.heights.shape) > 2 and name not in (
        "grazing",
        "skimming",
    ):  # else too few of the hits are away from borders and silhouettes
        assert narrow.sum() >= 0.75 * hit.sum()
    np.testing.assert_allclose(swept.t[narrow], t[narrow], rtol=1e-9)
    sharp = narrow & (swept.place.inside > 1e-6)
    np.testing.assert_array_equal(place.cell[sharp], swept.place.cell[sharp])
    np.testing.assert_array_equal(place.triangle[sharp], swept.place.triangle[sharp])
    np.testing.assert_allclose(place.n[sharp], swept.place.n[sharp], atol=1e-14)
    np.testing.assert_allclose(place.uv[sharp], swept.place.uv[sharp], atol=1e-7)
    return decided


@pytest.mark.parametrize("name", aimed.FAMILIES)
def test_sweep_and_triangles_agree(name):
    for shape in GRIDS:
        for scale in (1e-6, 1.0, 1e6):
            field = ground(shape, scale, dx=0.5, dy=2.0, x0=-3.0, y0=10.0)
            rays = aimed.aimed(name, field, COUNT, seed=1)
            decided = compare_both_ways(field, rays, name)
            # On the border rounding decides: for a third of that family, and for most vertices of the smallest grids.
            assert decided.mean() > (0 if min(shape) == 2 else 0.6 if name == "border" else 0.75)


@pytest.mark.parametrize("name", aimed.FAMILIES)
def test_what_is_aimed_hits(name):
    count = 0
    for shape in GRIDS:
        for scale in (1e-6, 1.0, 1e6):
            for roundable in (False, True):
                field = ground(shape, scale, dx=0.5, dy=2.0, x0=-3.0, y0=10.0)
                rays = aimed.aimed(name, field, COUNT, seed=2, roundable=roundable)
                status = oracle.cast(*field, rays.o, rays.d).status
                known = rays.expect != aimed.OPEN
                np.testing.assert_array_equal(status[known], rays.expect[known])
                count += known.sum()
    assert count > 100 or name not in ("vertices", "x_edges", "y_edges", "diagonals", "vertical", "miss")


def test_holes_let_rays_through():
    field = ground((17, 33))
    heights = field.heights.copy()
    heights[4, 5], heights[10, 20], heights[16, 32], heights[0, :3] = np.nan, np.inf, -np.inf, np.nan
    heights[6:16:3, 1:16:3] = np.nan
    holed = field._replace(heights=heights)
    rays = [aimed.aimed(name, field, 200, seed=3) for name in ("vertical", "random", "through_side", "axis_aligned")]
    o, d = (np.concatenate([getattr(part, end) for part in rays]) for end in ("o", "d"))
    decided = compare_both_ways(holed, aimed.Rays(o, d, np.zeros(len(o), int)), "holes")
    assert decided.mean() > 0.8
    whole, pierced = (oracle.cast(*each, o, d).status for each in (field, holed))
    assert np.sum(whole != pierced) >= 10
    up = np.array([[0.0, 0.0, 1.0]])
    for x, y, expected in (
        (4.5, 3.5, oracle.MISS),
        (5.5, 4.5, oracle.MISS),
        (6.5, 4.5, oracle.HIT),
        (19.5, 9.2, oracle.MISS),
        (3.2, 0.5, oracle.HIT),
    ):
        hit = oracle.cast(*holed, np.array([[x, y, -5.0]]), up)
        assert (hit.status[0], bool(hit.decided[0])) == (expected, True)


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
    beside = oracle.cast(*field, o, d + 3 * np.array([9.0, 0.0, 4.5]))  # aimed at (x + 9, y) in the same plane
    assert np.all(beside.status == oracle.MISS)
    assert np.all(np.isinf(beside.t))
    away = oracle.cast(*field, o, -d)
    assert np.all(away.status == oracle.MISS)


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
    np.testing.assert_allclose(oracle.cast_triangles(heights, 1, 1, -2, -2, o, d)[0], expected, rtol=1e-10)


def test_vertical_ray_over_known_points():
    heights = np.array([[0.0, 1.0, 4.0], [2.0, 5.0, 3.0]])
    known = {
        (0, 0): 0.0,
        (2, 0): 4.0,
        (1, 1): 5.0,
        (0.5, 0): 0.5,
        (1, 0.5): 3.0,
        (0.5, 0.5): 2.5,
        (0.75, 0.25): 1.75,
        (0.25, 0.75): 2.25,
    }
    for (x, y), z in known.items():
        point = np.array([[7 + 2 * x, -3 + 4 * y, 10.0]])
        hit = oracle.cast(heights, 2, 4, 7, -3, point, np.array([[0.0, 0.0, -2.0]]))
        assert hit.t[0] == pytest.approx((10 - z) / 2, rel=1e-14)
        np.testing.assert_allclose(hit.place.uv[0], [x / 2, y], atol=1e-15)
    below = oracle.cast(heights, 2, 4, 7, -3, np.array([[8.0, -1.0, -1.0]]), np.array([[0.0, 0.0, 0.5]]))
    assert below.t[0] == pytest.approx(7.0)  # z = 2.5 at the middle of the first cell
    assert below.place.n[0, 2] > 0


def test_starts_on_the_surface_and_touches():
    flat = np.zeros((3, 3))
    o = np.array([[0.5, 0.3, 0.0], [0.5, 0.3, 0.0], [-1.0, 1.5, 0.0]])
    d = np.array([[0.0, 0.0, 1.0], [0.2, 0.1, -1.0], [1.0, 0.0, 0.0]])
    hit = oracle.cast(flat, 1, 1, 0, 0, o, d)
    assert np.all(hit.status == oracle.MISS)
    assert not np.any(hit.decided[:2])


def test_decided_knows_silhouettes_and_the_border():
    ridge = np.array([[0.0, 1.0, 0.0], [0.0, 1.0, 0.0], [0.0, 1.0, 0.0]])
    cases = {  # over or under the ridge, inside or outside of the border, by this much
        0.0: (False, False),
        1e-9: (False, False),
        1e-2: (True, True),
    }
    for by, (over_ridge, at_border) in cases.items():
        for sign in (-1, 1):
            level = oracle.cast(
                ridge, 1, 1, 0, 0, np.array([[-3.0, 0.7, 1 + sign * by]]), np.array([[1.0, 0.1, 0.0]]), slack=1e-6
            )
            down = oracle.cast(ridge, 1, 1, 0, 0, np.array([[sign * by, 0.7, 3.0]]), np.array([[0.0, 0.0, -1.0]]), slack=1e-6)
            assert bool(level.decided[0]) == over_ridge
            assert bool(down.decided[0]) == at_border
    # In front of a wall behind the ridge every ray hits, but not at one t.
    wall = np.column_stack([ridge, [2.0, 2.0, 2.0]])
    hit = oracle.cast(wall, 1, 1, 0, 0, np.array([[-3.0, 0.7, 1 + 1e-9]]), np.array([[1.0, 0.1, 0.0]]), slack=1e-6)
    assert hit.decided[0]
    assert [hit.earliest[0], hit.t[0], hit.latest[0]] == pytest.approx([4, 5.5, 5.5], abs=1e-4)


def test_frame():
    """Rays through a rotated, sheared and mirrored field meet it where the same rays meet it in its own frame."""
    field = ground((9, 5), dx=0.5, dy=2.0, x0=1.0, y0=-1.0)
    world = np.array([[0.0, -2.0, 0.3, 5.0], [1.0, 0.2, 0.0, -1.0], [0.1, 0.0, -3.0, 2.0], [0.0, 0.0, 0.0, 1.0]])
    rays = aimed.aimed("random", field, 300, seed=6)
    local = oracle.cast(*field, rays.o, rays.d)
    o, d = rays.o @ world[:3, :3].T + world[:3, 3], rays.d @ world[:3, :3].T
    moved = oracle.cast(*field, o, d, world_from_object=world)
    hit = local.decided & moved.decided & (local.place.inside > 1e-6) & (local.status == oracle.HIT)
    assert hit.sum() > 100
    np.testing.assert_array_equal(local.status[local.decided], moved.status[local.decided])
    np.testing.assert_allclose(moved.t[hit], local.t[hit], rtol=1e-9)
    np.testing.assert_allclose(moved.place.p[hit], (o + moved.t[:, None] * d)[hit], atol=1e-9)
    # The image of the triangle's plane is orthogonal to the normal, whose side is that of the image of +z.
    flat, steps = local.place.n[hit], np.eye(3)
    tangents = [np.cross(flat, step) @ world[:3, :3].T for step in steps]
    for tangent in tangents:
        np.testing.assert_allclose((tangent * moved.place.n[hit]).sum(1), 0, atol=1e-12)
    assert np.all(moved.place.n[hit] @ world[:3, 2] > 0)


def test_invalid_rays():
    o, d = np.zeros((5, 3)), np.ones((5, 3))
    o[0, 1], o[1, 2], d[2, 0], d[3, 2], d[4] = np.nan, np.inf, np.nan, -np.inf, 0
    np.testing.assert_array_equal(oracle.cast(np.zeros((3, 3)), 1, 1, 0, 0, o, d).status, oracle.INVALID)


SCHEMES = ("central", "four", "six", "six-angle", "six-equal")


@pytest.mark.parametrize("scheme", SCHEMES)
def test_normals_of_a_plane(scheme):
    x, y = np.meshgrid(np.arange(5) * 0.5, np.arange(4) * 2.0)
    normals, lengths = oracle.vertex_normals(1 + x / 2 - y / 4, 0.5, 2.0, scheme)
    size = np.linalg.norm(normals, axis=-1)
    np.testing.assert_allclose(
        normals / size[..., None], np.broadcast_to(np.array([-2, 1, 4]) / np.sqrt(21), (4, 5, 3)), atol=1e-14
    )
    np.testing.assert_allclose(lengths, size)


def test_normals_of_one_cell_by_hand():
    """Heights 0, 0, 0 and 1 at vertex 11: the lower triangle has the normal (0, -1, 1), the upper one (-1, 0, 1)."""
    heights = np.array([[0.0, 0.0], [0.0, 1.0]])
    lower, upper, s = np.array([0, -1, 1]), np.array([-1, 0, 1]), np.sqrt(0.5)
    six = oracle.vertex_normals(heights, 1, 1, "six")[0]
    np.testing.assert_allclose(six, [[lower + upper, lower], [upper, lower + upper]], atol=1e-15)
    equal = oracle.vertex_normals(heights, 1, 1, "six-equal")[0]
    np.testing.assert_allclose(equal[0], [s * (lower + upper), s * lower], atol=1e-15)
    # Of length 1. Both triangles have the same angles, at 00 and at 11.
    angle = oracle.vertex_normals(heights, 1, 1, "six-angle")[0]
    both = (lower + upper) / np.linalg.norm(lower + upper)
    np.testing.assert_allclose(angle, [[both, s * lower], [s * upper, both]], atol=1e-15)
    # Right-up at 00 is flat; up-left at 10 goes through 11 and 00; left-down at 11 through 01 and 10, with slopes 1 and 1.
    four = oracle.vertex_normals(heights, 1, 1, "four")[0]
    np.testing.assert_allclose(four[0], [[0, 0, 1], s * lower], atol=1e-15)
    np.testing.assert_allclose(four[1, 1], np.array([-1, -1, 1]) / np.sqrt(3), atol=1e-15)
    central = oracle.vertex_normals(heights, 1, 1, "central")[0]
    np.testing.assert_allclose(central, [[[0, 0, 1], [0, -1, 1]], [[-1, 0, 1], [-1, -1, 1]]], atol=1e-15)


def test_central_normals_of_a_parabola():
    x = np.arange(6) * 0.5
    normals = oracle.vertex_normals(np.tile(x**2, (4, 1)), 0.5, 2.0, "central")[0]
    np.testing.assert_allclose(normals[:, 1:-1, 0], np.tile(-2 * x[1:-1], (4, 1)), atol=1e-14)
    np.testing.assert_allclose(normals[:, [0, -1], 0], np.tile([-0.5, -4.5], (4, 1)), atol=1e-14)  # one-sided


@pytest.mark.parametrize("scheme", SCHEMES)
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
    mean = [
        normals[2, 1],
        normals[1, 3],
        0.3 * normals[1, 2] + 0.3 * normals[1, 3] + 0.4 * normals[2, 3],
        0.4 * normals[0, 2] + 0.3 * normals[1, 2] + 0.3 * normals[1, 3],
        0.5 * normals[1, 1] + 0.5 * normals[2, 2],
    ]
    np.testing.assert_allclose(ns, mean / np.linalg.norm(mean, axis=1)[:, None], atol=1e-14)
    assert np.all(cancels >= 1 - 1e-12)
    assert np.all(turn > 0)
    world = np.diag([2.0, -1.0, 0.5, 1.0])
    flipped, _, _ = oracle.shading_normals(heights, 0.5, 2.0, place, "six", world)
    mean = np.array(mean) / [2, -1, 0.5]
    np.testing.assert_allclose(flipped, mean / np.linalg.norm(mean, axis=1)[:, None], atol=1e-14)
