"""What a scene is made of: which values are refused, and in which words; defaults; the normals at vertices."""

import functools
import re
from typing import Any

import aimed
import jax
import jax.numpy as jnp
import numpy as np
import oracle
import pytest
from compare import heightfield

import jaxhf
from jaxhf.preparation.localise import localise

NAN, INF = np.nan, np.inf
GRID = np.zeros((2, 3))
FIELD = jaxhf.Heightfield(GRID)
OBJECT = jaxhf.Object(FIELD)
CAMERA = jaxhf.Perspective(np.eye(4))
ANYTHING: Any = jaxhf  # the constructors as a program without type annotations uses them


def matrix(**entries):
    """The identity but for some entries, m03=... being that of row 0 and column 3."""
    values = np.eye(4)
    for name, value in entries.items():
        values[int(name[1]), int(name[2])] = value
    return values


def made(kind: str, *arguments, **named):
    return lambda: getattr(ANYTHING, kind)(*arguments, **named)


field, settings, light = (functools.partial(made, kind) for kind in ("Heightfield", "Settings", "Directional"))
texture, cylinder = (functools.partial(made, kind) for kind in ("ImageTexture", "Cylinder"))


def field_of_size(dx):
    return ANYTHING.Heightfield(GRID, dx=dx).heights


def placed(world):
    return made("Object", FIELD, None, world)


def look_at(*arguments):
    return lambda: ANYTHING.Perspective.look_at(*arguments)


def perspective(world=None, **arguments):
    return made("Perspective", np.eye(4) if world is None else world, **arguments)


def intrinsics(fx: Any = 40, fy: Any = 50, cx: Any = 20, cy: Any = 30, **arguments):
    return lambda: ANYTHING.Perspective.from_intrinsics(
        fx, fy, cx, cy, **{"world_from_camera": np.eye(4), "width": 32, "height": 24, **arguments}
    )


def scene(objects: Any = (OBJECT,), camera: Any = CAMERA, lights: Any = (), **arguments):
    return made("Scene", objects, camera, lights, **arguments)


