"""Where a ray meets MuJoCo's primitives: planes, spheres, capsules, ellipsoids, cylinders and boxes, each in its own frame.

But for the plane all are convex: a ray is within from one distance to another, and meets the first of the two that is ahead,
as `mj_ray` has it. The distances are those at which it is within simpler bodies, balls and slabs, put together, so that no
rounding opens an edge between two faces.
"""

import dataclasses
import functools
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Float, Int

from ..core.autodiff import with_tangent
from ..core.ray import Ray
from ..core.types import AnyArray, Index, Scalar, Vector
from ..core.vector import dot, greater, largest_component, lesser, quotient, root, select, time_to, unit
from ..xla.compilation import compiled
from .pose import Quaternion, pose
from .solid import Within, slab
from .surface import Scan, in_frame

KINDS = ("plane", "sphere", "capsule", "ellipsoid", "cylinder", "box")


def ball(o: Float[jax.Array, " n"], d: Float[jax.Array, " n"]) -> Within:
    """Where a point o + t d is at most 1 away from the origin; both may have two components, of a cylinder without ends.

    The square under the root is taken where the ray is nearest to the origin, as the discriminant of far origins loses what
    single precision has (Haines et al., "Precision Improvements for Ray/Sphere Intersection", Ray Tracing Gems, chapter 7).
    """
    steep = dot(d, d)
    moves = steep > 0
    steep = jnp.where(moves, steep, 1)
    middle = -quotient(dot(o, d), steep)
    nearest = o + middle * d
    square = 1 - dot(nearest, nearest)
    half = root(quotient(jnp.where(square > 0, square, 0), steep))
    always = jnp.where(square > 0, jnp.inf, -jnp.inf)
    crosses = moves & (square > 0)
    return Within(jnp.where(crosses, middle - half, -always), jnp.where(crosses, middle + half, always))


def first_crossing(kind: str, size: Vector, ray: Ray) -> Scalar:
    """The least t >= 0 at which a ray in a primitive's frame meets it; infinite where it does not.

    Args:
      kind: one of KINDS.
      size: as MuJoCo's geom_size: half of the extents in x and y of a plane, where 0 is without end, and of a box; radii;
        radius and half of the length of a capsule and a cylinder, along z.
      ray: its direction is about 1 in length, see `scaled`.
    """
    o, d = ray.o, ray.d
    if kind == "plane":  # from above alone
        t, ever = time_to(-o[2], d[2])
        on_it = [(size[k] <= 0) | (jnp.abs(o[k] + t * d[k]) <= size[k]) for k in (0, 1)]
        return jnp.where(ever & (d[2] < 0) & (t >= 0) & on_it[0] & on_it[1], t, jnp.inf)
    if kind in ("sphere", "ellipsoid"):
        radii = size[:1] if kind == "sphere" else size
        within = ball(quotient(o, jnp.broadcast_to(radii, (3,))), quotient(d, jnp.broadcast_to(radii, (3,))))
    elif kind == "box":
        x, y, z = (slab(o[k], d[k], size[k]) for k in range(3))
        within = x.common(y).common(z)
    else:
        radius = size[0]
        within = ball(quotient(o[:2], radius), quotient(d[:2], radius)).common(slab(o[2], d[2], size[1]))
        if kind == "capsule":
            within = _none_if_empty(within)
            for z in (-size[1], size[1]):
                cap = ball(quotient(o.at[2].add(-z), radius), quotient(d, radius))
                within = within.either(_none_if_empty(cap))
    first = jnp.where(within.begin >= 0, within.begin, within.end)
    return jnp.where((within.begin <= within.end) & (first >= 0), first, jnp.inf)


def _none_if_empty(within: Within) -> Within:
    never = within.begin > within.end
    return Within(jnp.where(never, jnp.inf, within.begin), jnp.where(never, -jnp.inf, within.end))


def scaled(ray: Ray) -> tuple[Ray, Scalar]:
    """The same ray with a largest component of 1, and that of its direction; a direction of zero stays."""
    length = largest_component(ray.d)
    length = jnp.where(length > 0, length, 1)
    return Ray(ray.o, quotient(ray.d, length)), length


def normal(kind: str, size: Vector, p: Vector) -> Vector:
    """The unit normal, out of the body, at a point of its surface."""
    if kind == "plane":
        return jnp.array([0, 0, 1], p.dtype)
    if kind == "sphere":
        return unit(p)
    if kind == "ellipsoid":
        return unit(quotient(quotient(p, size), size))
    if kind == "box":
        return jnp.where(jnp.arange(3) == jnp.argmax(jnp.abs(p) - size), jnp.sign(p), 0)
    z = p[2]
    if kind == "capsule":
        return unit(p.at[2].set(z - lesser(greater(z, -size[1]), size[1])))
    radius = size[0]
    at_end = jnp.abs(z) - size[1] > jnp.sqrt(dot(p[:2], p[:2])) - radius
    side = unit(p.at[2].set(0))
    return jnp.where(at_end, jnp.array([0, 0, 1], p.dtype) * jnp.sign(z), side)


