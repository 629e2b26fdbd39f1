"""Values and derivatives of all that is differentiable, where its domain ends: finite in single precision, and right.

Right is what double precision says, where the squares of these numbers are far from its smallest; or, where a change of units
changes nothing, what other units say.
"""

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxhf
from jaxhf import mujoco
from jaxhf.core.vector import angle, quotient, time_to, unit

PIXELS = 8
HEIGHTS = np.random.default_rng(0).uniform(0, 0.2, (9, 9))
TEXTURE = jaxhf.ImageTexture(np.random.default_rng(1).uniform(0.2, 0.9, (3, 4, 3)))
BELOW = 0.2
TINY = (1e-9, 3e-10, 6e-17, 1e-19, 1e-20, 1e-30, 1e-37)


def in_precision(tree: Any, dtype: Any) -> Any:
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype), tree)


@functools.cache
def gradient(fun: Callable[..., jax.Array]) -> Callable[[Any], tuple[jax.Array, Any]]:
    return jax.jit(jax.value_and_grad(lambda args: fun(*args)))


def assert_finite(fun: Callable[..., jax.Array], *args: Any) -> tuple[jax.Array, Any]:
    """`fun(*args)` and its derivatives in all numbers, in single precision."""
    value, found = gradient(fun)(in_precision(args, np.float32))
    assert value.dtype == np.float32
    assert np.isfinite(value)
    for path, leaf in jax.tree.leaves_with_path(found):
        assert np.isfinite(leaf).all(), jax.tree_util.keystr(path)
    return value, found


def assert_right(fun: Callable[..., jax.Array], *args: Any, rtol: float = 1e-3) -> None:
    """These in single precision as in double."""
    value, single = assert_finite(fun, *args)
    with jax.enable_x64(True):
        exact, double = gradient(fun)(in_precision(args, np.float64))
    np.testing.assert_allclose(value, exact, rtol=rtol, atol=1e-6)
    for (path, leaf), wanted in zip(jax.tree.leaves_with_path(single), jax.tree.leaves(double), strict=True):
        atol = rtol * np.abs(wanted).max() + 1e-5
        np.testing.assert_allclose(leaf, wanted, rtol=rtol, atol=atol, err_msg=jax.tree_util.keystr(path))


# Pictures: all kinds of shapes, materials, lights and cameras; each edge of a domain is the same scene with other numbers.


def scene_with(camera: Any) -> jaxhf.Scene:
    field = jaxhf.Heightfield(HEIGHTS)
    return jaxhf.Scene(
        [
            jaxhf.Object(field, jaxhf.Matte(0.7)),
            jaxhf.Object(jaxhf.Skirt.of(field, -BELOW), jaxhf.Matte(TEXTURE)),
            jaxhf.Object(jaxhf.Cylinder(3.0, -9.0, 9.0)),
        ],
        camera,
        [
            jaxhf.Sun((0.3, -0.2, 1), (1, 2, 3)),
            jaxhf.Directional((0.2, 0.5, 1.0)),
            jaxhf.Point((0.4, 0.6, 2.0), 5.0),
            jaxhf.Sky(0.2),
        ],
    )


def from_above(across: float = 0.0) -> jaxhf.Orthographic:
    """Looks straight down, but for a turn about x by so small an angle that its cosine is 1."""
    frame = np.array([[1, 0, 0, 0.503], [0, -1, across, 0.507], [0, -across, -1, 3], [0, 0, 0, 1]])
    return jaxhf.Orthographic(frame, 1.3, width=PIXELS, height=PIXELS)


LEVEL = np.array([[1, 0, 0, 0.503], [0, 0, 1, -2], [0, 1, 0, 0.15], [0, 0, 0, 1.0]])
CAMERAS = {"orthographic": from_above(), "perspective": jaxhf.Perspective(LEVEL, 40.0, width=PIXELS, height=PIXELS)}


def put(where: Callable[[Any], Any], *value: Any) -> Callable[[jaxhf.Scene], jaxhf.Scene]:
    values = tuple(np.asarray(one, float) for one in value)
    return lambda scene: eqx.tree_at(where, scene, values[0] if len(values) == 1 else values)


