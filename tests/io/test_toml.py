"""Scenes in TOML: every feature once, and every mistake with its line, the rule and the value."""

import re
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

from jaxhf import (
    Cylinder,
    Directional,
    Heightfield,
    ImageTexture,
    Matte,
    Mirror,
    Orthographic,
    Perspective,
    Point,
    SceneError,
    Sky,
    Sun,
    Terrain,
    load_heights,
    load_scene,
    save_heights,
)
from jaxhf.io.georeference import WGS84_DEGREES, Georeference
from jaxhf.io.procedural import grid
from jaxhf.io.toml import tables
from jaxhf.io.toml.fit import load_case
from jaxhf.io.toml.lines import line_numbers
from jaxhf.io.toml.values import STEPS

SCENES = sorted((Path(__file__).parents[2] / "scenes").glob("*.toml"))

CAMERA = """
[camera]
type = "perspective"
eye = [0, -3, 2]
target = [0, 0, 0]
"""
FIELD = """
[[objects]]
shape = "heightfield"
heights = [[0, 1], [2, 3], [4, 5]]
"""
BY_DATE = "time = 2026-06-21T12:00:00Z\nlatitude = 46.5\nlongitude = 8"


def read(tmp_path, text, **arguments):
    (tmp_path / "scene.toml").write_text(text)
    return load_scene(tmp_path / "scene.toml", **arguments)


@pytest.mark.parametrize("path", SCENES, ids=[path.stem for path in SCENES])
def test_our_scenes_are_read(path):
    if "jacksboro" in path.read_text():
        pytest.importorskip("matplotlib")
    scene = load_scene(path)
    assert scene.heights.dtype == jnp.float32
    assert path.read_text().startswith("# ")  # says what it shows


def test_our_scenes_use_every_feature():
    text = "".join(path.read_text() for path in SCENES)
    for word in ("matte", "mirror", "cylinder", "heightfield", "point", "directional", "sky", "perspective", "orthographic"):
        assert f'"{word}"' in text


def test_the_smallest_scene(tmp_path):
    scene = read(tmp_path, CAMERA + FIELD)
    assert isinstance(scene.camera, Perspective)
    assert (scene.camera.fov, scene.camera.width, scene.camera.height) == (45, 512, 512)
    np.testing.assert_allclose(scene.camera.world_from_camera[:3, 3], (0, -3, 2))
    (field,) = scene.heightfields
    np.testing.assert_array_equal(field.heights, [[0, 1], [2, 3], [4, 5]])
    assert (field.dx, field.dy, field.x0, field.y0) == (1, 0.5, 0, 0)
    assert field.heights.dtype == jnp.float32
    assert (scene.samples, scene.lights, scene.objects[0].world_from_object) == (1, (), None)
    assert isinstance(scene.objects[0].material, Matte)
    np.testing.assert_array_equal(np.asarray(scene.objects[0].material.albedo), (0.7, 0.7, 0.7))
    assert read(tmp_path, CAMERA + FIELD, dtype=np.float64).heights.dtype == jnp.float64


@pytest.mark.parametrize("load", [load_scene, load_case])
def test_heights_are_read_in_a_precision_that_can_be_rendered(tmp_path, load):
    (tmp_path / "scene.toml").write_text(CAMERA + FIELD)
    for dtype in (int, np.float16, np.complex64):
        with pytest.raises(ValueError, match=f"^dtype must be float32 or float64, it is {np.dtype(dtype)}$"):
            load(tmp_path / "scene.toml", dtype)
    with jax.enable_x64(False), pytest.raises(ValueError, match=r"^dtype float64 needs JAX's x64 mode"):
        load(tmp_path / "scene.toml", np.float64)


def test_a_camera_from_its_calibration(tmp_path):
    camera = read(tmp_path, view(f"{PINHOLE}fy = 50")).camera
    pose = np.array([[1, 0, 0, 5], [0, -1, 0, 6], [0, 0, -1, 7], [0, 0, 0, 1]])
    expected = Perspective.from_intrinsics(40, 50, 20, 15, world_from_camera=pose, width=40, height=30)
    np.testing.assert_array_equal(camera.world_from_camera, expected.world_from_camera)
    assert isinstance(camera, Perspective)
    assert (camera.fov, camera.width, camera.height) == (expected.fov, 40, 30)


