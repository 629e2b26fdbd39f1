"""Small files beside a grid that say where it lies: ESRI's world file and the reference system in a .prj."""

from pathlib import Path

import numpy as np

from ..errors import FileError
from .georeference import CoordinateSystem, Georeference, coordinate_system
from .terrain import Terrain

WORLD_FILE = ".pgw"  # of a .png


def beside(path: Path, terrain: Terrain) -> dict[Path, str]:
    """The texts that go with a .png or an .asc: the world file of the first, the reference system where it is known."""
    ending, texts = path.suffix.lower(), {}
    if ending == ".png":
        a, b, x, d, e, y = terrain.geotransform(pixel=0.0)
        numbers = a, d, b, e, x, y  # the last two of the north-western pixel's centre
        texts[path.with_suffix(WORLD_FILE)] = "".join(f"{number!r}\n" for number in numbers)
    if ending in (".png", ".asc") and terrain.georeference is not None and terrain.georeference.wkt:
        texts[path.with_suffix(".prj")] = terrain.georeference.wkt
    return texts


def system_of(path: Path) -> tuple[str, CoordinateSystem]:
    """The well-known text in the .prj beside a file, "" where there is none, and what it says."""
    prj = path.with_suffix(".prj")
    wkt = prj.read_text(encoding="utf-8", errors="replace").strip() if prj.is_file() else ""
    return wkt, coordinate_system(wkt)


def by_world_file(path: Path, heights: np.ndarray) -> Terrain:
    """Heights, row 0 in the south, where the world file beside `path` puts them; of spacing 1 where there is none."""
    world = path.with_suffix(WORLD_FILE)
    if not world.is_file():
        return Terrain(heights)
    try:
        dx, down, across, dy, west, north = (float(word) for word in world.read_text(encoding="latin-1").split())
    except ValueError as error:
        raise FileError(f"{world.name} beside it must hold six numbers") from error
    if down or across or dx <= 0 or dy >= 0:
        raise FileError(f"{world.name} beside it must put the north up: dx, 0, 0, -dy; it begins {dx}, {down}, {across}, {dy}")
    wkt, crs = system_of(path)
    return Terrain(heights, dx, -dy, west, north + (len(heights) - 1) * dy, crs, Georeference(wkt))
