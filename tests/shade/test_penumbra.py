"""The sun as a disc: against rays to many points of it, by NumPy, and the area of a circular segment."""

import functools
from typing import Any

import aimed
import crossings
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxhf
from jaxhf.core.affine import translate

SIZE, DIAMETER, LOW = 24, 4.0, 12.0
TOWARDS = jaxhf.Directional.from_angles(270, LOW).towards
Y, X = np.mgrid[0:25, 0:33].astype(float)
PEAKS = 3 * np.exp(-((X - 8) ** 2 + (Y - 14) ** 2) / 6) + 2.5 * np.exp(-((X - 7) ** 2 + (Y - 6) ** 2) / 3)
TOWER = np.where((abs(X - 8) < 2) & (abs(Y - 12) < 2), 3.0, 0.0)
KNIFE = np.where(X == 8, 3.0, 0.0)
SETTINGS = jaxhf.Settings(chunk=576)
FLAT = jaxhf.Settings(chunk=576, shading="flat")


def scene(heights, lights):
    """Seen from above where the shadows of a sun in the west end."""
    camera = jaxhf.Orthographic.look_at((21, 12, 90), (21, 12, 0), (0, 1, 0), 10, width=SIZE, height=SIZE)
    return jaxhf.Scene([jaxhf.Object(jaxhf.Heightfield(heights, 1.0), jaxhf.Matte(1.0))], camera, lights)


def spread(count, towards: Any = TOWARDS, diameter=DIAMETER):
    """Directions evenly over the sun's disc, on Vogel's spiral (Mathematical Biosciences 44, 1979)."""
    side = np.cross(towards, (0, 0, 1))
    side = side / np.linalg.norm(side)
    k = np.arange(count)
    off = np.sqrt((k + 0.5) / count) * np.deg2rad(diameter) / 2
    turn = k * np.pi * (3 - np.sqrt(5))
    return towards + np.outer(off * np.cos(turn), side) + np.outer(off * np.sin(turn), np.cross(side, towards))


@functools.partial(jax.jit, static_argnames=("chords",))
def picture(heights, towards, chords=8):
    sun = jaxhf.Sun(towards, 1.0, DIAMETER, chords)
    return jaxhf.render(scene(heights, [sun]), SETTINGS)[..., 0]


PIXELS = np.mgrid[:SIZE:3, :SIZE:2].reshape(2, -1)


def mean_of_suns(heights, count=1024):
    """Radiance at PIXELS, the mean over points of the sun; what hides one is above the ray at a line or a diagonal."""
    field, directions = aimed.Ground(heights), spread(count)
    iy, ix = PIXELS
    p = field.points(16 + (ix + 0.5) * 10 / SIZE, 17 - (iy + 0.5) * 10 / SIZE)
    total = np.zeros(len(p))
    for d in directions / np.linalg.norm(directions, axis=1)[:, None]:
        course = crossings.Course(field, p, np.tile(d, (len(p), 1)), 1e-9)
        hidden = crossings.has_changed_sides(course, np.ones(len(p), int), np.zeros(len(p)), np.full(len(p), np.inf))
        total += np.where(hidden, 0, d[2] / np.pi / count)
    return total


def test_a_sun_is_the_mean_of_1024_suns():
    found, mean = np.asarray(picture(PEAKS, TOWARDS))[*PIXELS], mean_of_suns(PEAKS)
    share = mean / mean.max()  # of the sun that is seen, as all pixels lie in the plane
    penumbra = (share > 0.01) & (share < 0.99)
    assert penumbra.mean() > 0.1
    assert (share < 0.01).mean() > 0.05
    assert np.mean(np.abs(found - mean)[penumbra] / mean[penumbra]) < 0.01
    np.testing.assert_allclose(found, mean, atol=0.01 * mean.max())
    np.testing.assert_allclose(found[~penumbra], mean[~penumbra], atol=0.003 * mean.max())


@pytest.mark.deep
def test_more_chords_make_smaller_steps():
    mean = mean_of_suns(TOWER)
    few, many = (np.abs(np.asarray(picture(TOWER, TOWARDS, chords))[*PIXELS] - mean).max() / mean.max() for chords in (4, 32))
    assert many < 0.006
    assert few > 4 * many


