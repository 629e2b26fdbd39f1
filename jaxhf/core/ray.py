"""One ray."""

import equinox as eqx

from .types import Scalar, Vector


class Ray(eqx.Module):
    """The half-line `o + t * d`, t > 0, in the units of the frame that it is given in; `d` need not be unit."""

    o: Vector
    d: Vector

    def __call__(self, t: Scalar) -> Vector:
        return self.o + t * self.d
