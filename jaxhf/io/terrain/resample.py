"""Heights of one grid at the vertices of another."""

import numpy as np
from jaxtyping import Float

from ..errors import FileError
from .terrain import Terrain


def at_vertices(terrain: Terrain, wanted: Terrain) -> Float[np.ndarray, "ny nx"]:
    """The bilinear surface of `terrain` at the vertices of `wanted`.

    Half a cell beyond the outermost vertices, as far as pixels reach, the outermost heights hold: the centres of a coarse
    raster's pixels lie further inside than those of a fine one with the same corners. Vertices with a share in a hole are nan.
    Both have a `crs`, in the same kind of coordinates: degrees or lengths.
    """
    own, other = terrain.crs, wanted.crs
    assert own is not None
    assert other is not None
    if None not in (own.code, other.code) and own.code != other.code:
        raise FileError(f"it must have the terrain's coordinates, EPSG:{other.code}; it has EPSG:{own.code}")
    heights = terrain.heights
    (_, columns), (_, wanted_columns) = heights.shape, wanted.heights.shape
    middle, wanted_middle = terrain.x0 + (columns - 1) / 2 * terrain.dx, wanted.x0 + (wanted_columns - 1) / 2 * wanted.dx
    turns = round((wanted_middle - middle) / 360) if own.degrees else 0  # longitudes may count from -180 or from 0
    sides = (
        ("latitude" if own.degrees else "y", terrain.y0, terrain.dy, wanted.y0, wanted.dy),
        ("longitude" if own.degrees else "x", terrain.x0 + 360 * turns, terrain.dx, wanted.x0, wanted.dx),
    )
    for axis, (name, first, step, wanted_first, wanted_step) in enumerate(sides):
        count, wanted_count = heights.shape[axis], wanted.heights.shape[axis]
        at = (wanted_first - first) / step + np.arange(wanted_count) * (wanted_step / step)  # in cells of `terrain`
        vertex = np.rint(at)
        at = np.where(np.abs(at - vertex) < 1e-6, vertex, at)  # without a share in the next one, which may be a hole
        if at[0] < -0.5 or at[-1] > count - 0.5:
            last, wanted_last = first + (count - 1) * step, wanted_first + (wanted_count - 1) * wanted_step
            rule = f"it must cover the terrain, whose {name} goes from {wanted_first:.10g} to {wanted_last:.10g}"
            raise FileError(f"{rule}; its own goes from {first:.10g} to {last:.10g}")
        at = np.clip(at, 0, count - 1)
        low, high = np.floor(at).astype(int), np.ceil(at).astype(int)
        share = np.expand_dims(at - low, 1 - axis)
        heights = (1 - share) * np.take(heights, low, axis) + share * np.take(heights, high, axis)
    return heights
