"""Where a heightfield is from, and the start and prior heights of a fit file, resampled to its vertices."""

import dataclasses
from collections.abc import Collection
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from ....scene.heightfield import Heightfield
from ...errors import FileError
from ...terrain.georeference import CoordinateSystem
from ...terrain.load import read_terrain
from ...terrain.resample import at_vertices
from ...terrain.terrain import Terrain


@dataclasses.dataclass(frozen=True)
class Provenance:
    """Where a heightfield is from, as far as other files of heights depend on it."""

    placed: Terrain | None = None  # where the scene puts it; None: there is no heightfield
    stored: Terrain | None = None  # its file, in that file's coordinates; None: there is none
    path: Path | None = None  # that file
    like: Path | None = None  # that, if it is a GeoTIFF whose georeference counts: its table has none of dx, dy, x0 and y0
    z_scale: float = 1.0
    nodata: float | None = None
    # The rows and the columns of its grid that the heightfield has, see `nested`; None: all.
    posts: tuple[Int[np.ndarray, " ny"], Int[np.ndarray, " nx"]] | None = None

    @classmethod
    def of(cls, field: Heightfield, grid: Collection[str] = (), z_scale: float = 1.0) -> "Provenance":
        """That of heights in no file. They have a `crs` if `grid`, the keys of their table, has x0, y0 and the cell size."""
        crs = CoordinateSystem() if {"x0", "y0"} <= set(grid) and not {"dx", "dy"}.isdisjoint(grid) else None
        return cls(Terrain(np.asarray(field.heights), field.dx, field.dy, field.x0, field.y0, crs), z_scale=z_scale)

    def seen_by(self, field: Heightfield) -> "Provenance":
        """That of a heightfield whose posts are among its own, or go on beyond."""
        if self.placed is None:
            return self
        y, x = ((field.y0 - self.placed.y0) / self.placed.dy, (field.x0 - self.placed.x0) / self.placed.dx)
        rows, columns = (round(first) + np.arange(n) for first, n in zip((y, x), field.heights.shape, strict=True))
        return dataclasses.replace(self, posts=(rows, columns))

    def at_posts(self, heights: Float[np.ndarray, "my mx"]) -> Float[np.ndarray, "ny nx"]:
        """Heights over its footprint at the heightfield's posts; beyond, those of its border."""
        if self.posts is None or self.placed is None:
            return heights
        in_cells = CoordinateSystem()
        own = Terrain(self.placed.heights, crs=in_cells)
        dy, dx = ((n - 1) / (m - 1) for n, m in zip(own.heights.shape, heights.shape, strict=True))
        heights = at_vertices(Terrain(heights, dx, dy, crs=in_cells), own)
        rows, columns = (np.clip(at, 0, n - 1) for at, n in zip(self.posts, heights.shape, strict=True))
        return heights[rows[:, None], columns[None, :]]

    def grid(self, path: Path, other: Terrain) -> Terrain | None:
        """Its grid in coordinates that can be compared with those of `other`, which is the file `path`.

        They are those of the terrain's own file if both files are in degrees, name the same system, or are one file: the
        scene may have moved or scaled the terrain. Else they are the scene's.
        """
        own, crs = self.stored and self.stored.crs, other.crs
        if own is None or crs is None or own.degrees != crs.degrees:
            return self.placed
        same = own.degrees or path == self.path or (own.code is not None and own.code == crs.code)
        return self.stored if same else self.placed


def known_heights(field: Provenance, deviations: bool, path: Path) -> Float[np.ndarray, "my mx"]:
    """Heights as `start` and `prior` of `fit` take them, or their standard `deviations`, which have no sign.

    If the file and the terrain both have a `crs`: its heights, resampled to the terrain's vertices. Else the heights of the
    file as they are, which `fit` stretches over the terrain from corner to corner.
    """
    z_scale = abs(field.z_scale) if deviations else field.z_scale
    terrain = read_terrain(path, z_scale, field.nodata, nodata_overrules=False)
    terrain.require_unrotated()
    heights, grid = terrain.heights, field.grid(path, terrain)
    if terrain.crs is not None and grid is not None and grid.crs is not None:
        if terrain.crs.degrees and not grid.crs.degrees:
            raise FileError("it must lie in the coordinates of the terrain, it lies in degrees")
        heights = at_vertices(terrain, grid)
    heights = field.at_posts(heights)
    holes = np.argwhere(np.isnan(heights))
    if len(holes):
        iy, ix = holes[0].tolist()
        found = f"{len(holes)} of {heights.size} are holes; the first is row {iy} column {ix}"
        raise FileError(f"it must have a height everywhere, {found}")
    return heights
