"""Scenes in the format of pbrt-v2: what they mean, and where their mistakes are."""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from alike import assert_same

import jaxhf
from jaxhf import Cylinder, Directional, Matte, Mirror, Object, Point, SceneError
from jaxhf.io.scenes.pbrt import reader
from jaxhf.io.scenes.pbrt.reader import load_pbrt

CAMERA = 'Camera "perspective" "float fov" [45]'
FIELD = 'Shape "heightfield" "integer nu" [2] "integer nv" [2] "float Pz" [0 1 2 3]'

TEXTURE = 'Texture "t" "color" "imagemap" "string filename"'


def write(folder: Path, text: str, name: str = "scene.pbrt") -> Path:
    path = folder / name
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(text.encode())
    return path


def load(folder: Path, text: str, **kwargs) -> Any:  # a Scene; which shapes and materials it holds is for each test to say
    return load_pbrt(write(folder, text), **kwargs)


def load_world(folder: Path, world: str, **kwargs) -> Any:
    """A scene in which `world` begins on line 2."""
    return load(folder, f"{CAMERA} WorldBegin\n{world}\nWorldEnd\n", **kwargs)


def matrix_of(folder: Path, transforms: str) -> Any:
    return load_world(folder, f"{transforms}\n{FIELD}").objects[0].world_from_object


# ---- what a scene means


def test_a_whole_scene(tmp_path):
    scene = load(
        tmp_path,
        """# a scene
        Film "image" "string filename" ["out.exr"]
          "integer xresolution" [320] "integer yresolution" 200
        Sampler "bestcandidate" "integer pixelsamples" [5]
        PixelFilter "box" "float xwidth" [.5] "float ywidth" [5e-1]
        SurfaceIntegrator "whitted" "integer maxdepth" [5]
        LookAt 0 0 0  0 0 1  0 1 0
        Camera "perspective" "float fov" 30
        WorldBegin
        LightSource "point" "color I" [1 2 3] "color scale" [2 2 .5]
        Material "mirror"
        Shape "cylinder" "float radius" 2 "float zmin" [-3] "float zmax" [4.] "float phimax" [360]
        Material "matte" "color Kd" [.4 .2 .1] "float sigma" 15
        Shape "heightfield" "integer nu" [3] "integer nv" [2] "float Pz" [0 1 2  3 4 5]
        WorldEnd""",
    )
    field = jaxhf.Heightfield(np.array([[0, 1, 2], [3, 4, 5]], np.float32), dx=0.5, dy=1.0)
    expected = jaxhf.Scene(
        [Object(Cylinder(2, -3, 4), Mirror(0.9)), Object(field, jaxhf.OrenNayar((0.4, 0.2, 0.1), 15))],
        jaxhf.Perspective(np.eye(4), 30, width=320, height=200),
        [Point((0, 0, 0), (2, 4, 1.5))],
        samples=5,
    )
    assert_same(scene, expected)


@pytest.mark.parametrize("options", ["", 'Film "image" Sampler "bestcandidate"'])
def test_defaults_are_those_of_pbrt(tmp_path, options):
    world = f'LightSource "point" {FIELD} Material "matte" Shape "cylinder"'
    scene = load(tmp_path, f'{options} Camera "perspective" WorldBegin {world} WorldEnd')
    field = jaxhf.Heightfield(np.array([[0, 1], [2, 3]], np.float32))
    objects = [Object(field, Matte(0.5)), Object(Cylinder(1, -1, 1), Matte(0.5))]
    camera = jaxhf.Perspective(np.eye(4), 90, width=640, height=480)
    assert_same(scene, jaxhf.Scene(objects, camera, [Point((0, 0, 0), 1)], samples=4))


