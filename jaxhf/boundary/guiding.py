"""Which edges may bound something in the picture, and by what chance each is drawn."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Float, Int

from ..core.errors import ArgumentError
from ..core.settings import Settings
from ..core.types import Index
from ..core.vector import unit
from ..scene.camera import Camera
from ..scene.light import Directional, Point, Sky
from ..trace.grid import Grid
from ..trace.world import World
from .silhouette import EdgeFlags, Viewpoint, all_edges, lit_lengths, seen_lengths, silhouettes

# The sum of the whole numbers that edges are drawn by: below 2^31 with room for rounding up.
_TICKETS = 2**30
# Vertices along the side of the blocks over which a first round of draws is averaged.
_BLOCK = 8


class Source(NamedTuple):
    """The edges of one surface, where they stand (`light` None) or cast by a light; `first` is the number of its first."""

    surface: int
    light: int | None
    first: int
    ny: int
    nx: int

    @property
    def end(self) -> int:
        return self.first + 3 * self.ny * self.nx


def sources(world: World, settings: Settings) -> tuple[Source, ...]:
    """All edges of the scene that may bound something, in one numbering. A cylinder has none."""
    found, first = [], 0
    casting = [number for number, light in enumerate(world.lights) if not isinstance(light, Sky)] if settings.shadows else []
    for k, surface in enumerate(world.surfaces):
        if not isinstance(surface, Grid):
            continue
        for light in (None, *casting):
            ny, nx = surface.shape
            found.append(Source(k, light, first, ny, nx))
            first = found[-1].end
    return tuple(found)


def plain_weights(world: World, camera: Camera, settings: Settings) -> Float[jax.Array, " edges"]:
    """How much each edge may count, as far as can be told without a ray; those of a source sum to one, or are zero."""
    lights = {number: _viewpoint(light) for number, light in enumerate(world.lights) if not isinstance(light, Sky)}
    weights = []
    for source in sources(world, settings):
        surface = world.surfaces[source.surface]
        assert isinstance(surface, Grid)
        if source.light is None:
            flags = _standing(surface, camera, list(lights.values()), settings)
            lengths = seen_lengths(surface, camera)
        else:
            flags = silhouettes(surface, lights[source.light])
            lengths = lit_lengths(surface, lights[source.light])
        lengths = jnp.where(flags, lengths, 0).ravel()
        largest = jnp.max(lengths)
        lengths = lengths / jnp.where(largest > 0, largest, 1)
        total = jnp.sum(lengths)
        weights.append(lengths / jnp.where(total > 0, total, 1))
    return jnp.concatenate(weights)


def _standing(grid: Grid, camera: Camera, lights: list[Viewpoint], settings: Settings) -> EdgeFlags:
    """Edges across which what is seen jumps at the edge itself; one that is a silhouette for several counts once."""
    if settings.shading == "flat":
        return all_edges(grid)
    flags = silhouettes(grid, Viewpoint(*camera.viewpoint()))
    for light in lights:
        flags = flags | silhouettes(grid, light)
    return flags


def _viewpoint(light: Directional | Point) -> Viewpoint:
    return Viewpoint(light.p, True) if isinstance(light, Point) else Viewpoint(unit(light.towards), False)


class Lottery(eqx.Module):
    """Edges to be drawn in proportion to whole numbers, their tickets.

    A running sum of a million weights loses small ones in single precision; one of whole numbers is exact, and so is the
    chance that follows from it.

    Attributes:
      cumulative: the number of tickets up to and with each edge.
      stratum: tickets in each of the strata, of which every draw takes one.
    """

    cumulative: Int[jax.Array, " edges"]
    stratum: Index


def make_lottery(weights: Float[jax.Array, " edges"], draws: Index) -> Lottery:
    """Every edge with a weight gets a ticket at least."""
    count = weights.shape[0]
    if count >= _TICKETS // 2:
        raise ArgumentError("Settings", "edge_samples", f"works for fewer than {_TICKETS // 2} edges, the scene has {count}")
    total = jnp.sum(weights)
    tickets = jnp.ceil(weights / jnp.where(total > 0, total, 1) * (_TICKETS - count)).astype(jnp.int32)
    cumulative = jnp.cumsum(tickets, dtype=jnp.int32)
    return Lottery(cumulative, jnp.maximum((cumulative[-1] + draws - 1) // draws, 1))


def refined_weights(
    world: World,
    settings: Settings,
    weights: Float[jax.Array, " edges"],
    edge: Int[jax.Array, " n"],
    found: Float[jax.Array, " n"],
) -> Float[jax.Array, " edges"]:
    """The weights times what a first round of draws from them has found on each edge.

    Where an edge has few draws, the mean over its block of cells counts, and where that has few, the mean over all: as if each
    edge had one draw more, with the mean of its block. No edge that may count loses all its weight, so nothing is biased;
    where nothing was found at all, the weights stay as they are.

    Args:
      world, settings: for `sources`.
      weights: `plain_weights`.
      edge, found: of each draw, its edge and the change that it stands for.
    """
    none = jnp.zeros_like(weights)
    draws, sums = none.at[edge].add(1), none.at[edge].add(found)
    everywhere = jnp.mean(found)
    refined = []
    for source in sources(world, settings):
        n, total = (value[source.first : source.end].reshape(3, source.ny, source.nx) for value in (draws, sums))
        n_block, total_block = _over_blocks(n), _over_blocks(total)
        mean = (jnp.sum(total) + everywhere) / (jnp.sum(n) + 1)
        mean = (total_block + mean) / (n_block + 1)
        refined.append(((total + mean[None].repeat(3, axis=0)) / (n + 1)).ravel())
    factors = jnp.concatenate(refined)
    return weights * jnp.where((factors > 0).any(), factors, 1)


def _over_blocks(values: Float[jax.Array, "3 ny nx"]) -> Float[jax.Array, "ny nx"]:
    """At each vertex, the sum over all edges that begin in its block."""
    _, ny, nx = values.shape
    rows, columns = -(-ny // _BLOCK), -(-nx // _BLOCK)
    padded = jnp.pad(values, ((0, 0), (0, rows * _BLOCK - ny), (0, columns * _BLOCK - nx)))
    blocks = padded.reshape(3, rows, _BLOCK, columns, _BLOCK).sum((0, 2, 4))
    return blocks.repeat(_BLOCK, axis=0).repeat(_BLOCK, axis=1)[:ny, :nx]
