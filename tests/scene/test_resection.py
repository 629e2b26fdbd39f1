"""Cameras from points whose pixels are known, against pixels by K [R | t] and by affine maps; and where cameras see points."""

import re
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxhf

UTM = np.array([5e5, 5e6, 1200.0])
TOWARDS = np.array([0.3, -0.15, 0.9]) / np.linalg.norm([0.3, -0.15, 0.9])  # from the terrain to the eye
SIZE = {"width": 640, "height": 480}


def axes() -> np.ndarray:
    """Rows: right, down and forward of a camera that looks against TOWARDS, rolled a little."""
    right = np.cross(-TOWARDS, [0.2, 1, 0])
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(-TOWARDS, right), -TOWARDS])


def scattered(count: int, size: float, relief: float, seed: int = 0) -> np.ndarray:
    return UTM + np.random.default_rng(seed).uniform(-0.5, 0.5, (count, 3)) * [size, size, relief]


def by_hand(points: np.ndarray, away: float, size: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixels by K [R | t] (Hartley and Zisserman 2004, equation 6.8), with skew and a principal point aside; K, and the eye."""
    f = 400 * away / size
    k, eye = np.array([[f, 0.02 * f, 300], [0, 1.1 * f, 260], [0, 0, 1]]), UTM + away * TOWARDS
    x, y, z = k @ axes() @ (points - eye).T
    return np.stack([x / z, y / z], axis=1), k, eye


@pytest.mark.parametrize(
    ("away", "size", "relief", "off"),
    # Pixels of 640 are rounded to 1e-13, which counts as much more as depths differ less; 5e6 to 1e-9 of a metre.
    [
        (40.0, 30.0, 8.0, 1e-6),
        (2e3, 1e3, 300.0, 1e-9),
        (7e5, 1e4, 800.0, 1e-8),
        (7e5, 1e3, 20.0, 1e-6),
        (4e7, 1e3, 100.0, 1e-6),
    ],
)
@pytest.mark.parametrize("size_of_picture", [(640, 480), (480, 640)])
def test_the_camera_sees_all_points_where_k_r_t_has_them(away, size, relief, off, size_of_picture):
    """Also others than those it is made from, above and below them; its eye is where theirs is."""
    given, others = scattered(60, size, relief), scattered(200, size, 2 * relief, seed=1)
    (pixels, _, eye), (width, height) = by_hand(given, away, size), size_of_picture
    camera = jaxhf.Perspective.from_points(given, pixels, width=width, height=height, max_error=1e-6)
    np.testing.assert_allclose(camera.project(others), by_hand(others, away, size)[0], atol=off)
    np.testing.assert_allclose(np.asarray(camera.world_from_camera)[:3, 3], eye, atol=1e-6 * away)
    assert camera.world_from_camera.dtype == np.float64


def test_a_calibrated_camera_is_found_again():
    """Where pixels are not skew, matrix and angle are those of `from_intrinsics`."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = axes().T, UTM + 2e3 * TOWARDS
    for width, height in ((640, 480), (480, 640)):
        known = jaxhf.Perspective.from_intrinsics(900, 800, 310, 250, world_from_camera=pose, width=width, height=height)
        points = scattered(20, 1e3, 300.0)
        found = jaxhf.Perspective.from_points(points, known.project(points), width=width, height=height)
        np.testing.assert_allclose(found.world_from_camera, known.world_from_camera, rtol=1e-9)
        np.testing.assert_allclose(found.fov, known.fov, rtol=1e-9)


def test_points_in_single_precision_and_lists_are_taken():
    points = scattered(20, 1e3, 300.0) - UTM
    pixels, *_ = by_hand(points + UTM, 2e3, 1e3)
    found = jaxhf.Perspective.from_points(jnp.asarray(points, jnp.float32), pixels.tolist(), **SIZE, max_error=1e-3)
    np.testing.assert_allclose(found.project(points), pixels, atol=1e-3)


@pytest.mark.parametrize(("away", "size", "relief"), [(40.0, 30.0, 8.0), (2e3, 1e3, 300.0), (7e5, 1e4, 800.0)])
def test_noisy_pixels_are_met_by_least_squares(away, size, relief):
    """The residual is orthogonal to what any change of the camera does to the pixels; central differences."""
    points = scattered(40, size, relief)
    exact, *_ = by_hand(points, away, size)
    pixels = exact + np.random.default_rng(2).normal(0, 0.3, exact.shape)
    camera = jaxhf.Perspective.from_points(points, pixels, **SIZE, max_error=3.0)
    residual = (camera.project(points) - pixels).ravel()
    assert 0.2 < np.sqrt(np.mean(residual**2)) < 0.32
    matrix = np.asarray(camera.world_from_camera)
    for place in np.ndindex(3, 4):
        step = np.zeros((4, 4))
        step[place] = 1e-4 * [1, 1, size / away, size][place[1]]
        seen = [jaxhf.Perspective(matrix + sign * step, camera.fov, 640, 480).project(points) for sign in (1, -1)]
        slope = (seen[0] - seen[1]).ravel()
        assert abs(slope @ residual) < 1e-5 * np.linalg.norm(slope) * np.linalg.norm(residual), place


@pytest.mark.parametrize("kind", [jaxhf.Perspective, pytest.param(jaxhf.Orthographic, marks=pytest.mark.deep)])
def test_a_picture_from_700_km_shows_points_at_their_pixels(kind):
    """In single precision, at UTM coordinates: what a pixel shows is projected to its middle, half a pixel from its corner."""
    n, cell, away = 65, 0.5, 7e5
    heights = np.random.default_rng(3).standard_normal((n, n)).cumsum(0).cumsum(1).astype(np.float32) / 30
    corner = UTM[:2] - cell * (n - 1) / 2

    def places(u, v, z):
        return np.stack([corner[0] + cell * (n - 1) * u, corner[1] + cell * (n - 1) * v, z], axis=-1)

    rng = np.random.default_rng(4)
    u, v = rng.uniform(size=(2, 50))
    points = places(u, v, rng.uniform(heights.min(), heights.max(), 50))
    k = np.array([[away * 2.2, away * 0.04, 32], [0, away * 2.0, 24], [0, 0, 1]])

    def pixels(points):
        x, y, z = axes() @ (points - UTM * [1, 1, 0] - away * TOWARDS).T
        x, y, z = k @ np.stack([x, y, z if kind is jaxhf.Perspective else away + 0 * z])
        return np.stack([x / z, y / z], axis=1)

    camera: Any = kind.from_points(points, pixels(points), width=64, height=48, max_error=1e-6)
    field = jaxhf.Heightfield(heights, cell, cell, *corner)
    scene = jaxhf.Scene([jaxhf.Object(field)], camera)
    _, aovs = jaxhf.render(scene, jaxhf.Settings(shading="flat"), aovs=("status", "uv", "cell"))
    met = np.asarray(aovs["status"]) == jaxhf.Status.HIT
    u, v = np.asarray(aovs["uv"], np.float64)[met].T
    ix, iy = np.asarray(aovs["cell"])[met].T
    a, b, z = u * (n - 1) - ix, v * (n - 1) - iy, heights.astype(np.float64)
    low, high = z[iy, ix], z[iy + 1, ix + 1]
    z = (
        low
        + np.minimum(a, b) * (high - low)
        + np.where(a > b, (a - b) * (z[iy, ix + 1] - low), (b - a) * (z[iy + 1, ix] - low))
    )
    middles = np.stack(np.meshgrid(np.arange(64) + 0.5, np.arange(48) + 0.5), axis=-1)[met]
    np.testing.assert_allclose(pixels(places(u, v, z)), middles, atol=2e-3)
    np.testing.assert_allclose(camera.project(places(u, v, z)), middles, atol=2e-3)
    assert 0.5 < met.mean() <= 1


def test_parallel_rays_see_all_points_where_an_affine_map_has_them():
    """Oblique ones, too; the least squares of pixels that are off."""
    linear, offset = np.array([[0.5, 0.1, 0.2], [0.05, -0.4, 0.3]]), np.array([320.0, 240.0])
    given, others = scattered(4, 1e3, 300.0), scattered(100, 1e3, 900.0, seed=1)
    for width, height in ((640, 480), (480, 640)):
        camera = jaxhf.Orthographic.from_points(given, (given - UTM) @ linear.T + offset, width=width, height=height)
        np.testing.assert_allclose(camera.project(others), (others - UTM) @ linear.T + offset, atol=1e-9)
        assert np.asarray(camera.world_from_camera)[2, 2] < 0  # from above
        np.testing.assert_allclose(camera.extent, min(width, height) / np.linalg.norm(linear[0 if width < height else 1]))
    pixels = (others - UTM) @ linear.T + offset + np.random.default_rng(2).normal(0, 0.3, (100, 2))
    residual = jaxhf.Orthographic.from_points(others, pixels, **SIZE, max_error=3).project(others) - pixels
    slopes = np.concatenate([others - UTM, np.ones((100, 1))], axis=1)
    np.testing.assert_allclose(slopes.T @ residual, 0, atol=1e-6)


@pytest.mark.parametrize("kind", [jaxhf.Perspective, jaxhf.Orthographic])
def test_project_is_the_inverse_of_rays(kind):
    camera: Any = kind.look_at((3.0, -4.0, 5.0), (0.5, 0.5, 0.0), (0, 0, 1), 30.0, width=40, height=30)
    x, y = np.random.default_rng(0).uniform(0, 30, (2, 5, 7)).astype(np.float32)
    rays = jax.vmap(jax.vmap(camera.ray))(jnp.asarray(x), jnp.asarray(y))
    points = np.asarray(rays.o, np.float64) + 4 * np.asarray(rays.d, np.float64)
    np.testing.assert_allclose(camera.project(points), np.stack([x, y], axis=-1), atol=1e-4)
    assert np.isnan(camera.project(points - 8 * np.asarray(rays.d, np.float64))).all()  # behind
    with pytest.raises(jaxhf.ArgumentError, match=re.escape("project: points must have shape (..., 3), theirs is (4, 2)")):
        camera.project(np.zeros((4, 2)))


POINTS = scattered(12, 1e3, 300.0)
PIXELS, *_ = by_hand(POINTS, 2e3, 1e3)
BEHIND = POINTS.copy()
BEHIND[7] += 4e3 * TOWARDS
FLAT = POINTS * [1, 1, 0] + POINTS[:, :1] * [0, 0, 0.1]
TOWER = FLAT.copy()
TOWER[3, 2] += 50


def edited(values: np.ndarray, place, value) -> np.ndarray:
    values = values.copy()
    values[place] = value
    return values


WRONG = [
    (POINTS[:, :2], PIXELS, "points must have shape (n, 3), theirs is (12, 2)"),
    (POINTS, PIXELS[0], "pixels must have shape (n, 2), theirs is (2,)"),
    (POINTS, PIXELS[:-1], "pixels must be as many as points, they are 11 for 12 points"),
    (POINTS[:5], PIXELS[:5], "points must be at least 6, they are 5"),
    (edited(POINTS, (4, 1), np.nan), PIXELS, "points[4] must be finite, it is ["),
    (POINTS, edited(PIXELS, (2, 0), np.inf), "pixels[2] must be finite, it is [inf, "),
    (FLAT, by_hand(FLAT, 2e3, 1e3)[0], "points must not lie in one plane, which many cameras see alike"),
    (TOWER, by_hand(TOWER, 2e3, 1e3)[0], "points must tell cameras apart, several see them so: most lie in one plane"),
    (POINTS, PIXELS * [1, 0], "pixels must not lie on one line"),
    (BEHIND, by_hand(BEHIND, 2e3, 1e3)[0], "points[7] must lie in front of the camera that sees most of them; it lies behind"),
    (POINTS, edited(PIXELS, 5, PIXELS[5] + [30, 0]), "pixels must lie within max_error = 1 pixels of where one camera sees"),
    (POINTS, PIXELS * [1, -1], "pixels must count right and down from the top left corner, these show a mirror image"),
    (POINTS, PIXELS[:, ::-1], "pixels must count right and down from the top left corner, these show a mirror image"),
    (POINTS, (POINTS - UTM) @ np.array([[0.5, 0, 0.1], [0, -0.5, 0.2]]).T, "points must be seen in perspective, these by pa"),
]  # fmt: skip


@pytest.mark.parametrize(("points", "pixels", "message"), WRONG, ids=[message[:40] for *_, message in WRONG])
def test_what_tells_no_camera_is_refused(points, pixels, message):
    with pytest.raises(jaxhf.ArgumentError, match=f"^from_points: {re.escape(message)}"):
        jaxhf.Perspective.from_points(points, pixels, **SIZE)


def test_noise_that_hides_the_perspective_is_told_from_a_mirror():
    """Of a plain from 700 km: where the noise turns depths round, parallel rays are named."""
    points = scattered(200, 1e4, 1.0)
    exact, *_ = by_hand(points, 7e5, 1e4)
    refused = 0
    for seed in range(20):
        pixels = exact + np.random.default_rng(seed).normal(0, 0.3, exact.shape)
        try:
            jaxhf.Perspective.from_points(points, pixels, **SIZE, max_error=3.0)
        except jaxhf.ArgumentError as error:
            refused += "Orthographic.from_points" in str(error)
            np.testing.assert_allclose(
                jaxhf.Orthographic.from_points(points, pixels, **SIZE, max_error=3.0).project(points), exact, atol=1.0
            )
    assert 0 < refused < 20


def test_other_arguments_are_refused(as_users_call_it):
    for arguments, message in (
        ({**SIZE, "max_error": 0}, "from_points: max_error must be positive and finite, it is 0"),
        ({**SIZE, "width": 0}, "from_points: width must be a whole number of pixels from 1 on, it is 0"),
    ):
        for kind in (jaxhf.Perspective, jaxhf.Orthographic):
            with pytest.raises(jaxhf.ArgumentError, match=re.escape(message)):
                kind.from_points(POINTS, PIXELS, **arguments)
    with pytest.raises(jaxhf.ArgumentError, match=r"points must be at least 4, they are 3"):
        jaxhf.Orthographic.from_points(POINTS[:3], PIXELS[:3], **SIZE)
    with pytest.raises(jaxhf.ArgumentError, match="pixels must lie within max_error = 1 pixels"):
        jaxhf.Orthographic.from_points(POINTS, PIXELS, **SIZE)
    with pytest.raises(jaxhf.ArgumentError, match="points must be known when programs are compiled, they are traced by JAX"):
        jax.jit(lambda points: jaxhf.Perspective.from_points(points, PIXELS, **SIZE))(POINTS)


def test_a_scanner_is_nearly_a_pinhole_once_its_terrain_is_known():
    """50 km above 1 km of terrain and 100 m of relief, with pixels of 0.5 m: it is 0.65 pixels off a pinhole, and 0.03 once
    that resampled the picture on heights that are 2 m off. docs/coming-from/asp.md says these numbers."""
    rng = np.random.default_rng(0)
    points = rng.uniform([-500, -500, -50], [500, 500, 50], (4000, 3))
    moved = points + [0, 0, 1] * rng.choice([-2, 2], (4000, 1))

    def scanned(points: np.ndarray) -> np.ndarray:
        return 1000 + np.stack([points[:, 0] / (1 - points[:, 2] / 50e3), -points[:, 1]], axis=1) / 0.5

    camera = jaxhf.Perspective.from_points(points, scanned(points), width=2000, height=2000, max_error=0.7)
    off, off_moved = (camera.project(p) - scanned(p) for p in (points, moved))
    assert np.linalg.norm(off, axis=1).max() > 0.6
    assert 0.025 < np.linalg.norm(off - off_moved, axis=1).max() < 0.03
