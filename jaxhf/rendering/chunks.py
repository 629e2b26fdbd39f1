"""Many rays as chunks of one size, each of which is traced until its last ray has ended."""

import math
from collections.abc import Callable
from typing import Any

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
    n = jax.tree.leaves(rays)[0].shape[0]
    count = math.ceil(n / chunk)

    def chunked(leaf: jax.Array) -> jax.Array:
        tail = leaf.shape[1:]
        return jnp.pad(leaf, ((0, count * chunk - n), *((0, 0) for _ in tail))).reshape(count, chunk, *tail)

    results = lax.map(recomputed(jax.vmap(one)), jax.tree.map(chunked, rays))
    return jax.tree.map(lambda leaf: leaf.reshape(count * chunk, *leaf.shape[2:])[:n], results)


def trace_batch(make: Callable[[Any], Any], one: Callable[[Any, Any], Any], shapes: Any, rays: Any, chunk: int) -> Any:
    """`one(make(shape), ray)` for a batch of shapes that differ in numbers only, each with rays of its own.

    Several shapes share a chunk where they have few rays each. Without a derivative the memory needed beyond arguments and
    results is that of one chunk and of what `make` makes of its shapes.

    Args:
      make: prepares a shape for tracing.
      one: a function of such a shape and one ray.
      shapes: a pytree of arrays whose leading axis counts the shapes.
      rays: one whose two leading axes count the shapes and the rays of each.
      chunk: about how many rays are traced together.
    """
    shape_count, n = jax.tree.leaves(rays)[0].shape[:2]
    together = min(shape_count, max(1, chunk // max(n, 1)))

    def some(given: Any) -> Any:
        shape, rays = given
        ready = make(shape)
        if n <= chunk:
            return jax.vmap(lambda ray: one(ready, ray))(rays)
        return trace_chunks(lambda ray: one(ready, ray), rays, math.ceil(n / math.ceil(n / chunk)))

    if shape_count == 1:
        return jax.tree.map(lambda leaf: leaf[None], some(jax.tree.map(lambda leaf: leaf[0], (shapes, rays))))
    count = math.ceil(shape_count / together)
    missing = count * together - shape_count

    def grouped(leaf: jax.Array) -> jax.Array:
        if missing:
            leaf = jnp.pad(leaf, ((0, missing), *((0, 0) for _ in leaf.shape[1:])), mode="edge")
        return leaf.reshape(count, together, *leaf.shape[1:])

    results = lax.map(recomputed(jax.vmap(some)), jax.tree.map(grouped, (shapes, rays)))
    return jax.tree.map(lambda leaf: leaf.reshape(count * together, *leaf.shape[2:])[:shape_count], results)