def test_every_part_of_a_scene(tmp_path):
    scene = read(
        tmp_path,
        """
        samples = 9
        lights = [{ type = "point", position = [1, 2, 3], intensity = 4 }, { type = "sky", radiance = [0.1, 0.2, 0.3] }]

        [camera]
        type = "orthographic"
        eye = [0, 0, 9]
        target = [0, 0, 0]
        up = [0, 1, 0]
        extent = 2.5
        width = 40
        height = 30

        [textures.uv]
        source = "grid"
        size = [8, 16]
        lines = 2

        [[objects]]
        shape = "heightfield"
        source = "bumps"
        size = [6, 5]
        range = [0, 2]
        dx = 30
        dy = 20
        x0 = 500000
        y0 = 5e6
        z_scale = 0.5
        albedo = "uv"

        [[objects]]
        shape = "cylinder"
        radius = 3
        z_min = 0
        z_max = 2
        material = "mirror"
        reflectance = [0.1, 0.2, 0.3]
        matrix = [[2, 0, 0, 1], [0, 2, 0, 0], [0, 0, 2, 0], [0, 0, 0, 1]]
        """,
    )
    assert scene.samples == 9
    point, sky = scene.lights
    assert isinstance(point, Point)
    assert isinstance(sky, Sky)
    np.testing.assert_array_equal((point.p, point.intensity, sky.radiance), ((1, 2, 3), (4, 4, 4), (0.1, 0.2, 0.3)))
    assert isinstance(scene.camera, Orthographic)
    assert (scene.camera.extent, scene.camera.width, scene.camera.height) == (2.5, 40, 30)
    np.testing.assert_allclose(scene.camera.world_from_camera[:3, 1], (0, 1, 0))
    land, wall = scene.objects
    assert isinstance(land.shape, Heightfield)
    assert (land.shape.dx, land.shape.dy, land.shape.x0, land.shape.y0) == (30, 20, 500000, 5e6)
    assert (land.shape.heights.shape, float(land.shape.heights.max())) == ((6, 5), 1)
    assert isinstance(land.material, Matte)
    assert isinstance(land.material.albedo, ImageTexture)
    np.testing.assert_array_equal(land.material.albedo.texels, grid([8, 16], lines=2))
    assert isinstance(wall.shape, Cylinder)
    assert (wall.shape.radius, wall.shape.z_min, wall.shape.z_max) == (3, 0, 2)
    assert isinstance(wall.material, Mirror)
    np.testing.assert_array_equal(wall.material.reflectance, (0.1, 0.2, 0.3))
    np.testing.assert_array_equal(wall.world_from_object, [[2, 0, 0, 1], [0, 2, 0, 0], [0, 0, 2, 0], [0, 0, 0, 1]])


@pytest.mark.parametrize(
    ("text", "towards"),
    [
        ("", (-0.5, 0.5, np.sqrt(0.5))),
        ("azimuth = 90\naltitude = 0", (1, 0, 0)),
        ("azimuth = 180", (0, -np.sqrt(0.5), np.sqrt(0.5))),
        (BY_DATE, Directional.at(datetime(2026, 6, 21, 12, tzinfo=UTC), 46.5, 8).towards),
        ("towards = [0, 0, 2]", (0, 0, 2)),
    ],
)
def test_directional_lights(tmp_path, text, towards):
    (light,) = read(tmp_path, f'{CAMERA}[[lights]]\ntype = "directional"\n{text}\n{FIELD}').lights
    assert isinstance(light, Directional)
    np.testing.assert_allclose(light.towards, towards, atol=1e-15)
    np.testing.assert_array_equal(light.irradiance, (np.pi,) * 3)


