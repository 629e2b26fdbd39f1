"""Rays of the caller's own, on heightfields, into a scene or through a camera."""

import functools
import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..core.errors import ArgumentError, UserError, require_kind
from ..core.precision import numbers
from ..core.ray import Ray
from ..core.settings import Settings
from ..core.types import array_leaf, float_leaf
from ..preparation.any_size import of_any_terrain
from ..preparation.localise import anchor, localise, precision
from ..preparation.world import World, first_hit, make_world, resolve_settings
from ..scene.heightfield import Heightfield
from ..scene.scene import Scene
from ..trace.grid import Grid, joined, make_grid
from ..trace.hit import Hit
from ..trace.intersect import intersect, leave
from ..xla.compilation import compiled
from ..xla.devices import prepared_mesh, takes_numbers, where_called
from .chunks import trace_batch, trace_chunks
from .render import Prepared, PreparedHeightfield, prepared_world

_Traced = Grid | World


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
        ray = scene.camera.ray(x, y)
        hit = first_hit(world, ray)
        return hit if ray.before is None else eqx.tree_at(lambda hit: hit.t, hit, hit.t + ray.before)

    return jax.vmap(one)(x, y)


@takes_numbers
def cast(
    surface: Heightfield | Scene | Prepared | PreparedHeightfield,
    o: Any,
    d: Any,
    settings: Settings | None = None,
    *,
    leaving: Hit | None = None,
) -> Hit:
    """Where rays first meet a heightfield or a scene; differentiable in the heights, in `o`, in `d` and in `leaving`.

    Args:
      surface: a heightfield in the frame of the rays; a scene, of which all objects count; or what `prepare` made of either,
        for which nothing is prepared again. Or a batch of heightfields that differ in their heights only, shape (..., ny, nx),
        as `jax.vmap(lambda z: jaxhf.Heightfield(z, dx=2.0))(heights)` makes them: each has rays of its own, so that the
        axes of `o` and `d` begin with those of the batch.
      o, d: origins and directions, shape (..., 3) each, broadcast against each other; a direction need not be unit. NumPy
        and Python numbers keep double precision until the grid's x0 and y0 have been subtracted.
      settings: max_steps, shading, normals and chunk count here; those of what is prepared are its own.
      leaving: for rays that start on a heightfield: hits of an earlier `cast` on it, whose leading axes are
        broadcast against those of `d`; `o` must then be None. A ray leaves on the side of its triangle to which `d` points
        and cannot meet that triangle again, so that no offset by an epsilon is needed.

    Returns:
      A `Hit` with the same leading axes. A ray that is zero or not finite, or that leaves what is no hit, has the status
      INVALID.

    Raises:
      ValueError: `o` or `d` does not end in an axis of length 3, or not exactly one of `o` and `leaving` is None, or the
        axes do not begin with those of a batch; `leaving` or other settings with a scene that is prepared.
    """
    if isinstance(surface, Prepared):
        prepared_mesh("cast", surface.mesh, None, ())
    surface, o, d, leaving = where_called("cast", (surface, o, d, leaving))
    scene = surface._form if isinstance(surface, Prepared) else surface if isinstance(surface, Scene) else None
    ready = isinstance(surface, Prepared | PreparedHeightfield)
    field: Any = None if scene is not None else surface.field if isinstance(surface, PreparedHeightfield) else surface
    if scene is None and not all(hasattr(field, name) for name in ("heights", "dx", "dy", "x0", "y0")):
        hint = "jaxhf.Heightfield(heights, dx, dy) makes one"
        require_kind("cast", "surface", surface, Heightfield, "a jaxhf.Heightfield or a Scene", hint)
    require_kind("cast", "settings", settings or Settings(), Settings, "a jaxhf.Settings")
    if leaving is not None:
        require_kind("cast", "leaving", leaving, Hit, "the Hit that an earlier cast returned")
        if scene is not None:
            raise UserError("cast: leaving needs a heightfield alone, rays that meet a scene start at o")
    chosen = settings or (surface.settings if ready else Settings())
    chosen = chosen if scene is None else resolve_settings(chosen, scene)
    if ready and chosen != surface.settings:
        what = "heightfield" if scene is None else "scene"
        raise UserError(f"cast: the {what} was prepared with {surface.settings}, it cannot be cast into with {settings}")
    if scene is not None:
        corner = np.array(surface._origin) if isinstance(surface, Prepared) else anchor(scene)
        dtype, batch = precision(scene), ()
    else:
        dtype, batch = field.heights.dtype, field.heights.shape[:-2]
        corner = np.array([field.x0, field.y0, 0.0])
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
        start, axes = array_leaf(numbers(o).astype(np.float64) - corner, dtype), np.ndim(o) - 1
    d = array_leaf(d, dtype)
    starting = jax.tree.leaves(start)[0].shape[:axes]
    try:
        many = np.broadcast_shapes(starting, d.shape[:-1])
    except ValueError as error:
        raise ArgumentError(
            "cast", "d", f"must fit the {starting} rays that start, its leading axes are {d.shape[:-1]}"
        ) from error
    if many[: len(batch)] != batch:
        raise ArgumentError("cast", "d", f"must begin with the axes {batch} of the heightfields, its leading axes are {many}")

    def in_a_row(leaf: jax.Array, tail: tuple[int, ...]) -> jax.Array:
        lead = (math.prod(batch),) if batch else ()
        return jnp.broadcast_to(leaf, (*many, *tail)).reshape(*lead, -1, *tail)

    starts = jax.tree.map(lambda leaf: in_a_row(leaf, leaf.shape[axes:]), start)
    rays = starts, in_a_row(d, (3,))
    if isinstance(surface, Scene):
        shape = of_any_terrain(prepared_world(localise(surface.with_lights(())), chosen))
    elif isinstance(surface, Prepared):
        shape = of_any_terrain(surface._world)
    else:
        shape = surface._grid if isinstance(surface, PreparedHeightfield) else _with_one_axis(field)
    hit = (_cast_each if batch else _cast_one)(shape, *rays, chosen)
    return jax.tree.map(lambda leaf: leaf.reshape(*many, *leaf.shape[rays[1].ndim - 1 :]), _moved(hit, corner))


