"""`jaxhf hillshade`: a terrain shaded as on a map."""

import argparse
from typing import Any

from .. import arguments, mapping


def add(commands: Any) -> None:
    about = "Shade a terrain as on a map: bytes from 1 to 255, 0 where there is no value, as gdaldem hillshade writes them."
    examples = arguments.examples(
        "jaxhf hillshade terrain.tif -o shaded.tif --shadows",
        "jaxhf hillshade terrain.asc -o shaded.png --azimuth 300 --altitude 30 --z-factor 2",
    )
    command = commands.add_parser("hillshade", help="shade a terrain as on a map", description=about, epilog=examples)
    mapping.add_files(command, ".tif (8 bits, keeps its place), .png (and a world file) or .npy")
    mapping.add_light(command)
    mapping.add_slope(command)
    mapping.add_spacing(command)
    command.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    from ...maps.hillshade import hillshade

    wanted = {**mapping.light(options), "compute_edges": options.compute_edges}
    mapping.make(options, lambda terrain: hillshade(terrain, **wanted), kind="hillshade", nodata=0.0)
