"""All samples of a picture, in chunks of one size, and what they add up to."""

import math
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from ..boundary.term import resampled_side
from ..core.settings import Settings
from ..core.types import AnyArray
from ..scene.camera import Camera
from .tiles import Tiling, sample_offset


class PictureSamples:
    """The samples of a picture: those of each pixel, tile by tile, and then those of pixels that are sampled once more.

    Attributes:
      tiling: of the picture.
      resampled: the numbers of the pixels that have `resampled_side` squared samples besides; None: there are none.
      resampled_side: see the function of this name.
    """

    def __init__(self, camera: Camera, settings: Settings, resampled: Int[AnyArray, " pixels"] | None = None):
        self.tiling, self.dtype = Tiling(camera.width, camera.height, settings), camera.world_from_camera.dtype
        self.resampled, self.resampled_side = resampled, resampled_side(settings)

    @property
    def size(self) -> int:
        """Samples of a chunk."""
        return self.tiling.side**2

    @property
    def chunks(self) -> int:
        more = 0 if self.resampled is None else math.ceil(self.resampled.shape[0] * self.resampled_side**2 / self.size)
        return self.tiling.count * self.tiling.samples + more

    def positions(self, xp: Any = jnp) -> tuple[Float[AnyArray, "chunks n"], Float[AnyArray, "chunks n"]]:
        """Where all samples lie in the picture, x and y; by JAX, or by NumPy."""
        tiling, dtype, size = self.tiling, self.dtype, self.size
        number, corners = xp.arange(size, dtype=np.int32)[None], tiling.corners()[:, :, None]
        pixels = corners[:, 0] + number % tiling.side, corners[:, 1] + number // tiling.side
        offsets = sample_offset(xp.arange(tiling.samples, dtype=np.int32), math.isqrt(tiling.samples), dtype)
        x, y = (
            (pixel.astype(dtype)[:, None, :] + offset[None, :, None]).reshape(-1, size)
            for pixel, offset in zip(pixels, offsets, strict=True)
        )
        if self.resampled is None:
            return x, y
        side = self.resampled_side
        offsets = sample_offset(xp.arange(side * side, dtype=np.int32), side, dtype)
        corners = self.resampled % tiling.width, self.resampled // tiling.width
        more = [(corner.astype(dtype)[:, None] + offset[None]).ravel() for corner, offset in zip(corners, offsets, strict=True)]
        more = [xp.pad(values, (0, -values.shape[0] % size), mode="edge").reshape(-1, size) for values in more]
        return xp.concatenate([x, more[0]]), xp.concatenate([y, more[1]])

    def in_pixels(self, values: Float[AnyArray, "chunks n c"]) -> Float[AnyArray, "h w c"]:
        """The means over the samples of each pixel."""
        return self.tiling.assemble(self._in_tiles(values).mean(1))

    def in_rows(self, values: Float[AnyArray, "chunks n c"]) -> Float[AnyArray, "rows columns c"]:
        """The picture's samples where they lie, row by row: each pixel is a square of them."""
        side = math.isqrt(self.tiling.samples)
        pixels = self.tiling.assemble(self._in_tiles(values).swapaxes(1, 2))
        h, w, _, c = pixels.shape
        return pixels.reshape(h, w, side, side, c).swapaxes(1, 2).reshape(h * side, w * side, c)

    def _in_tiles(self, values: Float[AnyArray, "chunks n c"]) -> Float[AnyArray, "tiles samples n c"]:
        count, samples = self.tiling.count, self.tiling.samples
        return values[: count * samples].reshape(count, samples, *values.shape[1:])

    def of_resampled(self, values: Float[AnyArray, "chunks n c"]) -> Float[AnyArray, "pixels samples c"]:
        """The samples of the pixels that are sampled once more."""
        assert self.resampled is not None
        pixels, samples = self.resampled.shape[0], self.resampled_side**2
        rest = values[self.tiling.count * self.tiling.samples :].reshape(-1, values.shape[-1])
        return rest[: pixels * samples].reshape(pixels, samples, -1)
