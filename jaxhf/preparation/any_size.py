"""Worlds whose programs serve terrains of many sizes: arrays of few lengths, with sizes that are data."""

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Shaped

from ..core.settings import Settings
from ..core.types import Index
from ..scene.heightfield import Heightfield, Size, next_power_of_two
from ..scene.light import Light
from ..scene.material import map_textures
from ..scene.record import changed
from ..scene.scene import Scene, Shape
from ..scene.skirt import Skirt
from ..scene.texture import FlatTexture, ImageTexture
from ..trace.grid import Grid
from ..trace.intersect import Surface
from ..trace.skirt import Walls
from ..xla.materialise import materialise
from .ceiling import Ceiling
from .localise import precision
from .world import Ceilings, World, make_ceilings, make_world

_LEAST_CELLS, _MOST_CELLS = 2**14, 2**22  # beyond, room takes hundreds of megabytes
_SPARE = 5 / 4  # of the cells' number: the bins of a `Ceiling` are more, and vertices of squares of 2^n + 1


class Room(NamedTuple):
    """How many numbers arrays of a terrain have room for.

    Attributes:
      vertices: in those with an entry a vertex; a power of two but for squares of 2^n + 1, see `values_at`.
      bins: in bounds of shadows.
      bounds: in those of the pyramid, which rounds both sides up to powers of two.
      border: in those with an entry a vertex of the border.
      square: (ny, nx) of the arrays of two axes from which these are made, where a program makes them of terrains of many
        sizes; None: the terrain's own.
    """

    vertices: int
    bins: int
    bounds: int
    border: int
    square: tuple[int, int] | None = None


Rooms = tuple[Room | None, ...]
"""Of each object; None for all but heightfields that have room, and their skirts."""


