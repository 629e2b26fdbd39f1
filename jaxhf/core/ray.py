"""One ray."""

import equinox as eqx

from .types import Scalar, Vector


class Ray(eqx.Module):
    """The half-line `o + t * d`, t > 0, in the units of the frame that it is given in; `d` need not be unit.

    Attributes:
      o, d: where it begins, and its direction.
      before: how much longer t is from the camera's own place, where that is far behind `o`; None: `o` is that place.
    """

    o: Vector
    d: Vector
    before: Scalar | None = None

    def __call__(self, t: Scalar) -> Vector:
        return self.o + t * self.d
