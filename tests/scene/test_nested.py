"""A fine terrain in a coarser one is the surface that one grid at the fine spacing has, and its seam is nowhere to be seen."""

import dataclasses
import functools
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.ndimage

import jaxhf
from jaxhf.fitting.model.pictures import choose_edge_samples
from jaxhf.preparation.localise import localise
from jaxhf.scene import procedural

TIMES, CELLS, AROUND = 8, 5, 6  # fine cells in a coarse one, coarse ones in the fine terrain, and on each side of it
FIRST = TIMES * AROUND  # fine post, of all, on the seam
COUNT = TIMES * CELLS  # fine cells in the fine terrain
ABOVE = jaxhf.Orthographic.look_at((0, 0, 1000), (0, 0, 0), up=(0, 1, 0), extent=1.0)


def on_triangles(heights, x, y):
    """Heights over places in cells, written apart from the package: triangle by triangle."""
    ix, iy = (np.clip(np.floor(at).astype(int), 0, n - 2) for at, n in zip((x, y), heights.shape[::-1], strict=True))
    u, v = x - ix, y - iy
    z00, z10, z01, z11 = heights[iy, ix], heights[iy, ix + 1], heights[iy + 1, ix], heights[iy + 1, ix + 1]
    return np.where(u >= v, z00 + u * (z10 - z00) + v * (z11 - z10), z00 + v * (z01 - z00) + u * (z11 - z01))


@functools.cache
def terrains():
    """The fine terrain and the coarse one as they are given, and as they are nested; and one grid of the same surface."""
    count = (2 * AROUND + CELLS) * TIMES + 1
    truth = procedural.fractal((count, count), seed=3, exponent=1.8, range=(0.0, 0.2 * count)).astype(np.float32)
    coarse, here = truth[::TIMES, ::TIMES], slice(FIRST, FIRST + COUNT + 1)
    inner = jaxhf.Heightfield(truth[here, here], 1.0, x0=float(FIRST), y0=float(FIRST))
    outer = jaxhf.Heightfield(coarse, float(TIMES))
    fine, around = jaxhf.nested(inner, outer)
    x, y = np.meshgrid(np.arange(count) / TIMES, np.arange(count) / TIMES)
    whole = on_triangles(coarse.astype(np.float64), x, y)
    whole[here, here] = np.asarray(fine.heights)[1:-1, 1:-1]
    return inner, outer, fine, around, jaxhf.Heightfield(whole.astype(np.float32), 1.0)


def scene(*fields, camera=ABOVE, lights=()):
    return jaxhf.Scene([jaxhf.Object(field) for field in fields], camera, lights)


def cameras():
    middle, height = FIRST + COUNT / 2, float(np.asarray(terrains()[2].heights).mean())
    target = (middle, middle, height)
    near = (middle - 0.9 * COUNT, middle - 0.8 * COUNT, height + COUNT)
    return {
        "perspective": jaxhf.Perspective.look_at(near, target, fov=50.0, width=64, height=64),
        "orthographic": jaxhf.Orthographic.look_at(
            (middle, middle, height + 400), target, up=(0, 1, 0), extent=1.5 * COUNT, width=64, height=64
        ),
    }


def seam_of(field):
    """Which vertices are on it."""
    assert field.seam is not None
    return np.isfinite(field.seam).all(-1)


def unmarked(field):
    """The same heights, as if the surface ended at the seam; the same programs serve it."""
    return dataclasses.replace(field, seam=np.full((*field.heights.shape, 2), np.nan))


def picture(kind, light, *fields, aovs=()):
    return jaxhf.render(scene(*fields, camera=cameras()[kind], lights=[light]), jaxhf.Settings(shading="flat"), aovs=aovs)


@pytest.mark.parametrize("kind", [pytest.param("perspective", marks=pytest.mark.deep), "orthographic"])
def test_a_picture_is_that_of_one_grid(kind):
    light, aovs = jaxhf.Directional.from_angles(150, 10), ("depth", "object")
    *_, fine, around, whole = terrains()
    nested, known = picture(kind, light, fine, around, aovs=aovs)
    one, other = picture(kind, light, whole, aovs=aovs)
    np.testing.assert_allclose(known["depth"], other["depth"], rtol=1e-5)
    assert np.mean(np.abs(nested - one).max(-1) > 1e-5) <= 1 / 4096  # where a rounding decides of a shadow
    # Shadows fall from the coarse one onto the fine one.
    sunk = dataclasses.replace(around, heights=around.heights - 1000)
    inside = np.asarray(known["object"]) == 0
    assert 0.2 < inside.mean() < 0.8
    assert np.mean(np.abs(picture(kind, light, fine, sunk, aovs=aovs)[0] - one).max(-1)[inside] > 0.05) > 0.04


