"""Light on surfaces against closed forms: planes, walls, mirrors and a cylinder whose radiance can be written down by hand.

Where nothing else is said, grids have 5 x 9 heights and cells of 1 x 1, so the ground is 0..8 by 0..4, and the tolerance
stands for the rounding of some ten operations in float32.
"""

import aimed
import jax
import jax.numpy as jnp
import numpy as np
import oracle
import pytest

import jaxhf
from jaxhf.core.vector import rounded_clamp
from jaxhf.shade.radiance import _reflect

DEEP = pytest.mark.deep
ROUNDING = 4e-6
ALBEDO = np.array([0.2, 0.5, 0.8])
RADIANCE = np.array([1.0, 2.0, 3.0])
Y, X = np.mgrid[0:5, 0:9].astype(float)
FLAT = np.zeros((5, 9))
TILTED = 0.3 * X - 0.2 * Y
TILTED_NORMAL = np.array([-0.3, 0.2, 1.0]) / np.sqrt(1.13)
UP = np.array([0, 0, 1])


def ground(heights, material=None, **placement):
    material = jaxhf.Matte(ALBEDO) if material is None else material
    return jaxhf.Object(jaxhf.Heightfield(heights, **{"dx": 1.0, **placement}), material)


def vertical(x, y, extent, side=1, width=16, height=16):
    """A camera that looks straight down with the north up, or straight up (side -1); what it sees is `places`."""
    return jaxhf.Orthographic.look_at((x, y, 10 * side), (x, y, 0), (0, 1, 0), extent, width=width, height=height)


def places(x, y, extent, side=1, width=16, height=16):
    """Where the rays of `vertical` meet a horizontal plane, by hand: (h, w) each."""
    pixel = extent / min(width, height)
    east = x + side * (np.arange(width) + 0.5 - width / 2) * pixel
    north = y - (np.arange(height) + 0.5 - height / 2) * pixel
    return np.meshgrid(east, north)


def perspective(eye, target, fov=45.0, size=16):
    """A camera, and the unit directions of its rays by hand, shape (size, size, 3)."""
    camera = jaxhf.Perspective.look_at(eye, target, fov=fov, width=size, height=size)
    return camera, oracle.view_rays(eye, target, fov, size, size)


def from_point(p, n, light, intensity):
    """Irradiance from a point light at points p, shape (..., 3), with unit normals n; shape (..., 3)."""
    to = light - p
    distance = np.linalg.norm(to, axis=-1)
    cosine = np.abs((to * n).sum(-1)) / distance
    return intensity * (cosine / distance**2)[..., None]


@pytest.mark.parametrize("light_side", [1, -1])
@pytest.mark.parametrize("camera_side", [1, -1])
def test_plane_under_directional_light(camera_side, light_side):
    towards = light_side * np.array([0.3, 0.5, 0.8])
    lights = [jaxhf.Directional(7 * towards, RADIANCE)]  # the length of the vector does not matter
    image = jaxhf.render(jaxhf.Scene([ground(TILTED)], vertical(4, 2, 2, camera_side), lights))
    cosine = abs(towards @ TILTED_NORMAL) / np.linalg.norm(towards)
    expected = ALBEDO / np.pi * RADIANCE * cosine if light_side == camera_side else np.zeros(3)
    np.testing.assert_allclose(image, np.broadcast_to(expected, image.shape), rtol=ROUNDING)


def test_directions_from_azimuth_and_altitude():
    root = np.sqrt(0.5)
    azimuth, altitude, *towards = np.array(
        [(0, 0, 0, 1, 0), (90, 0, 1, 0, 0), (180, 0, 0, -1, 0), (123, 90, 0, 0, 1), (315, 45, -0.5, 0.5, root)]
    ).T
    made = [jaxhf.Directional.from_angles(*angles).towards for angles in zip(azimuth, altitude, strict=True)]
    np.testing.assert_allclose(np.transpose(made), towards, atol=1e-15)
    traced = jax.jit(jax.vmap(lambda a, h: jaxhf.Directional.from_angles(a, h).towards))(azimuth, altitude)
    np.testing.assert_allclose(traced.T, towards, atol=1e-6)
    default = jaxhf.Directional.from_angles()  # that of maps
    np.testing.assert_array_equal(default.towards, made[-1])
    np.testing.assert_array_equal(default.irradiance, np.full(3, np.pi))


