"""`jaxhf skyview` and `jaxhf horizon`: how much of the sky the terrain leaves to see, and how high it stands."""

import argparse
import dataclasses
import time
from pathlib import Path
from typing import TYPE_CHECKING

from ...core.errors import UserError, counted
from ...maps.choices import WEIGHTINGS
from .. import arguments
from ..arguments import FINITE, choice, number, output, whole
from ..command import Command
from .maps import STEPS, report_spacing, require_numbers

if TYPE_CHECKING:
    from ...io.terrain.terrain import Terrain


def _options(written: str, special: arguments.Option) -> dict[str, tuple[arguments.Option, ...]]:
    azimuths = whole("--azimuths", "K", "directions, at even steps from north on [32]", least=1)
    files = arguments.IN, output(written), azimuths, special
    return {"": files, "spacing": STEPS, **arguments.RASTER, **arguments.MACHINE}


def _read(options: argparse.Namespace) -> "tuple[Terrain, Terrain]":
    """The terrain as the file places it, and in metres, in the precision that is asked for."""
    from ...io.errors import FileError
    from ...io.terrain.load import read_terrain

    options.azimuths = 32 if options.azimuths is None else options.azimuths
    stored = read_terrain(options.terrain, options.z_scale, options.nodata)
    if stored.nodata.all():
        raise UserError(f"{options.terrain}: there is no height in it")
    stored = dataclasses.replace(stored, heights=stored.heights.astype(options.precision))
    report_spacing(options, stored)
    try:
        return stored, stored.in_metres(**arguments.given(options, "dx", "dy"))
    except FileError as error:
        raise FileError(f"{options.terrain}: {error}") from error


def _skyview(options: argparse.Namespace) -> None:
    import numpy as np

    from ...io.terrain.rasters import require_writable_raster, save_raster

    path = require_writable_raster(options.output)
    stored, terrain = _read(options)
    arguments.set_up_jax(options)
    from ...maps.skyview import sky_view
    from ..progress import compiled_bar

    begin = time.perf_counter()
    with compiled_bar(unit=" heights", unit_scale=True) as advance:
        values = np.asarray(sky_view(terrain, options.azimuths, weighting=options.weighting, progress=advance))
    took, span = time.perf_counter() - begin, f"{np.nanmin(values):.3f} .. {np.nanmax(values):.3f}"
    if path.suffix.lower() == ".png":
        values = np.rint(255 * np.nan_to_num(np.clip(values, 0, 1))).astype(np.uint8)
    save_raster(path, values, stored, nodata=None if values.dtype == np.uint8 else np.nan)
    print(f"{path}: sky-view factor {span}, {counted(options.azimuths, 'azimuth')}, {took:.1f} s")


def _horizon(options: argparse.Namespace) -> None:
    import numpy as np

    from ...io.files import replacing_all, write_npy
    from ...io.terrain.rasters import geotiff, require_writable_raster

    require_numbers(options.output, "angles")
    path, one = require_writable_raster(options.output), options.azimuth is not None
    if one:
        arguments.refuse(options, "azimuths", because="--azimuth asks for one")
    stored, terrain = _read(options)
    arguments.set_up_jax(options)
    from ...maps.skyview import horizon
    from ...preparation.horizon import even_azimuths
    from ..progress import compiled_bar

    begin = time.perf_counter()
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
    took = time.perf_counter() - begin
    print(f"{path}: horizon angles up to {highest:.2f} degrees, {counted(len(azimuths), 'azimuth')}, {took:.1f} s")


def _of(path: Path, azimuth: float) -> Path:
    """The file of one direction: out_090.tif."""
    degrees = f"{azimuth:03.0f}" if azimuth == round(azimuth) else f"{azimuth:06.2f}"
    return path.with_name(f"{path.stem}_{degrees}{path.suffix}")


_SHARE = "share of the sky's solid angle, or of its light on horizontal ground or on the slope [solid-angle]"
COMMANDS = (
    Command(
        "skyview",
        "map the sky-view factor of a terrain",
        examples=("dem.tif -o sky.tif", "dem.tif -o sky.png --azimuths 64 --weighting slope"),
        options=_options(
            "the map: .tif or .npy (0 to 1), or .png (0 to 255)",
            choice("--weighting", WEIGHTINGS, _SHARE, default="solid-angle"),
        ),
        run=_skyview,
        about="It is the share of the sky that the terrain leaves to see, exact and without a search radius.",
    ),
    Command(
        "horizon",
        "map the horizon angles of a terrain",
        examples=("dem.tif -o horizon.npy --azimuths 36", "dem.tif -o west.tif --azimuth 270"),
        options=_options(
            "the map: .npy of shape (azimuths, rows, columns), or .tif, one file an azimuth: OUT_090.tif",
            number("--azimuth", "DEGREES", "one direction, from north, clockwise, in its place", rule=FINITE),
        ),
        run=_horizon,
        about="They are in degrees above the horizontal, at least 0: exact and without a search radius.",
    ),
)
