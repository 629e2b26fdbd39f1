"""How steeply the surface rises above each vertex of a grid, direction by direction, as far as the grid reaches.

Along a line over the triangulated surface the height is linear between two crossings of edges, so the largest slope that is
seen from a vertex is that of a crossing. In one direction all vertices of a grid meet the crossings at the same offsets and
at the same shares of edges. A square tile of vertices therefore looks at one crossing after the other without a gather, and
leaves out stretches of the way over which nothing is high enough to raise the slope of any of its vertices.
"""

import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.sharding import Mesh
from jaxtyping import Bool, Float, Int

from ..core.types import Index, Scalar
from ..trace.edges import at_second_vertices, present_edges, whole_cells
from ..xla.devices import map_over
from .crossings import TOGETHER, Crossings, crossings_of

# Found best on the CPU at 1024 x 1024 vertices; smaller tiles leave more out, and run slower.
TILE = 32  # vertices along its side
_STRETCH = 24  # cells, along the axis on which a direction moves faster; up to `TOGETHER` crossings longer
_GRAIN = 8  # cells from one of the windows whose highest points are kept to the next
_MARGIN = TILE + 1
# Windows side by side that a tile moves over within a stretch, wherever between their beginnings it begins.
_REACH = math.ceil((TILE + _STRETCH + TOGETHER + 4) / _GRAIN) + 1
_STEEPEST = 1e18  # of slopes: a right angle, whose square is a number in single precision

# Slopes in all directions, shape (k, *at), and what is given `Besides`, to what is wanted of them: arrays without an axis for
# the direction, or with one in front.
Summary = Callable[..., jax.Array]


class Besides(NamedTuple):
    """What a summary takes besides the slopes.

    Attributes:
      shared: by all vertices.
      at_vertices: a number or more for each vertex, arrays of shape (..., ny, nx); a summary gets them at its own.
    """

    shared: Any
    at_vertices: Any


@functools.partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def over_horizon(
    summary: Summary,
    mesh: Mesh,
    z: Float[jax.Array, "ny nx"],
    directions: Float[jax.Array, "k 2"],
    lowest: Scalar,
    besides: Besides | None = None,
) -> jax.Array:
    """A summary of the slopes of the horizon at each vertex: of each direction, the largest that any point of the surface has.

    A slope is (height of the point - height of the vertex) / horizontal distance, with the surface as the renderer has it. It
    has a derivative in the heights, that of the slope to the point that was found; what is returned has one in `besides`, too,
    none in the other arguments.

    Args:
      summary: of the slopes, shape (k, ...), and of `besides`, what is returned for places of shape (...); elementwise in
        these.
      mesh: the devices among which tiles are dealt out.
      z: heights, nan in holes; a vertex that is a hole gives nan.
      directions: cells in x and in y for each unit of horizontal distance.
      lowest: the slope where nothing rises higher; may be -inf.
      besides: what else the summary takes; None: nothing.
    """
    return _searched(summary, mesh, z, directions, lowest, False, besides)[0]


@over_horizon.defjvp
def _over_horizon_jvp(summary: Summary, mesh: Mesh, primals: tuple[Any, ...], tangents: tuple[Any, ...]):
    z, directions, lowest, besides = lax.stop_gradient(primals)
    slopes, found = _searched(lambda slopes: slopes, mesh, z, directions, lowest, True)
    ny, nx = z.shape
    iy, ix = (at.astype(jnp.int32) for at in jnp.indices(z.shape))

    def change(of_one: tuple[jax.Array, jax.Array]) -> jax.Array:
        """Of the slopes in one direction."""
        direction, found = of_one
        on = jax.tree.map(lambda values: values[jnp.maximum(found, 0)], crossings_of((ny, nx), direction))
        low, high = tangents[0][iy + on.y, ix + on.x], tangents[0][iy + on.y2, ix + on.x2]
        raised = ((low - tangents[0]) + on.share * (high - low)) * on.inverse
        return jnp.where(found >= 0, raised, 0)

    changes = lax.map(change, (directions, found)), tangents[3]
    return jax.jvp(lambda slopes, besides: summary(slopes, *(besides or ())), (slopes, besides), changes)


