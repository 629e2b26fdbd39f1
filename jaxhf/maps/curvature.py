"""How a surface bends: curvatures of a quadratic through, or near, the 3 x 3 heights round each vertex."""

import numpy as np
from jaxtyping import Float32, Float64

from ..core.rules import OneOf, require
from .choices import CURVATURES, QUADRATICS
from .slope import NODATA
from .surface import Heights, surface
from .windows import Window, over_windows

_Values = Float64[np.ndarray, "k m"]


def curvature(
    heights: Heights,
    dx: float | None = None,
    dy: float | None = None,
    *,
    kind: str = "mean",
    scale: float | None = None,
    quadratic: str = "evans",
    compute_edges: bool = False,
) -> Float32[np.ndarray, "ny nx"]:
    """How the surface bends at each vertex: shape (ny, nx), float32, -9999 where there is no value.

    In radians along a unit of length, positive where the surface bulges (ridges, spurs), negative where it is hollow, as Minár,
    Evans and Jenčo have it (A comprehensive system of definitions of land surface (topographic) curvatures, with implications
    for their application in geoscience modelling and prediction, Earth-Science Reviews 211, 2020):

    - "profile": of the normal section down the slope. Where it bulges, what flows gets faster.
    - "tangential": of the normal section across the slope. Where it bulges, what flows spreads.
    - "plan": of the contour line.
    - "mean": of all normal sections; half the sum of the largest and the smallest.
    - "gaussian": the product of these two, along a unit of length squared; negative at passes.

    Where the ground is level there is no direction of the slope, and the first three are 0.

    Args:
      heights, dx, dy, scale, compute_edges: see `hillshade`, whose errors it has, too.
      kind: one of these.
      quadratic: "evans": that nearest to the nine heights (Evans, An integrated system of terrain analysis and slope mapping,
        Zeitschrift für Geomorphologie, Supplement 36, 1980); "zevenbergen-thorne": through the middle and its four
        neighbours, see `hillshade`, which noise moves more.
    """
    require("curvature", "kind", kind, OneOf(CURVATURES))
    require("curvature", "quadratic", quadratic, OneOf(QUADRATICS))
    ground = surface("curvature", heights, dx, dy, scale)
    dx, dy = ground.dx * ground.scale, ground.dy * ground.scale

    def formula(window: Window) -> np.ndarray:
        p, q, r, s, t = _derivatives(window, quadratic)
        p, q = p / dx, q / dy
        r, s, t = r / dx / ground.dx, s / dx / ground.dy, t / dy / ground.dy
        limit = np.finfo(np.float32).max
        return np.clip(_bend(kind, p, q, r, s, t), -limit, limit)

    return over_windows(ground.heights, formula, compute_edges, np.float32(NODATA))


def _derivatives(window: Window, quadratic: str) -> tuple[_Values, _Values, _Values, _Values, _Values]:
    """dz/dx, dz/dy, d²z/dx², d²z/dxdy and d²z/dy² in cells; x to the east, y to the north."""
    nw, n, ne, w, middle, e, sw, s, se = (view.astype(np.float64) for view in window)
    twist = (ne + sw - nw - se) / 4
    if quadratic == "zevenbergen-thorne":
        return (e - w) / 2, (n - s) / 2, e + w - 2 * middle, twist, n + s - 2 * middle
    east, west, north, south = ne + e + se, nw + w + sw, nw + n + ne, sw + s + se
    across, up = n + middle + s, w + middle + e
    return (east - west) / 6, (north - south) / 6, (east + west - 2 * across) / 3, twist, (north + south - 2 * up) / 3


def _over(a: _Values, b: _Values) -> _Values:
    """a / b, and 0 where the ground is level."""
    return np.divide(a, b, out=np.zeros_like(a), where=b > 0)


def _bend(kind: str, p: _Values, q: _Values, r: _Values, s: _Values, t: _Values) -> _Values:
    """The curvature from dz/dx, dz/dy, d²z/dx², d²z/dxdy and d²z/dy²."""
    squared = p * p + q * q
    stretch = 1 + squared
    if kind == "mean":
        return -((1 + q * q) * r - 2 * p * q * s + (1 + p * p) * t) / (2 * stretch**1.5)
    if kind == "gaussian":
        return (r * t - s * s) / stretch**2
    if kind == "profile":
        return -_over(r * p * p + 2 * s * p * q + t * q * q, squared * stretch**1.5)
    across = r * q * q - 2 * s * p * q + t * p * p
    return -_over(across, squared**1.5 if kind == "plan" else squared * np.sqrt(stretch))
