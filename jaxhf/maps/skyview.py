"""How high the terrain stands round each of its points, and how much of the sky it leaves to see."""

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
from ..core.rules import OneOf, Whole, require
from ..preparation.horizon import (
    HorizonView,
    Summary,
    assemble,
    cell_directions,
    even_azimuths,
    over_horizon,
    over_tiles,
    tile_count,
)
from ..preparation.sky import sky_vector
from ..scene.heightfield import Heightfield
from ..trace.normals import vertex_normals
from ..xla.compilation import compiled, is_traced
from ..xla.devices import chosen_mesh, on_every_device, takes_numbers
from .choices import WEIGHTINGS
from .surface import with_spacing


@takes_numbers
def horizon(
    terrain: Any,
    azimuths: Any = 32,
    *,
    dx: float | None = None,
    dy: float | None = None,
    lowest: float = 0.0,
    progress: Callable[[int, int], None] | None = None,
    mesh: Mesh | None = None,
) -> Float[jax.Array, "k ny nx"]:
    """The horizon angle at each vertex, in degrees: how high the terrain rises above the horizontal in a direction.

    Exact on the surface that is rendered, two triangles to a cell, to the end of the terrain: there is no search radius. The
    earth's curvature does not count. Differentiable in the heights: the angle moves with the point that makes the horizon.

    Args:
      terrain: a `Terrain` (degrees count as metres, see `load_heights`), a `Heightfield`, or heights, shape (ny, nx), row 0 in
        the south, nan where there is none.
      azimuths: degrees clockwise from north (y), shape (k,); or how many, from north on at even steps.
      dx, dy: cell size, in the unit of the heights. An array must have one, which counts for both; None: a terrain's own.
      lowest: the angle where nothing stands higher, degrees: 0, the horizontal; -90 shows terrain that falls away, and
        stays where there is none.
      progress: called with (vertices done, vertices in all) as the map grows; not within `jit`, `grad`, `vmap` and the like.
      mesh: the devices that share the work, see `render`.

    Returns:
      Degrees, shape (k, ny, nx); nan where there is no height.

    Raises:
      ValueError: an argument has a value that it cannot have.
    """
    field = _field("horizon", terrain, dx, dy)
    if np.ndim(azimuths) == 0:
        require("horizon", "azimuths", azimuths, Whole(1))
        azimuths = even_azimuths(int(azimuths))
    azimuths = np.asarray(azimuths, np.float64)
    if azimuths.ndim != 1 or not azimuths.size or not np.isfinite(azimuths).all():
        raise ArgumentError("horizon", "azimuths", f"must be a whole number or a list of finite numbers, they are {azimuths}")
    if not -90 <= lowest < 90:
        raise ArgumentError("horizon", "lowest", f"must be from -90 to below 90 degrees, it is {lowest}")
    return _mapped(
        "horizon", "degrees", field, azimuths, -np.inf if lowest == -90 else np.tan(np.deg2rad(lowest)), progress, mesh
    )


@takes_numbers
def sky_view(
    terrain: Any,
    azimuths: int = 32,
    *,
    weighting: str = "solid-angle",
    dx: float | None = None,
    dy: float | None = None,
    progress: Callable[[int, int], None] | None = None,
    mesh: Mesh | None = None,
) -> Float[jax.Array, "ny nx"]:
    """The sky-view factor at each vertex: the share of the sky that the terrain leaves to see, 0 to 1.

    From horizon angles h at least 0, exact and without a search radius as `horizon` has them, by `weighting`:

    - "solid-angle": the mean over azimuths of 1 - sin h, the share of the upper hemisphere (Zakšek, Oštir and Kokalj,
      Sky-view factor as a relief visualization technique, Remote Sensing 3(2), 2011, equation 3).
    - "horizontal": the mean of cos² h, the share of an even sky's light that a horizontal surface receives.
    - "slope": that of the surface as it is tilted (Dozier and Frew, Rapid calculation of terrain parameters for radiation
      modeling from digital elevation data, IEEE Transactions on Geoscience and Remote Sensing 28(5), 1990, equation 7b). Its
      normal is that of `vertex_normals`. A plane of slope S without other terrain has (1 + cos S) / 2.

    Args:
      azimuths: how many directions, from north on at even steps.
      terrain, dx, dy, progress, mesh: as for `horizon`, whose errors it has, too.

    Returns:
      Shape (ny, nx), nan where there is no height; differentiable in the heights.
    """
    field = _field("sky_view", terrain, dx, dy)
    require("sky_view", "weighting", weighting, OneOf(WEIGHTINGS))
    require("sky_view", "azimuths", azimuths, Whole(1))
    found = _mapped("sky_view", weighting, field, even_azimuths(int(azimuths)), 0.0, progress, mesh)
    if weighting != "slope":
        return found
    normals = vertex_normals(jnp.asarray(field.heights), field.dx, field.dy, "six")
    normals = normals / lax.stop_gradient(jnp.max(jnp.abs(normals), -1, keepdims=True))  # whose squares are numbers
    received = jnp.sum(jnp.moveaxis(found, 0, -1) * normals, -1) / jnp.linalg.norm(normals, axis=-1)
    return jnp.maximum(received, 0)


