"""`jaxhf render`: a scene to a picture."""

import argparse
import time
from pathlib import Path
from typing import TYPE_CHECKING

from ...core.errors import UserError
from ...core.settings import Settings
from .. import arguments
from ..arguments import option, output, whole
from ..command import Command

if TYPE_CHECKING:
    from ...scene.scene import Scene


def run(options: argparse.Namespace) -> None:
    from ...io.pictures.images import require_writable, save_image
    from ..scene_warnings import warn

    if options.aovs and Path(options.output).suffix.lower() != ".exr":
        raise UserError(f"--aovs are layers of an .exr, {options.output} is none")
    if getattr(options, "shading", None) == "flat" and hasattr(options, "normals"):
        raise UserError("--normals would change nothing: --shading flat takes those of the triangles")
    require_writable(options.output)
    settings = arguments.settings(options)
    arguments.set_up_jax(options)
    import jax
    import numpy as np

    from ...preparation.world import resolve_settings
    from ...rendering.aovs import known_aovs
    from ...rendering.render import render
    from ...xla.devices import local_mesh, worthwhile_mesh
    from ..limits import require_memory
    from ..progress import CompileTime, compiled_bar

    aovs = known_aovs("render", options.aovs)
    scene = _load(options)
    warn([scene])
    samples = resolve_settings(settings, scene).samples or 1
    rays = scene.camera.width * scene.camera.height * samples
    mesh = worthwhile_mesh(rays) if options.devices is None else local_mesh()
    require_memory(scene, mesh.size)
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


def _load(options: argparse.Namespace) -> "Scene":
    """The scene in the precision and in the size of the options; one of width and height keeps the proportions."""
    import numpy as np

    from ...io.scenes.load import load_scene
    from ...scene.views import resized

    scene = load_scene(options.scene, np.dtype(options.precision))
    old, width, height = scene.camera, options.width, options.height
    if width is None and height is None:
        return scene
    width = width or max(1, round(height * old.width / old.height))
    return resized(scene, width, height or max(1, round(width * old.height / old.width)))


def _names(text: str) -> tuple[str, ...]:
    return tuple(name.strip() for name in text.split(","))


_AOVS = (
    "what rays met besides, as layers of an .exr: some of depth, normal, uv, object, cell, shadow, status, steps and "
    "exhausted, with commas between [none]"
)
COMMAND = Command(
    "render",
    "render a scene to a picture",
    examples=("scene.toml -o picture.png --width 960", "scene.toml -o picture.exr --samples 16 --aovs depth,normal"),
    options={
        "": (
            option("scene", metavar="SCENE", help="a .toml or .pbrt scene"),
            output("the picture: .png, .jpg (sRGB), .exr, .npy or .pfm (linear)"),
            option("--aovs", type=_names, default=(), metavar="NAMES", help=_AOVS),
        ),
        "size": (
            whole("--width", "PIXELS", "of the picture; with one of the two, the other keeps the proportions", least=1),
            whole("--height", "PIXELS", "of the picture", least=1),
        ),
        # Nothing is differentiated.
        "accuracy and speed": arguments.settings_options(Settings.__dataclass_fields__.keys() - {"edge_samples"}),
        **arguments.MACHINE,
    },
    run=run,
    placed=False,
)
