"""The commands: what `jaxhf --help` and their own --help say, and their options. What they do stands in `commands`."""

import dataclasses

from ..core.rules import finite, positive
from ..core.settings import Settings
from .arguments import choice, flag, knob, names, number, option, size, sun, whole
from .command import DEGREES, IN, MACHINE, PLACE, RASTER, SCENE, TERRAIN, Command, output
from .map_catalogue import MAPS

PRESETS = {"draft": 1, "balanced": 9, "exact": 64}  # samples a pixel of `jaxhf view`
MATERIALS = "matte", "lommel-seeliger", "lunar-lambert", "minnaert", "oren-nayar", "hapke"  # of `scene.material.SCATTERING`
_PRESET = "1, 9 or 64 samples a pixel; draft: also a sky that nothing hides [balanced]"
_FROM = "where the camera stands, clockwise from north [110 left of the sun]"
_SUN_FROM = "a film of a moving sun: where it begins, or when, as in 2026-06-21T07:00-05:00"
_HEIGHT_COLOURS = "colours by height: a gdaldem colour file, or a matplotlib colour map"
_DRAPE = "a picture laid over it: a GeoTIFF where it lies, others from corner to corner"
_CAPTION = "with a caption of the sun and the exaggeration, a scale bar and north, as .png, .webp, .pdf or .svg"
_VIEW = Command(
    "view",
    "show a terrain as a solid block, or fly round it",
    examples=("--demo -o block.png", "dem.tif -o orbit.gif --size 640x400 --frames 48"),
    options={
        "": (
            option("terrain", metavar="IN", nargs="?", help=f"heights: {TERRAIN}"),
            flag("--demo", "in place of IN the Jacksboro fault, which matplotlib ships"),
            option("-o", "--output", metavar="OUT", help=".png, .jpg, .webp, .exr, .npy; a film: .gif, .mp4 [IN's name, .png]"),
        ),
        "picture": (
            option("--size", type=size, default=(1280, 800), metavar="WxH", help="pixels [1280x800]"),
            choice("--preset", tuple(PRESETS), _PRESET, default="balanced"),
            whole("--frames", "N", "of a film, 24 a second [72]", least=2),
            flag("--annotate", _CAPTION),
            option("--title", metavar="TEXT", help="above the caption [none]"),
        ),
        "camera": (
            number("--from", DEGREES, _FROM, dest="camera_azimuth"),
            number("--above", DEGREES, "above the horizon [35]", 35.0, dest="camera_altitude"),
            number("--fov", DEGREES, "angle of view [30]", 30.0),
        ),
        "light": (
            number("--azimuth", DEGREES, "of the sun, clockwise from north [315]"),
            number("--altitude", DEGREES, "of the sun, above the horizon [45]"),
            option("--sun-from", type=sun, metavar="AZ,ALT|TIME", help=_SUN_FROM),
            option("--sun-to", type=sun, metavar="AZ,ALT|TIME", help="and where it ends, or when"),
            *PLACE,
            number("--haze", "SHARE", "of light lost along the terrain [0.15]"),
        ),
        "terrain": (
            number("--exaggeration", "X", "heights are multiplied by it [1; flat or steep terrain: others]", rule=positive),
            option("--ramp", metavar="FILE|NAME", help=_HEIGHT_COLOURS),
            option("--drape", metavar="IMAGE", help=_DRAPE),
            choice("--material", MATERIALS, "the law by which it reflects [matte]", default="matte"),
            number("--water", "LEVEL", "up to it is water [0 where wide areas lie at 0]", rule=finite),
            option("--no-skirt", dest="skirt", action="store_false", help="no walls: a sheet"),
        ),
        **RASTER,
        **MACHINE,
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
            SCENE,
            output("the picture: .png, .jpg, .webp (sRGB), .exr, .npy or .pfm (linear)"),
            option("--aovs", type=names, default=(), metavar="NAMES", help=_AOVS),
        ),
        "size": (
            whole("--width", "PIXELS", "of the picture; with one of the two, the other keeps the proportions", least=1),
            whole("--height", "PIXELS", "of the picture", least=1),
        ),
        # Nothing is differentiated.
        "accuracy and speed": [knob(field) for field in dataclasses.fields(Settings) if field.name != "edge_samples"],
        **MACHINE,
    },
    placed=False,
)

_FIT = Command(
    "fit",
    "recover heights from pictures",
    examples=(
        "case.toml -o heights.tif --report report.html",
        "case.toml -o heights.tif --resume",
        "case.toml -o heights.tif --window 128",
    ),
    options={
        "": (
            option("case", metavar="CASE", help="a .toml file: a scene, its pictures, and what is known"),
            output("the heights: .npy, .npz or .tif"),
            option("--report", metavar="PAGE", help="an .html page with plots of heights, pictures and convergence"),
            flag("--resume", "go on from OUT.checkpoint, if it is there"),
            whole("--window", "N", "fit windows of N x N heights, 64 to 256, one after the other, for less memory", least=32),
            whole("--overlap", "M", "heights that neighbouring windows share [a quarter of N]", least=8),
        ),
        **MACHINE,
    },
    about="Beside OUT stand OUT_std and OUT_albedo.npy, where they are asked for.",
)
_TRADEOFF = Command(
    "tradeoff",
    "measure what each setting costs and gains",
    examples=("scene.toml --quick", "scene.toml --error 0.01 --knobs samples shading"),
    options={
        "": (SCENE, option("-o", "--output", metavar="FOLDER", help="for table, references and plot [NAME-tradeoff]")),
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

_WRITTEN = ".tif, .npz, .npy, .asc, .png (rounded) or .exr; a mesh: .glb, .obj, .ply or .stl"
_CONVERT = Command(
    "convert",
    "write a terrain in another format",
    examples=("terrain.tif terrain.npz", "terrain.tif block.glb --base 0", "terrain.tif print.stl --base 0 --longer-side 150"),
    options={
        "": (
            IN,
            option("output", metavar="OUT", help=_WRITTEN),
            number("--base", "Z", "close a mesh by walls down to this height, after --z-scale [open]"),
            number("--longer-side", "MM", "of a mesh's footprint, to which all is scaled, as for printers [as in the terrain]"),
        ),
        **RASTER,
    },
    about="It keeps its place on the map, or becomes a mesh of triangles.",
)
_INFO = Command(
    "info",
    "print what a scene or a terrain file holds",
    examples=("terrain.tif", "scene.toml"),
    options={"": (option("file", metavar="FILE", help=f"a .toml or .pbrt scene; heights: {TERRAIN}"),)},
)

GROUPS = {
    "terrain maps": MAPS,
    "pictures": (_VIEW, _RENDER),
    "recovery": (_FIT, _TRADEOFF),
    "files": (_CONVERT, _INFO),
}
COMMANDS = {command.name: command for group in GROUPS.values() for command in group}