_PARTS = 64  # of a map that reports its progress
_ROOM = 4  # heights and horizontal distances are divided by it, so that differences of heights stay numbers
_SUMMARIES: dict[str, Summary] = {
    "degrees": lambda slopes: jnp.rad2deg(jnp.arctan(slopes)),
    "solid-angle": lambda slopes: jnp.mean(1 - slopes * lax.rsqrt(1 + slopes * slopes), 0),
    "horizontal": lambda slopes: jnp.mean(1 / (1 + slopes * slopes), 0),
    "slope": sky_vector,
}


def _mapped(
    owner: str,
    summary: str,
    field: Heightfield,
    azimuths: np.ndarray,
    lowest: float,
    progress: Callable[[int, int], None] | None,
    mesh: Mesh | None,
) -> jax.Array:
    require_progress(owner, progress, is_traced())
    dtype, mesh = field.heights.dtype, chosen_mesh(owner, mesh, field)
    directions = _ROOM * cell_directions(azimuths, field.dx, field.dy, dtype)
    heights, directions = on_every_device((field.heights, directions), mesh)
    if progress is None:
        return _over(summary, mesh, heights, directions, np.asarray(lowest, dtype))
    count, parts = tile_count(heights.shape), []
    size = mesh.size * math.ceil(count / mesh.size / _PARTS)
    view = _view(heights, directions)
    for first in range(0, count, size):
        numbers = np.minimum(np.arange(first, first + size, dtype=np.int32), count - 1)
        parts.append(jax.device_get(_over_tiles(summary, mesh, view, np.asarray(lowest, dtype), numbers)))
        progress(heights.size * min(count, first + size) // count, heights.size)
    found = assemble(np.concatenate(parts)[:count], heights.shape)
    return jnp.asarray(np.where(np.isfinite(heights), found, np.asarray(np.nan, dtype)))


@functools.partial(compiled, newer=True, static_argnames=("summary", "mesh"))
def _over(summary: str, mesh: Mesh, heights: jax.Array, directions: jax.Array, lowest: jax.Array) -> jax.Array:
    return over_horizon(_SUMMARIES[summary], mesh, _holed(heights), directions, lowest)


@functools.partial(compiled, newer=True)
def _view(heights: jax.Array, directions: jax.Array) -> HorizonView:
    return HorizonView.of(_holed(heights), directions)


@functools.partial(compiled, newer=True, static_argnames=("summary", "mesh"))
def _over_tiles(summary: str, mesh: Mesh, view: HorizonView, lowest: jax.Array, numbers: jax.Array) -> jax.Array:
    return over_tiles(_SUMMARIES[summary], mesh, view, lowest, numbers)[0]


def _holed(heights: jax.Array) -> jax.Array:
    return jnp.where(jnp.isfinite(heights), heights / _ROOM, jnp.nan)


def _field(owner: str, terrain: Any, dx: float | None, dy: float | None) -> Heightfield:
    if not isinstance(terrain, Heightfield):
        return Heightfield(*with_spacing(owner, terrain, dx, dy))
    for name, value in (("dx", dx), ("dy", dy)):
        if value is not None:
            raise ArgumentError(owner, name, "must stand without a Heightfield, which has its own cell size")
    return terrain
