"""The cases that were not looked at while the default call of `jaxhf.fit` was built."""

import importlib
from collections.abc import Sequence
from typing import Any

import numpy as np
from cases import SAMPLES, Case, Definition, Sources, noisy, smoothed, viewed
from peers import mesh_of

import jaxhf
from jaxhf.io.procedural import bumps, fractal


def by_mitsuba(scene: jaxhf.Scene, eye: Sequence[float], at: Sequence[float], texels: np.ndarray | None = None) -> np.ndarray:
    """A picture (h, w, 3) by Mitsuba of a scene of one heightfield, at the origin, under one directional light.

    Args:
      eye, at: of its camera.
      texels: of its texture, row 0 in the south; None: the albedo is the material's number.
    """
    mi: Any = importlib.import_module("mitsuba")
    mi.set_variant("llvm_ad_rgb")
    ground, camera, (light,) = scene.objects[0], scene.camera, scene.lights
    assert isinstance(ground.shape, jaxhf.Heightfield)
    assert isinstance(ground.material, jaxhf.Matte)
    assert isinstance(light, jaxhf.Directional)
    heights = np.asarray(ground.shape.heights)
    ny, nx = heights.shape
    vertices, faces = mesh_of(heights, ((nx - 1) * ground.shape.dx, (ny - 1) * ground.shape.dy))
    mesh = mi.Mesh("terrain", len(vertices), len(faces), has_vertex_normals=True, has_vertex_texcoords=True)
    parameters = mi.traverse(mesh)
    parameters["faces"], parameters["vertex_positions"] = faces.astype(np.uint32).ravel(), vertices.ravel()
    uv = np.stack(np.meshgrid(np.linspace(0, 1, nx), np.linspace(0, 1, ny)), -1)
    parameters["vertex_texcoords"] = uv.astype(np.float32).ravel()
    parameters.update()
    reflectance: Any = float(np.asarray(ground.material.albedo)[0]) if texels is None else None
    if texels is not None:
        bitmap = mi.Bitmap(np.ascontiguousarray(texels, np.float32))
        reflectance = {"type": "bitmap", "bitmap": bitmap, "raw": True, "filter_type": "bilinear", "wrap_mode": "repeat"}
    mesh.set_bsdf(mi.load_dict({"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": reflectance}}))
    transform, distance = mi.ScalarTransform4f(), float(np.linalg.norm(np.subtract(at, eye)))
    pose = transform.look_at(origin=list(eye), target=list(at), up=[0, 0, 1])
    sensor: dict[str, Any] = {
        "near_clip": 0.01 * distance,
        "far_clip": 100 * distance,
        "film": {"type": "hdrfilm", "width": camera.width, "height": camera.height, "rfilter": {"type": "box"}},
        "sampler": {"type": "independent", "sample_count": SAMPLES},
    }
    if isinstance(camera, jaxhf.Orthographic):
        half = float(camera.extent) / 2 * camera.width / min(camera.width, camera.height)
        sensor |= {"type": "orthographic", "to_world": pose @ transform.scale([half, half, 1])}
    else:
        sensor |= {"type": "perspective", "fov": float(camera.fov), "fov_axis": "smaller", "to_world": pose}
    towards = [-float(v) for v in np.asarray(light.towards)]
    made = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "direct"},
            "terrain": mesh,
            "light": {"type": "directional", "direction": towards, "irradiance": np.pi},
            "sensor": sensor,
        }
    )
    return np.array(mi.render(made))[..., :3]


def from_all(
    sources: Sources,
    name: str,
    scenes: Sequence[jaxhf.Scene],
    eyes: Sequence[np.ndarray],
    at: np.ndarray,
    texels: np.ndarray | None = None,
) -> np.ndarray:
    """`by_mitsuba` of each scene: (pictures, h, w), or with a texture (pictures, h, w, 3)."""

    def make() -> np.ndarray:
        views = zip(scenes, eyes, strict=True)
        pictures = np.stack([by_mitsuba(scene, eye.tolist(), at.tolist(), texels) for scene, eye in views])
        return pictures[..., 0] if texels is None else pictures

    return sources.pictures(name, make)


def suns(*angles: tuple[float, float]) -> list[jaxhf.Directional]:
    """Lights by azimuth and altitude, degrees."""
    return [jaxhf.Directional.from_angles(azimuth=azimuth, altitude=altitude) for azimuth, altitude in angles]


def evening(sources: Sources) -> Case:
    """One picture of a valley under a sun 18 degrees high, with long shadows, and a map; off-nadir, the noise is given."""
    terrain = jaxhf.jacksboro()
    whole = terrain.heights.astype(np.float64)
    coarse = smoothed(whole, 6)
    part = np.s_[230:310, 60:156]
    truth, prior = whole[part], coarse[part]
    extent = np.array([95 * terrain.dx, 79 * terrain.dy])
    at = np.array([*extent / 2, prior.mean()])
    eye = at + np.array([-5000.0, -9000.0, 19000.0])
    camera = jaxhf.Perspective.look_at(eye, at, fov=29.0, width=224, height=224)

    def scenes(heights: np.ndarray) -> list[jaxhf.Scene]:
        ground = jaxhf.Object(jaxhf.Heightfield(heights.astype(np.float32), terrain.dx, terrain.dy), jaxhf.Matte(0.5))
        return viewed(ground, [camera], suns((250, 18)))

    targets, noise = noisy(from_all(sources, "evening", scenes(truth), [eye], at))
    spread = float(f"{np.sqrt(np.mean((coarse - whole) ** 2)):.1e}")
    given = {"prior": prior, "prior_std": spread, "noise": noise}
    return Case(truth, scenes(prior), list(targets), given, prior)