def test_point_light_falls_off_with_the_square():
    p = np.array([3.0, 1.0, 2.0])
    image = jaxhf.render(jaxhf.Scene([ground(FLAT)], vertical(4, 2, 4), [jaxhf.Point(p, RADIANCE)]))
    x, y = places(4, 2, 4)
    expected = ALBEDO / np.pi * from_point(np.stack([x, y, 0 * x], -1), (0, 0, 1), p, RADIANCE)
    np.testing.assert_allclose(image, expected, rtol=ROUNDING)
    assert image.max() > 2 * image.min()


@pytest.mark.parametrize("side", [1, -1])
def test_sky(side):
    """Its colour is behind everything; a matte plane with slope beta sees (1 + cos beta) / 2 of it."""
    image = jaxhf.render(jaxhf.Scene([ground(TILTED)], vertical(4, 2, 12, side), [jaxhf.Sky(RADIANCE)]))
    x, y = places(4, 2, 12, side)
    met = ((x > 0) & (x < 8) & (y > 0) & (y < 4))[..., None]
    diffuse = ALBEDO * RADIANCE * (1 + side * TILTED_NORMAL[2]) / 2
    np.testing.assert_allclose(image, np.where(met, diffuse, RADIANCE), rtol=ROUNDING)
    assert 0 < met.mean() < 1


WALL = np.where(np.arange(33) < 3.5, 0.0, 1.0) * np.ones((17, 1))  # a plain, a wall between x = 3 and x = 4, a plateau


def shadows(heights, camera, light):
    """A picture of flat triangles, and where it is in shadow; one program for all lights of a kind."""
    scene = jaxhf.Scene([ground(heights)], camera, [light])
    image, aov = jaxhf.render(scene, jaxhf.Settings(shading="flat"), aovs=("shadow",))
    return np.asarray(image), np.asarray(aov["shadow"])[..., 0]


# The wall's upper edge is the line x = 4, z = 1. Seen from a light at slope 1/2, or from (6, *, 2), it lies over x = 2, z = 0.
BEHIND_WALL = {"directional": jaxhf.Directional((1, 0, 0.5)), "point": jaxhf.Point((6, 2.5, 2), 10.0)}


@pytest.mark.parametrize("extent", [3.97, 1e-2, pytest.param(1e-9, marks=(pytest.mark.x64, DEEP))])
@pytest.mark.parametrize("kind", BEHIND_WALL)
def test_wall_casts_a_shadow(kind, extent):
    light = BEHIND_WALL[kind]
    image, shadow = shadows(WALL, vertical(2, 1.99, extent), light)
    x, y = places(2, 1.99, extent)
    lit = x < 2
    np.testing.assert_array_equal(shadow, ~lit)
    p = np.stack([x, y, 0 * x], -1)
    if isinstance(light, jaxhf.Point):
        expected = ALBEDO / np.pi * from_point(p, UP, np.asarray(light.p), np.asarray(light.intensity))
    else:
        expected = np.broadcast_to(ALBEDO * np.sqrt(0.2), p.shape)
    np.testing.assert_allclose(image, np.where(lit[..., None], expected, 0), rtol=ROUNDING)


