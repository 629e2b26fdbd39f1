"""Hillshades, slopes, aspects and tints: against gdaldem, planes by hand, and our own tints by value."""

import functools
import itertools
import math
import re

import numpy as np
import pytest
from gdaldem import gdaldem, needed

import jaxhf
from jaxhf import Terrain

HOLE = -9999.0


def rough(ny, nx, seed=0):
    """Hills with slopes of all steepnesses, and a flat."""
    noise = np.random.default_rng(seed).normal(size=(ny, nx))
    y, x = np.mgrid[:ny, :nx]
    heights = 80 * np.sin(x / 7) * np.cos(y / 5) + 4 * noise
    heights[5:12, 3:15] = 10.0
    return heights


def with_holes(heights):
    heights = heights.copy()
    heights[np.random.default_rng(1).uniform(size=heights.shape) < 0.01] = HOLE
    heights[20:25, 10:18] = HOLE
    heights[0, 3] = heights[-1, -1] = heights[7, 0] = HOLE
    return heights


GRIDS = {
    "square cells": ((3000 + rough(60, 60) / 24).astype(np.float32), 0.5, 0.5),  # where rounding to float32 shows
    "oblong cells, double": (rough(50, 71), 10.0, 14.3),
    "degrees": (rough(40, 50, 2).astype(np.float32), 1 / 3600, 1 / 3600),
    "holes, square cells": (with_holes(rough(45, 61)).astype(np.float32), 9.0, 9.0),
    "integers, holes": (with_holes(rough(50, 55)).astype(np.int16), 10.0, 12.0),
}
ALGORITHMS = {"horn": (), "zevenbergen-thorne": ("-alg", "ZevenbergenThorne")}


@pytest.fixture(params=GRIDS)
def grid(request):
    """Heights for jaxhf and for GDAL, dx, dy, and GDAL's options."""
    heights, dx, dy = GRIDS[request.param]
    holes = "holes" in request.param
    ours = (
        np.where(heights == HOLE, np.nan, heights.astype(float if heights.dtype == float else np.float32)) if holes else heights
    )
    scale = {"scale": 111120.0} if request.param == "degrees" else {}
    return (ours, dx, dy), scale, (heights, dx, dy), {"nodata": HOLE if holes else None}


def edges(on):
    return ("-compute_edges",) if on else ()


@needed
@pytest.mark.parametrize("variant", ["regular", "combined", "multidirectional", "igor"])
def test_hillshades_are_those_of_gdal(tmp_path, grid, variant):
    ours, scale, theirs, nodata = grid
    pairs = (
        itertools.product(ALGORITHMS, (False, True)) if variant == "regular" else zip(ALGORITHMS, (True, False), strict=True)
    )
    for algorithm, on in pairs:
        options = [*(() if variant == "regular" else (f"-{variant}",)), *ALGORITHMS[algorithm], *edges(on), "-z", 1.5]
        options += [] if variant == "multidirectional" else ["-az", 300]
        options += [] if variant == "igor" else ["-alt", 37]
        expected = gdaldem(tmp_path, "hillshade", *theirs, *options, *(("-s", 111120) if scale else ()), **nodata)
        light = {"azimuth": 300.0, "altitude": 37.0, "z_factor": 1.5}
        found = jaxhf.hillshade(*ours, **light, algorithm=algorithm, variant=variant, compute_edges=on, **scale)
        assert len(np.unique(expected)) > 50
        # GDAL's reciprocal roots are the processor's: at a rounding tie one byte in 10^5 may be another on another processor.
        apart = np.abs(found.astype(int) - expected)
        assert apart.max() <= 1, (algorithm, on)
        assert (apart > 0).sum() <= 1, (algorithm, on)


@needed
def test_slopes_and_aspects_are_those_of_gdal(tmp_path, grid):
    ours, scale, theirs, nodata = grid
    for (algorithm, on), flag in zip(itertools.product(ALGORITHMS, (False, True)), (False, True, True, False), strict=True):
        options = [*ALGORITHMS[algorithm], *edges(on)]
        same = {"algorithm": algorithm, "compute_edges": on}
        percent = [*(["-p"] if flag else []), *(("-s", 111120) if scale else ())]
        expected = gdaldem(tmp_path, "slope", *theirs, *options, *percent, **nodata)
        np.testing.assert_array_max_ulp(jaxhf.slope(*ours, percent=flag, **same, **scale), expected, 1)  # of the C library
        options += ["-trigonometric"] if flag else []
        options += ["-zero_for_flat"] if algorithm == "horn" else []
        expected = gdaldem(tmp_path, "aspect", *theirs, *options, **nodata)
        found = jaxhf.aspect(ours[0], trigonometric=flag, zero_for_flat=algorithm == "horn", **same)
        np.testing.assert_array_max_ulp(found, expected, 1)


