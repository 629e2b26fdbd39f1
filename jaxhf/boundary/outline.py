"""The edges of a skirt: where its walls meet each other and the floor, and where one ends. Of elementwise arithmetic.

The walls side by side make a grid of two rows of vertices: column k has the k-th of `Walls.tops`, row 0 lies on the floor and
row 1 on the border. So edges have a kind and begin at a vertex, as those of a heightfield do, see `silhouette`. There are none
along diagonals; the border itself is an edge of the terrain's, unless the scene has no terrain of as many cells.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from ..core.types import Scalar, Vector
from ..scene.camera import Camera
from ..trace.skirt import OUTWARDS, Walls
from ..trace.world import World
from .silhouette import STEPS, EdgeFlags, EdgeWeights, Viewpoint, framed_length, lit_length

_FLOOR, UPWARDS = 4, 5  # the numbers of faces, see `outwards`


class Faces(NamedTuple):
    """The two faces of an edge, by their numbers in `OUTWARDS` and 5 for one upwards, and whether each is there.

    They stand at right angles: each goes on from the edge against the other's direction, also where the other is missing.
    """

    first: jax.Array
    second: jax.Array
    has_first: jax.Array
    has_second: jax.Array


def columns(walls: Walls) -> int:
    return walls.tops.shape[0]


def column_of(walls: Walls, wall: jax.Array, number: jax.Array) -> jax.Array:
    """The column of a wall's vertex of this number."""
    nx, ny = (n + 1 for n in walls.cells)
    return jnp.array([0, nx, 2 * nx, 2 * nx + ny], jnp.int32)[wall] + number


