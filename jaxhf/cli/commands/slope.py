"""`jaxhf slope`: how steep a terrain is."""

import argparse
from typing import Any

from .. import arguments, mapping


def add(commands: Any) -> None:
    about = "Map the steepness of a terrain: degrees in 32-bit floats, -9999 where there is no value, as gdaldem slope."
    examples = arguments.examples(
        "jaxhf slope terrain.tif -o slope.tif",
        "jaxhf slope degrees.tif -o slope.tif --percent --scale 111120",
    )
    command = commands.add_parser("slope", help="map how steep a terrain is", description=about, epilog=examples)
    mapping.add_files(command, ".tif (keeps its place) or .npy")
    command.add_argument("--percent", action="store_true", help="rise over run in percent, not degrees")
    mapping.add_slope(command)
    mapping.add_spacing(command)
    command.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    from ...maps.slope import NODATA, slope

    wanted = arguments.given(options, "percent", "algorithm", "compute_edges", "scale", "dx", "dy")
    mapping.make(options, lambda terrain: slope(terrain, **wanted), kind="slope", nodata=NODATA, numbers=True)