@needed
@pytest.mark.parametrize(
    ("measure", "words"),
    {"roughness": ("roughness",), "tri": ("TRI",), "tri-wilson": ("TRI", "-alg", "Wilson"), "tpi": ("TPI",)}.items(),
)
def test_ruggedness_is_that_of_gdal(tmp_path, grid, measure, words):
    ours, _, theirs, nodata = grid
    for on in (False, True):
        mode, *options = *words, *edges(on)
        theirs_as_floats = theirs[0].astype(np.float32), *theirs[1:]  # GDAL rounds means of integers to integers
        expected = gdaldem(tmp_path, mode, *theirs_as_floats, *options, **nodata)
        np.testing.assert_array_equal(jaxhf.ruggedness(ours[0], measure, compute_edges=on), expected)
        assert len(np.unique(expected)) > 50


def test_ruggedness_by_hand():
    """Of a pyramid of height 8 with its top in the middle, and beside it."""
    z = np.zeros((5, 5))
    z[2, 2] = 8
    found = {measure: jaxhf.ruggedness(z, measure)[2, 1:3].tolist() for measure in ("roughness", "tri", "tri-wilson", "tpi")}
    assert found == {
        "roughness": [8, 8], "tri": [8, pytest.approx(8 * math.sqrt(8))], "tri-wilson": [1, 8], "tpi": [-1, 8]
    }  # fmt: skip
    assert set(jaxhf.ruggedness(z)[0]) == {HOLE}
    with pytest.raises(ValueError, match=r"^ruggedness: measure must be one of roughness, tri, tri-wilson, tpi; it is 'TRI'$"):
        jaxhf.ruggedness(z, "TRI")


@pytest.mark.parametrize("algorithm", ALGORITHMS)
@pytest.mark.parametrize(("east", "north"), [(0.5, 0.0), (0.0, -0.7), (-0.3, 0.4), (0.0, 0.0), (-2.0, 1.5)])
def test_planes_by_hand(algorithm, east, north):
    """Also at the border: a plane goes on in a straight line, but not at the corners, which repeat the border."""
    y, x = np.mgrid[:6, :9]
    terrain = Terrain(30.0 * east * x + 60.0 * north * y, 30.0, 60.0)
    inside = np.s_[1:-1, 1:-1]
    for on, place in ((False, inside), (True, np.s_[:, 1:-1]), (True, np.s_[1:-1])):
        both = {"algorithm": algorithm, "compute_edges": on}
        steep = np.degrees(np.arctan(np.hypot(east, north)))
        np.testing.assert_allclose(jaxhf.slope(terrain, **both)[place], steep, rtol=1e-6)
        percent = jaxhf.slope(terrain, scale=2.0, percent=True, **both)[place]
        np.testing.assert_allclose(percent, 50 * np.hypot(east, north), rtol=1e-6)
        azimuth, altitude = np.deg2rad([30, 60])
        light = np.array([np.sin(azimuth) * np.cos(altitude), np.cos(azimuth) * np.cos(altitude), np.sin(altitude)])
        cosine = np.array([-east, -north, 1]) @ light / np.sqrt(east**2 + north**2 + 1)
        shade = jaxhf.hillshade(terrain, azimuth=30.0, altitude=60.0, **both)[place]
        np.testing.assert_array_equal(shade, int(1.5 + 254 * max(cosine, 0)))
    if algorithm == "zevenbergen-thorne":  # so little west of north that it rounds to 360 degrees, which are 0
        steep = -(2.0**22) * y[:3, :3] + x[:3, :3]
        assert jaxhf.aspect(steep, algorithm=algorithm)[1, 1] == 0
        assert jaxhf.aspect(steep.T, algorithm=algorithm, trigonometric=True)[1, 1] == 0
    square = Terrain(30.0 * east * x + 30.0 * north * y, 30.0, 30.0)
    faces = np.degrees(np.arctan2(-east, -north)) % 360 if east or north else -9999
    np.testing.assert_allclose(jaxhf.aspect(square, algorithm=algorithm)[inside], faces, rtol=1e-6)
    assert jaxhf.hillshade(terrain).dtype == np.uint8
    assert set(jaxhf.hillshade(terrain)[0]) == {0}
    assert set(jaxhf.slope(terrain)[:, -1]) == {-9999}


