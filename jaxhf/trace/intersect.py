"""What stands where a ray meets a surface. The derivative of each hit starts here; that of moving edges in `boundary/`.

The walk has said which triangle; the hit is computed again from that triangle's plane in plain differentiable
arithmetic, so the derivative costs no memory a step and works in forward and in reverse mode.
"""

import dataclasses
import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import lax

from ..core.autodiff import stored
from ..core.ray import Ray
from ..core.types import Flag, Scalar, Vector
from ..core.vector import dot, finite, floor_to_power_of_two, largest_component, quotient, unit
from ..xla.masked import only_where
from ..xla.materialise import materialise
from .cylinder import Tube
from .grid import Grid, triangle_plane
from .hit import Hit, Status, orthogonal_tangents
from .search import first_triangle
from .skirt import Walls, before_terrain
from .triangle import plane_through, triangle_corners
from .walk import WalkResult
from .walk_start import place_on_grid, point_on_grid

Surface = Grid | Tube | Walls


def intersect(
    surface: Surface,
    number: int,
    ray: Ray,
    *,
    leaving: Hit | None = None,
    active: Flag | None = None,
    t_max: Scalar | None = None,
    count_steps: bool = False,
    tangents: bool = False,
) -> Hit:
    """The first hit of a world-frame ray on one surface.

    Args:
      surface: a prepared shape.
      number: of its object, for `Hit.object`.
      ray: one that is not finite, or whose `d` is zero, ends as INVALID.
      leaving, active, t_max, count_steps: see `first_triangle`; `leaving` may lie on another surface.
      tangents: whether the hit is to have its tangents, and the derivatives of `ns`.
    """
    valid = finite(ray.o) & finite(ray.d)
    ray = Ray(jnp.where(valid, ray.o, 0), jnp.where(valid, ray.d, 0))
    if not isinstance(surface, Grid):
        t, found, side = materialise(surface.distance(ray, leaving, number))
        found = found if active is None else found & active
        valid = largest_component(ray.d) > 0
        met, t = found & valid, jnp.where(found, t, 0)
        hit = surface.hit(number, ray(t), ray.d, side, found, tangents)
        if isinstance(surface, Walls):
            t = jnp.where(hit.side > 0, before_terrain(t), t)
        status = jnp.where(valid, jnp.where(met, int(Status.HIT), int(Status.MISS)), int(Status.INVALID)).astype(jnp.int32)
        hit = dataclasses.replace(hit, status=status, object=jnp.where(met, hit.object, -1), t=jnp.where(met, t, jnp.inf))
        return materialise(dataclasses.replace(hit, steps=jnp.zeros((), jnp.int32)) if count_steps else hit)
    local, scale = ray_in_grid(surface, ray)
    t_max = None if t_max is None else t_max * scale
    found = first_triangle(surface, local, active=active, leaving=leaving, number=number, t_max=t_max, count_steps=count_steps)
    return surface_hit(surface, number, local, scale, stored(materialise(found)), tangents)


def hit_on_triangle(grid: Grid, number: int, ray: Ray, at: Hit) -> Hit:
    """The hit of a world-frame ray that starts on the triangle of `at`, where it starts; also where it grazes the triangle."""
    local, scale = ray_in_grid(grid, ray)
    ix, iy, _, _ = place_on_grid(grid, at)
    met, zero = jnp.full((), int(Status.HIT), jnp.int32), jnp.zeros_like(scale)
    return surface_hit(grid, number, local, scale, WalkResult(met, ix, iy, at.triangle == 1, at.side, zero, zero, None))


def blocked(surface: Surface, ray: Ray, leaving: Hit, active: Flag, t_max: Scalar | None, *, number: int) -> tuple[Flag, Flag]:
    """Whether a world-frame ray meets the surface before `t_max`, and whether its budget ran out.

    Neither has a derivative: the arguments come under `stop_gradient`, see `unblocked`.
    """
    if not isinstance(surface, Grid):
        t, found, _ = surface.distance(ray, leaving, number)
        return active & found & (t < (jnp.inf if t_max is None else t_max)), jnp.zeros((), bool)
    local, scale = ray_in_grid(surface, ray)
    t_max = None if t_max is None else t_max * scale
    found = first_triangle(surface, local, active=active, leaving=leaving, number=number, t_max=t_max)
    met = found.status == int(Status.HIT)
    if t_max is not None:
        met = met & _is_through(triangle_plane(surface, found.ix, found.iy, found.upper), local, found, t_max)
    return stored((met, found.status == int(Status.EXHAUSTED)))


