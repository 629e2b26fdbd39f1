"""`jaxhf info`: what a scene holds, in words."""

import argparse
from typing import Any


def add(commands: Any) -> None:
    command = commands.add_parser("info", help="print what a scene holds", description="Print what a scene holds.")
    command.add_argument("scene", metavar="SCENE", help="a .toml or .pbrt scene")
    command.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    from ..io.scenes import load_scene
    from .describe import scene_lines

    scene = load_scene(options.scene)
    print(f"{options.scene}: {scene.camera.width} x {scene.camera.height} pixels, {scene.samples} samples a pixel")
    print("\n".join(scene_lines(scene)))
