"""Places and rotations as MuJoCo writes them: a position, and a quaternion (w, x, y, z) that need not be unit."""

import jax
import jax.numpy as jnp
from jaxtyping import Float

from ..core.affine import Affine
from ..core.types import Vector
from ..core.vector import angle, largest_component, unit

Quaternion = Float[jax.Array, "4"]


def rotation(quat: Quaternion) -> Float[jax.Array, "3 3"]:
    """The matrix of a quaternion; exactly the identity's rows and columns where a component is zero."""
    w, x, y, z = _normalised(quat)
    xx, yy, zz = x * x, y * y, z * z
    rows = [
        [1 - 2 * (yy + zz), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (xx + zz), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (xx + yy)],
    ]
    return jnp.stack([jnp.stack(row) for row in rows])


def _normalised(quat: Quaternion) -> Quaternion:
    """Of length 1; the identity for one shorter than 1e-15, as `mju_normalize4` has it."""
    short = largest_component(quat) < 1e-15
    return unit(jnp.where(short, jnp.array([1, 0, 0, 0], quat.dtype), quat))


def quaternion(matrix: Float[jax.Array, "3 3"]) -> Quaternion:
    """The quaternion of a rotation, of a length from 2 to 4.

    Of four multiples of it, each without a root or a quotient, the longest (Shepperd, "Quaternion from Rotation Matrix",
    Journal of Guidance and Control, 1978).
    """
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = matrix
    turns, sums = [zy - yz, xz - zx, yx - xy], [yz + zy, zx + xz, xy + yx]
    squares = [1 + xx + yy + zz, 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz]
    ways = [
        [squares[0], turns[0], turns[1], turns[2]],
        [turns[0], squares[1], sums[2], sums[1]],
        [turns[1], sums[2], squares[2], sums[0]],
        [turns[2], sums[1], sums[0], squares[3]],
    ]
    return jnp.stack([jnp.stack(way) for way in ways])[jnp.argmax(jnp.stack(squares))]


def pose(pos: Vector, quat: Quaternion) -> Affine:
    """world_from_local."""
    return Affine(rotation(quat), pos)


def yaw(quat: Quaternion) -> Quaternion:
    """The rotation about z alone that a rotation holds, of its angles yaw, pitch, roll (z-y'-x'')."""
    w, x, y, z = _normalised(quat)
    half = angle(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)) / 2
    zero = jnp.zeros_like(half)
    return jnp.stack([jnp.cos(half), zero, zero, jnp.sin(half)])
