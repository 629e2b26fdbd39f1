"""Walls and floor under a terrain, against triangles in double precision; and that with them a terrain is closed."""

import numpy as np
import pytest

import jaxhf
from jaxhf.preparation.localise import localise

RNG = np.random.default_rng(7)
HEIGHTS = RNG.uniform(0, 2, (6, 9)).astype(np.float32)
FIELD = jaxhf.Heightfield(HEIGHTS, 1.5, 2.0)
BASE = -1.0
TURN = np.array([[0.6, -0.8, 0, 3], [0.8, 0.6, 0, -2], [0, 0, 1, 5], [0, 0, 0, 1.0]])


def scene(*objects: jaxhf.Object) -> jaxhf.Scene:
    return jaxhf.Scene(objects, jaxhf.Orthographic.look_at((0, 0, 9), (0, 1, 0)))


def triangles() -> np.ndarray:
    """Of walls and floor, (n, 3, 3), in the object's frame."""
    z, (ny, nx) = HEIGHTS.astype(float), HEIGHTS.shape
    x, y = 1.5 * np.arange(nx), 2.0 * np.arange(ny)
    found = []
    for a, b, top in ((x, 0 * x, z[0]), (x, 0 * x + y[-1], z[-1]), (0 * y, y, z[:, 0]), (0 * y + x[-1], y, z[:, -1])):
        high, low = np.stack([a, b, top], 1), np.stack([a, b, 0 * a + BASE], 1)
        for k in range(len(a) - 1):
            found += [(low[k], low[k + 1], high[k + 1]), (low[k], high[k + 1], high[k])]
    corners = [(px, py, BASE) for px, py in ((0, 0), (x[-1], 0), (x[-1], y[-1]), (0, y[-1]))]
    return np.array([*found, corners[:3], [corners[0], *corners[2:]]])


def nearest(o: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """t of the first triangle that a ray meets (Möller and Trumbore 1997), and whether it is clear of all edges."""
    a, b, c = np.moveaxis(triangles(), 1, 0)[:, None]
    o, d = o[:, None], d[:, None]
    p = np.cross(d, c - a)
    det = ((b - a) * p).sum(-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        u = ((o - a) * p).sum(-1) / det
        q = np.cross(o - a, b - a)
        v, t = (d * q).sum(-1) / det, ((c - a) * q).sum(-1) / det
    inside = np.minimum(np.minimum(u, v), 1 - u - v)
    t = np.where((inside >= 0) & (t > 0), t, np.inf)
    return t.min(1), (np.abs(inside) > 1e-4).all(1)


def cast_turned(skirt: jaxhf.Skirt, o: np.ndarray, d: np.ndarray):
    """Rays in the frame of a skirt that is turned, padded to 3000, as any other number would be compiled anew."""
    o, d = (np.concatenate([v, np.tile(v[:1], (3000 - len(v), 1))]) @ TURN[:3, :3].T for v in (o, d))
    return jaxhf.cast(scene(jaxhf.Object(skirt, world_from_object=TURN)), o + TURN[:3, 3], d)


def test_walls_stand_where_their_triangles_do():
    o = RNG.uniform((-6, -6, -5), (18, 16, 6), (3000, 3))
    d = RNG.uniform((0, 0, -1), (12, 10, 2), (3000, 3)) - o
    hit = cast_turned(jaxhf.Skirt.of(FIELD, BASE), o, d)
    t, clear = nearest(o, d)
    assert clear.mean() > 0.95
    np.testing.assert_allclose(
        np.where(np.isfinite(hit.t), hit.t, -1)[clear], np.where(np.isfinite(t), t, -1)[clear], atol=2e-5
    )
    met = clear & np.isfinite(t)
    assert 0.3 < met.mean() < 0.99
    inwards = (np.asarray(hit.n) * (d @ TURN[:3, :3].T)).sum(-1) < 0
    np.testing.assert_array_equal(np.asarray(hit.side)[met], np.where(inwards, 1, -1)[met])
    local = (np.asarray(hit.p) - TURN[:3, 3]) @ TURN[:3, :3]
    assert np.abs((local - (o + t[:, None] * d))[met]).max() < 1e-4


def test_a_terrain_with_walls_is_closed():
    """From outside nobody sees the inside: rays aimed at the rim, at corners and at the floor's edges meet outer sides only."""
    ny, nx = HEIGHTS.shape
    rim = [
        (ix * 1.5, iy * 2.0, HEIGHTS[iy, ix]) for iy in range(ny) for ix in range(nx) if ix in (0, nx - 1) or iy in (0, ny - 1)
    ]
    low = [(x, y, BASE) for x, y, _ in rim]
    ends = np.array(rim + low)
    target = ends[RNG.integers(len(ends), size=20000)]
    along = np.roll(ends, 1, 0)[RNG.integers(len(ends), size=20000)]
    target[::2] += RNG.uniform(-1e-6, 1e-6, (10000, 3))
    target[1::4] = (target[1::4] + along[1::4]) / 2
    middle = np.array([6, 5, 0.5])
    away = RNG.normal(size=(20000, 3))
    o = middle + 20 * away / np.linalg.norm(away, axis=1, keepdims=True)
    seen = scene(jaxhf.Object(FIELD), jaxhf.Object(jaxhf.Skirt.of(FIELD, BASE)))
    hit = jaxhf.cast(seen, o, target - o)
    met = np.asarray(hit.status) == 1
    assert met.mean() > 0.6
    np.testing.assert_array_equal(np.asarray(hit.side)[met], 1)


def test_a_hole_in_the_border_leaves_no_wall():
    z = HEIGHTS.copy()
    z[0, 4] = np.nan
    o = np.array([[x, -3.0, -0.5] for x in (1.0, 5.0, 7.0, 11.0)])
    hit = cast_turned(jaxhf.Skirt.of(jaxhf.Heightfield(z, 1.5, 2.0), BASE), o, np.tile([0.0, 1.0, 0.0], (4, 1)))
    np.testing.assert_allclose(hit.t[:4], [3, 13, 13, 3], rtol=3e-6)


@pytest.mark.parametrize(
    ("base", "said"), [(3.0, "must not lie above the border"), (np.nan, "must be finite"), ((1, 2), "one number")]
)
def test_a_floor_that_cannot_be_is_refused(base, said: str):
    with pytest.raises(jaxhf.ArgumentError, match=said):
        jaxhf.Skirt.of(FIELD, base)


def test_a_skirt_moves_with_its_terrain():
    """To where the coordinates are small: both stand there without a transform, in front of the same rays."""
    for x0, y0 in ((0.0, 0.0), (5e5, 4.2e6)):
        field = jaxhf.Heightfield(HEIGHTS, 1.5, 2.0, x0, y0)
        moved = localise(scene(jaxhf.Object(field), jaxhf.Object(jaxhf.Skirt.of(field, BASE))))
        skirt = moved.objects[1].shape
        assert isinstance(skirt, jaxhf.Skirt)
        assert (skirt.x0, skirt.y0, moved.objects[1].world_from_object) == (0, 0, None)
        np.testing.assert_array_equal(skirt.north, HEIGHTS[-1])
