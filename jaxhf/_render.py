"""From a scene to a picture: the only place where rays are batched."""

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.sharding import Mesh
from jaxtyping import Float, Int

from ._boundaries import moving_boundaries
from ._camera import Camera
from ._devices import local_mesh, map_over, on_every_device
from ._edges import with_tangent
from ._film import grid_side, sample_offset
from ._grid import Grid
from ._heightfield import Heightfield
from ._hit import Hit, intersect, leave
from ._lottery import sources
from ._ray import Ray
from ._scene import Scene, localise, localise_camera
from ._settings import Settings
from ._shade import Vertex, World, first_vertex, in_shadow, make_surface, make_world, radiance
from ._store import stored
from ._types import float_leaf

AOVS = ("depth", "normal", "uv", "status", "object", "cell", "shadow", "steps", "exhausted")
"""Arbitrary output variables, each (h, w) or (h, w, c), of the ray through the pixel's centre:

depth: distance to the hit, infinite where there is none. normal: shading normal, world frame. uv: place in the
footprint. status: see `Status`. object: its number in the scene, -1 for none. cell: (ix, iy), -1 for none. shadow: for each
light but the sky, whether it fails to reach the hit (blocked, or behind the surface). steps: taken by the search for the hit,
over all objects. exhausted: walks that ran out of steps, over all samples of the pixel, shadow and mirrored rays included.
"""


class Prepared(eqx.Module):
    """A scene of which all is done that does not depend on the camera; `prepare` makes it, `render` takes it.

    Attributes:
      scene: as it was given, with the camera that is to see it.
      settings: those for which it was prepared.
      mesh: the devices on which it lies.
    """

    scene: Scene
    settings: Settings = eqx.field(static=True)
    mesh: Mesh = eqx.field(static=True)
    _world: World

    def with_camera(self, camera: Camera) -> "Prepared":
        """The same, seen by another camera; nothing is compiled again if its picture has the same size."""
        return dataclasses.replace(self, scene=dataclasses.replace(self.scene, camera=camera))


def prepare(scene: Scene, settings: Settings = Settings(), *, mesh: Mesh | None = None) -> Prepared:
    """Takes the normals and the bounds of the heights once, for many pictures of the same terrain in the same light.

    The arguments are those of `render`.
    """
    settings, mesh = settle(settings, scene), local_mesh() if mesh is None else mesh
    return Prepared(scene, settings, mesh, _make_world(on_every_device(localise(scene), mesh), settings=settings))


def render(
    scene: Scene | Prepared,
    settings: Settings = Settings(),
    *,
    aovs: Sequence[str] = (),
    progress: Callable[[int, int], None] | None = None,
    key: jax.Array | None = None,
    mesh: Mesh | None = None,
) -> Any:
    """Renders a picture.

    Its tiles are dealt out to many devices, each of which holds a copy of the scene; the picture has the same bits on any
    number of CPU devices. JAX takes the cores of a CPU for one device, unless
    `jax.config.update("jax_num_cpu_devices", n)` says otherwise before it is first used.

    Args:
      scene: what to see. Values that are NumPy or Python numbers keep double precision until the origin has been moved to
        the terrain; the rest is computed in the precision of the (first) heightfield's heights.
      settings: the knobs; those of a `Prepared` scene stay what they are.
      aovs: names out of `AOVS`.
      progress: called with (pixels done, pixels in all) as the picture grows; not under a transformation.
      key: of JAX's random numbers, for what is sampled: the points on edges, if the settings ask for them. The same key
        gives the same derivative; None stands for a fixed one.
      mesh: the devices that share the work, whatever its axes; None: all of this process. Where it spans several processes
        (`jax.distributed`), each must call with the same values, and gets the whole picture.

    Returns:
      Linear radiance, shape (h, w, 3), top row first; with `aovs` that and a dict of them.

    Raises:
      ValueError: an unknown AOV, or settings or a mesh for a scene that was prepared with others.
    """
    aovs = tuple(aovs)
    for name in aovs:
        if name not in AOVS:
            raise ValueError(f"render: aovs must be among {', '.join(AOVS)}; one is {name!r}")
    if not isinstance(scene, Prepared) and progress is not None:
        scene, settings = prepare(scene, settings, mesh=mesh), Settings()
    if isinstance(scene, Prepared):
        if mesh is not None and mesh != scene.mesh:
            raise ValueError(f"render: the scene was prepared on {scene.mesh}, it cannot be rendered on {mesh}")
        if settings != Settings() and settle(settings, scene.scene) != scene.settings:
            raise ValueError(f"render: the scene was prepared with {scene.settings}, it cannot be rendered with {settings}")
        settings, world, mesh = scene.settings, scene._world, scene.mesh
        camera = on_every_device(localise_camera(scene.scene.camera, scene.scene), mesh)
        if progress is None:
            outputs = _trace_prepared(world, camera, settings, aovs, mesh, settled_key(key, settings, mesh))
        else:
            outputs = _trace_in_parts(world, camera, settings, aovs, mesh, progress)
    else:
        settings, mesh = settle(settings, scene), local_mesh() if mesh is None else mesh
        local = on_every_device(localise(scene), mesh)
        outputs = _trace_all(local, settings, aovs, mesh, settled_key(key, settings, mesh))
    image = outputs.pop("image")
    return (image, {name: outputs[name] for name in aovs}) if aovs else image