def test_the_way_a_file_is_written_does_not_matter(tmp_path):
    """Numbers, brackets and comments; lines of Windows, which errors count; any encoding of a comment."""
    scene = load_world(
        tmp_path,
        'Material "matte" "color  Kd" [ .4\n +2e-1 # ] "not a token" [\n\t1.E-1]\nTranslate -.5 +2. 1e1\n'
        'Shape "heightfield"\n"integer nu" 2\n"integer nv"\n2.0 "float Pz"\n[0 1e-3 # a # b\n-2 .5]',
    )
    np.testing.assert_allclose(scene.objects[0].material.albedo, [0.4, 0.2, 0.1], rtol=1e-15)
    np.testing.assert_array_equal(scene.objects[0].world_from_object[:3, 3], [-0.5, 2, 10])
    np.testing.assert_array_equal(scene.heights, np.array([[0, 1e-3], [-2, 0.5]], np.float32))
    text = f"{CAMERA}\nWorldBegin\nTranslate 1 2\n3\n{FIELD}\nWorldEnd\n".replace("\n", "\r\n")
    np.testing.assert_array_equal(load(tmp_path, text).objects[0].world_from_object[:3, 3], [1, 2, 3])
    with pytest.raises(SceneError, match=r"scene\.pbrt:5: unknown directive 'Shade'"):
        load(tmp_path, text.replace("Shape", "Shade"))
    path = write(tmp_path, "")
    path.write_bytes(b"\xef\xbb\xbf# sea\xe9\xff\n" + f"{CAMERA} WorldBegin {FIELD} WorldEnd".encode())
    assert len(load_pbrt(path).objects) == 1


def test_heights_have_the_dtype_that_is_asked_for(tmp_path):
    with jax.enable_x64(True):
        world = FIELD.replace("0 1 2 3", "0 .1 2 3")
        assert load_world(tmp_path, world).heights.dtype == np.float32
        heights = load_world(tmp_path, world, dtype=np.float64).heights
        assert heights.dtype == np.float64
        assert float(heights[0, 1]) == 0.1


