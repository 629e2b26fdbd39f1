"""Horizon angles and sky-view factors, against all crossings one by one, closed forms and differences."""

import jax
import jax.numpy as jnp
import numpy as np
import oracle
import pytest

import jaxhf

SHAPE = (41, 165)
Y, X = np.indices(SHAPE).astype(float)
SMALL = (9, 12)
AZIMUTHS = np.array([0, 45, 90, 180, 225, 315, 17, 100.0, 200, 333, 26.56505117707799])


def surface(z, x, y):
    """Heights at points in cells, nan beyond the surface; of a cell to the lower left where a point lies on its border."""
    ny, nx = z.shape
    ix, iy = np.floor(x).astype(int), np.floor(y).astype(int)
    inside = (ix >= 0) & (iy >= 0) & (ix < nx - 1) & (iy < ny - 1)
    ix, iy = np.clip(ix, 0, nx - 2), np.clip(iy, 0, ny - 2)
    u, v = x - ix, y - iy
    a, b, c, d = z[iy, ix], z[iy, ix + 1], z[iy + 1, ix], z[iy + 1, ix + 1]
    height = np.where(u >= v, a + u * (b - a) + v * (d - b), a + v * (c - a) + u * (d - c))
    return np.where(inside & np.isfinite(a + b + c + d), height, np.nan)


def every_crossing(z, azimuth, dx, dy, lowest):
    """Horizon angles in double precision, each crossing of a line from each vertex looked at from all cells round it."""
    turn = np.deg2rad(azimuth)
    gx, gy = np.sin(turn) / dx, np.cos(turn) / dy
    slopes = np.full(z.shape, np.tan(np.deg2rad(lowest)) if lowest > -90 else -np.inf)
    iy, ix = np.indices(z.shape)
    tiny = 1e-9
    for rate in (gx, gy, gx - gy):
        for line in range(1, sum(z.shape)) if abs(rate) > 1e-12 * np.hypot(gx, gy) else ():
            s = line / abs(rate)
            if abs(gx * s) > z.shape[1] or abs(gy * s) > z.shape[0]:
                break  # beyond the surface, from wherever
            for off_x, off_y in ((tiny, 2 * tiny), (2 * tiny, tiny), (-tiny, tiny), (tiny, -tiny), (-tiny, -2 * tiny)):
                height = surface(z, ix + gx * s + off_x, iy + gy * s + off_y)
                slopes = np.fmax(slopes, (height - z) / s)
    return np.where(np.isnan(z), np.nan, np.rad2deg(np.arctan(slopes)))


WEIGHTINGS = ("solid-angle", "horizontal", "slope")


def skies(z, count, dx, dy):
    """Sky-view factors by weighting, from every crossing: means over even azimuths of what the docstring says."""
    azimuths = 360 * np.arange(count) / count
    h, turns = (np.deg2rad(each) for each in (np.stack([every_crossing(z, a, dx, dy, 0.0) for a in azimuths]), azimuths))
    n, east, north = oracle.vertex_normals(z, dx, dy, "six")[0], np.sin(turns)[:, None, None], np.cos(turns)[:, None, None]
    n /= np.linalg.norm(n, axis=-1, keepdims=True)
    aside = (n[..., 0] * east + n[..., 1] * north) * (np.pi / 2 - h - np.sin(h) * np.cos(h))
    shares = 1 - np.sin(h), np.cos(h) ** 2, n[..., 2] * np.cos(h) ** 2 + aside
    return dict(zip(WEIGHTINGS, (np.maximum(share.mean(0), 0) for share in shares), strict=True))


def rough():
    """Holes, and to the east of them stretches of tiles without."""
    rng = np.random.default_rng(4)
    z = 4 * rng.uniform(size=SHAPE) + 0.3 * X
    z[rng.integers(SHAPE[0], size=40), rng.integers(40, size=40)] = np.nan
    return z.astype(np.float32)


@pytest.mark.parametrize(
    ("lowest", "tolerance"),
    [(-90.0, 2e-4), pytest.param(0.0, 1e-6, marks=[pytest.mark.x64, pytest.mark.deep])],  # in double precision to its last bits
)
def test_horizon_is_that_of_every_crossing(lowest, tolerance):
    """Several tiles and stretches, rectangular cells, holes, directions along lines, along diagonals and through vertices.

    Points are taken 1e-9 cells off the lines, at slopes of up to 8; single precision is good to some 1e-6 of an angle.
    """
    z = rough().astype(np.float64 if jax.config.read("jax_enable_x64") else np.float32)
    found = jaxhf.horizon(z, AZIMUTHS, dx=2.0, dy=1.0, lowest=lowest)
    assert found.dtype == z.dtype
    for azimuth, angles in zip(AZIMUTHS, np.asarray(found), strict=True):
        np.testing.assert_allclose(angles, every_crossing(z.astype(float), azimuth, 2.0, 1.0, lowest), atol=tolerance)


