"""Affine maps between frames, applied to points, vectors, normals and rays.

Products are written out term by term: a matrix product may run in TF32 on a GPU, which has ten bits of mantissa, and may
round differently for different batch sizes.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from .errors import UserError
from .ray import Ray
from .types import AnyArray, Number, Vector, VectorLeaf
from .vector import floor_to_power_of_two


class Affine(eqx.Module):
    """p -> linear @ p + offset."""

    linear: Float[AnyArray, "3 3"]
    offset: Float[AnyArray, "3"]

    def point(self, p: VectorLeaf) -> VectorLeaf:
        return self.vector(p) + self.offset

    def vector(self, v: VectorLeaf) -> VectorLeaf:
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
        sizes: Any = np.ones(3) if host else floor_to_power_of_two(jnp.abs(linear).max(axis=0))
        linear = linear / sizes[None, :]
        a, b, c = linear[:, 0], linear[:, 1], linear[:, 2]
        adjugate = xp.stack([xp.cross(b, c), xp.cross(c, a), xp.cross(a, b)])
        inverse = adjugate / (a * adjugate[0]).sum() / sizes[:, None]
        return Affine(inverse, -(inverse * self.offset[None, :]).sum(1))


def affine(matrix: Float[AnyArray, "4 4"]) -> Affine:
    """The map of a 4x4 matrix whose last row is 0 0 0 1."""
    return Affine(matrix[:3, :3], matrix[:3, 3])


def matrix_of(linear: Float[np.ndarray, "3 3"], offset: Any) -> Float[np.ndarray, "4 4"]:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = linear, offset
    return matrix


def translate(x: float, y: float, z: float) -> Float[np.ndarray, "4 4"]:
    return matrix_of(np.eye(3), (x, y, z))


def scale(x: float, y: float, z: float) -> Float[np.ndarray, "4 4"]:
    return np.diag([x, y, z, 1.0])


def rotate(degrees: float, x: float, y: float, z: float) -> Float[np.ndarray, "4 4"]:
    """Rotation about the axis (x, y, z), counter-clockwise seen against it (Rodrigues' formula); UserError on a zero axis."""
    axis = np.array([x, y, z], dtype=np.float64)
    length = np.linalg.norm(axis)
    if not length > 0:
        raise UserError(f"rotate: the axis must not be zero, it is {axis.tolist()}")
    axis = axis / length
    cross = np.cross(np.eye(3), axis)  # rows: e_i x axis, so that v @ cross = v x axis
    angle = np.radians(degrees)
    return matrix_of(np.cos(angle) * np.eye(3) + (1 - np.cos(angle)) * np.outer(axis, axis) + np.sin(angle) * cross, 0)


def invertible(matrix: Any) -> str | None:
    """The rule of a transformation: 4x4 numbers whose last row is 0 0 0 1, with a linear part that is not singular."""
    wrong = _MATRIX(matrix)
    if wrong or not isinstance(matrix, np.ndarray):
        return wrong
    if not np.array_equal(matrix[3], [0, 0, 0, 1]):
        return f"must be affine (last row 0 0 0 1), its last row is {matrix[3].tolist()}"
    columns = np.abs(matrix[:3, :3]).max(axis=0)
    if not columns.all() or abs(np.linalg.det(matrix[:3, :3] / columns)) < 1e-12:
        return f"must be invertible, it flattens space: {matrix[:3, :3].tolist()}"
    return None


_MATRIX = Number(shape=(4, 4), shape_words="be a 4x4 matrix")