# What is made, and what the message says: the place, the rule, the value.
BAD = [
    (field(np.zeros((1, 5))), "Heightfield: heights must have shape (ny, nx) of at least 2x2, theirs is (1, 5)"),
    (field(np.zeros((0, 3))), "Heightfield: heights must have shape (ny, nx) of at least 2x2, theirs is (0, 3)"),
    (field(np.zeros((2, 2, 2))), "Heightfield: heights must have shape (ny, nx) of at least 2x2, theirs is (2, 2, 2)"),
    (lambda: jax.jit(field_of_size)(1.0), "Heightfield: dx must be known when programs are compiled, it is traced by JAX"),
    (field(GRID, dx=0.0), "Heightfield: dx must be positive and finite, it is 0.0"),
    (field(GRID, dx=1.0, dy=INF), "Heightfield: dy must be positive and finite, it is inf"),
    (field(GRID, x0=NAN), "Heightfield: x0 must be finite, it is nan"),
    (field(GRID, y0=-INF), "Heightfield: y0 must be finite, it is -inf"),
    (field(np.zeros((2, 2), bool)), "Heightfield: heights must be an array of real numbers, they are bool"),
    (field([[1, 2], [3]]), "Heightfield: heights must be an array of real numbers, they are a list"),
    (field(jaxhf.Terrain(GRID)), "Heightfield: heights must be an array of real numbers, they are a Terrain: take its .height"),
    (placed(np.zeros((4, 4))), "Object: world_from_object must be affine (last row 0 0 0 1), its last row is [0.0, 0"),
    (placed(matrix(m10=2, m11=0, m01=0)), "Object: world_from_object must be invertible, it flattens space: "),
    (placed(matrix(m03=NAN)), "Object: world_from_object must be finite, it is "),
    (placed(np.eye(3)), "Object: world_from_object must be a 4x4 matrix, its shape is (3, 3)"),
    (made("Object", GRID), "Object: shape must be a Heightfield, Cylinder or Skirt, it is a ndarray"),
    (made("Object", FIELD, 0.7), "Object: material must be a Material or a Mirror, it is a float"),
    (made("Matte", NAN), "Matte: albedo must be finite, it is [nan, nan, nan]"),
    (made("Mirror", [0, INF, 0]), "Mirror: reflectance must be finite, it is [0.0, inf, 0.0]"),
    (texture(np.ones(2)), "ImageTexture: texels must have shape (h, w, 3) or (h, w), theirs is (2,)"),
    (texture(np.ones((2, 2, 3)), wrap="black"), "ImageTexture: wrap must be one of repeat, clamp; it is"),
    (texture(np.zeros((2, 2, 3), np.uint8)), "ImageTexture: texels must hold linear colours in floats, 1 being white; theirs"),
    (texture(np.full((2, 2, 3), NAN)), "ImageTexture: texels must be finite"),
    (light([0, 0, 0]), "Directional: towards must not be zero, it is [0, 0, 0]"),
    (light([0, NAN, 1]), "Directional: towards must be finite, it is [0.0, nan, 1.0]"),
    (light([0, 0, 1], [1, 2]), "Directional: irradiance must be one number or three, its shape is (2,)"),
    (lambda: jaxhf.Directional.from_angles(NAN), "Directional: towards must be finite, it is "),
    (made("Point", [1, 2, INF]), "Point: p must be finite, it is [1.0, 2.0, inf]"),
    (perspective(fov=180), "Perspective: fov must lie between 0 and 180 degrees, it is 180.0"),
    (perspective(fov=[30, 40]), "Perspective: fov must be one number"),
    (perspective(height=0), "Perspective: height must be a whole number of pixels from 1 on, it is 0"),
    (perspective(np.eye(3)), "Perspective: world_from_camera must be a 4x4 matrix, its shape is (3, 3)"),
    (perspective(matrix(m11=0)), "Perspective: world_from_camera must be invertible, it flattens space: "),
    (intrinsics(fx=0), "from_intrinsics: fx must be positive and finite, it is 0.0"),
    (intrinsics(cy=NAN), "from_intrinsics: cy must be finite, it is nan"),
    (intrinsics(convention="blender"), "from_intrinsics: convention must be one of opencv, opengl; it is 'blender'"),
    (intrinsics(world_from_camera=matrix(m11=-1)), "from_intrinsics: world_from_camera must rotate without scaling or"),
    (made("Orthographic", np.eye(4), extent=INF), "Orthographic: extent must be positive and finite, it is inf"),
    (look_at((1, 2, 3), (1, 2, 3)), "look_at: target must differ from eye, both are [1.0, 2.0, 3.0]"),
    (look_at((0, 0, 5), (0, 0, 0)), "look_at: up must not point along the view, it is [0.0, 0.0, 1.0] for the view"),
    (look_at((0, 0, 0), (1, 0)), "look_at: target must hold three numbers, its shape is (2,)"),
    (scene(objects=[]), "Scene: objects must hold at least one Object, it is empty"),
    (scene(camera="front"), "Scene: camera does not take a str"),
    (scene(lights=[CAMERA]), "Scene: lights does not take a Perspective"),
    (scene(lights=[jaxhf.Sky(1), jaxhf.Sky(2)]), "Scene: lights may hold one Sky, they hold more"),
    (lambda: scene()().with_lights([CAMERA]), "Scene: lights does not take a Perspective"),
    (lambda: scene()().with_camera("front"), "Scene: camera does not take a str"),
    (settings(traversal="fast"), "Settings: traversal must be one of "),
    (settings(normals="five"), "Settings: normals must be one of central, four, six, six-angle, six-equal; it is 'five'"),
    (settings(shadows=1), "Settings: shadows must be True or False, it is 1"),
    (settings(max_steps=2.0), "Settings: max_steps must be a whole number from 1 on, it is 2.0"),
    (settings(samples=8), "Settings: samples must be a square number (1, 4, 9, ...), it is 8"),
    (settings(chunk=63), "Settings: chunk must be a whole number from 64 on, it is 63"),
    (settings(chunk=10**8), "Settings: chunk must be at most 1048576, it is 100000000; with 1024, the default,"),
    (cylinder(radius=0), "Cylinder: radius must be positive and finite, it is 0.0"),
    (cylinder(z_min=1, z_max=1), "Cylinder: z_min must lie below z_max, they are 1.0 and 1.0"),
    (cylinder(z_min=-INF), "Cylinder: z_min must be finite"),
]  # fmt: skip


