"""Which edges of a heightfield bound what is seen or lit: dense arithmetic over the grid, without a derivative.

Arrays over edges are those of `trace.edges`; an edge that would leave the grid bounds nothing.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Float

from ..core.types import Vector
from ..scene.camera import Camera
from ..trace.edges import STEPS, EdgeFlags, at_second_vertices, compare_sides, present_edges, whole_cells
from ..trace.grid import Grid
from ..xla.materialise import materialise

EdgeWeights = Float[jax.Array, "3 ny nx"]

Viewpoint = tuple[Vector, bool]
"""An eye or a light: at this point (True), or infinitely far away in this direction (False); world frame."""


def silhouettes(grid: Grid, viewpoint: Viewpoint) -> EdgeFlags:
    """The edges with exactly one of their two triangles facing the viewpoint, and those that have only one triangle.

    (Hertzmann and Zorin, Illustrating smooth surfaces, SIGGRAPH 2000, section 4.1, on polygons.) Edges at the border and
    at holes have one triangle, but where the surface goes on in another grid.
    """
    return _without_seam(grid, compare_sides(*_facing(grid, viewpoint), lambda a, b: a != b))


def all_edges(grid: Grid) -> EdgeFlags:
    """The edges with at least one triangle, but for those with one where the surface goes on in another grid."""
    return _without_seam(grid, present_edges(grid.z))


def _without_seam(grid: Grid, flags: EdgeFlags) -> EdgeFlags:
    if grid.seam is None:
        return flags
    present, on_seam = whole_cells(grid.z), grid.seam[None] & at_second_vertices(grid.seam)
    return flags & ~(on_seam & compare_sides(present, present, lambda a, b: a != b))


def folds(grid: Grid, viewpoint: Viewpoint) -> EdgeFlags:
    """The edges with one triangle that faces the viewpoint and one that faces away."""
    return compare_sides(*_facing(grid, viewpoint), lambda a, b: a * b < 0)


def _facing(grid: Grid, viewpoint: Viewpoint) -> tuple[jax.Array, jax.Array]:
    """1 where the viewpoint stands on the +z side of a triangle, -1 on the other, 0 where there is no triangle."""
    (v, at_place), to_grid = viewpoint, grid.grid_from_world
    v = to_grid.point(v) if at_place else to_grid.vector(v)
    z00, z10, z01, z11 = grid.z[:-1, :-1], grid.z[:-1, 1:], grid.z[1:, :-1], grid.z[1:, 1:]
    to_x, to_y, to_z = v[0], v[1], v[2]
    if at_place:
        x, y = _vertices(grid)
        to_x, to_y, to_z = v[0] - x[:-1, :-1], v[1] - y[:-1, :-1], v[2] - z00
    present = whole_cells(grid.z)

    def facing(a: jax.Array, b: jax.Array) -> jax.Array:
        return jnp.where(present, jnp.where(to_z - a * to_x - b * to_y >= 0, 1, -1), 0).astype(jnp.int8)

    return facing(z10 - z00, z11 - z10), facing(z11 - z01, z01 - z00)


def _vertices(grid: Grid) -> tuple[jax.Array, jax.Array]:
    ny, nx = grid.shape
    x, y = jnp.meshgrid(jnp.arange(nx, dtype=grid.z.dtype), jnp.arange(ny, dtype=grid.z.dtype))
    return x, y


def _steps(dtype: Any) -> tuple[jax.Array, jax.Array]:
    """From the first vertex of the edges of each kind to the second, in x and in y; shape (3, 1, 1)."""
    along_x, along_y = (jnp.array(steps, dtype)[:, None, None] for steps in zip(*STEPS, strict=True))
    return along_x, along_y


def _heights(grid: Grid) -> tuple[Float[jax.Array, "ny nx"], EdgeWeights]:
    """At the first vertices of edges, and at the second ones; zero in holes and beyond the grid."""
    z = jnp.where(jnp.isfinite(grid.z), grid.z, 0)
    return z, materialise(at_second_vertices(z))


def seen_lengths(grid: Grid, camera: Camera) -> EdgeWeights:
    """The length in the picture, in pixels, of the part of every edge that lies in its frame; hidden or not."""
    film, (z, second) = camera.film_from_world().of(grid.world_from_grid), _heights(grid)

    def seen(x: jax.Array, y: jax.Array, z: jax.Array) -> list[jax.Array]:
        return [film.linear[k, 0] * x + film.linear[k, 1] * y + film.linear[k, 2] * z + film.offset[k] for k in range(4)]

    (x, y), (along_x, along_y) = _vertices(grid), _steps(z.dtype)
    a = [jnp.stack([row] * 3) for row in materialise(seen(x, y, z))]
    b = materialise(seen(x[None] + along_x, y[None] + along_y, second))
    first, last = materialise(framed_part(camera, a, b))
    w = [a[2] + s * (b[2] - a[2]) for s in (first, last)]
    ends = [
        tuple((a[k] + s * (b[k] - a[k])) / jnp.where(w > 0, w, 1) for k in (0, 1))
        for s, w in zip((first, last), w, strict=True)
    ]
    across = jnp.asarray(camera.width + camera.height, a[0].dtype)
    dx, dy = (jnp.clip(ends[1][k] - ends[0][k], -across, across) for k in (0, 1))
    return jnp.where(last > first, jnp.sqrt(dx * dx + dy * dy), 0)


def framed_part(camera: Camera, a: Any, b: Any) -> tuple[jax.Array, jax.Array]:
    """Between which s the points a + s (b - a) lie in the picture's frame and before the camera; first > last: nowhere.

    Clipping in homogeneous coordinates (Liang and Barsky, ACM TOG 3(1), 1984; Blinn and Newell 1978).

    Args:
      camera: whose frame it is.
      a, b: the coordinates of `Projection`, scalars or arrays.
    """
    first, last = jnp.zeros_like(a[0]), jnp.ones_like(a[0])
    for at_a, at_b in zip(_inside(camera, a), _inside(camera, b), strict=True):
        cut = at_a / jnp.where(at_a == at_b, 1, at_a - at_b)
        first = jnp.where((at_a < 0) & (at_b > 0), jnp.maximum(first, cut), first)
        last = jnp.where((at_a > 0) & (at_b < 0), jnp.minimum(last, cut), last)
        last = jnp.where((at_a <= 0) & (at_b <= 0), -1, last)
    return first, last


def _inside(camera: Camera, at: Any) -> tuple[jax.Array, ...]:
    """Positive within each border of the frame, and before the camera."""
    x, y, w, depth = at[0], at[1], at[2], at[3]
    return x, camera.width * w - x, y, camera.height * w - y, depth


def lit_lengths(grid: Grid, light: Viewpoint) -> EdgeWeights:
    """The length of every edge as seen from a light: projected across its direction; for a point light, as an angle."""
    world, (x, y), (z, second), (v, at_place) = grid.world_from_grid, _vertices(grid), _heights(grid), light

    def turned(vx: jax.Array, vy: jax.Array, vz: jax.Array) -> list[jax.Array]:
        return [world.linear[k, 0] * vx + world.linear[k, 1] * vy + world.linear[k, 2] * vz for k in range(3)]

    e = turned(*_steps(z.dtype), second - z[None])
    to: list[Any] = [v[k] for k in range(3)]
    if at_place:
        to = [v[k] - world.offset[k] - p for k, p in enumerate(turned(x[None], y[None], z[None]))]
    square = to[0] * to[0] + to[1] * to[1] + to[2] * to[2]
    cross = [e[i] * to[j] - e[j] * to[i] for i, j in ((1, 2), (2, 0), (0, 1))]
    across = jnp.sqrt(cross[0] * cross[0] + cross[1] * cross[1] + cross[2] * cross[2])
    square = jnp.where(square > 0, square, 1)
    return across / (square if at_place else jnp.sqrt(square))
