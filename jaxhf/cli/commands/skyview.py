"""`jaxhf skyview`: how much of the sky the terrain leaves to see, as a map."""

import argparse
import time
from typing import TYPE_CHECKING, Any

from .. import arguments, mapping

if TYPE_CHECKING:
    from ...io.terrain import Terrain


def add(commands: Any) -> None:
    about = "Map the sky-view factor: the share of the sky that the terrain leaves to see, exact and without a search radius."
    examples = arguments.examples(
        "jaxhf skyview dem.tif -o sky.tif", "jaxhf skyview dem.tif -o sky.png --azimuths 64 --weighting slope"
    )
    command = commands.add_parser("skyview", help="map the sky-view factor of a terrain", description=about, epilog=examples)
    add_terrain(command, "the map: .tif or .npy (0 to 1), or .png (0 to 255)")
    command.add_argument(
        "--weighting", choices=("solid-angle", "horizontal", "slope"), default="solid-angle",
        help="share of the sky's solid angle, or of its light on horizontal ground or on the slope [solid-angle]",
    )  # fmt: skip
    command.set_defaults(run=run)


def add_terrain(command: argparse.ArgumentParser, output: str) -> None:
    """What `jaxhf skyview` and `jaxhf horizon` have in common."""
    command.set_defaults(placed=True)
    command.add_argument("terrain", metavar="IN", help=f"heights: {arguments.TERRAIN}")
    command.add_argument("-o", "--output", required=True, metavar="OUT", help=output)
    command.add_argument("--azimuths", type=int, metavar="K", help="directions, at even steps from north on [32]")
    mapping.add_spacing(command, scale=False)
    arguments.add_raster(command)
    arguments.add_machine(command)


def read(options: argparse.Namespace) -> "tuple[Terrain, Terrain]":
    """The terrain as the file places it, and in metres, in the precision that is asked for."""
    import dataclasses

    from ...core.errors import ArgumentError, UserError
    from ...io.errors import FileError
    from ...io.load_terrain import read_terrain
    from ...maps.surface import spacing

    given = spacing("", options.dx, options.dy)
    options.azimuths = 32 if options.azimuths is None else options.azimuths
    if options.azimuths < 1:
        raise ArgumentError("", "--azimuths", f"must be a whole number from 1 on, it is {options.azimuths}")
    stored = read_terrain(options.terrain, options.z_scale, options.nodata)
    if stored.nodata.all():
        raise UserError(f"{options.terrain}: there is no height in it")
    stored = dataclasses.replace(stored, heights=stored.heights.astype(options.precision))
    mapping.report_spacing(options, stored)
    try:
        return stored, stored.in_metres(**given)
    except FileError as error:
        raise FileError(f"{options.terrain}: {error}") from error


def run(options: argparse.Namespace) -> None:
    import numpy as np

    from ...core.errors import counted
    from ...io.rasters import require_writable_raster, save_raster

    path = require_writable_raster(options.output)
    stored, terrain = read(options)
    arguments.set_up_jax(options)
    from ...maps.skyview import sky_view
    from ..progress import compiled_bar

    begin = time.perf_counter()
    with compiled_bar(unit=" heights", unit_scale=True) as advance:
        seen = np.asarray(sky_view(terrain, options.azimuths, weighting=options.weighting, progress=advance))
    took = time.perf_counter() - begin
    values = np.rint(255 * np.nan_to_num(np.clip(seen, 0, 1))).astype(np.uint8) if path.suffix.lower() == ".png" else seen
    save_raster(path, values, stored, nodata=None if values.dtype == np.uint8 else np.nan)
    about = f"{counted(options.azimuths, 'azimuth')}, {took:.1f} s"
    print(f"{path}: sky-view factor {np.nanmin(seen):.3f} .. {np.nanmax(seen):.3f}, {about}")
