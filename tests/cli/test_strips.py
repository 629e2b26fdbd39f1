"""Maps of large rasters, made in strips, against those that are made at once."""

import dataclasses

import numpy as np
import pytest

import jaxhf
import jaxhf.cli.commands.maps
import jaxhf.io.files
import jaxhf.io.terrain.load
from jaxhf.io.terrain.georeference import WGS84_DEGREES, Georeference, coordinate_system

pytest.importorskip("rasterio")

SHAPE = 300, 230  # in strips of 64 rows
COMMANDS = [
    "hillshade", "hillshade --compute-edges --variant igor", "hillshade --shadows", "hillshade --scale 1e5", "slope --percent",
    "slope --compute-edges", "aspect --zero-for-flat", "curvature --kind plan --compute-edges", "ruggedness",
    "ruggedness --measure tpi --compute-edges", "relief",
    "relief --ramp viridis --alpha", "relief --no-shading", "slope --bbox 7.01 45.9 7.05 45.97", "slope --window 3 5 200 290",
]  # fmt: skip


@pytest.fixture
def large(tmp_path):
    """A raster in degrees, whose northern strips are of holes alone; others are anywhere."""
    random = np.random.default_rng(0)
    z = np.cumsum(np.cumsum(random.normal(size=SHAPE), 0), 1).astype(np.float32)
    z[-130:], z[100:120, 50:90], z[random.uniform(size=SHAPE) < 0.01] = np.nan, np.nan, np.nan
    place = Georeference(WGS84_DEGREES, nodata=-9999.0)
    terrain = jaxhf.Terrain(z, 1 / 3600, 1 / 3600, 7.0, 45.9, coordinate_system(WGS84_DEGREES), place)
    jaxhf.save_heights(tmp_path / "large.tif", terrain)
    return tmp_path / "large.tif"


def strips_of(heights, monkeypatch):
    for module in (jaxhf.cli.commands.maps, jaxhf.io.terrain.load):
        monkeypatch.setattr(module, "STRIP", heights)


ONE_ROW_LEFT = [(words, rows) for words in ("relief --alpha", "slope") for rows in (65, 129)]


@pytest.mark.parametrize(("words", "rows"), [*((words, SHAPE[0]) for words in COMMANDS), *ONE_ROW_LEFT])
@pytest.mark.parametrize("ending", [".tif", pytest.param(".npy", marks=pytest.mark.deep)])
def test_strips_have_the_bytes_of_the_whole(large, words, rows, ending, command, monkeypatch):
    name, *more = words.split()
    terrain = jaxhf.load_heights(large)
    jaxhf.save_heights(large, dataclasses.replace(terrain, heights=terrain.heights[:rows]))
    files = []
    for heights in (2**24, 64 * SHAPE[1]):
        strips_of(heights, monkeypatch)
        files.append(large.with_name(f"{heights}{ending}"))
        code, _, err = command(name, large, "-o", files[-1], *more)
        assert code == 0, err
    assert files[0].read_bytes() == files[1].read_bytes()
    if "--shadows" not in words:
        monkeypatch.setattr(jaxhf.io.files, "MAX_PIXELS", 20_000)  # memory may hold a strip, not all
        assert command(name, large, "-o", files[0], *more)[0] == 0
        assert files[0].read_bytes() == files[1].read_bytes()


def test_what_needs_all_of_it_has_the_limit_of_memory(large, command, monkeypatch):
    strips_of(64 * SHAPE[1], monkeypatch)
    monkeypatch.setattr(jaxhf.io.files, "MAX_PIXELS", 20_000)
    for words in (["-o", large.with_name("a.tif"), "--shadows"], ["-o", large.with_name("a.png")]):
        code, _, err = command("hillshade", large, *words)
        assert (code, "at most 20000 pixels, it declares 230 x 300" in err) == (2, True)
    assert [path.name for path in large.parent.iterdir()] == ["large.tif"]


def test_nothing_but_holes_is_no_map(large, command, monkeypatch):
    strips_of(64 * SHAPE[1], monkeypatch)
    terrain = jaxhf.load_heights(large)
    terrain.heights[...] = np.nan
    jaxhf.save_heights(large, terrain)
    code, _, err = command("slope", large, "-o", large.with_name("a.tif"))
    assert (code, "slope: heights must hold a finite one" in err) == (2, True)
    assert [path.name for path in large.parent.iterdir()] == ["large.tif"]


@pytest.mark.filterwarnings("default")
def test_values_that_may_mean_no_height_are_seen_in_a_sample(large, command, monkeypatch):
    monkeypatch.setattr(jaxhf.io.terrain.load, "_SAMPLE", 1000)
    strips_of(64 * SHAPE[1], monkeypatch)
    terrain = jaxhf.load_heights(large)
    terrain.heights[np.isnan(terrain.heights)] = 32767
    jaxhf.save_heights(large, terrain)
    _, _, err = command("slope", large, "-o", large.with_name("a.tif"))
    assert "32767 stands for" in err
