"""How much of the sky the surface leaves to see, from its horizon."""

import functools
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Float

from ..core.autodiff import recomputed
from ..core.types import Index, Scalar
from ..trace.grid import Grid
from ..trace.hit import hit_of_closed_form
from ..trace.skyline import skyline_slope
from ..xla.devices import local_mesh
from .crossings import cell_directions, even_azimuths
from .horizon import over_horizon


def sky_vector(slopes: Float[jax.Array, "k *at"]) -> Float[jax.Array, "3 *at"]:
    """The integral of w / pi over the directions w of the visible sky, from horizons at even azimuths, at least horizontal.

    Its product with a normal is the irradiance from an even sky of radiance 1 / pi, where all the visible sky lies on the upper
    side of the surface; after Dozier and Frew (1990), equation 7b, with h = atan(slope) for the height of the horizon.
    """
    turns = np.deg2rad(even_azimuths(slopes.shape[0])).reshape(-1, *[1] * (slopes.ndim - 1))
    square = 1 / (1 + slopes * slopes)
    level = jnp.pi / 2 - jnp.arctan(slopes) - slopes * square
    east, north = (jnp.asarray(f(turns), slopes.dtype) for f in (np.sin, np.cos))
    return jnp.stack(
        [
            jnp.mean(level * jnp.broadcast_to(east, level.shape), 0),
            jnp.mean(level * jnp.broadcast_to(north, level.shape), 0),
            jnp.mean(square, 0),
        ]
    )


_TOGETHER = 512  # vertices from which walks begin at once


def visible_sky(grid: Grid, azimuths: int, around: Sequence[Grid] = ()) -> Float[jax.Array, "vertices 3"]:
    """`sky_vector` at the vertices of a grid, world frame; its z axis must be upright there. Differentiable in the heights.

    The sky is hidden by the grid itself and by those `around` it, with which it is one surface.
    """
    z, linear = grid.z, grid.world_from_grid.linear
    level = jnp.asarray(cell_directions(even_azimuths(azimuths), 1.0, 1.0, z.dtype))
    to_grid = grid.grid_from_world.linear[None, :2]  # term by term, as `Affine` has it
    directions = lax.stop_gradient(level[:, :1] * to_grid[..., 0] + level[:, 1:] * to_grid[..., 1])
    flat = jnp.zeros((), z.dtype)
    if not around:
        seen = over_horizon(sky_vector, local_mesh(1), z * linear[2, 2], directions, flat)
    else:
        slopes = over_horizon(_themselves, local_mesh(1), z * linear[2, 2], directions, flat)
        slopes = functools.reduce(jnp.maximum, [slopes, *(_slopes_over(other, grid, level) for other in around)])
        seen = sky_vector(jnp.where(jnp.isnan(z), 0, slopes))
    # What is looked up in a hole, beside a hit elsewhere, is not used; were it nan, a derivative would be.
    seen = jnp.where(jnp.isnan(z), 0, seen)
    return jnp.moveaxis(seen, 0, -1).reshape(-1, 3)


def _themselves(slopes: jax.Array) -> jax.Array:
    return slopes


def _slopes_over(other: Grid, grid: Grid, level: Float[jax.Array, "k 2"]) -> Float[jax.Array, "k ny nx"]:
    """The horizon that another grid makes at the vertices of this one, at least horizontal, in these directions."""
    (ny, nx), dtype, none = grid.shape, grid.rows.dtype, jnp.zeros((), grid.rows.dtype)

    def from_vertex(number: Index, direction: jax.Array) -> Scalar:
        z = grid.rows[number]
        there = jnp.isfinite(z)
        x, y = (at.astype(dtype) for at in (number % nx, number // nx))
        p = grid.world_from_grid.point(jnp.stack([x, y, jnp.where(there, z, 0)]))
        up = jnp.array([0, 0, 1], dtype)
        at = hit_of_closed_form(-1, p, up, jnp.zeros(2, dtype), -up)
        return skyline_slope(other, 0, jnp.append(direction, none), at, there, (none, jnp.full_like(none, jnp.inf)))[0]

    def over(numbers: jax.Array) -> jax.Array:
        return lax.map(lambda direction: jax.vmap(lambda number: from_vertex(number, direction))(numbers), level)

    numbers = jnp.arange(ny * nx, dtype=jnp.int32)
    padded = jnp.pad(numbers, (0, -numbers.size % _TOGETHER), mode="edge").reshape(-1, _TOGETHER)
    slopes = jnp.moveaxis(lax.map(recomputed(over), padded), 1, 0)
    return slopes.reshape(level.shape[0], -1)[:, : ny * nx].reshape(-1, ny, nx)