def leave(grid: Grid, number: int, hit: Hit, d: Vector) -> tuple[Ray, Hit]:
    """The ray along `d` (world frame) from a hit on `grid`, on the side of its triangle to which `d` points, and that hit.

    It starts at the hit's position in the footprint and at the surface's height there, as `hit.p` may be far from the grid's
    own corner, and coarse. A ray in the plane of the triangle stays on the side that the hit was met from. A hit that is
    none gives a ray that is not valid.
    """
    ahead = dot(unit(d), hit.n)
    side = jnp.where(ahead == 0, hit.side, jnp.where(ahead > 0, 1, -1).astype(hit.side.dtype))
    p = grid.world_from_grid.point(point_on_grid(grid, hit))
    leaving = dataclasses.replace(hit, side=side, object=jnp.full_like(hit.object, number))
    return Ray(p, jnp.where(hit.status == int(Status.HIT), d, 0)), leaving


def ray_in_grid(grid: Grid, ray: Ray) -> tuple[Ray, Scalar]:
    """The ray in the grid's frame, with a `d` of length around 1, and by how much its t is longer there.

    The factor is a power of two, so that no bit changes; without it t would leave the range in which the walk's
    distances can be told from infinite ones, where heights and cells differ by many orders of magnitude.
    """
    local = grid.grid_from_world.ray(ray)
    size = largest_component(local.d)
    scale = floor_to_power_of_two(jnp.where(size > 0, size, 1))
    return materialise((Ray(local.o, local.d / scale), scale))


def surface_hit(grid: Grid, number: int, ray: Ray, scale: Scalar, found: WalkResult, tangents: bool = False) -> Hit:
    """The hit in the triangle that the walk found; differentiable in the heights, the transform and the ray.

    The ray is one of `ray_in_grid`, where t is longer by `scale`; `number` is that of the grid's object. Heights and normals at
    the vertices are fetched before the conditional, which in a reverse derivative would return the derivative of all heights
    and normals once a tile. What the walk itself says passes by both conditionals, as they would copy it (frames took
    up to a tenth longer).
    """
    nx, triangle = grid.nx, (found.ix, found.iy, found.upper)
    heights = triangle_corners(grid.rows, nx, *triangle, grid.first)
    normals = None if grid.normals is None else triangle_corners(grid.normals, nx, *triangle, grid.first)
    if grid.perturbation is not None:
        heights = _moved(heights, grid.perturbation.heights)
        if normals is not None and grid.perturbation.normals is not None:
            normals = _moved(normals, grid.perturbation.normals)
    plane = plane_through(heights, found.upper)
    met = found.status == int(Status.HIT)
    t, *geometry = only_where(met, _geometry_with(tangents), grid, ray, found, plane, normals, skips=grid.fixed_steps is None)
    t = jnp.where(met, t / scale, jnp.inf)
    t, p, n, ns, uv, *more = materialise((t, *geometry))
    return Hit(
        found.status, jnp.where(met, number, -1).astype(jnp.int32), t, p, n, ns, uv, jnp.stack([found.ix, found.iy]),
        found.upper.astype(jnp.int32), found.side, *more, steps=found.steps,
    )  # fmt: skip


def plane_distance(plane: tuple[Scalar, Scalar, Scalar], ray: Ray, found: WalkResult) -> Scalar:
    """t at which `ray` (in the grid's frame) meets the plane of the triangle in which a walk ended, see `triangle_plane`.

    Plain arithmetic that is differentiable in the heights and in the ray. It starts at the cell, as the subtraction
    of far heights would cancel; t is clamped to the part of the ray over the triangle, without touching its derivative. A
    ray that lies in the plane meets it all along: then t is that of the cell, with the derivative zero.
    """
    a, b, c = plane
    o, d = ray(found.t_near), ray.d
    u, v = o[0] - found.ix.astype(o.dtype), o[1] - found.iy.astype(o.dtype)
    slope = d[2] - a * d[0] - b * d[1]
    grazing = (slope == 0) | (found.status != int(Status.HIT))
    step = jnp.where(grazing, 0, quotient(c + a * u + b * v - o[2], jnp.where(grazing, 1, slope)))
    t = found.t_near + step
    return t + lax.stop_gradient(jnp.clip(t, found.t_near, found.t_far) - t)


