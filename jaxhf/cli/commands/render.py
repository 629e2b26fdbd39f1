"""`jaxhf render`: a scene to a picture."""

import argparse
import time
from pathlib import Path

import jax
import numpy as np

from ...core.errors import UserError
from ...io.pictures.images import require_writable, save_image
from ...io.scenes.load import load_scene
from ...preparation.world import resolve_settings
from ...rendering.aovs import known_aovs
from ...rendering.render import render
from ...scene.scene import resized
from ...xla.devices import local_mesh, worthwhile_mesh
from .. import arguments, limits
from ..progress import CompileTime, compiled_bar
from ..scene_warnings import warn


def run(options: argparse.Namespace) -> None:
    if options.aovs and Path(options.output).suffix.lower() != ".exr":
        raise UserError(f"--aovs are layers of an .exr, {options.output} is none")
    if getattr(options, "shading", None) == "flat" and hasattr(options, "normals"):
        raise UserError("--normals would change nothing: --shading flat takes those of the triangles")
    require_writable(options.output)
    settings = arguments.settings(options)
    limits.set_up_jax(options)
    aovs = known_aovs("render", options.aovs)
    scene = resized(load_scene(options.scene, np.dtype(options.precision)), options.width, options.height)
    warn([scene])
    samples = resolve_settings(settings, scene).samples or 1
    rays = scene.camera.width * scene.camera.height * samples
    mesh = worthwhile_mesh(rays) if options.devices is None else local_mesh()
    limits.require_memory(scene, mesh.size)
    compiling, begin = CompileTime(), time.perf_counter()
    with compiled_bar(unit=" pixels", unit_scale=True) as advance:
        image, found = render(scene, settings, aovs=tuple(dict.fromkeys(("exhausted", *aovs))), progress=advance, mesh=mesh)
    seconds = max(time.perf_counter() - begin - compiling.seconds, 1e-9)
    save_image(options.output, image, aovs={name: found[name] for name in aovs})
    print(
        f"{options.output}: {scene.camera.width} x {scene.camera.height} pixels, {rays} camera rays ({samples} a pixel), "
        f"{seconds:.3g} s + {compiling.seconds:.3g} s compiling, {mesh.size} x {jax.devices()[0].device_kind}, "
        f"{rays / seconds:.3g} rays/s, {int(np.sum(found['exhausted']))} rays exhausted"
    )