def test_a_sun_by_date_stands_over_the_terrain(tmp_path):
    """At the place of its file's middle, whatever the file's coordinates."""
    zone = pytest.importorskip("rasterio").crs.CRS.from_epsg(32632).to_wkt()
    utm = Georeference(zone, (10, 10), (423258.310033, 5150079.103964))
    text = (
        f'{CAMERA}[[lights]]\ntype = "sun"\ntime = 2026-06-21T12:00:00Z\n[[objects]]\nshape = "heightfield"\nfile = "dem.npz"'
    )
    for place in (Georeference(WGS84_DEGREES, (0.01, 0.01), (7.99, 46.49)), utm):
        save_heights(tmp_path / "dem.npz", Terrain(np.zeros((3, 3)), georeference=place))
        (light,) = read(tmp_path, text).lights
        assert isinstance(light, Sun)
        assert light.angular_diameter == 0.53
        noon = Directional.at(datetime(2026, 6, 21, 12, tzinfo=UTC), 46.5, 8)
        np.testing.assert_allclose(light.towards, noon.towards, atol=1e-6)
    save_heights(tmp_path / "dem.npz", Terrain(np.zeros((3, 3))))
    with pytest.raises(
        SceneError, match=r":6: lights\[0\]: Terrain: place must be given as latitude and longitude, it has no geo"
    ):
        read(tmp_path, text)


def test_a_sky_that_terrain_hides(tmp_path):
    (sky,) = read(tmp_path, f'{CAMERA}[[lights]]\ntype = "sky"\nradiance = 1\nocclusion = 8\n{FIELD}').lights
    assert isinstance(sky, Sky)
    assert sky.occlusion == 8


def test_the_old_name_of_irradiance(tmp_path):
    with pytest.warns(DeprecationWarning, match=r"scene\.toml:8: lights\[0\]\.radiance is now called irradiance$"):
        (light,) = read(tmp_path, f'{CAMERA}[[lights]]\ntype = "directional"\nradiance = [1, 2, 3]\n{FIELD}').lights
    assert isinstance(light, Directional)
    np.testing.assert_array_equal(light.irradiance, (1, 2, 3))


def test_the_last_transform_acts_first(tmp_path):
    """(1, 0, 0) is doubled, turned to +y, and moved: by hand (10, 2, 0)."""
    steps = "transform = [{ translate = [10, 0, 0] }, { rotate = [90, 0, 0, 1] }, { scale = 2 }]"
    world = np.asarray(read(tmp_path, CAMERA + FIELD + steps).objects[0].world_from_object)
    np.testing.assert_allclose(world @ [1, 0, 0, 1], (10, 2, 0, 1), atol=1e-15)
    world = read(tmp_path, CAMERA + FIELD + "transform = [{ scale = [1, 2, 3] }]").objects[0].world_from_object
    np.testing.assert_array_equal(world, np.diag([1, 2, 3, 1]))


def test_colours_may_be_larger_than_one_and_scales_negative(tmp_path):
    scene = read(tmp_path, CAMERA + FIELD + "albedo = 45\ntransform = [{ scale = [1, 1, -1] }]")
    assert isinstance(scene.objects[0].material, Matte)
    np.testing.assert_array_equal(np.asarray(scene.objects[0].material.albedo), (45, 45, 45))
    np.testing.assert_array_equal(scene.objects[0].world_from_object, np.diag([1, 1, -1, 1]))


def test_an_image_lies_with_its_top_in_the_north(tmp_path):
    """The image's top row, white, becomes v = 1, the last row of texels."""
    (tmp_path / "maps").mkdir()
    Image.fromarray(np.array([[255, 255], [100, 0]], np.uint8)).save(tmp_path / "maps" / "x.png")
    scene = read(tmp_path, f'{CAMERA}[textures."my map"]\nimage = "maps/x.png"\n{FIELD}albedo = "my map"')
    (material,) = (obj.material for obj in scene.objects)
    assert isinstance(material, Matte)
    assert isinstance(material.albedo, ImageTexture)
    grey = ((100 / 255 + 0.055) / 1.055) ** 2.4
    np.testing.assert_allclose(material.albedo.texels[:, :, 1], [[grey, 0], [1, 1]], rtol=1e-6)
    assert material.albedo.wrap == "repeat"
    (clamped,) = read(tmp_path, f'{CAMERA}[textures.m]\nimage = "maps/x.png"\nwrap = "clamp"\n{FIELD}albedo = "m"').objects
    assert isinstance(clamped.material, Matte)
    assert isinstance(clamped.material.albedo, ImageTexture)
    assert clamped.material.albedo.wrap == "clamp"


