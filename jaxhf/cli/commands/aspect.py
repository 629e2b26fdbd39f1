"""`jaxhf aspect`: where the slopes of a terrain face."""

import argparse
from typing import Any

from .. import arguments, mapping


def add(commands: Any) -> None:
    about = "Map where slopes face: degrees clockwise from north in 32-bit floats, -9999 where flat, as gdaldem aspect."
    examples = arguments.examples(
        "jaxhf aspect terrain.tif -o aspect.tif",
        "jaxhf aspect terrain.tif -o aspect.tif --zero-for-flat --compute-edges",
    )
    command = commands.add_parser("aspect", help="map where slopes face", description=about, epilog=examples)
    mapping.add_files(command, ".tif (keeps its place) or .npy")
    command.add_argument("--trigonometric", action="store_true", help="counterclockwise from east")
    command.add_argument("--zero-for-flat", action="store_true", help="0 in place of -9999")
    mapping.add_slope(command)
    command.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    from ...maps.slope import NODATA, aspect

    wanted = arguments.given(options, "trigonometric", "zero_for_flat", "algorithm", "compute_edges")
    nodata = None if options.zero_for_flat else NODATA
    mapping.make(options, lambda terrain: aspect(terrain, **wanted), kind="aspect", nodata=nodata, scaled=False, numbers=True)
