"""One ray, and how wide a part of the picture is where it goes."""

import equinox as eqx

from ._types import Scalar, Vector


class Ray(eqx.Module):
    """The half-line `o + t * d`, t > 0, in the units of the frame that it is given in; `d` need not be unit."""

    o: Vector
    d: Vector

    def __call__(self, t: Scalar) -> Vector:
        return self.o + t * self.d


class Footprint(eqx.Module):
    """How far apart two points may lie at a ray's `t` and still be seen as close as was asked: `width + spread * t`.

    The idea of a pixel's footprint along a ray is that of Igehy (Tracing ray differentials, SIGGRAPH 1999).
    """

    width: Scalar
    spread: Scalar

    def __call__(self, t: Scalar) -> Scalar:
        return self.width + self.spread * t
