"""Where a ray meets a cylinder."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp

from ..core.affine import Affine
from ..core.ray import Ray
from ..core.types import Flag, Index, Scalar, Vector
from ..core.vector import angle, dot, lesser, quotient, unit
from ..scene.cylinder import Cylinder
from .hit import Hit, hit_of_closed_form, orthogonal_tangents


class Tube(eqx.Module):
    """A cylinder made ready for tracing."""

    radius: Scalar
    z_min: Scalar
    z_max: Scalar
    world_from_object: Affine
    object_from_world: Affine

    def distance(self, ray: Ray, leaving: Hit | None, number: int) -> tuple[Scalar, Flag, Index]:
        """The smallest t > 0 at which a world-frame ray meets the cylinder, whether it does, and 0; differentiable.

        The roots are taken without cancellation (Press et al., Numerical Recipes, section 5.6). A ray that leaves the
        cylinder itself (the object `number`) has one root at zero, which is taken out of the equation instead of skipped by an
        epsilon.
        """
        local = self.object_from_world.ray(ray)
        o, d = local.o, local.d
        a = d[0] * d[0] + d[1] * d[1]
        half = o[0] * d[0] + o[1] * d[1]
        c = o[0] * o[0] + o[1] * o[1] - self.radius * self.radius
        if leaving is not None:
            c = jnp.where(leaving.object == number, 0, c)
        square = half * half - a * c
        real = (square > 0) & (a > 0)
        root = jnp.sqrt(jnp.where(real, square, 1))
        q = -(half + jnp.where(half < 0, -root, root))
        one, two = quotient(q, jnp.where(real, a, 1)), quotient(c, jnp.where(q == 0, 1, q))

        def reached(t):
            z = o[2] + t * d[2]
            return real & (t > 0) & jnp.isfinite(t) & (z >= self.z_min) & (z <= self.z_max)

        one_reached, two_reached = reached(one), reached(two)
        t = lesser(jnp.where(one_reached, one, jnp.inf), jnp.where(two_reached, two, jnp.inf))
        found = one_reached | two_reached
        return jnp.where(found, t, 0), found, jnp.zeros((), jnp.int32)

    def hit(self, number: int, p: Vector, d: Vector, side: Index, found: Flag, tangents: bool) -> Hit:
        """The hit at a point of the cylinder of a ray that comes along `d`; with t = 0. Unless `found` it is any other's."""
        local = self.object_from_world.point(p)
        x, y = jnp.where(found, local[0], 1), jnp.where(found, local[1], 0)
        turn = 2 * jnp.pi
        phi = angle(y, x)
        phi = jnp.where(phi < 0, phi + turn, phi)
        zero, height = jnp.zeros_like(x), self.z_max - self.z_min
        n = unit(self.object_from_world.covector(jnp.stack([x, y, zero])))
        uv = jnp.stack([phi / turn, quotient(local[2] - self.z_min, height)])
        hit = hit_of_closed_form(number, p, n, uv, d)
        if not tangents:
            return hit
        dp_du = self.world_from_object.vector(jnp.stack([-y, x, zero])) * turn
        dp_dv = self.world_from_object.vector(jnp.stack([zero, zero, height]))
        dp_du, dp_dv = orthogonal_tangents(dp_du, dp_dv, n)
        bend = self.object_from_world.covector(jnp.stack([-y, x, zero])) * turn
        scale = dot(n, self.object_from_world.covector(jnp.stack([x, y, zero])))
        dn_du = quotient(bend - n * dot(n, bend), scale)
        return dataclasses.replace(hit, dp_du=dp_du, dp_dv=dp_dv, dn_du=dn_du, dn_dv=jnp.zeros_like(n))


def make_tube(cylinder: Cylinder, world_from_object: Affine | None) -> Tube:
    dtype = jnp.asarray(cylinder.radius).dtype
    world = Affine(jnp.eye(3, dtype=dtype), jnp.zeros(3, dtype)) if world_from_object is None else world_from_object
    return Tube(jnp.asarray(cylinder.radius), jnp.asarray(cylinder.z_min), jnp.asarray(cylinder.z_max), world, world.inverse())
