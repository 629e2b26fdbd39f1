"""Meshes have the renderer's triangles, as trimesh reads them back."""

import json
from typing import Any

import numpy as np
import pytest

import jaxhf
from jaxhf import Terrain
from jaxhf.io.terrain.meshes import save_mesh

trimesh = pytest.importorskip("trimesh")

HEIGHTS = np.random.default_rng(0).uniform(5, 9, (5, 6)).astype(np.float32)


def terrain(*holes):
    heights = HEIGHTS.copy()
    for hole in holes:
        heights[hole] = np.nan
    return Terrain(heights, 30.0, 20.0, 5e5, 4.1e6)


def read(path):
    mesh = trimesh.load(path, force="mesh", process=False)
    if path.suffix == ".glb":  # y up
        mesh.vertices = mesh.vertices[:, [0, 2, 1]] * (1, -1, 1)
    return mesh


def test_the_surface_is_the_renderers(tmp_path):
    """Points above its triangles, chosen in the mesh, are met by rays at their heights; the rest of the ground is a hole."""
    holes = terrain((2, 3))
    for ending in (".obj", ".glb", ".ply"):
        save_mesh(tmp_path / f"x{ending}", holes)
    mesh, *others = (read(tmp_path / f"x{ending}") for ending in (".ply", ".obj", ".glb"))
    for other in others:
        np.testing.assert_array_equal(other.faces, mesh.faces)
        np.testing.assert_allclose(other.vertices, mesh.vertices, rtol=1e-6)
    assert mesh.faces.shape == (2 * (20 - 4), 3)
    assert len(mesh.vertices) == 30 - 1
    points = np.tensordot(mesh.triangles, [0.5, 0.3, 0.2], (1, 0))
    field = Terrain(holes.heights.astype(np.float64), 30.0, 20.0).heightfield()
    hits = jaxhf.cast(field, points + np.array([0, 0, 50]), np.tile([0.0, 0, -1], (32, 1)))
    np.testing.assert_allclose(hits.t, 50, atol=1e-5)
    np.testing.assert_allclose(hits.n, mesh.face_normals, atol=1e-5)
    np.testing.assert_allclose(mesh.triangles_cross[:, 2].sum() / 2, 16 * 600)


@pytest.mark.parametrize("holes", [(), ((2, 3),), ((0, 0), (4, 2))])
def test_a_solid_is_closed_and_has_its_volume(tmp_path, holes):
    given = terrain(*holes)
    z = given.heights.astype(float) - 1
    triangles = z[:-1, :-1] + z[:-1, 1:] + z[1:, 1:], z[:-1, :-1] + z[1:, 1:] + z[1:, :-1]
    cells = sum(triangles) / 6 + 0 * (z[:-1, 1:] + z[1:, :-1])  # nan at a hole
    for ending in (".ply", ".glb"):
        save_mesh(tmp_path / f"x{ending}", given, base=1.0)
        mesh = read(tmp_path / f"x{ending}")
        assert mesh.is_watertight
        np.testing.assert_allclose(mesh.volume, np.nansum(cells) * 600, rtol=1e-6)


def test_a_print_has_its_size(tmp_path):
    """Of a terrain of 150 x 80 units in x and y, 100 of the printer's on the longer side, and as high in proportion."""
    save_mesh(tmp_path / "x.stl", terrain(), base=1.0, longer_side=100.0)
    mesh = trimesh.load(tmp_path / "x.stl")  # which joins what an .stl holds once for each triangle
    assert mesh.is_watertight
    np.testing.assert_allclose(mesh.extents, np.array([150, 80, HEIGHTS.max() - 1]) / 1.5, rtol=1e-6)
    save_mesh(tmp_path / "x.ply", terrain(), base=1.0)
    np.testing.assert_allclose(mesh.volume, read(tmp_path / "x.ply").volume / 1.5**3, rtol=1e-5)


def test_colours_and_texture_coordinates(tmp_path):
    colours = np.random.default_rng(0).integers(0, 256, (5, 6, 3), np.uint8)
    save_mesh(tmp_path / "x.ply", terrain(), colours=colours)
    np.testing.assert_array_equal(read(tmp_path / "x.ply").visual.vertex_colors[:, :3], colours.reshape(-1, 3))
    save_mesh(tmp_path / "x.glb", terrain(), colours=colours)
    data = (tmp_path / "x.glb").read_bytes()  # whose colours trimesh leaves out when it reads a material
    length = int.from_bytes(data[12:16], "little")
    head = json.loads(data[20 : 20 + length])
    (primitive,) = head["meshes"][0]["primitives"]
    assert head["materials"][primitive["material"]]["pbrMetallicRoughness"]["metallicFactor"] == 0
    view = head["bufferViews"][head["accessors"][primitive["attributes"]["COLOR_0"]]["bufferView"]]
    found = np.frombuffer(data, np.uint8, view["byteLength"], 28 + length + view["byteOffset"]).reshape(-1, 4)
    encoded = colours.reshape(-1, 3) / 255
    linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4) * 255
    np.testing.assert_allclose(found[:, :3], linear, atol=0.5)
    save_mesh(tmp_path / "x.obj", terrain(), uv=True)
    lines = (tmp_path / "x.obj").read_text().splitlines()
    uv = np.array([line.split()[1:] for line in lines if line.startswith("vt ")], float)
    vertices = np.array([line.split()[1:] for line in lines if line.startswith("v ")], float)
    np.testing.assert_allclose(uv, vertices[:, :2] / (150, 80), atol=1e-7)
    assert not any("material" in line for line in lines)


def test_what_is_no_mesh_is_refused(tmp_path, as_users_call_it):
    cases: list[tuple[str, Terrain, dict[str, Any], str]] = [
        ("x.off", terrain(), {}, r"cannot write a mesh with the ending '\.off'"),
        ("x.stl", terrain(), {"uv": True}, r"uv cannot stand in an \.stl, as x\.stl is"),
        ("x.stl", terrain(), {"colours": np.zeros((5, 6, 3), np.uint8)}, r"colours cannot stand in an \.stl"),
        ("x.stl", terrain(), {"longer_side": 0.0}, r"longer_side must be positive and finite, it is 0\.0"),
        ("x.stl", terrain(), {"longer_side": "150"}, "longer_side must be positive and finite, it is '150'"),
        ("x.ply", terrain(), {"base": 6.0}, r"base must lie below all heights, the lowest is 5\.\d+, it is 6\.0"),
        ("x.ply", terrain(), {"colours": np.zeros((5, 6, 3))}, "colours must be uint8 of shape"),
        ("x.ply", Terrain(np.full((2, 2), np.nan)), {}, "must have a cell without a hole"),
    ]
    for name, given, options, message in cases:
        with pytest.raises(ValueError, match=message):
            save_mesh(tmp_path / name, given, **options)
    assert not list(tmp_path.iterdir())
