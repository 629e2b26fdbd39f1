"""Rays among MuJoCo's geoms, as `mj_ray` has them."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Bool, Float, Int

from ..core.errors import ArgumentError, require_kind
from ..core.types import POSITIVE, AnyArray, Scalar
from ..xla.compilation import compiled
from ..xla.devices import takes_numbers
from .geoms import Geoms
from .hfield import HField, as_numbers, known_numbers
from .primitives import meet_primitives
from .surface import Scan, meet_hfield


@takes_numbers
def ray(geoms: HField | Geoms, pnt: Any, vec: Any, *, max_range: Any = None) -> Scan:
    """What rays pnt + x vec, x >= 0, meet first; `dist` is x, in units of |vec|.

    What `mujoco.mj_ray` returns: -1 and a zero normal for a ray that meets nothing. A plane is met from above alone, other
    geoms from within too. A ray that starts below the surface of a height field meets the base and the walls from within; the
    normal is the triangle's own, upwards, or points out of the solid, from whichever side the ray came. Unlike there no ray
    slips through between two triangles or two walls; one that starts on a height field's surface, to the last bit, leaves it;
    one that touches a round primitive in one point passes it; and a `vec` that is zero or not finite meets nothing. Results
    are differentiable in all numbers of the geoms and of the rays; at a miss the derivative is zero.

    Args:
      geoms: a height field, or a batch of them; or several geoms.
      pnt, vec: origins and directions, world frame, shapes (..., 3), broadcast against each other. For a batch they begin with
        its axes: each has rays of its own.
      max_range: how far rays reach, in units of length; None: without end.

    Returns:
      A `Scan` with the axes of the rays.

    Raises:
      ValueError: `pnt` or `vec` does not end in an axis of length 3, or does not begin with the axes of the batch; a range
        that is not positive.
    """
    require_kind("ray", "geoms", geoms, HField | Geoms, "a jaxhf.mujoco.HField or Geoms")
    dtype = geoms.dtype
    pnt, vec = as_numbers("ray", "pnt", pnt, dtype), as_numbers("ray", "vec", vec, dtype)
    for name, value in (("pnt", pnt), ("vec", vec)):
        if value.shape[-1:] != (3,):
            raise ArgumentError("ray", name, f"must have shape (..., 3), its shape is {value.shape}")
    try:
        shape = np.broadcast_shapes(pnt.shape, vec.shape)
    except ValueError as error:
        raise ArgumentError("ray", "vec", f"must fit pnt of shape {pnt.shape}, its shape is {vec.shape}") from error
    if shape[: len(geoms.batch)] != geoms.batch or len(shape) <= len(geoms.batch):
        rule = f"must begin with the axes {geoms.batch} of the geoms, the rays have shape {shape}"
        raise ArgumentError("ray", "pnt", rule)
    return first_met(geoms, jnp.broadcast_to(pnt, shape), jnp.broadcast_to(vec, shape), reach("ray", max_range))


def reach(owner: str, max_range: Any) -> Any:
    """A range that is known to be positive or is traced, or None."""
    return None if max_range is None else known_numbers(owner, "max_range", max_range, POSITIVE)


def first_met(
    geoms: HField | Geoms,
    o: Float[jax.Array, "*rays 3"],
    d: Float[jax.Array, "*rays 3"],
    max_range: Any = None,
    of_field: Callable[[HField], Scan] | None = None,
) -> Scan:
    """What rays in the world's frame meet first, see `ray`; their axes are those of the batch, and any others behind them.

    `of_field` is what these rays meet of one height field, where that can be told without a search of each.
    """
    of_field = of_field or (lambda field: meet_hfield(field, o, d))
    if o.size == 0:  # as of a batch of none
        whole = jnp.zeros(o.shape[:-1], jnp.int32)
        return Scan(o, o, o[..., 0], whole > 0, None if isinstance(geoms, HField) else whole)
    if isinstance(geoms, HField):
        scan = of_field(geoms)
    else:
        parts = [of_field(field) for field in geoms.hfields]
        ids = np.array(geoms.ids, np.int32)
        if geoms.kinds:
            size, pos, quat = (jnp.asarray(leaf, geoms.dtype) for leaf in (geoms.size, geoms.pos, geoms.quat))
            parts.append(meet_primitives(size, pos, quat, ids[len(geoms.hfields) :], o, d, kinds=geoms.kinds))
        scan = _nearest_scan(tuple(parts), ids[: len(geoms.hfields)], o)
    return scan if max_range is None else _reached(scan, o, d, jnp.asarray(max_range, o.dtype))


@compiled
def _nearest_scan(parts: tuple[Scan, ...], ids: Int[AnyArray, " fields"], o: Float[jax.Array, "*rays 3"]) -> Scan:
    """The nearest of what rays from `o` met of the height fields, whose numbers are `ids`, and of the primitives."""
    numbered = [
        dataclasses.replace(part, geom=jnp.where(part.mask, jnp.asarray(ids)[k], -1)) if part.geom is None else part
        for k, part in enumerate(parts)
    ]

    def nearer(best: Scan, part: Scan) -> Scan:
        return _chosen(part.mask & (~best.mask | (part.dist < best.dist)), part, best)

    best = functools.reduce(nearer, numbered)
    return dataclasses.replace(best, p=jnp.where(best.mask[..., None], best.p, o))


@compiled
def _reached(scan: Scan, o: jax.Array, d: jax.Array, max_range: Scalar) -> Scan:
    near = scan.mask & (scan.dist * lengths(d) <= max_range)
    nothing = jax.tree.map(lambda leaf: jnp.full_like(leaf, -1), scan)
    nothing = dataclasses.replace(nothing, p=jnp.broadcast_to(o, scan.p.shape), n=0 * scan.n, mask=jnp.zeros_like(scan.mask))
    return _chosen(near, scan, nothing)


def lengths(d: Float[jax.Array, "*rays 3"]) -> Float[jax.Array, "*rays"]:
    """Of directions, without a derivative; they neither over- nor underflow."""
    d = lax.stop_gradient(d)
    largest = jnp.max(jnp.abs(d), axis=-1, keepdims=True)
    largest = jnp.where((largest > 0) & jnp.isfinite(largest), largest, 1)
    return jnp.linalg.norm(d / largest, axis=-1) * largest[..., 0]


def _chosen(first: Bool[jax.Array, "*rays"], one: Scan, other: Scan) -> Scan:
    def chosen(a: jax.Array, b: jax.Array) -> jax.Array:
        return jnp.where(first.reshape(*first.shape, *(1,) * (a.ndim - first.ndim)), a, b)

    return jax.tree.map(chosen, one, other)