@pytest.mark.deep
def test_a_small_sun_casts_the_shadows_of_a_point():
    """Beside azimuths 45 and 225 a chord meets cell after cell whose diagonals lie behind the point."""
    ground = np.random.default_rng(0).uniform(0, 1.5, Y.shape)

    @jax.jit
    def draw(towards):
        suns = jaxhf.Sun(towards, np.pi, 0.01), jaxhf.Directional(towards)
        return [jaxhf.render(scene(ground, [sun]), FLAT)[..., 0] for sun in suns]

    for azimuth in (45, 60, 135, 225, 300):
        small, point = draw(jnp.asarray(jaxhf.Directional.from_angles(azimuth, LOW).towards, jnp.float32))
        assert 0.2 < (point > 0).mean() < 0.8
        assert (abs(small - point) > 0.01).mean() < 0.005  # one pixel lies in a penumbra


def test_behind_a_straight_wall_the_sun_is_a_circular_segment():
    found = np.asarray(picture(KNIFE, TOWARDS))
    x = 16 + (np.arange(SIZE) + 0.5) * 10 / SIZE  # of the pixels' columns
    wall, middle, radius = np.arctan2(3.0, x - 8), np.deg2rad(LOW), np.deg2rad(DIAMETER) / 2
    h = np.clip((wall - middle) / radius, -1, 1)
    share = (np.arccos(h) - h * np.sqrt(1 - h * h)) / np.pi
    lifted = 2 / 3 * np.sqrt(1 - h * h) ** 3 / np.maximum(np.pi * share, 1e-9) * radius  # of the segment's centroid
    expected = share * np.sin(middle + lifted) / np.pi
    assert ((share > 0.05) & (share < 0.95)).sum() > 4
    np.testing.assert_allclose(found, np.broadcast_to(expected, found.shape), atol=0.006 * expected.max())


def test_a_sheet_hides_the_sun_from_the_ground_below_it():
    camera = jaxhf.Perspective.look_at((0.5, -0.2, 0.3), (0.5, 0.5, 0), fov=30, width=16, height=16)
    sheets = [jaxhf.Object(jaxhf.Heightfield(np.full((3, 3), z, np.float32), 0.5)) for z in (0.0, 0.4)]
    suns = (light.from_angles(285, 60) for light in (jaxhf.Sun, jaxhf.Directional))
    sun, point = (np.asarray(jaxhf.render(jaxhf.Scene(sheets, camera, [light]))) for light in suns)
    assert 0.03 < (point > 0).mean() < 0.5  # lit from beside the sheet
    np.testing.assert_allclose(sun.mean(), point.mean(), rtol=1e-3)


WIDE, SUNWARDS = 6.0, np.asarray(jaxhf.Directional.from_angles(250, 25).towards)
# x0, x1, y0, y1, and z at (0, 0) and its changes along x and y, of each sheet; of an open box z is that of its rim.
GROUND, SHEET, BOX, FLOOR = (0, 6, 0, 6, 0, 0, 0), (1, 2, 1.2, 2.4, 2.5, -1, 0.1), (2.6, 3.4, 0.2, 0.8, 0.8, 0, 0), 0.3


def sheet(patch, cells):
    """A heightfield at the origin and where it belongs."""
    x0, x1, y0, y1, z, along_x, along_y = patch
    dx, dy = (x1 - x0) / cells, (y1 - y0) / cells
    y, x = np.mgrid[0 : cells + 1, 0 : cells + 1] * np.array([dy, dx])[:, None, None]
    return jaxhf.Heightfield(along_x * x + along_y * y, dx, dy), translate(x0, y0, z + along_x * x0 + along_y * y0)


def sheets(moved=(0.0, 0.0, 0.0, 0.0, 0.0)):
    """Ground, a sloping sheet over it, and the sun.

    Args:
      moved: the sheet along x and along z, its heights, the ground along z, and the sun's z.
    """
    (ground, low), (slope, high) = sheet(GROUND, 3), sheet(SHEET, 4)
    slope = jaxhf.Heightfield(slope.heights * (1 + moved[2]), slope.dx, slope.dy)
    low, high = jnp.asarray(low).at[2, 3].add(moved[3]), jnp.asarray(high).at[0, 3].add(moved[0]).at[2, 3].add(moved[1])
    sun = jaxhf.Sun(jnp.asarray(SUNWARDS).at[2].add(moved[4]), np.pi, WIDE)
    return [jaxhf.Object(ground, jaxhf.Matte(1.0), low), jaxhf.Object(slope, jaxhf.Matte(1.0), high)], [sun]


