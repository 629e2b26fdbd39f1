"""Scenes in TOML: every feature once, and every mistake with its line, the rule and the value."""

import re
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from alike import assert_same
from PIL import Image

import jaxhf
from jaxhf import Directional, Heightfield, ImageTexture, Matte, Mirror, Orthographic, Perspective, SceneError, load_scene
from jaxhf.io.scenes.toml import tables
from jaxhf.io.scenes.toml.checks import line_of
from jaxhf.io.scenes.toml.fit import load_case
from jaxhf.io.scenes.toml.values import STEPS
from jaxhf.io.terrain.georeference import WGS84_DEGREES, Georeference
from jaxhf.scene.procedural import bumps, grid

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
    (tmp_path / "scene.toml").write_text(text, "utf-8", "surrogateescape")
    return load_scene(tmp_path / "scene.toml", **arguments)


@pytest.mark.parametrize("path", SCENES, ids=[path.stem for path in SCENES])
def test_our_scenes_are_read(path):
    if "jacksboro" in path.read_text():
        pytest.importorskip("matplotlib")
    scene = load_scene(path)
    assert scene.heights.dtype == jnp.float32
    assert path.read_text().startswith("# ")  # says what it shows


def test_the_smallest_scene(tmp_path):
    scene = read(tmp_path, CAMERA + FIELD)
    field = Heightfield(np.array([[0, 1], [2, 3], [4, 5]], np.float32), dx=1.0, dy=0.5)
    camera = Perspective.look_at((0, -3, 2), (0, 0, 0), fov=45, width=512, height=512)
    assert_same(scene, jaxhf.Scene([jaxhf.Object(field, Matte(0.7))], camera, [], samples=1))


@pytest.mark.parametrize("load", [load_scene, load_case])
def test_heights_are_read_in_a_precision_that_can_be_rendered(tmp_path, load):
    (tmp_path / "scene.toml").write_text(CAMERA + FIELD)
    for dtype in (int, np.float16, np.complex64):
        with pytest.raises(ValueError, match=f"^dtype must be float32 or float64, it is {np.dtype(dtype)}$"):
            load(tmp_path / "scene.toml", dtype)
    with pytest.raises(ValueError, match=r"^dtype float64 needs JAX's x64 mode"):
        load(tmp_path / "scene.toml", np.float64)
    with jax.enable_x64(True):
        assert load_scene(tmp_path / "scene.toml", np.float64).heights.dtype == jnp.float64


def test_every_part_of_a_scene(tmp_path):
    scene = read(
        tmp_path,
        """
        samples = 9
        lights = [
            { type = "point", position = [1, 2, 3], intensity = 4 },
            { type = "sky", radiance = [0.1, 0.2, 0.3], occlusion = 8 },
        ]
        textures.uv = { source = "grid", size = [8, 16], lines = 2 }

        [camera]
        type = "orthographic"
        eye = [0, 0, 9]
        target = [0, 0, 0]
        up = [0, 1, 0]
        extent = 2.5
        width = 40
        height = 30

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
        reflectance = [0.1, 0.2, 45]
        matrix = [[2, 0, 0, 1], [0, 2, 0, 0], [0, 0, 2, 0], [0, 0, 0, 1]]
        """,
    )
    field = Heightfield(0.5 * bumps([6, 5], range=(0.0, 2.0)).astype(np.float32), 30.0, 20.0, 500000.0, 5e6)
    assert field.heights.max() == 1
    land = jaxhf.Object(field, Matte(ImageTexture(grid([8, 16], lines=2))))
    pose = np.array([[2, 0, 0, 1], [0, 2, 0, 0], [0, 0, 2, 0], [0, 0, 0, 1]])
    wall = jaxhf.Object(jaxhf.Cylinder(3, 0, 2), Mirror((0.1, 0.2, 45)), pose)  # more than one is allowed
    camera = Orthographic.look_at((0, 0, 9), (0, 0, 0), (0, 1, 0), 2.5, width=40, height=30)
    lights = [jaxhf.Point((1, 2, 3), 4), jaxhf.Sky((0.1, 0.2, 0.3), occlusion=8)]
    assert_same(scene, jaxhf.Scene([land, wall], camera, lights, samples=9))


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
    assert_same(light, Directional(towards, np.pi), atol=1e-15)


