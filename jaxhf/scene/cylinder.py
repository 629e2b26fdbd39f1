"""An open cylinder, on which pbrt scenes paint their sky."""

import equinox as eqx
import numpy as np

from ..core.errors import ArgumentError
from ..core.types import FINITE, POSITIVE, ScalarLeaf, float_leaf
from .record import Record


class Cylinder(Record):
    """A cylinder about the z axis of its object's frame, without caps; seen from both sides.

    (u, v): u = phi / 2 pi with phi = atan2(y, x) in [0, 2 pi), v runs from z_min to z_max (pbrt-v2, `Shape "cylinder"`).

    Attributes:
      radius, z_min, z_max: object units.
    """

    radius: ScalarLeaf = eqx.field(converter=float_leaf, default=1.0, metadata={"rule": POSITIVE})
    z_min: ScalarLeaf = eqx.field(converter=float_leaf, default=-1.0, metadata={"rule": FINITE})
    z_max: ScalarLeaf = eqx.field(converter=float_leaf, default=1.0, metadata={"rule": FINITE})

    def _require_consistent(self):
        if isinstance(self.z_min, np.ndarray) and isinstance(self.z_max, np.ndarray) and not self.z_min < self.z_max:
            raise ArgumentError("Cylinder", "z_min", f"must lie below z_max, they are {self.z_min} and {self.z_max}")
