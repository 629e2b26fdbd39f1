"""Cameras from points whose pixels are known: resection, in double precision on the host."""

import math
from typing import Any

import numpy as np
from jax.core import Tracer
from jaxtyping import Float

from ..core.affine import matrix_of
from ..core.errors import ArgumentError
from ..core.rules import require
from ..core.types import POSITIVE, float_leaf

_OWNER = "from_points"
_FLAT = 1e-6  # of the largest extent: thinner points count as in a plane, thinner pixels as on a line
_UNDECIDED = 1e-9  # of the largest singular value: smaller ones are roundings
_PARALLEL = 1e-10  # of the mean depth: smaller differences of depth are roundings


def resected(
    points: Any, pixels: Any, width: int, height: int, max_error: float | int
) -> tuple[Float[np.ndarray, "4 4"], float]:
    """The matrix and the angle of view of the pinhole that sees points at these pixels, see `Perspective.from_points`.

    The direct linear transform of normalised coordinates is the start of the least squares of distances in the picture
    (Hartley and Zisserman, Multiple View Geometry, 2nd ed., 2004, algorithm 7.1). Points are normalised along their principal
    axes, as those of terrain lie nearly in a plane.
    """
    p, axes, middle, pixels = _matched(points, pixels, 6)
    centre, size = pixels.mean(axis=0), pixels.std()
    uv = (pixels - centre) / size
    projection = _least_squares(p, uv, _linear(p, uv))
    to_pixels = np.array([[size, 0, centre[0]], [0, size, centre[1]], [0, 0, 1]])
    seen = p @ (to_pixels @ projection).T
    off = _require_close(seen[:, :2] / seen[:, 2:], pixels, max_error)
    tapering = np.linalg.norm(projection[2, :3])  # what depths differ by, beside their mean
    if tapering < _PARALLEL or np.linalg.det(projection[:, :3]) < 0:
        if tapering > max(_PARALLEL, off / size):
            rule = "must count right and down from the top left corner, these show a mirror image"
            raise ArgumentError(_OWNER, "pixels", rule)
        rule = "must be seen in perspective, these by parallel rays, as far as their pixels tell: Orthographic.from_points"
        raise ArgumentError(_OWNER, "points", rule)
    eye = middle - axes @ np.linalg.solve(projection[:, :3], projection[:, 3])
    linear = (to_pixels @ projection[:, :3]) @ np.linalg.inv(axes)
    linear /= np.linalg.norm(linear[2])
    # Of K [R | t], so that a calibrated camera's matrix and angle are those of `from_intrinsics`.
    f = np.linalg.norm(np.cross(linear[0 if width <= height else 1], linear[2]))
    camera = [(linear[0] - width / 2 * linear[2]) / f, (height / 2 * linear[2] - linear[1]) / f, linear[2]]
    return matrix_of(np.linalg.inv(np.stack(camera)), eye), math.degrees(2 * math.atan(min(width, height) / 2 / f))


def resected_in_parallel(
    points: Any, pixels: Any, width: int, height: int, max_error: float | int
) -> tuple[Float[np.ndarray, "4 4"], float]:
    """The matrix and the extent of the camera whose parallel rays see points at these pixels, by linear least squares.

    The affine camera of Hartley and Zisserman's algorithm 14.1. Its rays begin well in front of the points.
    """
    p, axes, middle, pixels = _matched(points, pixels, 4)
    projection = np.linalg.lstsq(p, pixels)[0].T
    _require_close(p @ projection.T, pixels, max_error)
    right, down = projection[:, :3] @ np.linalg.inv(axes)  # pixels per world unit
    scale, ahead = float(np.linalg.norm(right if width <= height else down)), np.cross(right, down)
    extent = min(width, height) / scale
    linear = np.linalg.inv(np.stack([right / scale, -down / scale, ahead / np.linalg.norm(ahead)]))
    back = 4 * max(np.linalg.norm(p[:, :3] @ axes.T, axis=1).max(), max(width, height) / scale)
    aside = (np.array([width, height]) / 2 - projection[:, 3]) / scale
    return matrix_of(linear, middle + linear @ [aside[0], -aside[1], -back]), extent


