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


def add_spacing(command: argparse.ArgumentParser) -> None:
    group = command.add_argument_group("spacing")
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
    group.add_argument("--algorithm", choices=ALGORITHMS, default="horn", help="slopes from eight neighbours or four [horn]")
    if edges:
        group.add_argument("--compute-edges", action="store_true", help="also at the border and beside holes")


def add_light(command: argparse.ArgumentParser) -> None:
    group = command.add_argument_group("light")
    group.add_argument(
        "--azimuth", type=float, default=315.0, metavar="DEGREES", help="of the light, from north, clockwise [315]"
    )
    group.add_argument("--altitude", type=float, default=45.0, metavar="DEGREES", help="of the light, above the horizon [45]")
    group.add_argument("--z-factor", type=float, default=1.0, metavar="Z", help="heights are multiplied by it [1]")
    group.add_argument("--variant", choices=VARIANTS, default="regular", help="kind of hillshade [regular]")
    group.add_argument(
        "--shadows", action="store_true", help="what terrain keeps the light from is black: shadows as they fall"
    )


def given(options: argparse.Namespace, *names: str) -> dict[str, Any]:
    return {name: getattr(options, name) for name in names}


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
    from . import interruption

    path = require_writable_raster(options.output)
    if numbers and path.suffix.lower() == ".png":
        raise UserError(f"{path}: .png cannot hold the numbers of the {kind}; write .tif or .npy")
    begin = time.perf_counter()
    terrain = read_terrain(options.terrain, nodata=options.nodata)
    values = draw(terrain)
    degrees = terrain.crs is not None and terrain.crs.degrees
    if degrees and scaled and options.scale is None and None in (options.dx, options.dy):
        middle = terrain.y0 + (len(terrain.heights) - 1) / 2 * terrain.dy
        said = f"degrees, which are measured in metres at latitude {middle:.4g}; heights count as metres (--scale overrules)"
        print(f"jaxhf: {options.terrain} is in {said}", file=sys.stderr)
    interruption.raise_from_now_on()
    save_raster(path, values, terrain, nodata)
    ny, nx = terrain.heights.shape
    print(f"{path}: {kind}, {nx} x {ny} pixels, {time.perf_counter() - begin:.2f} s")
