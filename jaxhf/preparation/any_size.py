"""Worlds whose programs serve terrains of many sizes: arrays of few lengths, with sizes that are data."""

import dataclasses
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from ..scene.heightfield import next_power_of_two
from ..scene.material import map_textures
from ..scene.texture import FlatTexture, ImageTexture
from ..trace.grid import Grid
from ..trace.intersect import Surface
from ..trace.skirt import Walls
from .ceiling import Ceiling
from .world import Ceilings, World

_LEAST_CELLS, _MOST_CELLS = 2**14, 2**22  # beyond, room takes hundreds of megabytes
_SPARE = 5 / 4  # of the cells' number: vertices and the bins of a `Ceiling` are more


class _Room(NamedTuple):
    """How many numbers arrays of a terrain have room for.

    Attributes:
      vertices: in those with an entry a vertex, and in bounds of shadows.
      bounds: in those of the pyramid, which rounds both sides up to powers of two.
      border: in those with an entry a vertex of the border.
    """

    vertices: int
    bounds: int
    border: int


def _room(shape: tuple[int, int]) -> _Room | None:
    """Of two sizes for each power of four, so that room is at most five times what is needed; None where there is none."""
    ny, nx = shape
    width, height = next_power_of_two(nx - 1), next_power_of_two(ny - 1)
    cells = max(4 ** math.ceil(math.log2(width * height) / 2), _LEAST_CELLS)
    needed = max(nx * ny, (nx - 1) * (ny - 1) + 3 * max(nx, ny))
    enough = [vertices for vertices in (int(_SPARE * cells / 4), int(_SPARE * cells)) if needed <= vertices]
    border = cells // 32 + 64
    if cells > _MOST_CELLS or not enough or 2 * (nx + ny) > border:  # a narrow one has more of it than others
        return None
    return _Room(enough[0], 4 * cells, border)


def with_room(world: World) -> World:
    """The world with arrays that end with zeros, as long as those of terrains of other sizes."""
    surfaces, materials, sky = list(world.surfaces), list(world.materials), list(world.sky)
    for k, grid, room in _roomy(world.surfaces):
        surfaces[k] = _roomy_grid(grid, room)
        materials[k] = map_textures(materials[k], lambda image, grid=grid, room=room: _roomy_texture(image, grid, room))
        visible = world.sky[k]
        sky[k] = None if visible is None else _padded(visible, room.vertices)
        for number, walls in enumerate(surfaces):
            if isinstance(walls, Walls) and walls.known_shape == grid.shape:
                surfaces[number] = dataclasses.replace(walls, tops=_padded(walls.tops, room.border))
    return dataclasses.replace(
        world,
        surfaces=tuple(surfaces),
        materials=tuple(materials),
        ceilings=roomy_ceilings(world.surfaces, world.ceilings),
        sky=tuple(sky),
        has_room=True,
    )


def roomy_ceilings(surfaces: tuple[Surface, ...], ceilings: Ceilings) -> Ceilings:
    """Those of a world with room."""
    rooms = {k: room for k, _, room in _roomy(surfaces)}

    def with_its_room(k: int, ceiling: Ceiling | None) -> Ceiling | None:
        if ceiling is None or k not in rooms:
            return ceiling
        heights, first = _padded(ceiling.heights, rooms[k].vertices), _padded(ceiling.first, rooms[k].border)
        return dataclasses.replace(ceiling, heights=heights, first=first)

    return tuple(tuple(with_its_room(k, ceiling) for k, ceiling in enumerate(of_light)) for of_light in ceilings)


_FORMS: dict[Any, Any] = {}
"""For the structure of a world, that of `of_any_terrain` of it, which is asked for each picture."""


def of_any_terrain(world: World) -> World:
    """A world with room whose program need not know how large its terrains are; the same where there is none."""
    if not world.has_room:
        return world
    leaves, structure = jax.tree.flatten(world)
    if structure not in _FORMS:
        shapes = {grid.known_shape for _, grid, _ in _roomy(world.surfaces)}
        surfaces = (_opened(surface, shapes) for surface in world.surfaces)
        _FORMS[structure] = jax.tree.structure(dataclasses.replace(world, surfaces=tuple(surfaces)))
    return jax.tree.unflatten(_FORMS[structure], leaves)


def _opened(surface: Surface, shapes: set[tuple[int, int] | None]) -> Surface:
    sized = isinstance(surface, Grid | Walls) and surface.known_shape in shapes
    return dataclasses.replace(surface, known_shape=None) if sized else surface


def _roomy(surfaces: tuple[Surface, ...]) -> list[tuple[int, Grid, _Room]]:
    """The heightfields that may have room, with the numbers of their objects."""
    grids = ((k, surface) for k, surface in enumerate(surfaces) if isinstance(surface, Grid) and surface.known_shape)
    found = ((k, grid, _room(grid.shape)) for k, grid in grids if grid.seam is None and grid.fixed_steps is None)
    return [(k, grid, room) for k, grid, room in found if room is not None]


def _padded(values: jax.Array, length: int) -> jax.Array:
    """With zeros behind; the same where it is as long."""
    return jnp.pad(values, ((0, length - values.shape[0]), *((0, 0) for _ in values.shape[1:])))


def _roomy_grid(grid: Grid, room: _Room) -> Grid:
    pyramid = dataclasses.replace(grid.pyramid, bounds=_padded(grid.pyramid.bounds, room.bounds))
    normals = None if grid.normals is None else _padded(grid.normals, room.vertices)
    return dataclasses.replace(grid, rows=_padded(grid.rows, room.vertices), pyramid=pyramid, normals=normals)


def _roomy_texture(image: ImageTexture, grid: Grid, room: _Room) -> ImageTexture | FlatTexture:
    """An image of the terrain's own size, as colours at the vertices are; others, and those of a user's class, stay."""
    if type(image) is not ImageTexture or image.texels.shape[:2] != grid.shape:
        return image
    flat = FlatTexture.of(image)
    return dataclasses.replace(flat, texels=_padded(flat.texels, room.vertices))