def place_of(walls: Walls, column: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The wall of a column, the number of its vertex there, and that of the wall's last vertex."""
    nx, ny = (n + 1 for n in walls.cells)
    later = jnp.where(column < 2 * nx, 1, jnp.where(column < 2 * nx + ny, 2, 3))
    wall = jnp.where(column < nx, 0, later).astype(jnp.int32)
    return wall, column - column_of(walls, wall, jnp.zeros_like(column)), jnp.where(wall < 2, nx, ny) - 1


def vertex(walls: Walls, column: jax.Array, row: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """x, y, z in the object's frame; differentiable. A hole's is on the floor."""
    (size_x, size_y), (cells_x, cells_y), dtype = walls.size, walls.cells, walls.tops.dtype
    wall, number, _ = place_of(walls, column)
    along = number.astype(dtype)
    x = jnp.where(wall < 2, along * (size_x / cells_x), jnp.where(wall == 3, size_x, 0))
    y = jnp.where(wall < 2, jnp.where(wall == 1, size_y, 0), along * (size_y / cells_y))
    top = walls.tops[column]
    return x, y, jnp.where((row == 1) & jnp.isfinite(top), top, walls.base)


def along_edge(walls: Walls, start: jax.Array, end: jax.Array, s: Scalar) -> Vector:
    """The point between two vertices, (column, row) each; object frame, differentiable."""
    a, b = (vertex(walls, at[0], at[1]) for at in (start, end))
    return jnp.stack([first + s * (last - first) for first, last in zip(a, b, strict=True)])


def _wall_after(walls: Walls, column: jax.Array) -> jax.Array:
    """Whether a wall goes on from its vertex of this column to its next one."""
    tops = jnp.isfinite(walls.tops)
    _, number, last = place_of(walls, column)
    column = jnp.clip(column, 0, columns(walls) - 2)
    return (number < last) & tops[column] & tops[column + 1]


def faces_of(walls: Walls, kind: jax.Array, column: jax.Array, row: jax.Array, alone: bool) -> Faces:
    """Those of edges; none for what is no edge.

    Args:
      walls: the skirt.
      kind, column, row: of the edges, integers of one shape.
      alone: whether the border counts.
    """
    wall, number, last = place_of(walls, column)
    after = _wall_after(walls, column)
    before = (number > 0) & _wall_after(walls, jnp.maximum(column - 1, 0))
    # Up a wall: its corners, which count for those in the south and in the north, and where it ends at a hole.
    end, low_end = (number == 0) | (number == last), jnp.where(number == last, False, (number == 0) | after)
    beside = jnp.where(wall < 2, 2, 0) + jnp.where(low_end, 0, 1)
    beyond = column_of(walls, beside, jnp.where(wall == 1, walls.cells[1] - 1, 0))
    meets = end & (wall < 2) & _wall_after(walls, beyond)
    ends = (after ^ before) & ~(end & (wall >= 2))
    upright, foot, rim = (kind == 1) & (row == 0), (kind == 0) & (row == 0), (kind == 0) & (row == 1)
    return Faces(
        wall,
        jnp.where(upright, beside, jnp.where(foot, _FLOOR, UPWARDS)).astype(jnp.int32),
        (upright & ends) | ((foot | (rim & alone)) & after),
        (upright & meets) | (foot & (number < last)),
    )


def outwards(face: jax.Array, dtype: Any) -> Vector:
    """The direction out of the solid through a face, object frame."""
    return jnp.array((*OUTWARDS, (0, 0, 1)), dtype)[face]


def is_alone(world: World, walls: Walls) -> bool:
    return all(grid.cells != walls.cells for _, grid, _ in world.grids)


def _all_edges(walls: Walls) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Kind, column and row of each, shape (3, 2, columns)."""
    kind, row, column = jnp.indices((3, 2, columns(walls)), jnp.int32)
    return kind, column, row


def all_ends(walls: Walls) -> tuple[list[jax.Array], list[jax.Array]]:
    """The first and the second vertices of all edges, world frame: x, y, z each, shape (3, 2, columns)."""
    kind, column, row = _all_edges(walls)
    steps, world = jnp.array(STEPS, jnp.int32)[kind], walls.world_from_object
    last = jnp.minimum(column + steps[..., 0], columns(walls) - 1), jnp.minimum(row + steps[..., 1], 1)

    def placed(column: jax.Array, row: jax.Array) -> list[jax.Array]:
        p = vertex(walls, column, row)
        return [sum(world.linear[k, j] * p[j] for j in range(3)) + world.offset[k] for k in range(3)]

    return placed(column, row), placed(*last)


def seen_lengths(walls: Walls, camera: Camera) -> EdgeWeights:
    """As `silhouette.seen_lengths`."""
    film = camera.film_from_world()

    def seen(p: list[jax.Array]) -> list[jax.Array]:
        return [sum((film.linear[k, j] * p[j] for j in range(3)), film.offset[k]) for k in range(4)]

    a, b = all_ends(walls)
    return framed_length(camera, seen(a), seen(b))


def lit_lengths(walls: Walls, light: Viewpoint) -> EdgeWeights:
    """As `silhouette.lit_lengths`."""
    a, b = all_ends(walls)
    e = [last - first for first, last in zip(a, b, strict=True)]
    to = [light.v[k] - p if light.at_place else jnp.broadcast_to(light.v[k], p.shape) for k, p in enumerate(a)]
    return lit_length(e, to, light.at_place)


def outline(world: World, walls: Walls) -> EdgeFlags:
    """The edges that may bound what is seen."""
    faces = faces_of(walls, *_all_edges(walls), is_alone(world, walls))
    return faces.has_first | faces.has_second


def shading_edges(world: World, walls: Walls, light: Viewpoint) -> EdgeFlags:
    """The edges with one face in a light, and none or one that is away from it."""
    kind, column, row = _all_edges(walls)
    faces = faces_of(walls, kind, column, row, is_alone(world, walls))
    v = walls.object_from_world.point(light.v) if light.at_place else walls.object_from_world.vector(light.v)
    to = [v[k] - (p if light.at_place else 0) for k, p in enumerate(vertex(walls, column, row))]

    def lit(face: jax.Array) -> jax.Array:
        along = jnp.where(face < 2, to[1], jnp.where(face < 4, to[0], to[2]))
        return jnp.where(face % 2 == 1, along, -along) > 0

    return (lit(faces.first) & faces.has_first) ^ (lit(faces.second) & faces.has_second)