def test_degrees_become_metres_unless_a_scale_is_given():
    from jaxhf.io.terrain.georeference import WGS84, CoordinateSystem, metres_per_degree

    heights = rough(30, 40)
    degrees = Terrain(heights, 1 / 3600, 1 / 3600, 7.0, 46.0, CoordinateSystem(degrees=True, globe=WGS84))
    along_x, along_y = metres_per_degree(46.0 + 14.5 / 3600)
    assert (27.5e3 < along_x / 2.8 < 27.8e3, 111.1e3 < along_y < 111.2e3) == (True, True)
    expected = jaxhf.hillshade(heights, along_x / 3600, along_y / 3600)
    np.testing.assert_array_equal(jaxhf.hillshade(degrees), expected)
    given = jaxhf.slope(degrees, scale=111120.0)
    np.testing.assert_array_equal(given, jaxhf.slope(heights, 1 / 3600, 1 / 3600, scale=111120.0))


ONES = np.ones((3, 3))


@pytest.mark.parametrize(
    ("heights", "options", "message"),
    [
        (ONES, {"altitude": 0.0}, "hillshade: altitude must be above 0 and at most 90 degrees, it is 0.0"),
        (ONES, {"azimuth": np.nan}, "hillshade: azimuth must be finite, it is nan"),
        (ONES, {"z_factor": -1.0}, "hillshade: z_factor must be positive and finite, it is -1.0"),
        (ONES, {"scale": 0.0}, "hillshade: scale must be positive and finite, it is 0.0"),
        (ONES, {"dx": np.inf}, "hillshade: dx must be positive and finite, it is inf"),
        (ONES, {"variant": "soft"}, "variant must be one of regular, combined, multidirectional, igor; it is 'soft'"),
        (ONES, {"algorithm": "Horn"}, "algorithm must be one of horn, zevenbergen-thorne; it is 'Horn'"),
        (ONES + 0j, {}, "heights must be an array of real numbers or a Terrain, they are of complex128"),
        (ONES > 0, {}, "heights must be an array of real numbers or a Terrain, they are of bool"),
        (np.ones((3, 3, 3)), {}, "heights must have shape (ny, nx) of at least 2x2, theirs is (3, 3, 3)"),
        (ONES * np.nan, {}, "heights must hold a finite one, all of them are nan or infinite"),
        (ONES * 1e300, {}, "heights must be within -1e+30 and 1e+30, one is 1e+300 from 0"),
    ],
)
def test_refuses(heights, options, message):
    with pytest.raises(jaxhf.ArgumentError, match=re.escape(message)):
        jaxhf.hillshade(heights, **{"dx": 1.0, **options})


def test_heights_and_cells_of_any_size():
    """Only their ratio counts; where that is beyond any number surfaces are vertical, or flat."""
    z = rough(9, 9)
    for draw in (jaxhf.slope, jaxhf.hillshade, functools.partial(jaxhf.relief, shadows=True)):
        for scale in (2.0**-96, 2.0**90):
            np.testing.assert_allclose(draw(z * np.float32(scale), scale).astype(float), draw(z, 1.0).astype(float), rtol=1e-6)
    steep = np.random.default_rng(3).normal(size=(9, 9)) * 1e28
    np.testing.assert_allclose(jaxhf.slope(steep, 1e-29)[1:-1, 1:-1], 90)
    assert (jaxhf.slope(steep, 1e-29, percent=True)[1:-1, 1:-1] == np.finfo(np.float32).max).all()
    np.testing.assert_allclose(jaxhf.slope(steep / 1e58, 1e30)[1:-1, 1:-1], 0, atol=1e-30)


