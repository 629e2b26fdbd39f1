"""`jaxhf relief --annotate`: what stands on a map's sheet, and where."""

import dataclasses
from typing import Any

import numpy as np
import pytest

import jaxhf
from jaxhf.cli.sheet import sheet
from jaxhf.io.terrain.georeference import WGS84_DEGREES, Georeference, coordinate_system
from jaxhf.maps.ramp import as_ramp

pytest.importorskip("matplotlib")

RANDOM = np.random.default_rng(0)
Z = np.cumsum(np.cumsum(RANDOM.normal(size=(40, 60)), 0), 1).astype(np.float32)
LOW, HIGH = float(Z.min()), float(Z.max())


def degrees() -> jaxhf.Terrain:
    place = Georeference(WGS84_DEGREES)
    return jaxhf.Terrain(Z, 1 / 1200, 1 / 1200, 7.0, 60.0, coordinate_system(WGS84_DEGREES), place)


def parts(terrain: jaxhf.Terrain, contours: float | None = None, dx: float | None = None) -> tuple[Any, Any, Any]:
    """The axes of the map, its picture, and the scale bar."""
    colours = jaxhf.relief(terrain, alpha=True) if terrain.crs else jaxhf.color_relief(terrain, alpha=True)
    metres = terrain.in_metres(dx=dx) if dx else terrain.in_metres()
    figure = sheet(colours, terrain, metres, as_ramp(None, LOW, HIGH), "interpolate", contours, "A title", "a caption")
    axis = figure.axes[0]
    assert (axis.get_title(loc="left"), axis.get_xlabel()) == ("A title", "a caption")
    (picture,) = axis.get_images()
    np.testing.assert_array_equal(picture.get_array(), colours)
    return axis, picture, axis.artists[0]


def test_a_map_lies_at_its_coordinates_with_a_scale_bar_of_metres():
    terrain = degrees()
    axis, picture, bar = parts(terrain)
    step = 1 / 1200
    np.testing.assert_allclose(picture.get_extent(), (7 - step / 2, 7 + 59.5 * step, 60 - step / 2, 60 + 39.5 * step))
    metres = terrain.in_metres()
    assert axis.get_aspect() == pytest.approx(metres.dy / metres.dx)
    assert 1.9 < axis.get_aspect() < 2.1  # at 60 degrees north
    assert bar.txt_label.get_text() == "500 m"  # of 2.8 km
    assert bar.size_bar.get_children()[0].get_width() * metres.dx / terrain.dx == pytest.approx(500)
    assert [text.get_text() for text in axis.texts] == ["N"]
    assert axis.figure.axes[1].get_ylabel() == "height, m"


def test_what_was_made_metres_lies_where_its_file_does():
    """As of heights that were read in metres and saved."""
    terrain = degrees()
    step = 1 / 1200
    axis, picture, bar = parts(terrain.in_metres())
    np.testing.assert_allclose(picture.get_extent(), (7 - step / 2, 7 + 59.5 * step, 60 - step / 2, 60 + 39.5 * step))
    assert bar.txt_label.get_text() == "500 m"
    assert bar.size_bar.get_children()[0].get_width() * terrain.in_metres().dx / step == pytest.approx(500)
    assert axis.figure.axes[1].get_ylabel() == "height, m"


@pytest.mark.parametrize("entries", ["interpolate", "nearest", "exact"])
def test_the_legend_has_the_colours_of_the_map(tmp_path, entries):
    ramp = as_ramp(None, LOW, HIGH)
    colours = jaxhf.color_relief(Z, ramp, entries=entries, alpha=True)
    figure = sheet(colours, jaxhf.Terrain(Z), jaxhf.Terrain(Z), ramp, entries, None, None, "")
    shown = next(part for part in figure.axes[1].collections if np.size(part.get_array()) == 256)
    legend = {tuple(colour) for colour in (shown.cmap(np.arange(256)) * 255).round().astype(int)}
    if entries != "interpolate":
        assert {tuple(colour) for colour in colours.reshape(-1, 4)} <= legend | {(0, 0, 0, 0)}
    assert len(legend) > 100 if entries == "interpolate" else len(legend) <= 13


