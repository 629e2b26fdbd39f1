"""Points on edges, drawn in rounds and traced, without a derivative."""

import dataclasses
import functools
import math
from collections.abc import Iterable
from typing import Any, Generic, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.sharding import Mesh
from jaxtyping import Float, Int

from ..core.errors import ArgumentError
from ..core.settings import Settings
from ..preparation.any_size import of_any_terrain
from ..preparation.world import World
from ..scene.camera import Camera, of_any_size
from ..scene.heightfield import next_power_of_two
from ..scene.projection import size_of
from ..scene.skirt import Skirt
from ..trace.grid import Grid
from ..trace.skirt import Walls
from ..xla.compilation import compiled
from ..xla.devices import map_over
from ..xla.kernel import PART, one_kernel
from ..xla.materialise import materialise
from .guiding import GuidingDistribution, edges_stand_still, initial_weights, make_distribution, refined_weights
from .jump import boundary_segment, pass_edge, radiance_jump
from .sample import BoundarySample, draw

Tree = TypeVar("Tree")

# The first of this many rounds of draws only refines the guiding distribution.
_ROUNDS = 4
# A program for any size draws from the edges of so many vertices, or times a power of two: at most twice as many as there are,
# where arrays of a terrain have room for four times as many. What looks at all edges takes so much longer.
_VERTICES = 2**14
_CHUNKS = 16  # of a round, for which a program for any number of points has room at least


class Packed(eqx.Module, Generic[Tree]):
    """A pytree whose arrays have one first axis, as one array of integers and one of floats, with that axis last.

    XLA compiles several kernels for each array that a loop hands on: with one array a leaf these were a tenth of the program.
    """

    whole: Int[jax.Array, "*chunks integers n"]
    real: Float[jax.Array, "*chunks floats n"]
    _form: Any = eqx.field(static=True)

    def __getstate__(self) -> dict[str, Any]:
        """With a pytree for its structure: one that has modules in it cannot be pickled."""
        structure, forms = self._form
        return {**vars(self), "_form": (jax.tree.unflatten(structure, range(structure.num_leaves)), forms)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        tree, forms = state["_form"]
        vars(self).update(state | {"_form": (jax.tree.structure(tree), forms)})

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
            part = (self.whole, self.real)[real][..., first : first + size, :].swapaxes(-2, -1)
            leaves.append(part.reshape(*part.shape[:-1], *shape).astype(dtype))
        return jax.tree.unflatten(structure, leaves)


class Points(eqx.Module):
    """Points on edges as they were drawn, in chunks; those are valid that contribute.

    Attributes:
      contributions: samples, and their flows: the derivative of the light that leaves a sample's pixel in the sample's position
        in the picture, (size, 3, 2). With the leading axis of the chunks.
      seen: of each the numbers of its pixel and of its edge, the size of its flow, and its speed. Pixels are numbered from the
        top left corner, row by row.
    """

    contributions: Packed[tuple[BoundarySample, jax.Array]]
    seen: Packed[tuple[jax.Array, jax.Array, jax.Array, jax.Array]]


def _share(edge_samples: int, most: int) -> tuple[int, int]:
    """Into how many chunks the points of a round go, and how many draws each has, at most so many."""
    chunks = math.ceil(edge_samples / (_ROUNDS * most))
    return chunks, math.ceil(edge_samples / (_ROUNDS * chunks))


def _in_parts(draws: int) -> int:
    """So many, or more, so that their walks end in parts of equal size."""
    return math.ceil(draws / PART) * PART if draws > PART else draws


@functools.cache
def _form_of_points(chunks: tuple[int, ...], size: int, dtype: Any) -> Points:
    """`jax.ShapeDtypeStruct`s in place of points, with axes for chunks."""

    def one_chunk() -> Points:
        no, none, at, place = jnp.zeros((), bool), jnp.zeros((), jnp.int32), jnp.zeros((), dtype), jnp.zeros(2, jnp.int32)
        sample = BoundarySample(
            valid=no, edge=none, surface=none, light=none, start=place, end=place, s=at, measure=at, receiver=none, cell=place,
            upper=no, t=at,
        )  # fmt: skip
        one = (sample, jnp.zeros((3, 2), dtype)), (none, none, at, at)
        contributions, seen = jax.tree.map(lambda leaf: jnp.zeros((size, *leaf.shape), leaf.dtype), one)
        return Points(Packed.of(contributions), Packed.of(seen))

    form = jax.eval_shape(one_chunk)
    return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct((*chunks, *leaf.shape), leaf.dtype), form)