def render_each(scenes: Scene, change: Callable[[Scene], Scene], settings: Settings, mesh: Mesh) -> Float[jax.Array, "n h w 3"]:
    """Pictures of scenes that differ in numbers only, one after the other, in one program; for tracing.

    Args:
      scenes: one `localise`d scene, whose leaves have a leading axis of n scenes.
      change: what is done to each before it is rendered.
      settings: the knobs.
      mesh: the devices that share the work.
    """

    def one(scene: Scene) -> jax.Array:
        scene = change(scene)
        settled = settle(settings, scene)
        return _trace_all(on_every_device(scene, mesh), settled, (), mesh, settled_key(None, settled, mesh))["image"]

    return lax.map(one, scenes)


def settle(settings: Settings, scene: Scene) -> Settings:
    """The settings with what they leave to the scene filled in."""
    samples = scene.samples if settings.samples is None else settings.samples
    return dataclasses.replace(settings, samples=grid_side(samples) ** 2)


def settled_key(key: jax.Array | None, settings: Settings, mesh: Mesh) -> jax.Array | None:
    if not settings.edge_samples:
        return None
    return on_every_device(jax.random.key(0) if key is None else key, mesh)


class Tiling:
    """How a picture is cut into squares of one fixed size: a fixed shape gives the same bits wherever a pixel lies."""

    def __init__(self, camera: Camera, settings: Settings):
        self.width, self.height = camera.width, camera.height
        self.side = 1 << ((settings.chunk.bit_length() - 1) // 2)
        self.columns, self.rows = math.ceil(self.width / self.side), math.ceil(self.height / self.side)

    @property
    def count(self) -> int:
        return self.columns * self.rows

    def pixels(self, tile: Int[jax.Array, ""]) -> tuple[Int[jax.Array, " n"], Int[jax.Array, " n"]]:
        """Column and row of each pixel of a tile, also of those beyond the picture."""
        pixel = jnp.arange(self.side * self.side, dtype=jnp.int32)
        column, row = (tile % self.columns) * self.side, (tile // self.columns) * self.side
        return column + pixel % self.side, row + pixel // self.side

    def assemble(self, tiles: Any) -> Any:
        """(count, side * side, ...) to (height, width, ...), for NumPy and JAX arrays."""
        tail = tiles.shape[2:]
        grid = tiles.reshape(self.rows, self.columns, self.side, self.side, *tail).swapaxes(1, 2)
        return grid.reshape(self.rows * self.side, self.columns * self.side, *tail)[: self.height, : self.width]


@functools.partial(jax.jit, static_argnames=("settings", "aovs", "mesh"))
def _trace_all(
    scene: Scene, settings: Settings, aovs: tuple[str, ...], mesh: Mesh, key: jax.Array | None
) -> dict[str, jax.Array]:
    return _trace_world(make_world(scene, settings), scene.camera, settings, aovs, mesh, key)


def _trace_world(
    world: World, camera: Camera, settings: Settings, aovs: tuple[str, ...], mesh: Mesh, key: jax.Array | None
) -> dict[str, jax.Array]:
    tiling = Tiling(camera, settings)
    tiles = _trace_each(mesh, world, camera, settings, aovs, jnp.arange(tiling.count, dtype=jnp.int32))
    outputs = jax.tree.map(tiling.assemble, tiles)
    if key is not None and sources(world, settings):
        image = outputs["image"]
        outputs["image"] = with_tangent(image, moving_boundaries(world, camera, settings, key, mesh, image))
    return outputs


_trace_prepared = jax.jit(_trace_world, static_argnames=("settings", "aovs", "mesh"))


def _trace_each(
    mesh: Mesh, world: World, camera: Camera, settings: Settings, aovs: tuple[str, ...], tiles: Int[jax.Array, " n"]
):
    """Tiles one after the other, (n, side * side, ...) of each output."""
    return map_over(mesh, lambda seen, tile: _trace_tile(seen[0], seen[1], settings, aovs, tile), (world, camera), tiles)


_trace_tiles = jax.jit(_trace_each, static_argnames=("mesh", "settings", "aovs"))
_make_world = jax.jit(make_world, static_argnames=("settings",))


def _trace_in_parts(
    world: World,
    camera: Camera,
    settings: Settings,
    aovs: tuple[str, ...],
    mesh: Mesh,
    progress: Callable[[int, int], None],
):
    """As `_trace_all`, a few tiles at a time, with the picture on the host: device memory does not grow with it."""
    tiling = Tiling(camera, settings)
    size = math.ceil(tiling.count / 64)
    pixels = tiling.width * tiling.height
    parts = []
    for first in range(0, tiling.count, size):
        tiles = np.minimum(np.arange(first, first + size), tiling.count - 1)
        parts.append(jax.device_get(_trace_tiles(mesh, world, camera, settings, aovs, np.asarray(tiles, np.int32))))
        progress(min(pixels, (first + size) * pixels // tiling.count), pixels)
    return jax.tree.map(lambda *parts: tiling.assemble(np.concatenate(parts)[: tiling.count]), *parts)


def _trace_tile(world: World, camera: Camera, settings: Settings, aovs: tuple[str, ...], tile: jax.Array):
    dtype = camera.world_from_camera.dtype

    def one(x: jax.Array, y: jax.Array):
        image, exhausted = _pixel(world, camera, settings, x, y)
        outputs = {"image": image}
        if aovs:
            outputs |= _observe(world, camera.ray(x + 0.5, y + 0.5), settings, aovs)
        if "exhausted" in aovs:
            outputs["exhausted"] = exhausted
        return outputs

    columns, rows = Tiling(camera, settings).pixels(tile)
    return jax.vmap(one)(columns.astype(dtype), rows.astype(dtype))


def _pixel(world: World, camera: Camera, settings: Settings, x: jax.Array, y: jax.Array):
    """The mean over the pixel's samples, and how many walks ran out of steps."""
    assert settings.samples is not None
    side = math.isqrt(settings.samples)

    def sample(k, sums):
        dx, dy = sample_offset(k, side, x.dtype)
        ray = stored(camera.ray(x + dx, y + dy), world.surfaces[0].sure)
        light, exhausted = radiance(world, ray, settings)
        return sums[0] + light, sums[1] + exhausted

    sums = (jnp.zeros(3, x.dtype), jnp.zeros((), jnp.int32))
    if side == 1:
        return sample(jnp.zeros((), jnp.int32), sums)
    total, exhausted = lax.fori_loop(0, side * side, sample, sums)
    return total / (side * side), exhausted


def _observe(world: World, ray: Ray, settings: Settings, aovs: tuple[str, ...]) -> dict[str, jax.Array]:
    vertex = first_vertex(world, ray, settings, count_steps="steps" in aovs)
    hit, found = vertex.hit, vertex.index >= 0
    makers: dict[str, Callable[[], jax.Array]] = {
        "depth": lambda: jnp.where(found, hit.t, jnp.inf),
        "normal": lambda: jnp.where(found, hit.ns, 0),
        "uv": lambda: jnp.where(found, hit.uv, 0),
        "status": lambda: hit.status,
        "object": lambda: vertex.index,
        "cell": lambda: jnp.where(found, hit.cell, -1),
        "shadow": lambda: in_shadow(world, vertex, settings),
        "steps": lambda: jnp.asarray(hit.steps),
    }
    return {name: makers[name]() for name in aovs if name in makers}


def cast_camera(
    scene: Scene, x: Float[np.ndarray, " n"], y: Float[np.ndarray, " n"], settings: Settings = Settings()
) -> Vertex:
    """The first hits of the camera's rays through the points (x, y) of the picture, in pixels from its top left corner.

    Returns:
      A `Vertex` whose leaves have a leading axis n: the hits, with `p` relative to the terrain's corner, and the number of
      the object that each is on, -1 for none.
    """
    local = localise(scene)
    dtype = local.camera.world_from_camera.dtype
    return _cast_camera(local, jnp.asarray(x, dtype), jnp.asarray(y, dtype), settings)


@functools.partial(jax.jit, static_argnames=("settings",))
def _cast_camera(scene: Scene, x: jax.Array, y: jax.Array, settings: Settings) -> Vertex:
    world = make_world(scene, settings)

    def one(x: jax.Array, y: jax.Array) -> Vertex:
        return first_vertex(world, scene.camera.ray(x, y), settings)

    return jax.vmap(one)(x, y)


def cast(heightfield: Heightfield, o: Any, d: Any, settings: Settings = Settings(), *, leaving: Hit | None = None) -> Hit:
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
    dtype = heightfield.heights.dtype
    corner = np.array([heightfield.x0, heightfield.y0, 0.0])
    if (o is None) == (leaving is None):
        raise ValueError("cast: rays start at o or at the hits that they are leaving, and one of the two must be None")
    for name, value in (("o", o), ("d", d)):
        if value is not None and np.shape(value)[-1:] != (3,):
            raise ValueError(f"cast: {name} must have shape (..., 3), its shape is {np.shape(value)}")
    if leaving is not None:
        start, axes = leaving, leaving.t.ndim
    elif isinstance(o, jax.Array):
        o = float_leaf(o)
        start, axes = jnp.asarray(o - jnp.broadcast_to(jnp.asarray(corner, o.dtype), o.shape), dtype), o.ndim - 1
    else:
        start, axes = jnp.asarray(np.asarray(o, np.float64) - corner, dtype), np.ndim(o) - 1
    d = jnp.asarray(d, dtype)
    batch = np.broadcast_shapes(jax.tree.leaves(start)[0].shape[:axes], d.shape[:-1])

    def in_a_row(leaf: jax.Array, tail: tuple[int, ...]) -> jax.Array:
        return jnp.broadcast_to(leaf, (*batch, *tail)).reshape(-1, *tail)

    starts = jax.tree.map(lambda leaf: in_a_row(leaf, leaf.shape[axes:]), start)
    field = Heightfield(heightfield.heights, heightfield.dx, heightfield.dy)
    hit = _cast(field, starts, in_a_row(d, (3,)), settings)
    offset = jnp.asarray(corner, dtype)
    hit = eqx.tree_at(lambda hit: hit.p, hit, hit.p + jnp.broadcast_to(offset, hit.p.shape))
    return jax.tree.map(lambda leaf: leaf.reshape(*batch, *leaf.shape[1:]), hit)


@functools.partial(jax.jit, static_argnames=("settings",))
def _cast(heightfield: Heightfield, start: jax.Array | Hit, d: Float[jax.Array, "n 3"], settings: Settings) -> Hit:
    """Rays from points (n, 3), or from hits with a leading axis n; chunk after chunk of one fixed size."""
    surface = make_surface(heightfield, None, settings)
    assert isinstance(surface, Grid)

    def one(rays: tuple[jax.Array | Hit, jax.Array]) -> Hit:
        start, d = rays
        ray, origin = leave(surface, start, d) if isinstance(start, Hit) else (Ray(start, d), None)
        return intersect(surface, ray, settings, origin)

    chunk = settings.chunk
    rays = d.shape[0]
    count = math.ceil(rays / chunk)

    def chunked(leaf: jax.Array) -> jax.Array:
        tail = leaf.shape[1:]
        return jnp.pad(leaf, ((0, count * chunk - rays), *((0, 0) for _ in tail))).reshape(count, chunk, *tail)

    hits = lax.map(jax.vmap(one), jax.tree.map(chunked, (start, d)))
    return jax.tree.map(lambda leaf: leaf.reshape(count * chunk, *leaf.shape[2:])[:rays], hits)
