"""The edges of a heightfield's triangles, by their kinds: 0 along x, 1 along y, 2 along the diagonal.

An edge begins at a vertex, so here arrays over edges have shape (3, ny, nx). Those that would leave the grid are there too.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float, Int, Shaped

from ..core.types import Index

# From an edge's first vertex to its second, in x and in y.
STEPS = ((1, 0), (0, 1), (1, 1))


def step_of(kind: Index) -> Int[jax.Array, "2"]:
    """That of an edge of this kind, without a look-up."""
    return jnp.stack([kind != 1, kind != 0]).astype(jnp.int32)


def whole_cells(z: Float[jax.Array, "ny nx"]) -> Bool[jax.Array, "cells_y cells_x"]:
    """Which cells have all their vertices; a hole is nan."""
    return jnp.isfinite(z[:-1, :-1] + z[:-1, 1:] + z[1:, :-1] + z[1:, 1:])


def present_edges(z: Float[jax.Array, "ny nx"]) -> Bool[jax.Array, "3 ny nx"]:
    """The edges with at least one triangle."""
    present = whole_cells(z)
    here, below, left = (jnp.pad(present, sides) for sides in (((0, 1), (0, 1)), ((1, 0), (0, 1)), ((0, 1), (1, 0))))
    return jnp.stack([here | below, here | left, here])


def at_second_vertices(values: Shaped[jax.Array, "ny nx"], beyond: float = 0.0) -> Shaped[jax.Array, "3 ny nx"]:
    """Of values at vertices, those at the second vertices of edges; `beyond` where an edge leaves the grid."""
    (ny, nx), padded = values.shape, jnp.pad(values, ((0, 1), (0, 1)), constant_values=beyond)
    return jnp.stack([padded[iy : iy + ny, ix : ix + nx] for ix, iy in STEPS])