def test_terrain_files_keep_their_place_and_their_holes(tmp_path):
    heights = np.array([[1, 2, np.nan], [4, 5, 6]], np.float32)
    np.savez(tmp_path / "x.npz", heights=heights, dx=30.0, dy=20.0, x0=1e6)
    text = '[[objects]]\nshape = "heightfield"\nfile = "x.npz"\nz_scale = 2\ny0 = 7\nnodata = 5'
    (field,) = read(tmp_path, f"{CAMERA}{text}").heightfields
    heights[1, 1] = np.nan
    np.testing.assert_array_equal(field.heights, heights * 2)
    assert (field.dx, field.dy, field.x0, field.y0) == (30, 20, 1e6, 7)


def test_jacksboro_is_the_terrain_of_load_heights(tmp_path):
    cbook = pytest.importorskip("matplotlib.cbook")
    terrain = load_heights(cbook.get_sample_data("jacksboro_fault_dem.npz", asfileobj=False))
    text = '[[objects]]\nshape = "heightfield"\nsource = "jacksboro"\nz_scale = 2'
    (field,) = read(tmp_path, f"{CAMERA}{text}").heightfields
    np.testing.assert_array_equal(field.heights, terrain.heights * 2)
    assert (field.dx, field.dy) == (terrain.dx, terrain.dy)


def field(line):
    return f'{CAMERA}[[objects]]\nshape = "heightfield"\n{line}\n'


def surface(line):
    return f"{CAMERA}{FIELD}{line}\n"


def light(line):
    return f"{CAMERA}{FIELD}[[lights]]\n{line}\n"


def texture(line):
    return f"{CAMERA}{FIELD}[textures.t]\n{line}\n"


def view(line):
    return f"{FIELD}[camera]\n{line}\n"


LOOK = 'type = "perspective"\neye = [0, 0, 1]\ntarget = [0, 0, 0]\nup = [0, 1, 0]\n'
PINHOLE = """type = "pinhole"
fx = 40
cx = 20
cy = 15
width = 40
height = 30
world_from_camera = [
  [1, 0, 0, 5], [0, -1, 0, 6], [0, 0, -1, 7], [0, 0, 0, 1]]
"""

