"""Textures: images spread over a surface."""

from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from ..core.errors import ArgumentError
from ..core.rules import OneOf, require_fields
from ..core.types import AnyArray, Index, Point2, Scalar, Vector, float_leaf
from ..core.vector import within

Wrap = Literal["repeat", "clamp"]


def _texels(value: Any) -> Any:
    if isinstance(value, np.ndarray | jax.Array) and value.dtype.kind in "bu":
        rule = f"must hold linear colours in floats, 1 being white; theirs are {value.dtype} (load_image decodes a picture)"
        raise ArgumentError("ImageTexture", "texels", rule)
    leaf = float_leaf(value)
    return leaf[:, :, None].repeat(3, axis=2) if leaf.ndim == 2 else leaf


class ImageTexture(eqx.Module):
    """An image spread over (u, v) in 0..1, looked up bilinearly.

    Attributes:
      texels: linear colours, shape (h, w, 3), or (h, w) of greys: row 0 is v = 0, u runs along a row, texel centres lie at half
        steps.
      at_vertices: whether the outermost texel centres lie on 0 and 1 instead: an image of (ny, nx) texels then gives each
        vertex of a heightfield of that shape its colour, and a point outside that of the border.
      wrap: what lies beyond the outermost texel centres, half a texel inside the border: "repeat", the opposite border, as in
        pbrt; "clamp", the colour of the nearest texel.
    """

    texels: Float[AnyArray, "h w 3"] = eqx.field(converter=_texels)
    at_vertices: bool = eqx.field(static=True, default=False, kw_only=True)
    wrap: Wrap = eqx.field(static=True, default="repeat", kw_only=True, metadata={"rule": OneOf(Wrap)})

    def __check_init__(self):
        require_fields(self)
        if len(self.texels.shape) != 3 or self.texels.shape[2] != 3 or 0 in self.texels.shape:
            raise ArgumentError("ImageTexture", "texels", f"must have shape (h, w, 3) or (h, w), theirs is {self.texels.shape}")
        if isinstance(self.texels, np.ndarray) and not np.isfinite(self.texels).all():
            iy, ix, _ = np.argwhere(~np.isfinite(self.texels))[0]
            raise ArgumentError(
                "ImageTexture", "texels", f"must be finite, row {iy} column {ix} is {self.texels[iy, ix].tolist()}"
            )

    def __call__(self, uv: Point2) -> Vector:
        texels = jnp.asarray(self.texels)
        (low, high, fy), (left, right, fx) = self._between(uv)
        return (1 - fy) * ((1 - fx) * texels[low, left] + fx * texels[low, right]) + fy * (
            (1 - fx) * texels[high, left] + fx * texels[high, right]
        )

    def corners(self, uv: Point2) -> tuple[Int[jax.Array, "4"], Int[jax.Array, "4"], Float[jax.Array, "4"]]:
        """The rows and columns of the four texels between which a colour is looked up, and their weights."""
        (low, high, fy), (left, right, fx) = self._between(uv)
        rows, columns = jnp.stack([low, low, high, high]), jnp.stack([left, right, left, right])
        return rows, columns, jnp.stack([(1 - fy) * (1 - fx), (1 - fy) * fx, fy * (1 - fx), fy * fx])

    def _between(self, uv: Point2) -> tuple[tuple[Index, Index, Scalar], tuple[Index, Index, Scalar]]:
        """The two rows, and then the two columns, between which (u, v) lies, and its share of the way."""
        h, w, _ = self.texels.shape
        if self.at_vertices:
            x, y = within(uv[0], 0.0, 1.0) * (w - 1), within(uv[1], 0.0, 1.0) * (h - 1)
        else:
            x, y = uv[0] * w - 0.5, uv[1] * h - 0.5
            if self.wrap == "clamp":
                x, y = within(x, 0.0, w - 1.0), within(y, 0.0, h - 1.0)
        column, row = jnp.floor(x), jnp.floor(y)
        fx, fy = x - column, y - row
        ix, iy = column.astype(jnp.int32), row.astype(jnp.int32)
        return (iy % h, (iy + 1) % h, fy), (ix % w, (ix + 1) % w, fx)
