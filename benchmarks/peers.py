"""What is measured against: the common work of a folder of peers' measurements, and the same terrain in other renderers."""

import functools
import importlib
import importlib.util
import re
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from benchmark import need, refuse


def common_work(peers: Path) -> Any:
    """The module common_work.py of that folder: terrains, cameras, lights."""
    spec = importlib.util.spec_from_file_location("common_work", peers / "common_work.py")
    assert spec is not None
    assert spec.loader is not None
    work = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(work)
    return work


def mesh_of(heights: np.ndarray, extent: tuple[float, float] = (1.0, 1.0)) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (n, 3) of heights (ny, nx) over a footprint of this extent in x and y, and triangles (m, 3)."""
    ny, nx = heights.shape
    x, y = np.meshgrid(np.linspace(0, extent[0], nx), np.linspace(0, extent[1], ny))
    corner = (np.arange(ny - 1)[:, None] * nx + np.arange(nx - 1)).ravel()
    lower, upper = [corner, corner + 1, corner + nx + 1], [corner, corner + nx + 1, corner + nx]
    faces = np.concatenate([np.stack(lower, 1), np.stack(upper, 1)])
    return np.stack([x, y, heights], -1).astype(np.float32).reshape(-1, 3), faces.astype(np.int32)


View = tuple[Sequence[float], Sequence[float], float]
"""Eye, target, field of view in degrees."""


class MitsubaScene(NamedTuple):
    """A terrain in Mitsuba 3 (pip install mitsuba).

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


@functools.cache
def mitsuba_variant() -> str:
    """The quickest variant of Mitsuba that runs here: the first needs LLVM's library (see DRJIT_LIBLLVM_PATH).

    A process of its own tries it: Dr.Jit 1.5 with LLVM 15 aborts with "Cannot select: fminimum" on x86; LLVM 22 does not.
    """
    probe = "import mitsuba as mi; mi.set_variant('llvm_ad_rgb'); mi.render(mi.load_dict(mi.cornell_box()), spp=1).numpy()"
    tried = subprocess.run([sys.executable, "-c", probe], capture_output=True)
    return "scalar_rgb" if tried.returncode else "llvm_ad_rgb"


def need_fast_mitsuba() -> None:
    """Ends where Mitsuba cannot be timed or differentiated."""
    need("mitsuba")
    if mitsuba_variant() == "scalar_rgb":
        refuse("it needs Mitsuba with a library of LLVM that works with it, 16 or newer, which DRJIT_LIBLLVM_PATH names")


def mitsuba_scene(
    heights: np.ndarray,
    view: View,
    towards: Sequence[float],
    pixels: int | tuple[int, int],
    integrator: str = "direct",
    samples: int = 1,
    albedo: float | np.ndarray | None = None,
    extent: tuple[float, float] = (1.0, 1.0),
    orthographic: bool = False,
) -> MitsubaScene:
    """Heights over a footprint of this extent in x and y, under one directional light.

    Args:
      view: eye, target and field of view; if `orthographic`, in place of that what the shorter side of the picture shows.
      towards: the light.
      pixels: a side, or width and height.
      albedo: of a surface with two sides: a number, or texels (ny, nx, 3), row 0 in the south; None: Mitsuba's default.
    """
    dr, mi = importlib.import_module("drjit"), importlib.import_module("mitsuba")
    mi.set_variant(mitsuba_variant())
    mi.set_log_level(mi.LogLevel.Error)  # it warns of every picture without mirrored silhouettes
    vertices, faces = mesh_of(heights, extent)
    textured = isinstance(albedo, np.ndarray)
    mesh = mi.Mesh("terrain", len(vertices), len(faces), has_vertex_normals=True, has_vertex_texcoords=textured)
    parameters = mi.traverse(mesh)
    positions = vertices.ravel()
    parameters["faces"] = faces.astype(np.uint32).ravel()
    parameters["vertex_positions"] = positions
    reflectance: Any = albedo
    if textured:
        parameters["vertex_texcoords"] = mesh_of(0 * heights)[0][:, :2].ravel()
        bitmap = mi.Bitmap(np.ascontiguousarray(albedo, np.float32))
        reflectance = {"type": "bitmap", "bitmap": bitmap, "raw": True, "filter_type": "bilinear", "wrap_mode": "repeat"}
    parameters.update()
    if albedo is not None:
        mesh.set_bsdf(mi.load_dict({"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": reflectance}}))
    eye, target, shown = view
    width, height = pixels if isinstance(pixels, tuple) else (pixels, pixels)
    distance = float(np.linalg.norm(np.subtract(target, eye)))
    pose = mi.ScalarTransform4f().look_at(origin=list(eye), target=list(target), up=[0, 0, 1])
    if orthographic:
        half = shown / 2 * width / min(width, height)
        kind = {"type": "orthographic", "to_world": pose @ mi.ScalarTransform4f().scale([half, half, 1])}
    else:
        kind = {"type": "perspective", "fov": shown, "fov_axis": "smaller", "to_world": pose}
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": integrator},
            "terrain": mesh,
            "light": {"type": "directional", "direction": [-float(v) for v in towards], "irradiance": np.pi},
            "sensor": kind
            | {
                "near_clip": 0.01 * distance,  # its defaults, 0.01 and 1e4, cut off terrains in metres
                "far_clip": 100 * distance,
                "film": {"type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": "box"}},
                "sampler": {"type": "independent", "sample_count": samples},
            },
        }
    )
    return MitsubaScene(dr, mi, scene, mi.traverse(scene), positions)


