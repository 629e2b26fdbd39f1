"""Terrains of ours in Mitsuba 3 (pip install mitsuba), ray by ray and as pictures, by its variant that needs no LLVM."""

import importlib
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from peers import View, camera_rays, mesh_of

import jaxhf

Arrays = dict[str, Any]
Light = jaxhf.Directional | jaxhf.Point
ALBEDO, REFLECTANCE, BOUNCES, SAMPLES = 0.7, 0.9, 4, 1024


def mitsuba() -> Any:
    """The module, with that variant."""
    mi = importlib.import_module("mitsuba")
    mi.set_variant("scalar_rgb")
    mi.set_log_level(mi.LogLevel.Error)
    return mi


def mesh(mi: Any, heights: np.ndarray, spacing: Sequence[float], albedo: Any = ALBEDO, world: np.ndarray | None = None) -> Any:
    """Heights as Mitsuba's mesh with two sides, (u, v) over the footprint, and its own normals: weighted by angle."""
    world = np.eye(4) if world is None else world
    ny, nx = heights.shape
    vertices, faces = mesh_of(heights, (spacing[0] * (nx - 1), spacing[1] * (ny - 1)))
    made = mi.Mesh("terrain", len(vertices), len(faces), has_vertex_normals=True, has_vertex_texcoords=True)
    parameters = mi.traverse(made)
    parameters["faces"] = faces.astype(np.uint32).ravel()
    parameters["vertex_positions"] = (vertices @ world[:3, :3].T + world[:3, 3]).astype(np.float32).ravel()
    parameters["vertex_texcoords"] = mesh_of(heights)[0][:, :2].ravel()
    parameters.update()
    made.set_bsdf(mi.load_dict(matte(albedo)))
    return made


def texture(mi: Any, texels: np.ndarray) -> Arrays:
    """Linear colours (h, w, 3), looked up bilinearly."""
    return {"type": "bitmap", "bitmap": mi.Bitmap(texels), "raw": True, "filter_type": "bilinear"}


def matte(albedo: Any) -> Arrays:
    """With two sides; the albedo is a number or a texture."""
    return {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": albedo}}


def scattering(mi: Any, law: Callable[[float, float, float], float]) -> Any:
    """A BSDF of ours for Mitsuba, on both sides: of the angles of incidence and emission and of the phase angle."""

    class Scattering(mi.BSDF):
        def __init__(self, props: Any):
            mi.BSDF.__init__(self, props)
            self.m_flags = mi.BSDFFlags.DiffuseReflection | mi.BSDFFlags.FrontSide | mi.BSDFFlags.BackSide
            self.m_components = [self.m_flags]

        def eval(self, _ctx: Any, si: Any, wo: Any, _active: bool = True) -> Any:
            eye, light = np.array(si.wi), np.array(wo)
            if eye[2] * light[2] <= 0:
                return mi.Color3f(0)
            i, e, g = np.arccos(np.clip([abs(light[2]), abs(eye[2]), eye @ light], -1, 1)).tolist()
            return mi.Color3f(float(law(i, e, g) * abs(light[2])))

        def sample(self, _ctx: Any, _si: Any, _one: float, _two: Any, _active: bool = True) -> Any:
            return mi.BSDFSample3f(), mi.Color3f(0)  # lights alone are sampled

        def pdf(self, _ctx: Any, _si: Any, _wo: Any, _active: bool = True) -> float:
            return 0.0

        def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: bool = True) -> Any:
            return self.eval(ctx, si, wo, active), 0.0

    mi.register_bsdf("scattering", Scattering)
    return mi.load_dict({"type": "scattering"})


def emitter(light: Light) -> Arrays:
    if isinstance(light, jaxhf.Directional):
        return {"type": "directional", "direction": (-np.asarray(light.towards)).tolist(), "irradiance": np.pi}
    return {"type": "point", "position": np.asarray(light.p).tolist(), "intensity": float(light.intensity[0])}


def traced(mi: Any, shapes: Arrays, light: Light, view: View, pixels: int) -> Arrays:
    """One ray through each pixel's centre, by Mitsuba's intersections, shadow rays and direct light.

    Returns:
      Of the first hit: t (inf: none), n, ns (times 32767), its shape's number in `shapes` from 1 on. Of the last one, after
      mirrors (the shape `sea`, about its shading normals): whether the light reaches the side that is seen, and the radiance
      that the eye gets, red.
    """
    for name, shape in shapes.items():
        if not isinstance(shape, dict):
            shape.set_id(name)
    scene = mi.load_dict({"type": "scene", "integrator": {"type": "direct"}, "light": emitter(light), **shapes})
    sampler, d, numbers = mi.load_dict({"type": "independent"}), camera_rays(view, pixels), [None, *shapes]
    found: Arrays = {"t": np.full(len(d), np.inf, np.float32), "kind": np.zeros(len(d), np.int8)}
    found |= {"n": np.zeros((len(d), 3)), "ns": np.zeros((len(d), 3))}
    found |= {"visible": np.zeros(len(d), bool), "radiance": np.zeros(len(d), np.float32)}
    for k, direction in enumerate(d):
        ray, share = mi.Ray3f(list(view[0]), direction.tolist()), 1.0
        for bounce in range(BOUNCES + 1):
            hit = scene.ray_intersect(ray)
            if not hit.is_valid():
                break
            n, ns, along = np.array(hit.n), np.array(hit.sh_frame.n), np.array(ray.d)
            if bounce == 0:
                found["t"][k], found["kind"][k], found["n"][k], found["ns"][k] = hit.t, numbers.index(hit.shape.id()), n, ns
            if hit.shape.id() == "sea":
                ray, share = hit.spawn_ray(along - 2 * (along @ ns) * ns), share * REFLECTANCE
                continue
            if isinstance(light, jaxhf.Point):
                shadow = hit.spawn_ray_to(np.asarray(light.p).tolist())
            else:
                shadow = hit.spawn_ray(np.asarray(light.towards).tolist())
            found["visible"][k] = (n @ np.array(shadow.d)) * (n @ along) < 0 and not scene.ray_test(shadow)
            found["radiance"][k] = share * scene.integrator().sample(scene, sampler, mi.RayDifferential3f(ray))[0][0]
            break
    whole = {name: np.round(32767 * found.pop(name)).astype(np.int16) for name in ("n", "ns")}
    return {name: values.reshape(pixels, pixels, *values.shape[1:]) for name, values in (found | whole).items()}


def picture(mi: Any, terrain: Any, light: Light, view: View, pixels: int) -> np.ndarray:
    """Grey, (pixels, pixels), of SAMPLES a pixel."""
    eye, target, fov = view
    far = float(np.linalg.norm(np.subtract(target, eye)))
    sensor = {
        "type": "perspective",
        "fov": fov,
        "near_clip": 0.01 * far,
        "far_clip": 100 * far,
        "to_world": mi.ScalarTransform4f().look_at(origin=list(eye), target=list(target), up=[0, 0, 1]),
        "film": {"type": "hdrfilm", "width": pixels, "height": pixels, "rfilter": {"type": "box"}},
        "sampler": {"type": "stratified", "sample_count": SAMPLES},
    }
    scene = {"type": "scene", "integrator": {"type": "direct"}, "land": terrain, "light": emitter(light), "sensor": sensor}
    return np.array(mi.render(mi.load_dict(scene)))[..., 0]
