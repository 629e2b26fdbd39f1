"""The boundary term of a picture's derivative: samples of moving boundaries, drawn and traced.

And which pixels are to be sampled once more. Beside a silhouette the interior derivative is as large as one over a cosine, and
at a shadow it ends: a few pixels hold nearly all of its error. They are chosen by the points on edges, which know nothing of
the picture's samples: to look again where those are large, and to believe them where they are not, would be biased.
"""

import functools
import math
from typing import Any, Generic, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.sharding import Mesh
from jaxtyping import Float, Int

from ..core.errors import ArgumentError
from ..core.settings import Settings
from ..preparation.world import World
from ..scene.camera import Camera
from ..trace.skirt import Walls
from ..xla.devices import map_over
from ..xla.kernel import PART, one_kernel, traced_once
from ..xla.materialise import materialise
from .guiding import GuidingDistribution, initial_weights, make_distribution, refined_weights
from .jump import boundary_segment, pass_edge, radiance_jump
from .sample import BoundarySample, draw, picture_point

Tree = TypeVar("Tree")

# The first of this many rounds of samples only refines the guiding distribution.
_ROUNDS = 4
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


class Packed(eqx.Module, Generic[Tree]):
    """A pytree whose arrays have one first axis, as one array of integers and one of floats, with that axis last.

    XLA compiles several kernels for each array that a loop hands on: with one array a leaf these were a tenth of the program.
    """

    whole: Int[jax.Array, "*chunks integers n"]
    real: Float[jax.Array, "*chunks floats n"]
    _form: Any = eqx.field(static=True)

    @staticmethod
    def of(tree: Tree) -> "Packed[Tree]":
        leaves, structure = jax.tree.flatten(tree)
        rows: tuple[list[jax.Array], list[jax.Array]] = [], []
        for leaf in leaves:
            real = jnp.issubdtype(leaf.dtype, jnp.floating)
            rows[real].extend((leaf if real else leaf.astype(jnp.int32)).reshape(leaf.shape[0], -1).T)
        whole, real = (jnp.stack(part) for part in rows)
        return Packed(whole, real, (structure, tuple((leaf.dtype, leaf.shape[1:]) for leaf in leaves)))

    def unpacked(self) -> Tree:
        """The pytree; the axes that a loop has added come first."""
        structure, forms = self._form
        taken, leaves = [0, 0], []
        for dtype, shape in forms:
            real, size = jnp.issubdtype(dtype, jnp.floating), math.prod(shape)
            first = taken[real]
            taken[real] += size
            part = jnp.moveaxis((self.whole, self.real)[real][..., first : first + size, :], -2, -1)
            leaves.append(part.reshape(*part.shape[:-1], *shape).astype(dtype))
        return jax.tree.unflatten(structure, leaves)


def draw_boundaries(
    world: World, camera: Camera, key: jax.Array | None, mesh: Mesh, resampled: int | None = None
) -> Boundaries:
    """Draws `edge_samples` samples of boundaries.

    Args:
      world, camera, mesh: as for `render`.
      key: of the random numbers; None: a fixed one.
      resampled: how many pixels are resampled; None: as many as take `edge_samples` samples.

    Raises:
      ArgumentError: the scene has a skirt.
    """
    settings, edge_samples = world.settings, world.settings.edge_samples or 0
    if any(isinstance(surface, Walls) for surface in world.surfaces):
        rule = f"must be 0 where a scene with a Skirt is differentiated, as its edges are not followed; it is {edge_samples}"
        raise ArgumentError("Settings", "edge_samples", rule)
    key = jax.random.key(0) if key is None else key
    chunks = math.ceil(edge_samples / (_ROUNDS * settings.chunk))
    draws = math.ceil(edge_samples / (_ROUNDS * chunks))
    contributions, seen = lax.stop_gradient(_draw_edges(world, camera, key, mesh, chunks, draws))
    pixel, _, sizes, _ = (values.ravel() for values in seen.unpacked())
    all_pixels = camera.width * camera.height

    # They are chosen by the boundaries alone: a choice by the picture's own samples would keep what these happen to miss.
    count = min(math.ceil(edge_samples / resampled_side(settings) ** 2), all_pixels)
    count = count if resampled is None else min(resampled, all_pixels)
    _, chosen = lax.top_k(jnp.zeros(all_pixels, sizes.dtype).at[pixel].add(sizes), count)
    return Boundaries(contributions, pixel, chosen.astype(jnp.int32))


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


