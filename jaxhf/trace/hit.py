"""Where a ray met a surface, and how it ended."""

import enum
from typing import TYPE_CHECKING

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Int

from ..core.types import Index, Point2, Scalar, Vector
from ..core.vector import dot, unit

if TYPE_CHECKING:  # who has a hit of `cast` has its tangents
    _Tangent = Vector
else:
    _Tangent = Vector | None


class Status(enum.IntEnum):
    """How a ray ended.

    Attributes:
      MISS: 0, it met nothing.
      HIT: 1, it met a surface.
      EXHAUSTED: 2, its budget of steps ran out, see `Settings`.
      INVALID: 3, its origin or direction was not finite, or its direction zero.
    """

    MISS = 0
    HIT = 1
    EXHAUSTED = 2
    INVALID = 3


class Hit(eqx.Module):
    """Where a ray met a surface, in world units unless said.

    Unless `status` is HIT the rest is finite (t excepted) but means nothing.

    Attributes:
      status: see `Status`.
      object: its number in the scene's `objects`; -1 unless `status` is HIT.
      t: the ray's parameter at the hit; infinite where there is none.
      p: the point, on the surface rather than on the ray.
      n: unit normal of the triangle, on the surface's +z side (a cylinder: outwards).
      ns: unit shading normal, interpolated between the vertices; `n` with flat shading.
      uv: position in the footprint, 0..1 over the whole grid.
      cell: (ix, iy).
      triangle: 0 for (00, 10, 11), 1 for (00, 11, 01).
      side: 1 where the ray came from the side that `n` points to, else -1.
      dp_du, dp_dv: tangents, orthogonal to `ns` and to each other (Gram-Schmidt in this order).
      dn_du, dn_dv: derivatives of `ns`. These four are None but in what `cast` returns.
      steps: taken by the search; None unless counted.
    """

    status: Index
    object: Index
    t: Scalar
    p: Vector
    n: Vector
    ns: Vector
    uv: Point2
    cell: Int[jax.Array, "2"]
    triangle: Index
    side: Index
    dp_du: _Tangent = eqx.field(default=None)
    dp_dv: _Tangent = eqx.field(default=None)
    dn_du: _Tangent = eqx.field(default=None)
    dn_dv: _Tangent = eqx.field(default=None)
    steps: Index | None = None


def hit_of_closed_form(number: int, p: Vector, n: Vector, uv: Point2, d: Vector, part: Index | int = 0) -> Hit:
    """The hit at a point of a shape without cells, of a ray that comes along `d`; with t = 0. `part` stands for its cell."""
    none = jnp.zeros((), jnp.int32)
    return Hit(
        status=jnp.full((), int(Status.HIT), jnp.int32), object=jnp.full((), number, jnp.int32), t=jnp.zeros((), p.dtype),
        p=p, n=n, ns=n, uv=uv, cell=jnp.stack([none + part, none]), triangle=none,
        side=jnp.where(dot(n, d) < 0, 1, -1).astype(jnp.int32),
    )  # fmt: skip


def orthogonal_tangents(per_u: Vector, per_v: Vector, ns: Vector) -> tuple[Vector, Vector]:
    """Tangents orthogonal to `ns` and to each other, from those of the surface (Gram-Schmidt in this order)."""
    dp_du = per_u - ns * dot(ns, per_u)
    along = unit(dp_du)
    return dp_du, per_v - ns * dot(ns, per_v) - along * dot(along, per_v)