# The text, the line of the mistake (None: no line), and what the message says.
MISTAKES = [
    # The file itself.
    ("samples = = 2", 1, "this is not TOML"),
    ("samples = 2\nsamples = 3", 2, "this is not TOML"),
    ("\n\n[camera", 3, "this is not TOML"),
    ("x = " + "[" * 5000, None, "this is not TOML"),
    # Keys.
    (f"sampels = 4\n{CAMERA}{FIELD}", 1, "unknown key 'sampels'; did you mean 'samples'?"),
    (f"{CAMERA}{FIELD}[camra]", 10, "unknown key 'camra'; did you mean 'camera'?"),
    (f"{CAMERA}eye_x = 3\n{FIELD}", 6, "unknown key 'eye_x' in camera; did you mean 'eye'?"),
    (f"{CAMERA}extent = 3\n{FIELD}", 6, "unknown key 'extent' in camera"),
    (surface("albdeo = 1"), 10, "unknown key 'albdeo' in objects[0]; did you mean 'albedo'?"),
    (surface("reflectance = 1"), 10, "unknown key 'reflectance' in objects[0]"),
    (surface("radius = 1"), 10, "unknown key 'radius' in objects[0]"),
    (surface("exponent = 1"), 10, "unknown key 'exponent' in objects[0]"),
    (field("hieghts = [[0, 0], [0, 0]]"), 8, "unknown key 'hieghts' in objects[0]; did you mean 'heights'?"),
    (f'{CAMERA}[[objects]]\nshpe = "cylinder"', 7, "unknown key 'shpe' in objects[0]; did you mean 'shape'?"),
    (surface("") + FIELD + "\n\ncolor = 1", 17, "unknown key 'color' in objects[1]"),
    (light('type = "point"\nposition = [0, 0, 1]\nintensity = 1\nradiance = 2'), 14, "unknown key 'radiance' in lights[0]"),
    (texture('source = "grid"\nsize = [2, 2]\nseed = 1'), 13, "unknown key 'seed' in textures.t; did you mean 'size'?"),
    # What is missing.
    (FIELD, None, "a scene must have 'camera', it is missing"),
    (CAMERA, None, "a scene must have 'objects', it is missing"),
    (f"objects = []\n{CAMERA}", 1, "objects must hold at least one Object, it is empty"),
    (view('type = "perspective"\neye = [0, 0, 0]'), 5, "camera must have 'target', it is missing"),
    (view("eye = [0, 0, 0]"), 5, "camera must have 'type', one of perspective, orthographic, pinhole; it is missing"),
    (view('type = "orthographic"\neye = [0, 0, 1]\ntarget = [0, 0, 0]'), 5, "camera must have 'extent'"),
    (light('type = "point"\nposition = [0, 0, 1]'), 10, "lights[0] must have 'intensity', it is missing"),
    (light('type = "sky"'), 10, "lights[0] must have 'radiance', it is missing"),
    (f"{CAMERA}[[objects]]", 6, "objects[0] must have 'shape', one of"),
    (field(""), 6, "objects[0] must have exactly one of heights, file, source; it has none"),
    (
        field('heights = [[0, 0], [0, 0]]\nfile = "x.npy"'),
        9,
        "exactly one of heights, file, source; it has heights and file",
    ),
    (field('source = "fractal"'), 6, "objects[0] must have 'size', it is missing"),
    (texture(""), 10, "textures.t must have exactly one of image, source; it has none"),
    (texture('image = "x.png"\nsource = "grid"'), 12, "must have exactly one of image, source"),
    # Types.
    (f"camera = 3\n{FIELD}", 1, "camera must be a table, it is 3"),
    (f"lights = [1]\n{CAMERA}{FIELD}", 1, "lights must be a list of tables, it is [1]"),
    (f"textures = {{ t = 1 }}\n{CAMERA}{FIELD}", 1, "textures must be a table, it is {'t': 1}"),
    (f"samples = 4.0\n{CAMERA}{FIELD}", 1, "samples must be a whole number, it is 4.0"),
    (f"samples = true\n{CAMERA}{FIELD}", 1, "samples must be a whole number, it is True"),
    (view(f"{LOOK}fov = '45'"), 10, "camera.fov must be a finite number, it is '45'"),
    (view(f"{LOOK}fov = true"), 10, "camera.fov must be a finite number, it is True"),
    (view(f"{LOOK}fov = inf"), 10, "camera.fov must be a finite number, it is inf"),
    (view(f"{LOOK}fov = 1{'0' * 400}"), 10, "camera.fov must be"),
    (
        view('type = "perspective"\neye = [0, 0]\ntarget = [0, 0, 0]'),
        7,
        "camera.eye must be a list of 3 finite numbers",
    ),
    (view('type = "perspective"\neye = [0, 0, nan]\ntarget = [0, 0, 0]'), 7, "camera.eye must be a list of 3 finite numbers"),
    (light('type = "sky"\nradiance = [1, 2]'), 12, "lights[0].radiance must be a finite number or a list of 3, it is [1, 2]"),
    (surface("albedo = [1, 2]"), 10, "objects[0].albedo must be a finite number or a list of 3, or the name of a texture"),
    (surface("albedo = -1"), 10, "objects[0].albedo must be 0 or more, or the name of a texture, it is -1"),
    (surface('material = "mirror"\nreflectance = [1, -0.5, 1]'), 11, "reflectance must be 0 or more, it is [1, -0.5, 1]"),
    (light('type = "sky"\nradiance = -3'), 12, "lights[0].radiance must be 0 or more, it is -3"),
    (light('type = "directional"\nradiance = -3'), 12, "lights[0].radiance must be 0 or more, it is -3"),
    (light('type = "directional"\nirradiance = -3'), 12, "lights[0].irradiance must be 0 or more, it is -3"),
    (light('type = "directional"\nirradiance = 3\nradiance = 3'), 13, "lights[0].radiance must stand without irradiance"),
    (light('type = "point"\nposition = [0, 0, 1]\nintensity = -3'), 13, "lights[0].intensity must be 0 or more, it is -3"),
    (texture('source = "checker"\nsize = [2, 2]\nfirst = -1'), 13, "textures.t.first must be 0 or more, it is -1"),
    (f"{CAMERA}{FIELD}[[pictures]]\n", 10, "'pictures' makes this a fit file, for `jaxhf fit`"),
    (f"{CAMERA}{FIELD}[fit]\nnoise = 1\n", 10, "'fit' makes this a fit file, for `jaxhf fit`"),
    (field('source = "fractal"\nsize = [5, 5]\nseed = -1'), 10, "objects[0].seed must be non-negative, it is -1"),
    (field('file = "a\\u0000.npy"'), 8, "objects[0].file: 'a\\x00.npy' is no file's name"),
    (field('source = "fractal"\nsize = 5'), 9, "objects[0].size must be a list of 2 whole numbers, rows and columns, it is 5"),
    (field('source = "fractal"\nsize = [5.0, 5]'), 9, "objects[0].size must be a list of 2 whole numbers"),
    (field("file = 3"), 8, "objects[0].file must be a string, it is 3"),
    # Words.
    (
        view('type = "perspectiv"'),
        6,
        "it is 'perspectiv'; did you mean 'perspective'?",
    ),
    (light("type = 3"), 11, "lights[0].type must be one of directional, sun, point, sky; it is 3"),
    (f'{CAMERA}[[objects]]\nshape = "sphere"', 7, "objects[0].shape must be one of heightfield, cylinder; it is 'sphere'"),
    (surface('material = "glass"'), 10, "objects[0].material must be one of matte, mirror; it is 'glass'"),
    (surface('albedo = "gird"'), 10, "objects[0].albedo: there is no texture 'gird'; the scene has none"),
    (
        surface('albedo = "gird"\n[textures.grid]\nsource = "grid"\nsize = [2, 2]'),
        10,
        "'gird'; did you mean 'grid'?",
    ),
    (texture('source = "grids"'), 11, "textures.t.source must be one of grid, checker, sky; it is 'grids'"),
    (field('source = "jaksboro"'), 8, "did you mean 'jacksboro'?"),
    # Grids.
    (field("heights = []"), 8, "objects[0].heights must be a list of rows of numbers, the southernmost first, it is []"),
    (field("heights = [[], []]"), 8, "must be a list of rows of numbers"),
    (field("heights = [1, 2]"), 8, "must be a list of rows of numbers"),
    (field("heights = [[1, 2], [3]]"), 8, "must be a list of rows of one length, theirs are [1, 2]"),
    (field("heights = [[1, 2], [3, nan]]"), 8, "must be made of finite numbers, row 1 column 1 is nan"),
    (field("heights = [[1, inf], [3, 4]]"), 8, "row 0 column 1 is inf"),
    (field("heights = [[1, true], [3, 4]]"), 8, "row 0 column 1 is True"),
    (field("heights = [[1, 2, 3]]"), 8, "objects[0].heights must have shape (ny, nx) of at least 2x2, theirs is (1, 3)"),
    (field("heights = [[1], [2]]"), 8, "at least 2x2, theirs is (2, 1)"),
    (field("heights = [[1, 2], [3, 1e300]]"), 8, "objects[0].heights must fit into float32, the largest is 1e+300"),
    (surface("dx = 0"), 10, "objects[0].dx must be positive and finite, it is 0.0"),
    (surface("dx = 1\ndy = -2"), 11, "objects[0].dy must be positive and finite, it is -2.0"),
    (surface("z_scale = 0"), 10, "objects[0].z_scale must not be zero, it is 0"),
    (field('source = "fractal"\nsize = [1, 5]'), 9, "objects[0].size must be at least 2 x 2, it is [1, 5]"),
    (field('source = "fractal"\nsize = [100000, 100000]'), 6, "it declares 100000 x 100000"),
    (
        field('source = "fractal"\nsize = [5, 5]\nrange = [1, 0]'),
        10,
        "objects[0].range must be (lowest, highest)",
    ),
    (field('source = "waves"\nsize = [5, 5]\ncount = 0'), 10, "objects[0].count must be from 1 on, it is 0"),
    # Transforms.
    (surface("transform = 3"), 10, "objects[0].transform must be a list such as"),
    (surface("transform = [{ translate = [1, 2] }]"), 10, "step 0: translate must be a list of 3 finite numbers, it is [1, 2]"),
    (surface("transform = [{ scale = 1 }, { turn = 4 }]"), 10, "made of translate, rotate, scale, step 1 is 'turn'"),
    (surface("transform = [{ scale = 1, rotate = [1, 0, 0, 1] }]"), 10, "tables with one key each, step 0 is"),
    (surface("transform = [{ rotate = [90, 0, 0, 0] }]"), 10, "the axis must not be zero, it is [0.0, 0.0, 0.0]"),
    (surface("transform = [{ scale = [1, 0, 1] }]"), 10, "objects[0].transform must be invertible, it flattens space"),
    (surface("matrix = [[1, 0], [0, 1]]"), 10, "objects[0].matrix must be a list of 4 rows of 4 numbers"),
    (surface("matrix = [[1, 1, 0, 0], [1, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]"), 10, "objects[0].matrix must be invertible"),
    (surface("matrix = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 1, 1]]"), 10, "objects[0].matrix must be affine"),
    (
        surface("transform = [{ scale = 1 }]\nmatrix = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]"),
        11,
        "objects[0] must have transform or matrix, it has both",
    ),
    # What the constructors check.
    (f"samples = 0\n{CAMERA}{FIELD}", 1, "samples must be a whole number from 1 on, it is 0"),
    (view(f"{LOOK}fov = 180"), 10, "camera.fov must lie between 0 and 180 degrees, it is 180.0"),
    (view(f"{LOOK}width = 0"), 10, "camera.width must be a whole number of pixels from 1 on, it is 0"),
    (view(f"{LOOK}height = -5"), 10, "camera.height must be a whole number of pixels from 1 on, it is -5"),
    (view('type = "perspective"\neye = [1, 1, 1]\ntarget = [1, 1, 1]'), 8, "camera.target must differ from eye"),
    (view('type = "perspective"\neye = [0, 0, 1]\ntarget = [0, 0, 0]'), 5, "up must not point along the view"),
    (
        view('type = "orthographic"\neye = [0, 1, 1]\ntarget = [0, 0, 0]\nextent = 0'),
        9,
        "camera.extent must be positive and finite, it is 0.0",
    ),
    (view(f"{PINHOLE}fy = 0"), 14, "camera.fy must be positive, it is 0.0"),
    (view(f"{PINHOLE}fy = 5\nconvention = 'pbrt'"), 15, "camera.convention must be one of opencv, opengl; it is 'pbrt'"),
    (view(PINHOLE), 5, "camera must have 'fy', it is missing"),
    (light('type = "directional"\ntowards = [0, 0, 0]'), 12, "lights[0].towards must not be zero"),
    (light('type = "directional"\ntowards = [0, 0, 1]\nazimuth = 3'), 12, "towards must stand without azimuth and altitude"),
    (light(f'type = "directional"\n{BY_DATE}\nazimuth = 3'), 15, "azimuth must stand without time and latitude and long"),
    (light(f'type = "directional"\n{BY_DATE.replace("T12", "T23")}'), 12, "time must be one at which the sun is up, its al"),
    (light(f'type = "directional"\n{BY_DATE.replace("Z", "")}'), 12, "time must be a date and time with its offset from UTC"),
    (light('type = "directional"\nlatitude = 3'), 10, "time must be given with time, latitude and longitude, it is missing"),
    (
        light('type = "directional"\ntime = 2026-06-21T12:00:00Z'),
        10,
        "lights[0] must have latitude and longitude, there is no t",
    ),
    (light('type = "sun"\nangular_diameter = 0'), 12, "lights[0].angular_diameter must be above 0 and at most 10 degrees, it"),
    (light('type = "sky"\nradiance = 1\n[[lights]]\ntype = "sky"\nradiance = 1'), 10, "lights may hold one Sky"),
    (f'{CAMERA}[[objects]]\nshape = "cylinder"\nradius = -1', 8, "objects[0].radius must be positive, it is -1.0"),
    (f'{CAMERA}[[objects]]\nshape = "cylinder"\nz_min = 3', 8, "objects[0].z_min must lie below z_max, they are 3.0 and 1.0"),
    # Other files.
    (field('file = "none.npy"'), 8, "there is no file 'none.npy'"),
    (field('file = "../x.npy"'), 8, "'../x.npy' lies outside the scene's folder"),
    (field('file = "/etc/passwd"'), 8, "'/etc/passwd' lies outside the scene's folder"),
    (field('file = "text.npy"'), 8, "text.npy: "),
    (texture('image = "none.png"'), 11, "textures.t.image: there is no file 'none.png'"),
    (texture('image = "../x.png"'), 11, "'../x.png' lies outside the scene's folder"),
    (texture('image = "text.png"'), 11, "text.png: it is not a PNG"),
    (texture('image = "text.npy"'), 11, "text.npy: "),
    (texture('image = "text.npy"\nwrap = "black"'), 12, "textures.t.wrap must be one of repeat, clamp; it is 'black'"),
]


