"""A heightfield made ready for tracing."""

import functools
import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Bool, Float, Int, Shaped

from ..core.affine import Affine
from ..core.errors import UserError
from ..core.settings import Settings
from ..core.types import MOST_PLACES, Flag, Index, Scalar
from ..core.vector import floor_to_power_of_two
from ..scene.heightfield import Heightfield, Size
from .normals import vertex_normals
from .pyramid import Pyramid, enough_steps, levels_of, make_pyramid
from .triangle import Corners, plane_through, triangle_corners


class Grid(eqx.Module):
    """A heightfield made ready for tracing, in a frame of its own: cells by cells by heights.

    In the grid's frame vertex (ix, iy) stands at x = ix, y = iy, and heights are relative to the lowest and divided by a
    power of two, so that the walk sees the same bits whatever the offset, and neither over- nor underflows. Where the
    frame lies (lowest height, scale) is held constant under differentiation, as any choice of it gives the same surface.

    Heights and normals are flat arrays, row after row: XLA adds a tile's derivatives to a flat array in place, where for one
    that is reshaped on the way it makes a whole array for every tile (480 against 128 to 154 ms at 1024² heights).

    Attributes:
      rows: heights; a hole is nan.
      z_top: the largest of them.
      pyramid: bounds over blocks of cells.
      normals: at the vertices, object frame; None where shading is flat.
      cells, extent: cells along x and along y, the second as numbers of the heights' type.
      known_shape: (ny, nx); None where a program serves several, see `of_any_terrain`.
      most_steps: of a search on it: as many as suffice for any ray, or `Settings.max_steps` if that is less.
      fixed_steps: the same, where searches always take all of them; None where they end early, see `Settings.early_exit`.
      perturbation: what is added at the vertices of the triangle that a ray meets, for derivatives of one ray in those
        numbers alone; None: nothing.
      first: the place of the first vertex in `rows` and `normals`; None: 0, else they hold several grids, see `joined`.
      seam: the vertices where the surface goes on in another grid; None: there are none.
      still: whether it is known where its edges are seen, so that no derivative asks for these; their shadows may move.
    """

    rows: Float[jax.Array, " vertices"]
    z_top: Scalar
    pyramid: Pyramid
    normals: Float[jax.Array, "vertices 3"] | None
    world_from_grid: Affine
    grid_from_world: Affine
    object_from_world: Affine | None
    cells: tuple[Index, Index]
    extent: tuple[Scalar, Scalar]
    known_shape: tuple[int, int] | None = eqx.field(static=True)
    most_steps: Index
    fixed_steps: int | None = eqx.field(static=True)
    perturbation: Corners | None = None
    first: Index | None = None
    seam: Bool[jax.Array, "ny nx"] | None = None
    still: bool = eqx.field(static=True, default=False)

    @property
    def z(self) -> Float[jax.Array, "ny nx"]:
        """The heights as an array of two axes."""
        return self.rows[: math.prod(self.shape)].reshape(self.shape)

    @property
    def shape(self) -> tuple[int, int]:
        """(ny, nx), where it is known as a program is made."""
        assert self.known_shape is not None
        return self.known_shape

    @property
    def nx(self) -> Index:
        """Vertices in a row."""
        return self.cells[0] + 1