def hidden_by_patch(p, d, patch):
    x0, x1, y0, y1, z, along_x, along_y = patch
    t = (z + along_x * p[0] + along_y * p[1] - p[2]) / (d[2] - along_x * d[0] - along_y * d[1])
    x, y = p[0] + t * d[0], p[1] + t * d[1]
    return (t > 1e-9) & (x > x0) & (x < x1) & (y > y0) & (y < y1)


def hidden_by_wall(p, d, axis, at):
    (low, high), t = BOX[2 - 2 * axis : 4 - 2 * axis], (at - p[axis]) / d[axis]
    along, z = p[1 - axis] + t * d[1 - axis], p[2] + t * d[2]
    return (t > 1e-9) & (along > low) & (along < high) & (z > FLOOR) & (z < BOX[4])


def expected_light(x, y, from_above, count=512, moved=None):
    """What a vertical line of sight sees there, by rays to points of the sun; where something is `moved`, without the box."""
    boxed, moved = moved is None, np.zeros(5) if moved is None else moved
    a, c = SHEET[5] * (1 + moved[2]), SHEET[4] + SHEET[5] * SHEET[0] + SHEET[6] * SHEET[2] + moved[1]
    b, x0, x1 = SHEET[6] * (1 + moved[2]), SHEET[0] + moved[0], SHEET[1] + moved[0]
    slope = (x0, x1, *SHEET[2:4], c - a * x0 - b * SHEET[2], a, b)
    patches = [(*GROUND[:4], moved[3], 0, 0), slope, (*BOX[:4], FLOOR, 0, 0)][: 2 + boxed]
    heights = [np.where((x > k[0]) & (x < k[1]) & (y > k[2]) & (y < k[3]), k[4] + k[5] * x + k[6] * y, np.nan) for k in patches]
    heights = np.array(heights if from_above else [np.full_like(x, np.nan), *heights[1:]])
    seen = np.argmax(np.where(np.isnan(heights), -9, heights if from_above else -heights), axis=0)
    p = np.stack([x, y, np.take_along_axis(heights, seen[None], 0)[0]])
    n = np.array([(-k[5], -k[6], 1) / np.sqrt(k[5] ** 2 + k[6] ** 2 + 1) for k in patches]).T[:, seen]
    n = n if from_above else -n
    light = np.zeros_like(x)
    for d in spread(count, SUNWARDS + np.array([0, 0, moved[4]]), WIDE):
        away = np.zeros(x.shape, bool)
        for k, patch in enumerate(patches):
            away |= (seen != k) & hidden_by_patch(p, d, patch)
        for axis in (0, 1) if boxed else ():
            for at in BOX[2 * axis : 2 * axis + 2]:
                away |= hidden_by_wall(p, d, axis, at)
        light += np.where(away, 0, np.maximum(np.einsum("i,ihw->hw", d / np.linalg.norm(d), n), 0)) / count
    return np.where(np.isnan(p[2]), 0, light)


def over(x, y, size, up=1):
    camera = jaxhf.Orthographic.look_at((x, y, 9), (x, y, 0), (0, 1, 0), size, width=SIZE, height=SIZE)
    if up < 0:
        camera = jaxhf.Orthographic.look_at((x, y, 0.1), (x, y, 1), (0, 1, 0), size, width=SIZE, height=SIZE)
    step = (np.arange(SIZE) + 0.5) * size / SIZE - size / 2
    across, down = np.meshgrid(step, step)
    return jax.tree.map(jnp.asarray, camera), x + up * across, y - down


@pytest.mark.deep
def test_sheets_hide_the_sun_from_below_and_from_above():
    """Against rays to 512 points of the sun: shadows of one heightfield on another, on its own lower side, and of a skirt."""
    (rim, corner), (objects, lights) = sheet(BOX, 2), sheets()
    objects = [*objects, jaxhf.Object(jaxhf.Skirt.of(rim, FLOOR - BOX[4]), jaxhf.Matte(1.0), corner)]
    draw = jax.jit(lambda camera: jaxhf.render(jaxhf.Scene(objects, camera, lights), FLAT)[..., 0])
    for camera, x, y in (over(3, 2.4, 4.7), over(2.2, 1.4, 2.6, up=-1)):
        found, expected = np.asarray(draw(camera)), expected_light(x, y, from_above=camera.world_from_camera[2, 3] > 1)
        assert 0.1 < (expected > 0).mean() < 0.9
        # The upright edges of the box pass chord after chord: at most half of one is missed.
        np.testing.assert_allclose(found, expected, atol=0.1 * expected.max())
        assert np.abs(found - expected).mean() < 0.002 * expected.max()