@pytest.mark.parametrize(("make", "message"), BAD, ids=[message[:70] for _, message in BAD])
def test_bad_input_is_refused(make, message, as_users_call_it):
    with pytest.raises(jaxhf.ArgumentError, match=f"^{re.escape(message)}") as refused:
        make()
    assert refused.value.argument == message.partition(": ")[2].partition(" ")[0]


@pytest.mark.parametrize(
    ("arguments", "spacing"),
    [({}, (1 / 4, 1 / 2)), ({"dx": 3.0}, (3, 3)), ({"dy": 2.0}, (2, 2)), ({"dx": 3.0, "dy": 2.0}, (3, 2))],
)
def test_cell_size(arguments, spacing):
    """Nothing given: pbrt's unit square. One of the two alone counts for both."""
    made = jaxhf.Heightfield(np.zeros((3, 5)), **arguments)
    assert (made.dx, made.dy, made.x0, made.y0) == (*spacing, 0, 0)


def test_no_more_cells_than_can_be_traced():
    """Shapes alone: as many as 2^28, each side rounded up to a power of two, and a few more."""

    def shape_of(ny, nx):
        heights = jax.ShapeDtypeStruct((ny, nx), jnp.float32)
        return jax.eval_shape(lambda z: jaxhf.cast(jaxhf.Heightfield(z), (0.5, 0.5, 9.0), (0, 0, -1.0)).t, heights).shape

    for ny, nx in ((11520, 16385), (2, 2**27 + 1)):
        assert shape_of(ny, nx) == ()
    for ny, nx, padded in ((11520, 23040, "16384 x 32768"), (2, 2**27 + 2, "2 x 268435456")):
        message = f"at most 2**28 cells, each side rounded up to a power of two; shape {(ny, nx)}"
        with pytest.raises(ValueError, match=re.escape(message) + f" makes {padded}\\b"):
            shape_of(ny, nx)


def test_whole_numbers_in_jax_become_floats():
    """Whatever moves them later would lose its fractions: a light beside a grid whose corner becomes the origin."""
    for dtype in (jnp.int32, jnp.uint8, bool):
        three, square = jnp.array([0, 0, 1], dtype), jnp.eye(4).astype(dtype)
        leaves: tuple[Any, ...] = (
            jaxhf.Point(three, three).p, jaxhf.Point(three, three).intensity, jaxhf.Directional(three, three).irradiance,
            jaxhf.Matte(three).albedo, jaxhf.Matte(jnp.array(1, dtype)).albedo, jaxhf.Cylinder(jnp.array(1, dtype)).radius,
            jaxhf.Object(FIELD, None, square).world_from_object, jaxhf.Perspective(square).world_from_camera,
        )  # fmt: skip
        assert {leaf.dtype for leaf in leaves} == {np.dtype(np.float32)}
        np.testing.assert_array_equal(leaves[0], (0, 0, 1))
    shifted = jaxhf.Object(jaxhf.Heightfield(GRID, x0=0.5, y0=0.25))
    (point,) = localise(jaxhf.Scene([shifted], CAMERA, [jaxhf.Point(jnp.array([0, 0, 5]))])).lights
    assert isinstance(point, jaxhf.Point)
    np.testing.assert_array_equal(point.p, (-0.5, -0.25, 5))


