"""A function linearised in some of its arguments, in parts that different calls compute."""

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import jax


def chosen(which: Iterable[bool], values: Iterable[Any]) -> list[Any]:
    return [value for take, value in zip(which, values, strict=True) if take]


def merged(which: Iterable[bool], own: Iterable[Any], others: Iterable[Any]) -> list[Any]:
    """Where chosen, the next of `own`, elsewhere the one of `others` in that place."""
    following = iter(own)
    return [next(following) if take else other for take, other in zip(which, others, strict=True)]


def linearised(
    fun: Callable[..., Any], moving: Sequence[bool], leaves: Sequence[Any]
) -> tuple[list[Any], Any, list[Any], list[int | None]]:
    """Of `fun(*leaves)` in those leaves that move.

    Returns:
      Its values; the linear function; what that stores and is no argument as it is; and of all that it stores the place among
      the arguments, None for its own.
    """
    values, linear = jax.linearize(lambda *own: jax.tree.leaves(fun(*merged(moving, own, leaves))), *chosen(moving, leaves))
    stored = jax.tree.leaves(linear)
    places = [next((k for k, leaf in enumerate(leaves) if leaf is value), None) for value in stored]
    return values, linear, [value for value, place in zip(stored, places, strict=True) if place is None], places


def all_stored(own: Iterable[Any], places: Iterable[int | None], leaves: Sequence[Any]) -> list[Any]:
    """What `linearised` took apart."""
    following = iter(own)
    return [next(following) if place is None else leaves[place] for place in places]