def test_light_before_the_wall_is_not_blocked():
    """Where most rays to it would go on into the wall; just before the wall's foot; above the plain."""
    x, y = places(1, 1.7, 1.9)
    for p in ((2.5, 2.0, 0.3), (2.999, 2.0, 0.5), (0.5, 1.0, 3.0)):
        image, shadow = shadows(WALL, vertical(1, 1.7, 1.9), jaxhf.Point(p, 10.0))
        assert not shadow.any()
        expected = ALBEDO / np.pi * from_point(np.stack([x, y, 0 * x], -1), UP, np.array(p), 10.0)
        np.testing.assert_allclose(image, expected, rtol=ROUNDING)


@pytest.mark.parametrize(
    "place", [(16, 16), (14.5, 18.25), *(pytest.param(place, marks=DEEP) for place in ((12, 20), (14.5, 18), (7.25, 21.5)))]
)
@aimed.PRECISIONS
def test_a_light_on_the_ground_is_not_behind_it(place, dtype):
    """In a bowl it lights all but the triangles that it stands on, whose planes it is in; just below the ground, nothing."""
    y, x = np.mgrid[:33, :33] - 16
    heights = ((x * x + y * y) / 64).astype(dtype)  # exact, and so on edges and in the middle of cells
    ix, iy = (int(value) for value in place)
    u, v = place[0] - ix, place[1] - iy
    (a, b), (c, d) = heights[iy : iy + 2, ix : ix + 2].astype(float)
    z = a + u * (b - a) + v * (d - b) if u > v else a + v * (c - a) + u * (d - c)

    def dark(height):
        made = jaxhf.Scene([ground(heights)], vertical(16, 16, 32, 1, 64, 64), [jaxhf.Point((*place, height))])
        return np.asarray(jaxhf.render(made, aovs=("shadow",))[1]["shadow"])[..., 0]

    east, north = places(16, 16, 32, 1, 64, 64)
    beside = (np.abs(np.floor(east) + 0.5 - place[0]) <= 1) & (np.abs(np.floor(north) + 0.5 - place[1]) <= 1)
    assert not (dark(z) & ~beside).any()
    assert dark(z - 1e-3).all()


def texture_by_hand(texels, u, v, wrap="repeat"):
    """Bilinear interpolation as a sum over all texels, each with a tent of width 1 about its centre."""

    def tents(position, count):
        place = position[..., None] * count - 0.5
        if wrap == "clamp":
            return np.maximum(0, 1 - np.abs(np.clip(place, 0, count - 1) - np.arange(count)))
        apart = np.abs(place - np.arange(count)) % count
        return np.maximum(0, 1 - np.minimum(apart, count - apart))

    return np.einsum("...i,...j,ijc->...c", tents(v, texels.shape[0]), tents(u, texels.shape[1]), texels)


TEXELS = 2e-5  # a place in the texture is rounded where it is 7 times its size


def test_texture_lookup():
    texels = np.random.default_rng(0).uniform(0.1, 1, (3, 4, 3))
    lookup = jax.vmap(jaxhf.ImageTexture(texels))
    rows, columns = np.mgrid[0:3, 0:4]
    centres = np.stack([(columns + 0.5) / 4, (rows + 0.5) / 3], -1).reshape(-1, 2)  # row 0 is v = 0, u runs along it
    for moved in ((0, 0), (5, -7)):
        np.testing.assert_allclose(lookup(jnp.asarray(centres + moved)), texels.reshape(-1, 3), rtol=TEXELS)
    corner = lookup(jnp.zeros((1, 2)))[0]  # between the four corners of the image, as it repeats
    np.testing.assert_allclose(corner, texels[[0, 0, -1, -1], [0, -1, 0, -1]].mean(0), rtol=TEXELS)
    uv = np.random.default_rng(1).uniform(-2, 2, (200, 2))
    np.testing.assert_allclose(lookup(jnp.asarray(uv)), texture_by_hand(texels, uv[:, 0], uv[:, 1]), rtol=TEXELS)
    # One that is clamped ends with its outermost texels; many places are on the border, and in its corners.
    uv[:100] = uv[:100].clip(0, 1)
    for shape in ((3, 4, 3), (1, 1, 3), (1, 5, 3)):
        texels = np.random.default_rng(0).uniform(0.1, 1, shape)
        found = jax.vmap(jaxhf.ImageTexture(texels, wrap="clamp"))(jnp.asarray(uv))
        np.testing.assert_allclose(found, texture_by_hand(texels, uv[:, 0], uv[:, 1], "clamp"), rtol=TEXELS)


