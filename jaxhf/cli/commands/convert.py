"""`jaxhf convert`: a terrain in another format."""

import argparse
import dataclasses
import warnings
from pathlib import Path

import numpy as np

from ...io.terrain.load import load_heights
from ...io.terrain.meshes import MESHES, require_writable_mesh, save_mesh
from ...io.terrain.save import HEIGHTS, require_writable_heights, save_heights
from ...io.terrain.terrain import Terrain
from .. import arguments
from .info import heightfield_line


def run(options: argparse.Namespace) -> None:
    ending = Path(options.output).suffix.lower()
    in_metres = ending in MESHES  # alone; others are in the unit of the file
    if in_metres:
        require_writable_mesh(options.output)
    else:
        require_writable_heights(options.output, HEIGHTS + MESHES)
        arguments.refuse(options, "base", "longer_side", because=f"meshes are {', '.join(MESHES)}, {options.output} is none")
    with warnings.catch_warnings():
        if not in_metres:
            warnings.filterwarnings("ignore", "degrees from latitude")
        terrain = load_heights(options.terrain, **arguments.reading(options))
    if in_metres:
        save_mesh(options.output, terrain, **arguments.given(options, "base", "longer_side"))
    else:
        save_heights(options.output, terrain)
        dx, dy, x0, y0 = terrain.in_file
        terrain = dataclasses.replace(terrain, dx=dx, dy=dy, x0=x0, y0=y0, georeference=None)
    alone = f" ({ending} holds the heights alone)" if ending in (".npy", ".exr") else ""
    if ending == ".png" and (terrain.heights % 1 != 0).any():
        alone = " (.png holds whole numbers: heights are rounded to steps of 1)"
    print(f"{options.output}: {heightfield_line(terrain)}{alone}{_printed(options, terrain)}")


def _printed(options: argparse.Namespace, terrain: Terrain) -> str:
    """Width, depth and height of a mesh that is scaled for a printer."""
    if options.longer_side is None:
        return ""
    (ny, nx), low = terrain.heights.shape, np.nanmin(terrain.heights) if options.base is None else options.base
    size = np.array([(nx - 1) * terrain.dx, (ny - 1) * terrain.dy, np.nanmax(terrain.heights) - low])
    sides = " x ".join(f"{side:.4g}" for side in size * (options.longer_side / size[:2].max()))
    return f"; in the file {sides} at most"
