"""The triangles of a grid: their vertices, and the planes through them."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Float

from ..core.types import Flag, Index, Scalar


class Corners(eqx.Module):
    """What stands at the vertices 00, between and 11 of a triangle: heights, shape (3,); normals, (3, 3), or None."""

    heights: Float[jax.Array, "3"]
    normals: Float[jax.Array, "3 3"] | None


def corners(rows: Float[jax.Array, "vertices *rest"], nx: int, ix: Index, iy: Index) -> tuple[jax.Array, ...]:
    """What stands at the vertices 00, 10, 01, 11 of a cell that is in range; rows have nx vertices."""
    first = iy * nx + ix
    return tuple(_at(rows, first + further) for further in (0, 1, nx, nx + 1))


def triangle_corners(
    rows: Float[jax.Array, "vertices *rest"], nx: int, ix: Index, iy: Index, upper: Flag
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """What stands at the vertices of a triangle of a cell in range: 00, that between (10, or 01 in the upper), and 11."""
    first, between, last = triangle_places(nx, ix, iy, upper)
    return _at(rows, first), _at(rows, between), _at(rows, last)


def triangle_places(nx: int, ix: Index, iy: Index, upper: Flag) -> tuple[Index, Index, Index]:
    """Where these vertices are in the rows."""
    first = iy * nx + ix
    return first, first + jnp.where(upper, nx, 1), first + nx + 1


def _at(rows: Float[jax.Array, "vertices *rest"], place: Index) -> jax.Array:
    return rows.at[place].get(mode="promise_in_bounds", wrap_negative_indices=False)


def plane_through(heights: Any, upper: Flag) -> tuple[Scalar, Scalar, Scalar]:
    """`triangle_plane`, from the heights at the three vertices."""
    z00, between, z11 = (jnp.where(jnp.isfinite(height), height, 0) for height in heights)
    first, second = between - z00, z11 - between
    return jnp.where(upper, second, first), jnp.where(upper, first, second), z00
