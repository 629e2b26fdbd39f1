"""Items dealt with part after part, by programs to which it is data how many a part has; results go to the host."""

from collections.abc import Callable, Iterator
from typing import Any

import jax
import numpy as np

from .devices import on_host


def in_parts(call: Callable[[Any, np.int32], Any], items: Any, size: int, most: int) -> Iterator[tuple[int, int, Any]]:
    """(first, end, results) of so many items after the others; while one part is taken the next is being computed.

    Args:
      call: what to do with `most` items, of which so many count.
      items: a pytree of NumPy's arrays, whose leading axis counts the items.
      size: of a part, at most `most`.
      most: for how many items the program is.
    """
    count, begun = len(jax.tree.leaves(items)[0]), []

    def filled(values: np.ndarray) -> np.ndarray:
        return np.concatenate([values, np.zeros((most - len(values), *values.shape[1:]), values.dtype)])

    for first in range(0, count, size):
        end = min(first + size, count)
        part = jax.tree.map(lambda values, first=first, end=end: filled(values[first:end]), items)
        begun.append((first, end, call(part, np.int32(end - first))))
        if len(begun) > 1:
            yield begun.pop(0)
    yield from begun


def by_item(results: Any, first: int, end: int, devices: int) -> Iterator[tuple[slice, Any]]:
    """What each device has of the results of the items from `first` to `end`, as `map_first` leaves them: which items, and
    their results, of NumPy."""
    leaves, structure = jax.tree.flatten(results)
    for device, parts in enumerate(zip(*(_by_device(leaf, devices) for leaf in leaves), strict=True)):
        items = slice(first + device, end, devices)
        count = len(range(first + device, end, devices))
        yield items, jax.tree.unflatten(structure, [part[:count] for part in parts])


def _by_device(leaf: jax.Array, devices: int) -> list[np.ndarray]:
    """What each of so many devices has of an array whose first axis is divided among them; where CPU devices of one process
    hold it, without a copy."""
    if devices == 1 or not leaf.is_fully_addressable:
        return np.split(on_host(leaf), devices)
    shards = sorted(leaf.addressable_shards, key=lambda shard: shard.index[0].start)
    return [np.asarray(shard.data) for shard in shards]