@functools.partial(compiled, static_argnames=("kinds",))
def meet_primitives(
    size: Float[jax.Array, "n 3"],
    pos: Float[jax.Array, "*batch n 3"],
    quat: Float[jax.Array, "*batch n 4"],
    ids: Int[AnyArray, " n"],
    o: Float[jax.Array, "*rays 3"],
    d: Float[jax.Array, "*rays 3"],
    kinds: tuple[str, ...],
) -> Scan:
    """What rays in the world's frame meet of primitives, see `Geoms`, and the nearest one's number among `ids`.

    One primitive after the other is asked for its distance, and the nearest one again with derivatives: the memory needed is
    that of a few numbers a ray, however many primitives there are.
    """
    axes, count = o.shape[:-1], math.prod(pos.shape[:-2])
    kind, known = jnp.array([KINDS.index(kind) for kind in kinds], jnp.int32), sorted(set(kinds))
    of_kind = {kind: np.flatnonzero([kind == other for other in kinds]) for kind in known}

    def of_one(pos: jax.Array, quat: jax.Array, o: jax.Array, d: jax.Array) -> Scan:
        best, which = _search(of_kind, *lax.stop_gradient((size, pos, quat, o, d)))
        met = jax.vmap(functools.partial(_meet, known=known))(size[which], pos[which], quat[which], kind[which], o, d, best)
        return dataclasses.replace(met, geom=jnp.where(met.mask, jnp.asarray(ids)[which], -1))

    grouped = (leaf.reshape(count, -1, leaf.shape[-1]) for leaf in (pos, quat, o, d))
    return jax.tree.map(lambda leaf: leaf.reshape(*axes, *leaf.shape[2:]), jax.vmap(of_one)(*grouped))


def _search(
    of_kind: dict[str, np.ndarray],
    size: Float[jax.Array, "n 3"],
    pos: Float[jax.Array, "n 3"],
    quat: Float[jax.Array, "n 4"],
    o: Float[jax.Array, "rays 3"],
    d: Float[jax.Array, "rays 3"],
) -> tuple[Float[jax.Array, " rays"], Int[jax.Array, " rays"]]:
    """At which t each ray meets a primitive first, infinite where it meets none, and the number of that primitive."""
    best = jnp.full(len(o), jnp.inf, o.dtype), jnp.zeros(len(o), jnp.int32)
    for kind, numbers in of_kind.items():

        def nearer(best: Any, given: Any, kind: str = kind) -> tuple[Any, None]:
            number, size, pos, quat = given

            def distance(o: Vector, d: Vector) -> Scalar:
                local, length = scaled(in_frame(pose(pos, quat), Ray(o, d)))
                return quotient(first_crossing(kind, size, local), length)

            t = jax.vmap(distance)(o, d)
            closer = t < best[0]
            return (jnp.where(closer, t, best[0]), jnp.where(closer, number, best[1])), None

        best, _ = lax.scan(nearer, best, (jnp.asarray(numbers, jnp.int32), size[numbers], pos[numbers], quat[numbers]))
    return best


def _meet(
    size: Vector, pos: Vector, quat: Quaternion, kind: Index, o: Vector, d: Vector, best: Scalar, known: list[str]
) -> Scan:
    """What one ray meets of the primitive whose place among KINDS is `kind`, one of those `known`; differentiable.

    `best` is t as the search has it. It counts where a ray just touches the primitive and rounding says here that it passes.
    """
    frame, found = pose(pos, quat), jnp.isfinite(best)
    local, length = scaled(in_frame(frame, Ray(o, d)))
    numbers = [KINDS.index(name) for name in known]
    sizes = [jnp.where(kind == number, size, 1) for number in numbers]  # of another kind they may be zero
    t = select(kind, zip(numbers, map(first_crossing, known, sizes, [local] * len(known)), strict=True))
    searched = lax.stop_gradient(jnp.where(found, best, 0) * length)
    t = with_tangent(searched, jnp.where(jnp.isfinite(t), t, searched))
    n = select(kind, zip(numbers, map(normal, known, sizes, [local(t)] * len(known)), strict=True))
    p, n = jnp.where(found, frame.point(local(t)), o), jnp.where(found, frame.vector(n), 0)
    return Scan(p, n, jnp.where(found, quotient(t, length), -1), found)