SHOWN = [
    (jaxhf.Perspective.look_at((4.5e6 + 0.25, 0, 2), (4.5e6 + 0.25, 0, 0), up=(0, 1, 0), width=640, height=480),
     "Perspective(eye=(4500000.25, 0, 2), looking=(0, 0, -1), fov=45, 640 x 480)"),
    (jaxhf.Orthographic(np.eye(4), 1 / 63), "Orthographic(eye=(0, 0, 0), looking=(0, 0, 1), extent=0.0159, 512 x 512)"),
    (jaxhf.Directional((0, 0.5, 1)), "Directional(towards=(0, 0.5, 1), irradiance=(3.142, 3.142, 3.142))"),
    (jaxhf.Point(jnp.array([1, 2, 3])), "Point(p=(1, 2, 3), intensity=(1, 1, 1))"),
    (jaxhf.Sky(1e-5), "Sky(radiance=(1e-05, 1e-05, 1e-05))"),
    (jaxhf.Matte(jaxhf.ImageTexture(jnp.ones((2, 4, 3)))), "Matte(albedo=ImageTexture(texels=f32[2,4,3]))"),
    (CAMERA, "Perspective(eye=(0, 0, 0), looking=(0, 0, 1), fov=45, 512 x 512)"),
    (OBJECT, "Object(Heightfield(2 x 3, dx=0.5, dy=1, x0=0, y0=0, heights 0 .. 0), Matte(albedo=(0.7, 0.7, 0.7)))"),
    (jaxhf.Mirror(), "Mirror(reflectance=(0.9, 0.9, 0.9))"),
    (jaxhf.Cylinder(), "Cylinder(radius=1, z_min=-1, z_max=1)"),
    (jaxhf.Heightfield([[300, NAN, 900], [1, 2, 3]], dx=30.0, x0=7.0),
     "Heightfield(2 x 3, dx=30, dy=30, x0=7, y0=0, heights 1 .. 900)"),
    (jaxhf.Heightfield(np.full((2, 2), NAN)), "Heightfield(2 x 2, dx=1, dy=1, x0=0, y0=0, heights nan .. nan)"),
]  # fmt: skip


@pytest.mark.parametrize(("part", "text"), SHOWN, ids=[text.partition("(")[0] for _, text in SHOWN])
def test_parts_print_their_numbers(part, text):
    assert repr(part) == text


K = np.array([[70.0, 0, 27.3], [0, 55, 31.9], [0, 0, 1]])  # its principal point is off the middle, its pixels are not square


def by_k_r_t(points, rotation, t):
    """Pixels and depths of world points by K [R | t] (Hartley and Zisserman 2004, equation 6.8): x right, y down, z forward."""
    seen = points @ rotation.T + t
    return (seen @ K.T)[..., :2] / seen[..., 2:], seen[..., 2]


def calibrated(rotation, t, convention="opencv", width=64, height=48, fx=K[0, 0]):
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation.T, -rotation.T @ t
    if convention == "opengl":
        pose[:3, 1:3] *= -1
    return jaxhf.Perspective.from_intrinsics(
        fx, K[1, 1], K[0, 2], K[1, 2], world_from_camera=pose, width=width, height=height, convention=convention
    )


