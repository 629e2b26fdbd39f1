"""The parts of a .pbrt scene: which parameters each kind of them takes, and what is made of these."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from ...core.affine import rotate, scale, translate
from ...core.errors import UserError
from ...core.precision import fitted
from ...scene.cylinder import Cylinder
from ...scene.heightfield import Heightfield
from ...scene.light import Directional, Light, Point
from .tokens import Arguments, Parameter, Parameters

Matrix = Float[np.ndarray, "4 4"]

# pbrt-v2's defaults. Depth 5 counts the camera ray: at most four mirrors.
_DEPTH: Parameters = {"integer maxdepth": Parameter(5)}
KINDS: Mapping[str, Mapping[str, Parameters]] = {
    "Film": {
        "image": {
            "string filename": Parameter("pbrt.exr"),
            "integer xresolution": Parameter(640),
            "integer yresolution": Parameter(480),
        }
    },
    "Sampler": {
        "bestcandidate": {"integer pixelsamples": Parameter(4)},
        "stratified": {
            "integer xsamples": Parameter(2),
            "integer ysamples": Parameter(2),
            "bool jitter": Parameter(True),
        },
    },
    "PixelFilter": {"box": {"float xwidth": Parameter(0.5), "float ywidth": Parameter(0.5)}},
    "SurfaceIntegrator": {"directlighting": _DEPTH, "whitted": _DEPTH},
    "Camera": {"perspective": {"float fov": Parameter(90.0)}},
    "LightSource": {
        "point": {
            "color I": Parameter(np.ones(3)),
            "color scale": Parameter(np.ones(3)),
            "point from": Parameter(np.zeros(3)),
        },
        "distant": {
            "color L": Parameter(np.ones(3)),
            "color scale": Parameter(np.ones(3)),
            "point from": Parameter(np.zeros(3)),
            "point to": Parameter(np.array([0.0, 0.0, 1.0])),
        },
    },
    "Texture": {"imagemap": {"string filename": Parameter(required=True)}},
    "Material": {
        "matte": {"color Kd": Parameter(0.5), "texture Kd": Parameter(), "float sigma": Parameter(0.0)},
        "mirror": {"color Kr": Parameter(0.9)},
    },
    "Shape": {
        "heightfield": {
            "integer nu": Parameter(required=True),
            "integer nv": Parameter(required=True),
            "float Pz": Parameter(required=True, many=True),
        },
        "cylinder": {
            "float radius": Parameter(1.0),
            "float zmin": Parameter(-1.0),
            "float zmax": Parameter(1.0),
            "float phimax": Parameter(360.0),
        },
    },
}
DEFAULT_SAMPLES = 4  # of the "lowdiscrepancy" sampler that pbrt-v2 takes where a scene names none


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


def _bestcandidate(args: Arguments) -> int:
    args.require("integer pixelsamples", args["integer pixelsamples"] >= 1, "be at least 1")
    return args["integer pixelsamples"]


def _stratified(args: Arguments) -> int:
    if args["bool jitter"]:
        raise args.error("bool jitter", 'jitter must be "false": jittered samples, the default, are not supported')
    side = args["integer xsamples"]
    args.require("integer xsamples", side >= 1, "be at least 1")
    args.require("integer ysamples", args["integer ysamples"] == side, f"equal xsamples, {side}")
    return side * side


def _point_light(args: Arguments, world_from_object: Matrix) -> Point:
    # pbrt-v2 moves the light by "from" after the current transformation, so "from" counts in world units.
    return Point(world_from_object[:3, 3] + args["point from"], args.colour("color I") * args.colour("color scale"))


def _distant_light(args: Arguments, world_from_object: Matrix) -> Directional:
    towards = world_from_object[:3, :3] @ (args["point from"] - args["point to"])
    return Directional(towards, args.colour("color L") * args.colour("color scale"))


def _heightfield(args: Arguments, dtype: np.dtype) -> Heightfield:
    nu, nv, z = args["integer nu"], args["integer nv"], args["float Pz"]
    for side in ("integer nu", "integer nv"):
        args.require(side, args[side] >= 2, "be at least 2")
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


def _cylinder(args: Arguments, dtype: np.dtype) -> Cylinder:
    args.require("float phimax", args["float phimax"] == 360, "be 360 (parts of a circle are not supported)")
    return Cylinder(args["float radius"], args["float zmin"], args["float zmax"])


TRANSFORMS: Mapping[str, tuple[int, Callable[..., Any]]] = {
    "LookAt": (9, _look_at),
    "Rotate": (4, rotate),
    "Scale": (3, scale),
    "Translate": (3, translate),
}
SAMPLERS: Mapping[str, Callable[[Arguments], int]] = {"bestcandidate": _bestcandidate, "stratified": _stratified}
LIGHTS: Mapping[str, Callable[[Arguments, Matrix], Light]] = {"point": _point_light, "distant": _distant_light}
SHAPES: Mapping[str, Callable[[Arguments, np.dtype], Heightfield | Cylinder]] = {
    "heightfield": _heightfield,
    "cylinder": _cylinder,
}