def heights_of(scene: Any) -> Any:
    return scene.objects[0].shape.heights


def sun_of(scene: Any) -> Any:
    return scene.lights[0].towards, scene.lights[0].angular_diameter


def without_border(scene: jaxhf.Scene) -> jaxhf.Scene:
    heights = np.pad(HEIGHTS[1:-1, 1:-1], 1, constant_values=np.nan)
    row, skirt = np.full(9, np.nan), scene.objects[1].shape
    assert isinstance(skirt, jaxhf.Skirt)
    scene = eqx.tree_at(heights_of, scene, heights)
    return eqx.tree_at(lambda s: [getattr(s.objects[1].shape, side) for side in SIDES], scene, [row] * 4)


SIDES = ("south", "north", "west", "east")
PICTURES = {
    "as it is": lambda scene: scene,
    **{f"sun {x} beside the zenith": put(sun_of, (x, 0, 1), 0.53) for x in (0.0, 1e-7, 1e-5, 1e-3)},
    **{f"sun of {size} degrees at the zenith": put(sun_of, (0, 0, 1), size) for size in (1e-3, 0.1, 0.17, 10.0)},
    "lights of tiny length": put(
        lambda scene: (scene.lights[0].towards, scene.lights[1].towards), (3e-25, 0, 1e-24), (1e-30, 0, 2e-30)
    ),
    "lamp far away": put(lambda scene: (scene.lights[2].p, scene.lights[2].intensity), (3e9, 2e9, 1e10), [1e20] * 3),
    "lamp below": put(lambda scene: scene.lights[2].p, (0.4, 0.6, -1e-20)),
    "skirt of no height": lambda scene: put(
        lambda s: (s.objects[1].shape.base, *[getattr(s.objects[1].shape, side) for side in SIDES]), 0, *[np.zeros(9)] * 4
    )(put(heights_of, 0 * HEIGHTS)(scene)),
    "border of holes": without_border,
    "nothing but holes": put(heights_of, np.nan * HEIGHTS),
    "thin cylinder": put(lambda scene: scene.objects[2].shape.radius, 1e-12),
    "thinner cylinder": put(lambda scene: scene.objects[2].shape.radius, 2e-19),
    "low cylinder": put(lambda scene: (scene.objects[2].shape.z_min, scene.objects[2].shape.z_max), 0.0, 1e-25),
}


@functools.cache
def weights() -> np.ndarray:
    return np.random.default_rng(2).uniform(0.5, 1.5, (PIXELS, PIXELS, 3))


def brightness(scene: jaxhf.Scene, edge_samples: int = 0) -> jax.Array:
    if edge_samples:  # refused beside a skirt
        objects = [obj for obj in scene.objects if not isinstance(obj.shape, jaxhf.Skirt)]
        scene = jaxhf.Scene(objects, scene.camera, scene.lights)
    image = jaxhf.render(scene, jaxhf.Settings(chunk=PIXELS * PIXELS, edge_samples=edge_samples))
    return jnp.sum(image * jnp.asarray(weights(), image.dtype)) / 100


@pytest.mark.slow  # the same rules as of rays below, in some thirty programs
@pytest.mark.parametrize("kind", ["perspective", "orthographic"])
def test_pictures(kind):
    for change in PICTURES.values():
        assert_right(brightness, change(scene_with(CAMERAS[kind])))


@pytest.mark.slow
@pytest.mark.parametrize("edge_samples", [0, 64])
def test_pictures_of_what_no_precision_can_tell(edge_samples):
    """Finite, that is: with points on edges, and where a horizon cuts a sun that is smaller than its rounding."""
    seen = functools.partial(brightness, edge_samples=edge_samples)
    for towards in ((0, 0, 1), (1e-9, 0, 1), (0.3, -0.2, 1)):
        for size in (1e-20, 1e-6, 0.53):
            assert_finite(seen, put(sun_of, towards, size)(scene_with(CAMERAS["orthographic"])))
    for across in TINY:
        assert_finite(seen, scene_with(from_above(across)))


# Rays of one's own.


