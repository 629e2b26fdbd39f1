"""Depth cameras and lidars: rays that start at one point and turn with it."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..core.errors import ArgumentError, kind_of
from ..core.rules import Whole, require
from ..core.types import ANGLE_OF_VIEW, POSITIVE, Scalar
from ..scene.camera import require_size
from ..xla.compilation import compiled
from ..xla.devices import takes_numbers
from .geoms import Geoms
from .hfield import HField, known_numbers, number_pair
from .pose import rotation
from .ray import first_met, lengths, reach
from .scan import on_sensors
from .surface import Scan


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

    Raises:
      ValueError: no channel, a resolution that is not positive, azimuths that do not rise.
    """
    owner = "lidar_pattern"
    require(owner, "channels", channels, Whole(1))
    require(owner, "resolution", float(resolution), POSITIVE)
    first, last = number_pair(owner, "horizontal_fov", horizontal_fov)
    elevations = number_pair(owner, "vertical_fov", vertical_fov)
    if not last > first:
        raise ArgumentError(owner, "horizontal_fov", f"must rise from the first to the last azimuth, it is {horizontal_fov!r}")
    steps = int(np.ceil((last - first) / resolution - 1e-9))
    azimuth = np.radians(np.linspace(first, last, steps + 1))
    azimuth = azimuth[:-1] if last - first >= 360 else azimuth
    elevation = np.radians(np.linspace(*elevations, channels))[:, None]
    x, y, z = np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation) + 0 * azimuth
    return np.stack([x, y, z], -1).reshape(-1, 3)


@takes_numbers
def lidar(
    geoms: HField | Geoms,
    pos: Any,
    quat: Any,
    pattern: Any = None,
    *,
    max_range: Any = None,
    noise: Any = None,
    key: jax.Array | None = None,
) -> Scan:
    """What rays from a sensor meet, in directions that turn with it; `dist` is in units of a direction's length.

    Args:
      geoms, pos, quat: as in `height_scan`, of the sensors.
      pattern: directions (n, 3) in the sensor's frame; None: `lidar_pattern()`.
      max_range: how far rays reach; None: without end.
      noise: the standard deviation of a measured range, in units of length, by which `dist` and `p` are off along the rays;
        normal, independent from ray to ray; also beyond `max_range`. None: exact ranges.
      key: of JAX's random numbers, where there is noise.

    Returns:
      A `Scan` with the axes (..., n).

    Raises:
      ValueError: shapes that do not fit, a range or noise that is not positive, noise without a key.
    """
    directions = lidar_pattern() if pattern is None else pattern
    return _measured("lidar", geoms, pos, quat, directions, max_range, noise, key)


@takes_numbers
def depth_image(
    geoms: HField | Geoms,
    pos: Any,
    quat: Any,
    width: int,
    height: int,
    *,
    fovy: float = 45.0,
    intrinsics: Any = None,
    max_range: Any = None,
    noise: Any = None,
    key: jax.Array | None = None,
) -> tuple[Float[jax.Array, "*cameras h w"], Float[jax.Array, "*cameras h w"]]:
    """Depths along the optical axis and distances along the rays through the pixels' centres, -1 where nothing is met.

    Cameras are MuJoCo's: they look along -z, with x to the right and y up. Differentiable in all numbers but the intrinsics.

    Args:
      geoms, pos, quat: as in `height_scan`, of the cameras.
      width, height: pixels.
      fovy: vertical field of view, degrees.
      intrinsics: (fx, fy, cx, cy) in pixels, (cx, cy) from the upper left corner of the picture, or the matrix
        [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]; None: from fovy, with square pixels and the axis in the middle.
      max_range, noise, key: as in `lidar`.

    Returns:
      Depths and distances, top row first, shape (..., height, width).

    Raises:
      ValueError: shapes that do not fit, a size below 1, a fovy that is not between 0 and 180, focal lengths, a range or
        noise that are not positive, noise without a key.
    """
    require("depth_image", "fovy", float(fovy), ANGLE_OF_VIEW)
    require_size("depth_image", width, height)
    f = height / 2 / np.tan(np.radians(fovy) / 2)
    fx, fy, cx, cy = (f, f, width / 2, height / 2) if intrinsics is None else _lens(intrinsics)
    x, y = np.meshgrid((np.arange(width) + 0.5 - cx) / fx, (cy - np.arange(height) - 0.5) / fy)
    # With 1 along the axis a ray's t is the depth itself.
    pixels = np.stack([x, y, -np.ones_like(x)], -1).reshape(-1, 3)
    met = _measured("depth_image", geoms, pos, quat, pixels, max_range, noise, key)
    depth, slant = met.dist, jnp.asarray(np.linalg.norm(pixels, axis=1), met.dist.dtype)
    dist = jnp.where(met.mask, depth * jnp.broadcast_to(slant, depth.shape), -1)
    shape = *depth.shape[:-1], height, width
    return depth.reshape(shape), dist.reshape(shape)


def _measured(
    owner: str,
    geoms: HField | Geoms,
    pos: Any,
    quat: Any,
    directions: Any,
    max_range: Any,
    noise: Any,
    key: jax.Array | None,
) -> Scan:
    """What rays from sensors meet, in directions that turn with them; see `lidar`."""
    is_key = isinstance(key, jax.Array) and key.shape == (() if jnp.issubdtype(key.dtype, jax.dtypes.prng_key) else (2,))
    if noise is not None and not is_key:
        raise ArgumentError(owner, "key", f"must be one key of jax.random, where there is noise, it is {kind_of(key)}")
    noise = None if noise is None else known_numbers(owner, "noise", noise, POSITIVE)
    o, d = _turned(*on_sensors(owner, geoms, pos, quat, directions, 3))
    scan = first_met(geoms, o, d, reach(owner, max_range))
    return scan if noise is None else _blurred(scan, d, jnp.asarray(noise, scan.dist.dtype), key)


@compiled
def _blurred(scan: Scan, d: Float[jax.Array, "*rays 3"], noise: Scalar, key: jax.Array) -> Scan:
    """With ranges that are off along the rays; none ends behind its start."""
    length = lengths(d)
    off = noise * jax.random.normal(key, scan.dist.shape, scan.dist.dtype) / jnp.where(length > 0, length, 1)
    off = jnp.where(scan.mask, jnp.where(off > -scan.dist, off, -scan.dist), 0)
    return dataclasses.replace(scan, p=scan.p + off[..., None] * d, dist=scan.dist + off)


def _lens(intrinsics: Any) -> list[float]:
    """fx, fy, cx and cy from these four or from the matrix of a pinhole."""
    owner, name = "depth_image", "intrinsics"
    given = known_numbers(owner, name, intrinsics)
    if given.shape == (3, 3):
        fx, fy, cx, cy = numbers = np.asarray(given)[[0, 1, 0, 1], [0, 1, 2, 2]]
        if not np.array_equal(given, [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]):
            rule = f"must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] as a matrix, it is {np.asarray(given).tolist()}"
            raise ArgumentError(owner, name, rule)
        given = numbers
    if given.shape != (4,):
        raise ArgumentError(owner, name, f"must be fx, fy, cx and cy, or a matrix of 3 x 3, the shape is {given.shape}")
    fx, fy, cx, cy = map(float, given)
    if not min(fx, fy) > 0:
        raise ArgumentError(owner, name, f"must have positive focal lengths, fx is {fx:g} and fy {fy:g}")
    return [fx, fy, cx, cy]


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
