"""Rays of the caller's own as chunks of one size, each of which is traced until its last ray has ended; a picture has tiles."""

import math
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax

from ..core.autodiff import recomputed


def trace_chunks(one: Callable[[Any], Any], rays: Any, chunk: int) -> Any:
    """`one(ray)` for every ray, chunk after chunk of one fixed size, so that a ray's result has the same bits in any batch.

    Args:
      one: a function of one ray.
      rays: a pytree of arrays whose leading axis counts the rays.
      chunk: how many rays are traced together; the last ones are made up by zeros.
    """
    return _map_groups(jax.vmap(one), rays, chunk, "constant")


def _map_groups(fun: Callable[[Any], Any], items: Any, size: int, padding: Any) -> Any:
    """`fun(items)` for groups of one size, one after the other; the last one is filled up by this mode of `jnp.pad`."""
    n = jax.tree.leaves(items)[0].shape[0]
    count, missing = math.ceil(n / size), -n % size

    def grouped(leaf: jax.Array) -> jax.Array:
        if missing:
            leaf = jnp.pad(leaf, ((0, missing), *((0, 0) for _ in leaf.shape[1:])), padding)
        return leaf.reshape(count, size, *leaf.shape[1:])

    results = lax.map(recomputed(fun), jax.tree.map(grouped, items))
    return jax.tree.map(lambda leaf: leaf.reshape(count * size, *leaf.shape[2:])[:n], results)


# Heights, or numbers of what was made of them, in shapes that share a chunk. Bounds of heights are up to 16 times as many, and
# `_together` may take half as many shapes again: all places stay below 2^31.
_MOST_TOGETHER = 2**26


def trace_batch(
    make: Callable[[Any], Any],
    join: Callable[[Any], tuple[Any, Any]],
    one: Callable[[Any, Any], Any],
    shapes: Any,
    rays: Any,
    chunk: int,
) -> Any:
    """`one(make(shape), ray)` for a batch of shapes that differ in numbers only, each with rays of its own.

    Several shapes share a chunk where they have few rays each, and their rays are one batch. Without a derivative the memory
    needed beyond arguments and results is that of one chunk and of what `make` makes of its shapes.

    Args:
      make: prepares a shape for tracing.
      join: takes what `make` makes of several shapes, with a leading axis; returns what they have in common, and the rest of
        each, with the leading axis. The two are `equinox.combine`d to what `one` takes, as `joined` grids are.
      one: a function of such a shape and one ray.
      shapes: a pytree of arrays whose leading axis counts the shapes.
      rays: one whose two leading axes count the shapes and the rays of each.
      chunk: about how many rays are traced together.
    """
    shape_count, n = jax.tree.leaves(rays)[0].shape[:2]
    largest = max(leaf.size for leaf in jax.tree.leaves(shapes)) // shape_count
    together = _together(shape_count, max(1, min(chunk // max(n, 1), _MOST_TOGETHER // largest)))

    def of_one(given: Any) -> Any:
        ready, rays = make(given[0]), given[1]
        if n <= chunk:
            return jax.vmap(lambda ray: one(ready, ray))(rays)
        return trace_chunks(lambda ray: one(ready, ray), rays, math.ceil(n / math.ceil(n / chunk)))

    def of_several(given: Any) -> Any:
        shared, own = join(jax.vmap(make)(given[0]))
        each = jax.tree.map(lambda leaf: jnp.repeat(leaf, n, axis=0), own)
        rays = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), given[1])
        results = jax.vmap(lambda own, ray: one(eqx.combine(shared, own), ray))(each, rays)
        return jax.tree.map(lambda leaf: leaf.reshape(together, n, *leaf.shape[1:]), results)

    if shape_count == 1:
        return jax.tree.map(lambda leaf: leaf[None], of_one(jax.tree.map(lambda leaf: leaf[0], (shapes, rays))))
    if together == 1:
        return lax.map(recomputed(of_one), (shapes, rays))
    return _map_groups(of_several, (shapes, rays), together, "edge")


def _together(count: int, wanted: int) -> int:
    """About as many as wanted: a divisor of the count where one is near, else all are copied to make up the last ones."""
    wanted = min(count, wanted)
    near = [k for k in range(-(-2 * wanted // 3), 3 * wanted // 2 + 1) if count % k == 0]
    return min(near, key=lambda k: abs(k - wanted), default=wanted)
