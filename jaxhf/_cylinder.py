"""The open cylinder that carries the sky of the seed scenes."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax

from ._ray import Ray
from ._transform import Affine
from ._types import Flag, Scalar, ScalarLeaf, float_leaf, require_finite, require_number


class Cylinder(eqx.Module):
    """A full circle about the z axis of its frame, without caps; seen from both sides.

    (u, v): u = phi / 2 pi with phi = atan2(y, x) in [0, 2 pi), v runs from z_min to z_max (pbrt-v2, `Shape "cylinder"`).

    Attributes:
      radius, z_min, z_max: object units.
    """

    radius: ScalarLeaf = eqx.field(converter=float_leaf, default=1.0)
    z_min: ScalarLeaf = eqx.field(converter=float_leaf, default=-1.0)
    z_max: ScalarLeaf = eqx.field(converter=float_leaf, default=1.0)

    def __check_init__(self):
        for name in ("radius", "z_min", "z_max"):
            require_number(f"Cylinder: {name}", getattr(self, name))
        if isinstance(self.radius, np.ndarray) and not 0 < self.radius < np.inf:
            raise ValueError(f"Cylinder: radius must be positive, it is {self.radius}")
        if isinstance(self.z_min, np.ndarray) and isinstance(self.z_max, np.ndarray) and not self.z_min < self.z_max:
            raise ValueError(f"Cylinder: z_min must lie below z_max, they are {self.z_min} and {self.z_max}")
        require_finite("Cylinder: z_min", self.z_min)
        require_finite("Cylinder: z_max", self.z_max)


class Tube(eqx.Module):
    """A cylinder made ready for tracing."""

    radius: Scalar
    z_min: Scalar
    z_max: Scalar
    world_from_object: Affine
    object_from_world: Affine

    @property
    def sure(self) -> Flag:
        """True, but not to the compiler: see `stored`."""
        return lax.stop_gradient(self.radius) >= 0


def make_tube(cylinder: Cylinder, world_from_object: Affine | None) -> Tube:
    dtype = jnp.asarray(cylinder.radius).dtype
    world = Affine(jnp.eye(3, dtype=dtype), jnp.zeros(3, dtype)) if world_from_object is None else world_from_object
    return Tube(jnp.asarray(cylinder.radius), jnp.asarray(cylinder.z_min), jnp.asarray(cylinder.z_max), world, world.inverse())


def tube_distance(tube: Tube, ray: Ray, left: Flag | None) -> tuple[Scalar, Flag]:
    """The smallest t > 0 at which a world-frame ray meets the cylinder, and whether it does; differentiable.

    The roots are taken without cancellation (Press et al., Numerical Recipes, section 5.6). A ray that leaves the
    cylinder itself has one root at zero, which is taken out of the equation instead of skipped by an epsilon.

    Args:
      tube: the surface.
      ray: world frame.
      left: whether it starts on this very cylinder; None for rays that start in free space.
    """
    local = tube.object_from_world.ray(ray)
    o, d = local.o, local.d
    a = d[0] * d[0] + d[1] * d[1]
    half = o[0] * d[0] + o[1] * d[1]
    c = o[0] * o[0] + o[1] * o[1] - tube.radius * tube.radius
    if left is not None:
        c = jnp.where(left, 0, c)
    square = half * half - a * c
    real = (square > 0) & (a > 0)
    root = jnp.sqrt(jnp.where(real, square, 1))
    q = -(half + jnp.where(half < 0, -root, root))
    one, two = q / jnp.where(real, a, 1), c / jnp.where(q == 0, 1, q)

    def reached(t):
        z = o[2] + t * d[2]
        return real & (t > 0) & jnp.isfinite(t) & (z >= tube.z_min) & (z <= tube.z_max)

    one_reached, two_reached = reached(one), reached(two)
    t = jnp.minimum(jnp.where(one_reached, one, jnp.inf), jnp.where(two_reached, two, jnp.inf))
    found = one_reached | two_reached
    return jnp.where(found, t, 0), found
