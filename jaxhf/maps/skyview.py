"""How high the terrain stands round each of its points, and how much of the sky it leaves to see."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Float

from ..core.errors import ArgumentError
from ..core.rules import OneOf, Whole, require
from ..preparation.crossings import even_azimuths
from ..xla.devices import takes_numbers
from .choices import WEIGHTINGS
from .horizons import field_of, map_over_horizons, unit_normals
from .surface import rotation_of


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
    field = field_of("horizon", terrain, dx, dy)
    if np.ndim(azimuths) == 0:
        require("horizon", "azimuths", azimuths, Whole(1))
        azimuths = even_azimuths(int(azimuths))
    azimuths = np.asarray(azimuths, np.float64)
    if azimuths.ndim != 1 or not azimuths.size or not np.isfinite(azimuths).all():
        raise ArgumentError("horizon", "azimuths", f"must be a whole number or a list of finite numbers, they are {azimuths}")
    if not -90 <= lowest < 90:
        raise ArgumentError("horizon", "lowest", f"must be from -90 to below 90 degrees, it is {lowest}")
    azimuths = azimuths - rotation_of(terrain)
    return map_over_horizons(
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
      azimuths: how many directions, from the y axis on at even steps.
      terrain, dx, dy, progress, mesh: as for `horizon`, whose errors it has, too.

    Returns:
      Shape (ny, nx), nan where there is no height; differentiable in the heights.
    """
    field = field_of("sky_view", terrain, dx, dy)
    require("sky_view", "weighting", weighting, OneOf(WEIGHTINGS))
    require("sky_view", "azimuths", azimuths, Whole(1))
    found = map_over_horizons("sky_view", weighting, field, even_azimuths(int(azimuths)), 0.0, progress, mesh)
    if weighting != "slope":
        return found
    return jnp.maximum(jnp.sum(found * jnp.moveaxis(unit_normals(jnp.asarray(field.heights), field.dx, field.dy), -1, 0), 0), 0)
