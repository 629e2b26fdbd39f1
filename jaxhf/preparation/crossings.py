"""Where directions from the vertices of a grid cross its edges."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from ..core.types import Scalar
from ..trace.edges import STEPS

TOGETHER = 8
"""Of their number crossings are a multiple: so many are looked at in one pass over a tile."""

# The kinds of edges, see `edges`; and a last one, for crossings at a vertex, which leads nowhere.
_ALONG_X, _ALONG_Y, _DIAGONAL, _VERTEX = range(4)
_TO_SECOND = np.array([*STEPS, (0, 0)], np.int32)


class Crossings(eqx.Module):
    """Crossings of one direction with the edges of a grid, from a vertex outwards; an entry each, those at a vertex once.

    Attributes:
      inverse: 1 / the horizontal distance, falling; 0 at entries without a crossing.
      share: how far along the edge; nan at such entries.
      kind: of the edge.
      x, y, x2, y2: from the vertex to the first and to the second vertex of the edge, cells.
    """

    inverse: Float[jax.Array, " n"]
    share: Float[jax.Array, " n"]
    kind: Int[jax.Array, " n"]
    x: Int[jax.Array, " n"]
    y: Int[jax.Array, " n"]
    x2: Int[jax.Array, " n"]
    y2: Int[jax.Array, " n"]


def even_azimuths(count: int) -> Float[np.ndarray, " k"]:
    """Degrees clockwise from north, from 0 on."""
    return np.arange(count) * (360 / count)


def cell_directions(azimuths: Float[np.ndarray, " k"], dx: float, dy: float, dtype: Any) -> Float[np.ndarray, "k 2"]:
    """Cells in x and in y for each unit of horizontal distance; exact along lines of the grid and along diagonals."""
    turns = np.deg2rad(azimuths % 360)
    unit = np.stack([np.sin(turns), np.cos(turns)], -1)
    unit[np.abs(unit) < 1e-12] = 0
    x, y = (unit / (dx, dy)).T
    return np.stack([x, np.where(np.abs(x - y) < 1e-12 * np.abs(x), x, y)], -1).astype(dtype)


def crossings_of(shape: tuple[int, int], direction: Float[jax.Array, "2"]) -> Crossings:
    """Those of a direction, in cells for each unit of distance, with the edges of a grid of this shape, from any vertex on."""
    (ny, nx), dx, dy, dtype = shape, direction[0], direction[1], direction.dtype
    rounding = 8 * float(jnp.finfo(dtype).eps)

    def of_lines(most: int, rate: Scalar, moving: Scalar, kind: int) -> tuple[jax.Array, ...]:
        """Of lines that the direction passes at `rate`, while it moves along them at `moving`, and their numbers."""
        line, size = jnp.arange(1, most + 1, dtype=jnp.int32), jnp.abs(rate)
        at = line.astype(dtype) * (moving / jnp.where(size > 0, size, 1))
        at_vertex = jnp.abs(at - jnp.round(at)) <= rounding * jnp.maximum(jnp.abs(at), 1)
        first = jnp.where(at_vertex, jnp.round(at), jnp.floor(at))
        share = jnp.where(size > 0, jnp.where(at_vertex, 0, at - first), jnp.nan)
        kinds = jnp.where(at_vertex, _VERTEX, kind).astype(jnp.int32)
        return size / line.astype(dtype), share, kinds, first.astype(jnp.int32), jnp.where(rate < 0, -line, line)

    *columns, columns_y, columns_x = of_lines(nx - 1, dx, dy, _ALONG_Y)
    *rows, rows_x, rows_y = of_lines(ny - 1, dy, dx, _ALONG_X)
    *diagonals, diagonals_x, number = of_lines(nx + ny - 2, dx - dy, dx, _DIAGONAL)  # of x - y
    families = (*columns, columns_x, columns_y), (*rows, rows_x, rows_y), (*diagonals, diagonals_x, diagonals_x - number)
    entries = [jnp.concatenate(parts) for parts in zip(*families, strict=True)]
    order = jnp.argsort(-entries[0])
    inverse, share, kind, x, y = (values[order] for values in entries)
    again = (kind[1:] == _VERTEX) & (kind[:-1] == _VERTEX) & (x[1:] == x[:-1]) & (y[1:] == y[:-1])
    inverse = jnp.where(jnp.pad(again, (1, 0)), 0, inverse)
    order, missing = jnp.argsort(-inverse), -inverse.size % TOGETHER
    inverse, share, kind, x, y = (jnp.pad(values[order], (0, missing)) for values in (inverse, share, kind, x, y))
    share = jnp.where(inverse > 0, share, jnp.nan)
    second = jnp.asarray(_TO_SECOND)[kind]
    return Crossings(inverse, share, kind, x, y, x + second[:, 0], y + second[:, 1])