@pytest.mark.parametrize("convention", ["opencv", "opengl"])
@pytest.mark.parametrize("size", [(64, 48), (48, 64)])
def test_cameras_from_intrinsics_project_as_k_r_t(convention, size):
    """A pixel's ray passes through the points that are projected to it, and back."""
    rng = np.random.default_rng(4)
    rotation, _ = np.linalg.qr(rng.standard_normal((3, 3)))
    rotation *= np.linalg.det(rotation)
    t, points = np.array([0.3, -0.2, 4.0]), rng.uniform(-1, 1, (20, 3))
    (pixels, z), eye = by_k_r_t(points, rotation, t), -rotation.T @ t
    camera = calibrated(rotation, t, convention, *size)
    ray = jax.vmap(camera.ray)(*pixels.T)
    np.testing.assert_allclose(ray.o, np.broadcast_to(eye, (20, 3)), atol=1e-6)
    np.testing.assert_allclose(ray.d, units(points - eye), atol=1e-6)
    x, y, w, depth = np.asarray(jax.vmap(camera.film_from_world())(jnp.asarray(points))).T
    np.testing.assert_allclose(np.stack([x, y]) / w, pixels.T, atol=1e-4)  # float32 at 64 has steps of 8e-6
    np.testing.assert_allclose(depth, z, rtol=1e-6)
    assert camera.world_from_camera.dtype == np.float64
    traced = jax.jit(lambda fx: calibrated(rotation, t, convention, *size, fx=fx))(K[0, 0])
    np.testing.assert_allclose(traced.world_from_camera, camera.world_from_camera, atol=1e-6)
    np.testing.assert_allclose(traced.fov, camera.fov, rtol=1e-6)


def test_a_picture_through_intrinsics_shows_points_at_their_pixels():
    """What each pixel of a picture shows, projected by hand, is at the pixel's middle, half a pixel from its corner."""
    ground = aimed.Ground(aimed.random_heights((17, 17), 0.5, seed=2), dx=0.5, dy=0.5, x0=-4.0, y0=-4.0)
    a, b = np.radians([35, 200])  # pitched, and turned about the vertical
    pitch = np.array([[1, 0, 0], [0, -np.sin(a), -np.cos(a)], [0, np.cos(a), -np.sin(a)]])
    rotation = pitch @ np.array([[np.cos(b), -np.sin(b), 0], [np.sin(b), np.cos(b), 0], [0, 0, 1]])
    camera = calibrated(rotation, t := np.array([0.3, -0.2, 9.0]))
    shown = jaxhf.Scene([jaxhf.Object(heightfield(ground, np.float32))], camera)
    _, aovs = jaxhf.render(shown, jaxhf.Settings(shading="flat"), aovs=("status", "uv", "depth"))
    met = np.asarray(aovs["status"]) == jaxhf.Status.HIT
    points = ground.points(*(16 * np.asarray(aovs["uv"], float)[met]).T)
    middles = np.stack(np.meshgrid(np.arange(64) + 0.5, np.arange(48) + 0.5), axis=-1)[met]
    np.testing.assert_allclose(by_k_r_t(points, rotation, t)[0], middles, atol=2e-3)
    np.testing.assert_allclose(aovs["depth"][met], np.linalg.norm(points + rotation.T @ t, axis=1), rtol=1e-5)
    assert 0.3 < met.mean() < 0.95


def test_a_scene_prints_whatever_its_leaves_are():
    """Traced, batched, shapes alone, nothing: a message about them must not end in another error."""
    made = jaxhf.Scene([OBJECT, jaxhf.Object(jaxhf.Cylinder(), jaxhf.Mirror(), np.eye(4))], CAMERA, [jaxhf.Sky(1)])
    assert repr(made).startswith("Scene(objects=(Object(Heightfield(2 x 3,")
    seen = []

    @jax.jit
    def traced(scene):
        seen.append(repr(scene))
        return jax.vmap(lambda scene: seen.append(repr(scene)) or 0)(jax.tree.map(lambda leaf: leaf[None], scene))

    traced(jax.tree.map(jnp.asarray, made))
    seen += [repr(jax.tree.map(lambda leaf, to=to: to, made)) for to in (None, True, object())]
    seen.append(repr(jax.eval_shape(lambda: jax.tree.map(jnp.asarray, made))))
    deleted = jax.tree.map(jnp.array, made)
    for leaf in jax.tree.leaves(deleted):
        leaf.delete()
    seen.append(repr(deleted))
    assert "Heightfield(f32[2,3], dx=0.5, dy=1, x0=0, y0=0)" in seen[0]
    assert "Perspective(world_from_camera=f32[4,4], fov=f32[], 512 x 512)" in seen[-1]
    assert all(text.startswith("Scene(") for text in seen)


