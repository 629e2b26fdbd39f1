"""The picture of a scene that is ready for tracing: by a program for its size, or by one for pictures of any size."""

import functools
import math
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.sharding import Mesh
from jaxtyping import Float

from ..boundary.guiding import has_edges
from ..boundary.points import draw_edges
from ..boundary.term import Boundaries, choose_resampled, moved_light
from ..core.autodiff import with_tangent
from ..core.settings import Settings
from ..core.types import room
from ..preparation.any_size import of_any_terrain
from ..preparation.world import World
from ..scene.camera import Camera, of_any_size
from ..xla.compilation import compiled, is_part_of_more
from ..xla.devices import everywhere, map_over, on_every_device
from ..xla.kernel import in_turn, one_kernel
from ..xla.parts import by_item, in_parts
from .samples import PictureSamples
from .tiles import Tiling, light_along, tile_side, trace_tiles

_PIXELS = 2**17
"""That a program for any size traces at once: with fewer devices wait more often, with more it clears memory for longer."""

_OF_ITS_SIZE = 64
"""Up to so many tiles a picture has a program for its size: by that for any size it would take 1.1 to 1.5 times as long."""


def picture(world: World, camera: Camera, aovs: tuple[str, ...], mesh: Mesh, key: jax.Array | None) -> dict[str, jax.Array]:
    """The picture ("image") and AOVs, each of shape (h, w, ...)."""
    is_part = is_part_of_more((world, camera))
    if is_part or _are_few(Tiling(camera.width, camera.height, world.settings)):
        return trace_picture(*_at_its_size(world, camera, aovs, mesh, key, is_part))
    if mesh.devices.size > 1:  # of whose parts XLA makes many copies, on each device
        return everywhere(trace_in_parts(world, camera, aovs, mesh, None), mesh)
    parts = [part for *_, part in _parts(world, camera, aovs, mesh, _at_once(world.settings, mesh))]
    return _assembled(parts, camera.width, camera.height, world.settings)


def compile_picture_ahead(world: World, camera: Camera, aovs: tuple[str, ...], mesh: Mesh, key: jax.Array | None) -> None:
    """The program of `picture` and, without a key, of `trace_in_parts`, for a world whose arrays may be forms of those to come,
    see `Compiled.compile_ahead`."""
    if _are_few(Tiling(camera.width, camera.height, world.settings)):
        trace_picture.compile_ahead(*_at_its_size(world, camera, aovs, mesh, key))
    else:
        most = _at_once(world.settings, mesh)
        corners = np.zeros((most, 2), np.int32)
        _trace_tiles.compile_ahead(mesh, of_any_terrain(world), of_any_size(camera), aovs, corners, np.int32(most))


def _at_its_size(
    world: World, camera: Camera, aovs: tuple[str, ...], mesh: Mesh, key: jax.Array | None, is_part: bool = False
) -> tuple[Any, ...]:
    """What `trace_picture` takes; `is_part`: of a program or a derivative of more, see `is_part_of_more`."""
    drawn = on_every_device(key, mesh) if world.settings.edge_samples else None  # else the settings draw nothing
    seen = world if is_part or has_edges(world) else of_any_terrain(world)
    return seen, camera, aovs, mesh, drawn


def _are_few(tiling: Tiling) -> bool:
    return tiling.count <= _OF_ITS_SIZE