def distances(heights: jax.Array, base: jax.Array, o: jax.Array, d: jax.Array) -> jax.Array:
    field = jaxhf.Heightfield(heights, 1.0)
    walled = [jaxhf.Object(field), jaxhf.Object(jaxhf.Skirt.of(field, base)), jaxhf.Object(jaxhf.Cylinder(20.0))]
    hit = jaxhf.cast(jaxhf.Scene(walled, CAMERAS["orthographic"]), o, d)
    met = hit.status == jaxhf.Status.HIT
    return jnp.sum(jnp.where(met, hit.t, 0)) + jnp.sum(jnp.where(met[:, None], hit.p + hit.n + hit.dp_du, 0))


def rays_beside(across: float) -> tuple[np.ndarray, np.ndarray]:
    """On walls, floor and terrain, each in the plane of something else but for `across`."""
    o = [(4, -1, -0.5), (-1, 4, -0.5), (3.3, 4.2, 9), (3.3, 4.2, -9), (4.2, 4.3, -0.5), (-30, 4.2, 0.3), (4, -1, 0.05)]
    d = [(across, 1, 0), (1, across, across), (across, -across, -1), (across, across, 1), (across, 1, 0), (1, across, across),
         (0.1, 1, across)]  # fmt: skip
    return np.array(o), np.array(d)


@pytest.mark.deep
def test_rays():
    for heights in (HEIGHTS, 0 * HEIGHTS + 0.1):
        for across in (0.0, *TINY, -1e-20, -1e-37):
            assert_right(distances, heights, -BELOW - 1, *rays_beside(across))


def on_hfield(data: jax.Array, size: jax.Array, quat: jax.Array, pnt: jax.Array, vec: jax.Array) -> jax.Array:
    scan = mujoco.ray(mujoco.HField(data, size, quat=quat), pnt, vec)
    return jnp.sum(scan.dist) + jnp.sum(scan.n @ jnp.asarray([1, 2, 3], scan.n.dtype))


@pytest.mark.deep
def test_rays_of_robots():
    size, upright = np.array([4, 4, 1, 1.0]), np.array([1, 0, 0, 0.0])
    for across in (0.0, *TINY, -1e-20, -1e-37):
        o, d = rays_beside(across)
        for quat in (upright, 1e-14 * upright, 1e18 * upright):
            assert_right(on_hfield, HEIGHTS, size, quat, o - [4, 4, 0], d)
    o, d = rays_beside(0.0)
    assert_right(on_hfield, HEIGHTS, 1e-12 * size, upright, 1e-12 * (o - [4.1, 4.1, 0]), np.add(d, [0.01, 0.02, 0]))
    assert_finite(on_hfield, HEIGHTS, size, 0 * upright, o - [4, 4, 0], d)


def on_sensors(data: jax.Array, pos: jax.Array, quat: jax.Array) -> jax.Array:
    field = mujoco.HField(data, (4, 4, 1, 1))
    scans = [mujoco.height_scan(field, pos, quat, np.array([[0.1, 0.2], [1, -2]]), align=align) for align in ("yaw", "base")]
    scans.append(mujoco.lidar(field, pos, quat, mujoco.lidar_pattern(3, resolution=60.0)))
    total = sum(jnp.sum(jnp.where(scan.mask, scan.dist, 0)) for scan in scans)
    return total + jnp.sum(mujoco.depth_image(field, pos, quat, 4, 4)[0])


@pytest.mark.slow  # their rays are those above
def test_sensors():
    """Upright; turned by right angles, of which one leaves no heading; and not turned by a number at all."""
    pos, half = np.array([[0.3, 0.2, 2.0]]), np.sqrt(0.5)
    for quat in ((1, 0, 0, 0), (0, 1, 0, 0), (1e-14, 0, 0, 0), (1e18, 1e17, 0, 0), (1, 1e-20, 1e-30, 1e-37)):
        assert_right(on_sensors, HEIGHTS, pos, np.array([quat], float))
    for quat in ((half, 0, half, 0), (half, 0, -half, 0), (0.5, 0.5, 0.5, 0.5), (0, 0, 0, 0)):
        assert_finite(on_sensors, HEIGHTS, pos, np.array([quat], float))


# Arrays in any unit.


