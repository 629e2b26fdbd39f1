"""Maps of rasters that are rotated: in the coordinates and azimuths of the map, from closed forms of surfaces on it."""

import dataclasses

import numpy as np
import pytest
from geotiffs import write

import jaxhf
from jaxhf.io.terrain.georeference import Georeference
from jaxhf.scene.mapped import geotransformed

rasterio = pytest.importorskip("rasterio")

SHAPE = 12, 14
PLACES = [(17, 2, -3), (-130, 2, 3), (90, 2, -2)]  # counterclockwise in degrees, and the steps of columns and rows


def affine(degrees, dx, dy):
    """The numbers of an Affine that turns counterclockwise and begins at a place in zone 16."""
    cos, sin = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return dx * cos, -dy * sin, 5.9e5, dx * sin, dy * cos, 4.1e6


def at(place, column, row):
    a, b, c, d, e, f = place
    return a * column + b * row + c, d * column + e * row + f


def goes_south(place):
    return place[0] * place[4] < place[1] * place[3]


@pytest.fixture(params=PLACES, ids=str)
def place(request):
    return affine(*request.param)


def sampled(path, place, z):
    """A raster of z(x, y), x and y counted from the raster's corner; its terrain, and x and y at the vertices of that."""
    rows, columns = np.mgrid[: SHAPE[0], : SHAPE[1]] + 0.5
    x, y = (moved - start for moved, start in zip(at(place, columns, rows), (place[2], place[5]), strict=True))
    write(path, z(x, y), place)
    upwards = slice(None, None, -1 if goes_south(place) else 1)
    return jaxhf.load_heights(path), x[upwards], y[upwards]


P, Q, R, S, T = 0.3, -0.5, 0.01, 0.004, -0.02  # the derivatives at the corner of a quadratic, for which all stencils are exact


def quadratic(x, y):
    return P * x + Q * y + R * x * x / 2 + S * x * y + T * y * y / 2


@pytest.fixture
def curved(tmp_path, place):
    """Its terrain, and dz/dx and dz/dy of the map inside of the border."""
    terrain, x, y = sampled(tmp_path / "curved.tif", place, quadratic)
    x, y = x[1:-1, 1:-1], y[1:-1, 1:-1]
    return terrain, P + R * x + S * y, Q + S * x + T * y


def inside(values):
    return values[1:-1, 1:-1].astype(np.float64)


def towards(azimuth, altitude):
    azimuth, altitude = np.radians(azimuth), np.radians(altitude)
    return np.array([np.sin(azimuth) * np.cos(altitude), np.cos(azimuth) * np.cos(altitude), np.sin(altitude)])


def test_slope_aspect_and_curvature(curved):
    terrain, p, q = curved
    np.testing.assert_allclose(inside(jaxhf.slope(terrain)), np.degrees(np.arctan(np.hypot(p, q))), atol=1e-4)
    for trigonometric, facing in ((False, np.arctan2(-p, -q)), (True, np.arctan2(-q, -p))):
        found = inside(jaxhf.aspect(terrain, trigonometric=trigonometric))
        assert found.min() >= 0
        assert found.max() < 360
        np.testing.assert_allclose((found - np.degrees(facing) + 180) % 360, 180, atol=1e-3)
    np.testing.assert_allclose(
        inside(jaxhf.curvature(terrain, kind="gaussian")), (R * T - S * S) / (1 + p * p + q * q) ** 2, rtol=1e-3
    )


def test_hillshades(curved):
    """But for the rounding to bytes."""
    terrain, p, q = curved
    steep = np.hypot(p, q)
    normal = np.stack([-p, -q, np.ones_like(p)]) / np.sqrt(1 + steep * steep)

    def cosine(azimuth, altitude):
        return np.maximum(np.tensordot(towards(azimuth, altitude), normal, 1), 0)

    def apart(azimuth):
        return np.arctan2(-p, -q) - np.radians(azimuth)

    found = jaxhf.hillshade(terrain, azimuth=300.0, altitude=40.0)
    np.testing.assert_allclose(inside(found), 1 + 254 * cosine(300, 40), atol=0.51)
    weighted = sum(np.cos(apart(azimuth)) ** 2 * cosine(azimuth, 45) for azimuth in (225, 270, 315, 360))
    np.testing.assert_allclose(inside(jaxhf.hillshade(terrain, variant="multidirectional")), 1 + 127 * weighted, atol=0.51)
    faces_away = np.arccos(np.cos(apart(300))) / np.pi
    expected = 255 * (1 - np.arctan(steep) / (np.pi / 2) * faces_away)
    np.testing.assert_allclose(inside(jaxhf.hillshade(terrain, azimuth=300.0, variant="igor")), expected, atol=0.51)


