"""`jaxhf info`: what a scene or a terrain file holds, in words."""

import argparse
from pathlib import Path

from ...core.errors import counted
from ...io.files import by_ending
from ...io.terrain.load import ENDINGS, read_terrain
from ..describe import scene_lines, terrain_lines


def run(options: argparse.Namespace) -> None:
    of_scene = dict.fromkeys((".toml", ".pbrt"), True)
    if not by_ending({**dict.fromkeys(ENDINGS, False), **of_scene}, Path(options.file), "describe"):
        print("\n".join(terrain_lines(options.file, read_terrain(options.file))))
        return
    from ...io.scenes.load import load_scene  # with JAX, which a terrain does without
    from ..scene_warnings import warn

    scene = load_scene(options.file)
    print(f"{options.file}: {scene.camera.width} x {scene.camera.height} pixels, {counted(scene.samples, 'sample')} a pixel")
    print("\n".join(scene_lines(scene)))
    warn([scene])
