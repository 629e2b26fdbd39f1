"""`jaxhf info`: what a scene or a terrain file holds, in words."""

import argparse
from pathlib import Path
from typing import Any

from .. import arguments


def add(commands: Any) -> None:
    about = "Print what a scene or a terrain file holds."
    examples = arguments.examples(
        "jaxhf info terrain.tif",
        "jaxhf info scene.toml",
    )
    command = commands.add_parser("info", help="print what a scene or a terrain file holds", description=about, epilog=examples)
    command.add_argument("file", metavar="FILE", help=f"a .toml or .pbrt scene; heights: {arguments.TERRAIN}")
    command.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    from ...core.errors import counted
    from ...io.files import by_ending
    from ...io.load_terrain import ENDINGS, read_terrain

    of_scene = dict.fromkeys((".toml", ".pbrt"), True)
    if not by_ending({**dict.fromkeys(ENDINGS, False), **of_scene}, Path(options.file), "describe"):
        from ..describe import terrain_lines

        print("\n".join(terrain_lines(options.file, read_terrain(options.file))))
        return
    from ...io.scenes import load_scene
    from ..describe import scene_lines
    from ..scene_warnings import warn

    scene = load_scene(options.file)
    print(f"{options.file}: {scene.camera.width} x {scene.camera.height} pixels, {counted(scene.samples, 'sample')} a pixel")
    print("\n".join(scene_lines(scene)))
    warn([scene])