def make_grid(field: Heightfield, world_from_object: Affine | None, settings: Settings, size: Size | None = None) -> Grid:
    """Prepares `field` for tracing: dense array arithmetic, differentiable in the heights and in the transform.

    Its x0 and y0 must be 0, see `localise`. The scheme of its normals and the levels of its bounds are those of the settings.
    With a `size` that is data, beyond which its heights are holes, only the `known_shape` and the order of what is flat are
    those of the array; each side of that must round up to the same power of two as the size's.
    """
    heights = jnp.asarray(field.heights)
    (ny, nx), dtype = heights.shape, heights.dtype
    finite = jnp.isfinite(heights)
    known = lax.stop_gradient(jnp.where(finite, heights, 0))
    largest = jnp.max(jnp.abs(known))
    unit_height = floor_to_power_of_two(jnp.where(largest > 0, largest, 1))
    lowest = jnp.min(jnp.where(finite, known, jnp.inf), initial=jnp.inf)
    lowest = jnp.where(finite.any(), lowest, 0)
    z = jnp.where(finite, heights / unit_height - lowest / unit_height, jnp.nan)
    z_top = jnp.max(lax.stop_gradient(jnp.where(finite, z, 0)))

    (cells_x, cells_y), (dx, dy) = (nx - 1, ny - 1), (field.dx, field.dy)
    if size is not None:
        (cells_x, cells_y), (dx, dy) = size.cells, size.spacing
    cell = jnp.stack([jnp.full((), dx, dtype), jnp.full((), dy, dtype), unit_height])
    ground = jnp.stack([jnp.zeros((), dtype), jnp.zeros((), dtype), lowest])
    if world_from_object is None:
        world_from_grid = Affine(jnp.diag(cell), ground)
        grid_from_world = Affine(jnp.diag(1 / cell), -ground / cell)
        object_from_world = None
    else:
        object_from_world = world_from_object.inverse()
        world_from_grid = Affine(world_from_object.linear * cell[None, :], world_from_object.point(ground))
        grid_from_world = Affine(object_from_world.linear / cell[:, None], (object_from_world.offset - ground) / cell)
    normals = None
    if settings.shading == "smooth":
        normals = _at_seam(field, vertex_normals(heights, dx, dy, settings.normals or "six")).reshape(-1, 3)
    levels = 0 if settings.traversal == "dda" else levels_of((ny, nx))
    cells, extent = ((jnp.asarray(cells_x, kind), jnp.asarray(cells_y, kind)) for kind in (jnp.int32, dtype))
    pyramid = make_pyramid(lax.stop_gradient(z), z_top, levels, cells)
    most: Any = enough_steps(cells_x, cells_y, levels)
    if settings.max_steps is not None:
        most = min(settings.max_steps, most) if size is None else jnp.minimum(settings.max_steps, most)
    return Grid(
        z.reshape(-1), z_top, pyramid, normals, world_from_grid, grid_from_world, object_from_world,
        cells, extent, (ny, nx), jnp.int32(most), None if settings.early_exit else most,
        seam=None if field.seam is None else jnp.isfinite(field.seam[..., 0]),
    )  # fmt: skip


def _at_seam(field: Heightfield, normals: Float[jax.Array, "ny nx 3"]) -> Float[jax.Array, "ny nx 3"]:
    """Normals with those of the seam put in: all of one weight, that of a vertex with all of its triangles."""
    if field.seam is None:
        return normals
    up = jnp.full((*normals.shape[:2], 1), lax.stop_gradient(jnp.max(normals[..., 2])))
    given = up * jnp.concatenate([-jnp.asarray(field.seam), jnp.ones_like(up)], axis=-1)
    return jnp.where(jnp.isfinite(given).all(-1, keepdims=True), given, normals)


put_at = functools.partial(eqx.tree_at, is_leaf=lambda leaf: leaf is None)
"""`equinox.tree_at`, also in place of None."""


def joined(grids: Grid) -> tuple[Grid, Grid]:
    """Grids of one shape, which come with a leading axis, in common arrays, so that rays on any of them make up one batch.

    Returns:
      The heights, bounds and normals of all, one after the other; and the rest of each, with the leading axis. The first with
      one of the second makes a grid, see `equinox.combine`.
    """

    def in_common(grid: Grid) -> tuple[Any, ...]:
        blocks = grid.pyramid
        sizes = blocks.width, blocks.height, blocks.log_width, blocks.largest, blocks.below
        return grid.rows, grid.normals, blocks.bounds, *sizes, *grid.cells, *grid.extent, grid.most_steps

    def of_all(leaf: jax.Array) -> jax.Array:
        return leaf[0] if leaf.ndim == 1 else leaf.reshape(-1, *leaf.shape[2:])

    places = first_places(grids.rows), first_places(grids.pyramid.bounds)
    grids = put_at(lambda grid: (grid.first, grid.pyramid.first), grids, places)
    shared, own = eqx.partition(grids, put_at(in_common, jax.tree.map(lambda _: False, grids), replace_fn=lambda _: True))
    return jax.tree.map(of_all, shared), own


def first_places(values: Shaped[jax.Array, "count n"]) -> Int[jax.Array, " count"]:
    """Where each row begins, when all stand in one array, one after the other; UserError where that has too many numbers."""
    if values.size > MOST_PLACES:
        share = f"{len(values)} heightfields under a vmap share an array of {values.size} numbers"
        raise UserError(f"{share}, at most {MOST_PLACES} can be addressed; jax.lax.map with a batch_size takes fewer")
    return jnp.arange(len(values), dtype=jnp.int32) * values.shape[1]


def triangle_plane(grid: Grid, ix: Index, iy: Index, upper: Flag) -> tuple[Scalar, Scalar, Scalar]:
    """(a, b, c) of the triangle's plane c + a u + b v, with u and v from the cell's vertex 00; finite in a hole too."""
    return plane_through(triangle_corners(grid.rows, grid.nx, ix, iy, upper, grid.first), upper)


def height_over(grid: Grid, ix: Index, iy: Index, upper: Flag, x: Scalar, y: Scalar) -> Scalar:
    """The height of that plane over the point (x, y); all in the grid's frame."""
    a, b, c = triangle_plane(grid, ix, iy, upper)
    return c + a * (x - ix.astype(x.dtype)) + b * (y - iy.astype(y.dtype))