def test_horizons_and_shadows_of_a_plane(tmp_path, place):
    """Which rises to where it does on the map, in whatever direction rows go there."""
    terrain, *_ = sampled(tmp_path / "plane.tif", place, lambda x, y: P * x + Q * y)
    azimuths = [20.0, 110.0, 150.0]
    for azimuth, found in zip(azimuths, np.asarray(jaxhf.horizon(terrain, azimuths)), strict=True):
        east, north, _ = towards(azimuth, 0)
        rises = np.degrees(np.arctan(max(P * east + Q * north, 0)))
        np.testing.assert_allclose(inside(found), rises, atol=1e-3)
        for altitude in (rises - 1, rises + 1) if rises else ():
            shade = jaxhf.hillshade(terrain, azimuth=azimuth, altitude=altitude, shadows=True)
            assert (inside(shade) > 1).all() == (altitude > rises)


def test_the_output_lies_where_the_raster_does(tmp_path, command):
    """Also by way of .npz, and beside a .png."""
    place = affine(17, 2, -3)
    sampled(tmp_path / "in.tif", place, quadratic)
    assert command("slope", tmp_path / "in.tif", "-o", tmp_path / "slope.tif")[0] == 0
    assert command("convert", tmp_path / "in.tif", tmp_path / "in.npz")[0] == 0
    assert command("relief", tmp_path / "in.npz", "-o", tmp_path / "relief.tif", "--window", 1, 2, 5, 6)[0] == 0
    assert command("hillshade", tmp_path / "in.npz", "-o", tmp_path / "shade.png")[0] == 0
    for name, columns, rows in (("slope.tif", 0, 0), ("relief.tif", 1, 2), ("shade.png", 0, 0)):
        with rasterio.open(tmp_path / name) as found:
            x, y = at(place, columns, rows)
            expected = *place[:2], x, *place[3:5], y
            np.testing.assert_allclose(found.transform[:6], expected, rtol=1e-14, atol=1e-14)
    code, out, _ = command("info", tmp_path / "in.npz")
    corners = ((0, SHAPE[0] - 1), (SHAPE[1] - 1, SHAPE[0] - 1), (SHAPE[1] - 1, 0), (0, 0))
    expected = ", ".join("{:.10g} {:.10g}".format(*at(place, i + 0.5, j + 0.5)) for i, j in corners)
    assert (code, f"corners {expected}, rotated by 17 degrees counterclockwise\n" in out) == (0, True)


def test_observers_stand_where_the_map_says(tmp_path, place, command):
    rng = np.random.default_rng(0)
    heights = rng.uniform(size=SHAPE).astype(np.float32)
    write(tmp_path / "in.tif", heights, place)
    x, y = at(place, 4.5, 3.5)
    assert command("viewshed", tmp_path / "in.tif", "-o", tmp_path / "seen.tif", "--observer", x, y)[0] == 0
    terrain = jaxhf.load_heights(tmp_path / "in.tif")
    row = SHAPE[0] - 1 - 3 if goes_south(place) else 3
    seen = jaxhf.viewshed(terrain, (4 * terrain.dx, row * terrain.dy))
    assert 0.1 < seen.mean() < 0.9
    with rasterio.open(tmp_path / "seen.tif") as found:
        np.testing.assert_array_equal(found.read(1)[::-1] > 0, seen)
    code, _, err = command("viewshed", tmp_path / "in.tif", "-o", tmp_path / "x.tif", "--observer", 5.9e5 - 100, 4.1e6)
    assert (code, "clockwise; one is 589900 4100000" in err) == (2, True)


def test_true_north_is_that_of_the_middle(tmp_path):
    """Of which map and raster are turned one after the other."""
    terrain, *_ = sampled(tmp_path / "in.tif", affine(17, 2, -3), quadratic)
    moved, *_ = sampled(tmp_path / "in.tif", affine(0, 2, -3), quadratic)
    middle = terrain.file_from_terrain @ (6.5 * terrain.dx, 5.5 * terrain.dy, 1)
    x0, y0 = middle - (6.5 * moved.dx, 5.5 * moved.dy)
    straight = jaxhf.Terrain(moved.heights, moved.dx, moved.dy, x0, y0, georeference=moved.georeference)
    np.testing.assert_allclose(terrain.place, straight.place, rtol=1e-12)
    assert abs(straight.convergence) > 0.5
    np.testing.assert_allclose(terrain.turned_from_north, straight.convergence - 17, atol=1e-5)  # by differences
    unknown = dataclasses.replace(terrain, georeference=Georeference(rotation=-17.0))
    assert unknown.turned_from_north == -17


