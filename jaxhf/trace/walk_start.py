"""Where a ray's walk over a grid starts: at the border of the surface's box, or at the hit that the ray leaves."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax

from ..core.ray import Ray
from ..core.types import Flag, Index, Scalar, Vector
from ..core.vector import FAR, finite, lesser
from ..xla.materialise import materialise
from .grid import Grid, height_over, triangle_plane
from .hit import Hit
from .walk import LEAVING, MISS, WALKING, Walk, reciprocal


def _surface_start(grid: Grid, leaving: Hit | None, number: int) -> tuple[Any, ...]:
    """Whether a ray starts on this grid; then its cell, its place as in `place_on_grid`, whether in the upper triangle, and its
    side. All None for rays that start in free space."""
    if leaving is None:
        return (None,) * 7
    start = leaving.object == number, *place_on_grid(grid, leaving), leaving.triangle == 1, leaving.side
    return lax.stop_gradient(materialise(start))


def place_on_grid(grid: Grid, hit: Hit) -> tuple[Index, Index, Scalar, Scalar]:
    """The cell of a hit, and its point in grid coordinates; in range also where the hit lies on another surface."""
    (cells_x, cells_y), (extent_x, extent_y) = grid.cells, grid.extent
    ix, iy = (jnp.clip(hit.cell[k], 0, cells - 1) for k, cells in enumerate((cells_x, cells_y)))
    return ix, iy, hit.uv[0] * extent_x, hit.uv[1] * extent_y


def point_on_grid(grid: Grid, hit: Hit) -> Vector:
    """The point of a hit on the plane of its triangle, in the grid's frame."""
    ix, iy, x, y = place_on_grid(grid, hit)
    return jnp.stack([x, y, height_over(grid, ix, iy, hit.triangle == 1, x, y)])


def walk_start(
    grid: Grid, ray: Ray, leaving: Hit | None, number: int, t_max: Scalar | None, active: Flag | None
) -> tuple[Walk, jax.Array, Flag]:
    """The constants of a ray's walk, the state in which it starts, and whether the ray is finite and has a direction.

    The arguments are those of `first_triangle`.
    """
    width, height = grid.pyramid.width, grid.pyramid.height
    valid = finite(ray.o) & finite(ray.d) & ((ray.d[0] != 0) | (ray.d[1] != 0) | (ray.d[2] != 0))
    dx, dy, dz = ray.d[0], ray.d[1], ray.d[2]
    inverse = inv_x, inv_y, inv_z = reciprocal(dx), reciprocal(dy), reciprocal(dz)
    t_start, enters, through_end = _enter(grid, ray, inverse, valid)
    (cells_x, cells_y), (extent_x, extent_y) = grid.cells, grid.extent
    # An ulp inside the far border, so that a ray which stands still on it is in the last cell.
    inside = 1 - jnp.finfo(dx.dtype).epsneg
    x = jnp.clip(ray.o[0] + t_start * dx, 0, extent_x * inside)
    y = jnp.clip(ray.o[1] + t_start * dy, 0, extent_y * inside)
    z_ray = jnp.clip(ray.o[2] + t_start * dz, 0, grid.z_top)
    away, own_ix, own_iy, own_x, own_y, own_upper, side = _surface_start(grid, leaving, number)
    if leaving is not None:
        on_triangle = height_over(grid, own_ix, own_iy, own_upper, own_x, own_y)
        enters, t_start = enters | away, jnp.where(away, 0, t_start)
        x, y, z_ray = jnp.where(away, own_x, x), jnp.where(away, own_y, y), jnp.where(away, on_triangle, z_ray)

    # From the grid's frame to the walk's.
    back_x, back_y = inv_x < 0, inv_y < 0
    end_x, end_y = jnp.where(back_x, width, cells_x), jnp.where(back_y, height, cells_y)
    x, y = (jnp.where(back, n.astype(at.dtype) - at, at) for back, n, at in ((back_x, width, x), (back_y, height, y)))
    turned = back_x != back_y
    rate = jnp.where(turned, jnp.abs(dx) + jnp.abs(dy), jnp.abs(dx) - jnp.abs(dy))
    begins_upper = (rate > 0) != back_x
    walk = Walk(
        rows=grid.rows,
        nx=grid.nx,
        pyramid=grid.pyramid,
        of_x=2 * width - 1,
        first_of_y=(4 + grid.pyramid.log_width).astype(jnp.uint32),
        x=x,
        y=y,
        z_ray=z_ray,
        dx=jnp.abs(dx),
        dy=jnp.abs(dy),
        dz=dz,
        inv_x=jnp.abs(inv_x),
        inv_y=jnp.abs(inv_y),
        back_x=back_x,
        back_y=back_y,
        along_diagonals=jnp.where(turned, x + y, x - y),
        rate=rate,
        inv_rate=reciprocal(rate),
        t_start=t_start,
        t_end=jnp.where(inv_z > 0, grid.z_top - z_ray, -z_ray) * inv_z,
        t_stop=jnp.full_like(x, jnp.inf),
        budget=grid.most_steps,
        ahead=None if leaving is None else (own_upper == begins_upper) & (rate != 0),
        first=grid.first,
        noise=None if leaving is None else jnp.where(away, 4 * jnp.finfo(x.dtype).eps * grid.z_top, 0),
    )
    t_stop = lesser(lesser(walk.distance_x(end_x), walk.distance_y(end_y)), walk.t_end)
    walk = eqx.tree_at(lambda walk: walk.t_stop, walk, t_stop if t_max is None else lesser(t_stop, t_max - t_start))

    # Planes in x count as crossed at their own distance and planes in y just behind it, so that at a vertex x is
    # crossed first.
    ix = jnp.clip(jnp.floor(x).astype(jnp.int32), end_x - cells_x, end_x - 1)
    iy = jnp.clip(jnp.ceil(y).astype(jnp.int32) - 1, end_y - cells_y, end_y - 1)
    flip_x, flip_y = walk.flip
    u, v = x - ix.astype(x.dtype), y - iy.astype(y.dtype)
    u, v = jnp.where(back_x, 1 - u, u), jnp.where(back_y, 1 - v, v)
    a, b, c = triangle_plane(grid, ix ^ flip_x, iy ^ flip_y, v > u)
    gap = z_ray - (c + a * u + b * v)
    gap = jnp.where(gap == 0, dz - a * dx - b * dy, gap)  # on the surface: where it goes
    above = jnp.where(through_end, dz < 0, gap >= 0)
    going = enters if active is None else enters & active
    status = jnp.where(going, WALKING, MISS)
    if leaving is not None:
        ix, iy = jnp.where(away, own_ix ^ flip_x, ix), jnp.where(away, own_iy ^ flip_y, iy)
        above = jnp.where(away, side > 0, above)
        status = jnp.where(going & away, LEAVING, status)
    return walk, walk.pack(status, above, 2 * ix + 1, iy), valid


