"""The derivative that moving boundaries add to a picture: many points on edges, drawn, followed and summed.

And a finer look at the pixels in which they were seen. Beside a silhouette the interior derivative is as large as one over a
cosine, and at a shadow it ends: a few pixels hold nearly all of its error.
"""

import functools
import math

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.sharding import Mesh
from jaxtyping import Float, Int

from ..core.devices import map_over
from ..core.materialise import stored
from ..core.sampling import sample_offset
from ..core.settings import Settings
from ..scene.camera import Camera
from ..shade.radiance import radiance
from ..trace.world import World
from .guiding import Lottery, make_lottery, plain_weights, refined_weights
from .sample import Crossing, EdgePoint, cast_shadow, draw, make_crossing, picture_point, side_ray

# Of this many rounds of points on edges, the first finds out which edges count.
_ROUNDS = 4
# Samples along a pixel's side where it is looked at again; twice the picture's, where that is more.
_FINER = 8


def moving_boundaries(
    world: World,
    camera: Camera,
    settings: Settings,
    key: jax.Array,
    mesh: Mesh,
    image: Float[jax.Array, "h w 3"],
) -> Float[jax.Array, "h w 3"]:
    """An image that means nothing, but whose derivative is what is to be added to that of the picture `image`."""
    drawn = draw_boundaries(world, camera, settings, key, mesh)

    @jax.checkpoint
    def carry(world: World, camera: Camera, point: EdgePoint, flow: jax.Array):
        x, _ = picture_point(world, camera, settings, point, point.s)
        return flow[:, 0] * x[0] + flow[:, 1] * x[1]

    def chunk(seen: tuple[World, Camera], drawn: tuple[EdgePoint, jax.Array]):
        return jax.vmap(carry, in_axes=(None, None, 0, 0))(*seen, *drawn)

    light = map_over(mesh, chunk, (world, camera), (drawn.points, drawn.flows)).reshape(-1, 3)
    flat = image.reshape(-1, 3)
    finer = _finer(world, camera, settings, mesh, drawn.pixels) - flat[drawn.pixels]
    return jnp.zeros_like(flat).at[drawn.place].add(light).at[drawn.pixels].add(finer).reshape(image.shape)


class Boundaries(eqx.Module):
    """Points on moving boundaries, without a derivative, in chunks; pixels are numbered from the top left corner, row by row.

    Attributes:
      points: those drawn; valid where they count. Their leaves have the leading axes (chunks, size).
      flows: by how much the light that leaves a point's pixel changes with the point's place in the picture.
      place: the pixel of each point.
      pixels: those in which most changes, to be looked at again with `finer_side` squared samples each.
    """

    points: EdgePoint
    flows: Float[jax.Array, "chunks size 3 2"]
    place: Int[jax.Array, " points"]
    pixels: Int[jax.Array, " pixels"]


def draw_boundaries(world: World, camera: Camera, settings: Settings, key: jax.Array, mesh: Mesh) -> Boundaries:
    """Draws `settings.edge_samples` points."""
    chunks = math.ceil(settings.edge_samples / (_ROUNDS * settings.chunk))
    size = math.ceil(settings.edge_samples / (_ROUNDS * chunks))
    points, crossings, flows = lax.stop_gradient(_draw_edges(world, camera, settings, key, mesh, chunks, size))
    points = eqx.tree_at(lambda points: points.valid, points, (flows != 0).any((2, 3)))
    column, row = (crossings.x[..., axis].astype(jnp.int32).ravel() for axis in (0, 1))
    place, all_pixels = row * camera.width + column, camera.width * camera.height

    # The points know nothing of the picture's samples: a choice by these would keep what they happen to miss.
    sizes = jnp.sqrt(jnp.sum(flows * flows, axis=(2, 3))).ravel()
    count = min(math.ceil(settings.edge_samples / finer_side(settings) ** 2), all_pixels)
    _, pixels = lax.top_k(jnp.zeros(all_pixels, sizes.dtype).at[place].add(sizes), count)
    return Boundaries(points, flows, place, pixels.astype(jnp.int32))


def finer_side(settings: Settings) -> int:
    """How many samples along a pixel's side are taken where it is looked at again."""
    return max(_FINER, 2 * math.isqrt(settings.samples or 1))


