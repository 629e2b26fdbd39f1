"""`jaxhf viewshed`: what is seen of a terrain from points on it."""

import argparse
import itertools
import math
import time

import numpy as np

from ...core.errors import UserError, counted
from ...io.terrain.rasters import require_writable_raster, save_raster
from ...maps.surface import surface
from ...maps.viewshed import cells_of, height_at, seen_from
from .. import arguments, limits
from ..progress import compiled_bar
from .maps import read_in_metres, require_numbers

_ON_SIDE = 1e-6  # cells from it


def run(options: argparse.Namespace) -> None:
    if options.above_ground:
        require_numbers(options.output, "heights")
        arguments.refuse(options, "target_height", because="--above-ground says how high it must be")
    if options.area:
        arguments.refuse(options, "line", because="--area takes all of what the line surrounds")
    for name, least in (("line", 2), ("area", 3)):
        if getattr(options, name) and len(options.observers) < least:
            raise UserError(f"viewshed: --{name} needs {least} --observer at least, it has {len(options.observers)}")
    path = require_writable_raster(options.output)
    stored, terrain = read_in_metres(options)
    dx, dy, x0, y0 = stored.in_file
    shape = stored.heights.shape
    cells = cells_of("viewshed", "--observer", options.observers, shape, (x0, y0), (dx, dy), rotation=stored.rotation)
    limits.require_memory_of_map("viewshed", stored.heights.size, options.precision)
    if options.line or options.area:
        cells = (_along if options.line else _within)(cells, stored.heights)
    limits.set_up_jax(options)
    begin = time.perf_counter()
    known = arguments.given(options, "height", "target_height", "radius")
    wanted = "above-ground" if options.above_ground else "visible"
    ground = surface("viewshed", terrain)
    with compiled_bar(unit=" observers") as advance:
        found = seen_from(ground, cells, "--observer", **known, wanted=wanted, progress=advance)
    if options.above_ground:
        said, values = f"up to {np.nanmax(found):.1f} above the ground", found
    else:
        there = np.isfinite(terrain.heights)
        said, values = f"{100 * found.sum() / there.sum():.1f} % is seen", np.where(found, np.uint8(255), np.uint8(0))
    save_raster(path, values, stored, np.nan if options.above_ground else None)
    print(f"{path}: {said}, from {counted(len(cells), 'point')}, {time.perf_counter() - begin:.1f} s")


def _along(cells: np.ndarray, heights: np.ndarray) -> np.ndarray:
    """The points and those between them, at most a cell apart; between them none in holes."""
    found = [cells[:1]]
    for first, second in itertools.pairwise(cells):
        between = np.linspace(first, second, math.ceil(np.abs(second - first).max()), endpoint=False)[1:]
        found += [np.array([at for at in between if math.isfinite(height_at(heights, *at))]).reshape(-1, 2), second[None]]
    return np.concatenate(found)


def _within(cells: np.ndarray, heights: np.ndarray) -> np.ndarray:
    """The vertices in and on the polygon of these points, without those in holes: rays along x cross it an odd number of
    times. What stands on a side is within, however coordinates are rounded."""
    left, bottom = np.ceil(cells.min(0) - _ON_SIDE).astype(int)
    right, top = np.floor(cells.max(0) + _ON_SIDE).astype(int)
    iy, ix = np.nonzero(np.isfinite(heights[bottom : top + 1, left : right + 1]))
    vertices = np.column_stack([ix + left, iy + bottom]).astype(float)
    inside, on_side = np.zeros((2, len(vertices)), bool)
    for first, second in zip(cells, np.roll(cells, -1, axis=0), strict=True):
        along, to = second - first, vertices - first
        share = np.clip(to @ along / max(along @ along, np.finfo(float).tiny), 0, 1)
        on_side |= np.abs(to - share[:, None] * along).max(1) < _ON_SIDE
        if along[1]:
            crosses = (vertices[:, 1] < first[1]) != (vertices[:, 1] < second[1])
            inside ^= crosses & (to[:, 0] < to[:, 1] * (along[0] / along[1]))
    if not (inside | on_side).any():
        raise UserError("viewshed: --area must hold heights, none stands within")
    return vertices[inside | on_side]
