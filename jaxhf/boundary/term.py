"""The boundary term of a picture's derivative: samples of moving boundaries, drawn and traced.

And which pixels are to be sampled once more. Beside a silhouette the interior derivative is as large as one over a cosine, and
at a shadow it ends: a few pixels hold nearly all of its error. They are chosen by the points on edges, which know nothing of
the picture's samples: to look again where those are large, and to believe them where they are not, would be biased.
"""

import functools
import math

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.sharding import Mesh
from jaxtyping import Float, Int

from ..core.devices import map_over, on_every_device
from ..core.materialise import materialise
from ..core.settings import Settings
from ..scene.camera import Camera
from ..trace.world import World
from .guiding import GuidingDistribution, initial_weights, make_distribution, refined_weights
from .jump import boundary_segment, pass_edge, radiance_jump
from .sample import BoundarySample, draw, picture_point

# The first of this many rounds of samples only refines the guiding distribution.
_ROUNDS = 4
# Samples along a pixel's side where its interior derivative is resampled; twice the picture's, where that is more.
_RESAMPLED_SIDE = 8


def default_key(key: jax.Array | None, settings: Settings, mesh: Mesh) -> jax.Array | None:
    """The key of the random numbers, a fixed one where the caller gives none; None where the settings draw none."""
    if not settings.edge_samples:
        return None
    return on_every_device(jax.random.key(0) if key is None else key, mesh)


class Boundaries(eqx.Module):
    """Samples of moving boundaries, without a derivative, in chunks; pixels are numbered from the top left corner, row by row.

    Attributes:
      samples: valid where they contribute. Their leaves have the leading axes (chunks, size).
      flows: derivative of the light that leaves a sample's pixel in the sample's position in the picture.
      pixel: the pixel of each sample.
      resampled: the pixels that change most, whose interior derivative is taken from `resampled_side` squared samples.
    """

    samples: BoundarySample
    flows: Float[jax.Array, "chunks size 3 2"]
    pixel: Int[jax.Array, " points"]
    resampled: Int[jax.Array, " pixels"]


def draw_boundaries(world: World, camera: Camera, key: jax.Array, mesh: Mesh, resampled: int | None = None) -> Boundaries:
    """Draws `edge_samples` samples of boundaries.

    Args:
      world: what is seen.
      camera: what sees it.
      key: of the random numbers.
      mesh: the devices that share the work.
      resampled: how many pixels are resampled; None: as many as take `edge_samples` samples.
    """
    settings, edge_samples = world.settings, world.settings.edge_samples or 0
    chunks = math.ceil(edge_samples / (_ROUNDS * settings.chunk))
    size = math.ceil(edge_samples / (_ROUNDS * chunks))
    samples, segments, flows = lax.stop_gradient(_draw_edges(world, camera, key, mesh, chunks, size))
    samples = eqx.tree_at(lambda samples: samples.valid, samples, (flows != 0).any((2, 3)))
    column, row = (segments.x[..., axis].astype(jnp.int32).ravel() for axis in (0, 1))
    pixel, all_pixels = row * camera.width + column, camera.width * camera.height

    # They are chosen by the boundaries alone: a choice by the picture's own samples would keep what these happen to miss.
    sizes = jnp.sqrt(jnp.sum(flows * flows, axis=(2, 3))).ravel()
    count = min(math.ceil(edge_samples / resampled_side(settings) ** 2), all_pixels)
    count = count if resampled is None else min(resampled, all_pixels)
    _, chosen = lax.top_k(jnp.zeros(all_pixels, sizes.dtype).at[pixel].add(sizes), count)
    return Boundaries(samples, flows, pixel, chosen.astype(jnp.int32))


def resampled_side(settings: Settings) -> int:
    """The number of samples along the side of a pixel that is resampled."""
    return max(_RESAMPLED_SIDE, 2 * math.isqrt(settings.samples or 1))


