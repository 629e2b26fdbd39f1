"""Where rays meet one of MuJoCo's height fields, or each of a batch."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Bool, Float, Int

from ..core.affine import Affine
from ..core.autodiff import stored
from ..core.ray import Ray
from ..core.types import Flag, Index, Scalar
from ..core.vector import finite, quotient, unit
from ..rendering.chunks import trace_batch
from ..scene.heightfield import Heightfield
from ..trace.grid import Grid, joined, make_grid
from ..trace.hit import Status
from ..trace.intersect import plane_distance, ray_in_grid
from ..trace.search import first_triangle
from ..trace.triangle import plane_through, triangle_corners
from ..trace.walk import WalkResult
from ..xla.compilation import compiled
from ..xla.materialise import materialise
from .hfield import SEARCHED, HField
from .pose import pose
from .solid import Ground, Side, base_faces, column, ground_of, wall

CHUNK = 1024  # rays traced together


class Scan(eqx.Module):
    """What the rays of a scan met, with the scan's axes: of the robots, then of the pattern.

    Attributes:
      p: where in the world; the ray's start where it met nothing.
      n: unit normals; zero where nothing was met.
      dist: distances from the rays' starts, in units of their directions' length; -1 where nothing was met.
      mask: where something was met.
      geom: the number of the geom that was met (see `Geoms.ids`), -1 where nothing was; None of an `HField` alone.
    """

    p: Float[jax.Array, "*rays 3"]
    n: Float[jax.Array, "*rays 3"]
    dist: Float[jax.Array, "*rays"]
    mask: Bool[jax.Array, "*rays"]
    geom: Int[jax.Array, "*rays"] | None = None

    @property
    def heights(self) -> Float[jax.Array, "*rays"]:
        """z of what was met, in the world; of the ray's start where nothing was, see `mask`."""
        return self.p[..., 2]


def meet_hfield(hfield: HField, o: Float[jax.Array, "*rays 3"], d: Float[jax.Array, "*rays 3"]) -> Scan:
    """What rays in the world's frame meet; their axes are those of the batch, and any others behind them."""
    return _meet_hfield(hfield.data, hfield.size, hfield.pos, hfield.quat, hfield._grid, o, d)


@compiled
def _meet_hfield(
    data: jax.Array, size: jax.Array, pos: jax.Array, quat: jax.Array, grid: Grid | None, o: jax.Array, d: jax.Array
) -> Scan:
    """From the numbers alone: whether they stand upright makes no other program."""
    hfield = eqx.tree_at(lambda hfield: hfield._grid, HField(data, size, pos, quat), grid, is_leaf=lambda leaf: leaf is None)
    axes, fields = o.shape[:-1], one_axis(hfield)
    count = len(fields.data)
    rays = o.reshape(count, -1, 3), d.reshape(count, -1, 3)
    met = trace_batch(_searchable, _joined, lambda ground, ray: _one(ground, Ray(ray[0], ray[1])), fields, rays, CHUNK)
    return jax.tree.map(lambda leaf: leaf.reshape(*axes, *leaf.shape[2:]), met)


def one_axis(hfield: HField) -> HField:
    """A batch, or a single one, as a batch with one axis, its numbers in the precision of the heights."""
    axes, count = len(hfield.batch), math.prod(hfield.batch)

    def in_a_row(leaf: jax.Array) -> jax.Array:
        whole = jnp.issubdtype(leaf.dtype, jnp.integer)  # as sizes of a grid at hand are
        return jnp.asarray(leaf, None if whole else hfield.data.dtype).reshape(count, *leaf.shape[axes:])

    return jax.tree.map(in_a_row, hfield)


def _searchable(hfield: HField) -> Ground:
    field = lax.stop_gradient(hfield)
    return ground_of(hfield, field._grid or make_grid(Heightfield(field.data, 1.0, 1.0), None, SEARCHED))


def _joined(grounds: Ground) -> tuple[Ground, Ground]:
    """See `trace_batch`: what is `joined` of the grids is in common, and so are the data."""

    def with_parts(grounds: Ground, rows: jax.Array | None, grid: Grid) -> Ground:
        return eqx.tree_at(lambda all: (all.rows, all.grid), grounds, (rows, grid), is_leaf=lambda leaf: leaf is None)

    assert grounds.grid is not None
    shared, own = joined(grounds.grid)
    nothing = jax.tree.map(lambda _: None, grounds)
    return with_parts(nothing, grounds.rows.reshape(-1), shared), with_parts(grounds, None, own)


