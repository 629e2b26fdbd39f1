"""Materials: how a surface reflects light."""

from typing import Any

import equinox as eqx
from jaxtyping import Float

from ..core.errors import ArgumentError
from ..core.types import AnyArray, require_finite, rgb_leaf
from .show import fields
from .texture import ImageTexture


def _albedo(value: Any) -> Any:
    return value if isinstance(value, ImageTexture) else rgb_leaf(value)


class Matte(eqx.Module):
    """A Lambertian surface with two sides.

    Attributes:
      albedo: the reflected share of the light: a number, three numbers (r, g, b), or an `ImageTexture` over the shape's uv.
    """

    albedo: Float[AnyArray, "3"] | ImageTexture = eqx.field(converter=_albedo)

    def __check_init__(self):
        if not isinstance(self.albedo, ImageTexture):
            if self.albedo.shape != (3,):
                hint = "; an image is an ImageTexture" if len(self.albedo.shape) > 1 else ""
                raise ArgumentError("Matte", "albedo", f"must be one number or three, its shape is {self.albedo.shape}{hint}")
            require_finite("Matte", "albedo", self.albedo)

    def __repr__(self) -> str:
        return fields(self)


class Mirror(eqx.Module):
    """A perfect mirror with two sides.

    Attributes:
      reflectance: the reflected share: a number or three; pbrt's default is 0.9.
    """

    reflectance: Float[AnyArray, "3"] = eqx.field(converter=rgb_leaf, default=0.9)

    def __check_init__(self):
        if self.reflectance.shape != (3,):
            raise ArgumentError("Mirror", "reflectance", f"must be one number or three, its shape is {self.reflectance.shape}")
        require_finite("Mirror", "reflectance", self.reflectance)

    def __repr__(self) -> str:
        return fields(self)


Material = Matte | Mirror
