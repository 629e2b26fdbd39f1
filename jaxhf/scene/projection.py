"""Where the points of a picture lie in a camera's frame, and where points of the world lie in the picture."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..core.affine import Affine, affine
from ..core.errors import ArgumentError
from ..core.types import Scalar, Vector, float_leaf


class Projection(eqx.Module):
    """p -> linear @ p + offset, four numbers (X, Y, W, depth): the point is seen at (X / W, Y / W), if its depth is positive.

    Homogeneous coordinates (Riesenfeld, IEEE CG&A 1981): what is linear in p can be cut at the picture's border before
    the division.
    """

    linear: Float[jax.Array, "4 3"]
    offset: Float[jax.Array, "4"]

    def __call__(self, p: Vector) -> Float[jax.Array, "4"]:
        return self._vector(p) + self.offset

    def _vector(self, v: Vector) -> Float[jax.Array, "4"]:
        return self.linear[:, 0] * v[0] + self.linear[:, 1] * v[1] + self.linear[:, 2] * v[2]

    def of(self, world: Affine) -> "Projection":
        """The same projection for points in another frame; `world` maps that frame to the world's."""
        return Projection(jnp.stack([self._vector(world.linear[:, k]) for k in range(3)], axis=1), self(world.offset))


def size_of(camera: Any) -> tuple[Any, Any]:
    """Width and height of a camera's picture, in pixels: as they were given, or as numbers, see `of_any_size`."""
    return (camera.width, camera.height) if camera._size is None else (camera._size[0], camera._size[1])


def screen(camera: Any, x: Any, y: Any) -> tuple[Any, Any]:
    """Pixels to screen coordinates: -1 to 1 along the shorter side, x right, y up."""
    width, height = size_of(camera)
    if camera._size is None:
        short = min(width, height)
        return (2 * x - width) / short, (height - 2 * y) / short
    times = 1 / jnp.minimum(width, height)  # as XLA has it for a constant
    return (2 * x - width) * times, (height - 2 * y) * times


def film(camera: Any, half: Scalar, parallel: bool) -> Projection:
    """The inverse of `screen`: x = (short X / half + width W) / (2 W), W the depth or, of parallel rays, 1; y likewise."""
    inverse = affine(jnp.asarray(camera.world_from_camera)).inverse()
    offset = inverse.offset if camera._ahead is None else inverse.offset.at[2].add(camera._ahead)
    width, height = size_of(camera)
    scale = (min(width, height) if camera._size is None else jnp.minimum(width, height)) / (2 * half)

    def rows(p: Any, w: Any) -> jax.Array:
        return jnp.stack([p[0] * scale + w * (width / 2), -p[1] * scale + w * (height / 2), w, p[2]])

    w, w_offset = (jnp.zeros_like(offset), jnp.ones_like(half)) if parallel else (inverse.linear[2], offset[2])
    return Projection(rows(inverse.linear, w), rows(offset, w_offset))


def projected(camera: Any, points: Any, half: Callable[[Any], Any]) -> Float[np.ndarray, "*n 2"]:
    """The same by `half` of what the shorter side spans at a depth, on the host: see `Perspective.project`."""
    matrix, given = np.asarray(camera.world_from_camera, np.float64), np.asarray(float_leaf(points), np.float64)
    if given.shape[-1:] != (3,):
        raise ArgumentError("project", "points", f"must have shape (..., 3), theirs is {given.shape}")
    x, y, depth = np.moveaxis((given - matrix[:3, 3]) @ np.linalg.inv(matrix[:3, :3]).T, -1, 0)
    scale = min(camera.width, camera.height) / 2 / np.where(depth > 0, half(depth), np.nan)
    return np.stack([camera.width / 2 + scale * x, camera.height / 2 - scale * y], axis=-1)
