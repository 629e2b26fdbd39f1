"""How much of the sky the surface leaves to see, from its horizon."""

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Float

from ..trace.grid import Grid
from ..xla.devices import local_mesh
from .horizon import cell_directions, even_azimuths, over_horizon


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


def visible_sky(grid: Grid, azimuths: int) -> Float[jax.Array, "vertices 3"]:
    """`sky_vector` at the vertices of a grid, world frame; its z axis must be upright there. Differentiable in the heights."""
    z, linear = grid.z, grid.world_from_grid.linear
    level = jnp.asarray(cell_directions(even_azimuths(azimuths), 1.0, 1.0, z.dtype))
    to_grid = grid.grid_from_world.linear[None, :2]  # term by term, as `Affine` has it
    directions = lax.stop_gradient(level[:, :1] * to_grid[..., 0] + level[:, 1:] * to_grid[..., 1])
    flat = jnp.zeros((), z.dtype)
    seen = over_horizon(sky_vector, local_mesh(1), z * linear[2, 2], directions, flat)
    return jnp.moveaxis(seen, 0, -1).reshape(-1, 3)