def _is_through(plane: tuple[Scalar, Scalar, Scalar], ray: Ray, found: WalkResult, t: Scalar) -> Flag:
    """Whether the ray (in the grid's frame) is beyond the triangle's plane at t, by more than rounding can have moved it there:
    a light that stands on the surface is not behind it."""
    a, b, c = plane
    o, end = ray.o, ray(t)
    gap = end[2] - (c + a * (end[0] - found.ix.astype(a.dtype)) + b * (end[1] - found.iy.astype(a.dtype)))
    x, y, z = jnp.abs(o) + jnp.abs(end)
    return -found.side.astype(a.dtype) * gap > 8 * jnp.finfo(a.dtype).eps * (z + jnp.abs(a) * x + jnp.abs(b) * y)


def _moved(corners: tuple[jax.Array, jax.Array, jax.Array], by: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    a, b, c = corners
    return a + by[0], b + by[1], c + by[2]


@functools.cache  # JAX traces a function once
def _geometry_with(tangents: bool) -> Callable[..., tuple[jax.Array, ...]]:
    return functools.partial(_geometry, tangents=tangents)


def _geometry(
    grid: Grid,
    ray: Ray,
    found: WalkResult,
    plane: tuple[Scalar, Scalar, Scalar],
    normals: tuple[Vector, Vector, Vector] | None,
    tangents: bool,
) -> tuple[jax.Array, ...]:
    """t, p, n, ns, uv of a `Hit`, from the triangle's plane and the normals at its vertices; with tangents dp_du, dp_dv, dn_du
    and dn_dv, too."""
    t = plane_distance(plane, ray, found)
    dtype = t.dtype
    point = ray(t)
    u, v = point[0] - found.ix.astype(dtype), point[1] - found.iy.astype(dtype)
    t, point, u, v, (a, b, c) = materialise((t, point, u, v, plane))
    x, y = point[0], point[1]
    p = grid.world_from_grid.point(jnp.stack([x, y, c + a * u + b * v]))
    one, zero = jnp.ones((), dtype), jnp.zeros((), dtype)
    n = unit(grid.grid_from_world.covector(jnp.stack([-a, -b, one])))
    cells_x, cells_y = grid.extent
    uv = jnp.stack([x / cells_x, y / cells_y])
    ns, turning = _shading_normal(grid, found.upper, normals, u, v, n)
    if not tangents:
        return t, p, n, ns, uv
    per_u = grid.world_from_grid.vector(jnp.stack([one, zero, a])) * cells_x
    per_v = grid.world_from_grid.vector(jnp.stack([zero, one, b])) * cells_y
    dn_du, dn_dv = turning()
    return t, p, n, ns, uv, *orthogonal_tangents(per_u, per_v, ns), dn_du * cells_x, dn_dv * cells_y


def _shading_normal(
    grid: Grid, upper: Flag, normals: tuple[Vector, Vector, Vector] | None, u: Scalar, v: Scalar, n: Vector
) -> tuple[Vector, Callable[[], tuple[Vector, Vector]]]:
    """The barycentric mean of the triangle's three vertex normals (Phong 1975), and what gives its derivatives by cells."""
    if normals is None:
        return n, lambda: (jnp.zeros_like(n), jnp.zeros_like(n))
    n00, between, n11 = normals
    first, second = between - n00, n11 - between
    mean = n00 + jnp.where(upper, v, u) * first + jnp.where(upper, u, v) * second
    if grid.object_from_world is not None:
        mean, first, second = (grid.object_from_world.covector(normal) for normal in (mean, first, second))
    largest = lax.stop_gradient(largest_component(mean))
    largest = jnp.where(largest > 0, largest, 1)
    ns = unit(mean)

    def turning() -> tuple[Vector, Vector]:
        length = dot(mean / largest, ns)
        per_u, per_v = jnp.where(upper, second, first), jnp.where(upper, first, second)
        changes = per_u / largest, per_v / largest
        dn_du, dn_dv = ((change - ns * dot(ns, change)) / jnp.where(length > 0, length, 1) for change in changes)
        return dn_du, dn_dv

    return ns, turning