def photographs(sources: Sources) -> Case:
    """Grey photographs, saved as RGB, of a rough patch of soil from far away, as good as orthographic; double precision.

    The patch is 1.2 m wide; that it is level, and by how much it is not, is known.
    """
    spread = 0.02
    truth = fractal([40, 48], seed=11, exponent=1.6, range=(-0.06, 0.06))
    truth *= spread / truth.std()
    spacing = 1.2 / 47
    at = np.array([0.6, 39 / 2 * spacing, 0.0])
    eyes = [at + offset for offset in ((0.3, -1.0, 2.0), (-0.9, 0.5, 2.0), (0.9, 0.6, 2.0), (0.1, 0.2, 2.0))]
    cameras = [jaxhf.Orthographic.look_at(eye, at, extent=1.6, width=160, height=160) for eye in eyes]
    lights = suns((100, 40), (190, 40), (280, 40), (10, 40))

    def scenes(heights: np.ndarray) -> list[jaxhf.Scene]:
        ground = jaxhf.Object(jaxhf.Heightfield(heights, spacing), jaxhf.Matte(0.35))
        return viewed(ground, cameras, lights)

    grey, noise = noisy(from_all(sources, "photographs", scenes(truth), eyes, at), 0.02)
    targets = [np.repeat(picture[..., None], 3, axis=-1) for picture in grey]
    start = np.zeros_like(truth)
    given = {"prior": start, "prior_std": spread, "noise": noise}
    return Case(truth, scenes(start), targets, given, start)


def orthophoto(sources: Sources) -> Case:
    """Two colour pictures, wider than high, of hills under a known texture; a rough map, the noise is not given."""
    truth = bumps([72, 72], seed=5, count=30, radius=0.09, range=(0.0, 60.0)) + fractal([72, 72], 6, 2.4, (-9.0, 9.0))
    grain = np.stack([fractal([128, 128], seed, 1.2, (0.0, 1.0)) for seed in (21, 22, 23)], -1)
    texels = np.array([0.45, 0.4, 0.25]) + np.array([0.25, 0.3, 0.2]) * (0.7 * grain[..., :1] + 0.3 * grain - 0.5)
    spacing, error = 5.0, 10 * fractal([72, 72], 31, 2.8, (-1.0, 1.0))
    prior = truth + error - error.mean()
    at = np.array([71 / 2 * spacing, 71 / 2 * spacing, float(prior.mean())])
    eyes = [at + offset for offset in ((350.0, -500.0, 800.0), (-450.0, 350.0, 800.0))]
    cameras = [jaxhf.Perspective.look_at(eye, at, fov=31.0, width=240, height=160) for eye in eyes]
    lights = suns((120, 38), (230, 30))
    material = jaxhf.Matte(jaxhf.ImageTexture(texels.astype(np.float32)))

    def scenes(heights: np.ndarray) -> list[jaxhf.Scene]:
        ground = jaxhf.Object(jaxhf.Heightfield(heights.astype(np.float32), spacing), material)
        return viewed(ground, cameras, lights)

    targets, _ = noisy(from_all(sources, "orthophoto", scenes(truth), eyes, at, texels))
    given = {"prior": prior, "prior_std": float(f"{error.std():.1e}")}
    return Case(truth, scenes(prior), list(targets), given, prior)


def aslant(sources: Sources) -> Case:
    """A small mountain from four sides, 35 degrees above the horizon, with outlines against the background; no map."""
    x, y = np.meshgrid(np.linspace(-1, 1, 56), np.linspace(-1, 1, 56))
    truth = 0.16 * np.exp(-2.5 * (x**2 + y**2)) * (1 + 0.4 * (x**3 - 3 * x * y**2) / (0.1 + x**2 + y**2))
    truth += fractal([56, 56], 8, 2.2, (-0.04, 0.04))
    at = np.array([0.5, 0.5, 0.06])
    turns = np.radians((20, 115, 200, 290))
    eyes = [at + 2.0 * np.array([np.sin(t) * 0.82, np.cos(t) * 0.82, 0.57]) for t in turns]
    cameras = [jaxhf.Perspective.look_at(eye, at, fov=42.0, width=160, height=160) for eye in eyes]
    lights = suns((60, 48), (60, 48), (150, 48), (330, 48))

    def scenes(heights: np.ndarray) -> list[jaxhf.Scene]:
        ground = jaxhf.Object(jaxhf.Heightfield(heights.astype(np.float32)), jaxhf.Matte(0.6))
        return viewed(ground, cameras, lights)

    targets, noise = noisy(from_all(sources, "aslant", scenes(truth), eyes, at), 0.005)
    start = np.full(truth.shape, 0.05)
    return Case(truth, scenes(start), list(targets), {"noise": noise}, start)


HELD_OUT = {
    "evening": Definition("float32", evening),
    "photographs": Definition("float64", photographs),
    "orthophoto": Definition("float32", orthophoto),
    "aslant": Definition("float32", aslant),
}
