"""Terrain as triangles for other programs, written through trimesh."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Int

from ..core.errors import ArgumentError, kind_of
from .files import PathLike, by_ending, file_path, replacing, require_folder
from .mesh_formats import Mesh, Triangles, write_glb, write_obj, write_ply
from .terrain import Terrain

_WRITERS = {".glb": write_glb, ".obj": write_obj, ".ply": write_ply}
MESHES = tuple(_WRITERS)


def save_mesh(path: PathLike, terrain: Terrain, *, base: float | None = None, colours: Any = None, uv: bool = False) -> None:
    """Writes a terrain as a mesh of the triangles that the renderer sees: .ply, .obj or .glb.

    Its vertices are those of the terrain from vertex (0, 0) on, as float32 holds no UTM coordinates, in the terrain's unit; x
    points east, y north and z up, in .glb y up and z south, as glTF demands. Cells at a hole are left out. The file appears
    whole or not at all.

    Args:
      path: the file.
      terrain: the heights.
      base: a height below all of the terrain, to which walls go down from its border and its holes, closed by a floor: a solid,
        to be printed or cut. None: the surface alone.
      colours: of the vertices, sRGB as bytes: uint8 of shape (ny, nx, 3) or, with opacity, (ny, nx, 4), row 0 in the south.
      uv: whether each vertex has its position in the footprint, 0..1 to the east and to the north, for an image to be draped.

    Raises:
      ValueError: the ending is not known, `path` is a folder, no cell has four heights, or `base`,
        `colours` or `uv` cannot be; see there.
      FileNotFoundError, PermissionError: the folder does not exist, or cannot be written to.
    """
    path = require_writable_mesh(path)
    if not hasattr(terrain, "dx"):  # as of a Heightfield, which would import JAX here
        raise ArgumentError("save_mesh", "terrain", f"must be a jaxhf.Terrain, it is {kind_of(terrain)}")
    heights = np.asarray(terrain.heights, np.float64)
    ny, nx = heights.shape
    if base is not None and not base < np.nanmin(heights, initial=np.inf):
        lowest = np.nanmin(heights, initial=np.inf)
        raise ArgumentError("save_mesh", "base", f"must lie below all heights, the lowest is {lowest:.6g}, it is {base}")
    if colours is not None:
        colours = np.asarray(colours)
        if uv or colours.dtype != np.uint8 or colours.shape not in ((ny, nx, 3), (ny, nx, 4)):
            rule = f"must be uint8 of shape {(ny, nx, 3)} or {(ny, nx, 4)}, without uv"
            raise ArgumentError("save_mesh", "colours", f"{rule}; they are {colours.dtype} of shape {colours.shape}")
    finite = np.isfinite(heights)
    whole = finite[:-1, :-1] & finite[:-1, 1:] & finite[1:, 1:] & finite[1:, :-1]
    if not whole.any():
        raise ArgumentError("save_mesh", "terrain", "must have a cell without a hole, it has none")
    faces, z, of = _surface(whole), heights.ravel(), np.arange(ny * nx, dtype=np.int32)
    if base is not None:
        faces = np.concatenate([faces, faces[:, ::-1] + np.int32(ny * nx), *_walls(whole, ny * nx)])
        z, of = np.concatenate([z, np.full(ny * nx, base)]), np.tile(of, 2)
    used = np.zeros(len(of), bool)
    used[faces] = True
    if not used.all():  # copies of the largest arrays
        z, of, faces = z[used], of[used], (np.cumsum(used, dtype=np.int32) - np.int32(1))[faces]
    mesh = Mesh(z, of, faces, (ny, nx), (terrain.dx, terrain.dy), colours, uv)
    with replacing(path) as temporary, temporary.open("wb") as file:
        by_ending(_WRITERS, path, "write a mesh with")(file, mesh)


def require_writable_mesh(path: PathLike) -> Path:
    """Checks that `save_mesh` can write to `path`; errors as there."""
    path = file_path("save_mesh", path)
    by_ending(_WRITERS, path, "write a mesh with")
    require_folder(path, "a mesh")
    return path


def _corners(whole: Bool[np.ndarray, "cy cx"]) -> list[Int[np.ndarray, " cells"]]:
    """The vertices of each whole cell, counter-clockwise from 00: 00, 10, 11, 01."""
    (iy, ix), columns = (at.astype(np.int32) for at in np.nonzero(whole)), np.int32(whole.shape[1] + 1)
    first = iy * columns + ix
    return [first, first + 1, first + 1 + columns, first + columns]


def _surface(whole: Bool[np.ndarray, "cy cx"]) -> Triangles:
    """Two triangles for each whole cell, split along 00-11, counter-clockwise from above."""
    a, b, c, d = _corners(whole)
    faces = np.empty((len(a), 6), np.int32)
    for k, corner in enumerate((a, b, c, a, c, d)):
        faces[:, k] = corner
    return faces.reshape(-1, 3)


def _walls(whole: Bool[np.ndarray, "cy cx"], count: int) -> Iterator[Triangles]:
    """Two triangles below each edge of a whole cell that no other shares; a vertex's foot is `count` further."""
    padded, foot = np.pad(whole, 1), np.int32(count)
    for k, (iy, ix) in enumerate(((0, 1), (1, 2), (2, 1), (1, 0))):  # the neighbours in the south, east, north and west
        corners = _corners(whole & ~padded[iy : iy + whole.shape[0], ix : ix + whole.shape[1]])
        p, q = corners[k], corners[(k + 1) % 4]
        yield np.stack([q, p, p + foot], axis=-1)
        yield np.stack([q, p + foot, q + foot], axis=-1)