def _at_once(settings: Settings, mesh: Mesh) -> int:
    """Tiles that a program for any size traces at once."""
    return max(mesh.devices.size, _PIXELS // tile_side(settings) ** 2)


@functools.partial(compiled, static_argnames=("aovs", "mesh"))
def trace_picture(
    world: World, camera: Camera, aovs: tuple[str, ...], mesh: Mesh, key: jax.Array | None
) -> dict[str, jax.Array]:
    """The same by a program for its size, also as a part of another program, and differentiable."""

    def picture(world: World, camera: Camera, _: jax.Array | None = None) -> dict[str, jax.Array]:
        tiling = Tiling(camera.width, camera.height, world.settings)
        tiles = trace_tiles(mesh, world, camera, aovs, tiling.corners())
        return jax.tree.map(tiling.assemble, tiles)

    def differentiated(world: World, camera: Camera, key: jax.Array | None) -> dict[str, jax.Array]:
        others = picture(world, camera) if aovs else {}
        if not has_edges(world):
            samples = PictureSamples(camera, world.settings)
            return others | {"image": samples.in_pixels(_light(world, camera, samples, mesh))}
        drawn = choose_resampled(draw_edges(world, camera, key, mesh), camera, world.settings)
        return others | {"image": _picture_across_boundaries(world, camera, drawn, mesh)}

    # With a loop of samples in that of tiles, each tile would add an array of derivatives by all heights to that of the others.
    in_one_loop = has_edges(world) or (world.settings.samples or 1) > 1
    return in_turn(picture, world, camera, key, derivative_of=differentiated if in_one_loop else None)


def _light(world: World, camera: Camera, samples: PictureSamples, mesh: Mesh) -> Float[jax.Array, "chunks n 3"]:
    """The radiance of all samples, in one loop."""

    def radiance(seen: tuple[World, Camera], points: tuple[jax.Array, ...]) -> jax.Array:
        return one_kernel(lambda *args: light_along(*args)[0], *seen, *points)

    return map_over(mesh, radiance, (world, camera), samples.positions())


def _picture_across_boundaries(world: World, camera: Camera, drawn: Boundaries, mesh: Mesh) -> Float[jax.Array, "h w 3"]:
    """The picture, with the derivative in which boundaries have a part.

    One loop traces all samples, also those of pixels in which boundaries were seen: with a loop of their own for these the
    program compiled for 7 s longer.
    """
    samples = PictureSamples(camera, world.settings, drawn.resampled)
    light = _light(world, camera, samples, mesh)
    image = samples.in_pixels(light)
    finer = samples.of_resampled(light).mean(1)
    light = moved_light(world, camera, drawn, mesh)
    change = image.reshape(-1, 3).at[drawn.resampled].set(finer, unique_indices=True).at[drawn.pixel].add(light)
    return with_tangent(lax.stop_gradient(image), change.reshape(image.shape))


_trace_tiles = compiled(trace_tiles, static_argnames=("mesh", "aovs"))


def trace_in_parts(
    world: World, camera: Camera, aovs: tuple[str, ...], mesh: Mesh, progress: Callable[[int, int], None] | None
) -> dict[str, np.ndarray]:
    """As `picture`, on the host: device memory does not grow with it."""
    tiling, most = Tiling(camera.width, camera.height, world.settings), _at_once(world.settings, mesh)
    pixels, found = tiling.width * tiling.height, {}
    if _are_few(tiling):
        found = jax.device_get(trace_picture(*_at_its_size(world, camera, aovs, mesh, None)))
        if progress is not None:
            progress(pixels, pixels)
        return found
    size = most if progress is None else min(most, max(math.ceil(tiling.count / 64), most // tiling.samples))
    whole = tiling.rows * tiling.side, tiling.columns * tiling.side
    for first, done, part in _parts(world, camera, aovs, mesh, size):
        for numbers, tiles in by_item(part, first, done, mesh.devices.size):
            for name, values in tiles.items():
                if name not in found:
                    found[name] = room((*whole, *values.shape[2:]), values.dtype)
                tiling.place(values, np.arange(tiling.count)[numbers], found[name])
        if progress is not None:
            progress(min(pixels, done * pixels // tiling.count), pixels)
    return {name: values[: tiling.height, : tiling.width] for name, values in found.items()}


def _parts(
    world: World, camera: Camera, aovs: tuple[str, ...], mesh: Mesh, size: int
) -> Iterator[tuple[int, int, dict[str, jax.Array]]]:
    """(first, end, tiles) of so many tiles after the others, as `map_first` leaves them."""
    seen = of_any_terrain(world), of_any_size(camera)

    def traced(corners: np.ndarray, count: np.int32) -> dict[str, jax.Array]:
        return _trace_tiles(mesh, *seen, aovs, corners, count)

    corners = Tiling(camera.width, camera.height, world.settings).corners()
    return in_parts(traced, corners, size, _at_once(world.settings, mesh))


@functools.partial(compiled, newer=True, static_argnames=("width", "height", "settings"))
def _assembled(parts: list[dict[str, jax.Array]], width: int, height: int, settings: Settings) -> dict[str, jax.Array]:
    """A picture of parts as one device leaves them."""
    tiling = Tiling(width, height, settings)
    return jax.tree.map(lambda *parts: tiling.assemble(jnp.concatenate(parts)[: tiling.count]), *parts)
