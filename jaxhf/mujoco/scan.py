"""Height scans: the heights of the ground round a robot, at places that move with it."""

import functools
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import Tracer
from jaxtyping import Float

from ..core.autodiff import with_tangent
from ..core.errors import ArgumentError, require_kind
from ..core.ray import Ray
from ..core.rules import OneOf, require
from ..core.types import FINITE, POSITIVE, Point2, Scalar, Vector
from ..trace.hit import Status
from ..trace.triangle import plane_through
from ..trace.walk import WalkResult
from ..xla.compilation import compiled
from ..xla.devices import takes_numbers
from ..xla.materialise import materialise
from .geoms import Geoms
from .hfield import HField, as_numbers, known_numbers, number_pair
from .pose import Quaternion, pose, rotation, yaw
from .ray import first_met, reach
from .solid import base_faces, column, ground_of
from .surface import Scan, in_frame, meet_hfield, nearest, one_axis, triangle_heights

Align = Literal["yaw", "base", "world"]


def grid_pattern(size: tuple[float, float] = (1.6, 1.0), resolution: float = 0.1) -> Float[np.ndarray, "n 2"]:
    """Places (x, y) on a grid about the origin, x fastest, as Isaac Lab's `GridPatternCfg` has them: 17 x 11 by default.

    Args:
      size: extent in x (ahead) and in y, which the grid reaches on both sides where it is a multiple of the resolution.
      resolution: from place to place.

    Raises:
      ValueError: an extent is negative, or the resolution not positive.
    """
    sides = number_pair("grid_pattern", "size", size)
    if min(sides) < 0:
        raise ArgumentError("grid_pattern", "size", f"must not be negative, it is {size!r}")
    require("grid_pattern", "resolution", float(resolution), POSITIVE)
    x, y = (np.arange(-length / 2, length / 2 + 1e-9, resolution) for length in sides)
    return np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)


@takes_numbers
def height_scan(
    geoms: HField | Geoms,
    pos: Any,
    quat: Any,
    pattern: Any = None,
    *,
    offset: Any = 20.0,
    align: str = "yaw",
    max_range: Any = None,
) -> Scan:
    """What rays meet that start above each place of a pattern, which moves and turns with a robot, and go down.

    Straight down over a height field that is upright (see `HField`) there is nothing to search: the triangle is looked up, by
    the rules of the walk where a place lies between two. On CPUs places and distances inside of a triangle have the walk's very
    bits (normals agree to a rounding); within a program that a caller's own `jit` compiles, XLA may round them elsewhere.
    Differentiable in all numbers of the height fields, the robots and the pattern. Beyond arguments
    and results a look-up needs about 60 bytes a ray, in single precision.

    Args:
      geoms: a height field, or a batch of them; or several geoms.
      pos, quat: the robots' positions and orientations (w, x, y, z), shapes (..., 3) and (..., 4). For a batch they begin with
        its axes: each has robots of its own.
      pattern: places (n, 2) in the robot's frame; None: `grid_pattern()`.
      offset: how far above the robot rays start; rays that start below the surface meet the base from within.
      align: yaw: the pattern follows the robot's heading, and rays go straight down; base: the pattern and the rays are
        tilted with the robot; world: neither turns.
      max_range: how far rays reach from where they start; None: without end.

    Returns:
      A `Scan` with the axes (..., n).

    Raises:
      ValueError: shapes that do not fit, an unknown `align`, an `offset` that is not finite, a range that is not positive.
    """
    owner = "height_scan"
    pos, quat, places = on_sensors(owner, geoms, pos, quat, grid_pattern() if pattern is None else pattern, 2)
    require(owner, "align", align, OneOf(Align))
    offset = known_numbers(owner, "offset", offset, FINITE)
    starts = _starts(pos, quat, jnp.asarray(offset, pos.dtype), align=align)
    if align != "base" and isinstance(geoms, HField) and geoms.upright and max_range is None and pos.size:
        return _look_up(geoms, starts, places)
    o, d = _rays(starts, places)

    def met(field: HField) -> Scan:
        return _look_up(field, starts, places) if align != "base" and field.upright else meet_hfield(field, o, d)

    return first_met(geoms, o, d, reach(owner, max_range), met)


