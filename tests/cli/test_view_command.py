"""`jaxhf view`: pictures and films of terrain files."""

import argparse
import dataclasses

import imageio.v3 as imageio
import numpy as np
import pytest

import jaxhf
from jaxhf.cli.main import main
from jaxhf.cli.view import _sun, _sun_path
from jaxhf.core.errors import UserError
from jaxhf.io.georeference import WGS84_DEGREES, Georeference
from jaxhf.io.terrain import Terrain
from jaxhf.rendering import render as _render

pytestmark = pytest.mark.unoptimised

SMALL = ["--size", "48x32", "--preset", "draft", "--devices", "1"]
MORNING, EVENING = "2026-06-21T05:00:00Z", "2026-06-21T18:00+01:00"
BY_TIME = ["--sun-from", MORNING, "--sun-to", EVENING]


@pytest.fixture(autouse=True)
def jax_is_set_up(monkeypatch):
    monkeypatch.setattr("jaxhf.cli.arguments.set_up_jax", lambda options: None)


@pytest.fixture(scope="module")
def terrain(tmp_path_factory) -> str:
    path = tmp_path_factory.mktemp("view") / "in.npz"
    x, y = np.meshgrid(np.linspace(-1, 1, 17), np.linspace(-1, 1, 13))
    jaxhf.save_heights(path, Terrain((300 * np.exp(-4 * (x**2 + y**2))).astype(np.float32), 100.0, 100.0))
    return str(path)


@pytest.mark.filterwarnings("always:view. the heights go from")
def test_a_terrain_stands_in_the_middle_of_its_picture(terrain, tmp_path, capsys):
    assert main(["view", terrain, "-o", str(tmp_path / "out.png"), "--water", "-9", *SMALL]) == 0
    told = capsys.readouterr()
    assert "48 x 32 pixels, heights x 1, " in told.out
    assert told.err.endswith(" to 300, --water is -9\n")
    image = imageio.imread(tmp_path / "out.png").astype(int)
    background = (image[:, :1] == image).all(-1)
    rows, columns = np.nonzero(~background)
    assert abs(rows.min() + rows.max() - 31) <= 4
    assert abs(columns.min() + columns.max() - 47) <= 4
    assert columns.max() - columns.min() > 36 or rows.max() - rows.min() > 24
    assert len(np.unique(image[~background], axis=0)) > 100


def test_films_turn_round_and_have_a_moving_sun(terrain, tmp_path, monkeypatch):
    """Each film prepares its terrain once."""
    framing, views = jaxhf.Perspective.framing, []
    prepare, prepared = _render.prepare, []
    monkeypatch.setattr(_render, "prepare", lambda scene: (prepared.append(scene), prepare(scene))[1])

    def recorded(field, azimuth, *rest, **options):
        views.append((azimuth, options["around"]))
        return framing(field, azimuth, *rest, **options)

    monkeypatch.setattr(jaxhf.Perspective, "framing", recorded)
    turning, sunny = tmp_path / "out.gif", tmp_path / "out.mp4"
    assert main(["view", terrain, "-o", str(turning), "--frames", "3", *SMALL]) == 0
    frames = imageio.imread(turning).astype(int)
    assert frames.shape == (3, 32, 48, 3)
    assert views == [(205, True), (325, True), (445, True)]
    sun = ["--sun-from", "90,10", "--sun-to", "90,80"]
    assert main(["view", terrain, "-o", str(sunny), "--frames", "3", *sun, *SMALL]) == 0
    lit = imageio.imread(sunny, plugin="pyav").astype(int)
    assert lit.shape == (3, 32, 48, 3)
    assert views[3:] == [(205, False)]  # the camera stands still
    assert len(prepared) == 2
    for film in (frames, lit):
        assert (np.abs(np.diff(film, axis=0)).max(-1) > 15).mean() > 0.05
    shape = np.abs(lit - lit[:, :1, :1]).max(-1) > 60  # the terrain stands still
    assert (shape[0] == shape[2]).mean() > 0.9


def test_the_sun_moves_as_it_does_over_the_terrain(terrain):
    heights = dataclasses.replace(jaxhf.load_heights(terrain), georeference=Georeference(WGS84_DEGREES, offset=(7.0, 45.5)))
    heights = dataclasses.replace(heights, dx=0.125, dy=1 / 6)  # its middle is at 46.5 degrees north, 8 east
    options = argparse.Namespace(sun_from=_sun(MORNING), sun_to=_sun(EVENING), frames=13, latitude=None, longitude=None)
    path = _sun_path(options, heights)
    assert path is not None
    hours = np.datetime64("2026-06-21T05") + np.arange(13).astype("timedelta64[h]")
    np.testing.assert_allclose(path, np.stack(jaxhf.sun(hours, 46.5, 8.0), -1), atol=1e-6)
    options.latitude, options.longitude = -33.0, 8.0
    with pytest.raises(UserError, match=r"its altitude is -18.44 degrees at 2026-06-21T05:00:00Z"):
        _sun_path(options, heights)


