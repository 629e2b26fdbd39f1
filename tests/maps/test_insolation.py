"""Sunlight of a day and longer, against suns one by one, closed forms and differences."""

import datetime
import re

import jax
import jax.numpy as jnp
import numpy as np
import oracle
import pytest

import jaxhf
from jaxhf.io.terrain.georeference import CoordinateSystem, Georeference
from jaxhf.maps.clear_sky import above_the_air, beam, diffuse
from jaxhf.maps.shadows import lit
from jaxhf.maps.sunlight import suns_of

BEGIN, DAY = np.datetime64("2026-03-10"), np.timedelta64(1, "D")
PLACE = (46.5, 0.0)
CELL = 100.0


def mountains():
    """Of 0 to 2000 m, steep enough to keep the sun away for hours, with a hole."""
    rng = np.random.default_rng(3)
    y, x = np.indices((26, 37)).astype(float)
    z = 900 + 500 * np.sin(0.5 * x) * np.cos(0.4 * y) + 300 * rng.uniform(-1, 1, size=x.shape)
    z[5, 30] = np.nan
    return z.astype(np.float32)


def suns(begin, end, count, place=PLACE):
    """Times, azimuths and altitudes of so many suns that are up, and the hours for which each stands."""
    times = begin + ((np.arange(count) + 0.5) * ((end - begin) / np.timedelta64(1, "s") / count)).astype("timedelta64[s]")
    azimuth, altitude = jaxhf.sun(times, *place, refraction=True)
    up = altitude > 0
    return times[up], azimuth[up], altitude[up], (end - begin) / np.timedelta64(1, "h") / count


def direct(z, turbidity, times, azimuth, altitude, hours):
    """kWh/m² and hours, sun by sun: a ray from each vertex, its own height of air, its normal."""
    normal = oracle.vertex_normals(z.astype(float), CELL, CELL, "six")[0]
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    turn, up = np.deg2rad(azimuth), np.deg2rad(altitude)
    towards = np.stack([np.sin(turn) * np.cos(up), np.cos(turn) * np.cos(up), np.sin(up)], -1)
    energy, shining = np.zeros(z.shape), np.zeros(z.shape)
    for k, s in enumerate(towards):
        high = jnp.full(z.size, altitude[k])
        shares = np.asarray(beam(high, jnp.asarray(np.nan_to_num(z).ravel()), jnp.asarray(turbidity))).reshape(z.shape)
        there = lit(z, CELL, CELL, azimuth[k], altitude[k]) & (normal @ s > 0)
        energy += above_the_air(times[k : k + 1])[0] / 1000 * hours * shares * np.where(there, normal @ s, 0)
        shining += hours * there
    return np.where(np.isnan(z), np.nan, energy), np.where(np.isnan(z), np.nan, shining)


def test_a_day_is_that_of_a_thousand_suns():
    """Of slopes up to 80 degrees, on which 64 azimuths are right to 2 % on average, 256 to 0.5 %."""
    z, turbidity = mountains(), 3.0
    z[5, 30] = z[5, 29]
    energy, hours = direct(z, turbidity, *suns(BEGIN, BEGIN + DAY, 2048))
    off = {}
    for azimuths in (64, 256):
        found = np.asarray(jaxhf.insolation(z, BEGIN, BEGIN + DAY, PLACE, wanted="direct", azimuths=azimuths, dx=CELL))
        off[azimuths] = np.abs(found - energy) / energy.mean()
    assert off[256].mean() < 0.006 < 2 * off[256].mean() < off[64].mean() < 0.025
    assert off[256].max() < 0.06, off[256].max()
    found = np.asarray(jaxhf.insolation(z, BEGIN, BEGIN + DAY, PLACE, wanted="hours", azimuths=256, dx=CELL))
    off = np.abs(found - hours)
    assert off.mean() < 0.05, off.mean()
    assert hours.min() < 6 < 11 < hours.max()


def test_a_hole_has_none():
    found = jaxhf.insolation(mountains(), BEGIN, BEGIN + DAY, PLACE, azimuths=8, dx=CELL)
    np.testing.assert_array_equal(np.isnan(found), np.isnan(mountains()))