def _with_one_axis(field: Heightfield) -> Heightfield:
    """A heightfield, or a batch with one axis, whose x0 and y0 are 0."""

    def at_origin(heights: jax.Array) -> Heightfield:
        return Heightfield(heights, field.dx, field.dy, seam=field.seam)

    heights = jnp.asarray(field.heights)
    return at_origin(heights) if heights.ndim == 2 else jax.vmap(at_origin)(heights.reshape(-1, *heights.shape[-2:]))


def _moved(hit: Hit, offset: Float[np.ndarray, "3"]) -> Hit:
    """Hits with a leading axis, their points moved by `offset`."""
    return eqx.tree_at(lambda hit: hit.p, hit, hit.p + jnp.broadcast_to(jnp.asarray(offset, hit.p.dtype), hit.p.shape))


@functools.partial(compiled, static_argnames=("settings",))
def _cast_one(surface: _Traced | Heightfield, start: jax.Array | Hit, d: Float[jax.Array, "n 3"], settings: Settings) -> Hit:
    """Rays from points (n, 3), or from hits with a leading axis n; chunk after chunk of one fixed size."""
    ready = _ready(surface, settings)
    return trace_chunks(lambda ray: _first(ready, ray), (start, d), settings.chunk)


@functools.partial(compiled, static_argnames=("settings",))
def _cast_each(surfaces: Grid | Heightfield, start: jax.Array | Hit, d: Float[jax.Array, "m n 3"], settings: Settings) -> Hit:
    """Heightfields with a leading axis m, each of which has rays of its own."""
    return trace_batch(functools.partial(_ready, settings=settings), joined, _first, surfaces, (start, d), settings.chunk)


def _ready(surface: _Traced | Heightfield, settings: Settings) -> Any:
    return make_grid(surface, None, settings) if isinstance(surface, Heightfield) else surface


def _first(surface: _Traced, ray: tuple[Any, jax.Array]) -> Hit:
    """Of one ray that starts at a point or, on a grid, from a hit."""
    start, d = ray
    if isinstance(surface, World):
        return first_hit(surface, Ray(start, d), tangents=True)
    begin, leaving = leave(surface, 0, start, d) if isinstance(start, Hit) else (Ray(start, d), None)
    return intersect(surface, 0, begin, leaving=leaving, tangents=True)