# Columns of the handwritten matrices are the images of x, y and z, and of the origin.
QUARTER_TURN = [[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
SHEARED = "[1 0 0 0  2 1 0 0  0 0 1 0  5 6 7 1]"
SHEAR = [[1, 2, 0, 5], [0, 1, 0, 6], [0, 0, 1, 7], [0, 0, 0, 1]]


@pytest.mark.parametrize(
    ("transforms", "expected"),
    [
        ("Translate 1 2 3", [[1, 0, 0, 1], [0, 1, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]),
        ("Scale 2 3 -4", [[2, 0, 0, 0], [0, 3, 0, 0], [0, 0, -4, 0], [0, 0, 0, 1]]),
        ("Rotate 90 0 0 2", QUARTER_TURN),
        ("Rotate 90 1 0 0", [[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]]),
        ("Rotate 90 0 1 0", [[0, 0, 1, 0], [0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 1]]),
        ("Rotate 120 1 1 1", [[0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]]),
        ("Translate 1 2 3 Scale 2 2 2", [[2, 0, 0, 1], [0, 2, 0, 2], [0, 0, 2, 3], [0, 0, 0, 1]]),
        ("Scale 2 2 2 Translate 1 2 3", [[2, 0, 0, 2], [0, 2, 0, 4], [0, 0, 2, 6], [0, 0, 0, 1]]),
        ("Translate 1 0 0 Rotate 90 0 0 1 Scale 1 3 1", [[0, -3, 0, 1], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]),
        (f"Translate 9 9 9 Transform {SHEARED}", SHEAR),
        (f"Scale 2 2 2 ConcatTransform {SHEARED}", [[2, 4, 0, 10], [0, 2, 0, 12], [0, 0, 2, 14], [0, 0, 0, 1]]),
        ("Rotate 90 0 0 1 TransformBegin Scale 2 2 2 TransformEnd", QUARTER_TURN),
        ("Rotate 90 0 0 1 AttributeBegin Scale 2 2 2 AttributeEnd", QUARTER_TURN),
        ('Rotate 90 0 0 1 CoordinateSystem "a" Identity Scale 2 2 2 CoordSysTransform "a"', QUARTER_TURN),
        # LookAt is the inverse of the frame (right, up, forward, eye): eye (1, 2, 3), forward +x, up +z, right +y.
        ("LookAt 1 2 3  5 2 3  0 0 2", [[0, 1, 0, -2], [0, 0, 1, -3], [1, 0, 0, -1], [0, 0, 0, 1]]),
    ],
)
def test_transforms(tmp_path, transforms, expected):
    assert matrix_of(tmp_path, f"{transforms} Identity") is None
    np.testing.assert_allclose(matrix_of(tmp_path, transforms), expected, atol=1e-15, rtol=1e-15)


def rays(scene: Any, points: list[tuple[float, float]]) -> tuple[np.ndarray, np.ndarray]:
    found = [scene.camera.ray(jnp.asarray(x, float), jnp.asarray(y, float)) for x, y in points]
    return np.array([ray.o for ray in found]), np.array([ray.d for ray in found])


@pytest.mark.parametrize(
    ("transforms", "eye", "right"),
    [
        ("LookAt 1 2 3  4 2 3  0 0 1", (1, 2, 3), (0, 1, 0)),
        # Acts on the world first: the world moves up by 5, so the camera stands 5 lower in it.
        ("LookAt 1 2 3  4 2 3  0 0 1 Translate 0 0 5", (1, 2, -2), (0, 1, 0)),
        # Acts last, in camera space: everything moves 5 away from the camera.
        ("Translate 0 0 5 LookAt 1 2 3  4 2 3  0 0 1", (-4, 2, 3), (0, 1, 0)),
        ("Scale -1 1 1 LookAt 1 2 3  4 2 3  0 0 1", (1, 2, 3), (0, -1, 0)),
    ],
)
def test_camera_rays(tmp_path, transforms, eye, right):
    film = 'Film "image" "integer xresolution" [4] "integer yresolution" [2]'
    scene = load(tmp_path, f'{film} {transforms} Camera "perspective" "float fov" [90] WorldBegin {FIELD} WorldEnd')
    forward, up, right = np.array([1, 0, 0]), np.array([0, 0, 1]), np.array(right)
    # The shorter side (height) spans 90 degrees: y = -1..1, x = -2..2 on the plane z = 1.
    o, d = rays(scene, [(2, 1), (4, 1), (0, 1), (2, 0), (3.5, 0.5)])
    expected = np.array([forward, forward + 2 * right, forward - 2 * right, forward + up, forward + 1.5 * right + 0.5 * up])
    np.testing.assert_allclose(o, np.tile(eye, (5, 1)), atol=1e-6)
    np.testing.assert_allclose(d, expected / np.linalg.norm(expected, axis=1, keepdims=True), atol=1e-6)  # float32


def test_world_begin_forgets_the_transform_but_not_the_camera(tmp_path):
    scene = load(
        tmp_path,
        f'LookAt 1 2 3  4 2 3  0 0 1 {CAMERA} Translate 8 8 8 WorldBegin Scale 2 2 2 {FIELD} CoordSysTransform "camera" {FIELD}'
        ' LightSource "point" WorldEnd',
    )
    np.testing.assert_array_equal(scene.objects[0].world_from_object, np.diag([2, 2, 2, 1]))
    frame = [[0, 0, 1, 1], [1, 0, 0, 2], [0, 1, 0, 3], [0, 0, 0, 1]]
    np.testing.assert_allclose(scene.objects[1].world_from_object, frame, atol=1e-15)
    np.testing.assert_allclose(scene.lights[0].p, [1, 2, 3], atol=1e-15)


def test_lights(tmp_path):
    scene = load_world(
        tmp_path,
        'Translate 1 2 3 Scale 2 2 2 LightSource "point" "point from" [10 20 30]\n'
        'LightSource "distant" "color L" [1 2 3] "color scale" [3 2 1] "point from" [0 0 5] "point to" [1 0 0]\n'
        f'LightSource "distant"\n{FIELD}',
    )
    point = Point((11, 22, 33), 1)  # pbrt-v2 adds "from" after the transformation
    assert_same(scene.lights, (point, Directional((-2, 0, 10), (3, 4, 3)), Directional((0, 0, -2), 1)))


def test_stratified_samples_and_a_film_behind_its_camera(tmp_path):
    sampler = 'Sampler "stratified" "integer xsamples" [3] "integer ysamples" [3] "bool jitter" ["false"]'
    scene = load(tmp_path, f'{sampler} {CAMERA} Film "image" "integer xresolution" [7] WorldBegin {FIELD} WorldEnd')
    assert (scene.samples, scene.camera.width, scene.camera.height) == (9, 7, 480)


def test_attributes_restore_material_and_textures(tmp_path, monkeypatch):
    """A texture goes before a colour, is not flipped, and is opened once, where it is used."""
    images = np.arange(24, dtype=np.float32).reshape(2, 2, 2, 3)
    for name, image in zip(("a.npy", "b.npy"), images, strict=True):
        np.save(tmp_path / name, image)
    scene = load_world(
        tmp_path,
        f'{TEXTURE} "a.npy" Material "matte" "texture Kd" "t" "color Kd" [1 0 0]\n'
        f'AttributeBegin Texture "t" "color" "imagemap" "string filename" "b.npy" {FIELD}\n'
        f'Material "mirror" "color Kr" [.1 .2 .3] {FIELD} AttributeEnd {FIELD} Shape "cylinder"\n'
        f'TransformBegin Material "mirror" TransformEnd {FIELD}',
    )
    inner, mirror, outer, again, last = [obj.material for obj in scene.objects]
    np.testing.assert_array_equal([inner.albedo.texels, outer.albedo.texels], images[::-1])
    assert again.albedo is outer.albedo
    np.testing.assert_array_equal(mirror.reflectance, [0.1, 0.2, 0.3])
    np.testing.assert_array_equal(last.reflectance, [0.9, 0.9, 0.9])
    monkeypatch.setattr(reader, "load_image", lambda path: pytest.fail(f"opened {path}"))
    load_world(tmp_path, f'{TEXTURE} "a.npy"\n{FIELD}')


def test_include(tmp_path):
    write(tmp_path, f'Translate 1 0 0\nInclude "b.pbrt" {FIELD}', "parts/a.pbrt")
    write(tmp_path, "Scale 2 2 2", "parts/b.pbrt")
    write(tmp_path, CAMERA, "camera.pbrt")
    scene = load(
        tmp_path, 'Include "camera.pbrt" WorldBegin Include "parts/a.pbrt" Translate 1 0 0 Include "./parts/a.pbrt" WorldEnd'
    )
    first, second = [obj.world_from_object[:3] for obj in scene.objects]
    np.testing.assert_array_equal(first, [[2, 0, 0, 1], [0, 2, 0, 0], [0, 0, 2, 0]])
    np.testing.assert_array_equal(second, [[4, 0, 0, 5], [0, 4, 0, 0], [0, 0, 4, 0]])


# ---- mistakes

STRATIFIED = 'Sampler "stratified" "bool jitter" "false"'
# What stands before WorldBegin, the line of the mistake, and what the message says: one of each rule.
OPTIONS_ERRORS = [
    ('\nSampler "bestcandidate"\nCamra "perspective"', 3, "unknown directive 'Camra'; did you mean 'Camera'?"),
    ('SurfaceIntegrator "directlighting"\n"integer maxdepth"\n[6]', 3, "maxdepth must be 5, it is 6"),
    ('\nSampler "bestcandidates"', 2, "unknown Sampler \"bestcandidates\"; did you mean 'bestcandidate'?"),
    ('\nSampler "stratified"', 2, 'jitter must be "false": jittered samples, the default, are not supported'),
    (f'{STRATIFIED} "integer xsamples" 2\n"integer ysamples" 3', 2, "ysamples must equal xsamples, 2, it is 3"),
    ('PixelFilter "box" "float xwidth" .5\n"float ywidth" 1', 2, "ywidth must be 0.5, it is 1.0"),
    ('Film "image"\n"integer yresolution" [-1]', 2, "yresolution must be at least 1, it is -1"),
    ('Film "image" "integer xresolution" [1e999]', 1, "'integer xresolution' must be finite, it is [1e999]"),
    ('Camera "perspective"\n"float fov" [180]', 2, "fov must lie between 0 and 180 degrees, it is 180.0"),
    ('Camera "perspective"\n"integer fov" [45]', 2, "Camera \"perspective\" takes 'float fov', not 'integer fov'"),
    ('Camera "perspective" "float fov" 45\n"float fov" 50', 2, "'float fov' is given twice"),
    ('Camera "perspective"\n"float fov"', 2, "'float fov' has no value"),
    ('Camera "perspective"\n45', 2, "Camera \"perspective\" takes a parameter such as 'float fov' here, found 45"),
    ("\nCamera", 2, "Camera takes a name in quotes here, found nothing"),
    ('Film "image" "string filename"\n["a" 4]', 2, 'a bracket holds numbers or strings, this one holds both: ["a" 4]'),
    ('Film "image"\n"string filename" ["a\\b"]', 2, "a string must not contain a backslash"),
    ("\nLookAt 1 2 3 1 2 3 0 0 1", 2, "LookAt: the target must differ from the eye, both are [1.0, 2.0, 3.0]"),
    (f"\n{FIELD}", 2, "Shape must follow WorldBegin"),
    ("\nWorldBegin", 2, "there must be a Camera before WorldBegin"),
    ('\nCoordSysTransform "camera"', 2, 'unknown coordinate system "camera"'),
    ('\n"image"', 2, 'a directive must come first, found "image"'),
]

MATTE = 'Material "matte"'
SQUARE = 'Shape "heightfield" "integer nu" 2'
# What stands from line 2 on, behind a camera and WorldBegin.
WORLD_ERRORS = [
    ("\n" + CAMERA, 3, "Camera must not follow WorldBegin"),
    (f"{FIELD} WorldEnd\n\nIdentity", 4, "Identity must not follow WorldEnd"),
    ('\nShape "sphere"', 3, 'unknown Shape "sphere"; known: cylinder, heightfield'),
    (f'{MATTE}\n"float sigma"\n-10', 4, "sigma must be 0 to 90 degrees, it is -10.0"),
    (f'{MATTE}\n"color Kd" [.5]', 3, "'color Kd' takes 3 numbers, found 1 number"),
    (f'{MATTE}\n"float Kd" .5', 3, "Material \"matte\" takes 'color Kd' or 'texture Kd', not 'float Kd'"),
    (f'{MATTE}\n"color Kd" [1 -1 1]', 3, "Kd must be 0 or more, it is [ 1. -1.  1.]"),
    ('LightSource "point"\n"color I" [1 -1 1]', 3, "I must be 0 or more"),
    ('LightSource "distant" "color L" [1 1 1]\n"color scale" [1 -1 1]', 3, "scale must be 0 or more"),
    ('Material "mirror"\n"color Kd" [1 1 1]', 3, "unknown parameter 'color Kd' of Material \"mirror\""),
    ('\nLightSource "distant" "point to" [0 0 0]', 3, "Directional: towards must not be zero, it is [0, 0, 0]"),
    (f'{MATTE} "color Kd"\n[.4\n.2 O.1]', 4, "'O.1' in the bracket of line 3 is not a number"),
    (f'{MATTE} "color Kd" [.4 # ]\n1_0\n1..0]', 3, "'1_0' in the bracket of line 2 is not a number"),
    ("\nTranslate 1 2", 3, "Translate takes 3 numbers, found 2"),
    ("Translate 1 2 3\n4", 3, "Translate takes 3 numbers, found 4"),
    ("\nRotate 1O 1 0 0", 3, "Rotate takes 4 numbers, found 0"),
    ("\nScale 1 0 1", 3, "Scale must be invertible, it flattens space"),
    ("\nConcatTransform [1 0 0 0 1 0 0 0 0 0 1 0 0 0 0 1]", 3, "ConcatTransform must be invertible"),
    ("Translate 9e29 0 0\nTranslate 9e29 0 0", 3, "the current transformation must be within"),
    ("ConcatTransform\n1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1", 3, "ConcatTransform takes 16 numbers in brackets, found 1"),
    ('CoordSysTransform\n"camra"', 3, "unknown coordinate system \"camra\"; did you mean 'camera'?"),
    ("\nAttributeBegin", 3, "this AttributeBegin has no AttributeEnd"),
    ("\nAttributeEnd", 3, "this AttributeEnd has no AttributeBegin"),
    ("AttributeBegin\nTransformBegin\nAttributeEnd", 4, "the last to be opened is TransformBegin in line 3"),
    (f'{MATTE} "color Kd"\n[.4 .2\n.1\nMaterial "matte" "color Kd" [1 1 1]', 3, "this bracket is not closed"),
    ("Translate 1 2 3\n]", 3, "there is no '[' before this ']'"),
    ('Shape "cylinder"\n"float phimax" 180', 3, "phimax must be 360"),
    (FIELD.replace('"float', '\n"float').replace(" 3]", "]"), 3, "Pz must hold nu * nv = 2 * 2 = 4 heights, it holds 3"),
    (f'{SQUARE} "integer nv" 2', 2, "Shape \"heightfield\" must have a parameter 'float Pz'"),
    (FIELD.replace("1 2", "1e39\n2"), 2, "Pz[1] (column 1, row 0) must be finite in float32, it is 1e+39"),
    (FIELD.replace('v" [2]', 'v"\n[-2]'), 3, "nv must be at least 2, it is -2"),
    (f'{TEXTURE} "a.npy" {MATTE}\n"texture Kd" "u"\n{FIELD}', 3, "unknown texture 'u'; known: t"),
    ('Texture "t"\n"float" "imagemap"', 3, 'the type of a Texture must be "color", it is "float"'),
    (f'{TEXTURE}\n"a.npy"\n{MATTE} "texture Kd" "t"\n{FIELD}', 3, "a.npy"),
    (f'{TEXTURE}\n"../a.npy"', 3, "'../a.npy' lies outside the scene's folder"),
    ('Include\n"/etc/passwd"', 3, "'/etc/passwd' lies outside the scene's folder"),
    ('Include\n"scene.pbrt"', 3, '"scene.pbrt" includes itself'),
]

FILE_ERRORS = [
    (f"{CAMERA}\n\n", 2, "the file ends without a WorldBegin"),
    (f"{CAMERA}\nWorldBegin\nWorldEnd", 3, "there must be a Shape before WorldEnd"),
]
ERRORS = [
    *((f"{options}\n{CAMERA} WorldBegin {FIELD} WorldEnd", line, message) for options, line, message in OPTIONS_ERRORS),
    *((f"{CAMERA} WorldBegin\n{world}\nWorldEnd\n", line, message) for world, line, message in WORLD_ERRORS),
    *FILE_ERRORS,
]


def assert_error(path: Path, where: Path, line: int, message: str):
    with pytest.raises(SceneError) as caught:
        load_pbrt(path)
    assert str(caught.value).startswith(f"{where}:{line}: ")
    assert message in str(caught.value)


@pytest.fixture
def folder(tmp_path):
    write(tmp_path, "not an image", "a.npy")
    (tmp_path / "parts").mkdir()
    return tmp_path


@pytest.mark.parametrize(("text", "line", "message"), ERRORS, ids=[message for *_, message in ERRORS])
def test_a_mistake_is_named_with_its_line(folder, text, line, message):
    path = write(folder, text)
    assert_error(path, path, line, message)


@pytest.mark.parametrize("k", range(0, len(WORLD_ERRORS), 8))
def test_an_error_names_the_included_file(folder, k):
    world, line, message = WORLD_ERRORS[k]
    path = write(folder, f'{CAMERA} WorldBegin\n\n\nInclude "part.pbrt"\nWorldEnd')
    part = write(folder, f"# the line before\n{world}", "part.pbrt")
    assert_error(path, part.resolve(), line, message)


def test_files_that_are_not_opened(tmp_path):
    """Those that include each other; a link that leads out of the folder; none, or a folder."""
    first = write(tmp_path, '\nInclude "b.pbrt"', "a.pbrt")
    second = write(tmp_path, '\n\nInclude "a.pbrt"', "b.pbrt")
    assert_error(first, second.resolve(), 3, '"a.pbrt" includes itself')
    assert_error(write(tmp_path, 'Include "b.pbrt"', "c.pbrt"), first.resolve(), 2, '"b.pbrt" includes itself')
    path = write(tmp_path / "scene", f'{CAMERA} WorldBegin\nInclude "link.pbrt" WorldEnd')
    (path.parent / "link.pbrt").symlink_to(write(tmp_path, FIELD, "secret.pbrt"))
    assert_error(path, path, 2, "'link.pbrt' lies outside the scene's folder")
    for name in ("none.pbrt", "."):
        with pytest.raises(SceneError, match=r": (No such file|Is a directory)"):
            load_pbrt(tmp_path / name)
