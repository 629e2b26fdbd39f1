"""`jaxhf skyview`, `horizon`, `insolation`, `viewshed`: the values of the functions of those names, where the terrain lies."""

import errno
import sys

import numpy as np
import pytest
from PIL import Image

import jaxhf

Z = np.random.default_rng(0).uniform(size=(5, 7)).astype(np.float32)
Z[2, 3] = np.nan


@pytest.fixture
def run(command, tmp_path):
    """A command on that terrain, whose cells are of 2 x 3; its exit code and what it says."""

    def run(name, output, *options):
        jaxhf.save_heights(tmp_path / "terrain.npz", jaxhf.Terrain(Z, 2.0, 3.0, 100.0, 50.0))
        code, *said = command(name, tmp_path / "terrain.npz", "-o", tmp_path / output, *options)
        return code, "".join(said)

    return run


def test_skyview(run, tmp_path):
    reports = []
    options = {"dx": 2.0, "dy": 3.0, "weighting": "horizontal"}
    expected = np.asarray(jaxhf.sky_view(Z, 4, **options, progress=lambda *report: reports.append(report)))
    assert reports == [(35, 35)]
    np.testing.assert_allclose(jaxhf.sky_view(Z, 4, **options), expected, rtol=1e-6)
    code, said = run("skyview", "sky.npy", "--azimuths", "4", "--weighting", "horizontal")
    assert code == 0
    assert f": sky-view factor {np.nanmin(expected):.3f} .. {np.nanmax(expected):.3f}, 4 azimuths, " in said
    np.testing.assert_array_equal(np.load(tmp_path / "sky.npy"), expected)
    assert run("skyview", "sky.png", "--azimuths", "4", "--weighting", "horizontal")[0] == 0
    with Image.open(tmp_path / "sky.png") as picture:
        np.testing.assert_array_equal(np.asarray(picture)[::-1], np.rint(255 * np.nan_to_num(expected)))


def test_horizon(run, tmp_path):
    options = {"dx": 2.0, "dy": 3.0, "progress": lambda done, total: None}
    ask = [np.asarray(jaxhf.horizon(Z, [azimuth], **options))[0] for azimuth in (0.0, 90.0, 180.0, 270.0)]
    assert run("horizon", "all.npy", "--azimuths", "4")[0] == 0
    np.testing.assert_array_equal(np.load(tmp_path / "all.npy"), ask)
    pytest.importorskip("rasterio")
    code, said = run("horizon", "west.tif", "--azimuth", "270")
    assert (code, ", 1 azimuth, " in said) == (0, True)
    west = jaxhf.load_heights(tmp_path / "west.tif")
    np.testing.assert_array_equal(west.heights, ask[3])
    assert (west.dx, west.dy, west.x0, west.y0) == (2, 3, 100, 50)


@pytest.mark.parametrize(("name", "heights"), [("skyview", 35), ("horizon", 4 * 35)])
def test_a_bar_tells_what_is_done_until_ctrl_c(run, name, heights, tmp_path, monkeypatch):
    """Which comes after the last tile, or azimuth: the old file is kept."""
    (tmp_path / "old.npy").write_bytes(b"old")
    files = [tmp_path / "old.npy", tmp_path / "terrain.npz"]
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    shown = []

    def update(bar, increment):
        bar.n += increment
        shown.append((bar.n, bar.total))
        if bar.n == heights:
            raise KeyboardInterrupt

    monkeypatch.setattr("tqdm.std.tqdm.update", update)
    code, said = run(name, "old.npy", "--azimuths", "4")
    assert code == 130
    assert "compiling" in said
    assert shown[-1] == (heights, heights)
    assert len(shown) == heights // 35
    assert sorted(tmp_path.iterdir()) == files
    assert (tmp_path / "old.npy").read_bytes() == b"old"
    code, said = run(name, "old.npy", "--azimuths", "4", "--quiet")
    assert (code, said) == (0, "")


