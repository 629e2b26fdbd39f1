"""Where the sun stands, by time and place."""

import datetime
from typing import Any

import numpy as np

from ..core.errors import ArgumentError
from ..core.rules import require
from ..core.types import NUMBERS

_J2000 = np.datetime64("2000-01-01T12:00:00", "us")
_CLOCK = 64 / 86400  # days by which terrestrial time ran ahead of UTC in 2000; 29 s in 1950, 93 s at most until 2050


def sun(time: Any, latitude: Any, longitude: Any, *, refraction: bool = False) -> tuple[Any, Any]:
    """The sun's azimuth and altitude, in degrees; within 0.01 degrees from 1950 to 2050.

    The low-accuracy theory of Meeus (Astronomical Algorithms, 1991, chapter 24) with the planets' and the Moon's terms of his
    earlier book (Astronomical Formulae for Calculators, 1979, chapter 18), sidereal time with the equation of the equinoxes,
    and the sun's parallax. The largest of 11 000 angles to the SPA of Reda and Andreas (Solar Energy 76(5), 2004) is 0.0037.

    Args:
      time: a `datetime` with a time zone, or one or an array of NumPy's datetime64, which are in UTC. UTC counts as UT1, from
        which it has been less than 0.9 s away since 1972 (0.004 degrees).
      latitude, longitude: of the observer, degrees, north and east positive; numbers or arrays.
      refraction: whether to add that of air at 1010 hPa and 10 degrees Celsius (Sæmundsson, Sky and Telescope 72, 1986), for
        a sun that stands higher than -1 degree; it lifts the sun by 0.5 degrees at the horizon.

    Returns:
      (azimuth, altitude): the azimuth clockwise from north, 0 to 360; the altitude of the sun's centre above the horizon.
      Numbers, or arrays where an argument is one: `time`, `latitude` and `longitude` are broadcast against each other.

    Raises:
      ValueError: a `datetime` has no time zone, or the place is not on the globe.
    """
    days = (utc("sun", "time", time) - _J2000) / np.timedelta64(1, "D")
    latitude, longitude = np.asarray(latitude, np.float64), np.asarray(longitude, np.float64)
    require_place("sun", latitude, longitude)
    right_ascension, declination, sidereal, parallax = _equatorial(days)
    hour, phi = np.deg2rad(sidereal + longitude) - right_ascension, np.deg2rad(latitude)
    east = -np.cos(declination) * np.sin(hour)
    north = np.sin(declination) * np.cos(phi) - np.cos(declination) * np.cos(hour) * np.sin(phi)
    up = np.sin(declination) * np.sin(phi) + np.cos(declination) * np.cos(hour) * np.cos(phi)
    azimuth = np.rad2deg(np.arctan2(east, north)) % 360
    altitude = np.rad2deg(np.arctan2(up, np.hypot(east, north)) - parallax * np.hypot(east, north))
    if refraction:
        lift = 1.02 / 60 / np.tan(np.deg2rad(altitude + 10.3 / (np.maximum(altitude, -1) + 5.11)))
        altitude = np.where(altitude > -1, altitude + lift, altitude)
    return (azimuth, altitude) if azimuth.ndim else (float(azimuth), float(altitude))


def require_place(owner: str, latitude: Any, longitude: Any) -> None:
    """ArgumentError of the `owner` where these are no numbers of degrees on the globe."""
    for name, value, most in (("latitude", latitude, 90), ("longitude", longitude, 360)):
        require(owner, name, value, NUMBERS)
        if not (np.abs(value) <= most).all():
            raise ArgumentError(owner, name, f"must lie between -{most} and {most} degrees, it is {value}")


def utc(owner: str, name: str, time: Any) -> Any:
    """A `datetime` with its zone, or datetime64s, as datetime64 in UTC; else an ArgumentError of the `owner`'s argument."""
    if isinstance(time, datetime.datetime):
        if time.tzinfo is None:
            raise ArgumentError(owner, name, f"must have a time zone, as 2026-06-21T12:00:00Z has, it is {time.isoformat()}")
        offset = time.utcoffset() or datetime.timedelta()
        time = np.datetime64(time.replace(tzinfo=None), "us") - np.timedelta64(offset, "us")
    instants = np.asarray(time)
    if instants.dtype.kind != "M":
        raise ArgumentError(owner, name, f"must be a datetime or datetime64, it is {type(time).__name__}")
    if np.isnat(instants).any():
        raise ArgumentError(owner, name, "must be a time, it is NaT")
    return instants.astype("datetime64[us]")


def _equatorial(days: Any) -> tuple[Any, Any, Any, Any]:
    """The sun's right ascension and declination, radians; sidereal time in Greenwich, degrees; parallax, radians."""
    t = (days + _CLOCK) / 36525
    mean_longitude = 280.46645 + t * (36000.76983 + t * 0.0003032)
    anomaly = np.deg2rad(357.52910 + t * (35999.05030 - t * 0.0001559))
    eccentricity = 0.016708617 - t * 0.000042037
    centre = (1.914600 - t * 0.004817) * np.sin(anomaly) + 0.019993 * np.sin(2 * anomaly) + 0.000290 * np.sin(3 * anomaly)

    def wave(amplitude: float, start: float, rate: float, function: Any = np.cos) -> Any:
        return amplitude * function(np.deg2rad(start + rate * (t + 1)))  # from 1900

    disturbed = (
        wave(0.00134, 153.23, 22518.7541) + wave(0.00154, 216.57, 45037.5082)  # Venus
        + wave(0.00200, 312.69, 32964.3577)  # Jupiter
        + wave(0.00179, 350.74, 445267.1142, np.sin)  # the Moon
        + wave(0.00178, 231.19, 20.20, np.sin)
    )  # fmt: skip
    node, lunar = np.deg2rad(125.04452 - 1934.136261 * t), np.deg2rad(2 * (218.3165 + 481267.8813 * t))
    solar = np.deg2rad(2 * mean_longitude)
    nutation = (-17.20 * np.sin(node) - 1.32 * np.sin(solar) - 0.23 * np.sin(lunar) + 0.21 * np.sin(2 * node)) / 3600
    tilt = (9.20 * np.cos(node) + 0.57 * np.cos(solar) + 0.10 * np.cos(lunar) - 0.09 * np.cos(2 * node)) / 3600
    obliquity = np.deg2rad(23.4392911 - 0.0130042 * t + tilt)
    distance = 1.000001018 * (1 - eccentricity**2) / (1 + eccentricity * np.cos(anomaly + np.deg2rad(centre)))
    ecliptic = np.deg2rad(mean_longitude + centre + disturbed + nutation - 0.005692 / distance)  # with aberration
    right_ascension = np.arctan2(np.cos(obliquity) * np.sin(ecliptic), np.cos(ecliptic))
    declination = np.arcsin(np.sin(obliquity) * np.sin(ecliptic))
    sidereal = 280.46061837 + 360.98564736629 * days + 0.000387933 * (days / 36525) ** 2 + nutation * np.cos(obliquity)
    return right_ascension, declination, sidereal % 360, np.deg2rad(8.794 / 3600) / distance
