"""The parts of a .pbrt scene: which parameters each kind of them takes; transformations and heightfields."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from ....core.affine import rotate, scale, translate
from ....core.errors import UserError
from ....core.precision import fitted
from ....scene.heightfield import Heightfield
from .statements import Arguments, Kinds, Rule

Matrix = Float[np.ndarray, "4 4"]

_ORIGIN, _WHITE = np.zeros(3), np.ones(3)
# Every kind and parameter that is understood, with pbrt-v2's defaults. Depth 5 counts the camera ray: at most four mirrors.
KINDS: Mapping[str, Kinds] = {
    "Film": {"image": {"string filename": "pbrt.exr", "integer xresolution": 640, "integer yresolution": 480}},
    "Sampler": {
        "bestcandidate": {"integer pixelsamples": 4},
        "stratified": {"integer xsamples": 2, "integer ysamples": 2, "bool jitter": True},
    },
    "PixelFilter": {"box": {"float xwidth": 0.5, "float ywidth": 0.5}},
    "SurfaceIntegrator": {"directlighting": {"integer maxdepth": 5}, "whitted": {"integer maxdepth": 5}},
    "Camera": {"perspective": {"float fov": 90.0}},
    "LightSource": {
        "point": {"color I": _WHITE, "color scale": _WHITE, "point from": _ORIGIN},
        "distant": {"color L": _WHITE, "color scale": _WHITE, "point from": _ORIGIN, "point to": np.array([0.0, 0, 1])},
    },
    "Texture": {"imagemap": {"string filename": ...}},
    "Material": {
        "matte": {"color Kd": 0.5 * _WHITE, "texture Kd": None, "float sigma": 0.0},
        "mirror": {"color Kr": 0.9 * _WHITE},
    },
    "Shape": {
        "heightfield": {"integer nu": ..., "integer nv": ..., "float Pz": ...},
        "cylinder": {"float radius": 1.0, "float zmin": -1.0, "float zmax": 1.0, "float phimax": 360.0},
    },
}
_LEAST_ONE: Rule = (lambda count: count >= 1, "be at least 1")
RULES: Mapping[str, Rule] = {
    **dict.fromkeys(("integer xresolution", "integer yresolution", "integer pixelsamples", "integer xsamples"), _LEAST_ONE),
    **dict.fromkeys(("integer nu", "integer nv"), (lambda count: count >= 2, "be at least 2")),
    **dict.fromkeys(("float xwidth", "float ywidth"), (lambda width: width == 0.5, "be 0.5")),
    **dict.fromkeys(("color I", "color L", "color scale", "color Kd", "color Kr"), (lambda c: min(c) >= 0, "be 0 or more")),
    "integer maxdepth": (lambda depth: depth == 5, "be 5"),
    "float fov": (lambda fov: 0 < fov < 180, "lie between 0 and 180 degrees"),
    "float sigma": (lambda sigma: sigma == 0, "be 0 (rough surfaces are not supported)"),
    "float phimax": (lambda phi: phi == 360, "be 360 (parts of a circle are not supported)"),
}


def _look_at(*numbers: float) -> Matrix:
    """camera_from_world of pbrt-v2: x right, y up, z forward, left-handed in a right-handed world."""
    eye, target, up = np.reshape(numbers, (3, 3))
    if not np.any(target - eye):
        raise UserError(f"LookAt: the target must differ from the eye, both are {eye.tolist()}")
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(up, forward)
    length = np.linalg.norm(right)
    if not length > 1e-9 * np.linalg.norm(up):
        raise UserError(f"LookAt: up must not point along the view, it is {up.tolist()} for the view {forward.tolist()}")
    right = right / length
    world_from_camera = np.eye(4)
    world_from_camera[:3] = np.stack([right, np.cross(forward, right), forward, eye], axis=1)
    return np.linalg.inv(world_from_camera)


TRANSFORMS: Mapping[str, tuple[int, Callable[..., Any]]] = {
    "LookAt": (9, _look_at),
    "Rotate": (4, rotate),
    "Scale": (3, scale),
    "Translate": (3, translate),
}


def heightfield(args: Arguments, dtype: np.dtype) -> Heightfield:
    """The surface of a `Shape "heightfield"`."""
    nu, nv, z = args["integer nu"], args["integer nv"], args["float Pz"]
    if z.size != nu * nv:
        raise args.error("float Pz", f"Pz must hold nu * nv = {nu} * {nv} = {nu * nv} heights, it holds {z.size}")
    with np.errstate(over="ignore"):
        heights = z.astype(dtype)
    bad = np.flatnonzero(~np.isfinite(heights))
    if bad.size:
        k = int(bad[0])
        message = f"Pz[{k}] (column {k % nu}, row {k // nu}) must be finite in {dtype}, it is {z[k]}"
        raise args.error("float Pz", message, k)
    return Heightfield(fitted(z, dtype).reshape(nv, nu))
