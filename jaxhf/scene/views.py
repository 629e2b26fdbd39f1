"""Scenes with pictures of another size."""

import dataclasses

from .scene import Scene


def resized(scene: Scene, width: int, height: int) -> Scene:
    """The same view in a picture of width x height pixels."""
    return dataclasses.replace(scene, camera=dataclasses.replace(scene.camera, width=width, height=height))


def shrunk(scene: Scene, pixels: int) -> Scene:
    """The same view in a picture whose longer side has at most so many pixels."""
    width, height = scene.camera.width, scene.camera.height
    scale = min(1.0, pixels / max(width, height))
    return resized(scene, max(1, round(scale * width)), max(1, round(scale * height)))