def test_cameras_by_calibration(tmp_path):
    camera = read(tmp_path, view(f"{PINHOLE}fy = 50")).camera
    pose = np.array([[1, 0, 0, 5], [0, -1, 0, 6], [0, 0, -1, 7], [0, 0, 0, 1]])
    assert_same(camera, Perspective.from_intrinsics(40, 50, 20, 15, world_from_camera=pose, width=40, height=30))


def test_a_sun_by_date_stands_over_the_terrain(tmp_path):
    """At the place of its file's middle, whatever the file's coordinates."""
    zone = pytest.importorskip("rasterio").crs.CRS.from_epsg(32632).to_wkt()
    utm = Georeference(zone, (10, 10), (423258.310033, 5150079.103964))
    text = (
        f'{CAMERA}[[lights]]\ntype = "sun"\ntime = 2026-06-21T12:00:00Z\n[[objects]]\nshape = "heightfield"\nfile = "dem.npz"'
    )
    for place in (Georeference(WGS84_DEGREES, (0.01, 0.01), (7.99, 46.49)), utm):
        jaxhf.save_heights(tmp_path / "dem.npz", jaxhf.Terrain(np.zeros((3, 3)), georeference=place))
        (light,) = read(tmp_path, text).lights
        assert isinstance(light, jaxhf.Sun)
        assert light.angular_diameter == 0.53
        noon = Directional.at(datetime(2026, 6, 21, 12, tzinfo=UTC), 46.5, 8)
        np.testing.assert_allclose(light.towards, noon.towards, atol=1e-6)
    jaxhf.save_heights(tmp_path / "dem.npz", jaxhf.Terrain(np.zeros((3, 3))))
    with pytest.raises(
        SceneError, match=r":6: lights\[0\]: Terrain: place must be given as latitude and longitude, it has no geo"
    ):
        read(tmp_path, text)


def test_the_last_transform_acts_first(tmp_path):
    """(1, 0, 0) is doubled, turned to +y, and moved: by hand (10, 2, 0)."""
    steps = "transform = [{ translate = [10, 0, 0] }, { rotate = [90, 0, 0, 1] }, { scale = 2 }]"
    world = np.asarray(read(tmp_path, CAMERA + FIELD + steps).objects[0].world_from_object)
    np.testing.assert_allclose(world @ [1, 0, 0, 1], (10, 2, 0, 1), atol=1e-15)
    world = read(tmp_path, CAMERA + FIELD + "transform = [{ scale = [1, 2, -3] }]").objects[0].world_from_object
    np.testing.assert_array_equal(world, np.diag([1, 2, -3, 1]))


def test_an_image_lies_with_its_top_in_the_north(tmp_path):
    """The image's top row, white, becomes v = 1, the last row of texels."""
    (tmp_path / "maps").mkdir()
    Image.fromarray(np.array([[255, 255], [100, 0]], np.uint8)).save(tmp_path / "maps" / "x.png")
    scene = read(tmp_path, f'{CAMERA}[textures."my map"]\nimage = "maps/x.png"\n{FIELD}albedo = "my map"')
    grey = ((100 / 255 + 0.055) / 1.055) ** 2.4
    texels = np.repeat(np.array([[grey, 0], [1, 1]], np.float32)[..., None], 3, axis=2)
    assert_same(scene.objects[0].material, Matte(ImageTexture(texels, wrap="repeat")), rtol=1e-6)
    (clamped,) = read(tmp_path, f'{CAMERA}[textures.m]\nimage = "maps/x.png"\nwrap = "clamp"\n{FIELD}albedo = "m"').objects
    assert clamped.material.albedo.wrap == "clamp"  # pyright: ignore[reportAttributeAccessIssue]


