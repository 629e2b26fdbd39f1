"""The distribution from which edges are drawn: by how much each is expected to change the picture as it moves."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
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
from ..trace.edges import EdgeFlags
from ..trace.grid import Grid
from .silhouette import EdgeWeights, Viewpoint, all_edges, folds, lit_lengths, seen_lengths, silhouettes

# The sum of the integer weights that edges are drawn by: below 2^31 with room for rounding up.
_TOTAL_WEIGHT = 2**30
# Vertices along the side of the blocks over which a first round of draws is averaged.
_BLOCK = 8


class EdgeSet(NamedTuple):
    """The edges of one surface, seen where they stand (`light` -1) or by their shadow; `first` is the number of its first."""

    surface: int
    light: int
    first: int
    ny: int
    nx: int

    @property
    def end(self) -> int:
        return self.first + 3 * self.ny * self.nx


def edge_sets(world: World) -> tuple[EdgeSet, ...]:
    """All edges of the scene that may bound something, in one numbering. A cylinder has none."""
    found, first = [], 0
    casting = [number for number, _ in sharp_lights(world)] if world.settings.shadows else []
    for k, grid, _ in world.grids:
        for light in casting if grid.still else (-1, *casting):
            found.append(EdgeSet(k, light, first, *grid.shape))
            first = found[-1].end
    return tuple(found)


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
        weights.append(_shares(jnp.where(flags, lengths, 0)))
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
        lengths = seen_lengths(grid, camera)
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
    probabilities that follow from it.

    Attributes:
      cumulative: the sum of the weights up to and with each edge.
      stratum: the weight of each stratum; every draw has a stratum of its own.
    """

    cumulative: Int[jax.Array, " edges"]
    stratum: Index


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
    total = jnp.sum(weights)
    integers = jnp.ceil(weights / jnp.where(total > 0, total, 1) * (_TOTAL_WEIGHT - count)).astype(jnp.int32)
    cumulative = jnp.cumsum(integers, dtype=jnp.int32)
    return GuidingDistribution(cumulative, jnp.maximum((cumulative[-1] + draws - 1) // draws, 1))


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
      edge, found: of each draw, its edge and the size of the change that it contributes.
    """
    counted = jnp.zeros((weights.shape[0], 2), weights.dtype).at[edge].add(jnp.stack([jnp.ones_like(found), found], axis=1))
    everywhere = jnp.mean(found)
    refined = []
    for edges in edge_sets(world):
        n, total = (value.reshape(3, edges.ny, edges.nx) for value in counted[edges.first : edges.end].T)
        n_block, total_block = _over_blocks(n), _over_blocks(total)
        mean = (jnp.sum(total) + everywhere) / (jnp.sum(n) + 1)
        mean = (total_block + mean) / (n_block + 1)
        refined.append(((total + mean[None].repeat(3, axis=0)) / (n + 1)).ravel())
    factors = jnp.concatenate(refined)
    return weights * jnp.sqrt(jnp.where((factors > 0).any(), factors, 1))


def _over_blocks(values: Float[jax.Array, "3 ny nx"]) -> Float[jax.Array, "ny nx"]:
    """At each vertex, the sum over all edges that begin in its block."""
    _, ny, nx = values.shape
    rows, columns = -(-ny // _BLOCK), -(-nx // _BLOCK)
    padded = jnp.pad(values, ((0, 0), (0, rows * _BLOCK - ny), (0, columns * _BLOCK - nx)))
    blocks = padded.reshape(3, rows, _BLOCK, columns, _BLOCK).sum((0, 2, 4))
    return blocks.repeat(_BLOCK, axis=0).repeat(_BLOCK, axis=1)[:ny, :nx]
