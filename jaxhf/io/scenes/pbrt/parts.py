"""The parts of a .pbrt scene: which parameters each kind of them takes, and what is made of these."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from ....core.affine import rotate, scale, translate
from ....core.errors import UserError
from ....core.precision import fitted
from ....scene.cylinder import Cylinder
from ....scene.heightfield import Heightfield
from ....scene.light import Directional, Light, Point
from .statements import Arguments, Rule, kinds

Matrix = Float[np.ndarray, "4 4"]

# Every kind and parameter that is understood, with pbrt-v2's defaults. [] must be given, [...] with any number of values.
# Depth 5 counts the camera ray: at most four mirrors.
_DEFAULTS = """
Film "image" "string filename" "pbrt.exr" "integer xresolution" 640 "integer yresolution" 480
Sampler "bestcandidate" "integer pixelsamples" 4
Sampler "stratified" "integer xsamples" 2 "integer ysamples" 2 "bool jitter" "true"
PixelFilter "box" "float xwidth" 0.5 "float ywidth" 0.5
SurfaceIntegrator "directlighting" "integer maxdepth" 5
SurfaceIntegrator "whitted" "integer maxdepth" 5
Camera "perspective" "float fov" 90
LightSource "point" "color I" [1 1 1] "color scale" [1 1 1] "point from" [0 0 0]
LightSource "distant" "color L" [1 1 1] "color scale" [1 1 1] "point from" [0 0 0] "point to" [0 0 1]
Texture "imagemap" "string filename" []
Material "matte" "color Kd" [0.5 0.5 0.5] "texture Kd" "" "float sigma" 0
Material "mirror" "color Kr" [0.9 0.9 0.9]
Shape "heightfield" "integer nu" [] "integer nv" [] "float Pz" [...]
Shape "cylinder" "float radius" 1 "float zmin" -1 "float zmax" 1 "float phimax" 360
"""
KINDS = kinds(_DEFAULTS)
_LEAST_ONE: Rule = (lambda count: count >= 1, "be at least 1")
_LEAST_TWO: Rule = (lambda count: count >= 2, "be at least 2")
RULES: Mapping[str, Rule] = {
    **dict.fromkeys(("integer xresolution", "integer yresolution"), _LEAST_ONE),
    **dict.fromkeys(("integer pixelsamples", "integer xsamples"), _LEAST_ONE),
    **dict.fromkeys(("integer nu", "integer nv"), _LEAST_TWO),
    **dict.fromkeys(("float xwidth", "float ywidth"), (lambda width: width == 0.5, "be 0.5")),
    "integer maxdepth": (lambda depth: depth == 5, "be 5"),
    "float fov": (lambda fov: 0 < fov < 180, "lie between 0 and 180 degrees"),
    "float sigma": (lambda sigma: sigma == 0, "be 0 (rough surfaces are not supported)"),
    "float phimax": (lambda phi: phi == 360, "be 360 (parts of a circle are not supported)"),
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


def _stratified(args: Arguments) -> int:
    if args["bool jitter"]:
        raise args.error("bool jitter", 'jitter must be "false": jittered samples, the default, are not supported')
    side = args["integer xsamples"]
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


TRANSFORMS: Mapping[str, tuple[int, Callable[..., Any]]] = {
    "LookAt": (9, _look_at),
    "Rotate": (4, rotate),
    "Scale": (3, scale),
    "Translate": (3, translate),
}
SAMPLERS: Mapping[str, Callable[[Arguments], int]] = {
    "bestcandidate": lambda args: args["integer pixelsamples"],
    "stratified": _stratified,
}
LIGHTS: Mapping[str, Callable[[Arguments, Matrix], Light]] = {"point": _point_light, "distant": _distant_light}
SHAPES: Mapping[str, Callable[[Arguments, np.dtype], Heightfield | Cylinder]] = {
    "heightfield": _heightfield,
    "cylinder": lambda args, _: Cylinder(args["float radius"], args["float zmin"], args["float zmax"]),
}
