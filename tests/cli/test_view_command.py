"""`jaxhf view`: pictures and films of terrain files."""

import argparse
import dataclasses

import geotiffs
import imageio.v3 as imageio
import numpy as np
import pytest

import jaxhf
from jaxhf.cli import block as looks
from jaxhf.cli.arguments import sun
from jaxhf.cli.commands import view
from jaxhf.cli.commands.view import _sun_path
from jaxhf.core.errors import UserError
from jaxhf.io.terrain.georeference import WGS84_DEGREES, Georeference
from jaxhf.io.terrain.terrain import Terrain

SMALL = ["--size", "48x32", "--preset", "draft", "--devices", "1"]
MORNING, EVENING = "2026-06-21T05:00:00Z", "2026-06-21T18:00+01:00"


@pytest.fixture(scope="module")
def terrain(tmp_path_factory) -> str:
    path = tmp_path_factory.mktemp("view") / "in.npz"
    x, y = np.meshgrid(np.linspace(-1, 1, 17), np.linspace(-1, 1, 13))
    jaxhf.save_heights(path, Terrain((300 * np.exp(-4 * (x**2 + y**2))).astype(np.float32), 100.0, 100.0))
    return str(path)


@pytest.mark.deep  # of the pictures that the next test has one of
def test_films_turn_round_and_have_a_moving_sun(terrain, tmp_path, monkeypatch, command):
    """Each film prepares its terrain once."""
    framing, views = jaxhf.Perspective.framing, []
    prepare, prepared = view.prepared, []
    monkeypatch.setattr(view, "prepared", lambda scene, look: (prepared.append(scene), prepare(scene, look))[1])

    def recorded(field, azimuth, *rest, **options):
        views.append((azimuth, options["around"]))
        return framing(field, azimuth, *rest, **options)

    monkeypatch.setattr(jaxhf.Perspective, "framing", recorded)
    turning, sunny = tmp_path / "out.gif", tmp_path / "out.mp4"
    assert command("view", terrain, "-o", turning, "--frames", 3, *SMALL)[0] == 0
    frames = imageio.imread(turning).astype(int)
    assert frames.shape == (3, 32, 48, 3)
    assert views == [(205, True), (325, True), (445, True)]
    sun = ["--sun-from", "90,10", "--sun-to", "90,80"]
    assert command("view", terrain, "-o", sunny, "--frames", 3, *sun, *SMALL)[0] == 0
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
    options = argparse.Namespace(sun_from=sun(MORNING), sun_to=sun(EVENING), frames=13, latitude=None, longitude=None)
    path = _sun_path(options, heights)
    assert path is not None
    hours = np.datetime64("2026-06-21T05") + np.arange(13).astype("timedelta64[h]")
    np.testing.assert_allclose(path, np.stack(jaxhf.sun(hours, 46.5, 8.0), -1), atol=1e-6)
    # On a map whose y axis points 1.1 degrees clockwise of north, the sun stands as much less clockwise of it.
    wkt = pytest.importorskip("rasterio").crs.CRS.from_epsg(32632).to_wkt()
    turned = dataclasses.replace(heights, dx=900.0, dy=900.0, georeference=Georeference(wkt, offset=(620_000.0, 5_150_000.0)))
    options.latitude, options.longitude = 46.5, 8.0
    east = _sun_path(options, turned)
    assert east is not None
    assert 1.0 < turned.convergence < 1.4
    np.testing.assert_allclose(east, path - [turned.convergence, 0], atol=1e-6)
    options.latitude, options.longitude = -33.0, 8.0
    with pytest.raises(UserError, match=r"its altitude is -18.44 degrees at 2026-06-21T05:00:00Z"):
        _sun_path(options, heights)


