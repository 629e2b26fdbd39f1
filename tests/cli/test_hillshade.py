"""`jaxhf hillshade`, `slope`, `aspect`, `relief` and `convert`: maps in their place, terrains that come back as they were."""

import subprocess
import sys

import geotiffs
import numpy as np
import oracle
import pytest
from PIL import Image

import jaxhf
from jaxhf import Terrain
from jaxhf.cli.main import main


def plane(east: float, north: float) -> Terrain:
    """A plane on a map, its cells twice as high as wide."""
    rows, columns = np.mgrid[:6, :9]
    return Terrain(30.0 * east * columns + 60.0 * north * rows, 30.0, 60.0, 5e5, 4.1e6)


def hills(holes: bool = True) -> Terrain:
    rows, columns = np.mgrid[:20, :30]
    heights = (80 * np.sin(rows / 4) * np.cos(columns / 5)).astype(np.float32)
    if holes:
        heights[4:6, 7] = np.nan
    return Terrain(heights, 30.0, 50.0, 5e5, 4.1e6)


def test_maps_are_in_their_place(tmp_path, capsys):
    """GeoTIFFs of n x n pixels where the terrain's are, in bytes or floats, with the value that means none."""
    rasterio = pytest.importorskip("rasterio")
    terrain = hills()
    source = tmp_path / "hills.tif"
    stored = np.nan_to_num(terrain.heights[::-1], nan=-9999)
    geotiffs.write(source, stored, (30, 0, 5e5, 0, -50, 4.1e6), nodata=-9999)
    light = {"azimuth": 200.0, "altitude": 30.0, "z_factor": 2.0, "algorithm": "zevenbergen-thorne", "variant": "combined"}
    words = [f"--{name.replace('_', '-')}={value}" for name, value in light.items()]
    whole = {**light, "shadows": True, "compute_edges": True}
    cases = [
        (["hillshade", *words, "--shadows", "--compute-edges"], jaxhf.hillshade(terrain, **whole), 0),
        (["slope", "--percent", "--scale", "2"], jaxhf.slope(terrain, percent=True, scale=2.0), -9999),
        (["slope", "--dx", "10", "--compute-edges"], jaxhf.slope(terrain, 10.0, compute_edges=True), -9999),
        (["aspect", "--trigonometric"], jaxhf.aspect(terrain, trigonometric=True), -9999),
        (["aspect", "--zero-for-flat"], jaxhf.aspect(terrain, zero_for_flat=True), None),
        (["relief", *words, "--alpha"], jaxhf.relief(terrain, **light, alpha=True), None),
        (["relief", "--no-shading", "--entries", "nearest"], jaxhf.color_relief(terrain, entries="nearest"), None),
    ]
    for command, expected, nodata in cases:
        assert main([command[0], str(source), "-o", str(tmp_path / "map.tif"), *command[1:]]) == 0
        with rasterio.open(source) as before, rasterio.open(tmp_path / "map.tif") as after:
            assert (after.transform, after.crs, after.nodata) == (before.transform, before.crs, nodata)
            found = np.moveaxis(after.read(), 0, -1)[::-1]
        np.testing.assert_array_equal(found, expected.reshape(found.shape))
        assert found.dtype == expected.dtype
    assert "30 x 20 pixels" in capsys.readouterr().out
    assert main(["relief", str(source), "-o", str(tmp_path / "map.png")]) == 0
    with Image.open(tmp_path / "map.png") as picture:
        np.testing.assert_array_equal(np.asarray(picture)[::-1], jaxhf.relief(terrain))


def test_a_relief_lies_in_shadow_where_rays_say_so(tmp_path):
    """By the oracle; there the colour is darkened as by the least of 255 shades, elsewhere it is that without shadows."""
    rng = np.random.default_rng(5)
    terrain = Terrain(rng.uniform(0, 400, (13, 17)).astype(np.float32), 100.0, 150.0)
    jaxhf.save_heights(tmp_path / "in.npz", terrain)
    pictures = {}
    for name, words in (("shadows", ["--shadows"]), ("light", []), ("colours", ["--no-shading"])):
        sun = [] if name == "colours" else ["--azimuth", "250", "--altitude", "30"]
        assert main(["relief", str(tmp_path / "in.npz"), "-o", str(tmp_path / "out.npy"), *sun, *words]) == 0
        pictures[name] = np.load(tmp_path / "out.npy")
    azimuth, altitude = np.radians(250), np.radians(30)
    towards = [np.sin(azimuth) * np.cos(altitude), np.cos(azimuth) * np.cos(altitude), np.sin(altitude)]
    y, x = np.indices(terrain.heights.shape)
    z = terrain.heights.astype(float)
    vertices = np.stack([100.0 * x, 150.0 * y, z + 1e-6], -1).reshape(-1, 3)
    t = oracle.cast(z, 100.0, 150.0, 0.0, 0.0, vertices, np.tile(towards, (z.size, 1))).t
    dark = np.isfinite(t).reshape(terrain.heights.shape)
    assert 40 < dark.sum() < 180
    level = 1 + 254 * np.sin(altitude)  # the shade of level ground, which keeps its colour
    expected = np.where(dark[..., None], np.rint(pictures["colours"] * (1 / 3 + 2 / 3 / level)), pictures["light"])
    np.testing.assert_allclose(pictures["shadows"].astype(float), expected, atol=1)
    # A slope that only faces away is as dark; these face the light, and other terrain keeps it from them.
    assert (dark & (np.abs(pictures["light"] - expected).max(-1) > 40)).sum() > 10
    np.testing.assert_array_equal(pictures["shadows"][~dark], pictures["light"][~dark])