def test_a_full_disk_leaves_none_of_several_maps(run, tmp_path, monkeypatch):
    pytest.importorskip("rasterio")
    from jaxhf.cli.commands import sky

    geotiff, written = sky.geotiff, []

    def full(*given):
        written.append(given)
        if len(written) == 3:
            raise OSError(errno.ENOSPC, "No space left on device")
        return geotiff(*given)

    monkeypatch.setattr(sky, "geotiff", full)
    code, said = run("horizon", "out.tif", "--azimuths", "4")
    assert (code, "cannot be written: No space left" in said) == (2, True)
    assert [path.name for path in tmp_path.iterdir()] == ["terrain.npz"]
    assert run("horizon", "out.tif", "--azimuths", "4")[0] == 0
    assert sorted(path.name for path in tmp_path.glob("out*")) == [f"out_{turn}.tif" for turn in ("000", "090", "180", "270")]


def test_insolation(run, tmp_path):
    """Of a day from midnight to midnight of mean solar time, 48 minutes before Greenwich's; and between two times."""
    begin, place = np.datetime64("2026-06-20T23:12"), (47.0, 12.0)
    options = {"azimuths": 8, "dx": 2.0, "dy": 3.0, "progress": lambda done, total: None}
    found = jaxhf.insolation(Z, begin, begin + np.timedelta64(1, "D"), place, **options)
    where = "--latitude", "47", "--longitude", "12", "--azimuths", "8"
    code, said = run("insolation", "day.npy", "--begin", "2026-06-21", "--end", "2026-06-22", *where)
    assert code == 0, said
    assert f": energy {np.nanmin(found):.4g} .. {np.nanmax(found):.4g} kWh/m², 8 azimuths, " in said
    np.testing.assert_array_equal(np.load(tmp_path / "day.npy"), found)
    west = [("--latitude", "47", "--longitude", longitude, "--azimuths", "8") for longitude in ("-10", "350")]
    for name, there in zip(("a.npy", "b.npy"), west, strict=True):
        assert run("insolation", name, "--begin", "2026-06-21", "--end", "2026-06-22", *there)[0] == 0
    np.testing.assert_allclose(np.load(tmp_path / "a.npy"), np.load(tmp_path / "b.npy"), rtol=1e-6)
    times = "--begin", "2026-06-21T11:00+02:00", "--end", "2026-06-21T10:00Z"
    code, said = run("insolation", "hour.npy", *times, "--wanted", "hours", *where)
    assert code == 0, said
    hour = np.datetime64("2026-06-21T09:00"), np.datetime64("2026-06-21T10:00")
    found = jaxhf.insolation(Z, *hour, place, wanted="hours", **options)
    np.testing.assert_array_equal(np.load(tmp_path / "hour.npy"), found)
    assert 0 < np.nanmax(found) < 1.001


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ("--begin 2026-06-21 --end 2026-06-22", "insolation: times need --latitude and --longitude for "),
        ("--begin 2026-06-21T10:00 --end 2026-06-22", "--begin must be a date, as 2026-06-21, or a time with its offset"),
        ("--begin 2026-06-22 --end 2026-06-21 --latitude 4 --longitude 4",
         "--end must come after --begin, they are 2026-06-21 and 2026-06-22; dates are"),
        ("--begin 2026-06-21 --end 2026-06-22 --latitude 4", "insolation: --latitude and --longitude belong"),
        ("--begin 2026-06-21 --end 2026-06-22 --wanted hours --turbidity 2",
         "--turbidity would change nothing: hours of sun are the same in any air"),
        ("--begin 2026-06-21", "required: --end"),
    ],
)  # fmt: skip
def test_wrong_times_are_refused(run, options, expected):
    code, said = run("insolation", "sun.npy", *options.split())
    assert code == 2
    assert expected in " ".join(said.split())


