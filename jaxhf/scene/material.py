"""Materials: how a surface reflects light."""

from typing import Any

import equinox as eqx
from jaxtyping import Float

from ..core.types import COLOUR, AnyArray, Number, rgb_leaf
from .record import Record
from .texture import ImageTexture

_ALBEDO = Number(shape=(3,), shape_words="be one number or three, or an ImageTexture")


def _albedo(value: Any) -> Any:
    return value if isinstance(value, ImageTexture) else rgb_leaf(value)


class Matte(Record):
    """A Lambertian surface with two sides.

    Attributes:
      albedo: the reflected share of the light: a number, three numbers (r, g, b), or an `ImageTexture` over the shape's uv.
    """

    albedo: Float[AnyArray, "3"] | ImageTexture = eqx.field(converter=_albedo, metadata={"rule": _ALBEDO})


class Mirror(Record):
    """A perfect mirror with two sides.

    Attributes:
      reflectance: the reflected share: a number or three; pbrt's default is 0.9.
    """

    reflectance: Float[AnyArray, "3"] = eqx.field(converter=rgb_leaf, default=0.9, metadata={"rule": COLOUR})


Material = Matte | Mirror
