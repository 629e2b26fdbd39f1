"""The distribution from which edges are drawn: by how much each is expected to change the picture as it moves."""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Float, Int

from ..core.errors import ArgumentError
from ..core.settings import Shading
from ..core.types import Index, Scalar
from ..core.vector import floor_to_power_of_two, unit
from ..preparation.world import World
from ..scene.camera import Camera
from ..scene.light import Directional, Point, Sun
from ..shade.lighting import sharp_lights
from ..trace.cylinder import Tube
from ..trace.grid import Grid
from ..xla.materialise import materialise, value_at
from .silhouette import EdgeFlags, EdgeWeights, Viewpoint, all_edges, folds, lit_lengths, seen_lengths, silhouettes, vertices_of

# The sum of the integer weights that edges are drawn by: below 2^31 with room for rounding up.
_TOTAL_WEIGHT = 2**30
# Edges of which a distribution keeps the sum of the weights.
_RUN = 32
# The binary logarithm of vertices along the side of the blocks over which a first round of draws is averaged.
_BLOCK = 3
# Pixels from the picture's border, within which an edge bounds nothing of it: else rounding would decide where a terrain fills
# the picture.
_BORDER = 0.01


class EdgeSet(NamedTuple):
    """The edges of one surface, seen where they stand (`light` -1) or by their shadow; `first` is the number of its first.

    They are numbered as an array of the shape (3, vertices) is, see `silhouette`.
    """

    surface: int
    light: int
    first: int
    vertices: int

    @property
    def end(self) -> int:
        return self.first + 3 * self.vertices


def edge_sets(world: World) -> tuple[EdgeSet, ...]:
    """All edges of the scene that may bound something, in one numbering. A cylinder has none."""
    found, first = [], 0
    casting = [number for number, _ in sharp_lights(world)] if world.settings.shadows else []
    for k, grid, _ in world.grids:
        for light in casting if grid.still else (-1, *casting):
            found.append(EdgeSet(k, light, first, grid.rows.shape[0]))
            first = found[-1].end
    return tuple(found)


def edges_stand_still(world: World) -> World:
    """The world, of whose grids all but the first stay where they are."""
    surfaces = list(world.surfaces)
    for k, grid, _ in world.grids[1:]:
        surfaces[k] = dataclasses.replace(grid, still=True)
    return dataclasses.replace(world, surfaces=tuple(surfaces))


def has_edges(world: World) -> bool:
    """Whether a derivative draws points on edges: a cylinder has none, and to draw those of a skirt is refused."""
    return bool(world.settings.edge_samples) and any(not isinstance(surface, Tube) for surface in world.surfaces)


def initial_weights(world: World, camera: Camera) -> Float[jax.Array, " edges"]:
    """Weights of the edges by their lengths as seen or lit, without tracing a ray; those of a set sum to one, or are zero."""
    lights = {number: _viewpoint(light) for number, light in sharp_lights(world)}
    standing = [*lights.values(), *(view for light in world.lights if isinstance(light, Sun) for view in _ends_of(light))]
    weights = []
    for edges in edge_sets(world):
        grid = world.surfaces[edges.surface]
        assert isinstance(grid, Grid)
        if edges.light < 0:
            flags, lengths = _standing(grid, camera, standing, world.settings.shading), seen_lengths(grid, camera)
        else:
            flags, lengths = silhouettes(grid, lights[edges.light]), lit_lengths(grid, lights[edges.light])
        weights.append(_shares(materialise(jnp.where(materialise(flags), lengths, 0))))
    return jnp.concatenate(weights)


def _shares(lengths: EdgeWeights) -> Float[jax.Array, " edges"]:
    """Of their sum; zeros where all are zero."""
    lengths = lengths.ravel()
    largest = jnp.max(lengths)
    lengths = lengths / jnp.where(largest > 0, largest, 1)
    total = jnp.sum(lengths)
    return lengths / jnp.where(total > 0, total, 1)


def boundary_length(world: World, camera: Camera) -> Scalar:
    """How long boundaries may be in the picture, pixels: silhouettes, the terrain's border and edges of shadows.

    By the edges alone, without tracing a ray: what hides them does not count, and a shadow's edge counts with the length of the
    edge that throws it. Zero where nothing in the picture has a boundary.
    """
    total = jnp.zeros((), camera.world_from_camera.dtype)
    for _, grid, _ in world.grids:
        lengths = seen_lengths(grid, camera, _BORDER)
        total = total + jnp.sum(jnp.where(silhouettes(grid, camera.viewpoint()), lengths, 0))
        for _, light in sharp_lights(world) if world.settings.shadows else ():
            total = total + jnp.sum(jnp.where(folds(grid, _viewpoint(light)), lengths, 0))
    return total


def _standing(grid: Grid, camera: Camera, lights: list[Viewpoint], shading: Shading) -> EdgeFlags:
    """Edges across which what is seen jumps at the edge itself; one that is a silhouette for several counts once."""
    if shading == "flat":
        return all_edges(grid)
    flags = silhouettes(grid, camera.viewpoint())
    for light in lights:
        flags = flags | silhouettes(grid, light)
    return flags


def _viewpoint(light: Directional | Point) -> Viewpoint:
    return (light.p, True) if isinstance(light, Point) else (unit(light.towards), False)


def _ends_of(sun: Sun) -> list[Viewpoint]:
    """Its lowest and its highest point: triangles that face the same of these differ little in how much of the sun they see."""
    towards = unit(sun.towards)
    up, radius = jnp.array([0, 0, 1], towards.dtype), jnp.deg2rad(sun.angular_diameter) / 2
    up = unit(up - towards[2] * towards)
    return [(towards + side * radius * up, False) for side in (-1, 1)]