def _zeros(form: Points) -> Points:
    return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), form)


def _draw_rounds(
    world: World, camera: Camera, key: jax.Array | None, mesh: Mesh, share: tuple[Any, Any], most: int, size: int
) -> Points:
    """Draws all rounds, and keeps the points of all but the first.

    `share`: how many chunks a round has, and how many draws a chunk; where these are data, a round has room for `most` chunks.
    A chunk's draws are followed by some that are not valid, up to `size`, and the chunks by some of zeros.
    """
    world, camera = lax.stop_gradient((world, camera))
    key, dtype = jax.random.key(0) if key is None else key, camera.world_from_camera.dtype
    chunks, draws = (jnp.asarray(number, jnp.int32) for number in share)
    per_round = chunks * draws

    def one(world: World, camera: Camera, guiding: GuidingDistribution, k: jax.Array, u: jax.Array):
        sample = materialise(draw(world, camera, guiding, k, u))
        sample, fold, beyond = materialise(pass_edge(world, camera, sample))
        return materialise((sample, fold, beyond, boundary_segment(world, camera, sample, fold)))

    def chunk(world: World, camera: Camera, guiding: GuidingDistribution, draws: jax.Array, first: jax.Array, u: jax.Array):
        k = jnp.arange(size, dtype=jnp.int32)
        k = jnp.where(k < draws, first + k, guiding.strata)
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
        width, _ = size_of(camera)
        seen = row * jnp.asarray(width, jnp.int32) + column, samples.edge, sizes, segments.speed
        return Points(Packed.of((samples, flows)), Packed.of(seen))

    def if_any(known: tuple[Any, ...], item: tuple[jax.Array, ...]) -> Points:
        """A chunk that a round has, and zeros in place of one for which it has but room."""
        drawn = functools.partial(one_kernel, chunk, *known[1:], *item[1:])
        return lax.cond(item[0] < known[0], drawn, functools.partial(_zeros, _form_of_points((), size, dtype)))

    weights, numbers = initial_weights(world, camera), jnp.arange(most, dtype=jnp.int32)

    def in_round(carry: tuple[GuidingDistribution, Points], number: jax.Array):
        guiding, kept = carry
        before = jnp.maximum(number - 1, 0) * chunks
        keys = jax.random.split(jax.random.fold_in(key, number), most)
        # In single precision always, so that both precisions take the same points.
        u = jax.vmap(lambda key: jax.random.uniform(key, (size, 2), jnp.float32))(keys)
        items = numbers, (before + numbers) * draws, u.astype(dtype)
        drawn = map_over(mesh, if_any, (chunks, world, camera, guiding, draws), items)

        def refined(_: GuidingDistribution) -> GuidingDistribution:
            _, edge, sizes, speed = drawn.seen.unpacked()
            # By how much the pixel changes as the edge is lifted; and, for what moves it otherwise, as if all had one speed.
            total = jnp.sum(sizes)
            mean_speed = jnp.sum(sizes * speed) / jnp.where(total > 0, total, 1)
            mean_speed = jnp.where(mean_speed > 0, mean_speed, 1)  # seen from straight above, lifting moves nothing
            sizes = sizes * (speed + mean_speed)
            edge = jnp.where(numbers[:, None] < chunks, edge, weights.shape[0])
            return make_distribution(refined_weights(world, weights, edge.ravel(), sizes.ravel()), (_ROUNDS - 1) * per_round)

        # Later rounds overwrite the first one, in place: all of them one after the other took a third more memory, and copies.
        kept = jax.tree.map(lambda all, part: lax.dynamic_update_slice_in_dim(all, part, before, 0), kept, drawn)
        return (lax.cond(number == 0, refined, lambda guiding: guiding, guiding), kept), None

    begun = make_distribution(weights, per_round), _zeros(_form_of_points(((_ROUNDS - 1) * most,), size, dtype))
    return lax.scan(in_round, begun, jnp.arange(_ROUNDS, dtype=jnp.int32))[0][1]