def _matched(points: Any, pixels: Any, least: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """(p, axes, middle, pixels): points are axes @ p + middle; p has mean 0, deviation 1 along each axis, and a 1 behind."""
    points, pixels = _given("points", points, 3), _given("pixels", pixels, 2)
    if len(points) != len(pixels):
        raise ArgumentError(_OWNER, "pixels", f"must be as many as points, they are {len(pixels)} for {len(points)} points")
    if len(points) < least:
        raise ArgumentError(_OWNER, "points", f"must be at least {least}, they are {len(points)}")
    axes = _deviations("points", points, "must not lie in one plane, which many cameras see alike")
    _deviations("pixels", pixels, "must not lie on one line")
    middle = points.mean(axis=0)
    p = (points - middle) @ np.linalg.inv(axes).T
    return np.concatenate([p, np.ones((len(p), 1))], axis=1), axes, middle, pixels


def _given(name: str, values: Any, count: int) -> Float[np.ndarray, "n count"]:
    if isinstance(values, Tracer):
        raise ArgumentError(_OWNER, name, "must be known when programs are compiled, they are traced by JAX")
    given = np.asarray(float_leaf(values), np.float64)
    if given.ndim != 2 or given.shape[1] != count:
        raise ArgumentError(_OWNER, name, f"must have shape (n, {count}), theirs is {given.shape}")
    if not (finite := np.isfinite(given).all(axis=1)).all():
        k = int(finite.argmin())
        raise ArgumentError(_OWNER, f"{name}[{k}]", f"must be finite, it is {given[k].tolist()}")
    return given


def _deviations(name: str, given: np.ndarray, rule: str) -> np.ndarray:
    """Principal axes as columns, each as long as the deviation along it."""
    _, sizes, turn = np.linalg.svd(given - given.mean(axis=0), full_matrices=False)
    if not sizes[-1] > _FLAT * sizes[0]:
        raise ArgumentError(_OWNER, name, rule)
    turn[-1] *= np.sign(np.linalg.det(turn))  # no mirror
    return turn.T * sizes / np.sqrt(len(given))


def _require_close(seen: Float[np.ndarray, "n 2"], pixels: Float[np.ndarray, "n 2"], max_error: float | int) -> float:
    """The root mean square of distances in the picture."""
    require(_OWNER, "max_error", max_error, POSITIVE)
    off = np.linalg.norm(seen - pixels, axis=1)
    k, usual = int(off.argmax()), math.sqrt(np.mean(off**2))
    if not off[k] <= max_error:
        rule = f"must lie within max_error = {max_error:g} pixels of where one camera sees the points"
        raise ArgumentError(_OWNER, "pixels", f"{rule}; pixels[{k}] is {off[k]:.3g} off, their root mean square {usual:.3g}")
    return usual


def _equations(p: Float[np.ndarray, "n 4"], uv: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "two_n 12"]:
    """Times a projection's 12 numbers: depth times (seen - uv), of all points first along u and then along v."""
    zeros = np.zeros_like(p)
    along_u = np.concatenate([p, zeros, -uv[:, :1] * p], axis=1)
    return np.concatenate([along_u, np.concatenate([zeros, p, -uv[:, 1:] * p], axis=1)])


def _linear(p: Float[np.ndarray, "n 4"], uv: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "3 4"]:
    """The projection by the direct linear transform, in which points have a mean depth of 1."""
    _, sizes, directions = np.linalg.svd(_equations(p, uv), full_matrices=False)
    if sizes[-2] < _UNDECIDED * sizes[0]:
        raise ArgumentError(_OWNER, "points", "must tell cameras apart, several see them so: most lie in one plane")
    projection = directions[-1].reshape(3, 4)
    depths = p @ projection[2]
    ahead = depths * np.sign(np.median(depths))
    if not (ahead > 0).all():
        rule = "must lie in front of the camera that sees most of them; it lies behind, or its pixel is another's"
        raise ArgumentError(_OWNER, f"points[{int(ahead.argmin())}]", rule)
    return projection / projection[2, 3]


def _least_squares(p: np.ndarray, uv: np.ndarray, start: Float[np.ndarray, "3 4"]) -> Float[np.ndarray, "3 4"]:
    """The projection with the least sum of squared distances in the picture, by Levenberg and Marquardt's method."""
    import scipy.optimize  # 0.4 s, which only this takes

    solver: Any = scipy.optimize.least_squares  # whose stub misses much

    def depths(numbers: np.ndarray) -> np.ndarray:
        return p @ np.append(numbers[8:], 1)

    def residual(numbers: np.ndarray) -> np.ndarray:
        return _equations(p, uv) @ np.append(numbers, 1) / np.tile(depths(numbers), 2)

    def slopes(numbers: np.ndarray) -> np.ndarray:
        seen = uv + residual(numbers).reshape(2, -1).T
        return _equations(p, seen)[:, :-1] / np.tile(depths(numbers), 2)[:, None]

    found = solver(residual, start.ravel()[:-1], slopes, method="lm", ftol=1e-15, xtol=1e-15, gtol=1e-15)
    return np.append(found.x, 1).reshape(3, 4)
