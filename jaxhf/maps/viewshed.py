"""What can be seen of a terrain from points above it, exact on its triangles."""

import functools
import math
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Float

from ..core.errors import ArgumentError, require_progress
from ..core.rules import OneOf, require
from ..core.settings import Settings
from ..core.types import POSITIVE, Index, Scalar, Vector
from ..io.terrain.terrain import Terrain
from ..preparation.horizon import assemble
from ..scene.heightfield import Heightfield
from ..trace.grid import Grid, make_grid
from ..trace.hit import hit_of_closed_form
from ..trace.skyline import skyline_slope
from ..trace.triangle import value_at
from ..xla.compilation import compiled
from ..xla.devices import chosen_mesh, map_over, on_every_device, takes_numbers
from ..xla.kernel import one_kernel
from .choices import WANTED
from .surface import surface, with_spacing

_ROUNDING = 1e-9  # cells
_TILE = 32  # vertices along a side of what `assemble` takes
_BEFORE = 0.35  # cells: no edge that does not touch a vertex is crossed nearer to it than twice as far away


@takes_numbers
def viewshed(
    terrain: Any,
    observers: Any,
    height: float = 1.8,
    target: float = 0.0,
    *,
    wanted: Literal["visible", "above-ground"] = "visible",
    radius: float | None = None,
    dx: float | None = None,
    dy: float | None = None,
    progress: Callable[[int, int], None] | None = None,
    mesh: Mesh | None = None,
) -> np.ndarray:
    """Which vertices of a terrain are seen from any of the observers, or how high above them one must be to be seen.

    Exact on the surface that is rendered, two triangles to a cell: between the edges that a line of sight crosses, the ground
    is straight, so that the steepest crossing decides (De Floriani and Magillo, Visibility algorithms on triangulated digital
    terrain models, International Journal of GIS 8(1), 1994). Over holes one sees.

    Args:
      terrain: a `Terrain` (degrees count as metres, see `load_heights`), a `Heightfield`, or heights, shape (ny, nx), row 0 in
        the south, nan where there is none.
      observers: x and y of one, shape (2,), or of several, (n, 2), on the terrain, in its coordinates; for an array from
        vertex (0, 0) on, in the unit of `dx`. Those along a line are points a cell apart.
      height: of the eyes above the ground, in the unit of the heights.
      target: height above the ground of what is to be seen.
      wanted: "visible", or "above-ground": the least height above the ground that is seen, 0 where the ground itself is.
      radius: of the sphere that the terrain lies on, in the unit of the heights: what is at a distance d stands lower by
        d² / (2 radius). None: the terrain lies on a plane. For light over the Earth, which air bends, 7.44e6 m (GDAL's 6/7).
      dx, dy: cell size, in the unit of the heights. An array must have one, which counts for both; None: a terrain's own.
      progress: called with (observers done, observers in all).
      mesh: the devices that share the work, see `render`.

    Returns:
      Shape (ny, nx): bool, False where there is no height; or the terrain's dtype, nan there.

    Raises:
      ValueError: an argument has a value that it cannot have, or an observer stands beside the terrain or over a hole.
    """
    require("viewshed", "wanted", wanted, OneOf(WANTED))
    require("viewshed", "height", height, POSITIVE)
    require("viewshed", "target", target, _at_least_0)
    if wanted == "above-ground" and target:
        raise ArgumentError("viewshed", "target", f"must be 0 where wanted is above-ground, it is {target}")
    if radius is not None:
        require("viewshed", "radius", radius, POSITIVE)
    require_progress("viewshed", progress, False)
    terrain = _with_place(terrain)
    places = _cells("viewshed", "observers", terrain, observers, dx, dy)
    ground = surface("viewshed", terrain, dx, dy)
    field = Heightfield(ground.heights, ground.dx, ground.dy)
    eyes = [
        (*place, _height_at(ground.heights, place, "viewshed", f"observers[{k}]") + height) for k, place in enumerate(places)
    ]
    mesh = chosen_mesh("viewshed", mesh)
    dtype = field.heights.dtype
    heights = on_every_device(jnp.asarray(field.heights), mesh)
    numbers = np.asarray([target, 0.0 if radius is None else 0.5 / radius], dtype)
    hidden: Any = None
    for done, eye in enumerate(np.asarray(eyes, dtype), 1):
        by = np.asarray(_hidden(heights, eye, numbers, field.dx, field.dy, wanted == "visible", mesh))
        hidden = by if hidden is None else np.minimum(hidden, by)  # nan where there is no height
        if progress is not None:
            progress(done, len(eyes))
    return hidden <= 0 if wanted == "visible" else hidden


