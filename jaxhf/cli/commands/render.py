"""`jaxhf render`: a scene to a picture."""

import argparse
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...core.errors import UserError
from ...core.settings import Settings
from .. import arguments

if TYPE_CHECKING:
    from ...scene.scene import Scene


def add(commands: Any) -> None:
    examples = arguments.examples(
        "jaxhf render scene.toml -o picture.png --width 960",
        "jaxhf render scene.toml -o picture.exr --samples 16 --aovs depth,normal",
    )
    about = "Render a scene to a picture."
    command = commands.add_parser("render", help="render a scene to a picture", description=about, epilog=examples)
    command.add_argument("scene", metavar="SCENE", help="a .toml or .pbrt scene")
    command.add_argument(
        "-o", "--output", required=True, metavar="OUT", help="the picture: .png, .jpg (sRGB), .exr, .npy or .pfm (linear)"
    )
    command.add_argument(
        "--aovs", type=lambda names: tuple(name.strip() for name in names.split(",")), default=(), metavar="NAMES",
        help="what rays met besides, as layers of an .exr: some of depth, normal, uv, object, cell, shadow, status, steps and "
        "exhausted, with commas between [none]",
    )  # fmt: skip
    arguments.add_size(command)
    arguments.add_settings(command, Settings.__dataclass_fields__.keys() - {"edge_samples"})  # nothing is differentiated
    arguments.add_machine(command)
    command.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    from ...io.images import require_writable, save_image
    from ..scene_warnings import warn

    if options.aovs and Path(options.output).suffix.lower() != ".exr":
        raise UserError(f"--aovs are layers of an .exr, {options.output} is none")
    if getattr(options, "shading", None) == "flat" and hasattr(options, "normals"):
        raise UserError("--normals would change nothing: --shading flat takes those of the triangles")
    require_writable(options.output)
    settings = arguments.settings(options)
    arguments.set_up_jax(options)
    from ...rendering.aovs import known_aovs

    aovs = known_aovs("render", options.aovs)
    scene = _load(options)
    warn([scene])
    image, found, report = _timed_render(scene, settings, options.devices, aovs)
    save_image(options.output, image, aovs=found)
    print(f"{options.output}: {report}")


def _load(options: argparse.Namespace) -> "Scene":
    import numpy as np

    from ...io.scenes import load_scene
    from ...scene.views import resized

    scene = load_scene(options.scene, np.dtype(options.precision))
    old, (width, height) = scene.camera, arguments.size(options)
    if width is None and height is None:
        return scene
    width = width or max(1, round((height or 1) * old.width / old.height))
    return resized(scene, width, height or max(1, round(width * old.height / old.width)))


def _timed_render(
    scene: "Scene", settings: Settings, devices: int | None, aovs: tuple[str, ...]
) -> tuple[Any, dict[str, Any], str]:
    """The picture, its `aovs` and what they took; `devices` None: as many as there are, if they pay."""
    import jax
    import numpy as np

    from ...rendering.render import render
    from ...trace.world import resolve_settings
    from ...xla.devices import local_mesh
    from ..limits import require_memory, worthwhile_devices
    from ..progress import CompileTime, compiled_bar

    samples = resolve_settings(settings, scene).samples or 1
    on_host = devices is None and jax.default_backend() == "cpu"
    mesh = local_mesh(worthwhile_devices(scene.camera.width * scene.camera.height * samples) if on_host else None)
    require_memory(scene, mesh.size)
    compiling = CompileTime()
    begin = time.perf_counter()
    with compiled_bar(lambda: compiling.seconds, unit=" pixels", unit_scale=True) as advance:
        image, found = render(scene, settings, aovs=tuple(dict.fromkeys(("exhausted", *aovs))), progress=advance, mesh=mesh)
    elapsed = time.perf_counter() - begin
    seconds = max(elapsed - compiling.seconds, 1e-9)
    height, width = image.shape[:2]
    device = f"{mesh.size} x {jax.devices()[0].device_kind}"
    exhausted = int(np.sum(found["exhausted"]))
    asked = {name: found[name] for name in aovs}
    rays = width * height * samples
    report = (
        f"{width} x {height} pixels, {rays} camera rays ({samples} a pixel), {seconds:.3g} s + {compiling.seconds:.3g} s "
        f"compiling, {device}, {rays / seconds:.3g} rays/s, {exhausted} rays exhausted"
    )
    return image, asked, report