@pytest.mark.parametrize("shape", [(2, 500), (500, 2), (2, 2)])
def test_narrow_and_level_terrain(tmp_path, shape):
    terrain = jaxhf.Terrain(np.full(shape, -3.0, np.float32), 999.9999999999999 * 5 / shape[1], 7.0)
    ramp = as_ramp(None, -3.0, -3.0)
    figure = sheet(jaxhf.color_relief(terrain, alpha=True), terrain, terrain, ramp, "nearest", 1.0, None, "")
    figure.savefig(tmp_path / "a.png", dpi=20)


def test_what_has_no_unit_has_none():
    axis, _, bar = parts(jaxhf.Terrain(Z))
    assert bar.txt_label.get_text() == "10"
    axis, picture, bar = parts(jaxhf.Terrain(Z), dx=30.0)
    assert bar.txt_label.get_text() == "200"
    assert bar.size_bar.get_children()[0].get_width() == pytest.approx(200 / 30)
    assert picture.get_extent()[1] == 59.5
    assert axis.figure.axes[1].get_ylabel() == "height"


def test_north_is_true_north():
    wkt = pytest.importorskip("rasterio").crs.CRS.from_epsg(32632).to_wkt()
    terrain = jaxhf.Terrain(Z, 30.0, 30.0, 7.2e5, 5.15e6, coordinate_system(wkt), Georeference(wkt))
    axis, _, bar = parts(terrain)
    assert bar.txt_label.get_text() == "200 m"
    east, north = (-np.array(axis.texts[0].get_position())) / 32  # from the letter to the arrow's head
    assert np.degrees(np.arctan2(east, north)) == pytest.approx(-terrain.convergence)
    assert 1 < terrain.convergence < 4


def test_contour_lines_are_where_the_heights_are():
    axis, *_ = parts(degrees(), 20.0)
    lines = [line for line in axis.collections if hasattr(line, "levels")]
    levels = np.sort(np.concatenate([line.levels for line in lines]))
    np.testing.assert_array_equal(levels, np.arange(np.ceil(LOW / 20), np.floor(HIGH / 20) + 1) * 20)
    (thick,) = (line for line in lines if line.get_linewidth()[0] > 0.5)
    np.testing.assert_array_equal(np.asarray(thick.levels) % 100, 0)


@pytest.mark.parametrize("ending", [".svg", ".png", ".pdf"])
def test_the_command(tmp_path, command, ending):
    terrain = degrees()
    terrain.heights[3:5, 3:5] = np.nan
    jaxhf.save_heights(tmp_path / "in.npz", dataclasses.replace(terrain))
    out = tmp_path / f"out{ending}"
    words = ["--annotate", "--title", "Hills $ dales $x_$", "--contours", 50, "--shadows", "--z-factor", 2, "--azimuth", 270]
    code, said, err = command("relief", tmp_path / "in.npz", "-o", out, *words)
    assert (code, said.startswith(f"{out}: a sheet of 60 x 40 heights, ")) == (0, True), err
    if ending == ".svg":
        text = out.read_text()
        for words in ("Hills $ dales $x_$", "light from 270°, 45° high; with cast shadows; shaded with heights x 2; WGS 84"):
            assert words in text


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("-o a.tif --annotate", "cannot write a sheet with the ending '.tif'"),
        ("-o a.pdf", "a.pdf: only a sheet is written with this ending, which --annotate makes"),
        ("-o a.png --contours 5", "--contours would change nothing: without --annotate there is no sheet"),
        ("-o a.png --annotate --alpha", "--alpha would change nothing: a sheet is white where there is no height"),
        ("-o a.png --annotate --contours 1e-310", "--contours must leave at most 500 lines, heights go from"),
        ("-o a.png --title x", "--title would change nothing: without --annotate"),
        ("-o a.png --annotate --contours 0", "must be positive and finite, it is 0"),
        ("-o a.png --annotate --contours 1e-6", "--contours must leave at most 500 lines, heights go from"),
    ],
)
def test_wrong_options(tmp_path, command, monkeypatch, words, message):
    monkeypatch.chdir(tmp_path)
    jaxhf.save_heights("in.npz", degrees())
    code, _, err = command("relief", "in.npz", *words.split())
    assert (code, message in err) == (2, True), err
    assert [path.name for path in tmp_path.iterdir()] == ["in.npz"]