class GuidingDistribution(eqx.Module):
    """A discrete distribution over the edges, with integer weights, for stratified sampling.

    A running sum of a million weights loses small ones in single precision; one of integers is exact, and so are the
    probabilities that follow from it. It is kept for runs of edges: to sum up all of them one by one takes longer than to draw.

    Attributes:
      weights: of each edge; with zeros behind, so that runs are complete.
      ends: the sum of the weights up to and with each run of 32 edges.
      stratum: the weight of each stratum; every draw has a stratum of its own.
      strata: how many there are.
    """

    weights: Int[jax.Array, " edges"]
    ends: Int[jax.Array, " runs"]
    stratum: Index
    strata: Index

    def at(self, chosen: Index) -> tuple[Index, Index, Index]:
        """The edge that has the unit of weight of this number, from 0 on; its weight, and that of all edges before it."""
        run = jnp.searchsorted(self.ends, chosen, side="right").astype(jnp.int32)
        run = jnp.minimum(run, self.ends.shape[0] - 1)
        before, first = jnp.where(run > 0, self.ends[jnp.maximum(run - 1, 0)], 0), run * _RUN

        def pass_one(k: Index, found: tuple[Index, Index]) -> tuple[Index, Index]:
            edge, before = found
            end = before + value_at(self.weights, edge)
            passed = (edge == first + k) & (end <= chosen)
            return jnp.where(passed, edge + 1, edge), jnp.where(passed, end, before)

        edge, before = lax.fori_loop(0, _RUN - 1, pass_one, (first, before))
        return edge, value_at(self.weights, edge), before


def make_distribution(weights: Float[jax.Array, " edges"], draws: Index | int) -> GuidingDistribution:
    """The distribution in proportion to `weights`, in as many strata as there are draws; no positive weight becomes zero.

    Weights are rounded down to powers of two, so that single and double precision draw the same edges from the same key.
    """
    count = weights.shape[0]
    if count >= _TOTAL_WEIGHT // 2:
        raise ArgumentError(
            "Settings", "edge_samples", f"works for fewer than {_TOTAL_WEIGHT // 2} edges, the scene has {count}"
        )
    weights = jnp.where(weights > 0, floor_to_power_of_two(weights), 0)
    total, positive = jnp.sum(weights), jnp.sum(weights > 0, dtype=jnp.int32)
    most = (_TOTAL_WEIGHT - positive).astype(weights.dtype)  # each may be rounded up by one
    integers = jnp.ceil(weights / jnp.where(total > 0, total, 1) * most).astype(jnp.int32)
    integers = jnp.pad(integers, (0, -count % _RUN))
    ends = jnp.cumsum(jnp.sum(integers.reshape(-1, _RUN), axis=1, dtype=jnp.int32), dtype=jnp.int32)
    stratum = jnp.maximum((ends[-1] + draws - 1) // draws, 1)
    return GuidingDistribution(integers, ends, stratum, jnp.asarray(draws, jnp.int32))


def refined_weights(
    world: World,
    weights: Float[jax.Array, " edges"],
    edge: Int[jax.Array, " n"],
    found: Float[jax.Array, " n"],
) -> Float[jax.Array, " edges"]:
    """The weights times an estimate, from a first round of draws, of the change that each edge makes per unit of weight.

    Shrinks each edge's estimate towards the mean of its 8x8 block, and that towards the global mean, with one pseudo-count
    each; no weight becomes zero, so the estimator stays unbiased. Where nothing was found at all, the weights stay as they are.
    The factor is the estimate's square root: in proportion to the estimate itself, edges of which the first round said little
    would hold few points of large measure.

    Args:
      world: for `edge_sets`.
      weights: `initial_weights`.
      edge, found: of each draw, its edge and the size of the change that it contributes; those beyond all edges do not count.
    """
    number = (edge < weights.shape[0]).astype(found.dtype)
    found = number * found
    everywhere = jnp.sum(found) / jnp.maximum(jnp.sum(number), 1)
    none, factors, mean_there = jnp.zeros_like(weights), [], jnp.zeros_like(found)
    n, total = (none.at[edge].add(values)[edge] for values in (number, found))
    for edges in edge_sets(world):
        grid = world.surfaces[edges.surface]
        assert isinstance(grid, Grid)
        x, y = vertices_of(grid)
        block, blocks = (y >> _BLOCK) * ((grid.cells[0] >> _BLOCK) + 1) + (x >> _BLOCK), edges.vertices // 4 + 1
        here = (edges.first <= edge) & (edge < edges.end)
        vertex = lax.rem(edge - edges.first, jnp.asarray(edges.vertices, edge.dtype))
        drawn = jnp.where(here, block[vertex], blocks)  # beyond the last: not counted
        values = jnp.stack([number, found], axis=1)
        of_set = jnp.sum(jnp.where(here[:, None], values, 0), axis=0)
        of_blocks = jnp.zeros((blocks, 2), weights.dtype).at[drawn].add(values, mode="drop")
        means = (of_blocks[:, 1] + (of_set[1] + everywhere) / (of_set[0] + 1)) / (of_blocks[:, 0] + 1)
        mean_there = jnp.where(here, means.at[drawn].get(mode="clip"), mean_there)
        factors += 3 * [jnp.sqrt(means).at[block].get(mode="clip")]  # of edges that were not drawn
    refined = weights * jnp.concatenate(factors)
    refined = refined.at[edge].set(weights[edge] * jnp.sqrt((total + mean_there) / (n + 1)))
    return jnp.where(everywhere > 0, refined, weights)