def _searched(
    summary: Summary,
    mesh: Mesh,
    z: jax.Array,
    directions: jax.Array,
    lowest: Scalar,
    numbered: bool,
    besides: Besides | None = None,
) -> tuple[jax.Array, Int[jax.Array, "k ny nx"] | None]:
    """The summary, and if they are to be numbered, the entries of `crossings_of` that were found; -1 for none."""
    view = HorizonView.of(z, directions)
    tiles = over_tiles(summary, mesh, view, lowest, jnp.arange(tile_count(z.shape), dtype=jnp.int32), numbered, besides)
    result, found = jax.tree.map(lambda values: assemble(values, z.shape), tiles)
    return jnp.where(jnp.broadcast_to(jnp.isnan(z), result.shape), jnp.nan, result), found


def tile_count(shape: tuple[int, ...]) -> int:
    """Square tiles that cover a grid of this shape."""
    return math.prod(math.ceil(n / TILE) for n in shape)


def over_tiles(
    summary: Summary,
    mesh: Mesh,
    view: "HorizonView",
    lowest: Scalar,
    numbers: Int[Any, " tiles"],
    numbered: bool = False,
    besides: Besides | None = None,
) -> tuple[jax.Array, jax.Array | None]:
    """As `over_horizon`, for some of the tiles, without a derivative, and with any values in holes. Besides, the entries that
    were found."""
    columns = math.ceil((view.heights.shape[1] - 2 * _MARGIN - TILE) / TILE)

    def one_tile(shared: tuple["HorizonView", Scalar, Besides | None], number: Index) -> tuple[jax.Array, jax.Array | None]:
        view, lowest, besides = shared
        x, y = (number % columns) * TILE, (number // columns) * TILE
        ways = jnp.arange(view.end.shape[0], dtype=jnp.int32)

        def searched() -> tuple[jax.Array, jax.Array | None]:
            slopes, found = lax.map(lambda way: _from_tile(view, way, x, y, lowest, numbered), ways)
            given = besides and (besides.shared, jax.tree.map(lambda values: _tile_of(values, x, y), besides.at_vertices))
            return summary(slopes, *(given or ())), found

        def nothing() -> tuple[jax.Array, jax.Array | None]:
            return jax.tree.map(lambda form: jnp.full(form.shape, -1, form.dtype), jax.eval_shape(searched))

        heights = lax.dynamic_slice(view.heights, (y + _MARGIN, x + _MARGIN), (TILE, TILE))
        return lax.cond(jnp.isnan(heights).all(), nothing, searched)

    return map_over(mesh, one_tile, (view, lowest, besides), numbers)


def _tile_of(values: Float[jax.Array, "*rest ny nx"], x: Index, y: Index) -> Float[jax.Array, "*rest tile tile"]:
    """Those of the tile that begins at (x, y); beyond the grid those of its border."""
    rows, columns = (
        jnp.minimum(at + jnp.arange(TILE, dtype=jnp.int32), n - 1) for at, n in zip((y, x), values.shape[-2:], strict=True)
    )
    return values[..., rows[:, None], columns[None, :]]


def assemble(tiles: Any, shape: tuple[int, ...]) -> Any:
    """An array over the grid from all its tiles, of JAX or NumPy: shape (tiles, ..., tile, tile) to (..., ny, nx)."""
    rows, columns = (math.ceil(n / TILE) for n in shape)
    tail = tiles.shape[1:-2]
    last = 2 + len(tail)
    grid = tiles.reshape(rows, columns, *tail, TILE, TILE).transpose(*range(2, last), 0, last, 1, last + 1)
    return grid.reshape(*tail, rows * TILE, columns * TILE)[..., : shape[0], : shape[1]]


class HorizonView(eqx.Module):
    """What all tiles of a search share.

    Attributes:
      heights: with a margin, nan beyond the grid.
      edges: for each kind, heights at the first vertices of edges, with a margin; nan where no cell of the surface has it.
      windows: the highest vertex of squares that begin at every multiple of `_GRAIN`, from `_REACH` of them before the grid.
      holed: whether in one of these a vertex, or an edge from there, has heights but no cell: not along straight borders.
      crossings: of each direction.
      bounds: between stretches, the horizontal distances.
      begins: the first of the groups of crossings that are beyond each.
      end: the distance at which a direction has left the grid, wherever it began.
      first_window: where a stretch begins in the least x and in the least y, from the vertex, cells.
    """

    heights: Float[jax.Array, "rows columns"]
    edges: Float[jax.Array, "4 rows columns"]
    windows: Float[jax.Array, "window_rows window_columns"]
    holed: Bool[jax.Array, "window_rows window_columns"]
    crossings: Any  # a `Crossings` with a leading axis
    bounds: Float[jax.Array, "k bounds"]
    begins: Int[jax.Array, "k bounds"]
    end: Float[jax.Array, " k"]
    first_window: Int[jax.Array, "k stretches 2"]

    @staticmethod
    def of(z: Float[jax.Array, "ny nx"], directions: Float[jax.Array, "k 2"]) -> "HorizonView":
        (ny, nx), dtype = z.shape, z.dtype
        count = math.ceil((max(nx, ny) - 1) / _STRETCH)
        margin = ((_MARGIN, _MARGIN + TILE), (_MARGIN, _MARGIN + TILE))

        def along(direction: jax.Array) -> tuple[Crossings, jax.Array, jax.Array, jax.Array, jax.Array]:
            crossings, size = crossings_of((ny, nx), direction), jnp.abs(direction)
            even = jnp.arange(count, dtype=dtype) * (_STRETCH / jnp.max(size))
            end = jnp.min(jnp.array([nx - 1, ny - 1], dtype) / jnp.maximum(size, jnp.finfo(dtype).tiny))
            beyond = jnp.searchsorted(-crossings.inverse, -1 / even, side="right").astype(jnp.int32)
            last = jnp.sum(crossings.inverse * end > 0.999, dtype=jnp.int32)
            groups = (last + TOGETHER - 1) // TOGETHER
            begins = jnp.append(jnp.where(beyond < last, beyond // TOGETHER, groups), groups)
            first = jnp.minimum(begins * TOGETHER, crossings.inverse.size - 1)
            bounds = jnp.minimum(1 / crossings.inverse[first], end)
            ends = jnp.outer(bounds, direction)
            # One cell less: a hole beside an edge takes a cell from it.
            return crossings, bounds, begins, end, jnp.floor(jnp.minimum(ends[:-1], ends[1:])).astype(jnp.int32) - 1

        heights = jnp.pad(z, margin, constant_values=jnp.nan)
        of_kind = _edges(z)
        edges = jnp.pad(of_kind, ((0, 0), *margin), constant_values=jnp.nan)
        second = jnp.concatenate([at_second_vertices(z, jnp.nan), z[None]])
        lost = (jnp.isnan(of_kind) & ~jnp.isnan(z)[None] & ~jnp.isnan(second)).any(0)
        highest = _windows(jnp.where(jnp.isnan(z), -jnp.inf, z))
        holed = _windows(jnp.where(lost, 0, -jnp.inf).astype(dtype)) == 0
        return HorizonView(heights, edges, highest, holed, *lax.map(along, directions))


def _from_tile(
    view: HorizonView, way: Index, x: Index, y: Index, lowest: Scalar, numbered: bool
) -> tuple[Float[jax.Array, "tile tile"], Int[jax.Array, "tile tile"] | None]:
    """Slopes in one direction from the vertices of the tile that begins at (x, y), and the entries of what was found.

    The crossings of all directions are handed on and looked up one by one: those of one would be copied for each tile.
    """
    bounds, begins, end, first = (values[way] for values in (view.bounds, view.begins, view.end, view.first_window))
    crossings = view.crossings
    stretches = first.shape[0]

    def moved(by_x: Index, by_y: Index) -> jax.Array:
        """Of the tile, moved by some cells. The start is clamped: a tile beyond the margin is one within it, all nan."""
        start = y + _MARGIN + by_y, x + _MARGIN + by_x
        return lax.dynamic_slice(view.heights, start, (TILE, TILE), allow_negative_indices=False)

    def moved_edges(kind: Index, by_x: Index, by_y: Index) -> jax.Array:
        start = kind, y + _MARGIN + by_y, x + _MARGIN + by_x
        return lax.dynamic_slice(view.edges, start, (1, TILE, TILE), allow_negative_indices=False)[0]

    z = moved(jnp.zeros_like(x), jnp.zeros_like(y))
    window = [(at + first[:, k]) // _GRAIN + _REACH for k, at in enumerate((x, y))]
    column, row = (jnp.clip(at, 0, n - 1) for at, n in zip(window, view.windows.shape[::-1], strict=True))
    top, holed = view.windows[row, column], view.holed[row, column]
    top_from_here = lax.cummax(top, reverse=True)

    def rises(top: Scalar, slopes: jax.Array, near: Scalar, far: Scalar) -> Bool[jax.Array, ""]:
        """Whether a point of this height, between two distances, could stand above the slope of some vertex."""
        return (top - z > slopes * jnp.where(slopes >= 0, near, far)).any()

    def look(holed: bool, group: Index, carry: tuple[jax.Array, jax.Array | None]) -> tuple[jax.Array, jax.Array | None]:
        slopes, found = carry
        for k in range(TOGETHER):
            n = group * TOGETHER + k
            at = way, n
            # Else from one array in place of five, whose memory pages are more than the processor keeps at hand.
            from_x, from_y = crossings.x[at], crossings.y[at]
            low = moved_edges(crossings.kind[at], from_x, from_y) if holed else moved(from_x, from_y)
            high = moved(crossings.x2[at], crossings.y2[at])
            slope = ((low - z) + crossings.share[at] * (high - low)) * crossings.inverse[at]
            steeper = slope > slopes  # never where it is nan
            slopes = jnp.where(steeper, slope, slopes)
            found = None if found is None else jnp.where(steeper, n, found)
        return slopes, found

    def walk(carry: tuple[Index, Any, Any]) -> tuple[Index, Any, Any]:
        k, _, seen = carry
        needed = rises(top[k], seen[0], bounds[k], bounds[k + 1])
        looks = (functools.partial(look, of) for of in (False, True))
        plain, holey = (functools.partial(lax.fori_loop, begins[k], begins[k + 1], one) for one in looks)
        return k + 1, *lax.cond(
            needed,
            lambda seen: (jnp.ones((), bool), lax.cond(holed[k], holey, plain, seen)),
            lambda seen: (rises(top_from_here[k], seen[0], bounds[k], end), seen),
            seen,
        )

    def going(carry: tuple[Index, Any, Any]) -> Bool[jax.Array, ""]:
        return (carry[0] < stretches) & carry[1]

    seen = jnp.full_like(z, lowest), jnp.full(z.shape, -1, jnp.int32) if numbered else None
    slopes, found = lax.while_loop(going, walk, (jnp.zeros((), jnp.int32), jnp.ones((), bool), seen))[2]
    return jnp.minimum(slopes, _STEEPEST), found


def _edges(z: Float[jax.Array, "ny nx"]) -> Float[jax.Array, "4 ny nx"]:
    """For each kind, heights at the first vertices of edges; nan where no cell of the surface has the edge."""
    whole = jnp.pad(whole_cells(z), 1)
    at_vertex = whole[1:, 1:] | whole[1:, :-1] | whole[:-1, 1:] | whole[:-1, :-1]
    return jnp.where(jnp.concatenate([present_edges(z), at_vertex[None]]), z[None], jnp.nan)


def _windows(values: Float[jax.Array, "ny nx"]) -> Float[jax.Array, "window_rows window_columns"]:
    """The largest in each window, see `HorizonView`; -inf beyond the grid."""
    ny, nx = values.shape
    known = jnp.pad(values, ((0, -ny % _GRAIN), (0, -nx % _GRAIN)), constant_values=-jnp.inf)
    blocks = known.reshape(known.shape[0] // _GRAIN, _GRAIN, -1, _GRAIN).max((1, 3))
    blocks = jnp.pad(blocks, _REACH, constant_values=-jnp.inf)
    rows, columns = (n - _REACH + 1 for n in blocks.shape)
    high = functools.reduce(jnp.maximum, (blocks[k : k + rows] for k in range(_REACH)))
    return functools.reduce(jnp.maximum, (high[:, k : k + columns] for k in range(_REACH)))
