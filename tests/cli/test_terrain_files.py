"""`jaxhf info` and `convert` on terrain files."""

import numpy as np
import pytest

from jaxhf import Terrain, load_heights, save_heights
from jaxhf.io.terrain.georeference import WGS84_DEGREES, Georeference, coordinate_system

DEGREES = Georeference(WGS84_DEGREES, nodata=-9999.0)


@pytest.fixture
def folder(tmp_path):
    heights = np.array([[1, 2.5, np.nan], [4, 5, 6], [7, 8, 9]], np.float32)
    terrain = Terrain(heights, 0.01, 0.01, 10.0, 44.99, coordinate_system(WGS84_DEGREES), DEGREES).in_metres()
    save_heights(tmp_path / "degrees.npz", terrain)
    save_heights(tmp_path / "metres.asc", Terrain(heights[1:], 30.0, 20.0, 5e5, 4e6))
    np.save(tmp_path / "bare.npy", np.full((2, 2), np.nan))
    return tmp_path


INFO = {
    "degrees.npz": """3 rows, 3 columns of float32
cells: 0.01 x 0.01 degree, in the middle 788.468 x 1111.32 metres
place: longitude 10 to 10.02, latitude 44.99 to 45.01
system: WGS 84 (EPSG:4326)
heights: 1 to 9, 1 hole (11.1 %), stored as -9999
""",
    "metres.asc": """2 rows, 3 columns of float32
cells: 30 x 20
place: x 500000 to 500060, y 4000000 to 4000020
system: not known
heights: 4 to 9, no holes
""",
    "bare.npy": """2 rows, 2 columns of float64
cells: not in the file, taken as 1 x 1
system: not known
heights: none, 4 holes (100 %)
""",
}


@pytest.mark.parametrize("name", INFO)
def test_info_describes_terrain(folder, command, name):
    assert command("info", folder / name)[:2] == (0, f"{folder / name}: {INFO[name]}")


CONVERTED = {
    # What the file says, but for a mesh, which is in metres and may be a solid.
    "degrees.npz x.asc": "x.asc: Heightfield, 3 x 3 heights, cells 0.01 x 0.01, origin (10, 44.99), range (1, 9), 1 hole",
    "degrees.npz x.ply": "cells 788.468 x 1111.32, origin (0, 0), range (1, 9), 1 hole",
    "metres.asc x.glb --base 0": "x.glb: Heightfield, 2 x 3 heights, cells 30 x 20, origin (500000, 4e+06), range (4, 9)",
    "metres.asc x.tif": "cells 30 x 20, origin (500000, 4e+06), range (4, 9)",
    "metres.asc x.npy --z-scale 2 --nodata 5": "range (8, 18), 1 hole (.npy holds the heights alone)",
    "metres.asc x.exr": "range (4, 9) (.exr holds the heights alone)",
    "metres.asc x.png": "range (4, 9)",
    "metres.asc x.png --z-scale 0.25": "range (1, 2.25) (.png holds whole numbers: heights are rounded to steps of 1)",
}


def test_convert_says_what_it_writes(folder, command):
    trimesh, _, _ = map(pytest.importorskip, ("trimesh", "rasterio", "OpenEXR"))
    for words, said in CONVERTED.items():
        source, output, *more = words.split()
        code, out, _ = command("convert", folder / source, folder / output, *more)
        assert (code, out.endswith(f"{said}\n")) == (0, True), out
    found, given = (load_heights(folder / name) for name in ("x.tif", "metres.asc"))
    np.testing.assert_array_equal(found.heights, given.heights)
    assert (found.dx, found.dy, found.x0, found.y0) == (given.dx, given.dy, given.x0, given.y0) == (30, 20, 5e5, 4e6)
    np.testing.assert_array_equal(np.load(folder / "x.npy"), [[8, np.nan, 12], [14, 16, 18]])
    assert trimesh.load(folder / "x.glb", force="mesh", process=False).is_watertight
