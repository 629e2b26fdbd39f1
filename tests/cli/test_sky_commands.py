"""`jaxhf skyview` and `jaxhf horizon`: the values of the functions of those names, where the terrain lies."""

import errno
import sys

import numpy as np
import pytest
from PIL import Image

import jaxhf
from jaxhf.cli.main import main

Z = np.random.default_rng(0).uniform(size=(5, 7))
Z[2, 3] = np.nan


@pytest.fixture
def run(monkeypatch, tmp_path, capsys):
    """A command on that terrain, whose cells are of 2 x 3, in double precision; its exit code and what it says."""
    monkeypatch.setattr("jaxhf.cli.arguments.set_up_jax", lambda options: None)
    path = tmp_path / "terrain.npz"
    jaxhf.save_heights(path, jaxhf.Terrain(Z, 2.0, 3.0, 100.0, 50.0))

    def command(name, output, *options):
        code = main([name, str(path), "-o", str(tmp_path / output), "--precision", "float64", *options])
        return code, "".join(capsys.readouterr())

    return command


def test_skyview(run, tmp_path):
    reports = []
    expected = np.asarray(jaxhf.sky_view(Z, 4, dx=2.0, dy=3.0, progress=lambda *report: reports.append(report)))
    assert reports == [(35, 35)]
    np.testing.assert_allclose(jaxhf.sky_view(Z, 4, dx=2.0, dy=3.0), expected, rtol=1e-14)
    code, said = run("skyview", "sky.npy", "--azimuths", "4")
    assert code == 0
    assert f": sky-view factor {np.nanmin(expected):.3f} .. {np.nanmax(expected):.3f}, 4 azimuths, " in said
    np.testing.assert_array_equal(np.load(tmp_path / "sky.npy"), expected)
    assert run("skyview", "sky.png", "--azimuths", "4")[0] == 0
    with Image.open(tmp_path / "sky.png") as picture:
        np.testing.assert_array_equal(np.asarray(picture)[::-1], np.rint(255 * np.nan_to_num(expected)))


def test_horizon(run, tmp_path):
    expected = [
        np.asarray(jaxhf.horizon(Z, [azimuth], dx=2.0, dy=3.0, progress=lambda done, total: None))[0]
        for azimuth in (0.0, 90.0, 180.0, 270.0)
    ]
    assert run("horizon", "all.npy", "--azimuths", "4")[0] == 0
    np.testing.assert_array_equal(np.load(tmp_path / "all.npy"), expected)
    pytest.importorskip("rasterio")
    assert run("horizon", "west.tif", "--azimuth", "270")[0] == 0
    west = jaxhf.load_heights(tmp_path / "west.tif")
    np.testing.assert_array_equal(west.heights, expected[3])
    assert (west.dx, west.dy, west.x0, west.y0) == (2, 3, 100, 50)
    assert run("horizon", "each.tif", "--azimuths", "4")[0] == 0
    names = sorted(path.name for path in tmp_path.glob("each*"))
    assert names == [f"each_{degrees}.tif" for degrees in ("000", "090", "180", "270")]


@pytest.mark.parametrize(("name", "heights"), [("skyview", 35), ("horizon", 4 * 35)])
def test_a_bar_tells_what_is_done_until_ctrl_c(run, name, heights, tmp_path, monkeypatch):
    """Which comes after the last tile, or azimuth: the old file is kept."""
    (tmp_path / "old.npy").write_bytes(b"old")
    files = sorted(tmp_path.iterdir())
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


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("skyview", "sky.npy", "--azimuths", "0"), "--azimuths must be a whole number from 1 on, it is 0"),
        (("skyview", "sky.txt"), "sky.txt"),
        (("horizon", "h.png"), "h.png: a .png holds whole numbers from 0 to 255, no angles; write .tif or .npy"),
        (("horizon", "h.npy", "--azimuth", "nan"), "--azimuth must be finite, it is nan"),
        (("horizon", "h.npy", "--dx", "-2"), "dx must be positive and finite, it is -2.0"),
    ],
)
def test_mistakes_are_one_line(run, arguments, message):
    code, said = run(*arguments)
    assert code == 2
    assert said.startswith("jaxhf: error: ")
    assert message in said
    assert said.count("\n") == 1


def test_a_full_disk_leaves_none_of_several_maps(tmp_path, capsys, monkeypatch):
    pytest.importorskip("rasterio")
    from jaxhf.io import rasters

    geotiff, written = rasters.geotiff, []

    def full(*given):
        written.append(given)
        if len(written) == 4:
            raise OSError(errno.ENOSPC, "No space left on device")
        return geotiff(*given)

    monkeypatch.setattr("jaxhf.cli.arguments.set_up_jax", lambda options: None)
    monkeypatch.setattr(rasters, "geotiff", full)
    jaxhf.save_heights(tmp_path / "in.npz", jaxhf.Terrain(np.random.default_rng(0).random((6, 5)).astype("f"), 1.0, 1.0))
    command = ["horizon", str(tmp_path / "in.npz"), "-o", str(tmp_path / "out.tif"), "--azimuths", "8"]
    assert main(command) == 2
    assert "cannot be written: No space left" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["in.npz"]
    assert main(command) == 0
    assert len(list(tmp_path.glob("out_*.tif"))) == 8


def test_one_azimuth_is_one(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("jaxhf.cli.arguments.set_up_jax", lambda options: None)
    jaxhf.save_heights(tmp_path / "in.npz", jaxhf.Terrain(np.eye(4, dtype=np.float32), 1.0, 1.0))
    for command in ("horizon", "skyview"):
        assert main([command, str(tmp_path / "in.npz"), "-o", str(tmp_path / "out.npy"), "--azimuths", "1"]) == 0
        assert ", 1 azimuth, " in capsys.readouterr().out
        assert np.load(tmp_path / "out.npy").shape == {"horizon": (1, 4, 4), "skyview": (4, 4)}[command]