def mitsuba_picture(heights: np.ndarray, view: View, towards: Sequence[float], pixels: Any, **options: Any) -> np.ndarray:
    """A picture (h, w, 3) of the heights and options of `mitsuba_scene`."""
    made = mitsuba_scene(heights, view, towards, pixels, **options)
    return np.array(made.mi.render(made.scene))[..., :3]


def camera_rays(view: View, pixels: int) -> np.ndarray:
    """Unit directions (pixels * pixels, 3) through the pixels' centres, row after row from the top left."""
    eye, target, fov = view
    forward = (np.asarray(target) - eye) / np.linalg.norm(np.asarray(target) - eye)
    right = np.cross(forward, (0, 0, 1))
    right /= np.linalg.norm(right)
    up = np.cross(right, forward)
    s = ((np.arange(pixels) + 0.5) / pixels * 2 - 1) * np.tan(np.radians(fov) / 2)
    d = forward + s[None, :, None] * right - s[:, None, None] * up
    return (d / np.linalg.norm(d, axis=-1, keepdims=True)).reshape(-1, 3)


def embree_frame(
    heights: np.ndarray, view: View, towards: Sequence[float], pixels: int
) -> tuple[Callable[[], np.ndarray], Callable[[], None]]:
    """A frame by Embree (pip install embreex) on one core, shaded with NumPy, and what builds its structure."""
    rtcore = importlib.import_module("embreex.rtcore_scene")
    construction = importlib.import_module("embreex.mesh_construction")
    vertices, faces = mesh_of(heights)
    d = camera_rays(view, pixels).astype(np.float32)
    o = np.broadcast_to(np.asarray(view[0], np.float32), d.shape).copy()
    wi = (np.asarray(towards) / np.linalg.norm(towards)).astype(np.float32)
    sun = np.broadcast_to(wi, d.shape)
    origin, along, across = (vertices[faces[:, k]] for k in range(3))
    normals = np.zeros_like(vertices)
    for k in range(3):
        np.add.at(normals, faces[:, k], np.cross(along - origin, across - origin))
    held = []

    def build() -> None:
        scene = rtcore.EmbreeScene()
        held[:] = [scene, construction.TriangleMesh(scene, vertices, faces)]
        scene.run(o[:1], d[:1])  # it builds when it is first asked

    def frame() -> np.ndarray:
        scene = held[0]
        hits = scene.run(o, d, output=True)
        met = np.flatnonzero(hits["primID"] >= 0)
        corners = faces[hits["primID"][met]]
        u, v = hits["u"][met, None], hits["v"][met, None]
        ns = normals[corners[:, 0]] * (1 - u - v) + normals[corners[:, 1]] * u + normals[corners[:, 2]] * v
        cosine = np.maximum(ns @ wi, 0) / np.linalg.norm(ns, axis=1)
        p = o[met] + (hits["tfar"][met, None] - 1e-5) * d[met]
        lit = (scene.run(p, sun[: len(met)], query="OCCLUDED") < 0) & (hits["Ng"][met] @ wi > 0)
        image = np.zeros(len(d), np.float32)
        image[met] = 0.7 * cosine * lit
        return image.reshape(pixels, pixels)

    build()
    return frame, build


def povray_seconds(heights: np.ndarray, view: View, towards: Sequence[float], pixels: int, folder: Path) -> float:
    """Seconds of CPU that POV-Ray (povray on the path) says its tracing took, over its threads.

    Its own heightfield with its smooth normals, of heights in 16 bits; reading the scene is not counted, nor what its
    threads wait for.
    """
    tall = float(heights.max())
    levels = np.round(heights[::-1] / tall * 65535).astype(">u2")
    (folder / "heights.pgm").write_bytes(f"P5\n{len(heights)} {len(heights)}\n65535\n".encode() + levels.tobytes())
    eye, target, fov = view
    vector = "<{:.9g}, {:.9g}, {:.9g}>".format
    (folder / "scene.pov").write_text(
        f"""#version 3.7; global_settings {{ assumed_gamma 1 }}
camera {{ perspective location {vector(*_swapped(eye))} right x up y angle {fov} sky y look_at {vector(*_swapped(target))} }}
light_source {{ {vector(*(1e4 * np.asarray(_swapped(towards))))} rgb 1 parallel point_at 0 }}
height_field {{ pgm "heights.pgm" smooth pigment {{ rgb 0.7 }} finish {{ diffuse 1 ambient 0 }} scale {vector(1, tall, 1)} }}
"""
    )
    command = ["povray", "scene.pov", f"+W{pixels}", f"+H{pixels}", "-D", "-A", "+FN", "+Oout.png"]
    said = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True).stderr
    threads, seconds = re.findall(r"using (\d+) thread\(s\) with ([\d.]+) CPU-seconds", said)[-1]
    return float(seconds) / int(threads)


def _swapped(v: Sequence[float]) -> tuple[float, float, float]:
    return v[0], v[2], v[1]