def test_on_a_plane():
    """Level, the energy outside of the air has a closed form, and so has the length of the day; tilted, the sky's has."""
    level, _ = suns_of(BEGIN, BEGIN + DAY, PLACE, 0.0, 3.0, 16, "direct", np.float64)
    assert level is not None
    noon = BEGIN + np.timedelta64(12, "h")
    _, high = jaxhf.sun(noon + np.arange(-30, 31) * np.timedelta64(60, "s"), *PLACE)
    latitude, declination = np.deg2rad(PLACE[0]), np.deg2rad(high.max() - 90 + PLACE[0])
    half = np.arccos(-np.tan(latitude) * np.tan(declination))
    turn = np.cos(latitude) * np.cos(declination) * np.sin(half) + half * np.sin(latitude) * np.sin(declination)
    np.testing.assert_allclose(level[2].sum(), 24 / np.pi * above_the_air(np.array([noon]))[0] / 1000 * turn, rtol=0.005)

    flat = np.zeros((4, 5), np.float32)
    hours = np.asarray(jaxhf.insolation(flat, BEGIN, BEGIN + DAY, PLACE, wanted="hours", dx=CELL))
    lifted = np.sin(np.deg2rad(-0.48))  # by refraction the sun's centre is seen when it stands so low
    day = 24 / np.pi * np.arccos(lifted / (np.cos(latitude) * np.cos(declination)) - np.tan(latitude) * np.tan(declination))
    np.testing.assert_allclose(hours, day, atol=0.06)

    rise = 0.7
    y = np.indices(flat.shape)[0]
    times, azimuth, altitude, step = suns(BEGIN, BEGIN + DAY, 1440)
    sky = np.sum(above_the_air(times) / 1000 * step * diffuse(altitude, 4.0))
    found = {
        wanted: np.asarray(
            jaxhf.insolation(
                (rise * CELL * y).astype(np.float32), BEGIN, BEGIN + DAY, PLACE, wanted=wanted, turbidity=4.0, dx=CELL
            )
        )
        for wanted in ("energy", "direct", "diffuse")
    }
    tilt = np.arctan(rise)
    np.testing.assert_allclose(found["diffuse"], sky * (1 + np.cos(tilt)) / 2, rtol=2e-3)
    np.testing.assert_allclose(found["energy"], found["direct"] + found["diffuse"], rtol=1e-5)
    energy, _ = direct(rise * CELL * y.astype(float), 4.0, times, azimuth, altitude, step)
    np.testing.assert_allclose(found["direct"], energy, rtol=5e-3)


def test_energy_is_what_comes_from_sun_and_sky():
    """Also where the few azimuths leave a vertex suns that stand behind its slope."""
    z = (5 * mountains()).astype(np.float32)
    parts = {
        wanted: np.asarray(jaxhf.insolation(z, BEGIN, BEGIN + DAY, PLACE, wanted=wanted, azimuths=8, dx=CELL))
        for wanted in ("energy", "direct", "diffuse")
    }
    assert np.nanmin(parts["direct"]) == 0
    np.testing.assert_allclose(parts["energy"], parts["direct"] + parts["diffuse"], rtol=1e-5)


@pytest.mark.parametrize(("turbidity", "day"), [(3.0, "2026-06-21"), (6.0, "2026-12-21")])
def test_the_air_above_each_height(turbidity, day):
    """Level ground of 0 to 4800 m, right to 0.2 %; with the lowest and the highest alone it would be to 1.4 %."""
    begin = np.datetime64(day)
    z = np.repeat(np.linspace(0, 4800, 33, dtype=np.float32)[:, None], 3, axis=1)
    found = np.asarray(jaxhf.insolation(z, begin, begin + DAY, PLACE, wanted="direct", turbidity=turbidity, azimuths=8, dx=1e9))
    times, _, altitude, hours = suns(begin, begin + DAY, 1440)
    light = above_the_air(times) / 1000 * hours * np.sin(np.deg2rad(altitude))
    expected = [
        np.sum(light * np.asarray(beam(jnp.asarray(altitude), jnp.asarray(h), jnp.asarray(turbidity)))) for h in z[:, 1]
    ]
    np.testing.assert_allclose(found[:, 1], expected, rtol=2e-3)


