"""Where the sun stands, against the SPA of Reda and Andreas as pvlib 0.13 has it, which is good to 0.0003 degrees."""

import datetime
from typing import Any

import numpy as np
import pytest

import jaxhf

# UTC, latitude, longitude: azimuth, altitude without and with refraction (1010 hPa, 10 degrees)
SPA = [
    ("1950-03-02T07:10:00", 51.5, -0.1, 105.7962, 2.9724, 3.2013),
    ("1969-07-20T20:17:40", 28.6, -80.6, 267.9040, 50.9616, 50.9753),
    ("1987-12-22T03:00:00", -33.9, 151.2, 301.3239, 72.0711, 72.0766),
    ("2000-02-29T12:00:00", 0.0, 0.0, 158.2055, 81.6585, 81.6610),
    ("2012-06-05T22:29:00", -45.0, 170.5, 30.5527, 16.3443, 16.4005),
    ("2026-06-21T12:00:00", 46.5, 8.0, 197.3359, 66.1497, 66.1572),
    ("2031-09-23T18:45:30", 69.7, -150.0, 131.5225, 13.5491, 13.6168),
    ("2044-01-15T05:30:00", -77.8, 166.7, 288.1368, 25.4940, 25.5291),
    ("2050-11-30T23:59:59", 35.7, -120.3, 236.1786, 7.5712, 7.6865),
]
NOON = datetime.datetime(2026, 6, 21, 12, tzinfo=datetime.UTC)
ANYTHING: Any = jaxhf


def towards(azimuth, altitude):
    return jaxhf.Directional.from_angles(azimuth, altitude).towards


@pytest.mark.parametrize(("time", "latitude", "longitude", "azimuth", "altitude", "apparent"), SPA)
def test_the_sun_is_where_spa_has_it(time, latitude, longitude, azimuth, altitude, apparent):
    instant = datetime.datetime.fromisoformat(time).replace(tzinfo=datetime.UTC)
    found = jaxhf.sun(instant, latitude, longitude)
    assert np.rad2deg(np.linalg.norm(towards(*found) - towards(azimuth, altitude))) < 0.005
    lifted = jaxhf.sun(instant, latitude, longitude, refraction=True)
    assert lifted[0] == found[0]
    if altitude > 0:
        assert abs(lifted[1] - apparent) < 0.005


def test_time_zones_and_arrays():
    there = datetime.timezone(datetime.timedelta(hours=-7))
    assert jaxhf.sun(NOON.astimezone(there), 46.5, 8) == jaxhf.sun(NOON, 46.5, 8)
    assert jaxhf.sun(np.datetime64("2026-06-21T12:00"), 46.5, 8) == jaxhf.sun(NOON, 46.5, 8)
    hours = np.datetime64("2026-06-21") + np.arange(24).astype("timedelta64[h]")
    azimuth, altitude = jaxhf.sun(hours[:, None], np.array([46.5, -33.0]), 8)
    assert azimuth.shape == altitude.shape == (24, 2)
    assert (azimuth[12, 0], altitude[12, 0]) == jaxhf.sun(NOON, 46.5, 8)


def test_light_by_date_and_place():
    light = jaxhf.Directional.at(NOON, 46.5, 8, irradiance=2.0)
    np.testing.assert_array_equal(light.towards, towards(*jaxhf.sun(NOON, 46.5, 8)))
    np.testing.assert_array_equal(light.irradiance, 2.0)
    # In the morning the air lifts it by 0.229 degrees.
    morning = datetime.datetime.fromisoformat(SPA[0][0]).replace(tzinfo=datetime.UTC)
    for kind in (jaxhf.Directional, jaxhf.Sun):
        lifted, seen = kind.at(morning, 51.5, -0.1, refraction=True), kind.at(morning, 51.5, -0.1)
        altitudes = [np.rad2deg(np.arcsin(one.towards[2])) for one in (lifted, seen)]
        np.testing.assert_allclose(altitudes, [3.2013, 2.9724], atol=0.005)


@pytest.mark.parametrize(
    ("make", "message"),
    [(lambda: jaxhf.sun(NOON.replace(tzinfo=None), 0, 0), "sun: time must have a time zone, as 2026-06-21T12:00:00Z has, it"),
     (lambda: jaxhf.sun("2026-06-21", 0, 0), "sun: time must be a datetime or datetime64, it is str"),
     (lambda: jaxhf.sun(np.datetime64("NaT", "s"), 0, 0), "sun: time must be a time, it is NaT"),
     (lambda: jaxhf.sun(NOON, 91, 0), "sun: latitude must lie between -90 and 90 degrees, it is 91"),
     (lambda: jaxhf.sun(NOON, np.nan, 0), "sun: latitude must be finite, it is nan"),
     (lambda: jaxhf.Directional.at(NOON, 0, 180), "Directional: time must be one at which the sun is up, its altitude is -6"),
     (lambda: ANYTHING.Directional.at(NOON, [0, 1], 0), "Directional: time and place must be one of each, they make 2 lights")],
)  # fmt: skip
def test_what_is_refused(make, message):
    with pytest.raises(jaxhf.ArgumentError) as error:
        make()
    assert str(error.value).startswith(message)
