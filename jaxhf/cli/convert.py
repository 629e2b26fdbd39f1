"""`jaxhf convert`: a terrain in another format."""

import argparse
from pathlib import Path
from typing import Any

from . import arguments, interruption


def add(commands: Any) -> None:
    about = "Write a terrain in another format. From GeoTIFF to GeoTIFF it keeps its place on the map."
    command = commands.add_parser("convert", help="write a terrain in another format", description=about)
    command.add_argument("terrain", metavar="IN", help="heights: .npy, .npz, .png (16 bits) or .tif")
    command.add_argument("output", metavar="OUT", help=".npy, .npz or .tif")
    arguments.add_raster(command)
    command.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    from ..io.load_terrain import load_heights
    from ..io.save_terrain import require_writable_heights, save_heights
    from .describe import heightfield_line

    require_writable_heights(options.output)
    terrain = load_heights(options.terrain, z_scale=options.z_scale, nodata=options.nodata)
    interruption.raise_from_now_on()
    save_heights(options.output, terrain)
    alone = " (.npy holds the heights alone)" if Path(options.output).suffix.lower() == ".npy" else ""
    print(f"{options.output}: {heightfield_line(terrain)}{alone}")