@pytest.mark.parametrize("wrap", ["repeat", pytest.param("clamp", marks=DEEP)])
def test_texture_lies_on_the_ground(wrap):
    texels = np.random.default_rng(2).uniform(size=(4, 6, 3))
    textured = ground(FLAT, jaxhf.Matte(jaxhf.ImageTexture(texels, wrap=wrap)))
    scene = jaxhf.Scene([textured], vertical(4, 2, 4, width=32), [jaxhf.Directional(UP, np.pi)])
    x, y = places(4, 2, 4, width=32)
    np.testing.assert_allclose(jaxhf.render(scene), texture_by_hand(texels, x / 8, y / 4, wrap), rtol=TEXELS)


def test_inside_a_textured_cylinder():
    texels = np.random.default_rng(3).uniform(size=(4, 6, 3))
    shape = jaxhf.Cylinder(radius=2, z_min=-1, z_max=3)
    eye, light = np.array([0.3, -0.2, 0.5]), np.array([0.1, 0.2, 1.5])
    camera, d = perspective(eye, (2, 0.2, 0.9), fov=100)  # towards the seam, phi = 0
    scene = jaxhf.Scene([jaxhf.Object(shape, jaxhf.Matte(jaxhf.ImageTexture(texels)))], camera, [jaxhf.Point(light, RADIANCE)])
    image, aov = jaxhf.render(scene, aovs=("uv", "status"))

    a, b, c = (d[..., :2] ** 2).sum(-1), d[..., :2] @ eye[:2], eye[:2] @ eye[:2] - 4
    t = (-b + np.sqrt(b * b - a * c)) / a
    p = eye + t[..., None] * d
    met = (p[..., 2] > -1) & (p[..., 2] < 3)
    u, v = np.arctan2(p[..., 1], p[..., 0]) / (2 * np.pi) % 1, (p[..., 2] + 1) / 4
    n = p * [0.5, 0.5, 0]
    expected = texture_by_hand(texels, u, v) / np.pi * from_point(p, n, light, RADIANCE)
    np.testing.assert_array_equal(aov["status"], np.where(met, jaxhf.Status.HIT, jaxhf.Status.MISS))
    np.testing.assert_allclose(aov["uv"], np.where(met[..., None], np.stack([u, v], -1), 0), rtol=ROUNDING, atol=ROUNDING)
    np.testing.assert_allclose(image, np.where(met[..., None], expected, 0), rtol=1e-4)  # rounding of u, times the texels
    assert 0.5 < met.mean() < 1
    assert u[met].min() < 0.1
    assert u[met].max() > 0.9


LOWER, UPPER = np.array([0.9, 0.8, 0.5]), np.array([0.7, 0.6, 0.3])


def parallel_mirrors(camera):
    """Two horizontal mirrors, at z = 0 and z = 1, that face each other."""
    mirrors = [ground(FLAT, jaxhf.Mirror(LOWER)), ground(FLAT + 1, jaxhf.Mirror(UPPER))]
    return jaxhf.Scene(mirrors, camera, [jaxhf.Sky(RADIANCE)])


