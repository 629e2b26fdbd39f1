"""`jaxhf skyview`, `horizon` and `insolation`: how much of the sky and of the sun the terrain leaves to see."""

import argparse
import datetime
import time
from pathlib import Path
from typing import Any

import numpy as np

from ...core.errors import UserError, counted
from ...io.files import replacing_all, write_npy
from ...io.terrain.rasters import geotiff, require_writable_raster, save_raster
from ...io.terrain.terrain import Terrain
from ...maps.insolation import insolation
from ...maps.skyview import horizon, sky_view
from ...preparation.crossings import even_azimuths
from ...scene.sun import utc
from .. import arguments, limits
from ..progress import compiled_bar
from .maps import place_of, read_in_metres, require_numbers


def run(options: argparse.Namespace) -> None:
    make = {"skyview": _skyview, "horizon": _horizon, "insolation": _insolation}[options.command.name]
    if make is not _skyview:
        require_numbers(options.output, "angles" if make is _horizon else options.wanted)
    if make is _horizon and options.azimuth is not None:
        arguments.refuse(options, "azimuths", because="--azimuth asks for one")
    if make is _insolation and options.wanted == "hours":
        arguments.refuse(options, "turbidity", because="hours of sun are the same in any air")
    path = require_writable_raster(options.output)
    options.azimuths = options.azimuths or (64 if make is _insolation else 32)
    stored, terrain = read_in_metres(options)
    kept = options.azimuths if make is _horizon and options.azimuth is None and path.suffix.lower() == ".npy" else 0
    limits.require_memory_of_map(options.command.name, stored.heights.size, options.precision, kept)
    limits.set_up_jax(options)
    begin = time.perf_counter()
    said, count = make(options, path, stored, terrain)
    print(f"{path}: {said}, {counted(count, 'azimuth')}, {time.perf_counter() - begin:.1f} s")


def _skyview(options: argparse.Namespace, path: Path, stored: Terrain, terrain: Terrain) -> tuple[str, int]:
    """Makes the map of a terrain in metres and writes it where the terrain as it is stored lies; what is to be told of it."""
    with compiled_bar(unit=" heights", unit_scale=True) as advance:
        values = np.asarray(sky_view(terrain, options.azimuths, weighting=options.weighting, progress=advance))
    span = f"{np.nanmin(values):.3f} .. {np.nanmax(values):.3f}"
    if path.suffix.lower() == ".png":
        values = np.rint(255 * np.nan_to_num(np.clip(values, 0, 1))).astype(np.uint8)
    save_raster(path, values, stored, nodata=None if values.dtype == np.uint8 else np.nan)
    return f"sky-view factor {span}", options.azimuths


def _horizon(options: argparse.Namespace, path: Path, stored: Terrain, terrain: Terrain) -> tuple[str, int]:
    """The same for the angles of one azimuth after the other."""
    one = options.azimuth is not None
    azimuths = np.array([options.azimuth]) if one else even_azimuths(options.azimuths)
    tiff = path.suffix.lower() != ".npy"
    paths = [_of(path, azimuth) for azimuth in azimuths] if tiff and not one else [path]
    maps, highest = [], 0.0
    with replacing_all(paths) as temporaries, compiled_bar(unit=" angles", unit_scale=True) as advance:
        for k, azimuth in enumerate(azimuths):

            def grown(done: int, total: int, k: int = k) -> None:
                advance(k * total + done, len(azimuths) * total)

            (angles,) = np.asarray(horizon(terrain, [azimuth], progress=grown))
            highest = max(highest, float(np.nanmax(angles)))
            if tiff:
                temporaries[k].write_bytes(geotiff(angles, stored, np.nan))
            else:
                maps.append(angles)
        if maps:
            write_npy(temporaries[0], maps[0] if one else np.stack(maps))
    return f"horizon angles up to {highest:.2f} degrees", len(azimuths)


def _insolation(options: argparse.Namespace, path: Path, stored: Terrain, terrain: Terrain) -> tuple[str, int]:
    """The same for the energy that arrives, or the hours of sun."""
    latitude, longitude = place_of("insolation", options, stored)
    begin, end = (_instant(time, longitude) for time in (options.begin, options.end))
    if not begin < end:
        rule = f"--end must come after --begin, they are {options.end} and {options.begin}"
        raise UserError(f"insolation: {rule}; dates are their midnights, a day ends with the next date")
    chosen = arguments.given(options, "wanted", "turbidity", "azimuths")
    with compiled_bar(unit=" heights", unit_scale=True) as advance:
        values = np.asarray(insolation(terrain, begin, end, (latitude, longitude), **chosen, progress=advance))
    save_raster(path, values, stored, nodata=np.nan)
    unit, kind = ("hours", "sun") if options.wanted == "hours" else ("kWh/m²", options.wanted)
    return f"{kind} {np.nanmin(values):.4g} .. {np.nanmax(values):.4g} {unit}", options.azimuths


def _instant(time: datetime.date, longitude: float) -> Any:
    """In UTC; a date begins at midnight of the place's mean solar time."""
    if isinstance(time, datetime.datetime):
        return utc("insolation", "time", time)
    east = (longitude + 180) % 360 - 180
    return np.datetime64(time, "us") - np.timedelta64(round(east * 240e6), "us")


def _of(path: Path, azimuth: float) -> Path:
    """The file of one direction: out_090.tif."""
    degrees = f"{azimuth:03.0f}" if azimuth == round(azimuth) else f"{azimuth:06.2f}"
    return path.with_name(f"{path.stem}_{degrees}{path.suffix}")