@pytest.mark.deep
@pytest.mark.parametrize("light", [jaxhf.Sun.from_angles(250, 14, angular_diameter=2.0), jaxhf.Point((60, 60, 80), 5000.0)])
def test_other_lights_shine_on_it_as_on_one_grid(light):
    *_, fine, around, whole = terrains()
    nested, one = picture("orthographic", light, fine, around), picture("orthographic", light, whole)
    assert np.mean(np.abs(nested - one).max(-1) > 1e-3 * np.max(one)) <= 2 / 4096


@pytest.mark.slow
def test_the_fine_terrain_sees_as_much_of_the_sky_as_on_one_grid():
    """The coarse one sees it from its own vertices, and so differs; but it does see less where the fine one hides it."""
    *_, fine, around, whole = terrains()
    light, weight = jaxhf.Sky(1.0, occlusion=4), np.random.default_rng(0).normal(size=(64, 64, 3)).astype(np.float32)
    (nested, known), one = picture("orthographic", light, fine, around, aovs=("object",)), picture("orthographic", light, whole)
    off = np.abs(nested - one).max(-1)
    inside = np.asarray(known["object"]) == 0
    assert off[inside].max() < 1e-4
    assert off.mean() < 0.02 < np.abs(picture("orthographic", light, unmarked(fine), unmarked(around)) - one).max()

    def total(heights):
        moved = dataclasses.replace(fine, heights=heights)
        return jnp.sum(weight * picture("orthographic", light, moved, around))

    change = np.random.default_rng(1).normal(size=fine.heights.shape) * ~seam_of(fine)  # which lies on the other's edges
    forward = jax.jvp(total, (fine.heights,), (jnp.asarray(change, jnp.float32),))[1]
    np.testing.assert_allclose(jnp.vdot(jax.grad(total)(fine.heights), change), forward, rtol=1e-3)


@pytest.mark.slow
def test_a_fit_explains_shadows_from_beyond():
    """To the noise, of pictures of one grid; without surroundings residuals there are many times as large."""
    inner, outer, fine, _, whole = terrains()
    random, noise, middle = np.random.default_rng(1), 0.01, FIRST + COUNT / 2
    camera = jaxhf.Orthographic.look_at((middle, middle, 500), (middle, middle, 0), (0, 1, 0), COUNT - 4, width=36, height=36)
    suns = [jaxhf.Directional.from_angles(azimuth, 10) for azimuth in (30, 150, 270)]

    def seen(sun, *fields):
        return np.asarray(jaxhf.render(scene(*fields, camera=camera, lights=[sun]), jaxhf.Settings(samples=16)))[..., 0]

    exact = [seen(sun, whole) for sun in suns]
    targets = [picture + noise * random.standard_normal(picture.shape) for picture in exact]
    truth = np.asarray(fine.heights)[1:-1, 1:-1]
    alone = dataclasses.replace(inner, heights=jnp.asarray(truth))
    beyond = [np.abs(seen(sun, alone) - picture) > 0.03 for sun, picture in zip(suns, exact, strict=True)]
    assert max(where.mean() for where in beyond) > 0.05
    smooth = scipy.ndimage.gaussian_filter(truth, 3, mode="nearest")
    std = float(np.sqrt(np.mean((smooth - truth) ** 2)))
    fields = jaxhf.nested(dataclasses.replace(inner, heights=jnp.asarray(smooth)), outer)
    scenes = [scene(*fields, camera=camera, lights=[sun]) for sun in suns]
    found = jaxhf.fit(scenes, targets, prior=jaxhf.Prior(fields[0].heights, std, length=2.1), noise=noise)
    held = seam_of(fields[0])
    np.testing.assert_array_equal(np.asarray(found.heights)[held], np.asarray(fields[0].heights)[held])
    left = np.concatenate([np.asarray(off)[where] for off, where in zip(found.residuals, beyond, strict=True)])
    assert np.sqrt(np.mean(left**2)) < 1.5 * noise
    assert np.sqrt(np.mean((np.asarray(found.heights)[1:-1, 1:-1] - truth) ** 2)) < 0.6 * std


def places_on_seam(count, seed=0):
    """Points on the seam, many of them at vertices, in fine cells from its corner."""
    random = np.random.default_rng(seed)
    along, side = random.uniform(0, COUNT, count), random.integers(0, 4, count)
    along[::4], along[1::4] = np.round(along[::4]), TIMES * np.round(along[1::4] / TIMES)
    ends = np.array([0, COUNT, 0, COUNT])[side]
    return np.where(side < 2, ends, along), np.where(side < 2, along, ends)