@pytest.mark.parametrize("max_depth", [pytest.param(0, marks=DEEP), pytest.param(1, marks=DEEP), 4])
def test_max_depth_ends_what_parallel_mirrors_reflect(max_depth):
    eye = np.array([0.1, 2.0, 0.5])
    camera, d = perspective(eye, (3.0, 2.1, 0.4), fov=80)
    image = jaxhf.render(parallel_mirrors(camera), jaxhf.Settings(max_depth=max_depth))
    # Unfolded, the ray goes straight on until it is over the mirrors' border, and passes the heights 1/2 + k.
    leaves = np.minimum((8 - eye[0]) / d[..., 0], (np.where(d[..., 1] > 0, 4, 0) - eye[1]) / d[..., 1])
    bounces = np.floor(leaves * np.abs(d[..., 2]) + 0.5)
    first, second = np.where(d[..., 2:] < 0, LOWER, UPPER), np.where(d[..., 2:] < 0, UPPER, LOWER)
    left = first ** np.ceil(bounces / 2)[..., None] * second ** np.floor(bounces / 2)[..., None] * RADIANCE
    np.testing.assert_allclose(image, np.where(bounces[..., None] <= max_depth, left, 0), rtol=ROUNDING)
    assert bounces.max() > 4
    assert set(range(5)) < set(bounces.ravel())


def test_mirror_shows_a_wall():
    tilt = np.array([-0.1, 0.05, 1.0]) / np.linalg.norm([-0.1, 0.05, 1.0])
    floor = ground(0.1 * X - 0.05 * Y, jaxhf.Mirror(UPPER))
    upright = np.array([[1, 0, 0, 0], [0, 0, -1, 4], [0, 1, 0, 0], [0, 0, 0, 1.0]])  # the object's y is up; it stands at y = 4
    wall = jaxhf.Object(jaxhf.Heightfield(FLAT, dx=1.0), jaxhf.Matte(ALBEDO), upright)
    eye, light = np.array([4, 0.5, 2]), np.array([3, 1, 3])
    camera, d = perspective(eye, (4, 2.5, 0.3), fov=25)
    image = jaxhf.render(jaxhf.Scene([floor, wall], camera, [jaxhf.Point(light, RADIANCE)]))

    mirrored_at = eye - ((eye @ tilt) / (d @ tilt))[..., None] * d  # the floor's plane contains the origin
    out = d - 2 * (d @ tilt)[..., None] * tilt
    p = mirrored_at + ((4 - mirrored_at[..., 1]) / out[..., 1])[..., None] * out
    assert np.all((p > (0, 3.9, 0.1)) & (p < (8, 4.1, 4)))
    expected = UPPER * ALBEDO / np.pi * from_point(p, np.array([0, 1, 0]), light, RADIANCE)
    np.testing.assert_allclose(image, expected, rtol=ROUNDING)


def test_a_shading_normal_has_a_dark_side():
    """By hand at every pixel, with a light at the eye: also where the triangle faces it, its normals do not."""
    heights, eye = np.random.default_rng(4).normal(0, 1.5, (5, 5)), np.array([-1.0, -2.0, 4.0])  # steep terrain
    camera, d = perspective(eye, (2, 2, 0), fov=50, size=32)
    scene = jaxhf.Scene([ground(heights, jaxhf.Matte(1.0))], camera, [jaxhf.Point(eye, 20.0)])
    image, aov = jaxhf.render(scene, aovs=("normal", "status", "depth"))
    met = np.asarray(aov["status"]) == jaxhf.Status.HIT
    rays = np.broadcast_to(eye, d.shape).reshape(-1, 3), d.reshape(-1, 3)
    n = oracle.cast(heights, 1, 1, 0, 0, *rays).place.n.reshape(d.shape)
    side = -np.sign((n * d).sum(-1))
    cosine = side * (np.asarray(aov["normal"]) * -d).sum(-1)
    rounded = np.where(abs(cosine) < 0.01, 25 * (cosine + 0.01) ** 2, np.maximum(cosine, 0))
    with np.errstate(divide="ignore"):
        expected = np.where(met, 20 / np.pi / np.asarray(aov["depth"]) ** 2 * rounded, 0)
    np.testing.assert_allclose(image, np.broadcast_to(expected[..., None], image.shape), rtol=1e-4, atol=1e-5)
    assert (met & (cosine < -0.01)).sum() > 10
    assert (side[met] < 0).sum() > 10