def on_sensors(
    owner: str, geoms: HField | Geoms, pos: Any, quat: Any, pattern: Any, columns: int
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Positions (..., 3) and orientations (..., 4) of robots or sensors, which begin with the axes of the geoms' batch, and the
    pattern (n, columns), checked and in the precision of the geoms."""
    require_kind(owner, "geoms", geoms, HField | Geoms, "a jaxhf.mujoco.HField or Geoms")
    given, dtype, batch = quat, geoms.dtype, geoms.batch
    pos, quat = as_numbers(owner, "pos", pos, dtype), as_numbers(owner, "quat", quat, dtype)
    if not isinstance(given, jax.Array) and not isinstance(quat, Tracer) and not np.any(given, axis=-1).all():
        raise ArgumentError(owner, "quat", "must not be zero, one is (0, 0, 0, 0)")
    for name, value, length in (("pos", pos, 3), ("quat", quat, 4)):
        if value.shape != (*pos.shape[:-1], length) or value.shape[: len(batch)] != batch or value.ndim <= len(batch):
            fits = name == "quat" and pos.ndim > len(batch)
            wanted = ", ".join(map(str, (*pos.shape[:-1], length) if fits else (*batch, "...", length)))
            raise ArgumentError(owner, name, f"must have shape ({wanted}), pos and quat alike, its shape is {value.shape}")
    places = as_numbers(owner, "pattern", pattern, dtype)
    if places.ndim != 2 or places.shape[1] != columns:
        raise ArgumentError(owner, "pattern", f"must have shape (n, {columns}), its shape is {places.shape}")
    return pos, quat, places


@functools.partial(compiled, static_argnames=("align",))
def _starts(pos: jax.Array, quat: jax.Array, offset: Scalar, align: str) -> "_Start":
    def one(pos: Vector, quat: Quaternion) -> _Start:
        x, y, z = jnp.eye(3, dtype=pos.dtype) if align == "world" else rotation(yaw(quat) if align == "yaw" else quat).T
        return _Start(pos + offset * z, x, y, -z)

    starts = jax.vmap(one)(pos.reshape(-1, 3), quat.reshape(-1, 4))
    return jax.tree.map(lambda leaf: leaf.reshape(pos.shape), starts)


@compiled
def _rays(starts: "_Start", places: Float[jax.Array, "n 2"]) -> tuple[jax.Array, jax.Array]:
    """Origins and directions, with the places as a further axis."""
    o, along_x, along_y, d = (leaf[..., None, :] for leaf in jax.tree.leaves(starts))
    x, y = (jnp.broadcast_to(places[:, k : k + 1], (*o.shape[:-2], len(places), 1)) for k in (0, 1))
    o = o + x * along_x + y * along_y
    return o, jnp.broadcast_to(d, o.shape)


@functools.partial(compiled, newer=True)
def _look_up(hfields: HField, starts: "_Start", places: Float[jax.Array, "n 2"]) -> Scan:
    axes, fields = starts.o.shape[:-1], one_axis(hfields)
    starts = jax.tree.map(lambda leaf: leaf.reshape(len(fields.data), -1, 3), starts)
    each = jax.vmap(jax.vmap(jax.vmap(_under, (None, None, 0)), (None, 0, None)), (0, 0, None))
    return jax.tree.map(lambda leaf: leaf.reshape(*axes, *leaf.shape[2:]), each(fields, starts, places))


class _Start(eqx.Module):
    """Where a robot's rays start, for the place (x, y) at o + x along_x + y along_y, and their direction; of one or several."""

    o: Float[jax.Array, "*robots 3"]
    along_x: Float[jax.Array, "*robots 3"]
    along_y: Float[jax.Array, "*robots 3"]
    d: Float[jax.Array, "*robots 3"]


def _under(hfield: HField, start: _Start, place: Point2) -> Scan:
    """What the ray straight down from one place meets, without a search, by the rules of the walk and of the solid.

    It is over the footprint all along, and no wall stands in its way. Where it is over the border of two triangles, the
    triangle is the walk's. Values are the walk's operation by operation, but for factors that are 0 or 1 where all stands
    upright; numbers stand alone, as arrays of three would have XLA compute each fused value three times. Derivatives are those
    of a ray whose triangle was searched.
    """
    field, begin, (nrow, ncol) = lax.stop_gradient((hfield, start, hfield.data.shape))
    frame, size, ready = pose(field.pos, field.quat), field.size, ground_of(field)
    turn, place_x, place_y = frame.linear, lax.stop_gradient(place[0]), lax.stop_gradient(place[1])
    away = [begin.o[k] + place_x * begin.along_x[k] + place_y * begin.along_y[k] - frame.offset[k] for k in range(3)]
    o = [turn[0, k] * away[0] + turn[1, k] * away[1] for k in (0, 1)]
    x, y, z = (o[0] / size[0] + 1) * ((ncol - 1) / 2), (o[1] / size[1] + 1) * ((nrow - 1) / 2), away[2] / size[2]
    ix = jnp.clip(jnp.floor(x).astype(jnp.int32), 0, ncol - 2)
    iy = jnp.clip(jnp.ceil(y).astype(jnp.int32) - 1, 0, nrow - 2)
    z = materialise(z)  # else XLA draws two divisions into one, which rounds elsewhere than the walk
    u, v = x - ix.astype(x.dtype), y - iy.astype(y.dtype)
    upper = v > u
    a, b, c = plane_through(triangle_heights(ready, ix, iy, upper), upper)
    level = c + a * u + b * v
    inside = (jnp.abs(o[0]) <= size[0]) & (jnp.abs(o[1]) <= size[1])
    on_base, valid = inside & (away[2] >= 0), inside & (away[2] >= -size[3])
    down = jnp.full_like(z, -1)
    # The slope's zero keeps XLA from turning a / (b / c) into a c / b, for the same reason.
    to_surface, bottom = (level - z) / (down / size[2] - a * 0), jnp.where(on_base, 0, -size[3])
    to_below = (bottom - away[2]) / down
    on_surface = inside & (z > level) & (to_surface < jnp.where(valid, to_below, jnp.inf))
    valid = valid | on_surface
    t = jnp.where(on_surface, to_surface, jnp.where(valid, to_below, 0))
    p = [turn[k, 0] * o[0] + turn[k, 1] * o[1] + frame.offset[k] for k in (0, 1)]
    p.append(jnp.where(on_surface, level * size[2], away[2] - t) + frame.offset[2])
    rise_x, rise_y = a * size[2] * ((ncol - 1) / 2) / size[0], b * size[2] * ((nrow - 1) / 2) / size[1]
    up = 1 / jnp.sqrt(1 + rise_x * rise_x + rise_y * rise_y)
    flat = jnp.where(on_base, 1, jnp.where(valid, -1, 0)).astype(t.dtype)
    n = [jnp.where(on_surface, part, of) for part, of in ((-rise_x * up, 0), (-rise_y * up, 0), (up, flat))]
    p[2], t, n = materialise((p[2], t, n))
    n = [turn[0, 0] * n[0] + turn[0, 1] * n[1], turn[1, 0] * n[0] + turn[1, 1] * n[1], n[2]]
    value = Scan(jnp.stack(p), jnp.stack(n), jnp.where(valid, t, -1), valid)

    status = jnp.where(on_surface, int(Status.HIT), int(Status.MISS)).astype(jnp.int32)
    zero = jnp.zeros_like(x)
    found = WalkResult(status, ix, iy, upper, jnp.ones_like(ix), zero, zero, None)
    frame, ready = pose(hfield.pos, hfield.quat), ground_of(hfield)
    local = in_frame(frame, Ray(start.o + place[0] * start.along_x + place[1] * start.along_y, start.d))
    met = nearest(ready, local, frame, found, base_faces(ready, local, column(ready, local)))
    return Scan(with_tangent(value.p, met.p), with_tangent(value.n, met.n), with_tangent(value.dist, met.dist), valid)
