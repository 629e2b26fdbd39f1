"""From a place in the picture to a ray in the world."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from ._ray import Ray
from ._transform import affine, require_invertible, unit
from ._types import MatrixLeaf, Scalar, ScalarLeaf, float_leaf, require_finite, require_number


class Perspective(eqx.Module):
    """A pinhole.

    Attributes:
      world_from_camera: 4x4; camera space is +x right, +y up, +z forward (the handedness of pbrt).
      fov: full angle of view across the shorter side of the picture, degrees.
      width, height: of the picture, pixels.
    """

    world_from_camera: MatrixLeaf = eqx.field(converter=float_leaf)
    fov: ScalarLeaf = eqx.field(converter=float_leaf, default=45.0)
    width: int = eqx.field(static=True, default=512, kw_only=True)
    height: int = eqx.field(static=True, default=512, kw_only=True)

    def __check_init__(self):
        _check_camera(self)
        require_number("Perspective: fov", self.fov)
        if isinstance(self.fov, np.ndarray) and not 0 < self.fov < 180:
            raise ValueError(f"Perspective: fov must lie between 0 and 180 degrees, it is {self.fov}")

    @classmethod
    def look_at(
        cls, eye: Any, target: Any, up: Any = (0, 0, 1), fov: Any = 45.0, *, width: int = 512, height: int = 512
    ) -> "Perspective":
        """A camera at `eye` that looks at `target`, in a right-handed world; ValueError where the three leave no frame."""
        return cls(_look_at(eye, target, up), fov, width=width, height=height)

    def ray(self, x: Scalar, y: Scalar) -> Ray:
        """The ray through the point (x, y) of the picture: pixels, from its top left corner; `d` has length 1."""
        world = affine(jnp.asarray(self.world_from_camera))
        sx, sy = _screen(self, x, y)
        half = jnp.tan(jnp.deg2rad(jnp.asarray(self.fov)) / 2)
        return Ray(world.offset, unit(world.vector(jnp.stack([sx * half, sy * half, jnp.ones_like(half)]))))


class Orthographic(eqx.Module):
    """Parallel rays.

    Attributes:
      world_from_camera: as for `Perspective`; rays start in the camera's plane z = 0.
      extent: what the shorter side of the picture spans, world units.
      width, height: of the picture, pixels.
    """

    world_from_camera: MatrixLeaf = eqx.field(converter=float_leaf)
    extent: ScalarLeaf = eqx.field(converter=float_leaf, default=1.0)
    width: int = eqx.field(static=True, default=512, kw_only=True)
    height: int = eqx.field(static=True, default=512, kw_only=True)

    def __check_init__(self):
        _check_camera(self)
        require_number("Orthographic: extent", self.extent)
        if isinstance(self.extent, np.ndarray) and not 0 < self.extent < np.inf:
            raise ValueError(f"Orthographic: extent must be positive and finite, it is {self.extent}")

    @classmethod
    def look_at(
        cls, eye: Any, target: Any, up: Any = (0, 0, 1), extent: Any = 1.0, *, width: int = 512, height: int = 512
    ) -> "Orthographic":
        """A camera at `eye` that looks at `target`, in a right-handed world; ValueError where the three leave no frame."""
        return cls(_look_at(eye, target, up), extent, width=width, height=height)

    def ray(self, x: Scalar, y: Scalar) -> Ray:
        """The ray through the point (x, y) of the picture: pixels, from its top left corner; `d` has length 1."""
        world = affine(jnp.asarray(self.world_from_camera))
        sx, sy = _screen(self, x, y)
        half = jnp.asarray(self.extent) / 2
        origin = world.point(jnp.stack([sx * half, sy * half, jnp.zeros_like(half)]))
        return Ray(origin, unit(world.linear[:, 2]))


Camera = Perspective | Orthographic


def _screen(camera: Camera, x: Scalar, y: Scalar) -> tuple[Scalar, Scalar]:
    """Pixels to the screen on which the shorter side runs from -1 to 1, x right, y up."""
    short = min(camera.width, camera.height)
    return (2 * x - camera.width) / short, (camera.height - 2 * y) / short


def _look_at(eye: Any, target: Any, up: Any) -> Any:
    eye, target, up = float_leaf(eye), float_leaf(target), float_leaf(up)
    leaves = {"eye": eye, "target": target, "up": up}
    for name, leaf in leaves.items():
        if leaf.shape != (3,):
            raise ValueError(f"look_at: {name} must hold three numbers, its shape is {leaf.shape}")
        require_finite(f"look_at: {name}", leaf)
    host = all(isinstance(leaf, np.ndarray) for leaf in leaves.values())
    xp = np if host else jnp

    def direction(v):
        return v / xp.sqrt((v * v).sum())

    if host and not (target - eye).any():
        raise ValueError(f"look_at: target must differ from eye, both are {eye.tolist()}")
    forward = direction(target - eye)
    right = xp.cross(forward, up)
    if host and not np.linalg.norm(right) > 1e-9 * np.linalg.norm(up):
        raise ValueError(f"look_at: up must not point along the view, it is {up.tolist()} for the view {forward.tolist()}")
    right = direction(right)
    columns = xp.stack([right, xp.cross(right, forward), forward, eye], axis=1)
    return xp.concatenate([columns, xp.asarray([[0.0, 0.0, 0.0, 1.0]], dtype=columns.dtype)])


def _check_camera(camera: Camera) -> None:
    kind = type(camera).__name__
    require_invertible(f"{kind}: world_from_camera", camera.world_from_camera)
    for side in ("width", "height"):
        value = getattr(camera, side)
        if not isinstance(value, int) or value < 1:
            raise ValueError(f"{kind}: {side} must be a whole number of pixels from 1 on, it is {value!r}")
