"""Scenes that are allowed but hardly meant, and numbers that no scene can mean."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import jaxhf
from jaxhf.cli.main import main
from jaxhf.cli.scene_warnings import scene_warnings
from jaxhf.core.errors import UserError

HILLS = np.array([[0.0, 1.0, 0.0], [2.0, 3.0, 2.0], [0.0, 1.0, 1.0]])  # 3 at (1, 1); spacing 1
SCENES = Path(__file__).parents[2] / "scenes"
SUN, NADIR = jaxhf.Directional.from_angles(), jaxhf.Directional.from_angles(90, -30)


def scene(eye=(1.0, -4.0, 3.0), target=(1.0, 1.0, 0.0), heights=HILLS, lights=(SUN,), fov=45.0, turn=None, width=8, albedo=0.7):
    field = jaxhf.Heightfield(heights, 1.0, 1.0)
    camera = jaxhf.Perspective.look_at(eye, target, fov=fov, width=width, height=8)
    return jaxhf.Scene([jaxhf.Object(field, jaxhf.Matte(albedo), turn)], camera, lights)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({}, None),
        ({"lights": ()}, "no lights"),
        ({"lights": (SUN, NADIR)}, r"lights\[1\]: it shines from below the horizon, .* is -0.5:"),
        ({"fov": 0.7}, "camera: fov is 0.7 degrees"),
        ({"albedo": (0.5, 1.25, 1.0)}, r"objects\[0\]: albedo is 1.25, more than 1: it sends out more light than it gets"),
        ({"heights": HILLS * np.nan}, r"objects\[0\]: none of its heights is finite"),
        ({"heights": np.where(HILLS == 3, -3.4e38, HILLS)}, r"heights reach -3.4e\+38; is that a value that means no height"),
        # A point of the triangle (1, 1), (2, 1), (2, 2), at (1.5, 1.25): 3 - 0.5 - 0.25.
        ({"eye": (1.5, 1.25, 2.26)}, None),
        ({"eye": (1.5, 1.25, 2.15)}, r"eye stands 0.1 below the surface of objects\[0\], whose height there is 2.25:"),
        ({"eye": (2.5, 1.25, -1.0)}, None),  # beside it
        ({"eye": (1.5, 1.25, 1.9), "heights": np.where(np.eye(9)[7].reshape(3, 3), np.nan, HILLS)}, None),  # in a hole's cell
        ({"eye": (1.5, 1.25, 1.9), "turn": np.eye(4)}, None),  # where an object is turned, below has no meaning
        ({"target": (1.0, -9.0, 3.0)}, "none of the terrain is in the picture, it spans x 0 to 2, y 0 to 2, z 0 to 3"),
        ({"target": (-9.0, -4.0, 3.0), "width": 80}, None),  # a wide picture sees it at its right end
    ],
)
def test_what_is_hardly_meant(given, said):
    lines = list(scene_warnings(scene(**given)))
    assert len(lines) == (said is not None)
    assert said is None or re.search(said, lines[0]), lines


def test_scenes_that_come_along_are_meant():
    """In landsea, the albedo of a cylinder that stands for the sky reaches 2.5."""
    for path in ("debug4x4", "landsea", "texture", "hillshade"):
        assert not list(scene_warnings(jaxhf.load_scene(SCENES / f"{path}.toml")))


def test_warnings_are_printed_and_stay_when_quiet(tmp_path, capsys):
    path = tmp_path / "dark.toml"
    camera = 'camera = { type = "perspective", eye = [1, -4, 3], target = [1, 1, 0] }'
    path.write_text(camera + '\nobjects = [{ shape = "heightfield", heights = [[0, 1], [2, 3]] }]')
    assert main(["info", str(path), "--quiet"]) == 0
    assert capsys.readouterr() == ("", "jaxhf: warning: the scene has no lights: the picture is black\n")


CAMERA = jaxhf.Perspective.look_at((0, -3, 2), (0, 0, 0))
FIELD = jaxhf.Heightfield(np.eye(4))
NAMES: dict[str, Any] = {"jaxhf": jaxhf, "np": np, "camera": CAMERA, "field": FIELD, "ray": ((0, 0, 1), (0, 0, -1))}
NAMES["scene"] = jaxhf.Scene([jaxhf.Object(FIELD)], CAMERA)
ANSWERS = {
    "jaxhf.fit([scene], [np.ones((8, 8, 3), np.uint8)])": "fit: targets[0] must hold linear radiance in floats, 1 being white; "
    "it holds uint8 (load_image decodes a picture)",
    'jaxhf.cast(field, *ray, "flat")': "cast: settings must be a jaxhf.Settings, it is a str",
    'jaxhf.render("x.toml")': "render: scene must be a jaxhf.Scene, it is a str; jaxhf.load_scene reads one from a file",
    'jaxhf.render(scene, aovs="depth")': "render: aovs must be a list of names, as in aovs=('depth',); it is 'depth'",
    "jaxhf.render(scene, mesh=2)": "render: mesh must be a jax.sharding.Mesh, it is an int; jax.make_mesh makes one",
    "jaxhf.render(scene, progress=True)": "render: progress must be a function of (done, in all), it is True",
    'jaxhf.save_heights(np.eye(3), "a.npy")': "save_heights: path must be the name of a file, it is a ndarray",
    "jaxhf.render(field)": "render: scene must be a jaxhf.Scene, it is a Heightfield; "
    "which has a camera and lights besides: jaxhf.Scene([jaxhf.Object(heightfield)], camera, lights)",
    'jaxhf.cast("t.tif", *ray)': "cast: surface must be a jaxhf.Heightfield or a Scene, it is a str; "
    "jaxhf.Heightfield(heights, dx, dy) makes one",
    "jaxhf.cast(field, (0, 0, 1), None)": "cast: d must have shape (..., 3), its shape is ()",
    "jaxhf.fit(scene, [1.0])": "fit: scenes must be a list, one for each picture, it is a Scene",
    'jaxhf.fit([scene], ["a.png"])': "fit: targets[0] must be an image, it is a name: jaxhf.load_image('a.png')",
    "jaxhf.Scene(jaxhf.Object(field), camera)": "Scene: objects and lights must be lists of them, here an Object stands alone",
    'jaxhf.Matte("red")': "'red' stands where numbers must",
    "jaxhf.Heightfield(np.eye(4), dx=(1, 2))": "Heightfield: dx must be one number, it is a tuple",
}


@pytest.mark.parametrize("call", ANSWERS)
def test_misuse_says_what_was_wanted(call, as_users_call_it):
    with pytest.raises(UserError) as error:
        eval(call, NAMES)
    assert str(error.value) == ANSWERS[call]


def test_numpys_whole_numbers_are_whole_numbers(as_users_call_it):
    ours: Any = jaxhf
    camera, sky = ours.Perspective(np.eye(4), np.float32(40), np.int64(640), np.uint16(480)), ours.Sky(1.0, np.int64(4))
    other = ours.Orthographic(np.eye(4), np.float32(2), np.int64(8), np.int8(8))
    made = ours.Scene([jaxhf.Object(FIELD)], camera, [sky], samples=np.int64(4))
    settings = ours.Settings(samples=np.int32(9), max_depth=np.int64(2), chunk=np.int64(256))
    whole = (
        camera.width,
        camera.height,
        other.width,
        other.height,
        made.samples,
        sky.occlusion,
        settings.samples,
        settings.chunk,
    )
    assert (whole, {*map(type, whole)}) == ((640, 480, 8, 8, 4, 4, 9, 256), {int})
