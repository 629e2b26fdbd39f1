"""Heights on a regular grid."""

import math
from typing import Any, SupportsFloat

import equinox as eqx
import numpy as np
from jax.core import Tracer
from jaxtyping import Float, Int

from ..core.errors import ArgumentError, require_kind
from ..core.types import AnyArray, height_leaf
from .record import known, number, numbers, span

# So that a walk's state fits into 32 bits; each side of the grid counts as the next power of two.
MOST_CELLS = 2**28
_FARTHEST = 1e18  # whose square and inverse square are numbers in single precision


def next_power_of_two(count: int) -> int:
    """The least power of two that is at least 2 and `count`."""
    return 1 << max(1, (count - 1).bit_length())


class Size(eqx.Module):
    """That of a heightfield as data, for a program that serves several; its heights then have an array with holes behind them.

    Attributes:
      cells: along x and along y.
      spacing: dx and dy.
      lengths: of the footprint, x and y.
    """

    cells: Int[AnyArray, "2"]
    spacing: Float[AnyArray, "2"]
    lengths: Float[AnyArray, "2"]

    @classmethod
    def of(cls, shape: tuple[int, int], dx: float, dy: float, dtype: Any) -> "Size":
        """Of a grid of (ny, nx) vertices."""
        ny, nx = shape
        cells: Any = np.array([nx - 1, ny - 1], np.int32)
        spacing: Any = np.array([dx, dy], dtype)
        lengths: Any = np.array([(nx - 1) * dx, (ny - 1) * dy], dtype)
        return cls(cells, spacing, lengths)


class Heightfield(eqx.Module):
    """A surface z = heights over a regular grid, two triangles to a cell, split along (ix, iy)-(ix+1, iy+1).

    Attributes:
      heights: shape (ny, nx), at least 2x2, object units; vertex (ix, iy) stands at x = x0 + ix dx, y = y0 + iy dy. A
        vertex that is nan, infinite or masked is a hole: the cells around it are not there. Their dtype, float32 or
        float64, is the precision of everything that is rendered from them. Of other real numbers longdouble becomes
        float64, all else float32; float64 becomes float32 without JAX's x64 mode, with a warning where that moves a
        height by more than a thousandth of the relief. NumPy's arrays are copied. There are at most 2^28 cells, where
        the cells along each side count as the next power of two.
      dx, dy: cell size, object units; one alone counts for both. With neither given the grid spans pbrt's unit square.
      x0, y0: where vertex (0, 0) stands. They are metadata in double precision and never enter single-precision
        arithmetic: an offset of 5e6 costs no accuracy.
      seam: at vertices where the surface goes on in another heightfield, its slopes (dz/dx, dz/dy), as `nested` gives them;
        nan elsewhere; shape (ny, nx, 2). Smooth shading takes these, a border along them bounds nothing, and a fit holds their
        heights. None: it goes on nowhere.
    """

    heights: Float[AnyArray, "ny nx"]
    dx: float = eqx.field(static=True)
    dy: float = eqx.field(static=True)
    x0: float = eqx.field(static=True)
    y0: float = eqx.field(static=True)
    seam: Float[AnyArray, "ny nx 2"] | None

    def __init__(
        self,
        heights: Any,
        dx: float | None = None,
        dy: float | None = None,
        x0: float = 0.0,
        y0: float = 0.0,
        seam: Any = None,
    ):
        self.heights = height_leaf("Heightfield", "heights", heights)
        shape = self.heights.shape
        if len(shape) != 2 or min(shape) < 2:
            raise ArgumentError("Heightfield", "heights", f"must have shape (ny, nx) of at least 2x2, theirs is {shape}")
        padded = [next_power_of_two(n - 1) for n in shape]
        if math.prod(padded) > MOST_CELLS:
            rule = "must have at most 2**28 cells, each side rounded up to a power of two"
            raise ArgumentError("Heightfield", "heights", f"{rule}; shape {shape} makes {padded[0]} x {padded[1]}")
        for name, value in (("dx", dx), ("dy", dy), ("x0", x0), ("y0", y0)):
            if isinstance(value, Tracer):
                raise ArgumentError("Heightfield", name, "must be known when programs are compiled, it is traced by JAX")
            require_kind("Heightfield", name, 0.0 if value is None else value, SupportsFloat, "one number")
        square = dx if dy is None else dy  # one of the two alone counts for both
        self.dx = float(1 / (shape[1] - 1) if square is None else square if dx is None else dx)
        self.dy = float(1 / (shape[0] - 1) if square is None else square if dy is None else dy)
        self.x0, self.y0 = float(x0), float(y0)
        for name in ("dx", "dy"):
            value = getattr(self, name)
            if not 0 < value < math.inf:
                raise ArgumentError("Heightfield", name, f"must be positive and finite, it is {value}")
            if not 1 / _FARTHEST <= value <= _FARTHEST:
                raise ArgumentError("Heightfield", name, f"must be from {1 / _FARTHEST:g} to {_FARTHEST:g}, it is {value}")
        for name in ("x0", "y0"):
            if not math.isfinite(getattr(self, name)):
                raise ArgumentError("Heightfield", name, f"must be finite, it is {getattr(self, name)}")
        self.seam = None if seam is None else height_leaf("Heightfield", "seam", seam, self.heights.dtype)
        if self.seam is not None and self.seam.shape != (*shape, 2):
            raise ArgumentError("Heightfield", "seam", f"must have shape {(*shape, 2)}, its shape is {self.seam.shape}")

    def __repr__(self) -> str:
        heights = known(self.heights)
        size, reach = numbers(self.heights), ""
        if heights is not None and heights.ndim == 2:
            size, reach = f"{len(heights)} x {heights.shape[1]}", f", heights {span(heights)}"
        grid = ", ".join(f"{name}={number(getattr(self, name))}" for name in ("dx", "dy", "x0", "y0"))
        return f"Heightfield({size}, {grid}{reach})"
