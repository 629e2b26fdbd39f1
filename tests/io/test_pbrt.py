"""Scenes in the format of pbrt-v2: what they mean, and where their mistakes are."""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxhf import Cylinder, Directional, Matte, Mirror, Point, SceneError
from jaxhf.io.pbrt import reader
from jaxhf.io.pbrt.reader import load_pbrt

SEED_SCENES = Path(__file__).parents[3] / "shared" / "pbrt" / "scenes"

CAMERA = 'Camera "perspective" "float fov" [45]'
FIELD = 'Shape "heightfield" "integer nu" [2] "integer nv" [2] "float Pz" [0 1 2 3]'


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
        Material "matte" "color Kd" [.4 .2 .1]
        Shape "heightfield" "integer nu" [3] "integer nv" [2] "float Pz" [0 1 2  3 4 5]
        WorldEnd""",
    )
    assert (scene.camera.width, scene.camera.height, float(scene.camera.fov)) == (320, 200, 30)
    assert scene.samples == 5
    cylinder, field = scene.objects
    assert isinstance(cylinder.shape, Cylinder)
    assert isinstance(cylinder.material, Mirror)
    assert (cylinder.shape.radius, cylinder.shape.z_min, cylinder.shape.z_max) == (2, -3, 4)
    np.testing.assert_array_equal(cylinder.material.reflectance, [0.9, 0.9, 0.9])
    assert isinstance(field.material, Matte)
    np.testing.assert_array_equal(field.material.albedo, [0.4, 0.2, 0.1])
    np.testing.assert_array_equal(scene.heights, [[0, 1, 2], [3, 4, 5]])
    assert (field.shape.dx, field.shape.dy, field.shape.x0, field.shape.y0) == (0.5, 1, 0, 0)
    (light,) = scene.lights
    assert isinstance(light, Point)
    np.testing.assert_array_equal(light.intensity, [2, 4, 1.5])


@pytest.mark.parametrize("options", ["", 'Film "image" Sampler "bestcandidate"'])
def test_defaults_are_those_of_pbrt(tmp_path, options):
    scene = load(tmp_path, f'{options} Camera "perspective" WorldBegin LightSource "point" {FIELD} Shape "cylinder" WorldEnd')
    assert (scene.camera.width, scene.camera.height, float(scene.camera.fov)) == (640, 480, 90)
    assert scene.samples == 4
    np.testing.assert_array_equal(scene.objects[0].material.albedo, [0.5, 0.5, 0.5])
    cylinder = scene.objects[1].shape
    assert (cylinder.radius, cylinder.z_min, cylinder.z_max) == (1, -1, 1)
    np.testing.assert_array_equal(scene.lights[0].intensity, [1, 1, 1])
    np.testing.assert_array_equal(scene.lights[0].p, [0, 0, 0])
    np.testing.assert_array_equal(load_world(tmp_path, f'Material "matte" {FIELD}').objects[0].material.albedo, [0.5, 0.5, 0.5])


def test_the_way_a_number_is_written_does_not_matter(tmp_path):
    scene = load_world(
        tmp_path,
        'Material "matte" "color  Kd" [ .4\n +2e-1 # ] "not a token" [\n\t1.E-1]\nTranslate -.5 +2. 1e1\n'
        'Shape "heightfield"\n"integer nu" 2\n"integer nv"\n2.0 "float Pz"\n[0 1e-3 # a # b\n-2 .5]',
    )
    np.testing.assert_allclose(scene.objects[0].material.albedo, [0.4, 0.2, 0.1], rtol=1e-15)
    np.testing.assert_array_equal(scene.objects[0].world_from_object[:3, 3], [-0.5, 2, 10])
    np.testing.assert_array_equal(scene.heights, np.array([[0, 1e-3], [-2, 0.5]], np.float32))


@pytest.mark.parametrize("ending", ["\r\n", "\n"])
def test_line_endings(tmp_path, ending):
    text = f"{CAMERA}\nWorldBegin\nTranslate 1 2\n3\n{FIELD}\nWorldEnd\n"
    scene = load(tmp_path, text.replace("\n", ending))
    np.testing.assert_array_equal(scene.objects[0].world_from_object[:3, 3], [1, 2, 3])
    with pytest.raises(SceneError, match=r"scene\.pbrt:5: unknown directive 'Shade'"):
        load(tmp_path, text.replace("Shape", "Shade").replace("\n", ending))


def test_a_comment_may_be_in_any_encoding(tmp_path):
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
    np.testing.assert_allclose(matrix_of(tmp_path, transforms), expected, atol=1e-15, rtol=1e-15)


def test_no_transform_is_none(tmp_path):
    assert matrix_of(tmp_path, "") is None
    assert matrix_of(tmp_path, "Translate 1 2 3 Identity") is None
    assert matrix_of(tmp_path, 'Translate 1 2 3 CoordSysTransform "world"') is None


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


def test_film_may_follow_the_camera(tmp_path):
    scene = load(tmp_path, f'{CAMERA} Film "image" "integer xresolution" [7] WorldBegin {FIELD} WorldEnd')
    assert (scene.camera.width, scene.camera.height) == (7, 480)


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
    point, distant, default = scene.lights
    np.testing.assert_array_equal(point.p, [11, 22, 33])  # pbrt-v2 adds "from" after the transformation
    assert isinstance(distant, Directional)
    assert isinstance(default, Directional)
    np.testing.assert_array_equal(distant.towards, [-2, 0, 10])
    np.testing.assert_array_equal(distant.irradiance, [3, 4, 3])
    np.testing.assert_array_equal(default.towards, [0, 0, -2])
    np.testing.assert_array_equal(default.irradiance, [1, 1, 1])


def test_stratified_samples(tmp_path):
    sampler = 'Sampler "stratified" "integer xsamples" [3] "integer ysamples" [3] "bool jitter" ["false"]'
    assert load(tmp_path, f"{sampler} {CAMERA} WorldBegin {FIELD} WorldEnd").samples == 9


def test_attributes_restore_material_and_textures(tmp_path):
    np.save(tmp_path / "a.npy", np.zeros((2, 2, 3), np.float32))
    np.save(tmp_path / "b.npy", np.ones((2, 2, 3), np.float32))
    scene = load_world(
        tmp_path,
        'Texture "t" "color" "imagemap" "string filename" "a.npy" Material "matte" "texture Kd" "t"\n'
        'AttributeBegin Texture "t" "color" "imagemap" "string filename" "b.npy"\n'
        f'{FIELD} Material "mirror" "color Kr" [.1 .2 .3] {FIELD} AttributeEnd\n'
        f'{FIELD} TransformBegin Material "mirror" TransformEnd {FIELD}',
    )
    inner, mirror, outer, last = [obj.material for obj in scene.objects]
    assert np.all(inner.albedo.texels == 1)
    assert np.all(outer.albedo.texels == 0)
    np.testing.assert_array_equal(mirror.reflectance, [0.1, 0.2, 0.3])
    np.testing.assert_array_equal(last.reflectance, [0.9, 0.9, 0.9])


def test_texture_wins_over_colour_and_is_not_flipped(tmp_path):
    image = np.arange(12, dtype=np.float32).reshape(2, 2, 3)
    np.save(tmp_path / "a.npy", image)
    scene = load_world(
        tmp_path,
        'Texture "t" "color" "imagemap" "string filename" ["a.npy"]\n'
        f'Material "matte" "texture Kd" ["t"] "color Kd" [1 0 0] {FIELD} Shape "cylinder"',
    )
    first, second = [obj.material.albedo for obj in scene.objects]
    np.testing.assert_array_equal(first.texels, image)
    assert second is first


def test_an_unused_texture_is_not_opened(tmp_path, monkeypatch):
    write(tmp_path, "not an image", "a.npy")
    monkeypatch.setattr(reader, "load_image", lambda path: pytest.fail(f"opened {path}"))
    load_world(tmp_path, f'Texture "t" "color" "imagemap" "string filename" "a.npy"\n{FIELD}')


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

OPTIONS_ERRORS = [
    (
        "unknown directive",
        '\nSampler "bestcandidate"\nCamra "perspective"',
        3,
        "unknown directive 'Camra'; did you mean 'Camera'?",
    ),
    ("other integrator", 'SurfaceIntegrator\n"path"', 2, 'unknown SurfaceIntegrator "path"; known: directlighting, whitted'),
    ("depth", 'SurfaceIntegrator "directlighting"\n"integer maxdepth"\n[6]', 3, "maxdepth must be 5, it is 6"),
    ("sampler", '\nSampler "bestcandidates"', 2, "unknown Sampler \"bestcandidates\"; did you mean 'bestcandidate'?"),
    ("samples", 'Sampler "bestcandidate"\n"integer pixelsamples" 0', 2, "pixelsamples must be at least 1, it is 0"),
    ("jitter", '\nSampler "stratified"', 2, 'jitter must be "false": jittered samples, the default, are not supported'),
    ("jitter given", 'Sampler "stratified"\n"bool jitter" "true"', 2, "jitter must be"),
    ("no bool", 'Sampler "stratified"\n"bool jitter" "no"', 2, "'bool jitter' must be \"true\" or \"false\", it is 'no'"),
    (
        "not square",
        'Sampler "stratified" "bool jitter" "false" "integer xsamples" 2\n"integer ysamples" 3',
        2,
        "ysamples must equal xsamples, 2, it is 3",
    ),
    (
        "no samples",
        'Sampler "stratified" "bool jitter" "false"\n"integer xsamples" 0',
        2,
        "xsamples must be at least 1, it is 0",
    ),
    ("filter", 'PixelFilter "gaussian"', 1, 'unknown PixelFilter "gaussian"; known: box'),
    ("filter width", 'PixelFilter "box" "float xwidth" .5\n"float ywidth" 1', 2, "ywidth must be 0.5, it is 1.0"),
    ("cropwindow", 'Film "image"\n"float cropwindow" [0 1 0 1]', 2, "unknown parameter 'float cropwindow' of Film \"image\""),
    ("resolution 0", 'Film "image"\n"integer xresolution" [0]', 2, "xresolution must be at least 1, it is 0"),
    ("resolution -1", 'Film "image"\n"integer yresolution" [-1]', 2, "yresolution must be at least 1, it is -1"),
    (
        "resolution 4.5",
        'Film "image"\n"integer xresolution"\n[4.5]',
        3,
        "'integer xresolution' must be a whole number, it is 4.5",
    ),
    ("resolution inf", 'Film "image" "integer xresolution" [1e999]', 1, "'integer xresolution' must be finite, it is [1e999]"),
    ("fov 0", 'Camera "perspective"\n"float fov" 0', 2, "fov must lie between 0 and 180 degrees, it is 0.0"),
    ("fov 180", 'Camera "perspective"\n"float fov" [180]', 2, "fov must lie between 0 and 180 degrees, it is 180.0"),
    ("fov text", 'Camera "perspective"\n"float fov" ["45"]', 2, "'float fov' takes 1 number, found 1 string"),
    (
        "fov integer",
        'Camera "perspective"\n"integer fov" [45]',
        2,
        "Camera \"perspective\" takes 'float fov', not 'integer fov'",
    ),
    ("fov twice", 'Camera "perspective" "float fov" 45\n"float fov" 50', 2, "'float fov' is given twice"),
    ("fov two values", 'Camera "perspective" "float fov"\n[45 46]', 2, "'float fov' takes 1 number, found 2 numbers"),
    ("fov no value", 'Camera "perspective"\n"float fov"', 2, "'float fov' has no value"),
    ("fov empty", 'Camera "perspective" "float fov"\n[ ]', 2, "'float fov' takes 1 number, found 0 numbers"),
    ("fov untyped", 'Camera "perspective"\n"fov" 45', 2, "Camera \"perspective\" takes 'float fov', not 'fov'"),
    (
        "no declaration",
        'Camera "perspective"\n45',
        2,
        "Camera \"perspective\" takes a parameter such as 'float fov' here, found 45",
    ),
    ("blank declaration", 'Camera "perspective"\n" " 45', 2, "unknown parameter '' of Camera \"perspective\""),
    ("no kind", "\nCamera", 2, "Camera takes a name in quotes here, found nothing"),
    ("kind not quoted", "Camera\n45", 2, "Camera takes a name in quotes here, found 45"),
    ("filename number", 'Film "image" "string filename"\n[4]', 2, "'string filename' takes 1 string, found 1 number"),
    (
        "filename mixed",
        'Film "image" "string filename"\n["a" 4]',
        2,
        'a bracket holds numbers or strings, this one holds both: ["a" 4]',
    ),
    ("escape", 'Film "image"\n"string filename" "a\\b"', 2, "a string must not contain a backslash"),
    ("escape in brackets", 'Film "image"\n"string filename" ["a\\b"]', 2, "a string must not contain a backslash"),
    (
        "camera stands still",
        "\nLookAt 1 2 3 1 2 3 0 0 1",
        2,
        "LookAt: the target must differ from the eye, both are [1.0, 2.0, 3.0]",
    ),
    ("camera up", "\nLookAt 0 0 0 0 0 2 0 0 1", 2, "LookAt: up must not point along the view, it is [0.0, 0.0, 1.0]"),
    ("camera no up", "\nLookAt 0 0 0 0 0 2 0 0 0", 2, "LookAt: up must not point along the view, it is [0.0, 0.0, 0.0]"),
    ("world first", f"\n{FIELD}", 2, "Shape must follow WorldBegin"),
    ("attribute first", "\nAttributeBegin", 2, "AttributeBegin must follow WorldBegin"),
    ("no camera", "\nWorldBegin", 2, "there must be a Camera before WorldBegin"),
    ("camera frame", '\nCoordSysTransform "camera"', 2, 'unknown coordinate system "camera"'),
    ("number first", "\n4", 2, "a directive must come first, found 4"),
    ("string first", '\n"image"', 2, 'a directive must come first, found "image"'),
]

TEXTURE = 'Texture "t" "color" "imagemap" "string filename"'

WORLD_ERRORS = [
    ("options late", "\n" + CAMERA, 3, "Camera must not follow WorldBegin"),
    ("world twice", "\nWorldBegin", 3, "WorldBegin must not follow WorldBegin"),
    ("after the end", f"{FIELD} WorldEnd\n\nIdentity", 4, "Identity must not follow WorldEnd"),
    ("other shape", '\nShape "sphere"', 3, 'unknown Shape "sphere"; known: cylinder, heightfield'),
    ("other light", 'LightSource "pont"', 2, "unknown LightSource \"pont\"; did you mean 'point'?"),
    ("other material", 'Material "glass"', 2, 'unknown Material "glass"; known: matte, mirror'),
    ("sigma", 'Material "matte"\n"float sigma"\n10', 4, "sigma must be 0 (rough surfaces are not supported), it is 10.0"),
    ("grey", 'Material "matte"\n"color Kd" [.5]', 3, "'color Kd' takes 3 numbers, found 1 number"),
    ("type of Kd", 'Material "matte"\n"float Kd" .5', 3, "Material \"matte\" takes 'color Kd' or 'texture Kd', not 'float Kd'"),
    ("Kd overflows", 'Material "matte"\n"color Kd" [1 1 1e999]', 3, "'color Kd' must be finite, it is [1 1 1e999]"),
    ("negative Kd", f'Material "matte"\n"color Kd" [1 -1 1]\n{FIELD}', 3, "Kd must be 0 or more, it is [ 1. -1.  1.]"),
    ("negative Kr", f'Material "mirror"\n"color Kr" [1 -1 1]\n{FIELD}', 3, "Kr must be 0 or more"),
    ("negative I", 'LightSource "point"\n"color I" [1 -1 1]', 3, "I must be 0 or more"),
    ("negative scale", 'LightSource "distant" "color L" [1 1 1]\n"color scale" [1 -1 1]', 3, "scale must be 0 or more"),
    ("negative L", 'LightSource "distant"\n"color L" [1 -1 1]', 3, "L must be 0 or more"),
    ("parameter", 'Material "mirror"\n"color Kd" [1 1 1]', 3, "unknown parameter 'color Kd' of Material \"mirror\""),
    ("nearest", 'LightSource "point"\n"color J" [1 1 1]', 3, "LightSource \"point\"; did you mean 'color I'?"),
    (
        "distant nowhere",
        '\nLightSource "distant" "point to" [0 0 0]',
        3,
        "Directional: towards must not be zero, it is [0, 0, 0]",
    ),
    ("letter for number", 'Material "matte" "color Kd"\n[.4\n.2 O.1]', 4, "'O.1' in the bracket of line 3 is not a number"),
    ("underscore", 'Material "matte" "color Kd" [.4 .2\n1_0]', 3, "'1_0' in the bracket of line 2 is not a number"),
    ("after a comment", 'Material "matte" "color Kd" [.4 # ]\n.2\n1..0]', 4, "'1..0' in the bracket of line 2 is not a number"),
    ("too few numbers", "\nTranslate 1 2", 3, "Translate takes 3 numbers, found 2"),
    ("too many numbers", "Translate 1 2 3\n4", 3, "Translate takes 3 numbers, found 4"),
    ("bracket", "Translate\n[1 2 3]", 3, "Translate takes 3 numbers, found [1 2 3]"),
    ("letter", "\nRotate 1O 1 0 0", 3, "Rotate takes 4 numbers, found 0"),
    ("infinite", "Translate 0 0\n1e999", 3, "Translate takes finite numbers, found 1e999"),
    ("scale 0", "\nScale 1 0 1", 3, "Scale must be invertible, it flattens space"),
    ("zero axis", "\nRotate 90 0 0 0", 3, "rotate: the axis must not be zero, it is [0.0, 0.0, 0.0]"),
    ("singular", "\nConcatTransform [1 0 0 0 1 0 0 0 0 0 1 0 0 0 0 1]", 3, "ConcatTransform must be invertible"),
    ("projective", "\nTransform [1 0 0 1 0 1 0 0 0 0 1 0 0 0 0 1]", 3, "Transform must be affine (last row 0 0 0 1)"),
    ("overflow", "Translate 9e29 0 0\nTranslate 9e29 0 0", 3, "the current transformation must be within"),
    ("not 16", "ConcatTransform\n[1 2 3]", 3, "ConcatTransform takes 16 numbers, found 3 numbers"),
    ("not numbers", "ConcatTransform\n[" + 16 * '"a"' + "]", 3, "ConcatTransform takes 16 numbers, found 16 strings"),
    (
        "not in brackets",
        "ConcatTransform\n1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1",
        3,
        "ConcatTransform takes 16 numbers in brackets, found 1",
    ),
    ("argument", "Identity\n4", 3, "Identity takes nothing, found 4"),
    ("frame", 'CoordSysTransform\n"camra"', 3, "unknown coordinate system \"camra\"; did you mean 'camera'?"),
    ("begin", "\nAttributeBegin", 3, "this AttributeBegin has no AttributeEnd"),
    ("end", "\nAttributeEnd", 3, "this AttributeEnd has no AttributeBegin"),
    (
        "crossed",
        "AttributeBegin\nTransformBegin\nAttributeEnd",
        4,
        "this AttributeEnd has no AttributeBegin; the last to be opened is TransformBegin in line 3",
    ),
    ("string open", '\nMaterial "matte\nShape "cylinder"', 3, "this string is not closed on its line"),
    ("string open in bracket", 'Material "matte" "texture Kd" [\n"t]\n', 3, "this string is not closed on its line"),
    (
        "bracket open",
        'Material "matte" "color Kd"\n[.4 .2\n.1\nMaterial "matte" "color Kd" [1 1 1]',
        3,
        "this bracket is not closed",
    ),
    ("bracket open to the end", '\nMaterial "matte" "color Kd" [.4 .2 .1 ', 3, "this bracket is not closed"),
    ("bracket not opened", "Translate 1 2 3\n]", 3, "there is no '[' before this ']'"),
    ("cylinder radius", '\nShape "cylinder" "float radius" 0', 3, "Cylinder: radius must be positive, it is 0.0"),
    (
        "cylinder upside down",
        '\nShape "cylinder" "float zmin" 1',
        3,
        "Cylinder: z_min must lie below z_max, they are 1.0 and 1.0",
    ),
    ("part of a cylinder", 'Shape "cylinder"\n"float phimax" 180', 3, "phimax must be 360"),
    (
        "few heights",
        FIELD.replace('"float', '\n"float').replace(" 3]", "]"),
        3,
        "Pz must hold nu * nv = 2 * 2 = 4 heights, it holds 3",
    ),
    ("many heights", FIELD.replace("3]", "3 4]"), 2, "Pz must hold nu * nv = 2 * 2 = 4 heights, it holds 5"),
    (
        "no heights",
        'Shape "heightfield" "integer nu" 2 "integer nv" 2',
        2,
        "Shape \"heightfield\" must have a parameter 'float Pz'",
    ),
    ("no nv", 'Shape "heightfield" "integer nu" 2 "float Pz" [1 2 3 4]', 2, "must have a parameter 'integer nv'"),
    ("nan", FIELD.replace("1 2", "1\nnan"), 3, "Pz[2] (column 0, row 1) must be finite in float32, it is nan"),
    ("inf", FIELD.replace("[0 1", "# [\n[ # ]\n-inf\n1"), 4, "Pz[0] (column 0, row 0) must be finite in float32, it is -inf"),
    ("beyond float32", FIELD.replace("1 2", "1e39\n2"), 2, "Pz[1] (column 1, row 0) must be finite in float32, it is 1e+39"),
    ("heights of text", FIELD.replace("[0 1 2 3]", '\n"a"'), 3, "'float Pz' takes numbers, found 1 string"),
    ("nu 1", FIELD.replace('u" [2]', 'u" [1]'), 2, "nu must be at least 2, it is 1"),
    ("nv -2", FIELD.replace('v" [2]', 'v"\n[-2]'), 3, "nv must be at least 2, it is -2"),
    ("no such texture", f'Material "matte"\n"texture Kd" "sky"\n{FIELD}', 3, "unknown texture 'sky'; there is none"),
    (
        "other texture",
        f'{TEXTURE} "a.npy" Material "matte"\n"texture Kd" "u"\n{FIELD}',
        3,
        "unknown texture 'u'; known: t",
    ),
    ("float texture", 'Texture "t"\n"float" "imagemap"', 3, 'the type of a Texture must be "color", it is "float"'),
    ("other map", 'Texture "t" "color"\n"checkerboard"', 3, 'unknown Texture "checkerboard"; known: imagemap'),
    ("texture unnamed", "\nTexture", 3, "Texture takes a name in quotes here, found nothing"),
    ("texture no file", 'Texture "t" "color" "imagemap"', 2, "Texture \"imagemap\" must have a parameter 'string filename'"),
    ("no image", f'{TEXTURE}\n"b.npy"', 3, "there is no file 'b.npy'"),
    ("not an image", f'{TEXTURE}\n"a.npy"\nMaterial "matte" "texture Kd" "t"\n{FIELD}', 3, "a.npy"),
    ("image outside", f'{TEXTURE}\n"../a.npy"', 3, "'../a.npy' lies outside the scene's folder"),
    ("no include", 'Include\n"b.pbrt"', 3, "there is no file 'b.pbrt'"),
    ("include a folder", 'Include\n"parts"', 3, "there is no file 'parts'"),
    ("include outside", 'Include\n"../scene.pbrt"', 3, "'../scene.pbrt' lies outside the scene's folder"),
    ("include absolute", 'Include\n"/etc/passwd"', 3, "'/etc/passwd' lies outside the scene's folder"),
    ("include itself", 'Include\n"scene.pbrt"', 3, '"scene.pbrt" includes itself'),
    ("include number", "Include\n4", 3, "Include takes a name in quotes, found 4"),
]

FILE_ERRORS = [
    ("empty", "", 1, "the file ends without a WorldBegin"),
    ("no world", f"{CAMERA}\n\n", 2, "the file ends without a WorldBegin"),
    ("no end", f"{CAMERA}\nWorldBegin\n{FIELD}\n", 2, "this WorldBegin has no WorldEnd"),
    ("nothing to see", f"{CAMERA}\nWorldBegin\nWorldEnd", 3, "there must be a Shape before WorldEnd"),
]


def cases(table):
    return [pytest.param(*case, id=name) for name, *case in table]


def assert_error(path: Path, where: Path, line: int, message: str):
    with pytest.raises(SceneError) as caught:
        load_pbrt(path)
    assert str(caught.value).startswith(f"{where}:{line}: ")
    assert message in str(caught.value)


@pytest.mark.parametrize(("options", "line", "message"), cases(OPTIONS_ERRORS))
def test_options_error(tmp_path, options, line, message):
    path = write(tmp_path, f"{options}\n{CAMERA} WorldBegin {FIELD} WorldEnd")
    assert_error(path, path, line, message)


@pytest.mark.parametrize(("world", "line", "message"), cases(WORLD_ERRORS))
def test_world_error(tmp_path, world, line, message):
    write(tmp_path, "not an image", "a.npy")
    (tmp_path / "parts").mkdir()
    path = write(tmp_path, f"{CAMERA} WorldBegin\n{world}\nWorldEnd\n")
    assert_error(path, path, line, message)


@pytest.mark.parametrize(("text", "line", "message"), cases(FILE_ERRORS))
def test_file_error(tmp_path, text, line, message):
    path = write(tmp_path, text)
    assert_error(path, path, line, message)


@pytest.mark.parametrize(("world", "line", "message"), cases(WORLD_ERRORS))
def test_an_error_names_the_included_file(tmp_path, world, line, message):
    write(tmp_path, "not an image", "a.npy")
    (tmp_path / "parts").mkdir()
    path = write(tmp_path, f'{CAMERA} WorldBegin\n\n\nInclude "part.pbrt"\nWorldEnd')
    part = write(tmp_path, f"# the line before\n{world}", "part.pbrt")
    assert_error(path, part.resolve(), line, message)


def test_includes_in_a_circle(tmp_path):
    first = write(tmp_path, '\nInclude "b.pbrt"', "a.pbrt")
    second = write(tmp_path, '\n\nInclude "a.pbrt"', "b.pbrt")
    assert_error(first, second.resolve(), 3, '"a.pbrt" includes itself')
    third = write(tmp_path, 'Include "b.pbrt"', "c.pbrt")
    assert_error(third, first.resolve(), 2, '"b.pbrt" includes itself')


def test_a_link_does_not_lead_out_of_the_folder(tmp_path):
    write(tmp_path, FIELD, "secret.pbrt")
    (tmp_path / "scene").mkdir()
    (tmp_path / "scene" / "link.pbrt").symlink_to(tmp_path / "secret.pbrt")
    path = write(tmp_path / "scene", f'{CAMERA} WorldBegin\nInclude "link.pbrt" WorldEnd')
    assert_error(path, path, 2, "'link.pbrt' lies outside the scene's folder")


@pytest.mark.parametrize("name", ["none.pbrt", "."])
def test_a_file_that_cannot_be_opened(tmp_path, name):
    with pytest.raises(SceneError, match=r": (No such file|Is a directory)"):
        load_pbrt(tmp_path / name)


# ---- the seed scenes

SEED_TABLE = [
    # name, size, samples, intensity, kinds of objects, shapes of heightfields
    ("hftest", 256, 4, 8, "m", [(4, 4)]),
    ("landsea-0", 400, 4, 15, "tmr", [(64, 64), (64, 64)]),
    ("landsea-1", 400, 4, 55, "tmr", [(64, 64), (64, 64)]),
    ("landsea-2", 400, 4, 15, "tmr", [(64, 64), (64, 64)]),
    ("landsea-big", 600, 4, 15, "tmr", [(64, 64), (1000, 1000)]),
    ("landsea-big64", 600, 64, 15, "tmr", [(64, 64), (1000, 1000)]),
    ("texture", 400, 4, 25, "t", [(64, 64)]),
]
# Least, greatest and mean height, as awk finds them in the files.
SEED_HEIGHTS = {
    (4, 4): (-0.5, -0.01, -0.1675),
    (64, 64): (-0.582939, 0.659307, 0.0367726),
    (1000, 1000): (-0.070355, 0.068715, 3.36e-10),
}


def kind_of(material: Matte | Mirror) -> str:
    """m: a matte colour, t: a matte texture, r: a mirror."""
    return "r" if isinstance(material, Mirror) else "m" if isinstance(material.albedo, np.ndarray) else "t"


@pytest.mark.skipif(not SEED_SCENES.is_dir(), reason=f"the seed scenes are not in {SEED_SCENES}")
@pytest.mark.parametrize(("name", "size", "samples", "intensity", "kinds", "shapes"), SEED_TABLE)
def test_seed_scene(name, size, samples, intensity, kinds, shapes):
    pytest.importorskip("OpenEXR", reason="the seed scenes' textures are .exr files")
    scene: Any = load_pbrt(SEED_SCENES / f"{name}.pbrt")
    assert (scene.camera.width, scene.camera.height, scene.samples) == (size, size, samples)
    assert "".join(kind_of(obj.material) for obj in scene.objects) == kinds
    np.testing.assert_array_equal([light.intensity for light in scene.lights], [[intensity] * 3])
    np.testing.assert_array_equal([light.p for light in scene.lights], [[0, 0, 0]])
    assert [field.heights.shape for field in scene.heightfields] == shapes
    for field in scene.heightfields:
        heights = np.asarray(field.heights, np.float64)
        statistics = heights.min(), heights.max(), heights.mean()
        np.testing.assert_allclose(statistics, SEED_HEIGHTS[heights.shape], rtol=2e-6, atol=1e-8)


@pytest.mark.skipif(not SEED_SCENES.is_dir(), reason=f"the seed scenes are not in {SEED_SCENES}")
def test_seed_scene_stands_where_pbrt_puts_it():
    pytest.importorskip("OpenEXR", reason="the seed scenes' textures are .exr files")
    # landsea-0's land: Translate -2 -.5 1, Rotate 85 about x, Scale 4 4 .4.
    scene: Any = load_pbrt(SEED_SCENES / "landsea-0.pbrt")
    land = scene.objects[1].world_from_object
    c, s = np.cos(np.radians(85)), np.sin(np.radians(85))
    expected = [[4, 0, 0, -2], [0, 4 * c, -0.4 * s, -0.5], [0, 4 * s, 0.4 * c, 1], [0, 0, 0, 1]]
    np.testing.assert_allclose(land, expected, atol=1e-15)