@pytest.mark.parametrize(
    ("side", "make"), [(1, jaxhf.Directional), (-1, jaxhf.Directional), pytest.param(1, jaxhf.Sun, marks=DEEP)]
)
def test_coarse_cells_are_dark_beyond_the_terminator(side, make):
    """Across a round hill radiance falls to zero, and stays there: triangles that still face the light are no bright rim."""
    s = np.linspace(-0.5, 0.5, 33)
    hill = side * 0.2 * np.exp(-(s**2 + s[:, None] ** 2) / 0.045)
    camera = jaxhf.Orthographic.look_at((0.5, 0.5, 2 * side), (0.5, 0.5, 0), (0, 1, 0), 1 / 32, width=128, height=4)
    light = make(jaxhf.Directional.from_angles(270, 8).towards * (1, 1, side), 1.0)
    image = jaxhf.render(jaxhf.Scene([ground(hill, jaxhf.Matte(1.0), dx=1 / 32)], camera, [light]), jaxhf.Settings(samples=16))
    row = np.asarray(image)[1, ::side, 0]
    assert row[60] > 0.1
    assert np.diff(row[64:]).max() < 1e-7
    assert row[72] == 0


def test_rounded_clamp():
    """max(x, 0) but for |x| < 0.01; there the parabola that continues it in value and in slope, 0.0025 at zero."""
    x = np.concatenate([np.linspace(-1, 1, 2000), np.linspace(-0.02, 0.02, 2001)]).astype(np.float32).astype(np.float64)
    value, slope = (np.asarray(values) for values in jax.vmap(jax.value_and_grad(rounded_clamp))(jnp.asarray(x)))
    within = np.abs(x) < 0.01
    np.testing.assert_allclose(value, np.where(within, 25 * (x + 0.01) ** 2, np.maximum(x, 0)), rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(slope, np.where(within, 50 * (x + 0.01), x > 0), atol=1e-6)
    assert value[np.abs(x) > 0.0101].tolist() == np.maximum(x, 0)[np.abs(x) > 0.0101].tolist()


def test_mirrored_ray_never_enters_its_triangle():
    rng = np.random.default_rng(6)

    def units():
        v = rng.normal(size=(20_000, 3))
        return v / np.linalg.norm(v, axis=1)[:, None]

    d, n, ns = units(), units(), units()
    d[:100] = np.cross(n[:100], ns[:100])  # grazing
    ns[100:5000] = n[100:5000] + 0.1 * ns[100:5000]  # as most are: near the triangle's own
    ns /= np.linalg.norm(ns, axis=1)[:, None]
    d, n, ns = (v.astype(np.float32).astype(np.float64) for v in (d, n, ns))
    side = np.where((d * n).sum(1) < 0, 1, -1)
    zero, whole = jnp.zeros(3), jnp.zeros((), jnp.int32)

    @jax.jit
    @jax.vmap
    def reflected(d, n, ns, side):
        hit = jaxhf.Hit(
            status=whole, object=whole, t=zero[0], p=zero, n=n, ns=ns, uv=zero[:2], dp_du=zero, dp_dv=zero, dn_du=zero,
            dn_dv=zero, cell=jnp.zeros(2, jnp.int32), triangle=whole, side=side,
        )  # fmt: skip
        return _reflect(d, hit)

    out = np.asarray(reflected(*map(jnp.asarray, (d, n, ns, side))), np.float64)
    height = side * (out * n).sum(1)
    assert height.min() > 0
    np.testing.assert_allclose(np.linalg.norm(out, axis=1), 1, rtol=ROUNDING)
    mirrored = d - 2 * (d * ns).sum(1)[:, None] * ns
    high = side * (mirrored * n).sum(1) > 0.01 + ROUNDING
    np.testing.assert_allclose(out[high], mirrored[high], atol=ROUNDING)
    assert 0.1 < high.mean() < 0.9
