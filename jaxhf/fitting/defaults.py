"""What a fit chooses by itself, from what its scenes show."""

import dataclasses
import math
from collections.abc import Sequence

import equinox as eqx

from ..boundary.guiding import boundaries_in_sight
from ..core.settings import Settings
from ..core.types import Flag
from ..scene.localise import localise
from ..scene.scene import Scene
from ..trace.world import make_world, resolve_settings
from .linearise import can_be_linearised

_SAMPLES = 4  # a pixel, at least
_EDGE_SAMPLES = (2048, 16384)  # at least, at most
_EDGE_SAMPLES_PER_SIDE = 32  # for each pixel of a picture's longer side: eight for each pixel of its frame's circumference


def choose_settings(scenes: Sequence[Scene], settings: Settings, linear: bool) -> Settings:
    """The settings with the samples and the points on edges that they leave open.

    Args:
      scenes: with the heights at which the fit begins.
      settings: the user's.
      linear: whether the heights are all that pictures are differentiated in.
    """
    if settings.samples is None:
        asked = max((resolve_settings(settings, scene).samples or 1 for scene in scenes), default=1)
        settings = dataclasses.replace(settings, samples=max(_SAMPLES, asked))
    if settings.edge_samples is None:
        linear = linear and all(can_be_linearised(scene, settings) for scene in scenes)
        shown = linear and any(bool(_boundaries_in_sight(localise(scene), settings)) for scene in scenes)
        settings = dataclasses.replace(settings, edge_samples=_edge_samples(scenes) if shown else 0)
    return settings


def _edge_samples(scenes: Sequence[Scene]) -> int:
    side = max(max(scene.camera.width, scene.camera.height) for scene in scenes)
    least, most = _EDGE_SAMPLES
    return min(max(2 ** round(math.log2(_EDGE_SAMPLES_PER_SIDE * side)), least), most)


@eqx.filter_jit
def _boundaries_in_sight(scene: Scene, settings: Settings) -> Flag:
    return boundaries_in_sight(make_world(scene, settings), scene.camera)
