"""What a command of `jaxhf` is, and options that several take."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from .arguments import Option, choice, number, option, real_number, whole, whole_number


@dataclass(frozen=True)
class Command:
    """One word after `jaxhf`."""

    name: str
    line: str  # about it, in `jaxhf --help`
    examples: Sequence[str]  # of what may stand after its name
    options: Mapping[str, Sequence[Option]]  # with positional arguments, by the titles of their groups; "": without a title
    module: str = ""  # of `commands`, whose `run` does it; "": that of its name
    about: str = ""  # what its own --help says besides
    placed: bool = True  # whether files beside an output that is a map say where it lies


TERRAIN = ".tif and others that GDAL reads, .npz, .npy, .asc, .hgt, .png (grey), .exr, .pfm or .hfield (MuJoCo)"
IN = option("terrain", metavar="IN", help=f"heights: {TERRAIN}")
SCENE = option("scene", metavar="SCENE", help="a .toml or .pbrt scene")
NODATA = number("--nodata", "V", "a stored value that means no height [as the file says]")
_BBOX = "only heights within, in the file's coordinates [all]"
_WINDOW = "in its place the first column and row, and how many, as GDAL's -srcwin"
PART = (
    whole("--band", "N", "of a raster, the band of heights, from 1 [its only one]", least=1),
    option("--bbox", nargs=4, type=real_number, metavar=("WEST", "SOUTH", "EAST", "NORTH"), help=_BBOX),
    option("--window", nargs=4, type=whole_number, metavar=("XOFF", "YOFF", "XSIZE", "YSIZE"), help=_WINDOW),
)
RASTER = {
    "heights as they are stored": (
        number("--z-scale", "S", "heights are multiplied by it [1]", default=1.0), NODATA, *PART
    )
}  # fmt: skip
MACHINE = {
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
DEGREES = "DEGREES"
PLACE = (
    number("--latitude", DEGREES, "for times [that of the terrain's middle]"),
    number("--longitude", DEGREES, "for times [that of the terrain's middle]"),
)


def output(help: str) -> Option:
    return option("-o", "--output", required=True, metavar="OUT", help=help)
