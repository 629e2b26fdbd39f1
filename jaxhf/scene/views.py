"""Scenes with pictures of another size."""

import dataclasses

from .scene import Scene


def resized(scene: Scene, width: int | None, height: int | None) -> Scene:
    """The same view in a picture of width x height pixels; one of them that is None follows from the proportions."""
    old = scene.camera
    if width is None:
        width = old.width if height is None else max(1, round(height * old.width / old.height))
    if height is None:
        height = max(1, round(width * old.height / old.width))
    return dataclasses.replace(scene, camera=dataclasses.replace(old, width=width, height=height))


def shrunk(scene: Scene, pixels: int) -> Scene:
    """The same view in a picture whose longer side has at most so many pixels."""
    width, height = scene.camera.width, scene.camera.height
    scale = min(1.0, pixels / max(width, height))
    return resized(scene, max(1, round(scale * width)), max(1, round(scale * height)))
