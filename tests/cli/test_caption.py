"""`jaxhf view --annotate`: what stands on a picture and below it, and where."""

import imageio.v3 as imageio
import numpy as np
import pytest

import jaxhf
from jaxhf.cli.caption import annotated
from jaxhf.cli.commands import view
from jaxhf.io.terrain.georeference import WGS84_DEGREES, Georeference
from jaxhf.io.terrain.terrain import Terrain

pytest.importorskip("matplotlib")

WIDTH, HEIGHT, FOV = 240, 160, 30.0


def drawn(azimuth: float, altitude: float, terrain: Terrain):
    """The pose of a camera of level ground at 0; the ends of the scale bar, its text, and the unit vector to north, pixels."""
    camera = jaxhf.Perspective.framing(terrain.heightfield(), azimuth, altitude, FOV, width=WIDTH, height=HEIGHT)
    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    axis = annotated(image, terrain, camera, 0.0, None, "a caption").axes[0]
    (bar,) = axis.lines
    north, said = axis.texts if axis.texts[0].get_text() == "N" else axis.texts[::-1]
    arrow = -np.array(north.get_position())
    return np.asarray(camera.world_from_camera, float), bar.get_xydata(), said, arrow / np.hypot(*arrow)


@pytest.mark.parametrize(
    ("azimuth", "altitude", "middle", "length", "north"),
    [(180.0, 40.0, (800, 0), 500, (0, 1)), (90.0, 20.0, (1600, 600), 200, (1, 0)), (0.0, 5.0, (800, 1200), 500, (0, -1))],
)
def test_the_bar_is_as_long_as_its_edge_shows_it(azimuth, altitude, middle, length, north):
    """By a pinhole's own rule: of an edge across the view, pixels are lengths times the focal length over the depth."""
    terrain = Terrain(np.zeros((13, 17), np.float32), 100.0, 100.0)
    pose, bar, said, arrow = drawn(azimuth, altitude, terrain)
    depth = pose[:3, 2] @ (np.array([*middle, 0.0]) - pose[:3, 3])
    focal = HEIGHT / 2 / np.tan(np.radians(FOV / 2))
    assert said.get_text() == str(length)
    np.testing.assert_allclose(np.ptp(bar[:, 0]), length * focal / depth, rtol=1e-4)
    down = HEIGHT / 2 - focal * pose[:3, 1] @ (np.array([*middle, 0.0]) - pose[:3, 3]) / depth
    np.testing.assert_allclose(bar[:, 1], down + 0.6 * 12, atol=1e-3)
    np.testing.assert_allclose(arrow, north, atol=1e-3)


def test_a_slender_terrain_has_its_bar_along_its_length_and_degrees_are_metres():
    place = Georeference(WGS84_DEGREES, (1e-5, 1e-5))
    _, bar, said, _ = drawn(180.0, 90.0, Terrain(np.zeros((400, 3), np.float32), 10.0, 10.0, georeference=place))
    assert said.get_text() == "1 km"
    assert abs(said.get_rotation() % 180 - 90) < 1
    assert np.ptp(bar[:, 1]) > 10 * np.ptp(bar[:, 0])
    _, bar, said, _ = drawn(
        180.0, 40.0, Terrain(np.zeros((40, 13), np.float32), 100.0, 100.0)
    )  # of which two sides may be hidden
    assert said.get_text() == "200"
    assert np.ptp(bar[:, 0]) > 10 * np.ptp(bar[:, 1])


def test_the_command(tmp_path, monkeypatch, command):
    """Of noise for a picture, as real ones are those of test_view_command.py."""
    noise = np.random.default_rng(0).uniform(size=(HEIGHT, WIDTH, 3)).astype(np.float32)
    monkeypatch.setattr(view, "prepared", lambda scene, _: scene)
    monkeypatch.setattr(view, "photograph", lambda *_: noise)
    jaxhf.save_heights(tmp_path / "in.npz", Terrain(np.eye(13, 17, dtype=np.float32), 100.0, 100.0))
    words = ["view", tmp_path / "in.npz", "--size", "240x160", "--preset", "draft", "--devices", 1, "--exaggeration", 2]
    annotate = ["--annotate", "--title", "Hills $ dales $x_$", "--azimuth", 275, "--altitude", 30, "--from", 205]
    assert command(*words, "-o", tmp_path / "plain.png", *annotate[3:])[0] == 0
    assert command(*words, "-o", tmp_path / "a.png", *annotate)[0] == 0
    plain, picture = imageio.imread(tmp_path / "plain.png"), imageio.imread(tmp_path / "a.png")
    assert picture.shape[0] > 160
    np.testing.assert_array_equal(picture[:100, :120, :3], plain[:100, :120])  # left of the arrow, above the bar
    assert command(*words, "-o", tmp_path / "a.svg", *annotate)[0] == 0
    text = (tmp_path / "a.svg").read_text()
    for said in ("Hills $ dales $x_$", "sun from 275°, 30° high;", "vertical exaggeration 2;", "edge beside", ">N<"):
        assert said in text