def test_a_scene_with_another_camera_or_light():
    made = jaxhf.Scene([OBJECT], CAMERA, [jaxhf.Sky(1)], samples=4)
    other, light = jaxhf.Orthographic(np.eye(4)), jaxhf.Point((1, 2, 3))
    changed = made.with_camera(other).with_lights([light])
    assert changed.camera is other
    assert changed.lights == (light,)
    assert (changed.objects, changed.samples) == (made.objects, 4)


def test_positions_keep_double_precision():
    """Python and NumPy numbers stay NumPy float64 until the origin has moved; JAX arrays stay as they are."""
    light = jaxhf.Point((5e6 + 0.125, 0, 0))
    assert isinstance(light.p, np.ndarray)
    assert light.p[0] == 5e6 + 0.125
    assert jaxhf.Point(jnp.ones(3)).p.dtype == jnp.float32


def test_heights_of_a_scene():
    first, second = jaxhf.Heightfield(np.zeros((2, 3))), jaxhf.Heightfield(np.ones((4, 4)), dx=2.0)
    objects = [jaxhf.Object(jaxhf.Cylinder()), jaxhf.Object(first), jaxhf.Object(second)]
    given = jaxhf.Scene(objects, CAMERA, [jaxhf.Sky(1)], samples=4)
    assert given.heightfields == (first, second)
    assert given.heights is first.heights
    changed = given.with_heights([[1, 2, 3], [4, 5, 6]])
    np.testing.assert_array_equal(changed.heights, [[1, 2, 3], [4, 5, 6]])
    assert changed.heightfields[1].heights is second.heights
    assert (changed.lights, changed.samples) == (given.lights, 4)
    assert not given.heights.any()
    without = jaxhf.Scene(objects[:1], CAMERA)
    assert without.heightfields == ()
    for asked in (lambda: without.heights, lambda: without.with_heights(GRID)):
        with pytest.raises(ValueError, match="Scene: there is no heightfield among its objects"):
            asked()


def units(vectors):
    vectors = np.asarray(vectors)
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


@pytest.mark.parametrize("scheme", ["central", "four", "six", "six-angle", "six-equal"])
def test_normals_at_vertices_are_the_oracles(scheme):
    """In the middle and on the border, beside holes of every kind, at a vertex alone among them, and of the smallest field."""
    heights = np.random.default_rng(3).uniform(0, 1, (9, 11)).astype(np.float32)
    heights[0, 0], heights[2, 3], heights[4, 9] = NAN, INF, -INF
    heights[5:8, 1:4][np.arange(9).reshape(3, 3) != 4] = NAN
    for z in (heights, heights[7:, 6:8]):
        found = jaxhf.vertex_normals(jnp.asarray(z), 0.5, 2.0, scheme)
        expected, _ = oracle.vertex_normals(z, 0.5, 2.0, scheme)
        np.testing.assert_allclose(units(found), units(expected), atol=1e-6)
        assert np.isfinite(z).sum() in (4, 88)


def test_a_camera_takes_its_size_by_place():
    for kind in (jaxhf.Perspective, jaxhf.Orthographic):
        assert repr(kind(np.eye(4), 45.0, 8, 6)) == repr(kind(np.eye(4), 45.0, width=8, height=6))


def test_a_traced_up_looks_like_a_known_one():
    """Any warning is an error: NumPy's numbers beside it are in double precision."""
    eye, target, up = (0.5, -1.0, 1.0), (0.5, 0.5, 0.0), (0.1, 0.0, 1.0)
    looking = jax.jit(lambda up: jaxhf.Perspective.look_at(eye, target, up).world_from_camera)(jnp.asarray(up))
    np.testing.assert_allclose(looking, jaxhf.Perspective.look_at(eye, target, up).world_from_camera, atol=1e-6)
