"""What a value in a TOML scene may be: for each kind a function that returns it, or raises ValueError with what it must be."""

import math
import sys
from collections.abc import Callable
from datetime import datetime
from typing import Any

import numpy as np
from jaxtyping import Float

from ....core.affine import rotate, scale, translate
from ....core.types import MOST
from ...errors import nearest

_FARTHEST = 1e18  # of a position: squares of distances are numbers in single precision


Kind = Callable[[Any], Any]


def _kind(holds: Callable[[Any], bool], must_be: str) -> Kind:
    def kind(value: Any) -> Any:
        if not holds(value):
            raise ValueError(must_be)
        return value

    return kind


def _is_number(value: Any) -> bool:
    return type(value) is int or (isinstance(value, float) and math.isfinite(value))


def _is_whole(value: Any) -> bool:
    return type(value) is int  # exactly: True is an int


def _is_list(value: Any, count: int, of: Callable[[Any], bool]) -> bool:
    return isinstance(value, list) and len(value) == count and all(map(of, value))


def _in_range(value: Any, most: float = MOST) -> float:
    if not -most <= value <= most:
        raise ValueError(f"within -{most:g} and {most:g}")
    return float(value)


whole = _kind(_is_whole, "a whole number")
word = _kind(lambda value: isinstance(value, str), "a string")
flag = _kind(lambda value: isinstance(value, bool), "true or false")
instant = _kind(
    lambda value: isinstance(value, datetime) and value.tzinfo is not None,
    "a date and time with its offset from UTC, without quotes, such as 2026-06-21T12:00:00Z",
)
size = _kind(lambda value: _is_list(value, 2, _is_whole), "a list of 2 whole numbers, rows and columns")
table = _kind(lambda value: isinstance(value, dict), "a table")
tables = _kind(lambda value: isinstance(value, list) and all(isinstance(item, dict) for item in value), "a list of tables")


def table_of_tables(value: Any) -> dict[str, dict[str, Any]]:
    return {name: table(item) for name, item in table(value).items()}


def number(value: Any) -> float:
    if not _is_number(value):
        raise ValueError("a finite number")
    return _in_range(value)


positive = _kind(lambda value: number(value) > 0, "positive")
not_negative = _kind(lambda value: number(value) >= 0, "from 0 on")
angle_above_horizon = _kind(lambda value: -90 <= number(value) <= 90, "from -90 to 90 degrees")


def _or(other: type, kind: Kind, tail: str) -> Kind:
    """A value of the type `other`, or what `kind` takes; `tail` goes behind what that must be."""

    def either(value: Any) -> Any:
        try:
            return value if isinstance(value, other) else kind(value)
        except ValueError as error:
            raise ValueError(f"{error}{tail}") from None

    return either


number_or_word = _or(str, number, " or a string")
positive_or_table = _or(dict, positive, " or a table")


def numbers(count: int) -> Kind:
    def kind(value: Any) -> list[float]:
        if not _is_list(value, count, _is_number):
            raise ValueError(f"a list of {count} finite numbers")
        return [_in_range(item, _FARTHEST) for item in value]

    return kind


def factors(value: Any) -> list[float]:
    """Three numbers, or one that stands for all of them."""
    if _is_number(value):
        return [_in_range(value)] * 3
    if not _is_list(value, 3, _is_number):
        raise ValueError("a finite number or a list of 3")
    return [_in_range(item) for item in value]


def colour(value: Any) -> list[float]:
    found = factors(value)
    if min(found) < 0:
        raise ValueError("0 or more")
    return found


colour_or_texture = _or(str, colour, ", or the name of a texture")


def grid(value: Any) -> Float[np.ndarray, "ny nx"]:
    if not isinstance(value, list) or not value or not all(isinstance(row, list) and row for row in value):
        raise ValueError("a list of rows of numbers, the southernmost first")
    if len({len(row) for row in value}) > 1:
        raise ValueError(f"a list of rows of one length, theirs are {sorted({len(row) for row in value})}")
    for iy, row in enumerate(value):
        for ix, height in enumerate(row):
            if not _is_number(height):
                raise ValueError(f"made of finite numbers, row {iy} column {ix} is {height!r}")
            _in_range(height, sys.float_info.max)
    return np.array(value, np.float64)


def steps(value: Any) -> Float[np.ndarray, "4 4"]:
    """The product of a list of transforms: as in pbrt, the last of them acts first on a point."""
    if not isinstance(value, list) or not value:
        raise ValueError("a list such as [{translate = [0, 0, 1]}, {rotate = [90, 0, 0, 1]}, {scale = 2}]")
    product = np.eye(4)
    for k, step in enumerate(value):
        if not isinstance(step, dict) or len(step) != 1:
            raise ValueError(f"a list of tables with one key each, step {k} is {step!r}")
        ((verb, amount),) = step.items()
        if verb not in STEPS:
            raise ValueError(f"made of {', '.join(STEPS)}, step {k} is {verb!r}; {nearest(verb, STEPS)}")
        kind, function = STEPS[verb]
        try:
            product = product @ function(*kind(amount))
        except ValueError as error:
            raise ValueError(f"valid in step {k}: {verb} must be {error}, it is {amount!r}") from error
    return product


STEPS: dict[str, tuple[Kind, Callable[..., np.ndarray]]] = {
    "translate": (numbers(3), translate),
    "rotate": (numbers(4), rotate),
    "scale": (factors, scale),
}


def matrix(value: Any) -> Float[np.ndarray, "4 4"]:
    if not isinstance(value, list) or len(value) != 4:
        raise ValueError("a list of 4 rows of 4 numbers")
    return np.array([numbers(4)(row) for row in value])