def test_how_far_apart_heights_are_is_said(tmp_path, command):
    """Of degrees that they are measured in metres; of bare heights that nothing says it."""
    heights = hills(False).heights
    geotiffs.write(tmp_path / "degrees.tif", heights[::-1], (1 / 3600, 0, 7, 0, -1 / 3600, 46), "EPSG:4326")
    np.save(tmp_path / "bare.npy", heights)
    metres = jaxhf.load_heights(tmp_path / "degrees.tif")
    in_degrees = jaxhf.slope(heights, 1 / 3600, 1 / 3600, scale=111120.0)
    bare = jaxhf.slope(heights, 1.0)
    latitude = "degrees, which are measured in metres at latitude 46;"
    nothing = "does not say how far apart its heights are, 1 is taken (--dx and --dy overrule)"
    for name, said, silently, measured, given in (
        ("degrees.tif", latitude, "--scale 111120", jaxhf.slope(metres), in_degrees),
        ("bare.npy", nothing, "--dx 1", bare, bare),
    ):
        words = ["slope", tmp_path / name, "-o", tmp_path / "slope.npy"]
        code, _, err = command(*words)
        assert (code, said in err) == (0, True)
        np.testing.assert_array_equal(np.load(tmp_path / "slope.npy"), measured)
        code, _, err = command(*words, *silently.split())
        assert (code, err) == (0, "")
        np.testing.assert_allclose(np.load(tmp_path / "slope.npy"), given, rtol=1e-5)


def test_maps_and_conversions_do_without_jax(tmp_path):
    heights = np.random.default_rng(0).uniform(0, 1, (41, 41))
    np.save(tmp_path / "in.npy", heights)
    script = (
        "import sys\n"
        "from jaxhf.cli.main import main\n"
        "for command in (['convert', 'in.npy', 'out.npz'], ['hillshade', 'out.npz', '-o', 'out.png', '--shadows'],\n"
        "                ['slope', 'in.npy', '-o', 'out.npy'], ['relief', 'in.npy', '-o', 'out.png']):\n"
        "    assert main(command) == 0\n"
        "print({'jax', 'equinox', 'matplotlib', 'rasterio'} & sys.modules.keys())\n"
    )
    run = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=60, cwd=tmp_path)
    assert run.stdout.splitlines()[-1:] == ["set()"], run.stderr


def test_conversion_keeps_heights_and_place(tmp_path, command):
    pytest.importorskip("rasterio")
    terrain = plane(0.5, 0.25)
    terrain.heights[2, 3] = np.nan
    jaxhf.save_heights(tmp_path / "one.npz", terrain)
    code, out, _ = command("convert", tmp_path / "one.npz", tmp_path / "two.tif")
    assert (code, "6 x 9 heights, cells 30 x 60, origin (500000, 4.1e+06)" in out) == (0, True)
    found = jaxhf.load_heights(tmp_path / "two.tif")
    np.testing.assert_array_equal(found.heights, terrain.heights)
    assert (found.dx, found.dy, found.x0, found.y0) == (30, 60, 5e5, 4.1e6)
    code, out, _ = command("convert", tmp_path / "two.tif", tmp_path / "three.npy", "--z-scale", 2, "--nodata", 0)
    assert (code, ".npy holds the heights alone" in out) == (0, True)
    expected = np.where(terrain.heights == 0, np.nan, 2 * terrain.heights)
    np.testing.assert_array_equal(np.load(tmp_path / "three.npy"), expected)


def test_conversion_says_what_is_left_out(tmp_path, command):
    """And refuses before it reads."""
    for name, top, said in (
        ("out.png", 0.25, " (.png holds whole numbers: heights are rounded to steps of 1)\n"),
        ("out.png", 1, "\n"),
        ("out.exr", 1, " (.exr holds the heights alone)\n"),
    ):
        if name.endswith(".exr"):
            pytest.importorskip("OpenEXR")
        jaxhf.save_heights(tmp_path / "in.npz", Terrain(top * np.eye(3)))
        code, out, _ = command("convert", tmp_path / "in.npz", tmp_path / name)
        assert (code, out.endswith(f"range (0, {top}){said}")) == (0, True)
    code, _, err = command("convert", tmp_path / "missing.tif", tmp_path / "out.jpg")
    assert (code, "cannot write heights with the ending '.jpg'" in err) == (2, True)