def test_a_picture_from_somewhere_through_haze_of_what_is_laid_over_it(tmp_path, command):
    """Of level ground without walls, whose colour, distance and light are known at each pixel."""
    jaxhf.save_heights(tmp_path / "in.npz", Terrain(np.zeros((13, 17), np.float32), 100.0, 100.0))
    texels = np.zeros((4, 6, 3), np.uint8)
    texels[:, :2, 0], texels[:2, :, 2] = 255, 255  # red in the west, blue in the north
    imageio.imwrite(tmp_path / "drape.png", texels)
    words = ["--from", 100, "--above", 50, "--fov", 20, "--haze", 0.6, "--no-skirt", "--drape", tmp_path / "drape.png"]
    assert command("view", tmp_path / "in.npz", "-o", tmp_path / "out.npy", *words, *SMALL)[0] == 0
    picture = np.load(tmp_path / "out.npy")

    field = jaxhf.Heightfield(np.zeros((13, 17), np.float32), 100.0)
    camera = jaxhf.Perspective.framing(field, 100.0, 50.0, 20.0, width=48, height=32)
    pose = np.asarray(camera.world_from_camera, float)
    eye, ahead = pose[:3, 3], pose[:3, 2]
    turn, rise = np.radians(100), np.radians(50)
    towards = [np.sin(turn) * np.cos(rise), np.cos(turn) * np.cos(rise), np.sin(rise)]
    np.testing.assert_allclose(ahead, -np.array(towards), atol=1e-6)
    y, x = np.mgrid[:32, :48] + 0.5
    plane = 2 * np.tan(np.radians(10)) / 32 * np.stack([x - 24, 16 - y, 0 * x], -1) + (0, 0, 1)  # right, up and ahead
    d = plane @ np.stack([pose[:3, 0], pose[:3, 1], ahead])
    d /= np.linalg.norm(d, axis=-1, keepdims=True)
    t = -eye[2] / d[..., 2]
    u, v = (eye[0] + t * d[..., 0]) / 1600, (eye[1] + t * d[..., 1]) / 1200
    met = (u > 0) & (u < 1) & (v > 0) & (v < 1)
    albedo = np.stack([u < 1 / 3, 0 * u, v > 1 / 2], -1)
    ground = albedo * (np.array(looks._SUN) * np.sin(np.radians(45)) + looks._EVEN_SKY)
    share = 0.4 ** ((t - t[met].min()) / np.hypot(1600, 1200))[..., None]
    expected = ground * share + looks._HAZE * (1 - share)
    # A picture's colours change over half a texel; a pixel is some hundredth of the terrain.
    clear = met & (np.abs(u - 1 / 3) > 0.11) & (np.abs(v - 1 / 2) > 0.15) & (np.abs(u - 0.5) < 0.48) & (np.abs(v - 0.5) < 0.48)
    assert clear.sum() > 200
    assert len(np.unique(albedo[clear], axis=0)) == 4
    assert np.ptp(share[clear]) > 0.2
    np.testing.assert_allclose(picture[clear], expected[clear], atol=2e-4)
    rows = np.linspace(0, 1, 32)[:, None, None]
    behind = np.broadcast_to((1 - rows) * looks._ABOVE + rows * looks._BELOW, picture.shape)
    away = (np.abs(u - 0.5) > 0.52) | (np.abs(v - 0.5) > 0.52)
    np.testing.assert_allclose(picture[away], behind[away], atol=1e-6)


def test_a_geotiff_is_draped_where_it_lies(tmp_path):
    rasterio = pytest.importorskip("rasterio")
    from jaxhf.io.errors import FileError
    from jaxhf.io.terrain.drape import load_drape
    from jaxhf.io.terrain.load import load_heights

    def write(path, bands, corner, step, system="EPSG:32632"):
        return geotiffs.write(path, bands, (step, 0, corner[0], 0, -step, corner[1]), system)

    heights = np.zeros((1, 11, 11), np.float32)
    grey = np.array([[0, 255, 255], [0, 0, 255]], np.uint8)  # a PNG from corner to corner
    imageio.imwrite(tmp_path / "grey.png", grey)
    drape = load_drape(tmp_path / "grey.png", Terrain(heights[0]))
    np.testing.assert_array_equal(drape, grey[::-1, :, None] / 255 * np.ones(3))
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
    palette = write(tmp_path / "palette.tif", colours[:1], (499955.0, 5000045.0), 5.0)
    with rasterio.open(palette, "r+") as file:
        file.write_colormap(1, {0: (0, 0, 0), 255: (9, 9, 9)})
    for path, message in (
        (write(tmp_path / "other.tif", colours, (5e5, 5e6), 5.0, "EPSG:32633"), "must be in the terrain's reference system, "),
        (write(tmp_path / "far.tif", colours, (7e5, 5e6), 5.0), "it must cover the terrain"),
        (tmp_path / "dem.tif", "bands of bytes, it has 1 of float32"),
        (palette, "its bands must be colours, it has a palette"),
    ):
        with pytest.raises(FileError, match=message):
            load_drape(path, terrain)


def test_a_sea_is_blue_without_being_asked_for(tmp_path, command):
    heights = 10 * np.maximum(np.arange(-6, 7), 0)[:, None] * np.ones(17, np.float32)
    jaxhf.save_heights(tmp_path / "in.npz", Terrain(heights, 100.0, 100.0))
    words = ["view", tmp_path / "in.npz", *SMALL, "--from", 180, "--above", 90, "-o"]
    for out, more, blue in (("a.npy", [], True), ("b.npy", ["--water", 0], True), ("c.npy", ["--ramp", "Reds"], False)):
        code, _, err = command(*words, tmp_path / out, *more)
        assert (code, "in.npz holds wide areas at 0, which are drawn as a sea" in err) == (0, not more)
        red, _, high = np.load(tmp_path / out)[24, 24]  # in the south
        assert (high > 1.5 * red) == blue
    np.testing.assert_array_equal(np.load(tmp_path / "a.npy"), np.load(tmp_path / "b.npy"))


@pytest.mark.filterwarnings("always:view. the heights go from")
def test_there_is_a_terrain_to_try(terrain, tmp_path, monkeypatch, command):
    """Here another, as that of matplotlib takes seconds; docs/index.md shows it."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("jaxhf.cli.commands.view.jacksboro_file", lambda: terrain)
    code, out, err = command("view", "--demo", "--water", "-9", *SMALL)
    assert (code, "48 x 32 pixels, heights x 1, " in out) == (0, True)
    assert err.endswith(" to 300, --water is -9\n")
    assert np.ptp(imageio.imread("in.png")) > 100