def test_terrain_files_keep_their_place_and_their_holes(tmp_path):
    heights = np.array([[1, 2, np.nan], [4, 5, 6]], np.float32)
    np.savez(tmp_path / "x.npz", heights=heights, dx=30.0, dy=20.0, x0=1e6)
    (land,) = read(tmp_path, field('file = "x.npz"\nz_scale = 2\ny0 = 7\nnodata = 5')).heightfields
    heights[1, 1] = np.nan
    np.testing.assert_array_equal(land.heights, heights * 2)
    assert (land.dx, land.dy, land.x0, land.y0) == (30, 20, 1e6, 7)
    pytest.importorskip("matplotlib")
    (land,) = read(tmp_path, field('source = "jacksboro"\nz_scale = 2')).heightfields
    np.testing.assert_array_equal(land.heights, jaxhf.jacksboro().heights * 2)
    assert (land.dx, land.dy) == (jaxhf.jacksboro().dx, jaxhf.jacksboro().dy)


NESTED = """
[[objects]]
shape = "heightfield"
file = "fine.npz"
transform = [{ translate = [0, 0, 5] }]

[[objects]]
shape = "heightfield"
file = "coarse.npz"
albedo = 0.2
around = true
"""


def write_nested(folder):
    random = np.random.default_rng(0)
    fine = jaxhf.Terrain(random.random((35, 40), np.float32), 1.0, 1.0, 70.0, 60.0)
    coarse = jaxhf.Terrain(random.random((20, 20), np.float32), 8.0, 8.0)
    jaxhf.save_heights(folder / "fine.npz", fine)
    jaxhf.save_heights(folder / "coarse.npz", coarse)
    return [terrain.heightfield() for terrain in (fine, coarse)]


def test_a_coarser_terrain_goes_on_around_a_heightfield(tmp_path):
    fields = write_nested(tmp_path)
    scene = read(tmp_path, CAMERA + NESTED)
    moved = np.eye(4) + 5 * np.eye(4, k=1) * [[0], [0], [1], [0]]
    paints = Matte(0.7), Matte(0.2)
    pairs = zip(jaxhf.nested(*fields), paints, strict=True)
    assert_same(scene.objects, tuple(jaxhf.Object(field, paint, moved) for field, paint in pairs))


# Scenes with one more line in one of their tables.
field = f'{CAMERA}[[objects]]\nshape = "heightfield"\n{{}}\n'.format
surface = f"{CAMERA}{FIELD}{{}}\n".format
light = f"{CAMERA}{FIELD}[[lights]]\n{{}}\n".format
texture = f"{CAMERA}{FIELD}[textures.t]\n{{}}\n".format
view = f"{FIELD}[camera]\n{{}}\n".format

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