def test_an_orthophoto_on_the_same_pixels_lies_along_them(tmp_path):
    place = affine(17, 2, -3)
    terrain, *_ = sampled(tmp_path / "in.tif", place, quadratic)
    matrix, extent = geotransformed(rasterio.Affine(*place), terrain, *SHAPE[::-1])
    middle = 6.5 * terrain.dx, 5.5 * terrain.dy
    np.testing.assert_allclose(matrix[:2, [0, 1, 3]].T, [(2 / 3, 0), (0, 1), middle], atol=1e-8)
    np.testing.assert_allclose(extent, 12 * 3)


FIXED, MOVING = "--azimuth {sun}", "--sun-from {sun},40 --sun-to {sun},60 --frames 2"


@pytest.mark.parametrize(("ending", "light"), [(".npy", FIXED), (".gif", MOVING)])
def test_views_are_from_where_the_map_says(tmp_path, ending, light, command):
    """In its light, too: by the pictures of the same heights along x and y, from where these are turned to."""
    heights, pictures = 50 * np.add.outer(np.sin(np.arange(13) / 3), np.cos(np.arange(17) / 4)), []
    for name, degrees, sun in (("rotated", 90, 300), ("straight", 0, 390)):
        write(tmp_path / f"{name}.tif", heights, affine(degrees, 100, -100))
        words = f"--size 48x32 --preset draft --from {sun - 80} {light.format(sun=sun)} --no-cache".split()
        assert command("view", tmp_path / f"{name}.tif", "-o", tmp_path / f"{name}{ending}", *words)[0] == 0
        pictures.append((tmp_path / f"{name}{ending}").read_bytes())
    assert pictures[0] == pictures[1]


def test_a_rotation_by_rounding_is_none(tmp_path):
    """As transforms have that were products, or text."""
    rounded, straight = affine(1e-7, 2, -3), affine(0, 2, -3)
    assert rounded[1] != 0
    (found, *_), (expected, *_) = (sampled(tmp_path / "in.tif", place, quadratic) for place in (rounded, straight))
    assert found.rotation == 0
    assert (found.dx, found.dy, found.x0, found.y0) == pytest.approx((expected.dx, expected.dy, expected.x0, expected.y0))
    assert found.crs == expected.crs


SHEARED = 2, 0.1, 0, 0.3, -3, 0
REFUSED = [
    (
        "slope in.tif -o out.tif",
        SHEARED,
        "EPSG:32616",
        "in.tif: its pixels must lie along x and y, or be rotated without shear",
    ),
    ("slope in.tif -o out.tif", affine(17, 1e-3, -1e-3), "EPSG:4326", "and in lengths (gdalwarp makes them so)"),
    ("slope in.tif -o out.tif --bbox 0 0 9 9", affine(17, 2, -3), None, "in.tif: a terrain that bbox cuts (window cuts any)"),
    ("convert in.tif out.asc", affine(17, 2, -3), None, "out.asc: the terrain in an .asc must lie along x and y"),
    ("convert in.tif out.png", affine(17, 2, -3), None, "out.png: the terrain in a .png must lie along x and y"),
    ("relief in.tif -o out.pdf --annotate", affine(17, 2, -3), None, "in.tif: the terrain on a sheet must lie along x and y"),
    ("view in.tif -o out.png --drape in.tif", affine(17, 2, -3), None, "in.tif: a terrain below a GeoTIFF must lie along"),
    ("view straight.tif -o out.png --drape in.tif", affine(17, 2, -3), None, "its pixels must lie along x and y (gdalwarp"),
    ("render scene.toml -o out.png", affine(17, 2, -3), None, "objects[0].file: a scene's terrain must lie along x and y"),
    ("fit fit.toml -o out.npy", affine(17, 2, -3), None, "fit.prior.heights: it must lie along x and y"),
]


@pytest.mark.parametrize(("words", "place", "crs", "said"), REFUSED, ids=[f"{row[0]} {row[2]}" for row in REFUSED])
def test_what_takes_no_rotated_raster_says_so(tmp_path, words, place, crs, said, command, monkeypatch):
    monkeypatch.chdir(tmp_path)
    values = np.zeros(SHAPE, np.uint8)
    write(tmp_path / "in.tif", values, place, crs)
    write(tmp_path / "straight.tif", values, affine(0, 2, -3), crs)
    start = '[camera]\ntype = "perspective"\neye = [0, 0, 9]\ntarget = [0, 1, 0]\n[[objects]]\nshape = "heightfield"\n'
    (tmp_path / "scene.toml").write_text(f'{start}file = "in.tif"\n')
    fit = '[[pictures]]\nimage = "grey.npy"\n[fit.prior]\nheights = "in.tif"\nstd = 1\n'
    (tmp_path / "fit.toml").write_text(f"{start}heights = [[0, 0], [0, 0]]\n{fit}")
    np.save(tmp_path / "grey.npy", np.ones((3, 4), np.float32))
    code, _, err = command(*words.split())
    assert (code, len(err.splitlines()), said in err) == (2, 1, True), err
