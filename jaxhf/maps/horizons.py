"""A map from the horizon of each vertex of a terrain."""

import functools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.sharding import Mesh
from jaxtyping import Float

from ..core.errors import ArgumentError, require_progress
from ..core.types import AnyArray
from ..preparation.crossings import cell_directions
from ..preparation.horizon import (
    Besides,
    HorizonView,
    Summary,
    assemble,
    over_horizon,
    over_tiles,
    tile_count,
)
from ..preparation.sky import sky_vector
from ..scene.heightfield import Heightfield
from ..trace.normals import vertex_normals
from ..xla.compilation import compiled, is_traced
from ..xla.devices import chosen_mesh, on_every_device
from .sunlight import received
from .surface import with_spacing

_PARTS = 64  # of a map that reports its progress
_ROOM = 4  # heights and horizontal distances are divided by it, so that differences of heights stay numbers
_SUMMARIES: dict[str, Summary] = {
    "degrees": lambda slopes: jnp.rad2deg(jnp.arctan(slopes)),
    "solid-angle": lambda slopes: jnp.mean(1 - slopes * lax.rsqrt(1 + slopes * slopes), 0),
    "horizontal": lambda slopes: jnp.mean(1 / (1 + slopes * slopes), 0),
    "slope": sky_vector,
    "received": received,
}


def map_over_horizons(
    owner: str,
    summary: str,
    field: Heightfield,
    azimuths: np.ndarray,
    lowest: float,
    progress: Callable[[int, int], None] | None,
    mesh: Mesh | None,
    besides: Besides | None = None,
) -> jax.Array:
    """A map of one of `_SUMMARIES` of the horizons at a terrain's vertices: shape (..., ny, nx), nan where there is no height.

    `lowest` is the slope where nothing rises higher, -inf at least; `besides` is what else the summary takes.
    """
    require_progress(owner, progress, is_traced())
    dtype, mesh = field.heights.dtype, chosen_mesh(owner, mesh, field)
    directions = _ROOM * cell_directions(azimuths, field.dx, field.dy, dtype)
    heights, directions, besides = on_every_device((field.heights, directions, besides), mesh)
    if progress is None:
        return _over(summary, mesh, heights, directions, np.asarray(lowest, dtype), besides)
    count, parts = tile_count(heights.shape), []
    size = mesh.size * math.ceil(count / mesh.size / _PARTS)
    view = _view(heights, directions)
    for first in range(0, count, size):
        numbers = np.minimum(np.arange(first, first + size, dtype=np.int32), count - 1)
        parts.append(jax.device_get(_over_tiles(summary, mesh, view, np.asarray(lowest, dtype), numbers, besides)))
        progress(heights.size * min(count, first + size) // count, heights.size)
    found = assemble(np.concatenate(parts)[:count], heights.shape)
    return jnp.asarray(np.where(np.isfinite(heights), found, np.asarray(np.nan, dtype)))


@functools.partial(compiled, newer=True, static_argnames=("summary", "mesh"))
def _over(
    summary: str, mesh: Mesh, heights: jax.Array, directions: jax.Array, lowest: jax.Array, besides: Besides | None
) -> jax.Array:
    return over_horizon(_SUMMARIES[summary], mesh, _holed(heights), directions, lowest, besides)


@functools.partial(compiled, newer=True)
def _view(heights: jax.Array, directions: jax.Array) -> HorizonView:
    return HorizonView.of(_holed(heights), directions)


@functools.partial(compiled, newer=True, static_argnames=("summary", "mesh"))
def _over_tiles(
    summary: str, mesh: Mesh, view: HorizonView, lowest: jax.Array, numbers: jax.Array, besides: Besides | None
) -> jax.Array:
    return over_tiles(_SUMMARIES[summary], mesh, view, lowest, numbers, besides=besides)[0]


def _holed(heights: jax.Array) -> jax.Array:
    return jnp.where(jnp.isfinite(heights), heights / _ROOM, jnp.nan)


def field_of(owner: str, terrain: Any, dx: float | None, dy: float | None) -> Heightfield:
    """The heightfield of a `Heightfield`, a `Terrain`, or an array with its cell size."""
    if not isinstance(terrain, Heightfield):
        return Heightfield(*with_spacing(owner, terrain, dx, dy))
    for name, value in (("dx", dx), ("dy", dy)):
        if value is not None:
            raise ArgumentError(owner, name, "must stand without a Heightfield, which has its own cell size")
    return terrain


def unit_normals(heights: Float[AnyArray, "ny nx"], dx: float, dy: float) -> Float[jax.Array, "ny nx 3"]:
    """Upward normals at the vertices, by area."""
    normals = vertex_normals(heights, dx, dy, "six")
    normals = normals / lax.stop_gradient(jnp.max(jnp.abs(normals), -1, keepdims=True))  # whose squares are numbers
    return normals / jnp.linalg.norm(normals, axis=-1, keepdims=True)
