"""The same pictures of the same terrain with coarser heights and coarser pixels, where a fit of many begins."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..core.precision import numbers
from ..scene.camera import Camera, Perspective
from ..scene.heightfield import Heightfield
from ..scene.scene import Scene
from .given import Given, Prior
from .model.surface import interpolation, resample

_FACTOR = 4  # between levels: a sixteenth of the work
_MOST_SAMPLES = 2**21  # of all pictures, with which steps take about as long as it takes to compile another level


def factors(scenes: Sequence[Scene], samples: int) -> list[int]:
    """How many times coarser the levels of a fit are, from coarse to fine: 1 last."""
    field, pixels = scenes[0].heightfields[0], sum(scene.camera.width * scene.camera.height for scene in scenes)
    # A skirt has the terrain's shape; a seam is finer than coarse heights, and would be moved by their steps.
    plain = field.seam is None and all(len(scene.objects) == len(scene.heightfields) for scene in scenes)
    found = [1]
    while plain and pixels * samples > found[0] ** 2 * _MOST_SAMPLES and min(field.heights.shape) > 16 * found[0] * _FACTOR:
        found.insert(0, found[0] * _FACTOR)
    return found


def coarser(
    scenes: Sequence[Scene], targets: Sequence[np.ndarray], given: Given, factor: int
) -> tuple[list[Scene], list[np.ndarray], Given]:
    """Scenes, pictures and arguments of `fit` for heights and pixels that are so many times as large.

    A coarse pixel has the mean of the pixels that it covers by the information that they bear, the squares of their weights;
    its own is the sum of theirs, so that the loss keeps its size.
    """
    old = scenes[0].heightfields[0]
    shape = tuple(max(2, round((n - 1) / factor) + 1) for n in old.heights.shape)

    def reduced(values: Any) -> Any:
        array = np.asarray(numbers(values), np.float64)
        return array if array.ndim == 0 else _reduced(resample(array, old.heights.shape), shape)

    assert given.weights is not None
    triples = zip(scenes, targets, given.weights, strict=True)
    pictures = [_coarser_picture(scene.camera, target, weight, factor) for scene, target, weight in triples]
    prior = given.prior
    if prior is not None:
        cell = factor * max(old.dx, old.dy)
        length = None if prior.length is None or prior.length < cell else prior.length
        std = np.asarray(numbers(prior.std), np.float64)
        held = None if prior.held is None else _held(np.asarray(numbers(prior.held), np.float64), shape)
        prior = Prior(reduced(prior.heights), std if std.ndim == 0 else resample(std, shape), length, held)
    start = None if given.start is None else reduced(given.start)
    return (
        [_coarser_scene(scene, camera, shape) for scene, (camera, _, _) in zip(scenes, pictures, strict=True)],
        [target for _, target, _ in pictures],
        dataclasses.replace(given, prior=prior, start=start, weights=[weight for _, _, weight in pictures]),
    )


def _held(heights: Float[np.ndarray, "ny nx"], shape: tuple[int, ...]) -> Float[np.ndarray, "my mx"]:
    """Heights that are held, nan elsewhere, where most of what is there is held."""
    there = np.isfinite(heights)
    share = resample(there.astype(np.float64), shape)
    return np.where(share > 0.5, resample(np.where(there, heights, 0), shape) / np.maximum(share, 0.5), np.nan)


def _coarser_scene(scene: Scene, camera: Camera, shape: tuple[int, ...]) -> Scene:
    old = scene.heightfields[0]
    ny, nx = old.heights.shape
    heights = _reduced(np.asarray(old.heights, np.float64), shape).astype(old.heights.dtype)
    field = Heightfield(heights, old.dx * (nx - 1) / (shape[1] - 1), old.dy * (ny - 1) / (shape[0] - 1), old.x0, old.y0)
    k = scene.first_heightfield
    return eqx.tree_at(lambda scene: scene.objects[k].shape, scene, field).with_camera(camera)


def _coarser_picture(
    camera: Camera, target: np.ndarray, weight: np.ndarray, factor: int
) -> tuple[Camera, np.ndarray, np.ndarray]:
    """The camera, the picture and its weights."""
    width, height = (math.ceil(n / factor) for n in (camera.width, camera.height))
    times = factor * min(width, height) / min(camera.width, camera.height)
    if isinstance(camera, Perspective):
        half = times * np.tan(np.radians(np.asarray(camera.fov, np.float64)) / 2)
        camera = dataclasses.replace(camera, fov=np.degrees(2 * np.arctan(half)), width=width, height=height)
    else:
        camera = dataclasses.replace(camera, extent=times * np.asarray(camera.extent), width=width, height=height)
    rows, columns = (_overlap(n, count, factor) for n, count in zip(target.shape[:2], (height, width), strict=True))

    def summed(values: np.ndarray) -> np.ndarray:
        return np.einsum("ih,jw,hwc->ijc", rows, columns, values, optimize=True)

    shaped, weight = (values.reshape(*target.shape[:2], -1) for values in (target, weight))
    told = summed(weight**2)
    mean = summed(weight**2 * np.where(weight > 0, shaped, 0)) / np.where(told > 0, told, 1)
    return camera, mean.reshape(height, width, *target.shape[2:]), np.sqrt(told).reshape(height, width, *target.shape[2:])


def _overlap(n: int, count: int, factor: int) -> Float[np.ndarray, "count n"]:
    """How much of each of n pixels lies in each of `count` pixels that are so many times as large, about the same centre."""
    begin = (np.arange(count) - count / 2) * factor + n / 2
    low, high = np.maximum(begin[:, None], np.arange(n)), np.minimum(begin[:, None] + factor, np.arange(n) + 1)
    return np.maximum(high - low, 0.0)


def _reduced(heights: Float[np.ndarray, "ny nx"], shape: tuple[int, ...]) -> Float[np.ndarray, "my mx"]:
    """Means of heights by the weights that a bilinear surface through fewer vertices would give these."""
    for count in shape:
        weights = interpolation(np.linspace(0, count - 1, len(heights)), count).T
        heights = (weights @ heights / weights.sum(axis=1)[:, None]).T
    return heights