@pytest.mark.parametrize(("text", "line", "message"), MISTAKES, ids=[row[2][:60] for row in MISTAKES])
def test_a_mistake_is_named_with_its_line(tmp_path, text, line, message):
    for name in ("text.png", "text.npy"):
        (tmp_path / name).write_text("no picture")
    with pytest.raises(SceneError, match=re.escape(message)) as error:
        read(tmp_path, text)
    where = f"{tmp_path / 'scene.toml'}:{f'{line}:' if line else ''} "
    assert str(error.value).startswith(where)
    assert "\n" not in str(error.value)


def test_what_is_known_is_told_once(tmp_path):
    with pytest.raises(SceneError, match=r"camera\.type must be one of perspective, orthographic, pinhole; it is 'x'$"):
        read(tmp_path, view('type = "x"'))


def test_a_file_that_is_not_text(tmp_path):
    (tmp_path / "scene.toml").write_bytes(b"\xff\xfe")
    with pytest.raises(SceneError, match="this is not TOML"):
        load_scene(tmp_path / "scene.toml")


def test_which_files_are_scenes(tmp_path):
    with pytest.raises(FileNotFoundError, match="none: there is no such file"):
        load_scene(tmp_path / "none")
    (tmp_path / "x.tml").touch()
    with pytest.raises(ValueError, match=r"cannot read a scene from the ending '.tml'; did you mean '.toml'\?"):
        load_scene(tmp_path / "x.tml")


