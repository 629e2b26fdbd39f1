"""The commands that make maps of a terrain, see `catalogue`."""

from collections.abc import Sequence

from ..core.rules import finite, positive
from ..maps.choices import ALGORITHMS, CURVATURES, ENTRIES, QUADRATICS, RUGGEDNESS, SUNLIGHT, VARIANTS, WEIGHTINGS
from .arguments import Option, choice, flag, moment, number, option, real_number, whole
from .command import IN, MACHINE, NODATA, PART, PLACE, RASTER, Command, output


def _files(written: str, *more: Option) -> dict[str, Sequence[Option]]:
    return {"": (IN, output(f"the map: {written}"), NODATA, *PART, *more)}


_BYTES = ".tif (8 bits, keeps its place), .png (and a world file) or .npy"
_COLOURED = ".tif (keeps its place), .png (and a world file) or .npy"
_NUMBERS = ".tif (keeps its place) or .npy"
_EDGES = flag("--compute-edges", "also at the border and beside holes")
_DIRECTION = flag("--trigonometric", "counterclockwise from east"), flag("--zero-for-flat", "0 in place of -9999")
_STEPS = (
    number("--dx", "D", "spacing of the columns [as the file says]"),
    number("--dy", "D", "spacing of the rows [as the file says]"),
)
_SCALE = "vertical units in a horizontal one [1; degrees are measured in metres at the middle latitude]"
_SPACING = {"spacing": (number("--scale", "S", _SCALE), *_STEPS)}
_ALGORITHM = choice("--algorithm", ALGORITHMS, "slopes from eight neighbours or four [horn]")
_SLOPES = {"slopes": (_ALGORITHM, _EDGES)}
_LIGHT = {
    "light": (
        number("--azimuth", "DEGREES", "of the light, from north, clockwise [315]"),
        number("--altitude", "DEGREES", "of the light, above the horizon [45]"),
        number("--z-factor", "Z", "heights are multiplied by it [1]"),
        choice("--variant", VARIANTS, "kind of hillshade [regular]"),
        flag("--shadows", "what terrain keeps the light from is black: shadows as they fall"),
    )
}
_SHEET = {
    "sheet": (
        flag("--annotate", "with coordinates, a scale bar, north, and what the colours mean, as .png, .webp, .pdf or .svg"),
        number("--contours", "STEP", "contour lines so far apart, in the unit of the heights [none]", rule=positive),
        option("--title", metavar="TEXT", help="above the map [none]"),
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


def _sky(written: str, *special: Option, azimuths: int = 32) -> dict[str, Sequence[Option]]:
    directions = whole("--azimuths", "K", f"directions, at even steps from north on [{azimuths}]", least=1)
    return {"": (IN, output(written), directions, *special), "spacing": _STEPS, **RASTER, **MACHINE}


_SHARE = "share of the sky's solid angle, or of its light on horizontal ground or on the slope [solid-angle]"
_END = "as --begin, ten years later at most; a day ends with the next date"
_TIME = "2026-06-21 (midnight of mean solar time there), or a time with its offset from UTC, 2026-06-21T07:00-05:00"
_RADIUS = "of the sphere on which the terrain lies [it lies on a plane; for light over the Earth 7.44e6, as GDAL's 6/7]"
_VIEWSHED = Command(
    "viewshed",
    "map what is seen of a terrain",
    examples=(
        "dem.tif -o seen.tif --observer 435200 5163000 --height 30 --radius 7.44e6",
        "dem.tif -o mast.tif --observer 435200 5163000 --above-ground",
    ),
    options={
        "": (
            IN,
            output("the map: .tif or .png (255 where it is seen, 0 elsewhere), or .npy"),
            option(
                "--observer", dest="observers", nargs=2, type=real_number, action="append", required=True, metavar=("X", "Y"),
                help="x and y in the file's coordinates; may be said several times",
            ),
            flag("--line", "observers all along the line through these points, at most a cell apart"),
            flag("--area", "observers at every height within the polygon of these points"),
            number("--height", "H", "of the eyes above the ground [1.8]"),
            number("--target-height", "H", "of what is to be seen, above the ground [0]"),
            flag("--above-ground", "the least height above the ground that is seen, in 32-bit floats; .tif or .npy"),
            number("--radius", "R", _RADIUS),
        ),
        "spacing": _STEPS,
        **RASTER,
        **MACHINE,
    },
    about="A place is seen if it is from any observer: exact on the terrain's triangles.",
)  # fmt: skip
MAPS = (
    Command(
        "hillshade",
        "shade a terrain as on a map",
        examples=("terrain.tif -o shaded.tif --shadows", "terrain.asc -o shaded.png --azimuth 300 --altitude 30 --z-factor 2"),
        options={**_files(_BYTES), **_LIGHT, **_SLOPES, **_SPACING},
        module="maps",
        about="Bytes from 1 to 255, 0 where there is no value, as gdaldem hillshade writes them.",
    ),
    Command(
        "slope",
        "map how steep a terrain is",
        examples=("terrain.tif -o slope.tif", "degrees.tif -o slope.tif --percent --scale 111120"),
        options={**_files(_NUMBERS, flag("--percent", "rise over run in percent, not degrees")), **_SLOPES, **_SPACING},
        module="maps",
        about="Degrees in 32-bit floats, -9999 where there is no value, as gdaldem slope.",
    ),
    Command(
        "aspect",
        "map where slopes face",
        examples=("terrain.tif -o aspect.tif", "terrain.tif -o aspect.tif --zero-for-flat --compute-edges"),
        options={**_files(_NUMBERS, *_DIRECTION), **_SLOPES},
        module="maps",
        about="Degrees clockwise from north in 32-bit floats, -9999 where flat, as gdaldem aspect.",
    ),
    Command(
        "curvature",
        "map how a terrain bends",
        examples=("terrain.tif -o mean.tif", "terrain.tif -o profile.tif --kind profile"),
        options={
            **_files(
                _NUMBERS,
                choice("--kind", CURVATURES, "down the slope, across it, of the contour line, mean or Gaussian [mean]"),
                choice("--quadratic", QUADRATICS, "nearest to nine heights, or through five [evans]"),
                _EDGES,
            ),
            **_SPACING,
        },
        module="maps",
        about="1/m (1/m² of Gaussian) in 32-bit floats, positive where the ground bulges, -9999 where there is no value.",
    ),
    Command(
        "ruggedness",
        "map how uneven a terrain is",
        examples=("terrain.tif -o tri.tif --measure tri", "terrain.tif -o tpi.tif --measure tpi --compute-edges"),
        options={
            **_files(
                _NUMBERS,
                choice("--measure", RUGGEDNESS, "gdaldem's roughness, TRI (Riley's or Wilson's) or TPI [roughness]"),
                _EDGES,
            )
        },
        module="maps",
        about="32-bit floats in the unit of the heights, -9999 where there is no value, as gdaldem roughness, TRI and TPI.",
    ),
    Command(
        "relief",
        "colour a terrain by height, and shade it",
        examples=("terrain.tif -o relief.png", "terrain.tif -o map.pdf --annotate --contours 50 --variant multidirectional"),
        options={**_files(_COLOURED), **_COLOURS, **_SHEET, **_LIGHT, "slopes": (_ALGORITHM,), **_SPACING},
        module="maps",
        about="Without shading the colours are those of gdaldem color-relief.",
    ),
    Command(
        "skyview",
        "map the sky-view factor of a terrain",
        examples=("dem.tif -o sky.tif", "dem.tif -o sky.png --azimuths 64 --weighting slope"),
        options=_sky(
            "the map: .tif or .npy (0 to 1), or .png (0 to 255)",
            choice("--weighting", WEIGHTINGS, _SHARE, default="solid-angle"),
        ),
        module="sky",
        about="It is the share of the sky that the terrain leaves to see, exact and without a search radius.",
    ),
    Command(
        "horizon",
        "map the horizon angles of a terrain",
        examples=("dem.tif -o horizon.npy --azimuths 36", "dem.tif -o west.tif --azimuth 270"),
        options=_sky(
            "the map: .npy of shape (azimuths, rows, columns), or .tif, one file an azimuth: OUT_090.tif",
            number("--azimuth", "DEGREES", "one direction, from north, clockwise, in its place", rule=finite),
        ),
        module="sky",
        about="They are in degrees above the horizontal, at least 0: exact and without a search radius.",
    ),
    Command(
        "insolation",
        "map the sunlight of a day, a month or a year",
        examples=(
            "dem.tif -o year.tif --begin 2026-01-01 --end 2027-01-01",
            "dem.tif -o hours.tif --wanted hours --begin 2026-06-21 --end 2026-06-22",
        ),
        options=_sky(
            "the map: .tif or .npy, kWh/m² of each vertex's own tilted surface, or hours",
            option("--begin", type=moment, metavar="TIME", required=True, help=_TIME),
            option("--end", type=moment, metavar="TIME", required=True, help=_END),
            choice(
                "--wanted", SUNLIGHT, "all energy, its parts, or the hours in which the sun shines there [energy]", "energy"
            ),
            number("--turbidity", "T", "haze and vapour after Linke, 1 to 10; mountains 2, lowlands 3 to 5 [3]"),
            *PLACE,
            azimuths=64,
        ),
        module="sky",
        about="The sky is cloudless. Mountains cast their shadows and hide the sky, by exact horizons in K directions.",
    ),
    _VIEWSHED,
)
