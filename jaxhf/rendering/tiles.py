"""How a picture is cut into tiles."""

import math
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Int

from ..core.settings import Settings
from ..scene.camera import Camera


class Tiling:
    """How a picture is cut into squares of one fixed size: a fixed shape gives the same bits wherever a pixel lies."""

    def __init__(self, camera: Camera, settings: Settings):
        self.width, self.height = camera.width, camera.height
        self.side = 1 << ((settings.chunk.bit_length() - 1) // 2)
        self.columns, self.rows = math.ceil(self.width / self.side), math.ceil(self.height / self.side)

    @property
    def count(self) -> int:
        return self.columns * self.rows

    def pixels(self, tile: Int[jax.Array, ""]) -> tuple[Int[jax.Array, " n"], Int[jax.Array, " n"]]:
        """Column and row of each pixel of a tile, also of those beyond the picture."""
        pixel = jnp.arange(self.side * self.side, dtype=jnp.int32)
        column, row = (tile % self.columns) * self.side, (tile // self.columns) * self.side
        return column + pixel % self.side, row + pixel // self.side

    def assemble(self, tiles: Any) -> Any:
        """(count, side * side, ...) to (height, width, ...), for NumPy and JAX arrays."""
        tail = tiles.shape[2:]
        grid = tiles.reshape(self.rows, self.columns, self.side, self.side, *tail).swapaxes(1, 2)
        return grid.reshape(self.rows * self.side, self.columns * self.side, *tail)[: self.height, : self.width]
