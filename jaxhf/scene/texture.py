"""Textures: images spread over a surface."""

from collections.abc import Callable
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
        return _mixed(self._between(uv), self.at)

    def at(self, row: Int[AnyArray, "*n"], column: Int[AnyArray, "*n"]) -> Float[jax.Array, "*n 3"]:
        """The colour of a texel, or of each of some."""
        return jnp.asarray(self.texels)[row, column]

    @property
    def columns(self) -> int:
        return self.texels.shape[1]

    def corners(self, uv: Point2) -> "Corners":
        return _corners(self._between(uv))

    def _between(self, uv: Point2) -> "tuple[_Between, _Between]":
        h, w, _ = self.texels.shape
        return _between(uv, jnp.int32(h), jnp.int32(w), self.at_vertices, self.wrap)


class FlatTexture(eqx.Module):
    """An `ImageTexture` whose size a program need not know: its texels row after row, and whatever behind them.

    Attributes:
      h, w: rows, and texels in each.
      at_vertices, wrap: as of `ImageTexture`.
    """

    texels: Float[AnyArray, "n 3"]
    h: Int[AnyArray, ""]
    w: Int[AnyArray, ""]
    at_vertices: bool = eqx.field(static=True)
    wrap: Wrap = eqx.field(static=True)

    @classmethod
    def of(cls, image: ImageTexture, texels: Float[AnyArray, "n 3"]) -> "FlatTexture":
        """The image, whose texels these are."""
        size: Any = [np.array(n, np.int32) for n in image.texels.shape[:2]]
        return cls(texels, size[0], size[1], image.at_vertices, image.wrap)

    def __call__(self, uv: Point2) -> Vector:
        return _mixed(self._between(uv), self.at)

    def at(self, row: Int[AnyArray, "*n"], column: Int[AnyArray, "*n"]) -> Float[jax.Array, "*n 3"]:
        """As of `ImageTexture`."""
        return jnp.asarray(self.texels)[row * self.w + column]

    @property
    def columns(self) -> Index:
        return jnp.asarray(self.w)

    def corners(self, uv: Point2) -> "Corners":
        return _corners(self._between(uv))

    def _between(self, uv: Point2) -> "tuple[_Between, _Between]":
        return _between(uv, jnp.asarray(self.h), jnp.asarray(self.w), self.at_vertices, self.wrap)


_Between = tuple[Index, Index, Scalar]
"""Two rows or columns of an image, and the share of the way from the first to the second."""

Corners = tuple[Int[jax.Array, "4"], Int[jax.Array, "4"], Float[jax.Array, "4"]]
"""The rows and columns of the four texels between which a colour is looked up, and their weights."""


def _corners(between: tuple[_Between, _Between]) -> Corners:
    (low, high, fy), (left, right, fx) = between
    rows, columns = jnp.stack([low, low, high, high]), jnp.stack([left, right, left, right])
    return rows, columns, jnp.stack([(1 - fy) * (1 - fx), (1 - fy) * fx, fy * (1 - fx), fy * fx])


def _between(uv: Point2, h: Index, w: Index, at_vertices: bool, wrap: Wrap) -> tuple[_Between, _Between]:
    """The two rows, and then the two columns, between which (u, v) lies in an image of this size."""
    height, width = h.astype(uv.dtype), w.astype(uv.dtype)
    if at_vertices:
        x, y = within(uv[0], 0.0, 1.0) * (width - 1), within(uv[1], 0.0, 1.0) * (height - 1)
    else:
        x, y = uv[0] * width - 0.5, uv[1] * height - 0.5
        if wrap == "clamp":
            x, y = within(x, 0.0, width - 1), within(y, 0.0, height - 1)
    column, row = jnp.floor(x), jnp.floor(y)
    fx, fy = x - column, y - row
    ix, iy = column.astype(jnp.int32), row.astype(jnp.int32)
    if at_vertices or wrap == "clamp":
        return (iy, jnp.minimum(iy + 1, h - 1), fy), (ix, jnp.minimum(ix + 1, w - 1), fx)
    return (iy % h, (iy + 1) % h, fy), (ix % w, (ix + 1) % w, fx)


def _mixed(between: tuple[_Between, _Between], texel: Callable[[Index, Index], Vector]) -> Vector:
    """The four texels between which a point lies, by its shares of the ways."""
    (low, high, fy), (left, right, fx) = between
    below = (1 - fx) * texel(low, left) + fx * texel(low, right)
    return (1 - fy) * below + fy * ((1 - fx) * texel(high, left) + fx * texel(high, right))
