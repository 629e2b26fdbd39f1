"""What a fit chooses by itself, from what its scenes show."""

import dataclasses
import functools
import math
from collections.abc import Sequence

import equinox as eqx

from ...boundary.guiding import boundary_length
from ...core.settings import Settings
from ...core.types import Scalar
from ...preparation.world import make_world, resolve_settings
from ...scene.scene import Scene
from ...scene.skirt import Skirt
from ...xla.compilation import compiled
from .pictures import can_be_linearised

_SAMPLES = 4  # a pixel, at least
EDGE_SAMPLES = (2048, 32768)  # at least, at most
_EDGE_SAMPLES_PER_PIXEL = 8  # of a picture's boundaries


def choose_samples(scenes: Sequence[Scene], settings: Settings) -> Settings:
    """The settings with the samples a pixel that they leave open: at least four, or more if a scene asks for them."""
    if settings.samples is not None:
        return settings
    asked = max(resolve_settings(settings, scene).samples or 1 for scene in scenes)
    return dataclasses.replace(settings, samples=max(_SAMPLES, asked))


def choose_edge_samples(views: Sequence[Scene], settings: Settings, shadows: bool = False) -> int:
    """As many points on edges as the longest boundaries in one of these `localise`d pictures ask for; 0 where there are none,
    and beside a skirt. A power of two, so that pictures that differ little share a program.

    `shadows`: whether the measured pictures show shadows, whatever these scenes do.
    """
    has_skirt = any(isinstance(obj.shape, Skirt) for view in views for obj in view.objects)  # with points it is refused
    if has_skirt or not all(can_be_linearised(view, settings) for view in views):
        return 0
    settings = dataclasses.replace(settings, edge_samples=None)  # so that a second call, when some are chosen, compiles nothing
    length = max(float(_boundary_length(view, settings)) for view in views)
    least, most = EDGE_SAMPLES
    if length == 0:
        return least if shadows else 0
    return min(max(2 ** round(math.log2(_EDGE_SAMPLES_PER_PIXEL * length)), least), most)


@functools.partial(compiled, jit=eqx.filter_jit)
def _boundary_length(scene: Scene, settings: Settings) -> Scalar:
    return boundary_length(make_world(scene, settings), scene.camera)
