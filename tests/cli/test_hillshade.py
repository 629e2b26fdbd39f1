"""`jaxhf hillshade`, `slope`, `aspect`, `relief` and `convert`: maps in their place, terrains that come back as they were."""

import itertools
import subprocess
import sys
from pathlib import Path

import numpy as np
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
    with rasterio.open(
        source, "w", driver="GTiff", width=30, height=20, count=1, dtype="float32", crs="EPSG:32632", nodata=-9999,
        transform=rasterio.Affine(30, 0, 5e5, 0, -50, 4.1e6),
    ) as file:  # fmt: skip
        file.write(np.nan_to_num(terrain.heights[::-1], nan=-9999), 1)
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
    world = [float(line) for line in (tmp_path / "map.pgw").read_text().splitlines()]
    assert world == [30, 0, 0, -50, 5e5 + 15, 4.1e6 - 25]


def test_degrees_are_measured_in_metres_and_that_is_said(tmp_path, capsys):
    rasterio = pytest.importorskip("rasterio")
    heights = hills(False).heights
    with rasterio.open(
        tmp_path / "degrees.tif", "w", driver="GTiff", width=30, height=20, count=1, dtype="float32", crs="EPSG:4326",
        transform=rasterio.Affine(1 / 3600, 0, 7, 0, -1 / 3600, 46),
    ) as file:  # fmt: skip
        file.write(heights[::-1], 1)
    command = ["slope", str(tmp_path / "degrees.tif"), "-o", str(tmp_path / "slope.npy")]
    assert main(command) == 0
    assert "is in degrees, which are measured in metres at latitude 46;" in capsys.readouterr().err
    metres = jaxhf.load_heights(tmp_path / "degrees.tif")
    np.testing.assert_array_equal(np.load(tmp_path / "slope.npy"), jaxhf.slope(metres))
    assert main([*command, "--scale", "111120"]) == 0
    assert capsys.readouterr().err == ""
    expected = jaxhf.slope(heights, 1 / 3600, 1 / 3600, scale=111120.0)
    np.testing.assert_allclose(np.load(tmp_path / "slope.npy"), expected, rtol=1e-5)


def test_an_unknown_spacing_is_said(tmp_path, capsys):
    np.save(tmp_path / "in.npy", hills(False).heights)
    command = ["slope", str(tmp_path / "in.npy"), "-o", str(tmp_path / "slope.npy")]
    assert main(command) == 0
    assert "in.npy does not say how far apart its heights are, 1 is taken (--dx and --dy overrule)" in capsys.readouterr().err
    assert main([*command, "--dx", "1"]) == 0
    assert capsys.readouterr().err == ""


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


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["hillshade", "--altitude", "0"], "hillshade: altitude must be above 0 and at most 90 degrees, it is 0.0"),
        (["hillshade", "--scale", "-1"], "hillshade: scale must be positive and finite, it is -1.0"),
        (["slope", "--dx", "0"], "slope: dx must be positive and finite, it is 0.0"),
        (["slope", "-o", "map.png"], "map.png: a .png holds whole numbers from 0 to 255, no slope; write .tif or .npy"),
        (["aspect", "-o", "map.exr"], "cannot write a map with the ending '.exr'"),
        (
            ["relief", "--ramp", "terain"],
            "terain: there is no such file, nor a matplotlib colour map of this name; did you mean terrain or ",
        ),
        (["relief", "--ramp", "nosuch"], "colour map of this name; terrain, gist_earth or viridis are some (matplotlib.org/"),
        (["relief", "--ramp", "no.txt"], "no.txt: there is no such file"),
        (["hillshade", "--nodata", "0"], "hillshade: heights must hold a finite one"),
    ],
)
def test_maps_refuse(tmp_path, capsys, monkeypatch, words, message):
    monkeypatch.chdir(tmp_path)
    jaxhf.save_heights("plane.npz", plane(0, 0))
    assert main([words[0], "plane.npz", "-o", "map.npy", *words[1:]]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["plane.npz"]


def test_conversion_keeps_heights_and_place(tmp_path, capsys):
    pytest.importorskip("rasterio")
    terrain = plane(0.5, 0.25)
    terrain.heights[2, 3] = np.nan
    paths = [tmp_path / name for name in ("one.npz", "two.tif", "three.tif", "four.npz")]
    jaxhf.save_heights(paths[0], terrain)
    for before, after in itertools.pairwise(paths):
        assert main(["convert", str(before), str(after)]) == 0
        found = jaxhf.load_heights(after)
        np.testing.assert_array_equal(found.heights, terrain.heights)
        assert (found.dx, found.dy, found.x0, found.y0) == (30, 60, 5e5, 4.1e6)
    assert "6 x 9 heights, cells 30 x 60, origin (500000, 4.1e+06)" in capsys.readouterr().out
    assert main(["convert", str(paths[0]), str(tmp_path / "five.npy"), "--z-scale", "2", "--nodata", "0"]) == 0
    expected = np.where(terrain.heights == 0, np.nan, 2 * terrain.heights)
    np.testing.assert_array_equal(np.load(tmp_path / "five.npy"), expected)
    assert ".npy holds the heights alone" in capsys.readouterr().out


def test_conversion_to_exr_says_what_is_left_out(tmp_path, capsys):
    pytest.importorskip("OpenEXR")
    jaxhf.save_heights(tmp_path / "plane.npz", plane(0, 0))
    assert main(["convert", str(tmp_path / "plane.npz"), str(tmp_path / "plane.exr")]) == 0
    assert capsys.readouterr().out.endswith(" (.exr holds the heights alone)\n")


def test_conversion_to_png_says_that_heights_are_rounded(tmp_path, capsys):
    for top, said in ((0.25, " (.png holds whole numbers: heights are rounded to steps of 1)\n"), (1, "\n")):
        jaxhf.save_heights(tmp_path / "in.npz", Terrain(top * np.eye(3)))
        assert main(["convert", str(tmp_path / "in.npz"), str(tmp_path / "out.png")]) == 0
        assert capsys.readouterr().out.endswith(f"range (0, {top}){said}")


def test_conversion_refuses_before_it_reads(tmp_path, capsys):
    assert main(["convert", str(tmp_path / "missing.tif"), str(tmp_path / "out.jpg")]) == 2
    assert "cannot write heights with the ending '.jpg'" in capsys.readouterr().err
    assert list(Path(tmp_path).iterdir()) == []