@pytest.mark.deep  # 1024 suns say the same of other places
def test_a_lid_hides_a_sun_overhead():
    """Up to the zenith and beyond: half of each chord lies there. A lid beneath the ground hides nothing."""
    (ground, place_of_ground), (lid, _) = sheet(GROUND, 3), sheet((-20, 26, -20, 26, 0, 0, 0), 2)
    camera = jaxhf.Orthographic.look_at((3, 3, 1), (3, 3, 0), (0, 1, 0), 4, width=4, height=4)

    @jax.jit
    def draw(corner):
        objects = [jaxhf.Object(ground, jaxhf.Matte(1.0), place_of_ground)]
        objects += [jaxhf.Object(lid, jaxhf.Matte(1.0), jnp.eye(4).at[:3, 3].set(corner))]
        return jaxhf.render(jaxhf.Scene(objects, camera, [jaxhf.Sun((0, 0, 1), np.pi, WIDE)]), FLAT)[..., 0]

    np.testing.assert_array_equal(draw(jnp.array([-20.0, -20, 2])), 0)
    np.testing.assert_allclose(draw(jnp.array([-20.0, -20, -1])), 1, rtol=5e-3)


@pytest.mark.deep
def test_the_shadow_of_a_sheet_has_a_derivative():
    """Against differences of the same rays, in what moves the sheet, the ground and the sun; no silhouette is in sight."""
    camera, x, y = over(3.9, 2.6, 2.8)
    weights = 1 + x / 2 + y**2 / 9

    def light(moved):
        objects, lights = sheets(moved)
        return jnp.sum(weights * jaxhf.render(jaxhf.Scene(objects, camera, lights), FLAT)[..., 0])

    def numeric(k, step=0.02):
        ahead, behind = (expected_light(x, y, True, 2048, side * step * (np.arange(5) == k)) for side in (1, -1))
        return np.sum(weights * (ahead - behind)) / (2 * step)

    np.testing.assert_allclose(jax.jit(jax.jacfwd(light))(jnp.zeros(5)), [numeric(k) for k in range(5)], rtol=0.05)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [(((0, 0, 1), 1.0, 0.0), "angular_diameter must be above 0 and at most 10 degrees, it is 0.0"),
     (((0, 0, 1), 1.0, [0.5, 0.6]), "angular_diameter must be one number"),
     (((0, 0, 0),), "towards must not be zero"),
     (((1, 0, 0),), "towards must point above the horizon, its altitude is 0.00 degrees"),
     (((0, 0, 1), 1.0, 0.5, 0), "chords must be a whole number from 1 on, it is 0")],
)  # fmt: skip
def test_what_is_refused(arguments, message):
    with pytest.raises(jaxhf.ArgumentError, match=f"Sun: {message}"):
        jaxhf.Sun(*arguments)


def test_a_wall_behind_a_hole_hides_the_sun():
    """A ray that comes to a wall over a hole meets it by the edge between them, which no cell before has."""
    z = np.zeros((9, 21), np.float32)
    z[:, 8] = 5
    z[2:7, 7] = np.nan
    above = jaxhf.Orthographic.look_at((1.2, 4.3, 50), (1.2, 4.3, 0), (0, 1, 0), extent=0.2, width=1, height=1)
    field = jaxhf.Heightfield(z, 1.0, 1.0)
    for up, light in ((0.6, 0.0), (0.9, 1.0)):  # the wall's top is seen at a slope of 0.735
        scene = jaxhf.Scene([jaxhf.Object(field, jaxhf.Matte(1.0))], above, [jaxhf.Sun((1, 0, up), irradiance=np.pi)])
        cosine = up / np.hypot(1, up)
        np.testing.assert_allclose(jaxhf.render(scene)[0, 0], light * cosine, atol=1e-3)
