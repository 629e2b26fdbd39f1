"""Which edges of a heightfield bound what is seen or lit: dense arithmetic over the grid, without a derivative.

The kinds of edges are those of `trace.edges`. Arrays over them have the shape (3, vertices), with vertices as in `Grid.rows`:
so a program may serve terrains of many sizes. Edges that would leave the grid are there too; they bound nothing.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Bool, Float, Int, Shaped

from ..core.types import Index, Vector
from ..scene.camera import Camera
from ..scene.projection import size_of
from ..trace.edges import STEPS
from ..trace.grid import Grid
from ..xla.materialise import materialise

EdgeFlags = Bool[jax.Array, "3 vertices"]
EdgeWeights = Float[jax.Array, "3 vertices"]

Viewpoint = tuple[Vector, bool]
"""An eye or a light: at this point (True), or infinitely far away in this direction (False); world frame."""


def silhouettes(grid: Grid, viewpoint: Viewpoint) -> EdgeFlags:
    """The edges with exactly one of their two triangles facing the viewpoint, and those that have only one triangle.

    (Hertzmann and Zorin, Illustrating smooth surfaces, SIGGRAPH 2000, section 4.1, on polygons.) Edges at the border and
    at holes have one triangle, but where the surface goes on in another grid.
    """
    return _without_seam(grid, _compare_sides(grid, *_facing(grid, viewpoint), lambda a, b: a != b))


def all_edges(grid: Grid) -> EdgeFlags:
    """The edges with at least one triangle, but for those with one where the surface goes on in another grid."""
    present, _ = _cells(grid)
    return _without_seam(grid, _compare_sides(grid, present, present, lambda a, b: a | b))


def _without_seam(grid: Grid, flags: EdgeFlags) -> EdgeFlags:
    if grid.seam is None:
        return flags
    (present, _), seam = _cells(grid), grid.seam.reshape(-1)
    alone = _compare_sides(grid, present, present, lambda a, b: a != b)
    return flags & ~(seam[None] & _at_second_vertices(grid, seam) & alone)


def folds(grid: Grid, viewpoint: Viewpoint) -> EdgeFlags:
    """The edges with one triangle that faces the viewpoint and one that faces away."""
    return _compare_sides(grid, *_facing(grid, viewpoint), lambda a, b: a * b < 0)


def _facing(grid: Grid, viewpoint: Viewpoint) -> tuple[Int[jax.Array, " vertices"], Int[jax.Array, " vertices"]]:
    """Of the lower and the upper triangle of the cell that begins at each vertex: 1 where the viewpoint stands on its +z side,
    -1 on the other, 0 where there is no triangle."""
    (v, at_place), to_grid = viewpoint, grid.grid_from_world
    v = to_grid.point(v) if at_place else to_grid.vector(v)
    present, (z00, z10, z01, z11) = _cells(grid)
    to_x, to_y, to_z = v[0], v[1], v[2]
    if at_place:
        x, y = vertices_of(grid)
        to_x, to_y, to_z = v[0] - x.astype(v.dtype), v[1] - y.astype(v.dtype), v[2] - z00

    def facing(a: jax.Array, b: jax.Array) -> jax.Array:
        return jnp.where(present, jnp.where(to_z - a * to_x - b * to_y >= 0, 1, -1), 0).astype(jnp.int8)

    return materialise((facing(z10 - z00, z11 - z10), facing(z11 - z01, z01 - z00)))


def _further(grid: Grid, values: Shaped[jax.Array, " n"], x: Index | int, y: Index | int) -> Shaped[jax.Array, " n"]:
    """At each vertex, what stands so many vertices further along x and along y; beyond the grid's border some other value."""
    n, by = values.shape[0], y * grid.nx + x
    # As `jnp.roll`, in a third of its equations.
    return lax.dynamic_slice(jnp.concatenate([values, values]), (jnp.where(by < 0, by + n, by),), (n,))


def _cells(grid: Grid) -> tuple[Bool[jax.Array, " vertices"], tuple[jax.Array, ...]]:
    """Whether a cell begins at each vertex that has all of its own, and their heights, at 00, 10, 01, 11; a hole is nan."""
    corners = (grid.rows, *(_further(grid, grid.rows, *step) for step in STEPS))
    x, y = vertices_of(grid)
    return jnp.isfinite(sum(corners)) & (x < grid.cells[0]) & (y < grid.cells[1]), corners


def _compare_sides(grid: Grid, lower: jax.Array, upper: jax.Array, compare: Callable[[Any, Any], jax.Array]) -> EdgeFlags:
    """Compares the two triangles of every edge, given values of the lower and the upper one of the cell that begins at each
    vertex; they are zero where none does, so that zero stands beyond the border, whichever vertex `_further` takes."""
    below, left = _further(grid, upper, 0, -1), _further(grid, lower, -1, 0)
    return jnp.stack([compare(lower, below), compare(upper, left), compare(lower, upper)])