def test_no_ray_gets_in_between():
    """One that is steeper than every triangle must hit; where both surfaces merely had the same border a tenth was lost."""
    *_, fine, around, whole = terrains()
    count, random = 200_000, np.random.default_rng(1)
    x, y = places_on_seam(count)
    p = np.stack([x + FIRST, y + FIRST, on_triangles(np.asarray(fine.heights, np.float64), x + 1, y + 1)], axis=-1)
    steepest = np.hypot(*(np.abs(np.diff(whole.heights, axis=axis)).max() for axis in (0, 1)))
    azimuth, slope = random.uniform(0, 2 * np.pi, count), steepest * (1.02 + np.exp(random.normal(-1, 2, count)))
    d = np.stack([np.cos(azimuth), np.sin(azimuth), -slope], axis=-1) / np.hypot(1, slope)[:, None]
    distance = np.exp(random.uniform(np.log(5), np.log(5000), count))
    hit = jaxhf.cast(scene(fine, around), p - d * distance[:, None], d)
    assert (np.asarray(hit.status) == jaxhf.Status.HIT).all()
    np.testing.assert_allclose(hit.t, distance, rtol=1e-5, atol=2e-3)


def test_shading_goes_on_across_the_seam():
    """A fiftieth of a cell to its two sides normals differ by what they turn over that way, not by tenths."""
    *_, fine, around, _ = terrains()
    x, y = places_on_seam(2000, seed=2)
    out = np.stack([np.where(x == 0, -1, np.where(x == COUNT, 1, 0)), np.where(y == 0, -1, np.where(y == COUNT, 1, 0))], -1)
    corner = np.abs(out).sum(-1) == 2
    beside = np.stack([x, y], -1) + FIRST + 0.02 * np.array([-1, 1])[:, None, None] * out

    def turn(*fields):
        o = np.concatenate([beside, np.full((*beside.shape[:-1], 1), 500.0)], -1)
        hit = jaxhf.cast(scene(*fields), o, (0, 0, -1))
        assert (np.asarray(hit.object)[:, ~corner] == [[0], [1]]).all()
        return np.linalg.norm(hit.ns[0] - hit.ns[1], axis=-1)

    assert turn(fine, around).max() < 0.02
    assert np.median(turn(unmarked(fine), unmarked(around))) > 0.05


@pytest.mark.parametrize("shading", ["smooth", pytest.param("flat", marks=pytest.mark.deep)])
def test_the_seam_bounds_nothing(shading):
    """Neither the fine terrain's border nor that of the hole in the coarse one: a fit needs no points on edges for them."""
    *_, fine, around, _ = terrains()

    def points(*fields):
        local = localise(scene(*fields, camera=cameras()["orthographic"]))
        return choose_edge_samples((local,), jaxhf.Settings(shading=shading))

    assert points(fine, around) == 0
    assert points(unmarked(fine), unmarked(around)) > 0


@pytest.mark.parametrize("points", [pytest.param(0, marks=pytest.mark.deep), pytest.param(20_000, marks=pytest.mark.slow)])
def test_the_derivative_is_that_of_one_grid(points):
    *_, fine, around, whole = terrains()
    change = np.random.default_rng(0).normal(size=fine.heights.shape)
    change[:4] = change[-4:] = change[:, :4] = change[:, -4:] = 0
    beyond = [(FIRST - 1, len(whole.heights) - FIRST + 1 - len(change))] * 2
    light, tangents = jaxhf.Directional.from_angles(150, 10), []
    settings = jaxhf.Settings(shading="flat", edge_samples=points, samples=4 if points else 1)
    for fields, dz in (((fine, around), change), ((whole,), np.pad(change, beyond))):
        seen = scene(*fields, camera=cameras()["orthographic"], lights=[light])
        keys = [jax.random.key(number) for number in range(4)] if points else [None]

        def drawn(z, key, seen=seen):
            return jaxhf.render(seen.with_heights(z), settings, key=key)

        at, along = (seen.heights,), (jnp.asarray(dz, jnp.float32),)
        tangents.append(np.mean([jax.jvp(functools.partial(drawn, key=key), at, along)[1] for key in keys], axis=0))
    nested, one = tangents
    size = np.sqrt(np.mean(one**2))
    assert size > 1e-3
    assert np.sqrt(np.mean((nested - one) ** 2)) < (0.4 if points else 1e-5) * size


