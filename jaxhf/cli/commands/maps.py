"""`jaxhf hillshade`, `slope`, `aspect`, `curvature`, `ruggedness` and `relief`: maps that NumPy makes of a terrain file."""

import argparse
import dataclasses
import inspect
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ...core.errors import ArgumentError, UserError
from ...core.extras import import_extra
from ...io.errors import FileError
from ...io.files import reading, require_writable
from ...io.terrain.load import STRIP, read_terrain, rows_of, terrain_rows
from ...io.terrain.rasters import require_writable_raster, save_raster, writing_strips
from ...io.terrain.terrain import Terrain
from ...maps.curvature import curvature
from ...maps.hillshade import hillshade
from ...maps.ramp import as_ramp
from ...maps.relief import color_relief, relief
from ...maps.ruggedness import ruggedness
from ...maps.slope import NODATA, aspect, slope
from ...maps.strips import by_strips
from .. import arguments
from ..progress import bar
from ..sheet import SHEETS, save_sheet, sheet

_NUMBERS = {"slope": slope, "aspect": aspect, "curvature": curvature, "ruggedness": ruggedness}  # and no bytes
_LIGHT = ("azimuth", "altitude", "z_factor", "variant", "shadows", "algorithm", "scale", "dx", "dy")


def run(options: argparse.Namespace) -> None:
    function, nodata = _chosen(options)
    if getattr(options, "annotate", False):
        _sheet(options, function)
        return
    path = require_writable_raster(options.output)
    begin = time.perf_counter()
    names = inspect.signature(function).parameters.keys() & vars(options).keys()
    with terrain_rows(options.terrain, **arguments.reading(options)) as rows:
        ny, nx = rows.place.heights.shape
        strip = max(STRIP // nx, 64)
        if ny > strip and (getattr(options, "shadows", False) or path.suffix.lower() == ".png"):
            rows, strip = rows_of(rows.whole()), ny  # shadows need all of the terrain, and a .png all of the map
        strips = by_strips(function, rows, strip, path.suffix.lower() != ".npy", arguments.given(options, *names))
        if ny <= strip:
            for _, values in strips:
                save_raster(path, values, rows.place, nodata)
        else:
            with writing_strips(path, rows.place, nodata) as put, bar(total=ny, unit=" rows") as shown:
                for part, values in strips:
                    put(part, values)
                    shown.update(len(values))
        if "dx" in names and options.scale is None:
            report_spacing(options, rows.place)
    kind = function.__name__.replace("_", " ")
    print(f"{path}: {kind}, {nx} x {ny} pixels, {time.perf_counter() - begin:.2f} s")


def _sheet(options: argparse.Namespace, function: Callable[..., Any]) -> None:
    """A relief with what is round it on a printed map."""
    import_extra("matplotlib", "--annotate draws with", "plot")
    path = require_writable("relief", "a sheet", SHEETS, options.output)
    begin = time.perf_counter()
    terrain = _read(options)
    terrain.require_unrotated(f"{options.terrain}: the terrain on a sheet")
    takes = inspect.signature(function).parameters
    given = arguments.given(options, *(takes.keys() & vars(options).keys()))
    ramp = as_ramp(options.ramp, float(np.nanmin(terrain.heights)), float(np.nanmax(terrain.heights)))
    image, said = function(terrain, **given | {"ramp": ramp, "alpha": True}), []  # paper shows where there is no height
    if "dx" in takes:
        if options.scale is None:
            report_spacing(options, terrain)
        azimuth, altitude = (given.get(name, takes[name].default) for name in ("azimuth", "altitude"))
        if options.shadows or options.variant in (None, "regular", "combined"):
            said.append(f"light from {azimuth:g}°, {altitude:g}° high")
        said += ["with cast shadows"] if options.shadows else []
        said += [f"shaded with heights x {given['z_factor']:g}"] if "z_factor" in given else []
    said += [terrain.georeference.name] if terrain.georeference and terrain.georeference.name else []
    with reading(Path(options.terrain)):
        metres = terrain.in_metres(**arguments.given(options, "dx", "dy"))
    entries = given.get("entries", takes["entries"].default)
    save_sheet(path, sheet(image, terrain, metres, ramp, entries, options.contours, options.title, "; ".join(said)))
    ny, nx = terrain.heights.shape
    print(f"{path}: a sheet of {nx} x {ny} heights, {time.perf_counter() - begin:.2f} s")


def _chosen(options: argparse.Namespace) -> tuple[Callable[..., Any], float | None]:
    """The function that makes the map, of those options that it has parameters for, and the value there that means none."""
    name = options.command.name
    if name in _NUMBERS:
        require_numbers(options.output, name)
        return _NUMBERS[name], None if getattr(options, "zero_for_flat", False) else NODATA
    if name == "relief" and options.annotate:
        arguments.refuse(options, "alpha", because="a sheet is white where there is no height")
    elif name == "relief":
        arguments.refuse(options, "contours", "title", because="without --annotate there is no sheet")
        if Path(options.output).suffix.lower() in set(SHEETS) - {".png"}:
            raise UserError(f"{options.output}: only a sheet is written with this ending, which --annotate makes")
    if name == "relief" and not options.shading:
        arguments.refuse(options, *_LIGHT, because="--no-shading leaves the light out")
        return color_relief, None
    for variant, angle in (("multidirectional", "azimuth"), ("igor", "altitude")):
        if options.variant == variant and not options.shadows:
            arguments.refuse(options, angle, because=f"--variant {variant} has lights of its own, without --shadows")
    return (relief, None) if name == "relief" else (hillshade, 0.0)


def require_numbers(output: str, kind: str) -> None:
    """UserError where the output's format holds bytes alone, and so no map of this kind."""
    if output.lower().endswith(".png"):
        raise UserError(f"{output}: a .png holds whole numbers from 0 to 255, no {kind}; write .tif or .npy")


def report_spacing(options: argparse.Namespace, terrain: Terrain) -> None:
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


def _read(options: argparse.Namespace) -> Terrain:
    terrain = read_terrain(options.terrain, **arguments.reading(options))
    if terrain.nodata.all():
        raise UserError(f"{options.terrain}: there is no height in it")
    return terrain


def read_in_metres(options: argparse.Namespace) -> tuple[Terrain, Terrain]:
    """The terrain of a file as it is stored, in the precision that was asked for, and with lengths in metres."""
    stored = _read(options)
    stored = dataclasses.replace(stored, heights=stored.heights.astype(options.precision))
    report_spacing(options, stored)
    try:
        return stored, stored.in_metres(**arguments.given(options, "dx", "dy"))
    except FileError as error:
        raise FileError(f"{options.terrain}: {error}") from error


def place_of(name: str, options: argparse.Namespace, terrain: Terrain) -> tuple[float, float]:
    """The latitude and longitude that a command was given, or those of the terrain's middle, degrees."""
    place = options.latitude, options.longitude
    if place == (None, None):
        try:
            return terrain.place
        except ArgumentError as error:
            why = error.rule.rpartition(", ")[2]
            raise UserError(f"{name}: times need --latitude and --longitude for {options.terrain}: {why}") from error
    if None in place:
        raise UserError(f"{name}: --latitude and --longitude belong together, one is missing")
    return place
