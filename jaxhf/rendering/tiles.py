"""A picture in tiles: how it is cut, and what is traced for each of them."""

import functools
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.sharding import Mesh
from jaxtyping import Float, Int

from ..core.autodiff import recomputed
from ..core.settings import Settings
from ..core.types import AnyArray, Index, Scalar, Vector
from ..preparation.world import World, first_hit
from ..scene.camera import Camera
from ..shade.radiance import radiance, radiance_and_hit
from ..xla.devices import map_first, map_over
from ..xla.kernel import one_kernel
from ..xla.materialise import materialise
from .aovs import observe


class Tiling:
    """The cut of a picture into squares of one size: a fixed shape gives the same bits wherever a pixel lies."""

    def __init__(self, width: int, height: int, settings: Settings):
        self.width, self.height = width, height
        self.samples = settings.samples or 1
        self.side = tile_side(settings)
        self.columns, self.rows = math.ceil(self.width / self.side), math.ceil(self.height / self.side)

    @property
    def count(self) -> int:
        return self.columns * self.rows

    def corners(self) -> Int[np.ndarray, "count 2"]:
        """Column and row of the top left pixel of each tile."""
        rows, columns = np.divmod(np.arange(self.count, dtype=np.int32), np.int32(self.columns))
        return np.stack([columns, rows], axis=1) * np.int32(self.side)

    def assemble(self, tiles: Any) -> Any:
        """(count, side * side, ...) to (height, width, ...), for NumPy and JAX arrays."""
        tail = tiles.shape[2:]
        grid = tiles.reshape(self.rows, self.columns, self.side, self.side, *tail).swapaxes(1, 2)
        return grid.reshape(self.rows * self.side, self.columns * self.side, *tail)[: self.height, : self.width]

    def place(self, tiles: np.ndarray, numbers: Int[np.ndarray, " n"], into: np.ndarray) -> None:
        """Writes tiles, (n, side * side, ...), of these numbers where they belong in a picture of whole tiles."""
        grid = into.reshape(self.rows, self.side, self.columns, self.side, *into.shape[2:])
        rows, columns = np.divmod(numbers, self.columns)
        grid[rows, :, columns] = tiles.reshape(len(tiles), self.side, self.side, *tiles.shape[2:])


def tile_side(settings: Settings) -> int:
    """Of the squares into which pictures are cut, pixels."""
    return 1 << ((settings.chunk.bit_length() - 1) // 2)


def pixels_from(corner: Int[jax.Array, "2"], side: int) -> tuple[Int[jax.Array, " n"], Int[jax.Array, " n"]]:
    """Column and row of each pixel of the tile with this top left pixel, also of those beyond the picture."""
    pixel = jnp.arange(side * side, dtype=jnp.int32)
    return corner[0] + pixel % side, corner[1] + pixel // side


def trace_tiles(
    mesh: Mesh,
    world: World,
    camera: Camera,
    aovs: tuple[str, ...],
    corners: Int[jax.Array | np.ndarray, "n 2"],
    count: Index | None = None,
) -> dict[str, jax.Array]:
    """The picture ("image") and AOVs of tiles with these top left pixels, traced one after the other; (n, side², ...) each.

    With a `count` of so many of the first alone, dealt out as by `map_first`.
    """
    of_tile = functools.partial(_trace_tile, aovs)

    def traced(seen: tuple[World, Camera], corner: jax.Array) -> dict[str, jax.Array]:
        return one_kernel(of_tile, *seen, corner)

    if count is None:
        return map_over(mesh, traced, (world, camera), corners)
    return map_first(mesh, traced, (world, camera), corners, count)


def sample_offset(k: Int[AnyArray, "*n"], side: int, dtype: Any) -> tuple[Float[AnyArray, "*n"], Float[AnyArray, "*n"]]:
    """The k-th sample's position in its pixel, 0..1 each way: the centres of a regular grid.

    With the box filter of a pixel's width, the pixel is the mean of its samples.
    """
    return ((k % side).astype(dtype) + 0.5) / side, ((k // side).astype(dtype) + np.asarray(0.5, dtype)) / side


@recomputed
def light_along(
    world: World, camera: Camera, x: Float[jax.Array, " n"], y: Float[jax.Array, " n"]
) -> tuple[Float[jax.Array, "n 3"], Int[jax.Array, " n"]]:
    """The radiance of samples at these positions in the picture, and how many of each one's walks ran out of steps."""
    return jax.vmap(lambda x, y: radiance(world, materialise(camera.ray(x, y))))(x, y)


def _seen_along(
    aovs: tuple[str, ...], world: World, camera: Camera, x: Float[jax.Array, " n"], y: Float[jax.Array, " n"]
) -> tuple[Float[jax.Array, "n 3"], Int[jax.Array, " n"], dict[str, jax.Array]]:
    """As `light_along`, and the AOVs of the same rays."""

    def seen(x: Scalar, y: Scalar) -> tuple[Vector, Index, dict[str, jax.Array]]:
        ray = materialise(camera.ray(x, y))
        light, exhausted, hit = radiance_and_hit(world, ray, count_steps="steps" in aovs)
        return light, exhausted, observe(world, ray, hit, aovs)

    return recomputed(jax.vmap(seen))(x, y)


def _trace_tile(aovs: tuple[str, ...], world: World, camera: Camera, corner: jax.Array) -> dict[str, jax.Array]:
    dtype = camera.world_from_camera.dtype
    columns, rows = (place.astype(dtype) for place in pixels_from(corner, tile_side(world.settings)))
    at_centres = columns + 0.5, rows + 0.5
    observed = tuple(name for name in aovs if name != "exhausted")
    if observed and (world.settings.samples or 1) == 1:  # the sample's ray is the observed one
        image, exhausted, outputs = _seen_along(observed, world, camera, *at_centres)
    else:
        image, exhausted = _pixels(world, camera, columns, rows)
        alone = functools.partial(_observed_along, observed, world, camera)
        outputs = jax.vmap(alone)(*at_centres) if observed else {}
    if "exhausted" in aovs:
        outputs["exhausted"] = exhausted
    return outputs | {"image": image}


def _observed_along(aovs: tuple[str, ...], world: World, camera: Camera, x: Scalar, y: Scalar) -> dict[str, jax.Array]:
    ray = camera.ray(x, y)
    return observe(world, ray, first_hit(world, ray, count_steps="steps" in aovs), aovs)


def _pixels(
    world: World, camera: Camera, x: Float[jax.Array, " n"], y: Float[jax.Array, " n"]
) -> tuple[Float[jax.Array, "n 3"], Int[jax.Array, " n"]]:
    """The means over the samples of the pixels whose top left corners are (x, y), and how many walks ran out of steps."""
    side = math.isqrt(world.settings.samples or 1)

    def sample(k: Int[jax.Array, ""]) -> tuple[Float[jax.Array, "n 3"], Int[jax.Array, " n"]]:
        dx, dy = sample_offset(k, side, x.dtype)
        return light_along(world, camera, x + dx, y + dy)

    if side == 1:
        return sample(jnp.zeros((), jnp.int32))
    # The loop is round `vmap`, not within: else its body would be traced once for one ray and once more for the batch.
    sums = (jnp.zeros((x.shape[0], 3), x.dtype), jnp.zeros(x.shape, jnp.int32))
    total, exhausted = lax.fori_loop(0, side * side, lambda k, sums: jax.tree.map(jnp.add, sums, sample(k)), sums)
    return total / (side * side), exhausted