def test_closed_forms():
    """A plane, a valley, a pit with a flat floor, a far wall a little above a near one; the sky that an inclined plane sees.

    In single precision heights between vertices are 4e-6 off, 2e-4 degrees a cell away.
    """
    a = np.deg2rad(AZIMUTHS)[:, None, None]
    plane = np.asarray(jaxhf.horizon(0.5 * X - 0.25 * Y, AZIMUTHS, dx=1.0))[:, 1:-1, 1:-1]
    slope = 0.5 * np.sin(a) - 0.25 * np.cos(a)
    np.testing.assert_allclose(plane, np.rad2deg(np.arctan(np.fmax(slope, 0))) + 0 * plane, atol=1e-3)
    valley = np.asarray(jaxhf.horizon(0.75 * np.abs(X - 36), AZIMUTHS, dx=1.0))[:, 20, 36]
    np.testing.assert_allclose(valley, np.rad2deg(np.arctan(0.75 * np.abs(np.sin(a[:, 0, 0])))), atol=1e-3)
    pit = np.asarray(jaxhf.horizon(np.where(np.hypot(X - 36, Y - 20) < 17.5, -12.0, 0.0), AZIMUTHS, dx=1.0))[:, 20, 36]
    assert np.all((pit > np.rad2deg(np.arctan(12 / 19))) & (pit < np.rad2deg(np.arctan(12 / 17))))
    walls = np.asarray(jaxhf.horizon(np.where(X == 20, 6.0, np.where(X == 33, 33 * 0.302, 0.0)), AZIMUTHS, dx=1.0))[2, :, 0]
    np.testing.assert_allclose(walls, np.rad2deg(np.arctan(0.302)), atol=1e-4)
    seen = jaxhf.sky_view((0.5 * X - 0.25 * Y)[:9, :12], 8, weighting="slope", dx=1.0)[1:-1, 1:-1]
    np.testing.assert_allclose(seen, (1 + 1 / np.sqrt(1.3125)) / 2, atol=1e-5)  # 2e-6 of it as there are eight azimuths


def test_sky_view_is_the_mean_over_every_crossing_at_any_size():
    """From the smallest heights and cells that single precision has to the largest, slopes beyond 1e50 included."""
    z = np.random.default_rng(7).uniform(-7, 7, SMALL).astype(np.float32)
    tiny, little, large, huge = 2.0**-140, 2.0**-59, 2.0**59, 2.0**125
    for scale, cell in ((1.0, 2.0), (tiny, little), (tiny, large), (huge, little), (huge, large), (2.0**60, large)):
        scaled = z * np.float32(scale)
        for weighting, expected in skies(scaled.astype(float), 8, cell, 1.5 * cell).items():
            found = jaxhf.sky_view(scaled, 8, dx=cell, dy=1.5 * cell, weighting=weighting)
            np.testing.assert_allclose(found, expected, atol=2e-6, err_msg=str((scale, cell, weighting)))
            for kind in (jaxhf.Heightfield, jaxhf.Terrain) if scale == 1 else ():
                np.testing.assert_array_equal(jaxhf.sky_view(kind(z, cell, 1.5 * cell), 8, weighting=weighting), found)


def test_derivatives_are_differences_of_every_crossing():
    """Forwards and backwards, beside a hole and at the border, in single precision."""
    rng = np.random.default_rng(3)
    z, dz = rng.normal(size=(2, *SMALL)).astype(np.float32).astype(float)
    z[4, 5], dz[4, 5] = np.nan, 0
    weights, eps = rng.normal(size=SMALL), 1e-5
    ahead, behind = (np.nansum(weights * skies(z + sign * eps * dz, 8, 1.0, 1.0)["slope"]) for sign in (1, -1))
    numeric = (ahead - behind) / (2 * eps)
    assert abs(numeric) > 1e-2

    def weighted(z):
        seen = jaxhf.sky_view(z, 8, weighting="slope", dx=1.0)
        return jnp.sum(jnp.where(jnp.isnan(seen), 0, seen * weights.astype(np.float32)))

    @jax.jit
    def both(z, dz):
        _, forward = jax.linearize(weighted, z)
        return forward(dz), jax.linear_transpose(forward, z)(jnp.ones((), np.float32))[0]

    tangent, gradient = both(z.astype(np.float32), dz.astype(np.float32))
    np.testing.assert_allclose(tangent, numeric, rtol=1e-4)
    assert np.all(np.isfinite(gradient))
    np.testing.assert_allclose(np.sum(gradient * dz), numeric, rtol=1e-4)


FLAT = np.zeros((2, 2))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: jaxhf.horizon(FLAT, 0, dx=1.0), "horizon: azimuths must be a whole number from 1 on, it is 0"),
        (lambda: jaxhf.horizon(FLAT, [np.nan], dx=1.0), "horizon: azimuths must be a whole number or a list of finite"),
        (lambda: jaxhf.horizon(FLAT, lowest=90.0, dx=1.0), "horizon: lowest must be from -90 to below 90 degrees, it is 90.0"),
        (lambda: jaxhf.horizon(FLAT[0], dx=1.0), "Heightfield: heights must have shape (ny, nx) of at least 2x2"),
        (lambda: jaxhf.sky_view(FLAT, -2, dx=1.0), "sky_view: azimuths must be a whole number from 1 on, it is -2"),
        (lambda: jaxhf.sky_view(FLAT, weighting="x", dx=1.0), "sky_view: weighting must be one of solid-angle, horiz"),
        (lambda: jaxhf.sky_view(jaxhf.Heightfield(FLAT), dx=1.0), "sky_view: dx must stand without a Heightfield, w"),
    ],
)
def test_what_is_refused(make, message):
    with pytest.raises(jaxhf.ArgumentError) as error:
        make()
    assert str(error.value).startswith(message)