def test_viewshed(run, tmp_path):
    """From two points, and all along the line between them; in the coordinates of the file, which begin at (100, 50)."""
    eyes = [(3.0, 2.0), (10.0, 2.5)]
    observers = [word for x, y in eyes for word in ("--observer", str(100 + x), str(50 + y))]
    terrain = jaxhf.Terrain(Z, 2.0, 3.0)
    code, said = run("viewshed", "seen.png", *observers, "--height", "0.2", "--target-height", "0.1")
    seen = jaxhf.viewshed(terrain, eyes, 0.2, 0.1)
    assert code == 0
    assert f": {100 * seen.sum() / 34:.1f} % is seen, from 2 points, " in said
    with Image.open(tmp_path / "seen.png") as picture:
        np.testing.assert_array_equal(np.asarray(picture)[::-1], np.where(seen, 255, 0))
    assert 3 < seen.sum() < 34
    assert run("viewshed", "above.npy", *observers, "--line", "--above-ground", "--radius", "50")[0] == 0
    along = np.linspace(eyes[0], eyes[1], 5)  # 3.5 cells: in 4 steps
    expected = jaxhf.viewshed(terrain, along, wanted="above-ground", radius=50.0)
    over_hole = ("--observer", "102", "53", "--observer", "110", "59", "--line")  # through the middle of the hole
    code, said = run("viewshed", "over.npy", *over_hole)
    assert (code, "from 4 points" in said) == (0, True), said
    np.testing.assert_array_equal(np.load(tmp_path / "above.npy"), expected)


def test_viewshed_of_an_area(run, tmp_path):
    """From all heights within a polygon with a notch, but the one in the hole."""
    corners = np.array([(0.5, 0.5), (5.5, 0.5), (5.5, 3.5), (3.2, 2.2), (0.5, 3.5)]) * (2, 3)
    shown = [word for x, y in corners for word in ("--observer", str(100 + x), str(50 + y))]
    code, said = run("viewshed", "seen.npy", *shown, "--area", "--height", "0.1")
    assert (code, "from 11 points" in said) == (0, True), said
    within = [(1, 1), (2, 1), (3, 1), (4, 1), (5, 1), (1, 2), (2, 2), (4, 2), (5, 2), (1, 3), (5, 3)]
    expected = jaxhf.viewshed(jaxhf.Terrain(Z, 2.0, 3.0), np.array(within) * (2, 3), 0.1)
    np.testing.assert_array_equal(np.load(tmp_path / "seen.npy"), 255 * expected)


def test_an_area_holds_what_stands_on_its_sides(run):
    """All 34 heights in the rectangle of the corners, and a row of three on a polygon that is a line."""
    corners = [(100, 50), (112, 50), (112, 62), (100, 62)]
    shown = [word for x, y in corners for word in ("--observer", str(x), str(y))]
    assert "from 34 points" in run("viewshed", "seen.npy", *shown, "--area")[1]
    line = [word for x in (102, 106, 104) for word in ("--observer", str(x), "53")]
    assert "from 3 points" in run("viewshed", "seen.npy", *line, "--area")[1]


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ("--observer 90 52", "--observer must be on the terrain, x from 100 to 112 and y from 50 to 62; one is 90 52"),
        ("--observer 103 52 --line", "--line needs 2 --observer at least, it has 1"),
        ("--observer 103 52 --observer 105 52 --area", "--area needs 3 --observer at least, it has 2"),
        ("--observer 103 52 --area --line", "--line would change nothing: --area takes all of what"),
        ("--observer 103 52 --observer 105 52 --observer 103.1 52.1 --area", "--area must hold heights, none stands within"),
        ("--observer 103 52 --above-ground --target-height 2", "--target-height would change nothing: --above-ground"),
        ("--observer 106 56", "--observer[0] must be on a triangle of the terrain"),
        ("--observer 103", "expected 2 arguments"),
        ("", "required: --observer"),
    ],
)
def test_wrong_observers_are_refused(run, options, expected):
    code, said = run("viewshed", "seen.npy", *options.split())
    assert code == 2
    assert expected in said
