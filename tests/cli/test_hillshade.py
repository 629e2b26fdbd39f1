"""`jaxhf hillshade`, `slope`, `aspect` and `relief`: maps in their place."""

import subprocess
import sys

import geotiffs
import numpy as np
import pytest
from PIL import Image

import jaxhf
from jaxhf import Terrain
from jaxhf.cli.main import main


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
        (["relief", *words, "--alpha", "--shadows"], jaxhf.relief(terrain, **light, alpha=True, shadows=True), None),
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
