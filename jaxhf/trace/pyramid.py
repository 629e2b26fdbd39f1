"""Bounds of the heights over square blocks of cells, at every size: a min-max quadtree in the form of a mip chain."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Bool, Float

from ..core.types import Flag, Index, Scalar
from ..scene.heightfield import next_power_of_two
from ..xla.materialise import materialise, value_at


class Pyramid(eqx.Module):
    """For each block of 2^level x 2^level cells, the highest its surface reaches, and the lowest.

    After Tevs, Ihrke and Seidel (Maximum mipmaps for fast, accurate, and scalable dynamic height field rendering, I3D
    2008), with both bounds. Which of the two can stop a ray depends on its side of the surface, so each is kept in a
    form in which a ray is clear of the block where it stays above the bound: the highest as it is, the lowest negated.

    Blocks are rounded outwards by 32 units in the last place of the largest height, more than a height on the ray or on
    an edge can be off: a ray that is clear of a block has no change of sign in it that the test of a cell could report. A
    block with a cell that has no surface is unbounded, as a ray finds its side anew there; but where the eight around such a
    cell have none, either, rays pass it by.

    Attributes:
      bounds: level after level, each row padded to the finest's width; first for rays above, then for rays below.
      width, height: of the finest level, cells, rounded up to powers of two.
      log_width: the base-2 logarithm of `width`.
      largest: cells along a side of the coarsest level's blocks.
      below: where the bounds for rays below begin.
      has_levels: whether there are any above the finest.
      first: where the first bound stands; None: at 0, else `bounds` holds those of several grids, one after the other.
    """

    bounds: Float[jax.Array, " n"]
    width: Index
    height: Index
    log_width: Index
    largest: Index
    below: Index
    has_levels: bool = eqx.field(static=True)
    first: Index | None = None

    def bound(self, above: Flag, level: Index, ix: Index, iy: Index) -> Scalar:
        """That of the block of `level` which holds the cell (ix, iy), for a ray above or below the surface."""
        twice = 2 * self.height
        first_row = twice - lax.shift_right_logical(jnp.broadcast_to(twice, level.shape), level)
        row = first_row + lax.shift_right_logical(iy, level)
        # By a shift: vectors multiply whole numbers slowly.
        index = lax.shift_left(row, jnp.broadcast_to(self.log_width, row.shape)) + lax.shift_right_logical(ix, level)
        index = index + jnp.where(above, 0, self.below)
        index = index if self.first is None else index + self.first
        return value_at(self.bounds, index)


def levels_of(shape: tuple[int, ...]) -> int:
    """How many stand above the finest for a grid of this shape, until a block spans its shorter side."""
    return next_power_of_two(min(shape) - 1).bit_length() - 1


def make_pyramid(z: Float[jax.Array, "ny nx"], z_top: Scalar, levels: int, cells: tuple[Index, Index]) -> Pyramid:
    """Builds the bounds by dense reductions: no loop on the host, and none over the cells.

    Args:
      z: heights, 0 to `z_top`; nan in holes.
      z_top: the largest.
      levels: how many above the finest.
      cells: of the terrain along x and along y; what lies beyond is nan.
    """
    ny, nx = z.shape
    width, height = next_power_of_two(nx - 1), next_power_of_two(ny - 1)
    outwards = 32 * jnp.finfo(z.dtype).eps * z_top
    hole = jnp.isnan(z)
    gone = jnp.pad(hole[:-1] | hole[1:], ((1, 1), (0, 0)), constant_values=True)
    gone = jnp.pad(gone[:, :-1] | gone[:, 1:], ((0, 0), (1, 1)), constant_values=True)  # of cells, with those beyond the border
    gone = gone[:-2] & gone[1:-1] & gone[2:]
    amid_gone = (gone[:, :-2] & gone[:, 1:-1] & gone[:, 2:]) | beyond((ny - 1, nx - 1), cells)

    # A kernel for each level: of both bounds, and from the level below as it is padded, which is computed once then.
    values = jnp.where(hole, jnp.inf, jnp.stack([z, -z]))
    pairs = jnp.maximum(values[:, :-1], values[:, 1:])
    block = jnp.where(amid_gone, -jnp.inf, jnp.maximum(pairs[..., :-1], pairs[..., 1:]) + outwards)
    block = jnp.pad(block, ((0, 0), (0, height - (ny - 1)), (0, width - (nx - 1))), constant_values=-jnp.inf)
    rows = [materialise(block)]
    for _ in range(levels):
        pairs = jnp.maximum(rows[-1][:, 0::2], rows[-1][:, 1::2])
        block = jnp.maximum(pairs[..., 0::2], pairs[..., 1::2])
        rows.append(materialise(jnp.pad(block, ((0, 0), (0, 0), (0, width // 2)), constant_values=-jnp.inf)))
    bounds = jnp.concatenate(rows, axis=1)
    return Pyramid(
        bounds=bounds.reshape(-1),
        width=jnp.int32(width),
        height=jnp.int32(height),
        log_width=jnp.int32(width.bit_length() - 1),
        largest=jnp.int32(2**levels),
        below=jnp.int32(bounds.size // 2),
        has_levels=levels > 0,
    )


def beyond(shape: tuple[int, ...], cells: tuple[Index, Index]) -> Bool[jax.Array, "cells_y cells_x"]:
    """Which cells of an array of this shape lie beyond a terrain of so many along x and along y."""
    iy, ix = (lax.broadcasted_iota(jnp.int32, shape, axis) for axis in (0, 1))
    return (ix >= cells[0]) | (iy >= cells[1])


def enough_steps(cells_x: Any, cells_y: Any, levels: int) -> Any:
    """A number of steps that suffices for any ray.

    A ray moves one way along each axis, so on each level it passes through at most (blocks along x) + (blocks along y) - 1
    blocks. It comes to each of them at most once: it grows to a block only on entering it, and goes down into one
    only from the block around it. Each step deals with at least one of them.
    """
    return sum(-(-cells_x // 2**level) - (-cells_y // 2**level) - 1 for level in range(levels + 1))
