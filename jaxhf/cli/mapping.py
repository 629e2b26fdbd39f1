"""What the commands share that make a map of a terrain file: options, reading, writing."""

import argparse
import sys
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from ..core.errors import UserError
from ..maps.choices import ALGORITHMS, VARIANTS
from . import arguments

if TYPE_CHECKING:
    from ..io.terrain import Terrain


def add_files(command: argparse.ArgumentParser, written: str) -> None:
    command.set_defaults(placed=True)
    command.add_argument("terrain", metavar="IN", help=f"heights: {arguments.TERRAIN}")
    command.add_argument("-o", "--output", required=True, metavar="OUT", help=f"the map: {written}")
    command.add_argument("--nodata", type=float, metavar="V", help="a stored value that means no height [as the file says]")


def add_spacing(command: argparse.ArgumentParser, scale: bool = True) -> None:
    group = command.add_argument_group("spacing")
    if scale:
        group.add_argument(
            "--scale",
            type=float,
            metavar="S",
            help="vertical units in a horizontal one [1; degrees are measured in metres at the middle latitude]",
        )
    group.add_argument("--dx", type=float, metavar="D", help="spacing of the columns [as the file says]")
    group.add_argument("--dy", type=float, metavar="D", help="spacing of the rows [as the file says]")


def add_slope(command: argparse.ArgumentParser, edges: bool = True) -> None:
    group = command.add_argument_group("slopes")
    group.add_argument("--algorithm", choices=ALGORITHMS, help="slopes from eight neighbours or four [horn]")
    if edges:
        group.add_argument("--compute-edges", action="store_true", help="also at the border and beside holes")


def add_light(command: argparse.ArgumentParser) -> None:
    group = command.add_argument_group("light")
    group.add_argument("--azimuth", type=float, metavar="DEGREES", help="of the light, from north, clockwise [315]")
    group.add_argument("--altitude", type=float, metavar="DEGREES", help="of the light, above the horizon [45]")
    group.add_argument("--z-factor", type=float, metavar="Z", help="heights are multiplied by it [1]")
    group.add_argument("--variant", choices=VARIANTS, help="kind of hillshade [regular]")
    group.add_argument(
        "--shadows", action="store_true", default=None, help="what terrain keeps the light from is black: shadows as they fall"
    )


LIGHT = ("azimuth", "altitude", "z_factor", "variant", "shadows")
SPACING = ("scale", "dx", "dy")


def light(options: argparse.Namespace) -> dict[str, Any]:
    """The options of `add_light` and `add_spacing`, and the algorithm of slopes; UserError where one says nothing."""
    for variant, angle in (("multidirectional", "azimuth"), ("igor", "altitude")):
        if options.variant == variant and not options.shadows:
            arguments.refuse(options, angle, because=f"--variant {variant} has lights of its own, without --shadows")
    return arguments.given(options, *LIGHT, "algorithm", *SPACING)


def make(
    options: argparse.Namespace,
    draw: Callable[["Terrain"], Any],
    *,
    kind: str,
    nodata: float | None = None,
    scaled: bool = True,
    numbers: bool = False,
) -> None:
    """Reads the terrain, draws its map and writes it.

    Args:
      options: of the command.
      draw: the map of a terrain.
      kind: what the map is, for the report.
      nodata: the value in it that means that there is none.
      scaled: whether the map depends on the spacing.
      numbers: whether it holds numbers that no byte can.
    """
    from ..io.load_terrain import read_terrain
    from ..io.rasters import require_writable_raster, save_raster

    if numbers:
        require_numbers(options.output, kind)
    path = require_writable_raster(options.output)
    begin = time.perf_counter()
    terrain = read_terrain(options.terrain, nodata=options.nodata)
    values = draw(terrain)
    if scaled and options.scale is None:
        report_spacing(options, terrain)
    save_raster(path, values, terrain, nodata)
    ny, nx = terrain.heights.shape
    print(f"{path}: {kind}, {nx} x {ny} pixels, {time.perf_counter() - begin:.2f} s")


def require_numbers(output: str, kind: str) -> None:
    """UserError where the output's format holds bytes alone, and so no map of this kind."""
    if output.lower().endswith(".png"):
        raise UserError(f"{output}: a .png holds whole numbers from 0 to 255, no {kind}; write .tif or .npy")


def report_spacing(options: argparse.Namespace, terrain: "Terrain") -> None:
    """Says where the cell size is not simply what the file says."""
    given, said = (options.dx, options.dy), ""
    if terrain.crs is not None and terrain.crs.degrees and None in given:
        middle = terrain.y0 + (len(terrain.heights) - 1) / 2 * terrain.dy
        overrules = "--scale overrules" if hasattr(options, "scale") else "--dx and --dy overrule"
        said = f"is in degrees, which are measured in metres at latitude {middle:.4g}; heights count as metres ({overrules})"
    elif terrain.crs is None and (terrain.dx, terrain.dy, *given) == (1, 1, None, None):
        said = "does not say how far apart its heights are, 1 is taken (--dx and --dy overrule)"
    if said and not options.quiet:
        print(f"jaxhf: {options.terrain} {said}", file=sys.stderr)