EYE = 'type = "perspective"\neye = '
SLANTED = "[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 1, 1]]"
CYLINDER = f'{CAMERA}[[objects]]\nshape = "cylinder"\n'
AROUND = '[[objects]]\nshape = "heightfield"\nheights = [[0, 0], [0, 0]]\naround = true\n'
SKY = '[[lights]]\ntype = "sky"\nradiance = 1\n'
# The text, the line of the mistake (None: no line), and what the message says: one of each rule, where it is kept.
MISTAKES = [
    # The file itself.
    ("samples = 2\nsamples = 3", 2, "this is not TOML"),
    ("x = " + "[" * 5000, None, "this is not TOML"),
    ("\udcff\udcfe", None, "this is not TOML"),  # bytes that are no text
    # Keys.
    (f"sampels = 4\n{CAMERA}{FIELD}", 1, "unknown key 'sampels'; did you mean 'samples'?"),
    (f"samples = 1\ntexture.uv = {{ size = [2, 2] }}\n{CAMERA}{FIELD}", 2, "unknown key 'texture'; did you mean 'textures'?"),
    (f"{CAMERA}extent = 3\n{FIELD}", 6, "unknown key 'extent' in camera"),
    (surface("albdeo = 1"), 10, "unknown key 'albdeo' in objects[0]; did you mean 'albedo'?"),
    (field("hieghts = [[0, 0], [0, 0]]"), 8, "unknown key 'hieghts' in objects[0]; did you mean 'heights'?"),
    (light('type = "point"\nposition = [0, 0, 1]\nintensity = 1\nradiance = 2'), 14, "unknown key 'radiance' in lights[0]"),
    (f"{CAMERA}{FIELD}[[pictures]]\n", 10, "'pictures' makes this a fit file, for `jaxhf fit`"),
    # What is missing, or stands beside what excludes it.
    (FIELD, None, "a scene must have 'camera', it is missing"),
    (view("eye = [0, 0, 0]"), 5, "camera must have 'type', one of perspective, orthographic, pinhole; it is missing"),
    (f"{CAMERA}[[objects]]", 6, "objects[0] must have 'shape', one of"),
    (texture('image = "x.png"\nsource = "grid"'), 12, "must have exactly one of image, source"),
    (light('type = "directional"\ntowards = [0, 0, 1]\nazimuth = 3'), 12, "towards must stand without azimuth and altitude"),
    (f"{CAMERA}{FIELD}{SKY}{SKY}", 10, "lights may hold one Sky"),
    # Types.
    # Numbers that no scene can mean.
    (view(f"{EYE}[0.5, 1e308, 1e308]"), 7, "camera.eye must be within -1e+18 and 1e+18, it is [0.5, 1e+308, 1e+308]"),
    (light('type = "sky"\nradiance = 1e39'), 12, "lights[0].radiance must be within -1e+30 and 1e+30, it is 1e+39"),
    (light('type = "directional"\naltitude = 100'), 12, "lights[0].altitude must be from -90 to 90 degrees, it is 100"),
    (surface("dx = 1e-300"), 10, "objects[0].dx must be from 1e-18 to 1e+18, it is 1e-300"),
    (surface("transform = [{ scale = 1e20 }, { scale = 1e20 }]"), 10, "transform must be within -1e+30 and 1e+30"),
    (view(f"{LOOK}fov = inf"), 10, "camera.fov must be a finite number, it is inf"),
    (light('type = "sky"\nradiance = [1, 2]'), 12, "lights[0].radiance must be a finite number or a list of 3, it is [1, 2]"),
    (surface("albedo = [1, 2]"), 10, "objects[0].albedo must be a finite number or a list of 3, or the name of a texture"),
    (field('source = "fractal"\nsize = [5.0, 5]'), 9, "objects[0].size must be a list of 2 whole numbers"),
    (field("file = 3"), 8, "objects[0].file must be a string, it is 3"),
    (field('file = "a\\u0000.npy"'), 8, "objects[0].file: 'a\\x00.npy' is no file's name"),
    # Words.
    (view('type = "perspectiv"'), 6, "it is 'perspectiv'; did you mean 'perspective'?"),
    (surface('albedo = "gird"\n[textures.grid]\nsource = "grid"\nsize = [2, 2]'), 10, "'gird'; did you mean 'grid'?"),
    (field('source = "jaksboro"'), 8, "did you mean 'jacksboro'?"),
    # Grids.
    (field("heights = [[], []]"), 8, "objects[0].heights must be a list of rows of numbers, the southernmost first, it is"),
    (field("heights = [[1, 2], [3, nan]]"), 8, "must be made of finite numbers, row 1 column 1 is nan"),
    (field("heights = [[1, 2], [3, 1e300]]"), 8, "objects[0].heights must fit into float32, the largest is 1e+300"),
    # Transforms.
    (surface("transform = [{ translate = [1, 2] }]"), 10, "step 0: translate must be a list of 3 finite numbers, it is [1, 2]"),
    (surface("transform = [{ scale = 1 }, { turn = 4 }]"), 10, "made of translate, rotate, scale, step 1 is 'turn'"),
    (surface("transform = [{ scale = 1, rotate = [1, 0, 0, 1] }]"), 10, "tables with one key each, step 0 is"),
    (surface(f"matrix = {SLANTED}"), 10, "objects[0].matrix must be affine"),
    (surface(f"transform = [{{ scale = 1 }}]\nmatrix = {SLANTED}"), 11, "must have transform or matrix, it has both"),
    # What the constructors check.
    (view(f"{LOOK}height = -5"), 10, "camera.height must be a whole number of pixels from 1 on, it is -5"),
    (view(f"{EYE}[1, 1, 1]\ntarget = [1, 1, 1]"), 8, "camera.target must differ from eye"),
    (surface("albedo = -1"), 10, "objects[0].albedo must be 0 or more, or the name of a texture, it is -1"),
    (light('type = "point"\nposition = [0, 0, 1]\nintensity = -3'), 13, "lights[0].intensity must be 0 or more, it is -3"),
    (light(f'type = "directional"\n{BY_DATE.replace("T12", "T23")}'), 12, "time must be one at which the sun is up, its al"),
    (light(f'type = "directional"\n{BY_DATE.replace("Z", "")}'), 12, "time must be a date and time with its offset from UTC"),
    # Surroundings.
    (surface("around = true"), 10, "objects[0].around must stand below another heightfield, it is the first"),
    (f"{CYLINDER}{AROUND}", 11, "objects[1].around must stand below a heightfield, there it is below a cylinder"),
    (f"{CAMERA}{FIELD}{AROUND}", 13, "objects[1].around: nested: fields must hold 3 cells of the next coarser one each"),
    (surface(f"{AROUND}transform = [{{ scale = 2 }}]"), 14, "transform must stand without around: it has that of objects[0]"),
    # Other files.
    (field('file = "/etc/passwd"'), 8, "'/etc/passwd' lies outside the scene's folder"),
    (texture('image = "../x.png"'), 11, "textures.t.image: '../x.png' lies outside the scene's folder"),
    (texture('image = "text.png"'), 11, "text.png: it is not a PNG"),
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


def test_lines_are_found_behind_whatever_stands_before_them():
    text = '''# [camera]
samples = 4 # [x
text = "[a] # \\" x"
long = """
[camera]
"""
[a."b.c".d] # [e] f
list = [ # one
  { x = "]" }, # ]
]
after = '[[objects]]'
[[objects]]
x.y = 1
[[objects]]
[objects.inner]
z = 2
'''
    block = ("a", "b.c", "d")
    top = {("samples",): 2, ("text",): 3, ("long",): 4, block: 7, (*block, "list"): 8, (*block, "after"): 11}
    first, second = ("objects", 0), ("objects", 1)
    expected = top | {first: 12, (*first, "x", "y"): 13, second: 14, (*second, "inner"): 15, (*second, "inner", "z"): 16}
    assert {where: line_of(text, where) for where in expected} == expected
    assert line_of(text, ("camera",)) is None
    assert line_of(text, (*block, "none")) == 7
    assert line_of(text, (*second, "inner", "y", 3)) == 15


PAGE = (Path(__file__).parents[2] / "docs" / "guides" / "scene-files.md").read_text(encoding="utf-8")


def words(table):
    """The keys of a table and of those inside it, and the words that choose between them."""
    for name, entry in table.items():
        yield name
        for inner in entry if isinstance(entry, tuple) else (entry,):
            yield from words(inner) if isinstance(inner, Mapping) else ()


TABLES = {name: set(words(t)) for name, t in vars(tables).items() if name.isupper() and isinstance(t, Mapping)}


def test_the_page_on_scene_files_explains_every_key():
    assert {"SCENE", "CAMERAS", "HEIGHTS", "OBJECT"} <= TABLES.keys()
    known = {"type", "image", *STEPS}.union(*TABLES.values())
    assert not [word for word in known if not re.search(rf"^\|.*`{word}`.*\|", PAGE, re.MULTILINE)]
