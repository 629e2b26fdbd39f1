"""The boundary term of a picture's derivative, from points on edges; and which pixels are to be sampled once more.

Beside a silhouette the interior derivative is as large as one over a cosine, and at a shadow it ends: a few pixels hold
nearly all of its error. They are chosen by the points on edges, which know nothing of the picture's samples: to look again
where those are large, and to believe them where they are not, would be biased.
"""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.sharding import Mesh
from jaxtyping import Float, Int

from ..core.settings import Settings
from ..preparation.world import World
from ..scene.camera import Camera
from ..xla.devices import map_over
from .points import Packed, Points
from .sample import BoundarySample, picture_point

# Samples along a pixel's side where its interior derivative is resampled; twice the picture's, where that is more.
_RESAMPLED_SIDE = 8


class Boundaries(eqx.Module):
    """Samples of moving boundaries, without a derivative, in chunks; pixels are numbered from the top left corner, row by row.

    Attributes:
      contributions: samples, valid where they contribute, and their flows: the derivative of the light that leaves a sample's
        pixel in the sample's position in the picture, (size, 3, 2). With the leading axis of the chunks.
      pixel: the pixel of each sample.
      resampled: the pixels that change most, whose interior derivative is taken from `resampled_side` squared samples.
    """

    contributions: "Packed[tuple[BoundarySample, jax.Array]]"
    pixel: Int[jax.Array, " points"]
    resampled: Int[jax.Array, " pixels"]


def choose_resampled(points: Points, camera: Camera, settings: Settings) -> Boundaries:
    """Points with the pixels that change most, as many as take `edge_samples` samples."""
    pixel, _, sizes, _ = (values.ravel() for values in points.seen.unpacked())
    all_pixels = camera.width * camera.height
    count = math.ceil((settings.edge_samples or 0) / resampled_side(settings) ** 2)
    # They are chosen by the boundaries alone: a choice by the picture's own samples would keep what these happen to miss.
    _, chosen = lax.top_k(jnp.zeros(all_pixels, sizes.dtype).at[pixel].add(sizes), min(count, all_pixels))
    return Boundaries(points.contributions, pixel, chosen.astype(jnp.int32))


def resampled_side(settings: Settings) -> int:
    """The number of samples along the side of a pixel that is resampled."""
    return max(_RESAMPLED_SIDE, 2 * math.isqrt(settings.samples or 1))


def moved_light(world: World, camera: Camera, drawn: Boundaries, mesh: Mesh) -> Float[jax.Array, "points 3"]:
    """For each boundary sample a number whose value is meaningless; its derivative is what the silhouette or the shadow's edge
    that it stands for adds to the sample's pixel by moving."""

    def moved(world: World, camera: Camera, sample: BoundarySample, flow: jax.Array):
        x, _ = picture_point(world, camera, sample, sample.s)
        return flow[:, 0] * x[0] + flow[:, 1] * x[1]

    @jax.checkpoint
    def chunk(seen: tuple[World, Camera], contributions: Packed[tuple[BoundarySample, jax.Array]]):
        return jax.vmap(moved, in_axes=(None, None, 0, 0))(*seen, *contributions.unpacked())

    return map_over(mesh, chunk, (world, camera), drawn.contributions).reshape(-1, 3)