def _one(ground: Ground, ray: Ray) -> Scan:
    """What one ray in the world's frame meets, after a walk over the surface."""
    grid, frame = ground.grid, pose(ground.pos, ground.quat)
    assert grid is not None
    local = in_frame(frame, ray)
    within = column(ground, local)
    faces = base_faces(ground, local, within)
    limit = lax.stop_gradient(jnp.where(faces[0].met, faces[0].t, jnp.where(faces[1].met, faces[1].t, jnp.inf)))
    scaled, scale = ray_in_grid(grid, in_cells(ground, local))
    found = first_triangle(grid, scaled, t_max=limit * scale)
    found = eqx.tree_at(lambda found: (found.t_near, found.t_far), found, (found.t_near / scale, found.t_far / scale))
    found = stored(materialise(found))
    walls = (wall(ground, local, side, found.side < 0) for side in within)
    return nearest(ground, local, frame, found, [*faces, *walls])


def in_frame(frame: Affine, ray: Ray) -> Ray:
    """A ray of the world's in a geom's frame; one that is not finite gets a direction of zero."""
    valid = finite(ray.o) & finite(ray.d)
    o, d = jnp.where(valid, ray.o, frame.offset), jnp.where(valid, ray.d, 0)
    return Ray(frame.covector(o - frame.offset), frame.covector(d))


def in_cells(ground: Ground, local: Ray) -> Ray:
    """A ray of the height field's frame in cells by cells by data, such that the border is at whole numbers to the last bit."""
    nrow, ncol = ground.shape
    half = jnp.array([(ncol - 1) / 2, (nrow - 1) / 2, 1], local.o.dtype)
    centre = jnp.array([1, 1, 0], local.o.dtype)
    size = ground.size[:3]
    return Ray((quotient(local.o, size) + centre) * half, quotient(local.d, size) * half)


def triangle_heights(ground: Ground, ix: Index, iy: Index, upper: Flag) -> tuple[Scalar, Scalar, Scalar]:
    """The data at the vertices of a triangle, see `triangle_corners`."""
    # XLA on the CPU fuses a gather into its only user; one with several users becomes a loop over its elements, some twenty
    # times as slow.
    return materialise(triangle_corners(ground.rows, ground.shape[1], ix, iy, upper, ground.first))


def nearest(ground: Ground, local: Ray, frame: Affine, found: WalkResult, solid: list[Side]) -> Scan:
    """The nearest of the triangle that a search found and of the solid's sides; of two at the same distance the first side.

    Of a ray straight down only the cell that was found is used, as it is over one place wherever on it the search began.
    """
    nrow, ncol = ground.shape
    plane = a, b, c = plane_through(triangle_heights(ground, found.ix, found.iy, found.upper), found.upper)
    down = (local.d[0] == 0) & (local.d[1] == 0)
    near, far = jnp.where(down, 0, found.t_near), jnp.where(down, jnp.inf, found.t_far)
    found = eqx.tree_at(lambda found: (found.t_near, found.t_far), found, (near, far))
    cells = in_cells(ground, local)
    t = plane_distance(plane, cells, found)
    at, size = cells(t), ground.size
    u, v = at[0] - found.ix.astype(t.dtype), at[1] - found.iy.astype(t.dtype)
    per_x, per_y = quotient(a * size[2] * ((ncol - 1) / 2), size[0]), quotient(b * size[2] * ((nrow - 1) / 2), size[1])
    surface = Side(t, found.status == int(Status.HIT), unit(jnp.stack([-per_x, -per_y, jnp.ones_like(a)])))
    best = Side(jnp.full_like(t, jnp.inf), jnp.zeros((), bool), jnp.zeros_like(surface.n))
    for side in (*solid, surface):
        closer = side.met & (side.t < best.t)
        best = Side(jnp.where(closer, side.t, best.t), best.met | side.met, jnp.where(closer, side.n, best.n))
    t = jnp.where(best.met, best.t, 0)
    p = local(t)
    z = jnp.where(surface.met & (surface.t == best.t), (c + a * u + b * v) * size[2], p[2])  # free of the ray's own rounding
    return Scan(frame.point(jnp.stack([p[0], p[1], z])), frame.vector(best.n), jnp.where(best.met, t, -1), best.met)
