"""Affine maps between frames, applied to points, vectors, normals and rays.

Products are written out term by term: a matrix product may run in TF32 on a GPU, which has ten bits of mantissa, and may
round differently for different batch sizes.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Float

from ._ray import Ray
from ._types import AnyArray, Flag, Scalar, Vector


def dot(a: Vector, b: Vector) -> Scalar:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def lesser(a: Scalar, b: Scalar) -> Scalar:
    """The minimum of two numbers: one instruction, where that by NumPy's rules for nan and signed zeros takes four."""
    return jnp.where(a < b, a, b)


def greater(a: Scalar, b: Scalar) -> Scalar:
    return jnp.where(a > b, a, b)


def largest_component(v: Vector) -> Scalar:
    """max |v_i|. Written out, as XLA on the CPU calls a library for a reduction, however short; nan is passed over."""
    return greater(greater(jnp.abs(v[0]), jnp.abs(v[1])), jnp.abs(v[2]))


def finite(v: Vector) -> Flag:
    return jnp.isfinite(v[0]) & jnp.isfinite(v[1]) & jnp.isfinite(v[2])


def unit(v: Vector) -> Vector:
    """`v` at length 1; a zero vector stays zero, with zero derivative. Neither over- nor underflows on the way."""
    largest = lax.stop_gradient(largest_component(v))  # any factor does; its own derivative has its square in it
    zero = largest == 0
    largest = jnp.minimum(largest, float(jnp.finfo(v.dtype).max) / 8)  # whose reciprocal is a normal number
    v = v / jnp.where(zero, 1, largest)
    return v / jnp.sqrt(jnp.where(zero, 1, dot(v, v)))


def length(v: Vector) -> Scalar:
    """Of a vector that is not zero; neither over- nor underflows on the way."""
    largest = largest_component(v)
    v = v / largest
    return largest * jnp.sqrt(dot(v, v))


def power_of_two(value: Float[jax.Array, "*shape"]) -> Float[jax.Array, "*shape"]:
    """The power of two next below positive numbers, clamped to 2^-100..2^100, so that its reciprocal is normal and exact.

    It carries no derivative.
    """
    value = jnp.clip(lax.stop_gradient(value), 2.0**-100, 2.0**100)
    integer, exponent_bits = (jnp.uint32, 0x7F800000) if value.dtype == jnp.float32 else (jnp.uint64, 0x7FF0000000000000)
    bits = lax.bitcast_convert_type(value, integer) & jnp.asarray(exponent_bits, integer)
    return lax.bitcast_convert_type(bits, value.dtype)


class Affine(eqx.Module):
    """p -> linear @ p + offset."""

    linear: Float[AnyArray, "3 3"]
    offset: Float[AnyArray, "3"]

    def point(self, p: Vector) -> Vector:
        return self.vector(p) + self.offset

    def vector(self, v: Vector) -> Vector:
        return self.linear[:, 0] * v[0] + self.linear[:, 1] * v[1] + self.linear[:, 2] * v[2]

    def covector(self, n: Vector) -> Vector:
        """Maps a normal from this map's target frame back to its source frame: by the transpose of `linear`.

        A normal that is to follow points through a map M therefore goes through the covector of M's inverse (Pharr and
        Humphreys, Physically Based Rendering, 2nd ed., section 2.8.3).
        """
        return self.linear[0] * n[0] + self.linear[1] * n[1] + self.linear[2] * n[2]

    def ray(self, ray: Ray) -> Ray:
        """The same points at the same t, in the other frame."""
        return Ray(self.point(ray.o), self.vector(ray.d))

    def inverse(self) -> "Affine":
        """By the adjugate; in NumPy float64 where the map is NumPy, so that a host-side inverse loses nothing."""
        linear: Any = self.linear
        host = isinstance(linear, np.ndarray) and isinstance(self.offset, np.ndarray)
        xp: Any = np if host else jnp
        # Each column is divided by about its size, as the derivative has the determinant's square in it.
        sizes: Any = np.ones(3) if host else power_of_two(jnp.abs(linear).max(axis=0))
        linear = linear / sizes[None, :]
        a, b, c = linear[:, 0], linear[:, 1], linear[:, 2]
        adjugate = xp.stack([xp.cross(b, c), xp.cross(c, a), xp.cross(a, b)])
        inverse = adjugate / (a * adjugate[0]).sum() / sizes[:, None]
        return Affine(inverse, -(inverse * self.offset[None, :]).sum(1))


def affine(matrix: Float[AnyArray, "4 4"]) -> Affine:
    """The map of a 4x4 matrix whose last row is 0 0 0 1."""
    return Affine(matrix[:3, :3], matrix[:3, 3])


def translate(x: float, y: float, z: float) -> Float[np.ndarray, "4 4"]:
    matrix = np.eye(4)
    matrix[:3, 3] = x, y, z
    return matrix


def scale(x: float, y: float, z: float) -> Float[np.ndarray, "4 4"]:
    return np.diag([x, y, z, 1.0])


def rotate(degrees: float, x: float, y: float, z: float) -> Float[np.ndarray, "4 4"]:
    """Rotation about the axis (x, y, z), counter-clockwise seen against it (Rodrigues' formula); ValueError on a zero axis."""
    axis = np.array([x, y, z], dtype=np.float64)
    length = np.linalg.norm(axis)
    if not length > 0:
        raise ValueError(f"rotate: the axis must not be zero, it is {axis.tolist()}")
    axis = axis / length
    cross = np.cross(np.eye(3), axis)  # rows: e_i x axis, so that v @ cross = v x axis
    angle = np.radians(degrees)
    matrix = np.eye(4)
    matrix[:3, :3] = np.cos(angle) * np.eye(3) + (1 - np.cos(angle)) * np.outer(axis, axis) + np.sin(angle) * cross
    return matrix


def require_invertible(place: str, matrix: Any) -> None:
    """Raises ValueError on a shape other than 4x4, a last row other than 0 0 0 1, nan, or a singular linear part."""
    if matrix.shape != (4, 4):
        raise ValueError(f"{place} must be a 4x4 matrix, its shape is {matrix.shape}")
    if not isinstance(matrix, np.ndarray):
        return
    if not np.isfinite(matrix).all():
        raise ValueError(f"{place} must be finite, it is {matrix.tolist()}")
    if not np.array_equal(matrix[3], [0, 0, 0, 1]):
        raise ValueError(f"{place} must be affine (last row 0 0 0 1), its last row is {matrix[3].tolist()}")
    columns = np.abs(matrix[:3, :3]).max(axis=0)
    if not columns.all() or abs(np.linalg.det(matrix[:3, :3] / columns)) < 1e-12:
        raise ValueError(f"{place} must be invertible, it flattens space: {matrix[:3, :3].tolist()}")
