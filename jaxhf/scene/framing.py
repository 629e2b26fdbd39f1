"""Where a camera must stand so that it sees all of a terrain."""

import itertools
import math

import numpy as np
from jaxtyping import Float

from ..core.affine import matrix_of
from ..core.errors import ArgumentError
from .heightfield import Heightfield

_MOST = 1024  # points along a side that are looked at


def framing_pose(
    field: Heightfield,
    azimuth: float,
    altitude: float,
    fov: float,
    width: int,
    height: int,
    margin: float,
    base: float | None,
    around: bool,
) -> Float[np.ndarray, "4 4"]:
    """The pose of the nearest pinhole that looks at a heightfield from a direction and has all of it in its picture.

    See `Perspective.framing`. In the camera's frame a point lies within the left and right borders of the picture where
    |X - x| <= (Z - z) tan(half the angle of view). For the camera's place (x, z) that is linear; the nearest place follows
    from the points that are farthest out on either side. Likewise for the upper and lower borders.
    """
    for name, value, rule, holds in (
        ("azimuth", azimuth, "finite", math.isfinite(azimuth)),
        ("altitude", altitude, "from -90 to 90 degrees", -90 <= altitude <= 90),
        ("fov", fov, "between 0 and 180 degrees", 0 < fov < 180),
        ("margin", margin, "at least 0 and below 1", 0 <= margin < 1),
    ):
        if not holds:
            raise ArgumentError("framing", name, f"must be {rule}, it is {value}")
    points = _outline(field, base)
    points = _cylinder(points) if around else points
    turn, lift = math.radians(azimuth), math.radians(altitude)
    forward = -np.array([math.sin(turn) * math.cos(lift), math.cos(turn) * math.cos(lift), math.sin(lift)])
    right = np.array([-math.cos(turn), math.sin(turn), 0.0])
    up = np.cross(right, forward)
    middle = (points.min(0) + points.max(0)) / 2
    x, y, z = np.stack([right, up, forward]) @ (points - middle).T
    half, short = math.tan(math.radians(fov) / 2) * (1 - margin), min(width, height)
    tangents = half * width / short, half * height / short
    along = min(
        -((across - tangent * z).max() + (-across - tangent * z).max()) / (2 * tangent)
        for across, tangent in zip((x, y), tangents, strict=True)
    )
    eye = middle + _central(x, z - along) * right + _central(y, z - along) * up + along * forward
    return matrix_of(np.stack([right, up, forward], axis=1), eye)


def _cylinder(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "m 3"]:
    """The two rims of the upright cylinder round points."""
    low, high = points.min(0), points.max(0)
    middle = (low + high)[:2] / 2
    radius = np.hypot(*(points[:, :2] - middle).T).max()
    turns = np.linspace(0, 2 * np.pi, 72, endpoint=False)
    x, y = middle[0] + radius * np.cos(turns), middle[1] + radius * np.sin(turns)
    return np.concatenate([np.stack([x, y, np.full(72, z)], axis=1) for z in (low[2], high[2])])


def _central(across: Float[np.ndarray, " n"], depth: Float[np.ndarray, " n"]) -> float:
    """The place from which points are seen equally far out on both sides."""
    place = 0.0
    for _ in range(20):
        slope = (across - place) / depth
        ends = [slope.argmin(), slope.argmax()]
        better = (across[ends] / depth[ends]).sum() / (1 / depth[ends]).sum()
        if better == place:
            break
        place = better
    return place


def _outline(field: Heightfield, base: float | None) -> Float[np.ndarray, "n 3"]:
    """The vertices that have a height, and where the border stands on the level `base`.

    Of a large terrain the corners of boxes round blocks of vertices, some 1024 x 1024 of them, stand for these.
    """
    heights = np.asarray(field.heights)
    heights = np.where(np.isfinite(heights), heights, np.nan)
    ny, nx = heights.shape
    size = math.ceil(max(ny, nx) / _MOST)
    points = []
    for end in (np.fmax, np.fmin)[: min(size, 2)]:
        blocks = end.reduceat(end.reduceat(heights, range(0, ny, size)), range(0, nx, size), axis=1)
        iy, ix = np.nonzero(~np.isnan(blocks))
        for right, up in itertools.product(range(0, size, max(size - 1, 1)), repeat=2):
            x, y = np.minimum(ix * size + right, nx - 1), np.minimum(iy * size + up, ny - 1)
            at = field.x0 + x * field.dx, field.y0 + y * field.dy
            points.append(np.stack([*at, blocks[iy, ix].astype(np.float64)], axis=1))
    points = np.concatenate(points)
    if not len(points):
        raise ArgumentError("framing", "field", "must have a height, all of its vertices are holes")
    if base is None:
        return points
    x1, y1 = field.x0 + (nx - 1) * field.dx, field.y0 + (ny - 1) * field.dy
    return np.concatenate([points, [(x, y, base) for x in (field.x0, x1) for y in (field.y0, y1)]])
