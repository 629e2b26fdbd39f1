"""`jaxhf relief`: a terrain in colours by height, shaded."""

import argparse
from typing import Any

from ...maps.choices import ENTRIES
from .. import arguments, mapping


def add(commands: Any) -> None:
    about = "Colour a terrain by height and shade it. Without shading the colours are those of gdaldem color-relief."
    examples = arguments.examples(
        "jaxhf relief terrain.tif -o relief.png",
        "jaxhf relief terrain.tif -o relief.tif --ramp colours.txt --variant multidirectional",
    )
    command = commands.add_parser("relief", help="colour a terrain by height, and shade it", description=about, epilog=examples)
    mapping.add_files(command, ".tif (keeps its place), .png (and a world file) or .npy")
    group = command.add_argument_group("colours")
    group.add_argument(
        "--ramp",
        metavar="FILE|NAME",
        help="a colour file as gdaldem reads it, or a matplotlib colour map [green lowlands to pale heights, blue below 0]",
    )
    group.add_argument(
        "--entries", choices=ENTRIES, default="interpolate", help="colours between the heights of the ramp [interpolate]"
    )
    group.add_argument("--alpha", action="store_true", help="a fourth band: opacity, 0 where there is no height")
    group.add_argument("--no-shading", dest="shading", action="store_false", help="colours alone")
    mapping.add_light(command)
    mapping.add_slope(command, edges=False)
    mapping.add_spacing(command)
    command.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    from ...maps.relief import color_relief, relief

    tint = arguments.given(options, "ramp", "entries", "alpha")
    if not options.shading:
        arguments.refuse(options, *mapping.LIGHT, "algorithm", *mapping.SPACING, because="--no-shading leaves the light out")
        return mapping.make(options, lambda terrain: color_relief(terrain, **tint), kind="color relief", scaled=False)
    light = mapping.light(options)
    mapping.make(options, lambda terrain: relief(terrain, **tint, **light), kind="relief")
