"""A picture in tiles: how it is cut, and what is traced for each of them."""

import math
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jax.sharding import Mesh
from jaxtyping import Int

from ..core.devices import map_over
from ..core.materialise import materialise
from ..core.sampling import sample_offset
from ..core.settings import Settings
from ..scene.camera import Camera
from ..shade.radiance import radiance
from ..trace.world import World
from .aovs import observe


class Tiling:
    """The cut of a picture into squares of one size: a fixed shape gives the same bits wherever a pixel lies."""

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


def trace_tiles(
    mesh: Mesh, world: World, camera: Camera, aovs: tuple[str, ...], tiles: Int[jax.Array, " n"]
) -> dict[str, jax.Array]:
    """The picture ("image") and AOVs of tiles, traced one after the other; (n, side * side, ...) each."""
    return map_over(mesh, lambda seen, tile: _trace_tile(seen[0], seen[1], aovs, tile), (world, camera), tiles)


def _trace_tile(world: World, camera: Camera, aovs: tuple[str, ...], tile: jax.Array) -> dict[str, jax.Array]:
    dtype = camera.world_from_camera.dtype

    def one(x: jax.Array, y: jax.Array) -> dict[str, jax.Array]:
        image, exhausted = _pixel(world, camera, x, y)
        outputs = {"image": image}
        if aovs:
            outputs |= observe(world, camera.ray(x + 0.5, y + 0.5), aovs)
        if "exhausted" in aovs:
            outputs["exhausted"] = exhausted
        return outputs

    columns, rows = Tiling(camera, world.settings).pixels(tile)
    return jax.vmap(one)(columns.astype(dtype), rows.astype(dtype))


def _pixel(world: World, camera: Camera, x: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The mean over the samples of the pixel whose top left corner is (x, y), and how many walks ran out of steps."""
    assert world.settings.samples is not None
    side = math.isqrt(world.settings.samples)

    def sample(k, sums):
        dx, dy = sample_offset(k, side, x.dtype)
        light, exhausted = radiance(world, materialise(camera.ray(x + dx, y + dy)))
        return sums[0] + light, sums[1] + exhausted

    sums = (jnp.zeros(3, x.dtype), jnp.zeros((), jnp.int32))
    if side == 1:
        return sample(jnp.zeros((), jnp.int32), sums)
    total, exhausted = lax.fori_loop(0, side * side, sample, sums)
    return total / (side * side), exhausted