def test_y_may_point_aside_of_north():
    """Then the whole sky is turned; a quarter of a turn changes places of the azimuths alone."""
    (north, sky), (east, other) = (
        suns_of(BEGIN, BEGIN + DAY, PLACE, turned, 3.0, 8, "energy", np.float64) for turned in (0.0, 90.0)
    )
    assert north is not None
    assert east is not None
    assert north[2].sum() > 1
    np.testing.assert_allclose(east[2], np.roll(north[2], -2, axis=0), rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(east[0], -np.roll(north[1], -2, axis=0), rtol=1e-9, atol=1e-9)
    assert sky == other


def test_a_map_in_metres_says_where_it_lies_and_how_it_is_turned():
    rasterio = pytest.importorskip("rasterio")
    wkt = rasterio.crs.CRS.from_epsg(32632).to_wkt()  # 3 degrees east of its middle
    located = jaxhf.Terrain(mountains(), CELL, CELL, 7.2e5, 5.15e6, CoordinateSystem(), Georeference(wkt))
    assert 1 < located.convergence < 4
    found = np.asarray(jaxhf.insolation(located, BEGIN, BEGIN + DAY, wanted="direct", azimuths=64))
    rays = suns(BEGIN, BEGIN + DAY, 512, located.place)
    energy, _ = direct(mountains(), 3.0, rays[0], rays[1] - located.convergence, *rays[2:])
    wrong, _ = direct(mountains(), 3.0, rays[0], rays[1] + located.convergence, *rays[2:])
    assert np.nanmean(np.abs(found - energy)) < 0.6 * np.nanmean(np.abs(found - wrong))


@pytest.mark.x64
@pytest.mark.parametrize("wanted", ["energy", pytest.param("hours", marks=pytest.mark.deep)])
def test_derivative(wanted):
    """Along a random change of the heights, by differences; hours change by the horizons alone."""
    z = mountains().astype(np.float64)
    z[5, 30] = z[5, 29]
    rng = np.random.default_rng(0)
    change, weights = rng.standard_normal((2, *z.shape))

    def total(heights):
        found = jaxhf.insolation(heights, BEGIN, BEGIN + DAY, PLACE, wanted=wanted, azimuths=8, dx=CELL)
        return jnp.sum(weights * found)

    _, slope = jax.jvp(total, (jnp.asarray(z),), (jnp.asarray(change),))
    gradient = jax.grad(total)(jnp.asarray(z))
    step = 1e-5
    ahead, behind = (float(total(jnp.asarray(z + sign * step * change))) for sign in (1, -1))
    np.testing.assert_allclose(slope, (ahead - behind) / (2 * step), rtol=1e-4)
    np.testing.assert_allclose(jnp.sum(gradient * change), slope, rtol=1e-8)


@pytest.mark.parametrize(
    ("arguments", "options", "expected"),
    [
        ((BEGIN, BEGIN, PLACE), {}, "insolation: end must come after begin, 2026-03-10, by ten years at most, it is 2026-"),
        ((BEGIN, BEGIN + 4000 * DAY, PLACE), {}, "by ten years at most"),
        ((datetime.datetime(2026, 3, 10), BEGIN, PLACE), {}, "insolation: begin must have a time zone"),
        (("2026-03-10", BEGIN + DAY, PLACE), {}, "insolation: begin must be a datetime or datetime64, it is str"),
        ((BEGIN, BEGIN + DAY), {}, "insolation: place must be latitude and longitude, unless a Terrain says where it lies"),
        ((BEGIN, BEGIN + DAY, (46.5,)), {}, "insolation: place must be latitude and longitude, degrees, it is (46.5,)"),
        ((BEGIN, BEGIN + DAY, (95.0, 0.0)), {}, "insolation: latitude must lie between -90 and 90 degrees, it is 95"),
        ((BEGIN, BEGIN + DAY, ("a", "b")), {}, "insolation: place must be latitude and longitude, degrees, it is ('a', 'b')"),
        ((BEGIN, np.array([BEGIN + DAY]), PLACE), {}, "insolation: end must be one time, its shape is (1,)"),
        ((BEGIN, BEGIN + DAY, PLACE), {"turbidity": 0.0}, "insolation: turbidity must be a number from 1 to 10, it is 0.0"),
        ((BEGIN, BEGIN + DAY, PLACE), {"turbidity": "3"}, "insolation: turbidity must be a number from 1 to 10, it is '3'"),
        ((BEGIN, BEGIN + DAY, PLACE), {"wanted": "joules"}, "insolation: wanted must be one of energy, direct, diffuse, hours"),
        ((BEGIN, BEGIN + DAY, PLACE), {"azimuths": 3}, "insolation: azimuths must be a whole number from 4 on, it is 3"),
    ],
)
@pytest.mark.usefixtures("as_users_call_it")
def test_wrong_arguments_are_refused(arguments, options, expected):
    with pytest.raises(ValueError, match=re.escape(expected)):
        jaxhf.insolation(mountains(), *arguments, dx=CELL, **options)
