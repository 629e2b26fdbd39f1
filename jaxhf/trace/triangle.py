"""The triangles of a grid: their vertices, and the planes through them."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Float

from ..core.types import Flag, Index, Scalar
from ..xla.materialise import value_at, values_at


class Corners(eqx.Module):
    """Heights (3,) and normals (3, 3), or None, at the vertices of a triangle: 00, the one between (10 or 01), and 11."""

    heights: Float[jax.Array, "3"]
    normals: Float[jax.Array, "3 3"] | None


def corners(
    rows: Float[jax.Array, "vertices *rest"], nx: Index | int, ix: Index, iy: Index, grid: Index | None
) -> tuple[jax.Array, ...]:
    """The values at the vertices 00, 10, 01, 11 of a cell that is in range, from a flat array whose rows have nx vertices.

    Where that holds several grids, `grid` is the place of the grid's first vertex.
    """
    return values_at(rows, _place(nx, ix, iy, grid), (1, nx, nx + 1))


def triangle_corners(
    rows: Float[jax.Array, "vertices *rest"], nx: Index | int, ix: Index, iy: Index, upper: Flag, grid: Index | None = None
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The values at the vertices of a triangle of a cell in range: 00, the one between (10, or 01 in the upper), and 11.

    `grid` is as in `corners`.
    """
    first = _place(nx, ix, iy, grid)
    z00, z11 = values_at(rows, first, (nx + 1,))
    return z00, value_at(rows, first + jnp.where(upper, nx, 1)), z11


def _place(nx: Index | int, ix: Index, iy: Index, grid: Index | None) -> Index:
    first = iy * nx + ix
    return first if grid is None else first + grid


def triangle_vertices(nx: Index | int, ix: Index, iy: Index, upper: Flag) -> tuple[Index, Index, Index]:
    """The numbers of these vertices, row by row."""
    first = _place(nx, ix, iy, None)
    return first, first + jnp.where(upper, nx, 1), first + nx + 1


def plane_through(heights: Any, upper: Flag) -> tuple[Scalar, Scalar, Scalar]:
    """`triangle_plane`, from the heights at the three vertices."""
    z00, between, z11 = (jnp.where(jnp.isfinite(height), height, 0) for height in heights)
    first, second = between - z00, z11 - between
    return jnp.where(upper, second, first), jnp.where(upper, first, second), z00