def _enter(grid: Grid, ray: Ray, inverse: tuple[Scalar, Scalar, Scalar], valid: Flag) -> tuple[Scalar, Flag, Flag]:
    """t at which the ray enters the surface's box, whether it does, and whether it comes through the floor or the ceiling.

    In the last case its side of the surface is known, whatever the rounding of the height there. The far distances are
    widened by the rounding of the operations behind them, so that no ray along a face is lost (Ize, Robust BVH ray
    traversal, JCGT 2(2), 2013).
    """
    cells_x, cells_y = grid.extent
    near_x, far_x = _slab(ray.o[0], inverse[0], cells_x)
    near_y, far_y = _slab(ray.o[1], inverse[1], cells_y)
    near_z, far_z = _slab(ray.o[2], inverse[2], grid.z_top)
    start = jnp.maximum(jnp.maximum(near_x, near_y), jnp.maximum(near_z, 0))
    wide = 1 + 8 * jnp.finfo(start.dtype).eps
    enters = valid & (start <= jnp.minimum(jnp.minimum(far_x, far_y), far_z) * wide)
    start = jnp.where(enters, start, 0)
    return start, enters, ((ray.o[2] < 0) | (ray.o[2] > grid.z_top)) & (start == near_z)


def _slab(o: Scalar, inverse: Scalar, high: Scalar) -> tuple[Scalar, Scalar]:
    """Distances between which a ray is in 0 <= coordinate <= high; (inf, -inf) where it never is."""
    a, b = -o * inverse, (high - o) * inverse
    still, inside = inverse == FAR, (o >= 0) & (o <= high)
    near = jnp.where(still, jnp.where(inside, -jnp.inf, jnp.inf), jnp.minimum(a, b))
    far = jnp.where(still, jnp.where(inside, jnp.inf, -jnp.inf), jnp.maximum(a, b))
    return near, far
