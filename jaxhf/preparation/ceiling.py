"""Where a directional light reaches a heightfield for certain: a bound for each cell, from one sweep along the light."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Float, Int

from ..core.types import Flag, Index, Scalar, Vector
from ..core.vector import largest_component
from ..trace.grid import Grid, triangle_plane
from ..trace.hit import Hit
from ..trace.pyramid import beyond
from ..trace.walk import reciprocal
from ..trace.walk_start import place_on_grid
from ..xla.materialise import value_at


class Ceiling(eqx.Module):
    """How high a point on a heightfield must be so that nothing of it can keep a directional light away; in the grid's frame.

    Cells lie in strips across the light: columns where it moves more along x, else rows. Along the strips they are cut by
    lines parallel to the light into bins that are one cell wide. The height of a point is taken where the light's ray through
    it passes the side of its cell that has the lower ix or iy.

    Attributes:
      heights: the bound, of each bin of each strip in the order in which a ray to the light meets them.
      first: of each strip, the column in `heights` of the bin at 0.
      columns: whether the strips are columns.
      back: whether the light stands towards lower ix or iy.
      across: cells by which the light moves along a strip while it crosses it, -1 to 1.
      rise: of the light's ray from one strip to that with the next ix or iy.
    """

    heights: Float[jax.Array, " bins"]
    first: Int[jax.Array, " strips"]
    columns: Flag
    back: Flag
    across: Scalar
    rise: Scalar


def make_ceiling(grid: Grid, towards: Vector) -> Ceiling:
    """The bound under a light that stands in the direction `towards` (world frame); without a derivative.

    A ray towards the light that starts on the surface, or above it, cannot meet a triangle that faces the light, as it rises
    faster than the triangle. Only a cell with another triangle can block it, and does not where the ray clears its vertices.
    The height needed for that falls away from the light by what the light rises. It is swept strip after strip (as by Timonen
    and Westerholm, Scalable height field self-shadowing, Computer Graphics Forum 29(2), 2010); a ray stays in its bin. A bin
    takes the highest of the cells that it touches. All is widened by the rounding of a walk.
    """
    grid, towards = lax.stop_gradient((grid, towards))
    z = grid.z
    (cells_x, cells_y), longest = grid.cells, max(z.shape) - 1
    eps, most = float(jnp.finfo(z.dtype).eps), jnp.maximum(*grid.extent)
    d = grid.grid_from_world.vector(towards)
    d = d / largest_component(d)
    columns = jnp.abs(d[0]) > jnp.abs(d[1])
    along, across = jnp.where(columns, d[0], d[1]), jnp.where(columns, d[1], d[0])
    back, per_strip = along < 0, reciprocal(jnp.abs(along))
    d, across = d * per_strip, across * per_strip
    rise = jnp.where(back, -d[2], d[2])

    per_x, per_y = z[:, 1:] - z[:, :-1], z[1:] - z[:-1]
    lower, upper = per_x[:-1] * d[0] + per_y[:, 1:] * d[1], per_x[1:] * d[0] + per_y[:, :-1] * d[1]
    faces = d[2] - jnp.maximum(lower, upper) > 8 * eps * (grid.z_top + jnp.abs(d[2]))
    z00, z10, z01, z11 = z[:-1, :-1], z[:-1, 1:], z[1:, :-1], z[1:, 1:]
    near, far = jnp.maximum(z00, jnp.where(columns, z01, z10)), jnp.maximum(z11, jnp.where(columns, z10, z01))
    needed = jnp.maximum(near, far - rise) + eps * ((64 + 4 * most) * grid.z_top + 8 * most * jnp.abs(rise))
    needed = jnp.where(faces | beyond(needed.shape, grid.cells), -jnp.inf, jnp.where(jnp.isnan(needed), jnp.inf, needed))

    def swept(needed: jax.Array) -> tuple[jax.Array, jax.Array]:
        heights, first = _sweep(needed, strips, back, across, d[2], 8 * eps * most)
        return heights.reshape(-1), first

    strips = jnp.where(columns, cells_x, cells_y)
    if z.shape[0] == z.shape[1]:
        heights, first = swept(lax.cond(columns, jnp.transpose, lambda needed: needed, needed))
    else:
        length = needed.size + 3 * longest

        def padded(needed: jax.Array) -> tuple[jax.Array, jax.Array]:
            heights, first = swept(needed)
            return jnp.pad(heights, (0, length - heights.size)), jnp.pad(first, (0, longest - first.size))

        heights, first = lax.cond(columns, lambda needed: padded(needed.T), padded, needed)
    return Ceiling(heights, first, columns, back, across, rise)


def _sweep(
    needed: Float[jax.Array, "n m"], count: Index, back: Flag, across: Scalar, rise: Scalar, wide: Scalar
) -> tuple[Float[jax.Array, "n bins"], Int[jax.Array, " n"]]:
    """What a ray needs in each bin of a strip to clear what is needed there and ahead, and the column of the bin at 0.

    Args:
      needed: in each cell of each strip; -inf where a cell blocks no ray.
      count: of strips; those behind hold nothing.
      back: whether the last strip comes first on the way to the light; in the result the first does.
      across: cells by which the light moves along a strip while it crosses it, -1 to 1.
      rise: of the light meanwhile.
      wide: by how many cells a ray may be off.
    """
    (strips, cells), nothing = needed.shape, jnp.array(-jnp.inf, needed.dtype)

    def cross(carry: tuple[jax.Array, Index], strip: Index):
        bins, before = carry  # in the column of the first cell that they touch, from -3 on
        begin = across * strip.astype(needed.dtype)
        end = begin + across
        first = jnp.floor(jnp.minimum(begin, end) - wide).astype(jnp.int32)
        more = jnp.floor(1 + jnp.maximum(begin, end) + wide).astype(jnp.int32) - first  # cells than the first, 1 to 3
        number = jnp.where(back, (count - 1 - strip) % strips, strip)  # those that hold nothing stay behind
        row = lax.dynamic_index_in_dim(needed, number, keepdims=False)
        row = lax.pad(row, nothing, [(3, 3, 0)])
        beside = [row[k : k + cells + 3] for k in range(4)]
        bins = lax.dynamic_slice_in_dim(lax.pad(bins, nothing, [(1, 1, 0)]), 1 + before - first, cells + 3) - rise
        bins = jnp.maximum(jnp.maximum(bins, beside[0]), beside[1])
        bins = jnp.maximum(bins, jnp.where(more > 1, beside[2], nothing))
        bins = jnp.maximum(bins, jnp.where(more > 2, beside[3], nothing))
        return (bins, first), (bins, first + 3)

    init = jnp.full(cells + 3, nothing), jnp.zeros((), jnp.int32)
    return lax.scan(cross, init, jnp.arange(strips, dtype=jnp.int32), reverse=True)[1]


def clears(ceiling: Ceiling, grid: Grid, number: int, hit: Hit) -> Flag:
    """Whether the hit lies on the grid, the object of this number, above its bound under a light that is on the hit's side.

    On the lower side of a triangle that is so under no light: the triangle then does not face it, and so bounds itself.
    """
    ix, iy, x, y = place_on_grid(grid, hit)
    a, b, c = triangle_plane(grid, ix, iy, hit.triangle == 1)
    u, v = x - ix.astype(x.dtype), y - iy.astype(y.dtype)
    cells_x, cells_y = grid.cells
    strips, cells = jnp.where(ceiling.columns, cells_x, cells_y), jnp.where(ceiling.columns, cells_y, cells_x)
    strip, along = jnp.where(ceiling.columns, ix, iy), jnp.where(ceiling.columns, x, y)
    strip = jnp.where(ceiling.back, strips - 1 - strip, strip)
    along = jnp.where(ceiling.back, strips.astype(along.dtype) - along, along)
    parallel = jnp.where(ceiling.columns, y, x) - ceiling.across * along
    column = jnp.clip(jnp.floor(parallel).astype(jnp.int32) + value_at(ceiling.first, strip), 0, cells + 2)
    height = c + a * u + b * v - ceiling.rise * jnp.where(ceiling.columns, u, v)
    return (hit.object == number) & (height > value_at(ceiling.heights, strip * (cells + 3) + column))
