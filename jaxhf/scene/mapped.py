"""Cameras of pictures that know their place on the Earth: by RPC models, and by geotransforms.

A terrain here is whatever has the attributes of `jaxhf.Terrain`, which stands behind this package in the flow.
"""

import math
from typing import Any

import numpy as np
from jaxtyping import Float

from ..core.errors import ArgumentError
from ..core.extras import import_extra
from ..core.rules import require
from ..core.types import FINITE, POSITIVE
from .resection import resected

_SEARCHED, _FITTED, _LEVELS = 257, 17, 5  # columns and rows among which what is seen is looked for, and fitted to; heights
_THIN = 0.01  # of a box: the least height in which a camera is fitted, so that a plain tells it, too


def resected_rpc(
    rpcs: Any, terrain: Any, width: int, height: int, geoid: float | int, max_error: float | int
) -> tuple[Float[np.ndarray, "4 4"], float]:
    """The matrix and the angle of view of the pinhole nearest to an RPC model, see `Perspective.from_rpc`."""
    owner = "from_rpc"
    rasterio = import_extra("rasterio", "an RPC model needs", "geo")
    if not isinstance(rpcs, rasterio.rpc.RPC):
        raise ArgumentError(owner, "rpcs", f"must be an RPC of rasterio's, as dataset.rpcs, it is {rpcs!r}")
    low, high = _levels(owner, terrain)
    require(owner, "geoid", geoid, FINITE)
    require(owner, "max_error", max_error, POSITIVE)
    ny, nx = terrain.heights.shape
    west, south = terrain.x0, terrain.y0
    east, north = west + (nx - 1) * terrain.dx, south + (ny - 1) * terrain.dy

    def seen(count: int, levels: int, thick: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Points of a grid in the box, where the model sees them, and whether that is in the picture."""
        z = np.linspace((low + high - thick) / 2, (low + high + thick) / 2, levels)
        x, y, z = np.meshgrid(np.linspace(west, east, count), np.linspace(south, north, count), z, indexing="ij")
        latitude, longitude, above = (values.ravel() for values in terrain.geodetic(x, y, z))
        if not np.isfinite(latitude + longitude).all():
            raise ArgumentError(owner, "terrain", "must have a place on a globe, its georeference does not say it")
        with rasterio.transform.RPCTransformer(rpcs) as model:
            rows, columns = model.rowcol(longitude, latitude, above + geoid, op=np.positive)
        shown = (columns >= 0) & (columns <= width) & (rows >= 0) & (rows <= height)
        if not shown.any():
            place = f"columns {columns.min():.6g} to {columns.max():.6g} and rows {rows.min():.6g} to {rows.max():.6g}"
            raise ArgumentError(owner, "terrain", f"must be in the picture of {width} x {height} pixels, it is at {place}")
        return np.stack([x.ravel(), y.ravel(), z.ravel()], axis=1), np.stack([columns, rows], axis=1), shown

    points, _, shown = seen(_SEARCHED, 2, high - low)
    step = np.array([east - west, north - south]) / (_SEARCHED - 1)
    west, south = np.maximum(points[shown, :2].min(axis=0) - step, [west, south])
    east, north = np.minimum(points[shown, :2].max(axis=0) + step, [east, north])
    points, pixels, shown = seen(_FITTED, _LEVELS, max(high - low, _THIN * max(east - west, north - south)))
    try:
        return resected(points[shown], pixels[shown], width, height, max_error)
    except ArgumentError as error:
        rule = "must be small enough for one perspective; a part of it, or of the picture, is seen more nearly so"
        raise ArgumentError(owner, "terrain", f"{rule} ({error.argument} {error.rule})") from error


def geotransformed(transform: Any, terrain: Any, width: int, height: int) -> tuple[Float[np.ndarray, "4 4"], float]:
    """The matrix and the extent of an orthophoto's camera, see `Orthographic.from_geotransform`."""
    owner = "from_geotransform"
    if not all(hasattr(transform, name) for name in "abcdef"):
        rule = "must be an Affine, as rasterio's dataset.transform or Affine.from_gdal(*numbers)"
        raise ArgumentError(owner, "transform", f"{rule}, it is {transform!r}")
    to_file = np.array([[transform.a, transform.b, transform.c], [transform.d, transform.e, transform.f]], np.float64)
    if not (np.isfinite(to_file).all() and np.linalg.det(to_file[:, :2])):
        raise ArgumentError(owner, "transform", f"must be finite and invertible, it is {to_file.tolist()}")
    low, high = _levels(owner, terrain)
    axes, offset = np.split(terrain.file_from_terrain, [2], axis=1)
    to_file[:, 2:] -= offset
    right, down, corner = np.linalg.solve(axes, to_file).T  # of a pixel, in world units
    pixel = float(np.linalg.norm(right if width <= height else down))
    extent = min(width, height) * pixel
    matrix = np.diag([1.0, 1.0, -1.0, 1.0])
    matrix[:2, 0], matrix[:2, 1] = right / pixel, -down / pixel
    matrix[:2, 3], matrix[2, 3] = corner + width / 2 * right + height / 2 * down, high + (high - low) + extent
    return matrix, extent


def _levels(owner: str, terrain: Any) -> tuple[float, float]:
    """The lowest and the highest of a terrain's heights."""
    if not hasattr(terrain, "in_file"):
        raise ArgumentError(owner, "terrain", f"must be a Terrain, as load_heights gives it, it is a {type(terrain).__name__}")
    low, high = (float(of.reduce(terrain.heights, axis=None)) for of in (np.fmin, np.fmax))
    if not math.isfinite(high - low):
        raise ArgumentError(owner, "terrain", f"must have heights, nan being none; they go from {low} to {high}")
    return low, high