def moved_light(world: World, camera: Camera, drawn: Boundaries, mesh: Mesh) -> Float[jax.Array, "points 3"]:
    """For each boundary sample a number whose value is meaningless; its derivative is what the boundary's moving adds to the
    sample's pixel."""

    @jax.checkpoint
    def moved(world: World, camera: Camera, sample: BoundarySample, flow: jax.Array):
        x, _ = picture_point(world, camera, sample, sample.s)
        return flow[:, 0] * x[0] + flow[:, 1] * x[1]

    def chunk(seen: tuple[World, Camera], drawn: tuple[BoundarySample, jax.Array]):
        return jax.vmap(moved, in_axes=(None, None, 0, 0))(*seen, *drawn)

    return map_over(mesh, chunk, (world, camera), (drawn.samples, drawn.flows)).reshape(-1, 3)


def _draw_edges(world: World, camera: Camera, key: jax.Array, mesh: Mesh, chunks: int, size: int):
    """Samples in chunks, the boundaries round them in the picture, and their flows, see `Boundaries`."""
    world, camera = lax.stop_gradient((world, camera))

    def one(world: World, camera: Camera, guiding: GuidingDistribution, k: jax.Array, u: jax.Array):
        sample = materialise(draw(world, camera, guiding, k, u))
        sample, passage = materialise(pass_edge(world, camera, sample))
        return materialise((sample, passage, boundary_segment(world, camera, sample, passage.fold)))

    def chunk(known: tuple[World, Camera, GuidingDistribution], drawn: tuple[jax.Array, jax.Array]):
        (world, camera, guiding), (key, first) = known, drawn
        # In single precision always, so that both precisions take the same points.
        u = jax.random.uniform(key, (size, 2), jnp.float32).astype(camera.world_from_camera.dtype)
        samples, passages, segments = jax.vmap(functools.partial(one, world, camera, guiding))(
            first + jnp.arange(size, dtype=jnp.int32), u
        )
        # One batch: a `vmap` of a `vmap` would have to do all that `only_where` leaves out.
        both = jax.tree.map(lambda leaf: jnp.repeat(leaf, 2, axis=0), (samples, passages, segments.valid))
        sides = jnp.tile(jnp.arange(2, dtype=jnp.int32), size)
        light = jax.vmap(lambda both, side: radiance_jump(world, both[0], both[1], both[2], side))(both, sides).reshape(
            size, 2, 3
        )
        jump = light.sum(1) * jnp.where(segments.valid, samples.measure, 0)[:, None]
        return samples, segments, jump[:, :, None] * segments.across[:, None, :]

    def in_round(weights: jax.Array, number: jax.Array):
        per_round = chunks * size
        guiding = make_distribution(weights, jnp.where(number == 0, per_round, (_ROUNDS - 1) * per_round))
        firsts = jnp.maximum(number - 1, 0) * per_round + jnp.arange(chunks, dtype=jnp.int32) * size
        keys = jax.random.split(jax.random.fold_in(key, number), chunks)
        drawn = map_over(mesh, chunk, (world, camera, guiding), (keys, firsts))

        def refined(weights: jax.Array) -> jax.Array:
            samples, segments, flows = drawn
            sizes = jnp.sqrt(jnp.sum(flows * flows, axis=(2, 3)))
            # By how much the pixel changes as the edge is lifted; and, for what moves it otherwise, as if all had one speed.
            total = jnp.sum(sizes)
            mean_speed = jnp.sum(sizes * segments.speed) / jnp.where(total > 0, total, 1)
            mean_speed = jnp.where(mean_speed > 0, mean_speed, 1)  # seen from straight above, lifting moves nothing
            sizes = sizes * (segments.speed + mean_speed)
            return refined_weights(world, weights, samples.edge.ravel(), sizes.ravel())

        return lax.cond(number == 0, refined, lambda weights: weights, weights), drawn

    _, drawn = lax.scan(in_round, initial_weights(world, camera), jnp.arange(_ROUNDS, dtype=jnp.int32))
    return jax.tree.map(lambda leaf: leaf[1:].reshape(-1, *leaf.shape[2:]), drawn)
