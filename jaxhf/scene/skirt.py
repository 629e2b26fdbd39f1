"""Walls and a floor with which terrain looks solid."""

import functools
import math
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jax.core import Tracer
from jaxtyping import Float

from ..core.errors import ArgumentError
from ..core.rules import require
from ..core.types import FINITE, AnyArray, ScalarLeaf, float_leaf, height_leaf
from .heightfield import Heightfield
from .record import number, numbers

_border = functools.partial(height_leaf, "Skirt", "border")


class Skirt(eqx.Module):
    """The four vertical walls under a heightfield's border, down to a level, and the floor there; seen from both sides.

    (u, v) on a wall: u along it, 0 to 1, v from 0 on the floor to 1 on the highest point of the border; on the floor as on the
    heightfield. Where the border has a hole there is no wall. A derivative of a scene that has one is refused with
    `Settings.edge_samples` above 0.

    Attributes:
      south, north: heights of the border's first and last row.
      west, east: of its first and last column.
      base: z of the floor, object units.
      dx, dy, x0, y0: those of the heightfield.
    """

    south: Float[AnyArray, " nx"] = eqx.field(converter=_border)
    north: Float[AnyArray, " nx"] = eqx.field(converter=_border)
    west: Float[AnyArray, " ny"] = eqx.field(converter=_border)
    east: Float[AnyArray, " ny"] = eqx.field(converter=_border)
    base: ScalarLeaf = eqx.field(converter=float_leaf)
    dx: float = eqx.field(static=True)
    dy: float = eqx.field(static=True)
    x0: float = eqx.field(static=True)
    y0: float = eqx.field(static=True)

    @classmethod
    def of(cls, field: Heightfield, base: Any) -> "Skirt":
        """The walls under a heightfield, for an `Object` with the same transform.

        Raises:
          ValueError: `base` is not one finite number, or lies above the lowest height of the border.
        """
        z = field.heights
        level = float_leaf(base)
        require("Skirt", "base", level, FINITE)
        if isinstance(level, np.ndarray) and not isinstance(z, Tracer):
            z = jax.device_get(z)
            rim = np.concatenate([z[0], z[-1], z[:, 0], z[:, -1]])
            lowest = rim[np.isfinite(rim)].min(initial=math.inf)
            if level > lowest:
                raise ArgumentError("Skirt", "base", f"must not lie above the border, whose lowest is {lowest}; it is {level}")
        return cls(z[0], z[-1], z[:, 0], z[:, -1], level, field.dx, field.dy, field.x0, field.y0)

    def __repr__(self) -> str:
        place = ", ".join(f"{name}={number(getattr(self, name))}" for name in ("dx", "dy", "x0", "y0"))
        return f"Skirt({len(self.west)} x {len(self.south)}, base={numbers(self.base)}, {place})"
