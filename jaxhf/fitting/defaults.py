"""What a fit chooses by itself, from what its scenes show."""

import dataclasses
import math
from collections.abc import Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..boundary.guiding import boundary_length
from ..core.settings import Settings
from ..core.types import Scalar
from ..scene.localise import localise
from ..scene.scene import Scene
from ..trace.world import make_world, resolve_settings
from .linearise import can_be_linearised

_SAMPLES = 4  # a pixel, at least
_EDGE_SAMPLES = (2048, 32768)  # at least, at most
_EDGE_SAMPLES_PER_PIXEL = 8  # of a picture's boundaries


def choose_settings(scenes: Sequence[Scene], heights: Float[np.ndarray, "ny nx"], settings: Settings, linear: bool) -> Settings:
    """The settings with the samples and the points on edges that they leave open.

    Args:
      scenes: one a picture.
      heights: at which the fit begins.
      settings: the user's.
      linear: whether the heights are all that pictures are differentiated in.
    """
    if settings.samples is None:
        asked = max((resolve_settings(settings, scene).samples or 1 for scene in scenes), default=1)
        settings = dataclasses.replace(settings, samples=max(_SAMPLES, asked))
    if settings.edge_samples is None:
        linear = linear and all(can_be_linearised(scene, settings) for scene in scenes)
        length = max((_boundary_length(scene, heights, settings) for scene in scenes if linear), default=0.0)
        settings = dataclasses.replace(settings, edge_samples=_edge_samples(length))
    return settings


def _edge_samples(length: float) -> int:
    """Points for boundaries of this length, pixels: a power of two, so that pictures that differ little share a program."""
    if length == 0:
        return 0
    least, most = _EDGE_SAMPLES
    return min(max(2 ** round(math.log2(_EDGE_SAMPLES_PER_PIXEL * length)), least), most)


def _boundary_length(scene: Scene, heights: Float[np.ndarray, "ny nx"], settings: Settings) -> float:
    return float(_traced_length(localise(scene.with_heights(heights)), settings))


@eqx.filter_jit
def _traced_length(scene: Scene, settings: Settings) -> Scalar:
    return boundary_length(make_world(scene, settings), scene.camera)
