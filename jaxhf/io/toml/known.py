"""Heights that a fit file knows beforehand, from terrain files to the vertices of the terrain that is sought."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ..errors import FileError
from ..georeference import Place, at_vertices
from ..terrain import load_placed


class Sought(NamedTuple):
    """The heightfield that a fit recovers, as far as other files of heights depend on it.

    Attributes:
      shape: of its heights.
      path: the file that they come from; None: there is none.
      given: those of dx, dy, x0, y0 that its table has.
      z_scale, nodata: of its table, or their defaults.
    """

    shape: tuple[int, ...]
    path: Path | None = None
    given: Mapping[str, float] = {}
    z_scale: float = 1.0
    nodata: float | None = None


def known_heights(sought: Sought, path: Path) -> Float[np.ndarray, "my mx"]:
    """Heights as `start` and `prior` of `fit` take them.

    Where both files say where they lie, those at the vertices sought; else the file's own, which `fit` lays over the
    terrain from corner to corner.

    Raises:
      FileNotFoundError, FileError: as `load_heights`; or the file does not cover the terrain, or has holes in it.
    """
    cell = {"dx": 1.0, "dy": 1.0}  # in the scene's unit, which does not count here: degrees may be on any globe
    terrain, place = load_placed(path, cell, sought.z_scale, sought.nodata, nodata_overrules=False)
    heights, wanted = terrain.heights, _wanted(sought, path, place)
    if place.known and wanted.known:
        if place.degrees and not wanted.degrees:
            raise FileError("it must lie in the coordinates of the terrain, it lies in degrees")
        heights = at_vertices(heights, place, wanted, sought.shape)
    holes = np.argwhere(np.isnan(heights))
    if len(holes):
        iy, ix = holes[0].tolist()
        raise FileError(
            f"it must have a height everywhere, {len(holes)} of {heights.size} are holes; the first is row {iy} column {ix}"
        )
    return heights


def known_deviations(sought: Sought, path: Path) -> Float[np.ndarray, "my mx"]:
    """Standard deviations of such heights; they have no sign."""
    return known_heights(sought._replace(z_scale=abs(sought.z_scale)), path)


def _wanted(sought: Sought, path: Path, known: Place) -> Place:
    """The place of the terrain to compare with that of another file.

    Where the terrain's own file has it, if both name the same coordinates or are the same file, as its table may have moved
    or scaled it in the scene; else in the scene.
    """
    if sought.path is not None:
        _, place = load_placed(sought.path, sought.given)
        same = place.degrees == known.degrees and (
            place.degrees or (place.system is not None and place.system == known.system) or path == sought.path
        )
        return place if same else place.with_metres(sought.shape[0], sought.given)
    square = {name: sought.given[other] for name, other in (("dx", "dy"), ("dy", "dx")) if other in sought.given}
    return Place()._replace(**{**square, **sought.given})


def sought_heightfield(table: Mapping[str, Any], shape: tuple[int, ...], path: Path | None) -> Sought:
    """Of the table of a heightfield that has been read; `path` as in `Sought`."""
    given = {name: float(table[name]) for name in ("dx", "dy", "x0", "y0") if name in table}
    nodata = float(table["nodata"]) if "nodata" in table else None
    return Sought(shape, path, given, float(table.get("z_scale", 1)), nodata)
