"""`jaxhf hillshade` and `jaxhf convert`: maps held against a closed form, terrains that come back as they were."""

import itertools
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import jaxhf
from jaxhf import Terrain
from jaxhf.cli.hillshade import hillshade_scene
from jaxhf.cli.main import main
from jaxhf.cli.relief import small


@pytest.fixture(autouse=True)
def in_this_process(monkeypatch):
    """JAX is set up already, with double precision."""
    monkeypatch.setattr("jaxhf.cli.arguments.set_up_jax", lambda options: None)


def slope(east: float, north: float) -> Terrain:
    """A plane on a map, its cells twice as high as wide."""
    rows, columns = np.mgrid[:6, :9]
    return Terrain(30.0 * east * columns + 60.0 * north * rows, 30.0, 60.0, 5e5, 4.1e6)


@pytest.mark.parametrize("rendered", [False, True])
@pytest.mark.parametrize(("east", "north"), [(0.5, 0.0), (0.0, -0.7), (-0.3, 0.4)])
def test_planes_have_the_shade_of_their_slope(tmp_path, monkeypatch, east, north, rendered):
    """All formulae agree on a plane: the cosine between its normal and the light; as GDAL's, but for the sky."""
    if rendered:
        monkeypatch.setattr("jaxhf.cli.relief.small", lambda *_: False)
    path = tmp_path / "plane.npz"
    jaxhf.save_heights(path, slope(east, north))
    options = ["--azimuth", "30", "--altitude", "60", "--sky", "0.25", "--precision", "float64"]
    assert main(["hillshade", str(path), "-o", str(tmp_path / "map.npy"), *options]) == 0
    image = np.load(tmp_path / "map.npy")
    assert image.shape == (10, 8, 3)  # 8 cells of 30 across, 5 of 60 up
    azimuth, altitude = np.deg2rad([30, 60])
    light = np.array([np.sin(azimuth) * np.cos(altitude), np.cos(azimuth) * np.cos(altitude), np.sin(altitude)])
    normal = np.array([-east, -north, 1]) / np.sqrt(east**2 + north**2 + 1)
    shade = normal @ light + 0.25 * (1 + normal[2]) / 2  # of the sky a slope sees a part
    np.testing.assert_allclose(image, shade, rtol=1e-9)
    assert main(["hillshade", str(path), "-o", str(tmp_path / "map.png"), *options]) == 0
    with Image.open(tmp_path / "map.png") as picture:
        np.testing.assert_array_equal(np.asarray(picture), int(255 * min(shade, 1) + 0.5))


def test_north_is_up_and_shadows_fall_away_from_the_light():
    heights = np.zeros((20, 30))
    heights[15:17, 5:7] = 4.0  # in the north-west
    scene = hillshade_scene(Terrain(heights), azimuth=315.0, altitude=30.0)
    image = np.asarray(jaxhf.render(scene))[..., 0]
    assert image.shape == (19, 29)
    np.testing.assert_allclose(image[-1], np.sin(np.deg2rad(30)), rtol=1e-9)
    row, column = map(int, np.unravel_index(image.argmax(), image.shape))
    assert (row < 5, column < 7) == (True, True)
    dark = np.argwhere(image == 0)
    assert len(dark) > 10
    assert dark[:, 0].mean() > row
    assert dark[:, 1].mean() > column + 2


@pytest.mark.parametrize("shape", [(4, 61), (61, 4), (9, 30)])
@pytest.mark.parametrize("size", [{}, {"width": 20}, {"height": 7}, {"width": 12, "height": 12}])
def test_all_of_the_terrain_is_seen(shape, size):
    """Whatever the proportions and the rounding; what is beside it in a picture of other proportions is black."""
    scene = hillshade_scene(Terrain(np.zeros(shape), 2.0, 3.0, 100.0, 50.0), 315.0, 45.0, 0.0, **size)
    camera: Any = scene.camera
    height, width = camera.height, camera.width
    assert {"width": width, "height": height}.items() >= size.items()
    middle = np.array([2 * (shape[1] - 1), 3 * (shape[0] - 1)]) / 2
    np.testing.assert_allclose(camera.world_from_camera[:2, 3], np.add(middle, [100, 50]))
    half = float(camera.extent) / 2 * np.array([width, height]) / min(width, height)
    assert (half >= middle * (1 - 1e-12)).all()
    assert np.isclose(half, middle).any()
    if len(size) < 2:  # less than half a pixel on either side is beside it
        assert (half - middle < half / np.array([width, height])).all()