@functools.partial(compiled, static_argnames=("dx", "dy", "visible", "mesh"))
def _hidden(
    heights: Float[jax.Array, "ny nx"],
    eye: Vector,
    numbers: Float[jax.Array, "2"],
    dx: float,
    dy: float,
    visible: bool,
    mesh: Mesh,
) -> Float[jax.Array, "ny nx"]:
    """By how much each vertex must be raised to be seen from one eye, besides the target's height; nan where there is none.

    Args:
      heights, dx, dy: of the terrain.
      eye: its column and row, and its height.
      numbers: the target's height above the ground, and by how much what is at a distance of 1 stands lower.
      visible: whether no more is to be said than whether that is 0.
      mesh: the devices that share the work.
    """
    (ny, nx), dtype = heights.shape, heights.dtype
    x, y = (jnp.arange(n, dtype=dtype) for n in (nx, ny))
    square = ((y - eye[1]) * dy)[:, None] ** 2 + ((x - eye[0]) * dx)[None, :] ** 2
    target, bend = numbers[0], numbers[1]
    grid = make_grid(Heightfield(heights - bend * square, dx, dy), None, Settings(shading="flat"))
    columns = math.ceil(nx / _TILE)
    of_vertex = functools.partial(_hidden_at, visible)

    def tile(shared: Any, number: jax.Array) -> jax.Array:
        grid, eye, target = shared
        at = jnp.arange(_TILE, dtype=jnp.int32)
        ix, iy = jnp.minimum((number % columns) * _TILE + at, nx - 1), jnp.minimum((number // columns) * _TILE + at, ny - 1)
        return jax.vmap(lambda iy: jax.vmap(lambda ix: of_vertex(grid, eye, target, ix, iy))(ix))(iy)

    count = columns * math.ceil(ny / _TILE)
    shared = grid, eye * jnp.array([dx, dy, 1], dtype), target
    tiles = map_over(mesh, lambda shared, number: one_kernel(tile, shared, number), shared, np.arange(count, dtype=np.int32))
    return assemble(tiles, heights.shape)


def _hidden_at(visible: bool, grid: Grid, eye: Vector, target: Scalar, ix: Index, iy: Index) -> Scalar:
    dtype, z = eye.dtype, value_at(grid.rows, iy * grid.shape[1] + ix)
    there = jnp.isfinite(z)
    at = grid.world_from_grid.point(jnp.stack([ix.astype(dtype), iy.astype(dtype), jnp.where(there, z, 0)]))
    to = at - eye
    distance = jnp.hypot(to[0], to[1])
    apart = there & (distance > 0)
    distance = jnp.where(apart, distance, 1)
    level = jnp.where(apart, jnp.stack([to[0], to[1], jnp.zeros_like(distance)]) / distance, jnp.array([1, 0, 0], dtype))
    cells = grid.grid_from_world.vector(level)
    t_max = distance - _BEFORE / jnp.hypot(cells[0], cells[1])
    slope = (to[2] + target) / distance
    up = jnp.array([0, 0, 1], dtype)
    # The first edge above the line of sight ends the walk, if no more is to be known.
    highest = jnp.nextafter(slope, jnp.inf) if visible else jnp.full_like(slope, jnp.inf)
    standing = hit_of_closed_form(-1, eye, up, jnp.zeros(2, dtype), -up)
    steepest, _ = skyline_slope(grid, 0, level, standing, apart, (slope, highest), t_max=t_max)
    return jnp.where(there, jnp.where(apart, (steepest - slope) * distance, 0), jnp.nan)


class LineOfSight(NamedTuple):
    """A line of sight over a terrain, at both its ends and wherever it crosses an edge of the triangles.

    Attributes:
      distance: from the observer, horizontal, rising; in the unit of the heights.
      ground: its height there, nan over a hole.
      line: the height of the line of sight there.
      visible: whether nothing stands above it.
      above_ground: the least height of a target above the ground that is seen from the eye, 0 where the ground is.
    """

    distance: Float[np.ndarray, " n"]
    ground: Float[np.ndarray, " n"]
    line: Float[np.ndarray, " n"]
    visible: bool
    above_ground: float


def line_of_sight(
    terrain: Any,
    observer: Any,
    target: Any,
    height: float = 1.8,
    target_height: float = 0.0,
    *,
    radius: float | None = None,
    dx: float | None = None,
    dy: float | None = None,
) -> LineOfSight:
    """Whether one point of a terrain sees another, and the profile between them, in double precision.

    With a `radius` the ground is lowered point by point, where `viewshed` lowers vertices.

    Args:
      observer, target: x and y, on the terrain, as the observers of `viewshed`.
      height, target_height: of the eye and of what is to be seen above the ground, in the unit of the heights.
      terrain, radius, dx, dy: as for `viewshed`, whose errors it has, too.
    """
    owner = "line_of_sight"
    require(owner, "height", height, POSITIVE)
    require(owner, "target_height", target_height, _at_least_0)
    if radius is not None:
        require(owner, "radius", radius, POSITIVE)
    terrain = _with_place(terrain)
    places = [_one(owner, name, terrain, at, dx, dy) for name, at in (("observer", observer), ("target", target))]
    ground = surface(owner, terrain, dx, dy)
    z = ground.heights.astype(np.float64)
    ends = [_height_at(z, place, owner, name) for place, name in zip(places, ("observer", "target"), strict=True)]
    (x0, y0), (x1, y1) = places
    crossed: list[Any] = [[0.0, 1.0]]
    for begin, end in ((x0, x1), (y0, y1), (x0 - y0, x1 - y1)):  # lines along y and x, and diagonals
        low, high = sorted((begin, end))
        lines = np.arange(math.ceil(low), math.floor(high) + 1)
        crossed.append((lines - begin) / (end - begin) if high > low else [])
    share = np.unique(np.clip(np.concatenate(crossed), 0, 1))
    profile = np.array([_interpolated(z, x0 + (x1 - x0) * s, y0 + (y1 - y0) * s) for s in share])
    profile[[0, -1]] = ends
    length = math.hypot((x1 - x0) * ground.dx, (y1 - y0) * ground.dy)
    distance = share * length
    profile = profile - (0 if radius is None else distance**2 / (2 * radius))
    eye = profile[0] + height
    line = eye + share * (profile[-1] + target_height - eye)
    between = slice(1, -1)
    with np.errstate(invalid="ignore"):
        visible = not (profile[between] > line[between]).any()
        needed = (profile[between] - eye) / share[between] + eye - profile[-1]
    return LineOfSight(distance, profile, line, visible, float(max(0, np.nanmax(needed, initial=0))))


def _with_place(terrain: Any) -> Any:
    if isinstance(terrain, Heightfield):
        return Terrain(np.asarray(terrain.heights), terrain.dx, terrain.dy, terrain.x0, terrain.y0)
    return terrain


def _at_least_0(value: Any) -> str | None:
    return None if 0 <= value < math.inf else f"must be at least 0 and finite, it is {value}"


def _cells(owner: str, name: str, terrain: Any, points: Any, dx: float | None, dy: float | None) -> Float[np.ndarray, "n 2"]:
    """Where points of the terrain's coordinates stand, in columns and rows."""
    given = np.asarray(points, np.float64)
    if given.ndim not in (1, 2) or given.shape[-1:] != (2,) or not given.size or not np.isfinite(given).all():
        raise ArgumentError(owner, name, f"must be x and y, shape (2,) or (n, 2), finite, shape is {given.shape}: {points!r}")
    if isinstance(terrain, Terrain):
        begin, step = (terrain.x0, terrain.y0), (terrain.dx, terrain.dy)
    else:
        _, *step = with_spacing(owner, terrain, dx, dy)
        begin = (0.0, 0.0)
    return ((given - begin) / step).reshape(-1, 2)


def _one(owner: str, name: str, terrain: Any, point: Any, dx: float | None, dy: float | None) -> tuple[float, float]:
    if np.shape(point) != (2,):
        raise ArgumentError(owner, name, f"must be x and y of one point, its shape is {np.shape(point)}")
    ((x, y),) = _cells(owner, name, terrain, point, dx, dy).tolist()
    return x, y


def _height_at(z: Float[np.ndarray, "ny nx"], place: Any, owner: str, name: str) -> float:
    """The surface's height at a place in columns and rows; ArgumentError where there is none."""
    (ny, nx), (x, y) = z.shape, map(float, place)
    if not (0 <= x <= nx - 1 and 0 <= y <= ny - 1):
        raise ArgumentError(owner, name, f"must be on the terrain of {nx} x {ny} vertices, it is in column {x:g}, row {y:g}")
    found = _interpolated(z, x, y)
    if not math.isfinite(found):
        raise ArgumentError(owner, name, f"must be where there is a height, there is none in column {x:g}, row {y:g}")
    return found


def _interpolated(z: Float[np.ndarray, "ny nx"], x: float, y: float) -> float:
    """The surface's height at a place in columns and rows; nan where no cell with all its vertices touches that."""
    sides = [_cells_at(at, n) for at, n in ((x, z.shape[1]), (y, z.shape[0]))]
    for ix, u in sides[0]:
        for iy, v in sides[1]:
            z00, z10, z01, z11 = (float(z[iy + j, ix + i]) for j in (0, 1) for i in (0, 1))
            if math.isfinite(z00 + z10 + z01 + z11):
                return z00 + u * (z10 - z00) + v * (z11 - z10) if u >= v else z00 + v * (z01 - z00) + u * (z11 - z01)
    return math.nan


def _cells_at(at: float, n: int) -> list[tuple[int, float]]:
    """The cells that touch a place along one side of n vertices, and the place in each; two where a vertex is."""
    nearest = round(at)
    if abs(at - nearest) < _ROUNDING:
        return [(k, float(nearest - k)) for k in (nearest, nearest - 1) if 0 <= k < n - 1]
    return [(math.floor(at), at - math.floor(at))]
