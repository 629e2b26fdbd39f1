"""`jaxhf viewshed`: what is seen of a terrain from points on it."""

import argparse
import dataclasses
import itertools
import math
import time

import numpy as np

from ...core.errors import UserError, counted
from ...io.errors import FileError
from ...io.terrain.load import read_terrain
from ...io.terrain.rasters import require_writable_raster, save_raster
from ...maps.viewshed import viewshed
from .. import arguments, limits
from ..progress import compiled_bar
from .maps import report_spacing, require_numbers


def run(options: argparse.Namespace) -> None:
    if options.above_ground:
        require_numbers(options.output, "heights")
        arguments.refuse(options, "target", because="--above-ground says how high it must be")
    if options.line and len(options.observers) < 2:
        raise UserError("viewshed: --line needs two --observer at least, there is one")
    path = require_writable_raster(options.output)
    stored = read_terrain(options.terrain, options.z_scale, options.nodata)
    if stored.nodata.all():
        raise UserError(f"{options.terrain}: there is no height in it")
    stored = dataclasses.replace(stored, heights=stored.heights.astype(options.precision))
    report_spacing(options, stored)
    dx, dy, x0, y0 = stored.in_file
    cells = [np.array([(x - x0) / dx, (y - y0) / dy]) for x, y in options.observers]
    for (x, y), cell in zip(options.observers, cells, strict=True):
        if not ((cell >= 0) & (cell <= np.array(stored.heights.shape[::-1]) - 1)).all():
            ny, nx = stored.heights.shape
            spans = f"x from {x0:.10g} to {x0 + (nx - 1) * dx:.10g} and y from {y0:.10g} to {y0 + (ny - 1) * dy:.10g}"
            raise UserError(f"viewshed: --observer must be on the terrain, {spans}; it is {x:.10g} {y:.10g}")
    if options.line:
        ways = [
            np.linspace(first, second, math.ceil(np.abs(second - first).max()), endpoint=False)
            for first, second in itertools.pairwise(cells)
        ]
        cells = [*np.concatenate(ways), cells[-1]]
    try:
        terrain = stored.in_metres(**arguments.given(options, "dx", "dy"))
    except FileError as error:
        raise FileError(f"{options.terrain}: {error}") from error
    limits.set_up_jax(options)
    begin = time.perf_counter()
    observers = np.array(cells) * (terrain.dx, terrain.dy) + (terrain.x0, terrain.y0)
    known = arguments.given(options, "height", "target", "radius")
    wanted = "above-ground" if options.above_ground else "visible"
    with compiled_bar(unit=" observers") as advance:
        found = viewshed(terrain, observers, **known, wanted=wanted, progress=advance)
    if options.above_ground:
        said, values = f"up to {np.nanmax(found):.1f} above the ground", found
    else:
        there = np.isfinite(terrain.heights)
        said, values = f"{100 * found.sum() / there.sum():.1f} % is seen", np.where(found, np.uint8(255), np.uint8(0))
    save_raster(path, values, stored, np.nan if options.above_ground else None)
    print(f"{path}: {said}, from {counted(len(observers), 'point')}, {time.perf_counter() - begin:.1f} s")