def test_a_picture_is_draped_from_corner_to_corner(terrain, tmp_path):
    from jaxhf.io.drape import load_drape

    texels = np.zeros((4, 6, 3), np.uint8)
    texels[:, :2, 0], texels[:2, :, 2] = 255, 255  # red in the west, blue in the north
    imageio.imwrite(tmp_path / "drape.png", texels)
    draped = load_drape(tmp_path / "drape.png", jaxhf.load_heights(terrain))
    np.testing.assert_array_equal(draped, texels[::-1] / 255)
    imageio.imwrite(tmp_path / "grey.png", texels[..., 0])
    grey = load_drape(tmp_path / "grey.png", jaxhf.load_heights(terrain))
    np.testing.assert_array_equal(grey, texels[::-1, :, :1] / 255 * np.ones(3))


def test_a_geotiff_is_draped_where_it_lies(tmp_path):
    rasterio = pytest.importorskip("rasterio")
    from jaxhf.io.drape import load_drape
    from jaxhf.io.errors import FileError
    from jaxhf.io.load_terrain import load_heights

    def write(path, bands, corner, step, system="EPSG:32632"):
        count, height, width = bands.shape
        place = rasterio.Affine(step, 0, corner[0], 0, -step, corner[1])
        profile = {
            "driver": "GTiff",
            "count": count,
            "height": height,
            "width": width,
            "dtype": bands.dtype,
            "transform": place,
        }
        with rasterio.open(path, "w", crs=system, **profile) as file:
            file.write(bands)
        return path

    heights = np.zeros((1, 11, 11), np.float32)
    terrain = load_heights(write(tmp_path / "dem.tif", heights, (5e5, 5e6), 10.0))  # vertices from 500005 to 500105
    colours = np.zeros((3, 40, 40), np.uint8)
    colours[0], colours[1, :, 20:], colours[2, :20] = 255, 255, 255  # green in the east, blue in the north
    texels = load_drape(write(tmp_path / "ortho.tif", colours, (499955.0, 5000045.0), 5.0), terrain)
    np.testing.assert_allclose(texels[..., 0], 1)
    ny, nx, _ = texels.shape
    # East of 500055 is green, which is the middle of the terrain, as north of 4999945 is blue.
    assert (texels[:, : nx // 2 - 1, 1] == 0).all()
    assert (texels[:, nx // 2 + 1 :, 1] == 1).all()
    assert (texels[: ny // 2 - 1, :, 2] == 0).all()
    assert (texels[ny // 2 + 1 :, :, 2] == 1).all()
    with pytest.raises(FileError, match=r"other\.tif: it must be in the terrain's reference system, .*gdalwarp"):
        load_drape(write(tmp_path / "other.tif", colours, (5e5, 5e6), 5.0, "EPSG:32633"), terrain)
    with pytest.raises(FileError, match="it must cover the terrain"):
        load_drape(write(tmp_path / "far.tif", colours, (7e5, 5e6), 5.0), terrain)
    with pytest.raises(FileError, match="bands of bytes, it has 1 of float32"):
        load_drape(tmp_path / "dem.tif", terrain)
    with rasterio.open(write(tmp_path / "palette.tif", colours[:1], (499955.0, 5000045.0), 5.0), "r+") as file:
        file.write_colormap(1, {0: (0, 0, 0), 255: (9, 9, 9)})
    with pytest.raises(FileError, match="its bands must be colours, it has a palette"):
        load_drape(tmp_path / "palette.tif", terrain)


def test_there_is_a_terrain_to_try(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["view", "--demo", *SMALL]) == 0
    assert np.ptp(imageio.imread("jacksboro_fault_dem.png")) > 100
    assert main(["view"]) == 2
    assert "there is neither" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--size", "48"], "--size must be two numbers of pixels, as 1280x800, it is '48'"),
        (["--sun-from", "90,10"], "--sun-from and --sun-to belong together"),
        (["--sun-from", "90,10", "--sun-to", "90,20"], "a moving sun makes a film"),
        (["-o", "a.gif", "--sun-from", "90,10", "--sun-to", MORNING], "must both be angles or both be times"),
        (["-o", "a.gif", *BY_TIME], "in.npz: it has no georeference"),
        (["-o", "a.gif", "--sun-from", "noon"], "error: --sun-from must be an azimuth and an altitude, as 90,10, or a time"),
        (["-o", "a.gif", *BY_TIME, "--latitude", "46.5"], "--latitude and --longitude belong together, one is missing"),
        (
            ["-o", "a.gif", *BY_TIME, "--latitude", "-80", "--longitude", "8"],
            "the sun must be up all the time, its altitude is",
        ),
        (["--latitude", "46.5"], "--latitude and --longitude stand with times"),
        (["--altitude", "0"], "altitude of the sun must be above 0"),
        (["--above", "95"], "altitude must be from -90 to 90 degrees"),
        (["--water", "nan"], "--water must be finite"),
        (["--exaggeration", "0"], "--exaggeration must be positive and finite"),
        (
            ["--exaggeration", "1e9"],
            "must leave a terrain at most 100 times its length high; times 1e+09 it",
        ),
        (["--demo"], "IN or --demo must say what to show, not both"),
        (["-o", "out.bmp"], "cannot write an image with the ending '.bmp'"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(terrain, tmp_path, capsys, monkeypatch, words, said):
    monkeypatch.chdir(tmp_path)
    try:
        code = main(["view", terrain, "-o", "out.png", *words])
    except SystemExit as refused:
        code = refused.code
    assert code == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1
    assert not list(tmp_path.iterdir())
