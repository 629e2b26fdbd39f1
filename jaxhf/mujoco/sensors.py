"""Depth cameras and lidars: rays that start at one point and turn with it."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..core.compilation import compiled
from ..core.errors import ArgumentError, require_kind
from .hfield import HField
from .pose import rotation
from .ray import first_met
from .scan import Scan, poses_for


def lidar_pattern(
    channels: int = 16,
    vertical_fov: tuple[float, float] = (-15.0, 15.0),
    horizontal_fov: tuple[float, float] = (-180.0, 180.0),
    resolution: float = 1.0,
) -> Float[np.ndarray, "n 3"]:
    """Unit directions of a spinning lidar, x ahead, y to the left, z up: channel after channel from the lowest.

    As Isaac Lab's `LidarPatternCfg`: a full turn does not have its last direction twice.

    Args:
      channels: how many elevations, spread evenly over `vertical_fov`, in degrees.
      vertical_fov: the lowest and the highest.
      horizontal_fov: azimuths in degrees, counter-clockwise seen from above.
      resolution: the largest step between two azimuths, in degrees.
    """
    first, last = horizontal_fov
    if channels < 1 or not resolution > 0 or not last > first:
        rule = f"must have channels, a positive resolution and a rising horizontal_fov, it has {channels}, {resolution}, "
        raise ArgumentError("lidar_pattern", "pattern", f"{rule}{horizontal_fov}")
    steps = int(np.ceil((last - first) / resolution - 1e-9))
    azimuth = np.radians(np.linspace(first, last, steps + 1))
    azimuth = azimuth[:-1] if last - first >= 360 else azimuth
    elevation = np.radians(np.linspace(*vertical_fov, channels))[:, None]
    x, y, z = np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation) + 0 * azimuth
    return np.stack([x, y, z], -1).reshape(-1, 3)


def lidar(hfields: HField, pos: Any, quat: Any, pattern: Any = None) -> Scan:
    """What rays from a sensor meet, in directions that turn with it; `dist` is in units of a direction's length.

    Args:
      hfields: one height field, or a batch.
      pos, quat: the sensors' positions and orientations, as in `height_scan`.
      pattern: directions (n, 3) in the sensor's frame; None: `lidar_pattern()`.

    Returns:
      A `Scan` with the axes (..., n).

    Raises:
      ValueError: shapes that do not fit.
    """
    require_kind("lidar", "hfields", hfields, HField, "a jaxhf.mujoco.HField")
    pos, quat = poses_for("lidar", hfields, pos, quat)
    directions = jnp.asarray(lidar_pattern() if pattern is None else pattern, hfields.data.dtype)
    if directions.ndim != 2 or directions.shape[1] != 3:
        raise ArgumentError("lidar", "pattern", f"must have shape (n, 3), its shape is {directions.shape}")
    met = first_met(hfields, *_turned(pos, quat, directions))
    return Scan(met.p, met.n, met.t, met.valid)


def depth_image(
    hfields: HField, pos: Any, quat: Any, width: int, height: int, *, fovy: float = 45.0, intrinsics: Any = None
) -> tuple[Float[jax.Array, "*cameras h w"], Float[jax.Array, "*cameras h w"]]:
    """Depths along the optical axis and distances along the rays through the pixels' centres, -1 where nothing is met.

    Cameras are MuJoCo's: they look along -z, with x to the right and y up. Differentiable in all numbers but the intrinsics.

    Args:
      hfields: one height field, or a batch.
      pos, quat: the cameras' positions and orientations, as in `height_scan`.
      width, height: pixels.
      fovy: vertical field of view, degrees.
      intrinsics: (fx, fy, cx, cy) in pixels, (cx, cy) from the upper left corner of the picture; None: from fovy, with
        square pixels and the axis in the middle.

    Returns:
      Depths and distances, top row first, shape (..., height, width).

    Raises:
      ValueError: shapes that do not fit, or a fovy that is not between 0 and 180.
    """
    require_kind("depth_image", "hfields", hfields, HField, "a jaxhf.mujoco.HField")
    if not 0 < fovy < 180:
        raise ArgumentError("depth_image", "fovy", f"must lie between 0 and 180 degrees, it is {fovy}")
    pos, quat = poses_for("depth_image", hfields, pos, quat)
    f = height / 2 / np.tan(np.radians(fovy) / 2)
    fx, fy, cx, cy = (f, f, width / 2, height / 2) if intrinsics is None else map(float, intrinsics)
    x, y = np.meshgrid((np.arange(width) + 0.5 - cx) / fx, (cy - np.arange(height) - 0.5) / fy)
    # With 1 along the axis a ray's t is the depth itself.
    pixels = np.stack([x, y, -np.ones_like(x)], -1).reshape(-1, 3)
    met = first_met(hfields, *_turned(pos, quat, jnp.asarray(pixels, hfields.data.dtype)))
    lengths = jnp.asarray(np.linalg.norm(pixels, axis=1), met.t.dtype)
    dist = jnp.where(met.valid, met.t * jnp.broadcast_to(lengths, met.t.shape), -1)
    shape = *pos.shape[:-1], height, width
    return met.t.reshape(shape), dist.reshape(shape)


@compiled
def _turned(
    pos: Float[jax.Array, "*sensors 3"], quat: Float[jax.Array, "*sensors 4"], directions: Float[jax.Array, "n 3"]
) -> tuple[jax.Array, jax.Array]:
    """Origins and directions in the world's frame, with the directions as a further axis."""

    def one(quat: jax.Array) -> jax.Array:
        x, y, z = rotation(quat).T
        return directions[:, :1] * x[None] + directions[:, 1:2] * y[None] + directions[:, 2:] * z[None]

    d = jax.vmap(one)(quat.reshape(-1, 4)).reshape(*pos.shape[:-1], len(directions), 3)
    return jnp.broadcast_to(pos[..., None, :], d.shape), d
