"""Meshes as .ply, .obj and .glb, written in blocks: the largest array in memory is that of the triangles."""

import json
import struct
from collections.abc import Callable, Iterator
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from jaxtyping import Float, Int, Int32, UInt8

from ..core.errors import ArgumentError
from .images import linear_from_srgb

Triangles = Int32[np.ndarray, "m 3"]
_AT_ONCE = 2**16  # vertices or triangles


class Mesh(NamedTuple):
    """Triangles between vertices of a terrain and of its floor.

    Attributes:
      z: height of each point.
      of: the vertex of the terrain that the point belongs to, as y * nx + x.
      faces: the points of each triangle, counter-clockwise from outside.
      shape, spacing: of the terrain, (ny, nx) and (dx, dy).
      colours: of the terrain's vertices, sRGB as bytes; None: none.
      uv: whether points have a position in the footprint, 0..1.
    """

    z: Float[np.ndarray, " n"]
    of: Int[np.ndarray, " n"]
    faces: Triangles
    shape: tuple[int, int]
    spacing: tuple[float, float]
    colours: UInt8[np.ndarray, "ny nx bands"] | None
    uv: bool

    def points(self, rows: slice) -> Float[np.ndarray, "k 3"]:
        x, y = self.of[rows] % self.shape[1], self.of[rows] // self.shape[1]
        return np.stack([x * self.spacing[0], y * self.spacing[1], self.z[rows]], axis=-1)

    def colours_of(self, rows: slice) -> UInt8[np.ndarray, "k bands"]:
        assert self.colours is not None
        return self.colours.reshape(-1, self.colours.shape[-1])[self.of[rows]]

    def texture(self, rows: slice) -> Float[np.ndarray, "k 2"]:
        ny, nx = self.shape
        return np.stack([self.of[rows] % nx / (nx - 1), self.of[rows] // nx / (ny - 1)], axis=-1)


def _blocks(values: np.ndarray) -> Iterator[slice]:
    for first in range(0, len(values), _AT_ONCE):
        yield slice(first, first + _AT_ONCE)


def write_obj(file: BinaryIO, mesh: Mesh) -> None:
    """Wavefront's text; colours follow the coordinates, 0 to 1, as most programs read them."""

    def lines(form: str, values: np.ndarray) -> None:
        file.write((form * len(values) % tuple(values.ravel().tolist())).encode())

    for rows in _blocks(mesh.of):
        points = mesh.points(rows)
        if mesh.colours is None:
            lines("v %.9g %.9g %.9g\n", points)
        else:
            lines("v %.9g %.9g %.9g %.4g %.4g %.4g\n", np.concatenate([points, mesh.colours_of(rows)[:, :3] / 255], axis=-1))
    if mesh.uv:
        for rows in _blocks(mesh.of):
            lines("vt %.9g %.9g\n", mesh.texture(rows))
    for rows in _blocks(mesh.faces):
        if mesh.uv:
            lines("f %d/%d %d/%d %d/%d\n", np.repeat(mesh.faces[rows] + 1, 2, axis=-1))
        else:
            lines("f %d %d %d\n", mesh.faces[rows] + 1)


def write_ply(file: BinaryIO, mesh: Mesh) -> None:
    """Stanford's, little-endian; positions in the footprint are called s and t."""
    bands = 0 if mesh.colours is None else mesh.colours.shape[-1]
    floats, colours = ["x", "y", "z", *("s", "t")[: 2 * mesh.uv]], ["red", "green", "blue", "alpha"][:bands]
    properties = [*(f"float {name}" for name in floats), *(f"uchar {name}" for name in colours)]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(mesh.of)}"]
    header += [*(f"property {line}" for line in properties), f"element face {len(mesh.faces)}"]
    header += ["property list uchar int vertex_indices", "end_header", ""]
    file.write("\n".join(header).encode())
    for rows in _blocks(mesh.of):
        points = mesh.points(rows)
        block = np.empty(len(points), [("floats", "<f4", len(floats)), ("colours", "u1", bands)])
        block["floats"] = np.concatenate([points, mesh.texture(rows)], axis=-1) if mesh.uv else points
        if bands:
            block["colours"] = mesh.colours_of(rows)
        file.write(block.tobytes())
    for rows in _blocks(mesh.faces):
        block = np.empty(len(mesh.faces[rows]), [("count", "u1"), ("points", "<i4", 3)])
        block["count"], block["points"] = 3, mesh.faces[rows]
        file.write(block.tobytes())


def write_glb(file: BinaryIO, mesh: Mesh) -> None:
    """glTF 2.0 in one file: y up and z south, linear colours, v from the north down."""
    nx = mesh.shape[1]
    x, y = mesh.of % nx * mesh.spacing[0], mesh.of // nx * mesh.spacing[1]
    low, high = [x.min(), mesh.z.min(), -y.max()], [x.max(), mesh.z.max(), -y.min()]
    bounds = {name: np.array(corner, np.float32).tolist() for name, corner in (("min", low), ("max", high))}
    linear = np.rint(linear_from_srgb(np.arange(256) / 255) * 255).astype(np.uint8)

    def colours(rows: slice) -> UInt8[np.ndarray, "k 4"]:
        found = mesh.colours_of(rows)
        opacity = found[:, 3:] if found.shape[-1] == 4 else np.full((len(found), 1), 255, np.uint8)
        return np.concatenate([linear[found[:, :3]], opacity], axis=-1)

    # Name, kind, component, what else the accessor says, and the values of some vertices or triangles.
    arrays: list[tuple[str, str, str, dict[str, Any], Callable[[slice], np.ndarray]]] = [
        ("indices", "SCALAR", "<u4", {}, lambda rows: mesh.faces[rows]),
        ("POSITION", "VEC3", "<f4", bounds, lambda rows: mesh.points(rows)[:, [0, 2, 1]] * (1, 1, -1)),
    ]
    if mesh.colours is not None:
        arrays.append(("COLOR_0", "VEC4", "u1", {"normalized": True}, colours))
    if mesh.uv:
        arrays.append(("TEXCOORD_0", "VEC2", "<f4", {}, lambda rows: mesh.texture(rows) * (1, -1) + (0, 1)))
    views, accessors, end = [], [], 0
    for k, (name, kind, component, more, _) in enumerate(arrays):
        count = mesh.faces.size if name == "indices" else len(mesh.of)
        size = count * np.dtype(component).itemsize * _PARTS[kind]
        views.append({"buffer": 0, "byteOffset": end, "byteLength": size})
        accessors.append({"bufferView": k, "type": kind, "componentType": _COMPONENTS[component], "count": count, **more})
        end += size
    primitive = {"attributes": {name: k for k, (name, *_) in enumerate(arrays) if k}, "indices": 0, "material": 0}
    head = {
        "asset": {"version": "2.0", "generator": "jaxhf"},
        "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}], "meshes": [{"primitives": [primitive]}],
        "materials": [{"pbrMetallicRoughness": {"metallicFactor": 0, "roughnessFactor": 1}, "doubleSided": True}],
        "accessors": accessors, "bufferViews": views, "buffers": [{"byteLength": end}],
    }  # fmt: skip
    text = json.dumps(head).encode()
    text += b" " * (-len(text) % 4)
    total = 12 + 8 + len(text) + 8 + end
    if total >= 2**32:
        raise ArgumentError("save_mesh", "terrain", f"must be smaller for .glb, which holds 4.2 GB, it takes {total / 1e9:.3g}")
    file.write(struct.pack("<4sIIII", b"glTF", 2, total, len(text), 0x4E4F534A) + text)
    file.write(struct.pack("<I4s", end, b"BIN\0"))
    for name, _, component, _, values in arrays:
        for rows in _blocks(mesh.faces if name == "indices" else mesh.of):
            file.write(values(rows).astype(component).tobytes())


_PARTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_COMPONENTS = {"u1": 5121, "<u4": 5125, "<f4": 5126}  # glTF's numbers
