"""What is seen of a terrain: against profiles in double precision, rays, closed forms and gdal_viewshed."""

import math
import shutil
import subprocess

import numpy as np
import pytest

import jaxhf
from jaxhf.scene.procedural import fractal

EYE = (30.3 * 2, 20.6 * 2)  # within a triangle
DX, DY = 2.0, 3.0


def ground(ny: int = 40, nx: int = 47, seed: int = 3) -> np.ndarray:
    return fractal([ny, nx], seed=seed, exponent=2.4, range=(0.0, 30.0))


def profile(z: np.ndarray, begin: tuple[float, float], end: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Shares of the way between two points, columns and rows, and the ground there: at 20,000 even steps, by triangles."""
    share = np.linspace(0, 1, 20_001)[1:-1]
    x, y = (a + share * (b - a) for a, b in zip(begin, end, strict=True))
    ix, iy = (np.clip(np.floor(at).astype(int), 0, n - 2) for at, n in ((x, z.shape[1]), (y, z.shape[0])))
    u, v = x - ix, y - iy
    low, high, last = z[iy, ix], z[iy + 1, ix + 1], np.where(u > v, z[iy, ix + 1], z[iy + 1, ix])
    first, second = np.where(u > v, u, v), np.where(u > v, v, u)
    return share, low + first * (last - low) + second * (high - last)


def touched(z: np.ndarray) -> np.ndarray:
    """The vertices that cells with all their heights touch."""
    whole = np.pad(np.isfinite(z[:-1, :-1] + z[1:, :-1] + z[:-1, 1:] + z[1:, 1:]), 1)
    return whole[1:, 1:] | whole[1:, :-1] | whole[:-1, 1:] | whole[:-1, :-1]


@pytest.mark.x64
@pytest.mark.parametrize("eye", [EYE, (10.29 * DX, 20 * DY), (0.0, 7.37 * DY)])  # within a triangle, on an edge, on the border
def test_holes_are_looked_through_and_their_rims_stand(eye):
    """With 5 % of the heights missing: what stands behind a hole counts from the edge on that faces the eye.

    But for lines that touch a rim without crossing a cell of it, as along a row: rounding decides whether they meet it.
    """
    z = ground()
    z[np.random.default_rng(1).uniform(size=z.shape) < 0.05] = np.nan
    z[6:9, 0:2] = z[19:22, 9:12] = 20.0  # whole where the eyes are
    found = jaxhf.viewshed(z, eye, 1.5, wanted="above-ground", dx=DX, dy=DY)
    for iy, ix in np.argwhere(touched(z))[::3]:
        if iy == eye[1] / DY:
            continue
        line = jaxhf.line_of_sight(z, eye, (DX * ix, DY * iy), 1.5, dx=DX, dy=DY)
        assert line.above_ground == pytest.approx(found[iy, ix], abs=1e-9), (iy, ix)


def test_a_rim_behind_a_hole_hides_as_a_wall_does():
    z = np.zeros((5, 41), np.float32)
    z[:, 7], z[:, 8] = np.nan, 5
    found = jaxhf.viewshed(z, (1.0, 1.0), 2.0, wanted="above-ground", dx=1.0)[1]
    np.testing.assert_allclose(found[9:], 2 + 3 / 7 * np.arange(8, 40), rtol=1e-6)


@pytest.mark.x64
def test_heights_above_ground_are_those_of_profiles():
    z = ground()
    z[8:11, 5:9] = np.nan
    found = jaxhf.viewshed(z, EYE, 1.5, wanted="above-ground", dx=DX, dy=DY)
    seen = jaxhf.viewshed(z, EYE, 1.5, dx=DX, dy=DY)
    np.testing.assert_array_equal(np.isnan(found), np.isnan(z))
    assert not seen[np.isnan(z)].any()
    np.testing.assert_array_equal(seen, found == 0)
    assert 0.1 < seen.mean() < 0.9
    for iy, ix in np.argwhere(touched(z))[::7]:
        line = jaxhf.line_of_sight(z, EYE, (DX * ix, DY * iy), 1.5, dx=DX, dy=DY)
        assert line.above_ground == pytest.approx(found[iy, ix], abs=1e-11)
        assert line.visible == seen[iy, ix]


def test_profiles_are_the_terrain():
    """Against the surface taken at even steps: the highest crossing is at most a step higher than what these find."""
    z, begin, end = ground(seed=5), (3.2, 4.7), (44.0, 31.5)
    line = jaxhf.line_of_sight(z, (DX * begin[0], DY * begin[1]), (DX * end[0], DY * end[1]), 1.5, 2.0, dx=DX, dy=DY)
    share, heights = profile(z, begin, end)
    length = math.hypot(DX * (end[0] - begin[0]), DY * (end[1] - begin[1]))
    assert line.distance[-1] == pytest.approx(length)
    np.testing.assert_allclose(np.interp(share * length, line.distance, line.ground), heights, atol=1e-9)
    eye = line.ground[0] + 1.5
    assert (line.line[0], line.line[-1]) == pytest.approx((eye, line.ground[-1] + 2))
    steepest = ((heights - eye) / share).max()
    assert line.above_ground == pytest.approx(eye + steepest - line.ground[-1], abs=0.02)
    assert line.above_ground > 1
    assert not line.visible
    higher = jaxhf.line_of_sight(
        z, (DX * begin[0], DY * begin[1]), (DX * end[0], DY * end[1]), 1.5, line.above_ground + 1e-9, dx=DX, dy=DY
    )
    assert higher.visible


@pytest.mark.x64
def test_rays_of_cast_agree():
    """Targets a little above what is found are seen along a ray, those a little below are not."""
    z = ground(seed=7)
    found = jaxhf.viewshed(z, EYE, 1.5, wanted="above-ground", dx=DX, dy=DY)
    field = jaxhf.Heightfield(z, DX, DY)
    iy, ix = np.argwhere(found > 0.01)[::5].T
    down = jaxhf.cast(field, np.array([[*EYE, 100.0]]), np.array([[0, 0, -1.0]]))
    eye = np.array([*EYE, 100 - float(down.t[0]) + 1.5])
    for off, hidden in ((1e-6, False), (-1e-6, True)):
        target = np.stack([DX * ix, DY * iy, z[iy, ix] + found[iy, ix] + off], -1)
        hit = jaxhf.cast(field, np.broadcast_to(eye, target.shape), target - eye)
        between = (np.asarray(hit.status) == jaxhf.Status.HIT) & (np.asarray(hit.t) < 1 - 1e-9)
        assert (between == hidden).all()


def test_a_wall_hides_what_is_behind_it():
    """By similar triangles: from 2 over the ground a wall of 5 at a distance of 10 hides 2 + 0.3 d at a distance d."""
    z = np.zeros((5, 41), np.float32)
    z[:, 11] = 5
    found = jaxhf.viewshed(z, (1.0, 2.0), 2.0, wanted="above-ground", dx=1.0)[2]
    distance = np.arange(41) - 1.0
    np.testing.assert_allclose(found[12:], 2 + 0.3 * distance[12:], rtol=1e-6)
    assert (found[:12] == 0).all()
    seen = jaxhf.viewshed(z, (1.0, 2.0), 2.0, target_height=8.0, dx=1.0)[2]
    np.testing.assert_array_equal(seen, (2 + 0.3 * distance <= 8) | (distance <= 10))
    level = jaxhf.viewshed(z, (1.0, 2.0), 2.0, target_height=2.0, dx=1.0)[2]  # a line of slope 0
    np.testing.assert_array_equal(level, distance <= 10)


def test_heights_in_whole_metres():
    """Of which many are as high as the eye."""
    z = np.rint(fractal([120, 120], seed=5, exponent=2.4, range=(0.0, 40.0))).astype(np.float32)
    eye, height = (60.0, 60.0), 2.0
    found = jaxhf.viewshed(z, eye, height, wanted="above-ground", dx=1.0)
    assert (z[60, 60] + height == z).sum() > 100
    np.testing.assert_array_equal(jaxhf.viewshed(z, eye, height, dx=1.0), found == 0)


@pytest.mark.parametrize("dx", [0.1, 0.3, 30.0, 87.36])
def test_planes_are_seen_from_any_vertex(dx):
    """By profiles: what a crossing at the target itself says by rounding does not count. And at the last row and column."""
    z = 0.3 * np.arange(20)[None, :] + 0.7 * np.arange(15)[:, None] + 5.0
    terrain = jaxhf.Terrain(z, dx, dx, x0=0.3, y0=0.7)
    eye = (terrain.x0 + 19 * dx, terrain.y0 + 14 * dx)
    for iy, ix in np.ndindex(z.shape):
        assert jaxhf.line_of_sight(terrain, eye, (terrain.x0 + ix * dx, terrain.y0 + iy * dx)).visible
    assert jaxhf.viewshed(terrain, eye).all()


def test_a_plain_ends_where_the_earth_falls_away():
    """At a distance d a sphere hides (d - sqrt(2 R h))² / (2 R), for an eye that is h high."""
    radius, height = 7.44e6, 20.0
    z = np.zeros((3, 401), np.float32)
    found = jaxhf.viewshed(z, (0.0, 100.0), height, wanted="above-ground", radius=radius, dx=100.0)[1]
    distance, edge = 100.0 * np.arange(401), math.sqrt(2 * radius * height)
    np.testing.assert_allclose(found, np.where(distance > edge, (distance - edge) ** 2 / (2 * radius), 0), atol=0.02)
    assert found[-1] > 30
    line = jaxhf.line_of_sight(z, (0.0, 100.0), (40_000.0, 100.0), height, radius=radius, dx=100.0)
    assert line.above_ground == pytest.approx(found[-1], abs=0.02)


def test_several_observers_see_what_one_of_them_does():
    z = ground().astype(np.float32)
    eyes = np.array([EYE, (5.0, 5.0), (70.0, 90.0)])
    told = []
    found = jaxhf.viewshed(z, eyes, dx=DX, dy=DY, progress=lambda done, count: told.append((done, count)))
    np.testing.assert_array_equal(found, np.any([jaxhf.viewshed(z, eye, dx=DX, dy=DY) for eye in eyes], axis=0))
    assert told == [(1, 3), (2, 3), (3, 3)]
    assert found.dtype == bool


def test_a_terrain_has_its_own_coordinates():
    z = ground().astype(np.float32)
    terrain = jaxhf.Terrain(z, DX, DY, x0=5e5, y0=4e6)
    by_terrain = jaxhf.viewshed(terrain, (5e5 + EYE[0], 4e6 + EYE[1]))
    np.testing.assert_array_equal(by_terrain, jaxhf.viewshed(z, EYE, dx=DX, dy=DY))
    field = jaxhf.Heightfield(z, DX, DY, x0=5e5, y0=4e6)
    np.testing.assert_array_equal(by_terrain, jaxhf.viewshed(field, (5e5 + EYE[0], 4e6 + EYE[1])))


def test_flat_ground_is_seen_as_a_whole():
    """Also from far away and low, at a height of 8000, and from on a vertex."""
    z = np.full((200, 1500), 8000, np.float32)
    for place in ((750.0, 100.0), (3.0, 199.0), (0.5, 0.25)):
        assert jaxhf.viewshed(z, place, 0.5, dx=1.0).all()


@pytest.mark.parametrize("place", [(0.0, 0.0), (46 * DX, 39 * DY), (46 * DX, 0.0)])
def test_eyes_at_corners_see_their_neighbours(place):
    z = ground().astype(np.float32)
    seen = jaxhf.viewshed(z, place, dx=DX, dy=DY)
    iy, ix = round(place[1] / DY), round(place[0] / DX)
    assert seen[max(0, iy - 1) : iy + 2, max(0, ix - 1) : ix + 2].all()


def test_gdal_sees_about_the_same(tmp_path):
    """It interpolates between rays, so that it is off at up to a twentieth of the vertices."""
    assert shutil.which("gdal_viewshed"), "Debian: gdal-bin"
    z = fractal([300, 300], seed=11, exponent=2.4, range=(0.0, 300.0)).astype(np.float32)
    jaxhf.save_heights(tmp_path / "t.tif", jaxhf.Terrain(z, 30.0, 30.0))
    command = ["gdal_viewshed", "-q", "-cc", "0", "-ox", "4500", "-oy", "4500", "-oz", "5"]
    subprocess.run([*command, tmp_path / "t.tif", tmp_path / "v.tif"], check=True, capture_output=True)
    theirs = jaxhf.load_heights(tmp_path / "v.tif").heights > 0
    ours = jaxhf.viewshed(z, (4500.0, 4500.0), 5.0, dx=30.0)
    assert np.mean(theirs != ours) < 0.05
    assert 0.05 < ours.mean() < 0.9


WRONG = {
    "observers must be on the terrain, x from 0 to 46 and y from 0 to 39; one is 100 0": {"observers": (100.0, 0.0)},
    "observers[1] must be on a triangle": {"observers": [(20.0, 20.0), (0.5, 0.5)]},
    "shape (2,) or (n, 2): [1.0, 2.0, 3.0]": {"observers": [1.0, 2.0, 3.0]},
    "shape (2,) or (n, 2): 'here'": {"observers": "here"},
    "height must be positive": {"height": 0.0},
    "target_height must be at least 0": {"target_height": -1.0},
    "target_height must be within": {"target_height": 1e39},
    "must be 0 where wanted is above-ground": {"target_height": 1.0, "wanted": "above-ground"},
    "one of visible, above-ground": {"wanted": "all"},
    "radius must be positive": {"radius": 0.0},
    "radius must be from": {"radius": 1e-40},
    "dx must be given": {"dx": None},
}


@pytest.mark.parametrize("said", WRONG)
def test_wrong_uses_are_refused(said, as_users_call_it):
    z = ground().astype(np.float32)
    z[0, 0] = np.nan
    known = {"observers": (20.0, 20.0), "dx": 1.0} | WRONG[said]
    with pytest.raises(ValueError, match=r"^viewshed: ") as error:
        jaxhf.viewshed(z, known.pop("observers"), **known)
    assert said in str(error.value)
    with pytest.raises(ValueError, match=r"^line_of_sight: target must be on the terrain"):
        jaxhf.line_of_sight(z, (20.0, 20.0), (20.0, 400.0), dx=1.0)
