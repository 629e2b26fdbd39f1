"""Terrain as triangles for other programs, written through trimesh."""

import re
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from ...core.errors import ArgumentError, kind_of
from ...core.extras import import_extra
from ..files import PathLike, replacing, require_writable
from ..pictures.images import linear_from_srgb
from .terrain import Terrain

MESHES = (".glb", ".obj", ".ply", ".stl")
require_writable_mesh = partial(require_writable, "save_mesh", "a mesh", MESHES)

_Triangles = Int[np.ndarray, "m 3"]


def save_mesh(
    path: PathLike,
    terrain: Terrain,
    *,
    base: float | None = None,
    colours: Any = None,
    uv: bool = False,
    longer_side: float | None = None,
) -> None:
    """Writes a terrain as a mesh of the triangles that the renderer sees: .ply, .obj, .glb or .stl (needs trimesh).

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
      longer_side: how long the longer side of the footprint is in the file, holes included, to which all is scaled; printers
        take an .stl's numbers for millimetres. None: as long as in the terrain's unit.

    Raises:
      FileNotFoundError, PermissionError: the folder is not there, or nothing can be written into it.
      ValueError: the ending is not known, or a package for it is missing; no cell has four heights, or `base`, `colours`,
        `uv` or `longer_side` cannot be, see there; .stl holds neither colours nor `uv`.
    """
    path = require_writable_mesh(path)
    if not hasattr(terrain, "dx"):  # as of a Heightfield, which would import JAX here
        raise ArgumentError("save_mesh", "terrain", f"must be a jaxhf.Terrain, it is {kind_of(terrain)}")
    heights = np.asarray(terrain.heights, np.float64)
    ny, nx = heights.shape
    lowest = np.nanmin(heights, initial=np.inf)
    if base is not None and not base < lowest:
        raise ArgumentError("save_mesh", "base", f"must lie below all heights, the lowest is {lowest:.6g}, it is {base}")
    is_number = isinstance(longer_side, int | float | np.number) and not isinstance(longer_side, bool)
    if longer_side is not None and not (is_number and 0 < longer_side < np.inf):
        raise ArgumentError("save_mesh", "longer_side", f"must be positive and finite, it is {longer_side!r}")
    if path.suffix.lower() == ".stl" and (uv or colours is not None):
        raise ArgumentError("save_mesh", "uv" if uv else "colours", f"cannot stand in an .stl, as {path.name} is")
    if colours is not None:
        colours = np.asarray(colours)
        if uv or colours.dtype != np.uint8 or colours.shape not in ((ny, nx, 3), (ny, nx, 4)):
            rule = f"must be uint8 of shape {(ny, nx, 3)} or {(ny, nx, 4)}, without uv"
            raise ArgumentError("save_mesh", "colours", f"{rule}; they are {colours.dtype} of shape {colours.shape}")
    whole = np.logical_and.reduce(_corners(np.isfinite(heights)))
    if not whole.any():
        raise ArgumentError("save_mesh", "terrain", "must have a cell without a hole, it has none")
    points = np.stack([*np.meshgrid(np.arange(nx) * terrain.dx, np.arange(ny) * terrain.dy), heights], axis=-1).reshape(-1, 3)
    corners = _corners(np.arange(ny * nx).reshape(ny, nx))
    a, b, c, d = (corner[whole] for corner in corners)
    faces = np.stack([a, b, c, a, c, d], axis=-1).reshape(-1, 3)  # split along 00-11, counter-clockwise from above
    if base is not None:
        faces = np.concatenate([faces, faces[:, ::-1] + ny * nx, _walls(whole, corners, ny * nx)])
        points = np.concatenate([points, points * (1, 1, 0) + (0, 0, base)])
    if longer_side is not None:
        points = points * (longer_side / max((nx - 1) * terrain.dx, (ny - 1) * terrain.dy))
    mesh = _mesh(path.suffix.lower(), points, faces, heights.shape, colours, uv)
    with replacing(path) as temporary:
        temporary.write_bytes(mesh)


def _corners(values: np.ndarray) -> list[np.ndarray]:
    """Those of each cell, of values at vertices, counter-clockwise from 00: 00, 10, 11, 01."""
    return [values[:-1, :-1], values[:-1, 1:], values[1:, 1:], values[1:, :-1]]


def _walls(whole: Bool[np.ndarray, "cy cx"], corners: list[np.ndarray], count: int) -> _Triangles:
    """Two triangles below each edge of a whole cell that no other shares; a vertex's foot is `count` further."""
    padded, found = np.pad(whole, 1), []
    for k, (iy, ix) in enumerate(((0, 1), (1, 2), (2, 1), (1, 0))):  # the neighbours in the south, east, north and west
        alone = whole & ~padded[iy : iy + whole.shape[0], ix : ix + whole.shape[1]]
        p, q = corners[k][alone], corners[(k + 1) % 4][alone]
        found += [np.stack([q, p, p + count], axis=-1), np.stack([q, p + count, q + count], axis=-1)]
    return np.concatenate(found)


def _mesh(
    ending: str, points: Float[np.ndarray, "n 3"], faces: _Triangles, shape: tuple[int, ...], colours: Any, uv: bool
) -> bytes:
    """The file's bytes; the points are the vertices of a terrain of that shape, perhaps followed by their feet."""
    trimesh = import_extra("trimesh", "writing meshes needs", "mesh")
    ny, nx = shape
    visual, of = None, np.arange(len(points)) % (ny * nx)  # the vertex that each point belongs to
    if colours is not None:
        colours = colours.reshape(ny * nx, -1)[of]
        if ending == ".glb":  # whose colours are linear
            linear = (linear_from_srgb(np.arange(256) / 255) * 255 + 0.5).astype(np.uint8)
            colours = np.concatenate([linear[colours[:, :3]], colours[:, 3:]], axis=-1)
        visual = trimesh.visual.ColorVisuals(vertex_colors=colours)
    elif uv:
        visual = trimesh.visual.TextureVisuals(uv=np.stack([of % nx / (nx - 1), of // nx / (ny - 1)], axis=-1))
    if ending == ".glb":
        points = points[:, [0, 2, 1]] * (1, 1, -1)
    plain = {"tree_postprocessor": _with_material} if ending == ".glb" else {}
    mesh = trimesh.Trimesh(points, faces, process=False, visual=visual)
    mesh.remove_unreferenced_vertices()
    data = mesh.export(file_type=ending[1:], **plain)
    if isinstance(data, bytes):
        return data
    return re.sub(r"^(mtllib|usemtl).*\n?", "", data, flags=re.MULTILINE).encode()


def _with_material(tree: Any) -> None:
    """Gives a glTF without a material a matte one, as those who show it otherwise take the surface for metal."""
    if "materials" not in tree:
        tree["materials"] = [{"pbrMetallicRoughness": {"metallicFactor": 0, "roughnessFactor": 1}}]
        for mesh in tree["meshes"]:
            for primitive in mesh["primitives"]:
                primitive["material"] = 0