def _at_second_vertices(grid: Grid, values: Shaped[jax.Array, " n"]) -> Shaped[jax.Array, "3 n"]:
    """Of values at vertices, those at the second vertices of edges."""
    return jnp.stack([_further(grid, values, *step) for step in STEPS])


def vertices_of(grid: Grid) -> tuple[Int[jax.Array, " vertices"], Int[jax.Array, " vertices"]]:
    """(ix, iy) of every number in `Grid.rows`; those that only fill the array come after the last row."""
    number = jnp.arange(grid.rows.shape[0], dtype=jnp.int32)
    y = materialise(lax.div(number, grid.nx))  # once: whole numbers are divided slowly
    return number - y * grid.nx, y


def _places(grid: Grid) -> tuple[Float[jax.Array, " vertices"], Float[jax.Array, " vertices"]]:
    x, y = vertices_of(grid)
    return x.astype(grid.rows.dtype), y.astype(grid.rows.dtype)


def _steps(dtype: Any) -> tuple[jax.Array, jax.Array]:
    """From the first vertex of the edges of each kind to the second, in x and in y; shape (3, 1)."""
    along_x, along_y = (jnp.array(steps, dtype)[:, None] for steps in zip(*STEPS, strict=True))
    return along_x, along_y


def _heights(grid: Grid) -> tuple[Float[jax.Array, " vertices"], EdgeWeights]:
    """At the first vertices of edges, and at the second ones; zero in holes."""
    z = jnp.where(jnp.isfinite(grid.rows), grid.rows, 0)
    return z, materialise(_at_second_vertices(grid, z))


def seen_lengths(grid: Grid, camera: Camera, margin: float = 0.0) -> EdgeWeights:
    """The length in the picture, in pixels, of the part of every edge that lies in its frame; hidden or not.

    `margin`: by how much the frame is narrower than the picture, pixels.
    """
    film, z = camera.film_from_world().of(grid.world_from_grid), jnp.where(jnp.isfinite(grid.rows), grid.rows, 0)
    width, height = size_of(camera)
    (x, y), across = _places(grid), jnp.asarray(width + height, z.dtype)

    def seen(x: jax.Array, y: jax.Array, z: jax.Array) -> list[jax.Array]:
        return [film.linear[k, 0] * x + film.linear[k, 1] * y + film.linear[k, 2] * z + film.offset[k] for k in range(4)]

    a = seen(x, y, z)

    def of_kind(step: tuple[jax.Array, jax.Array]) -> jax.Array:
        dx, dy = step
        b = seen(x + dx.astype(z.dtype), y + dy.astype(z.dtype), _further(grid, z, dx, dy))
        first, last = framed_part(camera, a, b, margin)
        w = [a[2] + s * (b[2] - a[2]) for s in (first, last)]
        ends = [
            tuple((a[k] + s * (b[k] - a[k])) / jnp.where(w > 0, w, 1) for k in (0, 1))
            for s, w in zip((first, last), w, strict=True)
        ]
        dx, dy = (jnp.clip(ends[1][k] - ends[0][k], -across, across) for k in (0, 1))
        return jnp.where(last > first, jnp.sqrt(dx * dx + dy * dy), 0)

    # Kind by kind, each in one pass: all at once, with what they share in memory, took four times as long.
    return lax.map(of_kind, tuple(jnp.array(STEPS, jnp.int32).T))


def framed_part(camera: Camera, a: Any, b: Any, margin: float = 0.0) -> tuple[jax.Array, jax.Array]:
    """Between which s the points a + s (b - a) lie in the picture's frame and before the camera; first > last: nowhere.

    Clipping in homogeneous coordinates (Liang and Barsky, ACM TOG 3(1), 1984; Blinn and Newell 1978).

    Args:
      camera: whose frame it is.
      a, b: the coordinates of `Projection`, scalars or arrays.
      margin: by how much the frame is narrower than the picture, pixels.
    """
    first, last = jnp.zeros_like(a[0]), jnp.ones_like(a[0])
    for at_a, at_b in zip(_inside(camera, a, margin), _inside(camera, b, margin), strict=True):
        cut = at_a / jnp.where(at_a == at_b, 1, at_a - at_b)
        first = jnp.where((at_a < 0) & (at_b > 0), jnp.maximum(first, cut), first)
        last = jnp.where((at_a > 0) & (at_b < 0), jnp.minimum(last, cut), last)
        last = jnp.where((at_a <= 0) & (at_b <= 0), -1, last)
    return first, last


def _inside(camera: Camera, at: Any, margin: float) -> tuple[jax.Array, ...]:
    """Positive within each border of the frame, and before the camera."""
    (x, y, w, depth), (width, height) = (at[k] for k in range(4)), size_of(camera)
    borders = x, width * w - x, y, height * w - y
    return *(at - margin * w if margin else at for at in borders), depth


def lit_lengths(grid: Grid, light: Viewpoint) -> EdgeWeights:
    """The length of every edge as seen from a light: projected across its direction; for a point light, as an angle."""
    world, (x, y), (z, second), (v, at_place) = grid.world_from_grid, _places(grid), _heights(grid), light

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