@pytest.mark.parametrize(("rough", "samples"), [(True, 4), (False, 1)])
def test_a_small_map_is_that_of_the_renderer(tmp_path, monkeypatch, rough, samples):
    """Attached and cast shadows, and pixels beside the terrain. No sample lies on an edge, where either triangle may count."""
    rows, columns = np.mgrid[:20, :30]
    heights = 80 * np.sin(rows / 4) * np.cos(columns / 5)
    if rough:
        heights = np.random.default_rng(0).uniform(0, 90, rows.shape)
    jaxhf.save_heights(tmp_path / "small.npz", Terrain(heights, 30.0, 50.7, 5e5, 4.1e6))
    options = ["--azimuth", "290", "--altitude", "20", "--sky", "0.2", "--width", "37", "--height", "45"]
    maps = []
    for name in ("numpy.npy", "jax.npy"):
        more = ["--samples", str(samples), "--precision", "float64"]
        assert main(["hillshade", str(tmp_path / "small.npz"), "-o", str(tmp_path / name), *options, *more]) == 0
        maps.append(np.load(tmp_path / name))
        monkeypatch.setattr("jaxhf.cli.relief.small", lambda *_: False)
    np.testing.assert_allclose(*maps, rtol=1e-9)  # the renderer subtracts an origin of 4e6 from the camera's position
    dark = maps[0][..., 0] < 0.2  # less than the sky gives to level ground
    assert 0.05 < dark.mean() < 0.9


def test_which_maps_are_small():
    """Those without holes, unless rays to the light cross too much."""
    heights = np.random.default_rng(0).uniform(0, 10, (200, 200))
    assert small(Terrain(heights), 40_000, 45.0)
    assert not small(Terrain(heights), 4_000_000, 45.0)
    assert not small(Terrain(100 * heights), 160_000, 5.0)
    heights[3, 3] = np.nan
    assert not small(Terrain(heights), 40_000, 45.0)


def test_small_maps_and_conversions_do_without_jax(tmp_path):
    heights = np.random.default_rng(0).uniform(0, 1, (41, 41))
    np.save(tmp_path / "in.npy", heights)
    script = (
        "import sys\n"
        "from jaxhf.cli.main import main\n"
        "for command in (['convert', 'in.npy', 'out.npz'], ['hillshade', 'out.npz', '-o', 'out.png']):\n"
        "    assert main(command) == 0\n"
        "print({'jax', 'equinox'} & sys.modules.keys())\n"
    )
    run = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=60, cwd=tmp_path)
    assert run.stdout.splitlines()[-1:] == ["set()"], run.stderr


def test_holes_are_black_and_the_rest_is_not():
    heights = np.random.default_rng(0).uniform(0, 0.1, (8, 8))
    heights[3, 3] = np.nan
    image = np.asarray(jaxhf.render(hillshade_scene(Terrain(heights))))[..., 0]
    assert set(map(tuple, np.argwhere(image == 0))) == {(3, 2), (3, 3), (4, 2), (4, 3)}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--altitude", "0"], "altitude must be above 0 and at most 90 degrees, it is 0.0"),
        (["--sky", "-1"], "sky must be 0 or more, it is -1.0"),
        (["--width", "0"], "--width must be a whole number of pixels from 1 on, it is 0"),
    ],
)
def test_hillshade_refuses(tmp_path, capsys, options, message):
    jaxhf.save_heights(tmp_path / "plane.npz", slope(0, 0))
    assert main(["hillshade", str(tmp_path / "plane.npz"), "-o", str(tmp_path / "map.npy"), *options]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "map.npy").exists()


def test_conversion_keeps_heights_and_place(tmp_path, capsys):
    pytest.importorskip("rasterio")
    terrain = slope(0.5, 0.25)
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


def test_conversion_refuses_before_it_reads(tmp_path, capsys):
    assert main(["convert", str(tmp_path / "missing.tif"), str(tmp_path / "out.jpg")]) == 2
    assert "cannot write heights with the ending '.jpg'" in capsys.readouterr().err
    assert list(Path(tmp_path).iterdir()) == []