def test_lines_are_found_behind_whatever_stands_before_them():
    text = '''# [camera]
samples = 4 # [x
text = "[a] # \\" x"
long = """
[camera]
y = 1
"""
single = \'[[objects]]\'
[a."b.c".d] # [e] f
list = [ # one
  [1, 2], # ]
  { x = "]" },
]
after = 1
[[objects]]
x.y = 1
[[objects]]
[objects.inner]
z = 2
[[objects]]
'''
    expected = {
        ("samples",): 2,
        ("text",): 3,
        ("long",): 4,
        ("single",): 8,
        ("a", "b.c", "d"): 9,
        ("a", "b.c", "d", "list"): 10,
        ("a", "b.c", "d", "after"): 14,
        ("objects", 0): 15,
        ("objects", 0, "x", "y"): 16,
        ("objects", 1): 17,
        ("objects", 1, "inner"): 18,
        ("objects", 1, "inner", "z"): 19,
        ("objects", 2): 20,
    }
    found = line_numbers(text)
    assert {where: found.get(where) for where in expected} == expected
    assert ("camera",) not in found
    assert max(found.values()) == 20


PAGE = (Path(__file__).parents[2] / "docs" / "guides" / "scene-files.md").read_text(encoding="utf-8")


def words(table):
    """The keys of a table and of those inside it, and the words that choose between them."""
    for name, entry in table.items():
        yield name
        for inner in entry if isinstance(entry, tuple) else (entry,):
            yield from words(inner) if isinstance(inner, Mapping) else ()


TABLES = {name: set(words(t)) for name, t in vars(tables).items() if name.isupper() and isinstance(t, Mapping)}


@pytest.mark.parametrize("word", sorted({"type", "image", *STEPS}.union(*TABLES.values())))
def test_the_page_on_scene_files_explains_every_key(word):
    assert {"SCENE", "CAMERAS", "HEIGHTS", "OBJECT"} <= TABLES.keys()
    assert re.search(rf"^\|.*`{word}`.*\|", PAGE, re.MULTILINE)
