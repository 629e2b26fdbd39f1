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
from ..core.types import POSITIVE, Index, Number, Scalar, Vector
from ..core.vector import greater
from ..io.terrain.georeference import corners_said
from ..io.terrain.terrain import Terrain
from ..preparation.horizon import TILE, assemble, tile_count
from ..scene.heightfield import Heightfield
from ..trace.grid import Grid, make_grid
from ..trace.hit import hit_of_closed_form
from ..trace.skyline import skyline_slope
from ..xla.compilation import compiled
from ..xla.devices import chosen_mesh, map_over, on_every_device, takes_numbers
from ..xla.kernel import one_kernel
from ..xla.materialise import value_at
from .choices import WANTED
from .surface import Surface, require_positive, surface

_ROUNDING = 1e-9  # cells
_BEFORE = 0.35  # cells: no edge that does not touch a vertex is crossed nearer to it than twice as far away


@takes_numbers
def viewshed(
    terrain: Any,
    observers: Any,
    height: float = 1.8,
    target_height: float = 0.0,
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
    terrain models, International Journal of GIS 8(1), 1994). Over holes one sees; a line that only touches the rim of one may
    pass it.

    Args:
      terrain, dx, dy, mesh: as for `horizon`.
      observers: x and y of one, shape (2,), or of several, (n, 2), on the terrain, in its coordinates; for an array from
        vertex (0, 0) on, in the unit of `dx`. Those along a line are points a cell apart.
      height: of the eyes above the ground, in the unit of the heights.
      target_height: of what is to be seen, above the ground.
      wanted: "visible", or "above-ground": the least height above the ground that is seen, 0 where the ground itself is.
      radius: of the sphere that the terrain lies on, in the unit of the heights: what is at a distance d stands lower by
        d² / (2 radius). None: the terrain lies on a plane. For light over the Earth, which air bends, 7.44e6 m (GDAL's 6/7).
      progress: called with (observers done, observers in all).

    Returns:
      Shape (ny, nx): bool, False where there is no height; or float32 (float64 of such heights in JAX's x64 mode), nan there.

    Raises:
      ValueError: an argument has a value that it cannot have, or an observer stands beside the terrain or in a hole.
    """
    ground, *frame = _placed("viewshed", terrain, dx, dy)
    cells = cells_of("viewshed", "observers", observers, ground.heights.shape, *frame)
    return seen_from(ground, cells, "observers", height, target_height, wanted, radius, progress, mesh)


def seen_from(
    ground: Surface,
    cells: Float[np.ndarray, "n 2"],
    name: str,
    height: float = 1.8,
    target_height: float = 0.0,
    wanted: str = "visible",
    radius: float | None = None,
    progress: Callable[[int, int], None] | None = None,
    mesh: Mesh | None = None,
) -> np.ndarray:
    """`viewshed` from places in columns and rows; errors call them by `name`."""
    require("viewshed", "wanted", wanted, OneOf(WANTED))
    _require_line("viewshed", height, target_height, radius)
    if wanted == "above-ground" and target_height:
        raise ArgumentError("viewshed", "target_height", f"must be 0 where wanted is above-ground, it is {target_height}")
    require_progress("viewshed", progress, False)
    field = Heightfield(ground.heights, ground.dx, ground.dy)
    heights_there = [require_height(ground.heights, cell, "viewshed", f"{name}[{k}]") for k, cell in enumerate(cells)]
    eyes = np.column_stack([cells, np.add(heights_there, height)])
    mesh, dtype = chosen_mesh("viewshed", mesh), field.heights.dtype
    heights = on_every_device(jnp.asarray(field.heights), mesh)
    falls = None if radius is None else np.array([ground.dx, ground.dy], dtype) / np.sqrt(np.array(2 * radius, dtype))
    hidden: Any = None
    for done, eye in enumerate(eyes.astype(dtype), 1):
        by = np.asarray(_hidden(heights, eye, np.array(target_height, dtype), falls, wanted == "visible", mesh))
        hidden = by if hidden is None else np.minimum(hidden, by)  # nan where there is no height
        if progress is not None:
            progress(done, len(eyes))
    return hidden <= 0 if wanted == "visible" else hidden


@functools.partial(compiled, static_argnames=("visible", "mesh"))
def _hidden(
    heights: Float[jax.Array, "ny nx"],
    eye: Vector,
    target: Scalar,
    falls: Float[jax.Array, "2"] | None,
    visible: bool,
    mesh: Mesh,
) -> Float[jax.Array, "ny nx"]:
    """By how much each vertex must be raised to be seen from one eye, besides the target's height; nan where there is none.

    Along a line all horizontal distances are as many cells, so that the size of cells does not matter.

    Args:
      eye: its column and row, and its height.
      falls: a vertex so many cells away stands lower by the sum of the squares of these times the cells; None: it does not.
      visible: whether no more is to be said than whether that is 0.
    """
    (ny, nx), dtype = heights.shape, heights.dtype
    if falls is not None:
        x, y = (jnp.arange(n, dtype=dtype) - eye[k] for k, n in enumerate((nx, ny)))
        heights = heights - (jnp.square(y * falls[1])[:, None] + jnp.square(x * falls[0])[None, :])
    grid = make_grid(Heightfield(heights, 1.0, 1.0), None, Settings(shading="flat"))
    columns = math.ceil(nx / TILE)

    def tile(shared: tuple[Grid, Vector, Scalar], number: Index) -> jax.Array:
        grid, eye, target = shared
        at = jnp.arange(TILE, dtype=jnp.int32)
        ix, iy = jnp.minimum((number % columns) * TILE + at, nx - 1), jnp.minimum((number // columns) * TILE + at, ny - 1)
        return jax.vmap(lambda iy: jax.vmap(lambda ix: _hidden_at(visible, grid, eye, target, ix, iy))(ix))(iy)

    numbers = np.arange(tile_count(heights.shape), dtype=np.int32)
    tiles = map_over(mesh, lambda shared, number: one_kernel(tile, shared, number), (grid, eye, target), numbers)
    return assemble(tiles, heights.shape)


def _hidden_at(visible: bool, grid: Grid, eye: Vector, target: Scalar, ix: Index, iy: Index) -> Scalar:
    dtype, z = eye.dtype, value_at(grid.rows, iy * grid.shape[1] + ix)
    there = jnp.isfinite(z)
    to = grid.world_from_grid.point(jnp.stack([ix.astype(dtype), iy.astype(dtype), jnp.where(there, z, 0)])) - eye
    distance = jnp.hypot(to[0], to[1])
    apart = there & (distance > 0)
    distance = jnp.where(apart, distance, 1)
    level = jnp.where(apart, jnp.stack([to[0], to[1], jnp.zeros_like(distance)]) / distance, jnp.array([1, 0, 0], dtype))
    slope, up = (to[2] + target) / distance, jnp.array([0, 0, 1], dtype)
    # The first edge above the line of sight ends the walk, if no more is to be known. What follows 0 would be flushed to it.
    just_above = greater(jnp.nextafter(slope, jnp.inf), slope + jnp.finfo(dtype).tiny)
    highest = just_above if visible else jnp.full_like(slope, jnp.inf)
    standing = hit_of_closed_form(-1, eye, up, jnp.zeros(2, dtype), -up)
    steepest, _ = skyline_slope(grid, 0, level, standing, apart, (slope, highest), t_max=distance - _BEFORE)
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
    _require_line(owner, height, target_height, radius)
    ground, *frame = _placed(owner, terrain, dx, dy)
    z, places, ends = ground.heights.astype(np.float64), [], []
    for name, point in (("observer", observer), ("target", target)):
        cells = cells_of(owner, name, point, z.shape, *frame)
        if len(cells) != 1:
            raise ArgumentError(owner, name, f"must be x and y of one point, there are {len(cells)}")
        places.append(tuple(cells[0].tolist()))
        ends.append(require_height(z, cells[0], owner, name))
    (x0, y0), (x1, y1) = places
    crossed: list[Any] = []
    for begin, end in ((x0, x1), (y0, y1), (x0 - y0, x1 - y1)):  # lines along y and x, and diagonals
        low, high = sorted((begin, end))
        lines = np.arange(math.ceil(low), math.floor(high) + 1)
        crossed.append((lines - begin) / (end - begin) if high > low else [])
    share = np.unique(np.concatenate(crossed))
    near = _ROUNDING / max(abs(x1 - x0), abs(y1 - y0), _ROUNDING)  # what touches an end is that
    share = np.concatenate([[0.0], share[(share > near) & (share < 1 - near)], [1.0]])
    between = [height_at(z, x0 + (x1 - x0) * s, y0 + (y1 - y0) * s) for s in share[1:-1]]
    profile = np.array([ends[0], *between, ends[1]])
    length = math.hypot((x1 - x0) * ground.dx, (y1 - y0) * ground.dy)
    distance = share * length
    profile = profile - (0 if radius is None else distance**2 / (2 * radius))
    eye = profile[0] + height
    line = eye + share * (profile[-1] + target_height - eye)
    with np.errstate(invalid="ignore"):
        visible = not (profile > line)[1:-1].any()
        needed = ((profile - eye)[1:-1] / share[1:-1]) + eye - profile[-1]
    return LineOfSight(distance, profile, line, visible, float(max(0, np.nanmax(needed, initial=0))))


def _require_line(owner: str, height: float, target_height: float, radius: float | None) -> None:
    require(owner, "height", height, POSITIVE)
    require(owner, "target_height", target_height, _AT_LEAST_0)
    if radius is not None:
        require_positive(owner, "radius", radius)


_AT_LEAST_0 = Number("be at least 0 and finite", lambda value: (value >= 0) & (value < np.inf))


def _placed(
    owner: str, terrain: Any, dx: float | None, dy: float | None
) -> tuple[Surface, tuple[float, float], tuple[float, float]]:
    """The surface; where its vertex (0, 0) stands in the terrain's own coordinates, and how far apart vertices are there."""
    if isinstance(terrain, Heightfield):
        terrain = Terrain(np.asarray(terrain.heights), terrain.dx, terrain.dy, terrain.x0, terrain.y0)
    ground = surface(owner, terrain, dx, dy)
    if isinstance(terrain, Terrain):
        return ground, (terrain.x0, terrain.y0), (terrain.dx, terrain.dy)
    return ground, (0.0, 0.0), (ground.dx, ground.dy)


def cells_of(
    owner: str,
    name: str,
    points: Any,
    shape: tuple[int, ...],
    begin: tuple[float, float],
    step: tuple[float, float],
    *,
    rotation: float = 0.0,
) -> Float[np.ndarray, "n 2"]:
    """Where points stand in columns and rows of a terrain of this shape, whose vertex (0, 0) stands at `begin`.

    `rotation` is how many degrees its columns point clockwise of y.
    """
    try:
        given = np.asarray(points, np.float64)
    except (TypeError, ValueError):
        given = np.empty(0)
    if given.ndim not in (1, 2) or given.shape[-1:] != (2,) or not given.size or not np.isfinite(given).all():
        raise ArgumentError(owner, name, f"must be x and y, finite, of shape (2,) or (n, 2): {points!r}")
    (ny, nx), turn = shape, math.radians(rotation)
    axes = np.array([[math.cos(turn), math.sin(turn)], [-math.sin(turn), math.cos(turn)]])
    cells, last = ((given - begin) @ axes / step).reshape(-1, 2), np.array([nx - 1, ny - 1])
    rounding = _ROUNDING + 8 * np.finfo(float).eps * np.abs(begin).max() / np.array(step)  # of coordinates
    for k, cell in enumerate(cells):
        if not ((cell >= -rounding) & (cell <= last + rounding)).all():
            spans = [f"{a:.10g} to {a + (n - 1) * d:.10g}" for a, d, n in zip(begin, step, (nx, ny), strict=True)]
            where = corners_said(begin, step, (nx, ny), rotation) if rotation else f"x from {spans[0]} and y from {spans[1]}"
            x, y = given.reshape(-1, 2)[k]
            raise ArgumentError(owner, name, f"must be on the terrain, {where}; one is {x:.10g} {y:.10g}")
    return np.clip(cells, 0, last)


def require_height(z: Float[np.ndarray, "ny nx"], cell: Float[np.ndarray, "2"], owner: str, name: str) -> float:
    """The surface's height at a place in columns and rows; ArgumentError where there is none."""
    found = height_at(z, *cell.tolist())
    if not math.isfinite(found):
        place = "column {:.6g} and row {:.6g}".format(*cell)
        rule = f"must be on a triangle of the terrain; a height of its cell is missing, at {place} from the south-west"
        raise ArgumentError(owner, name, rule)
    return found


def height_at(z: Float[np.ndarray, "ny nx"], x: float, y: float) -> float:
    """The surface's height at a place in columns and rows; nan where no cell with all its vertices touches that."""
    sides = [_cells_at(at, n) for at, n in ((x, z.shape[1]), (y, z.shape[0]))]
    for ix, u in sides[0]:
        for iy, v in sides[1]:
            z00, z10, z01, z11 = (float(z[iy + j, ix + i]) for j in (0, 1) for i in (0, 1))
            if math.isfinite(z00 + z10 + z01 + z11):
                return z00 + u * (z10 - z00) + v * (z11 - z10) if u >= v else z00 + v * (z01 - z00) + u * (z11 - z01)
    return math.nan


def _cells_at(at: float, n: int) -> list[tuple[int, float]]:
    """The cells that touch a place along one side of n vertices, and the place in each; two at a vertex, none outside."""
    nearest, cells = round(at), [math.floor(at)]
    if abs(at - nearest) < _ROUNDING:
        at, cells = float(nearest), [nearest, nearest - 1]
    return [(k, at - k) for k in cells if 0 <= k < n - 1]