@pytest.mark.parametrize("draw", [jaxhf.hillshade, jaxhf.slope, jaxhf.relief, jaxhf.horizon, jaxhf.sky_view])
def test_arrays_need_a_cell_size(draw):
    """As a slope of unknown cells is one of nothing; without one GDAL and others take 1 in silence."""
    with pytest.raises(jaxhf.ArgumentError, match="dx must be given for an array: its cell size, in the unit of the heights"):
        draw(rough(9, 9))
    labelled = rough(9, 9).view(type("DataArray", (np.ndarray,), {"dims": ("y", "x")}))
    with pytest.raises(jaxhf.ArgumentError, match=r"heights must not be xarray's, .* Terrain.from_xarray"):
        draw(labelled, dx=1.0)


def test_one_spacing_counts_for_both():
    for draw in (jaxhf.hillshade, jaxhf.slope):
        np.testing.assert_array_equal(draw(rough(9, 9), 30.0), draw(rough(9, 9), 30.0, 30.0))
        np.testing.assert_array_equal(draw(rough(9, 9), dy=30.0), draw(rough(9, 9), 30.0))
    terrain = Terrain(rough(9, 9), 20.0, 30.0)  # of which only what is given is overruled
    np.testing.assert_array_equal(jaxhf.slope(terrain, 10.0), jaxhf.slope(terrain.heights, 10.0, 30.0))


def test_light_beyond_the_zenith():
    with pytest.warns(UserWarning, match="opposite the azimuth, 60.0 high"):
        found = jaxhf.hillshade(rough(9, 9), 1.0, azimuth=20.0, altitude=120.0)
    np.testing.assert_array_equal(found, jaxhf.hillshade(rough(9, 9), 1.0, azimuth=200.0, altitude=60.0))


RAMPS = {
    "colours by name and number": "# low\n-60 0 0 128\n-20,0:255 0 7\n/ middle\n0\tOrange\n45.5 grey 100\n",
    "shares of the range": "0% blue\n33.3% 10 200 30 128\n50% orange 77\n100% white\n",
    "jumps": "-40 red\n0 green\n0 blue\n20 yellow\n20 1 2 3\n20 indigo\n60 white\n",
}


@needed
@pytest.mark.parametrize("text", RAMPS.values(), ids=RAMPS)
def test_tints_are_those_of_gdal(tmp_path, grid, text):
    (ours, *_), _, theirs, nodata = grid
    for entries, options in (("interpolate", ()), ("nearest", ("-nearest_color_entry",))):
        ramp = text + ("nv 9 8 7 6\n" if nodata["nodata"] else "")
        expected = gdaldem(tmp_path, "color-relief", *theirs, "-alpha", *options, **nodata, ramp=ramp)
        found = jaxhf.color_relief(ours, tmp_path / "ramp.txt", entries=entries, alpha=True)
        np.testing.assert_array_equal(found, expected)
        np.testing.assert_array_equal(jaxhf.color_relief(ours, tmp_path / "ramp.txt", entries=entries), expected[..., :3])


def test_tints_by_hand(tmp_path):
    """`exact` as GDAL documents it (3.6 finds only the lowest entry), `default`, and holes without a colour of their own."""
    heights = np.array([[0.0, 5.0, 10.0], [12.0, np.nan, -3.0]])
    (tmp_path / "ramp.txt").write_text("0 black\n10 200 100 0\n")
    shares = jaxhf.color_relief(heights, tmp_path / "ramp.txt", alpha=True)
    np.testing.assert_array_equal(shares[0], [[0, 0, 0, 255], [100, 50, 0, 255], [200, 100, 0, 255]])
    np.testing.assert_array_equal(shares[1], [[200, 100, 0, 255], [0, 0, 0, 0], [0, 0, 0, 255]])
    (tmp_path / "ramp.txt").write_text("default 1 2 3\n10 200 100 0\n")
    exact = jaxhf.color_relief(heights, tmp_path / "ramp.txt", entries="exact")
    np.testing.assert_array_equal(exact == [1, 2, 3], np.repeat((heights != 10)[..., None], 3, -1))
    own = jaxhf.color_relief(heights - 5).astype(int)
    assert (own[0, 0, 2] > own[0, 0, 0], own[0, 2, 2] < own[0, 2, 0]) == (True, True)  # blue below 0, none of it on mountains
    colormaps = pytest.importorskip("matplotlib").colormaps
    mapped = jaxhf.color_relief(heights, "viridis")
    np.testing.assert_array_equal(mapped[1, 2], np.multiply(colormaps["viridis"](0)[:3], 255).astype(int))


