"""`jaxhf info`: what a scene or a terrain file holds, in words."""

import argparse
from pathlib import Path

from .. import arguments
from ..command import Command


def run(options: argparse.Namespace) -> None:
    from ...core.errors import counted
    from ...io.files import by_ending
    from ...io.terrain.load import ENDINGS, read_terrain

    of_scene = dict.fromkeys((".toml", ".pbrt"), True)
    if not by_ending({**dict.fromkeys(ENDINGS, False), **of_scene}, Path(options.file), "describe"):
        from ..describe import terrain_lines

        print("\n".join(terrain_lines(options.file, read_terrain(options.file))))
        return
    from ...io.scenes.load import load_scene
    from ..describe import scene_lines
    from ..scene_warnings import warn

    scene = load_scene(options.file)
    print(f"{options.file}: {scene.camera.width} x {scene.camera.height} pixels, {counted(scene.samples, 'sample')} a pixel")
    print("\n".join(scene_lines(scene)))
    warn([scene])


COMMAND = Command(
    "info",
    "print what a scene or a terrain file holds",
    examples=("terrain.tif", "scene.toml"),
    options={"": (arguments.option("file", metavar="FILE", help=f"a .toml or .pbrt scene; heights: {arguments.TERRAIN}"),)},
    run=run,
)