def draw_edges(world: World, camera: Camera, key: jax.Array | None, mesh: Mesh) -> Points:
    """Draws `edge_samples` points, as a part of the program for a picture of its size.

    Args:
      world, camera, mesh: as for `render`.
      key: of the random numbers; None: a fixed one.

    Raises:
      ArgumentError: see `require_edges_followed`.
    """
    settings, edge_samples = world.settings, world.settings.edge_samples or 0
    require_edges_followed(world.surfaces, edge_samples)
    chunks, draws = _share(edge_samples, settings.chunk)
    return lax.stop_gradient(_draw_rounds(world, camera, key, mesh, (chunks, draws), chunks, _in_parts(draws)))


def require_edges_followed(shapes: Iterable[Any], edge_samples: int) -> None:
    """ArgumentError where one of these shapes or surfaces is a skirt, whose edges are not followed."""
    if any(isinstance(shape, Walls | Skirt) for shape in shapes):
        rule = f"must be 0 where a scene with a Skirt is differentiated, as its edges are not followed; it is {edge_samples}"
        raise ArgumentError("Settings", "edge_samples", rule)


def draw_points(world: World, camera: Camera, mesh: Mesh, edge_samples: int, still: bool) -> Points:
    """As `draw_edges`, by a program for terrains and pictures of any size, with room behind the points, see `asked_for`.

    Args:
      world, camera, mesh: as for `render`.
      edge_samples: how many points are drawn.
      still: whether only the edges of the first heightfield move in the picture; of the others then only shadows do.
    """
    return _draw_for_any_size(*_arguments(world, camera, mesh, edge_samples, still))


def compile_points_ahead(world: World, camera: Camera, mesh: Mesh, edge_samples: int, still: bool) -> Points:
    """The program of `draw_points`; `jax.ShapeDtypeStruct`s in place of what that returns."""
    _draw_for_any_size.compile_ahead(*_arguments(world, camera, mesh, edge_samples, still))
    most, size = _room_for(world.settings, edge_samples)
    return _form_of_points(((_ROUNDS - 1) * most,), size, camera.world_from_camera.dtype)


def asked_for(edge_samples: int, settings: Settings) -> tuple[int, int]:
    """How many of the chunks of what `draw_points` returns count, and how many points of each."""
    chunks, draws = _share(edge_samples, _draws_of_chunk(settings))
    return (_ROUNDS - 1) * chunks, _in_parts(draws)


def _arguments(world: World, camera: Camera, mesh: Mesh, edge_samples: int, still: bool) -> tuple[Any, ...]:
    known = [math.prod(grid.known_shape) for _, grid, _ in world.grids if grid.known_shape is not None]
    vertices = _VERTICES << (math.ceil(max(known) / _VERTICES) - 1).bit_length()
    share = tuple(np.asarray(number, np.int32) for number in _share(edge_samples, _draws_of_chunk(world.settings)))
    room = _room_for(world.settings, edge_samples)
    return of_any_terrain(world), of_any_size(camera), mesh, share, vertices, *room, still


def _room_for(settings: Settings, edge_samples: int) -> tuple[int, int]:
    """For how many chunks a round of a program for any number of points has room, and a chunk for how many draws."""
    chunks, _ = _share(edge_samples, _draws_of_chunk(settings))
    return max(next_power_of_two(chunks), _CHUNKS), _in_parts(_draws_of_chunk(settings))


def _draws_of_chunk(settings: Settings) -> int:
    """Half of the default chunk is what a round has of the 2048 points that a fit takes at least."""
    return max(settings.chunk // 2, 1)


def _draw_edges_of_any(
    world: World, camera: Camera, mesh: Mesh, share: tuple[Any, Any], vertices: int, most: int, size: int, still: bool
) -> Points:
    surfaces = tuple(
        dataclasses.replace(surface, rows=surface.rows[:vertices]) if isinstance(surface, Grid) else surface
        for surface in world.surfaces
    )
    world = dataclasses.replace(world, surfaces=surfaces)
    return _draw_rounds(edges_stand_still(world) if still else world, camera, None, mesh, share, most, size)


_draw_for_any_size = compiled(_draw_edges_of_any, static_argnames=("mesh", "vertices", "most", "size", "still"))
