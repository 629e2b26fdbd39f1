"""All samples of a picture, in chunks of one size, and what they add up to."""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Float, Int

from ..boundary.term import resampled_side
from ..core.sampling import sample_offset
from ..core.settings import Settings
from ..scene.camera import Camera
from .tiles import Tiling

Points = tuple[Float[jax.Array, "chunks n"], Float[jax.Array, "chunks n"]]
"""Positions in the picture, x and y."""


class PictureSamples(NamedTuple):
    """The samples of a picture: those of each pixel, tile by tile, and then those of pixels that are sampled once more.

    Attributes:
      camera: whose picture it is.
      settings: the knobs.
      resampled: the numbers of the pixels that have `resampled_side` squared samples besides; None: there are none.
    """

    camera: Camera
    settings: Settings
    resampled: Int[jax.Array, " pixels"] | None = None

    @property
    def _samples(self) -> int:
        assert self.settings.samples is not None
        return self.settings.samples

    def positions(self) -> Points:
        """Where all samples lie."""
        tiling, dtype = Tiling(self.camera, self.settings), self.camera.world_from_camera.dtype
        pixels = jax.vmap(tiling.pixels)(jnp.arange(tiling.count, dtype=jnp.int32))
        offsets = sample_offset(jnp.arange(self._samples, dtype=jnp.int32), math.isqrt(self._samples), dtype)
        size = tiling.side * tiling.side
        x, y = (
            (pixel.astype(dtype)[:, None, :] + offset[None, :, None]).reshape(-1, size)
            for pixel, offset in zip(pixels, offsets, strict=True)
        )
        if self.resampled is None:
            return x, y
        side = resampled_side(self.settings)
        offsets = sample_offset(jnp.arange(side * side, dtype=jnp.int32), side, dtype)
        corners = self.resampled % self.camera.width, self.resampled // self.camera.width
        more = [(corner.astype(dtype)[:, None] + offset[None]).ravel() for corner, offset in zip(corners, offsets, strict=True)]
        more = [jnp.pad(values, (0, -values.shape[0] % size), mode="edge").reshape(-1, size) for values in more]
        return jnp.concatenate([x, more[0]]), jnp.concatenate([y, more[1]])

    def in_pixels(self, values: Float[jax.Array, "chunks n c"]) -> Float[jax.Array, "h w c"]:
        """The means over the samples of each pixel."""
        tiling = Tiling(self.camera, self.settings)
        return tiling.assemble(self._in_tiles(values).mean(1))

    def in_rows(self, values: Float[jax.Array, "chunks n c"]) -> Float[jax.Array, "rows columns c"]:
        """The picture's samples where they lie, row by row: each pixel is a square of them."""
        tiling, side = Tiling(self.camera, self.settings), math.isqrt(self._samples)
        pixels = tiling.assemble(jnp.moveaxis(self._in_tiles(values), 1, 2))
        h, w, _, c = pixels.shape
        return pixels.reshape(h, w, side, side, c).swapaxes(1, 2).reshape(h * side, w * side, c)

    def _in_tiles(self, values: Float[jax.Array, "chunks n c"]) -> Float[jax.Array, "tiles samples n c"]:
        count = Tiling(self.camera, self.settings).count
        return values[: count * self._samples].reshape(count, self._samples, *values.shape[1:])

    def of_resampled(self, values: Float[jax.Array, "chunks n c"]) -> Float[jax.Array, "pixels samples c"]:
        """The samples of the pixels that are sampled once more."""
        assert self.resampled is not None
        shape = self.resampled.shape[0], resampled_side(self.settings) ** 2
        rest = values[Tiling(self.camera, self.settings).count * self._samples :].reshape(-1, values.shape[-1])
        return rest[: shape[0] * shape[1]].reshape(*shape, -1)
