"""What is measured against: the common work of a folder of peers' measurements, and the same terrain in Mitsuba 3."""

import importlib
import importlib.util
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np


def common_work(peers: Path) -> Any:
    """The module common_work.py of that folder: terrains, cameras, lights."""
    spec = importlib.util.spec_from_file_location("common_work", peers / "common_work.py")
    assert spec is not None
    assert spec.loader is not None
    work = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(work)
    return work


class MitsubaScene(NamedTuple):
    """A terrain in Mitsuba 3 (pip install mitsuba; it needs LLVM's library, see DRJIT_LIBLLVM_PATH).

    Attributes:
      dr, mi: its modules; they are in none of our extras.
      scene: what it renders.
      parameters: of the scene; `place` among them is where the vertices are.
      positions: the vertices, x, y and z one after the other.
    """

    dr: Any
    mi: Any
    scene: Any
    parameters: Any
    positions: np.ndarray

    place = "terrain.vertex_positions"


def mitsuba_scene(
    heights: np.ndarray,
    view: tuple[Sequence[float], Sequence[float], float],
    towards: Sequence[float],
    pixels: int,
    integrator: str,
    samples: int = 1,
    albedo: float | None = None,
) -> MitsubaScene:
    """Heights over the unit square under one directional light.

    Args:
      view: eye, target, field of view in degrees.
      towards: the light.
      albedo: of a surface with two sides; None: Mitsuba's default.
    """
    dr, mi = importlib.import_module("drjit"), importlib.import_module("mitsuba")
    mi.set_variant("llvm_ad_rgb")
    size = len(heights)
    x, y = np.meshgrid(np.linspace(0, 1, size), np.linspace(0, 1, size))
    corner = (np.arange(size - 1)[:, None] * size + np.arange(size - 1)).ravel()
    faces = np.concatenate(
        [np.stack([corner, corner + 1, corner + size + 1], 1), np.stack([corner, corner + size + 1, corner + size], 1)]
    )
    mesh = mi.Mesh("terrain", size * size, len(faces), has_vertex_normals=True)
    parameters = mi.traverse(mesh)
    positions = np.stack([x, y, heights], -1).astype(np.float32).ravel()
    parameters["faces"] = faces.astype(np.uint32).ravel()
    parameters["vertex_positions"] = positions
    parameters.update()
    if albedo is not None:
        mesh.set_bsdf(mi.load_dict({"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": albedo}}))
    eye, target, fov = view
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": integrator},
            "terrain": mesh,
            "light": {"type": "directional", "direction": [-float(v) for v in towards], "irradiance": np.pi},
            "sensor": {
                "type": "perspective",
                "fov": fov,
                "to_world": mi.ScalarTransform4f().look_at(origin=list(eye), target=list(target), up=[0, 0, 1]),
                "film": {"type": "hdrfilm", "width": pixels, "height": pixels, "rfilter": {"type": "box"}},
                "sampler": {"type": "independent", "sample_count": samples},
            },
        }
    )
    return MitsubaScene(dr, mi, scene, mi.traverse(scene), positions)