def test_terrains_that_are_not_aligned_meet_all_the_same():
    """A map whose posts stand anywhere, in UTM coordinates, with holes in both."""
    inner, outer, *_ = terrains()
    holed = np.asarray(inner.heights).copy()
    holed[27:30, 26:28] = np.nan
    far = 4e5, 5e6
    fine = jaxhf.Heightfield(holed, 1.0, x0=far[0] + FIRST, y0=far[1] + FIRST)
    heights = np.asarray(outer.heights).copy()
    heights[AROUND + 2, AROUND + 2] = heights[0, 0] = np.nan
    coarse = jaxhf.Heightfield(heights, 8.3, 7.9, far[0] - 3.7, far[1] + 2.2)
    found, around = jaxhf.nested(fine, coarse, blend=3)
    assert (around.dx, around.dy) == (8, 8)
    rim = np.asarray(found.heights)[1:-1, 1:-1]
    first, last = (np.round((found.x0 + 1 + n - around.x0) / 8, 9) for n in (0, rim.shape[1] - 1))
    assert first == int(first)
    assert last == int(last)  # whole coarse cells
    row = around.heights[round((found.y0 + 1 - around.y0) / 8)]
    expected = np.interp(first + np.arange(rim.shape[1]) / 8, np.arange(row.size), row)
    np.testing.assert_allclose(rim[0], expected, rtol=1e-6)
    # The coarse posts lie on its surface, where those of one grid are.
    x, y = around.x0 + 8 * np.arange(around.heights.shape[1]), around.y0 + 8 * np.arange(around.heights.shape[0])
    there = on_triangles(heights.astype(np.float64), *np.meshgrid((x - coarse.x0) / 8.3, (y - coarse.y0) / 7.9))
    both = np.isfinite(there) & np.isfinite(around.heights)
    assert both.mean() > 0.8
    np.testing.assert_allclose(np.asarray(around.heights)[both], there[both], rtol=1e-6)
    # Inside of what is blended the heights are the given ones, their holes filled from the coarse surface.
    assert np.isfinite(rim).all()
    x, y = (int(found.x0 + 1 - fine.x0), int(found.y0 + 1 - fine.y0))
    given = holed[y : y + rim.shape[0], x : x + rim.shape[1]][3:-3, 3:-3]
    np.testing.assert_array_equal(np.where(np.isnan(given), rim[3:-3, 3:-3], given), rim[3:-3, 3:-3])


def test_three_terrains_nest():
    inner, outer, *_ = terrains()
    middle = jaxhf.Heightfield(outer.heights, 8.0)
    wide = jaxhf.Heightfield(np.linspace(0, 30, 21 * 21).reshape(21, 21).astype(np.float32), 32.0, x0=-260.0, y0=-260.0)
    fields = jaxhf.nested(inner, middle, wide)
    assert [field.dx for field in fields] == [1, 8, 32]
    x, y = np.meshgrid(np.linspace(-220, 340, 150), np.linspace(-220, 340, 150))
    o = np.stack([x, y, np.full(x.shape, 500.0)], -1)
    hit = jaxhf.cast(scene(*fields), o, (0, 0, -1))
    assert (np.asarray(hit.status) == jaxhf.Status.HIT).all()
    assert set(np.unique(hit.object)) == {0, 1, 2}
    assert seam_of(fields[1]).sum() > seam_of(jaxhf.nested(inner, middle)[1]).sum()


def field(count, spacing, x0=0.0, y0=0.0, heights=None):
    heights = np.zeros((count, count)) if heights is None else heights
    return jaxhf.Heightfield(heights, float(spacing), x0=float(x0), y0=float(y0))


HOLED = np.zeros((20, 20))
HOLED[5, 7] = np.nan


@pytest.mark.parametrize(
    ("call", "says"),
    [
        (lambda: jaxhf.nested(field(9, 1)), "fields must be two or more, from fine to coarse, they are 1"),
        (lambda: jaxhf.nested(field(9, 1), cast(Any, 3)), "fields must be Heightfields .*, it is an int"),
        (lambda: jaxhf.nested(field(40, 1, 40, 40), field(20, 8), blend=0), "blend must be a whole number from 1 on, it is 0"),
        (lambda: jaxhf.nested(field(40, 8), field(80, 1)), "must come from fine to coarse; along y the cells of one have 8"),
        (lambda: jaxhf.nested(field(40, 1, 0, 40), field(20, 8)), "for 2 of its cells .* along x one lies from 0 to 39"),
        (lambda: jaxhf.nested(field(16, 1, 40, 40), field(20, 8)), "must hold 3 cells of the next coarser one .* along y"),
        (lambda: jaxhf.nested(field(41, 1, 40, 40), field(20, 8, heights=HOLED)), "one has one at x 49, y 40"),
        (lambda: jaxhf.nested(*terrains()[2:4]), "must not be nested already"),
        (lambda: jax.eval_shape(lambda z: jaxhf.nested(field(40, 1, 40, 40, z), field(20, 8)), np.zeros((40, 40))),
         "must have heights that are known, theirs are traced by JAX"),
        (lambda: jaxhf.Heightfield(np.zeros((3, 4)), seam=np.zeros((3, 4))), r"seam must have shape \(3, 4, 2\)"),
    ],
)  # fmt: skip
def test_what_does_not_nest_is_refused(call, says, as_users_call_it):
    with pytest.raises(jaxhf.ArgumentError, match=says):
        call()