def _room(shape: tuple[int, int], squared: bool = False) -> Room | None:
    """Of two sizes for each power of four, or a third for squares of 2^n + 1, so that room is at most 5 times what is needed;
    None where there is none."""
    ny, nx = shape
    width, height = next_power_of_two(nx - 1), next_power_of_two(ny - 1)
    cells = max(4 ** math.ceil(math.log2(width * height) / 2), _LEAST_CELLS)
    border = cells // 32 + 64
    if cells > _MOST_CELLS or 2 * (nx + ny) > border:  # a narrow one has more of it than others
        return None
    vertices = next((enough for enough in (cells // 4, cells) if nx * ny <= enough), int(_SPARE * cells))
    return Room(vertices, int(_SPARE * min(vertices, cells)), 4 * cells, border, (height + 1, width + 1) if squared else None)


def _rooms(shapes: Sequence[Shape | Surface], squared: bool) -> Rooms:
    """Those of objects, or of what was made of them.

    `squared`: for a program that serves many sizes, whose arrays of two axes then have sides of a power of two, and one. That
    pays where mountains hide the sky: to look round takes as long for the cells that are there, and compiles for seconds. The
    rest would take at least twice as long, see docs/measurements/speed.md.
    """

    def may_have_room(shape: Shape | Surface) -> bool:
        if isinstance(shape, Heightfield):
            return shape.seam is None
        return isinstance(shape, Grid) and shape.seam is None and shape.fixed_steps is None

    rooms = {known: _room(known, squared) for known in map(_known_shape, filter(may_have_room, shapes)) if known is not None}

    def room_of(shape: Shape | Surface) -> Room | None:
        known = _known_shape(shape) if may_have_room(shape) or isinstance(shape, Skirt | Walls) else None
        return None if known is None else rooms.get(known)

    return tuple(map(room_of, shapes))


def _known_shape(shape: Shape | Surface) -> tuple[int, int] | None:
    """(ny, nx) of a heightfield or of that which a skirt closes; None for others."""
    if isinstance(shape, Heightfield):
        ny, nx = shape.heights.shape
        return ny, nx
    if isinstance(shape, Skirt):
        return len(shape.west), len(shape.south)
    return shape.known_shape if isinstance(shape, Grid | Walls) else None


def in_room(scene: Scene, settings: Settings) -> tuple[Scene, tuple[Size | None, ...], Rooms]:
    """What `make_roomy_world` takes for a `localise`d scene: the scene without its camera, its arrays as long as those of other
    terrains; for each object its size, where that is data; and its room."""
    shapes, rooms = [obj.shape for obj in scene.objects], (None,) * len(scene.objects)
    if settings.early_exit:
        rooms = _rooms(shapes, squared=scene.sky_occlusion is not None)
    materials: list[Any] = [obj.material for obj in scene.objects]
    sizes: list[Size | None] = [None] * len(rooms)
    for k, (shape, room) in enumerate(zip(shapes, rooms, strict=True)):
        if room is None or not isinstance(shape, Heightfield | Skirt):
            continue
        if isinstance(shape, Heightfield):
            roomy = functools.partial(_roomy_texture, shape=shape.heights.shape, room=room)
            materials[k] = map_textures(materials[k], roomy)
        if room.square is not None:
            shapes[k], sizes[k] = _squared(shape, *room.square, precision(scene))

    objects = (changed(obj, shape=shapes[k], material=materials[k]) for k, obj in enumerate(scene.objects))
    return changed(scene, objects=tuple(objects), camera=None), tuple(sizes), rooms


def _squared(shape: Heightfield | Skirt, ny: int, nx: int, dtype: Any) -> tuple[Heightfield | Skirt, Size]:
    """One of this size, of cells of size 1, with holes beyond the heights, and its own size."""
    known = _known_shape(shape)
    assert known is not None
    size = Size.of(known, shape.dx, shape.dy, dtype)
    if isinstance(shape, Heightfield):
        return Heightfield(_longer(shape.heights, ny, nx, constant_values=np.nan), 1.0, 1.0), size
    lengths = {"south": nx, "north": nx, "west": ny, "east": ny}
    sides = {name: _longer(getattr(shape, name), length, mode="edge") for name, length in lengths.items()}
    return dataclasses.replace(shape, **sides, dx=1.0, dy=1.0), size


def _roomy_texture(image: ImageTexture, shape: tuple[int, ...], room: Room) -> ImageTexture | FlatTexture:
    """An image of the terrain's own size, as colours at the vertices are; others, and those of a user's class, stay."""
    if type(image) is not ImageTexture or image.texels.shape[:2] != shape:
        return image
    return FlatTexture.of(image, _longer(image.texels, room.vertices, shape=(-1, 3)))


def _longer(values: Any, *lengths: int, shape: tuple[int, ...] | None = None, **how: Any) -> Any:
    """An array whose first axes have these lengths, as `numpy.pad` fills it; before that it gets the shape, if any is given.

    On a CPU by NumPy: JAX would compile it for each size.
    """
    on_cpu = isinstance(values, jax.Array) and values.is_fully_addressable
    on_cpu = on_cpu and all(device.platform == "cpu" for device in values.devices())
    given = np.asarray(values) if on_cpu else values
    given = given if shape is None else given.reshape(shape)
    widths = [(0, length - n) for length, n in zip(lengths, given.shape, strict=False)]
    widths += [(0, 0)] * (given.ndim - len(widths))
    padded = (jnp if isinstance(given, jax.Array) else np).pad(given, widths, **how)
    if not on_cpu:
        return padded
    # A part of them on each device would not be one of the longer array.
    place = values.sharding if values.is_fully_replicated else min(values.devices(), key=lambda device: device.id)
    return jax.device_put(padded, place if values.committed else None)


def make_roomy_world(scene: Scene, sizes: tuple[Size | None, ...], rooms: Rooms, settings: Settings) -> World:
    """The world of what is `in_room`, with arrays that end with zeros, as long as those of terrains of other sizes."""
    world = make_world(scene, settings, sizes)
    surfaces, sky = list(world.surfaces), list(world.sky)
    for k, room in enumerate(rooms):
        surface, visible = surfaces[k], sky[k]
        if room is not None and isinstance(surface, Walls):
            surfaces[k] = _roomy_walls(surface, room)
        elif room is not None and isinstance(surface, Grid):
            longer = _longer_rows(surface, room)
            surfaces[k] = dataclasses.replace(
                surface,
                rows=longer(surface.rows),
                pyramid=dataclasses.replace(surface.pyramid, bounds=_padded(surface.pyramid.bounds, room.bounds)),
                normals=None if surface.normals is None else longer(surface.normals),
                known_shape=surface.known_shape if room.square is None else None,
            )
            sky[k] = None if visible is None else longer(visible)
    ceilings = _roomy_ceilings(world.surfaces, world.ceilings, rooms)
    return dataclasses.replace(world, surfaces=tuple(surfaces), ceilings=ceilings, sky=tuple(sky), has_room=True)


def with_shapes_of(scene: Scene, world: World) -> World:
    """The world of a scene that was `in_room`, with the shapes that its program did not know."""

    def with_shape(surface: Surface, shape: Shape) -> Surface:
        if not isinstance(surface, Grid | Walls) or surface.known_shape is not None:
            return surface
        return changed(surface, known_shape=_known_shape(shape))

    surfaces = tuple(with_shape(surface, obj.shape) for surface, obj in zip(world.surfaces, scene.objects, strict=True))
    return changed(world, surfaces=surfaces)


def _roomy_walls(walls: Walls, room: Room) -> Walls:
    if room.square is None:
        return dataclasses.replace(walls, tops=_padded(walls.tops, room.border))
    (ny, nx), (x, y) = room.square, (cells + 1 for cells in walls.cells)
    tops = jnp.zeros(room.border + max(ny, nx), walls.tops.dtype)
    sides = jnp.split(walls.tops, (nx, 2 * nx, 2 * nx + ny))
    for side, first in zip(sides, (jnp.zeros_like(x), x, 2 * x, 2 * x + y), strict=True):
        tops = lax.dynamic_update_slice(tops, side, (first,))  # over what the one before has too many
    tops = jnp.where(jnp.arange(tops.size, dtype=jnp.int32) < 2 * (x + y), tops, 0)
    return dataclasses.replace(walls, tops=tops[: room.border], known_shape=None)


def _longer_rows(grid: Grid, room: Room) -> Callable[[jax.Array], jax.Array]:
    """Makes arrays with an entry a vertex as long as the room."""
    if room.square is None:
        return functools.partial(_padded, length=room.vertices)
    return _rows_of(room.square[1], grid.nx, grid.cells[1] + 1, room.vertices)


def _rows_of(width: Index | int, columns: Index, rows: Index, length: int) -> Callable[[jax.Array], jax.Array]:
    """Of flat arrays with rows of this width: the first columns of the first rows, one after the other, and zeros."""
    number = jnp.arange(length, dtype=jnp.int32)
    row = number // columns
    place = materialise(row * width + number - row * columns)  # once: whole numbers are divided slowly

    def longer(values: Shaped[jax.Array, "n *rest"]) -> Shaped[jax.Array, "length *rest"]:
        inside = (number < rows * columns).reshape(-1, *[1] * (values.ndim - 1))
        return jnp.where(inside, values[jnp.minimum(place, len(values) - 1)], 0)

    return longer


def _roomy_ceilings(surfaces: tuple[Surface, ...], ceilings: Ceilings, rooms: Rooms) -> Ceilings:
    """Those of surfaces before these have room."""

    def with_its_room(ceiling: Ceiling | None, grid: Surface, room: Room | None) -> Ceiling | None:
        if ceiling is None or room is None or not isinstance(grid, Grid):
            return ceiling
        heights, first = ceiling.heights, ceiling.first
        if room.square is None:
            heights = _padded(heights, room.bins)
        else:
            (ny, nx), (x, y) = room.square, grid.cells
            width, cells, strips = (jnp.where(ceiling.columns, *pair) for pair in ((ny + 2, nx + 2), (y, x), (x, y)))
            heights = _rows_of(width, cells + 3, strips, room.bins)(heights)
            first = jnp.where(jnp.arange(first.size, dtype=jnp.int32) < strips, first, 0)
        return dataclasses.replace(ceiling, heights=heights, first=_padded(first, room.border))

    return tuple(tuple(map(with_its_room, of_light, surfaces, rooms)) for of_light in ceilings)


def make_roomy_ceilings(surfaces: tuple[Surface, ...], lights: tuple[Light, ...], rooms: Rooms, settings: Settings) -> Ceilings:
    """Those of surfaces that have room, see `surfaces_and_rooms`."""

    def squared(grid: Surface, room: Room | None) -> Surface:
        if room is None or room.square is None or not isinstance(grid, Grid):
            return grid
        row, column = (lax.broadcasted_iota(jnp.int32, room.square, axis) for axis in (0, 1))
        z = grid.rows[jnp.minimum(row * grid.nx + column, room.vertices - 1)]
        z = jnp.where((column <= grid.cells[0]) & (row <= grid.cells[1]), z, jnp.nan)
        return dataclasses.replace(grid, rows=z.reshape(-1), normals=None, known_shape=room.square)

    surfaces = tuple(map(squared, surfaces, rooms))
    return _roomy_ceilings(surfaces, make_ceilings(surfaces, lights, settings), rooms)


def surfaces_and_rooms(world: World) -> tuple[tuple[Surface, ...], Rooms]:
    """What `make_roomy_ceilings` takes of a world."""
    squared = any(visible is not None for visible in world.sky)
    rooms = _rooms(world.surfaces, squared) if world.has_room else (None,) * len(world.surfaces)
    return (of_any_terrain(world) if squared else world).surfaces, rooms


_FORMS: dict[Any, Any] = {}
"""For the structure of a world, that of `of_any_terrain` of it, which is asked for each picture."""


def of_any_terrain(world: World) -> World:
    """A world with room whose program need not know how large its terrains are; the same where there is none."""
    if not world.has_room:
        return world
    leaves, structure = jax.tree.flatten(world)
    if structure not in _FORMS:
        pairs = zip(world.surfaces, _rooms(world.surfaces, squared=False), strict=True)
        surfaces = (surface if room is None else changed(surface, known_shape=None) for surface, room in pairs)
        _FORMS[structure] = jax.tree.structure(changed(world, surfaces=tuple(surfaces)))
    return jax.tree.unflatten(_FORMS[structure], leaves)


def _padded(values: jax.Array, length: int) -> jax.Array:
    """With zeros behind; the same where it is as long."""
    return jnp.pad(values, ((0, length - values.shape[0]), *((0, 0) for _ in values.shape[1:])))
