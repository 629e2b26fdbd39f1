"""Grids of heights that need no library: ESRI's ASCII grids, SRTM's tiles and MuJoCo's height fields."""

import re
import warnings
from pathlib import Path

import numpy as np

from ..errors import FileError
from ..files import require_pixels
from .georeference import WGS84_DEGREES, Georeference, coordinate_system
from .sidecars import system_of
from .terrain import Nodata, Terrain, heights_of

_KEYS = ["ncols", "nrows", "xllcorner", "xllcenter", "yllcorner", "yllcenter", "cellsize", "dx", "dy", "nodata_value"]


def read_asc(path: Path, nodata: Nodata) -> Terrain:
    """An ESRI ASCII grid, in float32, with the reference system of the .prj beside it."""
    text = path.read_text(encoding="latin-1")
    header: dict[str, float] = {}
    at = 0
    while (line := re.compile(r"\s*([A-Za-z_]+)\s+(\S+)").match(text, at)) and line[1].lower() in _KEYS:
        try:
            header[line[1].lower()] = float(line[2])
        except ValueError as error:
            raise FileError(f"its {line[1]} must be a number, it is {line[2]!r}") from error
        at = line.end()
    dx, dy = (header.get(name, header.get("cellsize")) for name in ("dx", "dy"))
    if dx is None or dy is None or not {"ncols", "nrows"} <= header.keys():
        raise FileError("it is not an ESRI ASCII grid: it must begin with ncols, nrows and cellsize")
    west, south = (
        header[f"{axis}llcenter"] if f"{axis}llcenter" in header else header.get(f"{axis}llcorner", -step / 2) + step / 2
        for axis, step in (("x", dx), ("y", dy))
    )
    nx, ny = (int(header[name]) for name in ("ncols", "nrows"))
    require_pixels(ny, nx)
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)
        try:
            values = np.fromstring(text[at:], np.float32, sep=" ")
        except (DeprecationWarning, ValueError) as error:
            raise FileError("it is damaged: not all of its heights are numbers") from error
    if values.size != ny * nx:
        raise FileError(f"it is cut off or damaged: {nx} x {ny} heights take {nx * ny} numbers, it holds {values.size}")
    used = nodata(header.get("nodata_value"))
    wkt, crs = system_of(path)
    place = Georeference(wkt, nodata=used, point="xllcenter" in header)
    return Terrain(heights_of(values.reshape(ny, nx)[::-1], used), dx, dy, west, south, crs, place)


def write_asc(path: Path, terrain: Terrain) -> None:
    """Writes an ESRI ASCII grid in the coordinates of the terrain's file; cells not square have dx and dy, as GDAL's."""
    terrain.require_unrotated("the terrain in an .asc")
    dx, dy, x0, y0 = terrain.in_file
    ny, nx = terrain.heights.shape
    cell = f"cellsize {dx!r}" if dx == dy else f"dx {dx!r}\ndy {dy!r}"
    place = terrain.georeference and terrain.georeference.nodata
    nodata = -9999.0 if place is None or not np.isfinite(place) else place
    if np.any(terrain.heights == terrain.heights.dtype.type(nodata)):
        nodata = np.nan  # which GDAL writes too
    header = (
        f"ncols {nx}\nnrows {ny}\nxllcorner {x0 - dx / 2!r}\nyllcorner {y0 - dy / 2!r}\n{cell}\nNODATA_value {nodata:.10g}\n"
    )
    rows = np.where(np.isfinite(terrain.heights), terrain.heights, terrain.heights.dtype.type(nodata))[::-1]
    digits = "%.9g" if rows.dtype == np.float32 else "%.17g"
    with path.open("w", encoding="ascii") as file:
        file.write(header)
        file.writelines(" ".join([digits % height for height in row.tolist()]) + "\n" for row in rows)


def read_hgt(path: Path, nodata: Nodata) -> Terrain:
    """A tile of SRTM: heights in metres at every 1" or 3" of a degree, whose south-western corner is the file's name."""
    name = re.match(r"([NS])(\d{2})([EW])(\d{3})", path.name, re.IGNORECASE)
    if name is None:
        raise FileError("its name must begin with its south-western corner, as N35W085.hgt does")
    size = path.stat().st_size
    side = {2 * side**2: side for side in (1201, 3601)}.get(size)
    if side is None:
        raise FileError(f"it must hold 1201 x 1201 or 3601 x 3601 heights of two bytes, its size is {size} bytes")
    y0, x0 = (float(number) * (-1 if letter in "SWsw" else 1) for letter, number in ((name[1], name[2]), (name[3], name[4])))
    void = nodata(-32768.0)
    heights = heights_of(np.fromfile(path, ">i2").reshape(side, side)[::-1], void)
    place = Georeference(WGS84_DEGREES, nodata=void, point=True)
    return Terrain(heights, 1 / (side - 1), 1 / (side - 1), x0, y0, coordinate_system(WGS84_DEGREES), place)


def read_mujoco(path: Path, nodata: Nodata) -> Terrain:
    """A height field of MuJoCo: rows and columns as int32, then float32, row 0 at -y. MuJoCo scales them to 0..1, we do not."""
    data = path.read_bytes()
    if len(data) < 8:
        raise FileError("it is not a height field of MuJoCo: it must begin with the numbers of rows and columns")
    ny, nx = np.frombuffer(data, "<i4", 2).tolist()
    require_pixels(ny, nx)
    if len(data) != 8 + 4 * ny * nx:
        raise FileError(f"it is cut off or damaged: {nx} x {ny} heights take {4 * ny * nx} bytes, it holds {len(data) - 8}")
    return Terrain(heights_of(np.frombuffer(data, "<f4", offset=8).reshape(ny, nx), nodata(None)))