def finer_points(camera: Camera, settings: Settings, pixel: jax.Array, sample: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Where in the picture these samples of these pixels are."""
    dtype = camera.world_from_camera.dtype
    dx, dy = sample_offset(sample, finer_side(settings), dtype)
    return (pixel % camera.width).astype(dtype) + dx, (pixel // camera.width).astype(dtype) + dy


def _finer(
    world: World, camera: Camera, settings: Settings, mesh: Mesh, pixels: Int[jax.Array, " n"]
) -> Float[jax.Array, "n 3"]:
    """The light of pixels from many samples each."""
    side = finer_side(settings)
    together = min(max(settings.chunk // side**2, 1), pixels.shape[0])
    samples = jnp.arange(side * side, dtype=jnp.int32)

    def one(world: World, camera: Camera, pixel: jax.Array, sample: jax.Array) -> jax.Array:
        ray = camera.ray(*finer_points(camera, settings, pixel, sample))
        return radiance(world, stored(ray, world.surfaces[0].sure), settings)[0]

    def chunk(seen: tuple[World, Camera], pixels: jax.Array) -> jax.Array:
        light = jax.vmap(functools.partial(one, *seen))(jnp.repeat(pixels, side * side), jnp.tile(samples, together))
        return light.reshape(together, side * side, 3).mean(1)

    chunks = jnp.pad(pixels, (0, -pixels.shape[0] % together), mode="edge").reshape(-1, together)
    return map_over(mesh, chunk, (world, camera), chunks).reshape(-1, 3)[: pixels.shape[0]]


def _draw_edges(world: World, camera: Camera, settings: Settings, key: jax.Array, mesh: Mesh, chunks: int, size: int):
    """Points on edges, in chunks: the points, their places in the picture, and for each by how much the light that leaves
    its pixel changes with its place, shape (3, 2)."""
    world, camera = lax.stop_gradient((world, camera))

    def one(world: World, camera: Camera, lottery: Lottery, k: jax.Array, u: jax.Array):
        sure = world.surfaces[0].sure
        point = stored(draw(world, camera, settings, lottery, k, u), sure)
        point = stored(cast_shadow(world, point, settings), sure)
        return stored((point, make_crossing(world, camera, settings, point)), sure)

    def beside(world: World, camera: Camera, crossing: Crossing, side: jax.Array) -> jax.Array:
        return radiance(world, stored(side_ray(camera, crossing, side), world.surfaces[0].sure), settings)[0]

    def chunk(known: tuple[World, Camera, Lottery], drawn: tuple[jax.Array, jax.Array]):
        (world, camera, lottery), (key, first) = known, drawn
        u = jax.random.uniform(key, (size, 2), camera.world_from_camera.dtype)
        points, crossings = jax.vmap(functools.partial(one, world, camera, lottery))(
            first + jnp.arange(size, dtype=jnp.int32), u
        )
        # One batch: a `vmap` of a `vmap` would have to do all that `only_where` leaves out.
        sides, both = crossings.sides.reshape(-1, 2), jax.tree.map(lambda leaf: jnp.repeat(leaf, 2, axis=0), crossings)
        light = jax.vmap(functools.partial(beside, world, camera))(both, sides).reshape(size, 2, 3)
        jump = (light[:, 0] - light[:, 1]) * jnp.where(crossings.valid, points.measure, 0)[:, None]
        return points, crossings, jump[:, :, None] * crossings.across[:, None, :]

    def in_round(weights: jax.Array, number: jax.Array):
        per_round = chunks * size
        lottery = make_lottery(weights, jnp.where(number == 0, per_round, (_ROUNDS - 1) * per_round))
        firsts = jnp.maximum(number - 1, 0) * per_round + jnp.arange(chunks, dtype=jnp.int32) * size
        keys = jax.random.split(jax.random.fold_in(key, number), chunks)
        drawn = map_over(mesh, chunk, (world, camera, lottery), (keys, firsts))

        def refined(weights: jax.Array) -> jax.Array:
            points, crossings, flows = drawn
            sizes = jnp.sqrt(jnp.sum(flows * flows, axis=(2, 3)))
            # By how much the pixel changes as the edge is lifted; and, for what moves it otherwise, as if all had one speed.
            total = jnp.sum(sizes)
            mean_speed = jnp.sum(sizes * crossings.speed) / jnp.where(total > 0, total, 1)
            mean_speed = jnp.where(mean_speed > 0, mean_speed, 1)  # seen from straight above, lifting moves nothing
            sizes = sizes * (crossings.speed + mean_speed)
            return refined_weights(world, settings, weights, points.edge.ravel(), sizes.ravel())

        return lax.cond(number == 0, refined, lambda weights: weights, weights), drawn

    weights = plain_weights(world, camera, settings)
    _, drawn = lax.scan(in_round, weights, jnp.arange(_ROUNDS, dtype=jnp.int32))
    return jax.tree.map(lambda leaf: leaf[1:].reshape(-1, *leaf.shape[2:]), drawn)
