"""Heights on a regular grid, and the normals at its vertices."""

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ._settings import NormalScheme
from ._store import stored
from ._transform import power_of_two
from ._types import AnyArray

# So that a walk's state fits into 32 bits; each side of the grid counts as the next power of two.
MOST_CELLS = 2**28


def _heights(value: Any) -> jax.Array:
    try:
        heights = jnp.asarray(value)
    except TypeError as error:
        whole = ": take its .heights, .dx, .dy, .x0 and .y0" if hasattr(value, "heights") else ""
        raise ValueError(
            f"Heightfield: heights must be an array of numbers, they are a {type(value).__name__}{whole}"
        ) from error
    if jnp.issubdtype(heights.dtype, jnp.integer):
        return heights.astype(jnp.float32)
    if heights.dtype not in (jnp.float32, jnp.float64):
        raise ValueError(f"Heightfield: heights must be float32, float64 or whole numbers, they are {heights.dtype}")
    return heights


class Heightfield(eqx.Module):
    """A surface z = heights over a regular grid, two triangles to a cell, split along (ix, iy)-(ix+1, iy+1).

    Attributes:
      heights: shape (ny, nx), at least 2x2, object units; vertex (ix, iy) stands at x = x0 + ix dx, y = y0 + iy dy. A
        vertex that is nan or infinite is a hole: the cells around it are not there. Their dtype, float32 or float64, is
        the precision of everything that is rendered from them; whole numbers become float32. There are at most 2^28
        cells, where the cells along each side count as the next power of two.
      dx, dy: cell size, object units; one alone counts for both. With neither given the grid spans pbrt's unit square.
      x0, y0: where vertex (0, 0) stands. They are metadata in double precision and never enter single-precision
        arithmetic: an offset of 5e6 costs no accuracy.
    """

    heights: Float[AnyArray, "ny nx"]
    dx: float = eqx.field(static=True)
    dy: float = eqx.field(static=True)
    x0: float = eqx.field(static=True)
    y0: float = eqx.field(static=True)

    def __init__(self, heights: Any, dx: float | None = None, dy: float | None = None, x0: float = 0.0, y0: float = 0.0):
        self.heights = _heights(heights)
        shape = self.heights.shape
        if len(shape) != 2 or min(shape) < 2:
            raise ValueError(f"Heightfield: heights must have shape (ny, nx) of at least 2x2, theirs is {shape}")
        padded = [1 << max(1, (n - 2).bit_length()) for n in shape]
        if math.prod(padded) > MOST_CELLS:
            raise ValueError(
                f"Heightfield: heights must have at most 2**28 cells, each side rounded up to a power of two; "
                f"shape {shape} makes {padded[0]} x {padded[1]}"
            )
        square = dx if dy is None else dy  # one of the two alone counts for both
        self.dx = float(1 / (shape[1] - 1) if square is None else square if dx is None else dx)
        self.dy = float(1 / (shape[0] - 1) if square is None else square if dy is None else dy)
        self.x0, self.y0 = float(x0), float(y0)
        for name in ("dx", "dy"):
            value = getattr(self, name)
            if not 0 < value < math.inf:
                raise ValueError(f"Heightfield: {name} must be positive and finite, it is {value}")
        for name in ("x0", "y0"):
            if not math.isfinite(getattr(self, name)):
                raise ValueError(f"Heightfield: {name} must be finite, it is {getattr(self, name)}")


# The triangles round a vertex, counter-clockwise: each is spanned by two neighbouring offsets (ix, iy).
_FANS = {
    "four": ((1, 0), (0, 1), (-1, 0), (0, -1)),
    "six": ((1, 0), (1, 1), (0, 1), (-1, 0), (-1, -1), (0, -1)),
}


