"""Rays of the caller's own, on one heightfield or through a camera."""

import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..core.compilation import compiled
from ..core.errors import ArgumentError, UserError, require_kind
from ..core.ray import Ray
from ..core.settings import Settings
from ..core.types import float_leaf
from ..scene.heightfield import Heightfield
from ..scene.localise import anchor, localise
from ..scene.scene import Scene
from ..trace.grid import Grid
from ..trace.hit import Hit
from ..trace.intersect import intersect, leave
from ..trace.world import first_hit, make_surface, make_world
from .chunks import trace_chunks


def cast_camera(scene: Scene, x: Float[np.ndarray, " n"], y: Float[np.ndarray, " n"], settings: Settings | None = None) -> Hit:
    """The first hits of the camera's rays through the points (x, y) of the picture, in pixels from its top left corner.

    Returns:
      A `Hit` whose leaves have a leading axis n, with `p` in the world's frame.
    """
    local = localise(scene)
    dtype = local.camera.world_from_camera.dtype
    hit = _cast_camera(local, jnp.asarray(x, dtype), jnp.asarray(y, dtype), settings or Settings())
    return _moved(hit, anchor(scene))


@functools.partial(compiled, static_argnames=("settings",))
def _cast_camera(scene: Scene, x: jax.Array, y: jax.Array, settings: Settings) -> Hit:
    world = make_world(scene, settings)

    def one(x: jax.Array, y: jax.Array) -> Hit:
        return first_hit(world, scene.camera.ray(x, y))

    return jax.vmap(one)(x, y)


def cast(heightfield: Heightfield, o: Any, d: Any, settings: Settings | None = None, *, leaving: Hit | None = None) -> Hit:
    """Where rays meet a heightfield; differentiable in the heights, in `o`, in `d` and in `leaving`.

    Args:
      heightfield: the surface, in the frame of the rays.
      o, d: origins and directions, shape (..., 3) each, broadcast against each other; a direction need not be unit. NumPy
        and Python numbers keep double precision until the grid's x0 and y0 have been subtracted.
      settings: max_steps, shading, normals and chunk count here.
      leaving: for rays that start on the surface: hits of an earlier `cast` on the same heightfield, whose leading axes are
        broadcast against those of `d`; `o` must then be None. A ray leaves on the side of its triangle to which `d` points
        and cannot meet that triangle again, so that no offset by an epsilon is needed.

    Returns:
      A `Hit` with the same leading axes. A ray that is zero or not finite, or that leaves what is no hit, has the status
      INVALID.

    Raises:
      ValueError: `o` or `d` does not end in an axis of length 3, or not exactly one of `o` and `leaving` is None.
    """
    if not all(hasattr(heightfield, name) for name in ("heights", "dx", "dy", "x0", "y0")):
        hint = "a scene has .heightfields" if isinstance(heightfield, Scene) else "jaxhf.Heightfield(heights, dx, dy) makes one"
        require_kind("cast", "heightfield", heightfield, Heightfield, "a jaxhf.Heightfield", hint)
    require_kind("cast", "settings", settings or Settings(), Settings, "a jaxhf.Settings")
    if leaving is not None:
        require_kind("cast", "leaving", leaving, Hit, "the Hit that an earlier cast returned")
    dtype = heightfield.heights.dtype
    corner = np.array([heightfield.x0, heightfield.y0, 0.0])
    if (o is None) == (leaving is None):
        raise UserError("cast: rays start at o or at the hits that they are leaving, and one of the two must be None")
    for name, value in (("o", o), ("d", d)):
        shape = () if value is None else np.shape(value)
        if (value is not None or name == "d") and shape[-1:] != (3,):
            raise ArgumentError("cast", name, f"must have shape (..., 3), its shape is {shape}")
    if leaving is not None:
        start, axes = leaving, leaving.t.ndim
    elif isinstance(o, jax.Array):
        o = float_leaf(o)
        start, axes = jnp.asarray(o - jnp.broadcast_to(jnp.asarray(corner, o.dtype), o.shape), dtype), o.ndim - 1
    else:
        start, axes = jnp.asarray(np.asarray(o, np.float64) - corner, dtype), np.ndim(o) - 1
    d = jnp.asarray(d, dtype)
    starting = jax.tree.leaves(start)[0].shape[:axes]
    try:
        batch = np.broadcast_shapes(starting, d.shape[:-1])
    except ValueError as error:
        raise ArgumentError(
            "cast", "d", f"must fit the {starting} rays that start, its leading axes are {d.shape[:-1]}"
        ) from error

    def in_a_row(leaf: jax.Array, tail: tuple[int, ...]) -> jax.Array:
        return jnp.broadcast_to(leaf, (*batch, *tail)).reshape(-1, *tail)

    starts = jax.tree.map(lambda leaf: in_a_row(leaf, leaf.shape[axes:]), start)
    field = Heightfield(heightfield.heights, heightfield.dx, heightfield.dy)
    hit = _cast(field, starts, in_a_row(d, (3,)), settings or Settings())
    return jax.tree.map(lambda leaf: leaf.reshape(*batch, *leaf.shape[1:]), _moved(hit, corner))


def _moved(hit: Hit, offset: Float[np.ndarray, "3"]) -> Hit:
    """Hits with a leading axis, their points moved by `offset`."""
    return eqx.tree_at(lambda hit: hit.p, hit, hit.p + jnp.broadcast_to(jnp.asarray(offset, hit.p.dtype), hit.p.shape))


@functools.partial(compiled, static_argnames=("settings",))
def _cast(heightfield: Heightfield, start: jax.Array | Hit, d: Float[jax.Array, "n 3"], settings: Settings) -> Hit:
    """Rays from points (n, 3), or from hits with a leading axis n; chunk after chunk of one fixed size."""
    surface = make_surface(heightfield, None, settings)
    assert isinstance(surface, Grid)

    def one(rays: tuple[jax.Array | Hit, jax.Array]) -> Hit:
        start, d = rays
        ray, leaving = leave(surface, 0, start, d) if isinstance(start, Hit) else (Ray(start, d), None)
        return intersect(surface, 0, ray, max_steps=settings.max_steps, leaving=leaving)

    return trace_chunks(one, (start, d), settings.chunk)