def directions(heights: jax.Array, cell: float, scheme: Any) -> jax.Array:
    normals = jaxhf.vertex_normals(heights, cell, cell, scheme)
    largest = jax.lax.stop_gradient(jnp.abs(normals).max(-1, keepdims=True))
    return jnp.sum(jnp.sin(jnp.arange(243.0, dtype=jnp.float32)) * jax.vmap(unit)((normals / largest).reshape(-1, 3)).ravel())


def skies(heights: jax.Array, cell: float, weighting: Any) -> jax.Array:
    if weighting == "degrees":
        return jnp.sum(jaxhf.horizon(heights, 8, dx=cell))
    return jnp.sum(jaxhf.sky_view(heights, 8, weighting=weighting, dx=cell))


@pytest.mark.deep
@pytest.mark.parametrize(
    ("fun", "kinds"),
    [
        (directions, ("six-angle", "central", "four", "six", "six-equal")),
        (skies, ("solid-angle", "horizontal", "slope", "degrees")),
    ],
)
def test_maps_in_any_unit(fun, kinds):
    for kind in kinds:
        derivative = jax.value_and_grad(lambda heights, cell, kind=kind: fun(heights, cell, kind))
        value, slope = derivative(jnp.asarray(HEIGHTS, jnp.float32), 0.125)
        for scale in (1e-17, 1e-10, 1e-5, 1e5, 1e10, 1e18):
            found, change = derivative(jnp.asarray(HEIGHTS * scale, jnp.float32), 0.125 * scale)
            np.testing.assert_allclose(found, value, rtol=1e-4, err_msg=kind)
            np.testing.assert_allclose(change * np.float32(scale), slope, rtol=1e-3, atol=1e-3, err_msg=kind)
        for heights in (0 * HEIGHTS, 1e20 * HEIGHTS, 1e-30 * HEIGHTS):
            if fun is skies:
                assert np.isfinite(derivative(jnp.asarray(heights, jnp.float32), 1.0)[1]).all(), kind


def test_cameras_that_are_made_of_traced_numbers():
    def looking(eye: jax.Array, target: jax.Array, up: jax.Array) -> jax.Array:
        frame = jaxhf.Perspective.look_at(eye, target, up).world_from_camera
        return jnp.sum(jnp.sin(jnp.arange(9.0)).astype(frame.dtype).reshape(3, 3) * frame[:3, :3])

    for scale in (1.0, 1e-15, 1e15):
        assert_right(looking, np.zeros(3), scale * np.array([1, 2, -1]), np.array([0, 0, 1e-20]), rtol=1e-4)


# The rules themselves.


def test_quotients():
    """Right wherever the quotient itself is a number, zero where it is passed over."""
    for b in (1e-37, -1e-25, 1.0, 1e30):
        a = jnp.float32(3 * b)
        slope = jax.grad(quotient, (0, 1))(a, jnp.float32(b))
        np.testing.assert_allclose(slope, (1 / b, -3 / b), rtol=1e-5)
    assert jax.grad(lambda b: jnp.where(b > 1, quotient(jnp.ones_like(b), b), 0))(jnp.float32(1e-37)) == 0
    np.testing.assert_allclose(jax.hessian(lambda b: quotient(jnp.ones_like(b), b))(jnp.float32(2)), 2 / 2.0**3)


def test_times_and_angles():
    for distance, rate in ((1.0, 0.0), (0.0, 0.0), (5.0, 1e-38), (1e30, 1e-5)):
        t, ever = time_to(jnp.float32(distance), jnp.float32(rate))
        assert (t, ever) == (0, False)
        assert jax.grad(lambda *args: time_to(*args)[0], (0, 1))(jnp.float32(distance), jnp.float32(rate)) == (0, 0)
    for size in (1e-37, 1e-20, 1.0, 1e20, 1e37):
        y, x = jnp.float32(3 * size), jnp.float32(-4 * size)
        np.testing.assert_allclose(angle(y, x), np.arctan2(3, -4), rtol=1e-6)
        with np.errstate(over="ignore"):
            np.testing.assert_allclose(jax.grad(angle, (0, 1))(y, x), (-4 / 25 / size, -3 / 25 / size), rtol=1e-5)
    zero = jnp.zeros(())
    assert (angle(zero, zero), *jax.grad(angle, (0, 1))(zero, zero)) == (0, 0, 0)