def vertex_normals(
    heights: Float[AnyArray, "ny nx"], dx: float, dy: float, scheme: NormalScheme
) -> Float[jax.Array, "ny nx 3"]:
    """Normals at the vertices, on the +z side, object frame; their lengths are the weights of the interpolation.

    "central": central differences, one-sided at the border. "four": the sum of the unit normals of the triangles
    right-up, up-left, left-down, down-right. "six": of the six triangles that touch the vertex, weighted by area, so
    that it commutes with affine maps (the sum that the seed's pbrt shape takes). "six-equal": the six unit normals with
    equal weights (Gouraud 1971). "six-angle": weighted by the angle at the vertex (Thürmer and Wüthrich 1998), as
    Mitsuba does. What lies beyond the border or touches a hole takes no part, so that a vertex there weighs less in the
    interpolation; one with no triangle at all gets (0, 0, 1).
    """
    # Products of two huge heights would be larger than any number in single precision. Any unit will do, and a power of two
    # changes no bit.
    largest = jnp.max(jnp.abs(jnp.where(jnp.isfinite(heights), heights, 0)))
    unit = power_of_two(jnp.maximum(largest * 2.0**-61, 1))
    if scheme == "central":
        return _central(heights / unit, dx, dy, 1 / unit)
    weight = {"six": "area", "six-angle": "angle"}.get(scheme, "equal")
    return _fan_mean(heights / unit, dx / unit, dy / unit, _FANS[scheme.split("-")[0]], weight)


def _neighbours(heights):
    """Maps an offset (ix, iy) to each vertex's neighbour there, and whether there is one; holes have height 0."""
    present = jnp.pad(jnp.isfinite(heights), 1)
    padded = jnp.pad(jnp.where(jnp.isfinite(heights), heights, 0), 1)
    ny, nx = heights.shape

    def at(ix, iy):
        window = np.s_[1 + iy : 1 + iy + ny, 1 + ix : 1 + ix + nx]
        return padded[window], present[window]

    return at


def _central(heights, dx, dy, up):
    """With `up` for the vertical component."""
    at = _neighbours(heights)
    here, here_present = at(0, 0)

    def slope(ix, iy, step):
        ahead, ahead_present = at(ix, iy)
        behind, behind_present = at(-ix, -iy)
        ahead = jnp.where(ahead_present & here_present, ahead, here)
        behind = jnp.where(behind_present & here_present, behind, here)
        steps = (ahead_present & here_present).astype(here.dtype) + (behind_present & here_present).astype(here.dtype)
        return (ahead - behind) / (jnp.maximum(steps, 1) * step)

    return jnp.stack([-slope(1, 0, dx), -slope(0, 1, dy), jnp.full_like(here, up)], axis=-1)


def _fan_mean(heights, dx, dy, fan, weight):
    """The components stay apart until the end: arrays whose last axis has length 3 take several times as long."""
    at = _neighbours(heights)
    here, here_present = at(0, 0)
    total_x = total_y = total_z = jnp.zeros_like(here)
    sure = jnp.sum(here_present, dtype=jnp.int32) >= 0
    for (ax, ay), (bx, by) in zip(fan, fan[1:] + fan[:1], strict=True):
        (a, a_present), (b, b_present) = at(ax, ay), at(bx, by)
        present = here_present & a_present & b_present
        az, bz = jnp.where(present, a - here, 0), jnp.where(present, b - here, 0)
        x, y = (ay * bz - by * az) * dy, (bx * az - ax * bz) * dx
        z = jnp.where(present, (ax * by - ay * bx) * dx * dy, 0)  # x and y are zero where there is no triangle
        if weight != "area":
            length = _length(x, y, jnp.where(present & (z > 0), z, 1))
            share = 1 / length
            if weight == "angle":
                share = share * jnp.atan2(length, ax * bx * dx * dx + ay * by * dy * dy + az * bz)
            share = stored(share, sure)
            x, y, z = x * share, y * share, z * share
        total_x, total_y, total_z = total_x + x, total_y + y, total_z + z
    # Zero, where there is no triangle; or less than any number, beside slopes that are larger than any.
    nothing = (total_x == 0) & (total_y == 0) & (total_z == 0)
    return jnp.stack([total_x, total_y, jnp.where(nothing, 1, total_z)], axis=-1)


def _length(x, y, z):
    """The length of nonzero vectors, without overflow."""
    largest = jnp.maximum(jnp.maximum(jnp.abs(x), jnp.abs(y)), jnp.abs(z))
    x, y, z = x / largest, y / largest, z / largest
    return largest * jnp.sqrt(x * x + y * y + z * z)
