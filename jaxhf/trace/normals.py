"""Normals at the vertices of a heightfield."""

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Float

from ..core.settings import NormalScheme
from ..core.types import AnyArray, Scalar
from ..core.vector import floor_to_power_of_two, quotient
from ..xla.materialise import materialise

# The triangles round a vertex, counter-clockwise: each is spanned by two neighbouring offsets (ix, iy).
_FANS = {
    "four": ((1, 0), (0, 1), (-1, 0), (0, -1)),
    "six": ((1, 0), (1, 1), (0, 1), (-1, 0), (-1, -1), (0, -1)),
}


def vertex_normals(
    heights: Float[AnyArray, "ny nx"], dx: float | Scalar, dy: float | Scalar, scheme: NormalScheme
) -> Float[jax.Array, "ny nx 3"]:
    """Normals at the vertices, shape (ny, nx, 3), on the +z side; their lengths are the weights of the interpolation.

    "central": central differences, one-sided at the border. "four": the sum of the unit normals of the triangles
    right-up, up-left, left-down, down-right. "six": of the six triangles that touch the vertex, weighted by area, so
    that it commutes with affine maps. "six-equal": the six unit normals with equal weights (Gouraud 1971). "six-angle":
    weighted by the angle at the vertex (Thürmer and Wüthrich 1998), and of length 1, as Mitsuba does. What lies beyond the
    border or touches a hole takes no part, so that but for "six-angle" a vertex there weighs less in the interpolation; one
    with no triangle at all gets (0, 0, 1).

    Args:
      heights: shape (ny, nx), in the unit of `dx` and `dy`; nan is a hole.
      dx, dy: cell size.
      scheme: one of these.
    """
    # Products of two huge heights, or of two tiny cells, are no numbers in single precision. Any unit will do, and a power of
    # two changes no bit.
    largest = jnp.max(jnp.abs(jnp.where(jnp.isfinite(heights), heights, 0))) * 2.0**-61
    if scheme == "central":
        unit = floor_to_power_of_two(jnp.maximum(largest, 1))
        return _central(heights / unit, dx, dy, 1 / unit)
    unit = floor_to_power_of_two(jnp.maximum(jnp.maximum(largest, dx), dy))
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

    return _side_by_side(-slope(1, 0, dx), -slope(0, 1, dy), jnp.full_like(here, up))


def _fan_mean(heights, dx, dy, fan, weight):
    """The components stay apart until the end: arrays whose last axis has length 3 take several times as long."""
    at = _neighbours(heights)
    here, here_present = at(0, 0)
    total_x = total_y = total_z = jnp.zeros_like(here)
    for (ax, ay), (bx, by) in zip(fan, fan[1:] + fan[:1], strict=True):
        (a, a_present), (b, b_present) = at(ax, ay), at(bx, by)
        present = here_present & a_present & b_present
        az, bz = jnp.where(present, a - here, 0), jnp.where(present, b - here, 0)
        x, y = (ay * bz - by * az) * dy, (bx * az - ax * bz) * dx
        z = jnp.where(present, (ax * by - ay * bx) * dx * dy, 0)  # x and y are zero where there is no triangle
        if weight != "area":
            length = _length(x, y, jnp.where(present & (z > 0), z, 1))
            angle = jnp.ones_like(length)
            if weight == "angle":
                angle = jnp.atan2(length, ax * bx * dx * dx + ay * by * dy * dy + az * bz)
            share = materialise(quotient(angle, length))
            x, y, z = x * share, y * share, z * share
        total_x, total_y, total_z = total_x + x, total_y + y, total_z + z
    # Zero, where there is no triangle; or less than any number, beside slopes that are larger than any.
    nothing = (total_x == 0) & (total_y == 0) & (total_z == 0)
    total_z = jnp.where(nothing, 1, total_z)
    if weight == "angle":
        unit = quotient(jnp.ones_like(total_z), _length(total_x, total_y, total_z))
        total_x, total_y, total_z = total_x * unit, total_y * unit, total_z * unit
    return _side_by_side(total_x, total_y, total_z)


def _side_by_side(*components: Float[jax.Array, "ny nx"]) -> Float[jax.Array, "ny nx c"]:
    """Components as the last axis, once they are computed: by XLA's older emitters of loops, which `compiled` asks for, they
    would be number by number, in the order of the result."""
    return jnp.moveaxis(materialise(jnp.stack(components)), 0, -1)


def _length(x, y, z):
    """The length of nonzero vectors, without overflow; any factor does for that, and needs no derivative."""
    largest = lax.stop_gradient(jnp.maximum(jnp.maximum(jnp.abs(x), jnp.abs(y)), jnp.abs(z)))
    x, y, z = x / largest, y / largest, z / largest
    return largest * jnp.sqrt(x * x + y * y + z * z)
