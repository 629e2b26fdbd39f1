"""`jaxhf hillshade`, `slope`, `aspect` and `relief`: maps that NumPy makes of a terrain file."""

import argparse
import inspect
import sys
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from ...core.errors import UserError
from ...maps.choices import ALGORITHMS, ENTRIES, VARIANTS
from .. import arguments
from ..arguments import choice, flag, number, option
from ..command import Command

if TYPE_CHECKING:
    from ...io.terrain.terrain import Terrain

_BYTES = ".tif (8 bits, keeps its place), .png (and a world file) or .npy"
_COLOURED = ".tif (keeps its place), .png (and a world file) or .npy"
_NUMBERS = ".tif (keeps its place) or .npy"
_DIRECTION = flag("--trigonometric", "counterclockwise from east"), flag("--zero-for-flat", "0 in place of -9999")
STEPS = (
    number("--dx", "D", "spacing of the columns [as the file says]"),
    number("--dy", "D", "spacing of the rows [as the file says]"),
)
_SCALE = "vertical units in a horizontal one [1; degrees are measured in metres at the middle latitude]"
_SPACING = {"spacing": (number("--scale", "S", _SCALE), *STEPS)}
_ALGORITHM = choice("--algorithm", ALGORITHMS, "slopes from eight neighbours or four [horn]")
_SLOPES = {"slopes": (_ALGORITHM, flag("--compute-edges", "also at the border and beside holes"))}
_LIGHT = {
    "light": (
        number("--azimuth", "DEGREES", "of the light, from north, clockwise [315]"),
        number("--altitude", "DEGREES", "of the light, above the horizon [45]"),
        number("--z-factor", "Z", "heights are multiplied by it [1]"),
        choice("--variant", VARIANTS, "kind of hillshade [regular]"),
        flag("--shadows", "what terrain keeps the light from is black: shadows as they fall"),
    )
}
_RAMP = "a colour file as gdaldem reads it, or a matplotlib colour map [green lowlands to pale heights, blue below 0]"
_COLOURS = {
    "colours": (
        option("--ramp", metavar="FILE|NAME", help=_RAMP),
        choice("--entries", ENTRIES, "colours between the heights of the ramp [interpolate]"),
        flag("--alpha", "a fourth band: opacity, 0 where there is no height"),
        option("--no-shading", dest="shading", action="store_false", help="colours alone"),
    )
}


def _files(written: str, *more: arguments.Option) -> dict[str, tuple[arguments.Option, ...]]:
    return {"": (arguments.IN, arguments.output(f"the map: {written}"), arguments.NODATA, *more)}


def _hillshade(options: argparse.Namespace) -> None:
    from ...maps.hillshade import hillshade

    _require_meaning(options)
    _make(options, hillshade, nodata=0.0)


def _slope(options: argparse.Namespace) -> None:
    from ...maps.slope import NODATA, slope

    require_numbers(options.output, "slope")
    _make(options, slope, nodata=NODATA)


def _aspect(options: argparse.Namespace) -> None:
    from ...maps.slope import NODATA, aspect

    require_numbers(options.output, "aspect")
    _make(options, aspect, nodata=None if options.zero_for_flat else NODATA)


def _relief(options: argparse.Namespace) -> None:
    from ...maps.relief import color_relief, relief

    if options.shading:
        _require_meaning(options)
        return _make(options, relief)
    light = ("azimuth", "altitude", "z_factor", "variant", "shadows", "algorithm", "scale", "dx", "dy")
    arguments.refuse(options, *light, because="--no-shading leaves the light out")
    _make(options, color_relief)


def _require_meaning(options: argparse.Namespace) -> None:
    """UserError where an angle of the light is given that this variant of a hillshade does not ask for."""
    for variant, angle in (("multidirectional", "azimuth"), ("igor", "altitude")):
        if options.variant == variant and not options.shadows:
            arguments.refuse(options, angle, because=f"--variant {variant} has lights of its own, without --shadows")


def _make(options: argparse.Namespace, function: Callable[..., Any], nodata: float | None = None) -> None:
    """Reads the terrain, draws its map and writes it.

    Args:
      options: of the command; those that the function has parameters for reach it.
      function: of `jaxhf.maps`, from a terrain to its map; the report says its name.
      nodata: the value in it that means that there is none.
    """
    from ...io.terrain.load import read_terrain
    from ...io.terrain.rasters import require_writable_raster, save_raster

    path = require_writable_raster(options.output)
    begin = time.perf_counter()
    terrain = read_terrain(options.terrain, nodata=options.nodata)
    names = inspect.signature(function).parameters.keys() & vars(options).keys()
    values = function(terrain, **arguments.given(options, *names))
    if "dx" in names and options.scale is None:
        report_spacing(options, terrain)
    save_raster(path, values, terrain, nodata)
    ny, nx = terrain.heights.shape
    kind = function.__name__.replace("_", " ")
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


COMMANDS = (
    Command(
        "hillshade",
        "shade a terrain as on a map",
        examples=("terrain.tif -o shaded.tif --shadows", "terrain.asc -o shaded.png --azimuth 300 --altitude 30 --z-factor 2"),
        options={**_files(_BYTES), **_LIGHT, **_SLOPES, **_SPACING},
        run=_hillshade,
        about="Bytes from 1 to 255, 0 where there is no value, as gdaldem hillshade writes them.",
    ),
    Command(
        "slope",
        "map how steep a terrain is",
        examples=("terrain.tif -o slope.tif", "degrees.tif -o slope.tif --percent --scale 111120"),
        options={**_files(_NUMBERS, flag("--percent", "rise over run in percent, not degrees")), **_SLOPES, **_SPACING},
        run=_slope,
        about="Degrees in 32-bit floats, -9999 where there is no value, as gdaldem slope.",
    ),
    Command(
        "aspect",
        "map where slopes face",
        examples=("terrain.tif -o aspect.tif", "terrain.tif -o aspect.tif --zero-for-flat --compute-edges"),
        options={**_files(_NUMBERS, *_DIRECTION), **_SLOPES},
        run=_aspect,
        about="Degrees clockwise from north in 32-bit floats, -9999 where flat, as gdaldem aspect.",
    ),
    Command(
        "relief",
        "colour a terrain by height, and shade it",
        examples=("terrain.tif -o relief.png", "terrain.tif -o relief.tif --ramp colours.txt --variant multidirectional"),
        options={**_files(_COLOURED), **_COLOURS, **_LIGHT, "slopes": (_ALGORITHM,), **_SPACING},
        run=_relief,
        about="Without shading the colours are those of gdaldem color-relief.",
    ),
)