def _draw_edges(world: World, camera: Camera, key: jax.Array, mesh: Mesh, chunks: int, draws: int):
    """In chunks the `contributions` of `Boundaries`, and of each its pixel, its edge, the size of its flow and its speed.

    A chunk's draws are followed by some that are not valid, so that its walks end in parts of equal size.
    """
    world, camera = lax.stop_gradient((world, camera))
    size = math.ceil(draws / PART) * PART if draws > PART else draws
    per_round = chunks * draws

    def one(world: World, camera: Camera, guiding: GuidingDistribution, k: jax.Array, u: jax.Array):
        sample = materialise(draw(world, camera, guiding, k, u))
        sample, fold, beyond = materialise(pass_edge(world, camera, sample))
        return materialise((sample, fold, beyond, boundary_segment(world, camera, sample, fold)))

    @traced_once  # it is also asked for its shapes
    def chunk(world: World, camera: Camera, guiding: GuidingDistribution, first: jax.Array, u: jax.Array):
        k = jnp.arange(size, dtype=jnp.int32)
        k = jnp.where(k < draws, first + k, (_ROUNDS - 1) * per_round)  # beyond the last stratum nothing is valid
        samples, folds, beyond, segments = jax.vmap(functools.partial(one, world, camera, guiding))(k, u)

        def one_side(side: jax.Array) -> jax.Array:
            return jax.vmap(functools.partial(radiance_jump, world, camera, side=side))(samples, folds, beyond, segments.valid)

        # A `vmap` of a `vmap` would have to do all that `only_where` leaves out.
        light = lax.map(one_side, jnp.arange(2, dtype=jnp.int32))
        jump = (light[0] + light[1]) * jnp.where(segments.valid, samples.measure, 0)[:, None]
        flows = jump[:, :, None] * segments.across[:, None, :]
        samples = eqx.tree_at(lambda samples: samples.valid, samples, (flows != 0).any((1, 2)))
        column, row = (segments.x[:, axis].astype(jnp.int32) for axis in (0, 1))
        # Written out: XLA hands a sum over several axes to a library, which a kernel cannot call.
        sizes = jnp.sqrt(sum(flows[:, i, j] ** 2 for i in range(3) for j in range(2)))
        seen = row * camera.width + column, samples.edge, sizes, segments.speed
        return Packed.of((samples, flows)), Packed.of(seen)

    weights = initial_weights(world, camera)

    def in_round(carry: tuple[GuidingDistribution, Any], number: jax.Array):
        guiding, kept = carry
        before = jnp.maximum(number - 1, 0) * chunks
        firsts = (before + jnp.arange(chunks, dtype=jnp.int32)) * draws
        keys = jax.random.split(jax.random.fold_in(key, number), chunks)
        # In single precision always, so that both precisions take the same points.
        u = jax.vmap(lambda key: jax.random.uniform(key, (draws, 2), jnp.float32))(keys)
        numbers = firsts, jnp.pad(u, ((0, 0), (0, size - draws), (0, 0))).astype(camera.world_from_camera.dtype)
        drawn = map_over(mesh, lambda known, drawn: one_kernel(chunk, *known, *drawn), (world, camera, guiding), numbers)

        def refined(_: GuidingDistribution) -> GuidingDistribution:
            _, edge, sizes, speed = (values[:, :draws] for values in drawn[1].unpacked())
            # By how much the pixel changes as the edge is lifted; and, for what moves it otherwise, as if all had one speed.
            total = jnp.sum(sizes)
            mean_speed = jnp.sum(sizes * speed) / jnp.where(total > 0, total, 1)
            mean_speed = jnp.where(mean_speed > 0, mean_speed, 1)  # seen from straight above, lifting moves nothing
            sizes = sizes * (speed + mean_speed)
            found = refined_weights(world, weights, edge.ravel(), sizes.ravel())
            return make_distribution(found, (_ROUNDS - 1) * per_round)

        # Later rounds overwrite the first one, in place: all of them one after the other took a third more memory, and copies.
        kept = jax.tree.map(lambda all, part: lax.dynamic_update_slice_in_dim(all, part, before, 0), kept, drawn)
        return (lax.cond(number == 0, refined, lambda guiding: guiding, guiding), kept), None

    guiding, u = make_distribution(weights, per_round), jnp.zeros((size, 2), camera.world_from_camera.dtype)
    shapes = jax.eval_shape(chunk, world, camera, guiding, jnp.zeros((), jnp.int32), u)
    kept = jax.tree.map(lambda leaf: jnp.zeros(((_ROUNDS - 1) * chunks, *leaf.shape), leaf.dtype), shapes)
    return lax.scan(in_round, (guiding, kept), jnp.arange(_ROUNDS, dtype=jnp.int32))[0][1]
