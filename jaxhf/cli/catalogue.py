"""The commands: what `jaxhf --help` and their own --help say, and their options. What they do stands in `commands`."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from ..core.settings import Settings
from ..maps.choices import ALGORITHMS, CURVATURES, ENTRIES, QUADRATICS, RUGGEDNESS, SUNLIGHT, VARIANTS, WEIGHTINGS
from .arguments import (
    FINITE,
    POSITIVE,
    Option,
    choice,
    flag,
    moment,
    names,
    number,
    option,
    real_number,
    settings_options,
    size,
    sun,
    whole,
)


@dataclass(frozen=True)
class Command:
    """One word after `jaxhf`.

    Attributes:
      name: the word.
      line: about it, in `jaxhf --help`.
      examples: what may stand after its name.
      options: the title of each group and what is in it, with positional arguments; "": without a title.
      module: of `commands`, whose `run` does it; "": that of its name.
      about: what its own --help says besides.
      placed: whether files beside an output that is a map say where it lies.
    """

    name: str
    line: str
    examples: Sequence[str]
    options: Mapping[str, Sequence[Option]]
    module: str = ""
    about: str = ""
    placed: bool = True


# What several take.

_TERRAIN = ".tif and others that GDAL reads, .npz, .npy, .asc, .hgt, .png (grey), .exr, .pfm or .hfield (MuJoCo)"
_IN = option("terrain", metavar="IN", help=f"heights: {_TERRAIN}")
_SCENE = option("scene", metavar="SCENE", help="a .toml or .pbrt scene")
_NODATA = number("--nodata", "V", "a stored value that means no height [as the file says]")
_BBOX = "only heights within, in the file's coordinates [all]"
_PART = (
    whole("--band", "N", "of a raster, the band of heights, from 1 [its only one]", least=1),
    option("--bbox", nargs=4, type=real_number, metavar=("WEST", "SOUTH", "EAST", "NORTH"), help=_BBOX),
)
_RASTER = {
    "heights as they are stored": (
        number("--z-scale", "S", "heights are multiplied by it [1]", default=1.0), _NODATA, *_PART
    )
}  # fmt: skip
_MACHINE = {
    "machine": (
        whole("--devices", "N", "cores that share the work, each with a copy [all, at most 16, fewer for a small picture]"),
        choice("--precision", ("float32", "float64"), "of heights and rays [float32]", default="float32"),
        option(
            "--no-cache", dest="cache", action="store_false",
            help="keep no compiled programs for the next run [kept in the folder JAXHF_CACHE, by default one in the user's "
            "cache folder; JAXHF_CACHE=off: keep none]",
        ),
    )
}  # fmt: skip


def _output(help: str) -> Option:
    return option("-o", "--output", required=True, metavar="OUT", help=help)


# Maps.


def _files(written: str, *more: Option) -> dict[str, Sequence[Option]]:
    return {"": (_IN, _output(f"the map: {written}"), _NODATA, *_PART, *more)}


_BYTES = ".tif (8 bits, keeps its place), .png (and a world file) or .npy"
_COLOURED = ".tif (keeps its place), .png (and a world file) or .npy"
_NUMBERS = ".tif (keeps its place) or .npy"
_DIRECTION = flag("--trigonometric", "counterclockwise from east"), flag("--zero-for-flat", "0 in place of -9999")
_STEPS = (
    number("--dx", "D", "spacing of the columns [as the file says]"),
    number("--dy", "D", "spacing of the rows [as the file says]"),
)
_SCALE = "vertical units in a horizontal one [1; degrees are measured in metres at the middle latitude]"
_SPACING = {"spacing": (number("--scale", "S", _SCALE), *_STEPS)}
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
_SHEET = {
    "sheet": (
        flag("--annotate", "with coordinates, a scale bar, north, and what the colours mean, as .png, .pdf or .svg"),
        number("--contours", "STEP", "contour lines so far apart, in the unit of the heights [none]", rule=POSITIVE),
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


_DEGREES = "DEGREES"
_PLACE = (
    number("--latitude", _DEGREES, "for times [that of the terrain's middle]"),
    number("--longitude", _DEGREES, "for times [that of the terrain's middle]"),
)


def _sky(written: str, *special: Option, azimuths: int = 32) -> dict[str, Sequence[Option]]:
    directions = whole("--azimuths", "K", f"directions, at even steps from north on [{azimuths}]", least=1)
    return {"": (_IN, _output(written), directions, *special), "spacing": _STEPS, **_RASTER, **_MACHINE}


_SHARE = "share of the sky's solid angle, or of its light on horizontal ground or on the slope [solid-angle]"
_TIME = "2026-06-21 (midnight of mean solar time there), or a time with its offset from UTC, 2026-06-21T07:00-05:00"
_OBSERVER = "x and y in the file's coordinates; may be said several times"
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
            _IN,
            _output("the map: .tif or .png (255 where it is seen, 0 elsewhere), or .npy"),
            option(
                "--observer", dest="observers", nargs=2, type=real_number, action="append", required=True, metavar=("X", "Y"),
                help=_OBSERVER,
            ),
            flag("--line", "observers all along the line through these points, at most a cell apart"),
            number("--height", "H", "of the eyes above the ground [1.8]"),
            number("--target-height", "H", "of what is to be seen, above the ground [0]"),
            flag("--above-ground", "the least height above the ground that is seen, in 32-bit floats; .tif or .npy"),
            number("--radius", "R", _RADIUS),
        ),
        "spacing": _STEPS,
        **_RASTER,
        **_MACHINE,
    },
    about="A place is seen if it is from any observer: exact on the terrain's triangles.",
)  # fmt: skip
_MAPS = (
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
                flag("--compute-edges", "also at the border and beside holes"),
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
                flag("--compute-edges", "also at the border and beside holes"),
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
            number("--azimuth", "DEGREES", "one direction, from north, clockwise, in its place", rule=FINITE),
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
            option("--end", type=moment, metavar="TIME", required=True, help="ten years later at most"),
            choice(
                "--wanted", SUNLIGHT, "all energy, its parts, or the hours in which the sun shines there [energy]", "energy"
            ),
            number("--turbidity", "T", "haze and vapour after Linke, 1 to 10; mountains 2, lowlands 3 to 5 [3]"),
            *_PLACE,
            azimuths=64,
        ),
        module="sky",
        about="The sky is cloudless. Mountains cast their shadows and hide the sky, by exact horizons in K directions.",
    ),
    _VIEWSHED,
)

# Pictures.

PRESETS = {"draft": 1, "balanced": 9, "exact": 64}  # samples a pixel of `jaxhf view`
MATERIALS = "matte", "lommel-seeliger", "lunar-lambert", "minnaert", "oren-nayar", "hapke"  # of `scene.material.SCATTERING`
_PRESET = "1, 9 or 64 samples a pixel; draft: also a sky that nothing hides [balanced]"
_FROM = "where the camera stands, clockwise from north [110 left of the sun]"
_SUN_FROM = "a film of a moving sun: where it begins, or when, as in 2026-06-21T07:00-05:00"
_HEIGHT_COLOURS = "colours by height: a gdaldem colour file, or a matplotlib colour map"
_DRAPE = "a picture laid over it: a GeoTIFF where it lies, others from corner to corner"
_VIEW = Command(
    "view",
    "show a terrain as a solid block, or fly round it",
    examples=("--demo -o block.png", "dem.tif -o orbit.gif --size 640x400 --frames 48"),
    options={
        "": (
            option("terrain", metavar="IN", nargs="?", help=f"heights: {_TERRAIN}"),
            flag("--demo", "in place of IN the Jacksboro fault, which matplotlib ships"),
            option("-o", "--output", metavar="OUT", help=".png, .jpg, .exr, .npy; a film: .gif, .mp4 [IN's name, .png]"),
        ),
        "picture": (
            option("--size", type=size, default=(1280, 800), metavar="WxH", help="pixels [1280x800]"),
            choice("--preset", tuple(PRESETS), _PRESET, default="balanced"),
            whole("--frames", "N", "of a film, 24 a second [72]", least=2),
        ),
        "camera": (
            number("--from", _DEGREES, _FROM, dest="camera_azimuth"),
            number("--above", _DEGREES, "above the horizon [35]", 35.0, dest="camera_altitude"),
            number("--fov", _DEGREES, "angle of view [30]", 30.0),
        ),
        "light": (
            number("--azimuth", _DEGREES, "of the sun, clockwise from north [315]"),
            number("--altitude", _DEGREES, "of the sun, above the horizon [45]"),
            option("--sun-from", type=sun, metavar="AZ,ALT|TIME", help=_SUN_FROM),
            option("--sun-to", type=sun, metavar="AZ,ALT|TIME", help="and where it ends, or when"),
            *_PLACE,
            number("--haze", "SHARE", "of light lost along the terrain [0.15]"),
        ),
        "terrain": (
            number("--exaggeration", "X", "heights are multiplied by it [1, or more on flat terrain]", rule=POSITIVE),
            option("--ramp", metavar="FILE|NAME", help=_HEIGHT_COLOURS),
            option("--drape", metavar="IMAGE", help=_DRAPE),
            choice("--material", MATERIALS, "the law by which it reflects [matte]", default="matte"),
            number("--water", "LEVEL", "below it is water", rule=FINITE),
            option("--no-skirt", dest="skirt", action="store_false", help="no walls: a sheet"),
        ),
        **_RASTER,
        **_MACHINE,
    },
    about="It is seen from a place that shows all of it. A .gif or .mp4 goes round it.",
    placed=False,
)
_AOVS = (
    "what rays met besides, as layers of an .exr: some of depth, normal, uv, object, cell, shadow, status, steps and "
    "exhausted, with commas between [none]"
)
_RENDER = Command(
    "render",
    "render a scene to a picture",
    examples=("scene.toml -o picture.png --width 960", "scene.toml -o picture.exr --samples 16 --aovs depth,normal"),
    options={
        "": (
            _SCENE,
            _output("the picture: .png, .jpg (sRGB), .exr, .npy or .pfm (linear)"),
            option("--aovs", type=names, default=(), metavar="NAMES", help=_AOVS),
        ),
        "size": (
            whole("--width", "PIXELS", "of the picture; with one of the two, the other keeps the proportions", least=1),
            whole("--height", "PIXELS", "of the picture", least=1),
        ),
        # Nothing is differentiated.
        "accuracy and speed": settings_options(Settings.__dataclass_fields__.keys() - {"edge_samples"}),
        **_MACHINE,
    },
    placed=False,
)

# Recovery.

_FIT = Command(
    "fit",
    "recover heights from pictures",
    examples=("case.toml -o heights.tif --report report.html", "case.toml -o heights.tif --resume"),
    options={
        "": (
            option("case", metavar="CASE", help="a .toml file: a scene, its pictures, and what is known"),
            _output("the heights: .npy, .npz or .tif"),
            option("--report", metavar="PAGE", help="an .html page with plots of heights, pictures and convergence"),
            flag("--resume", "go on from OUT.checkpoint, if it is there"),
            whole("--window", "N", "fit windows of N x N heights one after the other: it takes the memory of one", least=32),
            whole("--overlap", "M", "heights that neighbouring windows share [a quarter of N]", least=8),
        ),
        **_MACHINE,
    },
    about="Beside OUT stand OUT_std and OUT_albedo.npy, where they are asked for.",
)
_TRADEOFF = Command(
    "tradeoff",
    "measure what each setting costs and gains",
    examples=("scene.toml --quick", "scene.toml --error 0.01 --knobs samples shading"),
    options={
        "": (_SCENE, option("-o", "--output", metavar="FOLDER", help="for table, references and plot [NAME-tradeoff]")),
        "what is asked": (
            number("--error", "E", "recommend the cheapest settings within this error"),
            number("--time", "SECONDS", "recommend the most exact settings within this time"),
            flag("--markdown", "print all figures as tables"),
        ),
        "what is measured": (
            flag("--quick", "fewer values, a smaller picture, a coarser reference"),
            option("--knobs", nargs="+", default=(), metavar="KNOB", help="sweep only these"),
            whole("--width", "PIXELS", "size [the scene's, at most 480 for the longer side]"),
            whole("--devices", "N", "cores that share the work [all, at most 16]"),
            whole("--repeats", "N", "runs whose median is taken [5]", default=5),
        ),
    },
    about="Sweep each over a scene: error against a reference in double precision, time, compilation and peak memory; print "
    "the Pareto front of the settings, and keep a table and a plot. What was measured is kept: the same command goes on after "
    "Ctrl-C, and only prints when all is there. It says how long it will take.",
)

# Files.

_WRITTEN = ".tif, .npz, .npy, .asc, .png (rounded) or .exr; a mesh: .glb, .obj or .ply"
_CONVERT = Command(
    "convert",
    "write a terrain in another format",
    examples=("terrain.tif terrain.npz", "terrain.tif block.glb --base 0"),
    options={
        "": (
            _IN,
            option("output", metavar="OUT", help=_WRITTEN),
            number("--base", "Z", "close a mesh by walls down to this height [open]"),
        ),
        **_RASTER,
    },
    about="It keeps its place on the map, or becomes a mesh of triangles.",
)
_INFO = Command(
    "info",
    "print what a scene or a terrain file holds",
    examples=("terrain.tif", "scene.toml"),
    options={"": (option("file", metavar="FILE", help=f"a .toml or .pbrt scene; heights: {_TERRAIN}"),)},
)

GROUPS = {
    "terrain maps": _MAPS,
    "pictures": (_VIEW, _RENDER),
    "recovery": (_FIT, _TRADEOFF),
    "files": (_CONVERT, _INFO),
}
COMMANDS = {command.name: command for group in GROUPS.values() for command in group}