def test_shading_darkens_and_lightens_tints():
    """Level ground keeps its tint; slopes to the light are lighter, those away from it darker; holes stay as they are."""
    x = np.arange(20) + np.zeros((12, 1))
    heights = np.abs(x - 9.0) + 20.0
    heights[:, 14:] = 25.0
    heights[5, 17] = np.nan
    tint = jaxhf.color_relief(heights).astype(int)
    shaded = jaxhf.relief(heights, 1.0, azimuth=270.0, altitude=25.0).astype(int)
    np.testing.assert_array_equal(shaded[:, 18], tint[:, 18])
    assert (shaded[:, 2:8] < tint[:, 2:8]).all()  # falls to the east
    assert (shaded[:, 11:13] > tint[:, 11:13]).any()
    assert not shaded[5, 17].any()


def test_sea_pales_towards_the_shore_and_land_is_not_blue():
    heights = np.linspace(-3, 2, 400) + np.zeros((2, 1))
    red, green, blue = np.moveaxis(jaxhf.color_relief(heights).astype(int)[0], -1, 0)
    sea = heights[0] < 0
    assert (np.diff((red + green + blue)[sea]) >= 0).all()
    assert (blue[sea] > green[sea]).all()
    assert (blue[~sea] < green[~sea]).all()


def test_light_adds_a_quarter_of_white_and_shade_leaves_a_third():
    """Planes that the light meets at a right angle, and from behind: hillshades of 255 and of 1."""
    x = np.arange(40.0) + np.zeros((3, 1))
    for towards, shade in ((1, 255), (-1, 1)):
        heights = towards * math.tan(math.radians(65)) * x
        tint = jaxhf.color_relief(heights).astype(float)
        level = 1 + 254 * math.sin(math.radians(25))  # of level ground
        expected = tint + (255 - tint) / 4 if shade == 255 else tint * (1 + 2 / level) / 3
        found = jaxhf.relief(heights, 1.0, azimuth=270.0, altitude=25.0)
        if shade == 255:
            np.testing.assert_array_equal(found[:, 1:-1], np.floor(expected + 0.5)[:, 1:-1])
        else:  # hillshades are whole numbers: that of level ground is off by a 200th, and a third by 0.6 of a grey level
            assert (np.abs(found - expected)[:, 1:-1] < 1.1).all()
        assert len(np.unique(tint)) > 60


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("0 red\n10 crimson\n", "ramp.txt:2: there is no colour 'crimson'; "),
        ("0 red\n10 1 2\n", "ramp.txt:2: a height must be followed by red, green and blue, or by a colour's name"),
        ("0 red\nten 1 2 3\n", "ramp.txt:2: there must be a height, a percentage, nv or default, there is 'ten'"),
        ("0 red\n10 1 2 300\n", "ramp.txt:2: a colour's parts must lie between 0 and 255, one is 300"),
        ("120% red\n", "ramp.txt:1: a percentage must lie between 0 and 100, it is 120%"),
        ("# nothing\nnv red\n", "ramp.txt: a colour file must hold a height and its colour, it holds none"),
    ],
)
def test_colour_files_are_refused(tmp_path, text, message):
    (tmp_path / "ramp.txt").write_text(text)
    with pytest.raises(jaxhf.SceneError, match=re.escape(message)):
        jaxhf.color_relief(np.eye(3), tmp_path / "ramp.txt")


def test_colour_files_of_other_encodings_and_what_is_none(tmp_path):
    (tmp_path / "ramp.txt").write_bytes("# Höhe\n0 1 2 3\n9 4 5 6\n".encode("latin-1"))
    assert jaxhf.color_relief(np.array([[0.0, 9.0], [0.0, 9.0]]), tmp_path / "ramp.txt")[0, 1].tolist() == [4, 5, 6]
    (tmp_path / "dem.tif").write_bytes(b"II*\x00\x83\xff")
    with pytest.raises(ValueError, match=r"dem\.tif:1: a height must be followed by red, green and blue"):
        jaxhf.color_relief(np.eye(2), tmp_path / "dem.tif")
