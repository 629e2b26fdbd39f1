"""What a value must be, said once: in the metadata of a class's field, {"rule": Whole(1)}, or where a function is given it."""

import dataclasses
import math
import sys
from collections.abc import Callable
from typing import Any, NamedTuple, get_args

from .errors import ArgumentError, whole_number

Rule = Callable[[Any], str | None]
"""What is wrong with a value, as an error says it behind the argument's name, "must be positive, it is 0"; None: nothing is."""


class Whole(NamedTuple):
    """A whole number from `least` on and at most `most`; `unit` is what it counts."""

    least: int
    most: float = math.inf
    unit: str = ""

    def __call__(self, value: Any) -> str | None:
        if isinstance(value, getattr(sys.modules.get("jax.core"), "Tracer", ())):  # --help does without JAX
            return "must be known when programs are compiled, it is traced by JAX"
        if type(whole_number(value)) is not int or value < self.least:
            return f"must be a whole number {self.unit and f'of {self.unit} '}from {self.least} on, it is {value!r}"
        return f"must be at most {self.most}, it is {value}" if value > self.most else None


class OneOf(NamedTuple):
    """One of these names, or of those of a `Literal`."""

    names: Any

    def __call__(self, value: Any) -> str | None:
        names = get_args(self.names) or self.names
        return None if value in names else f"must be one of {', '.join(names)}; it is {value!r}"


def finite(value: float) -> str | None:
    return None if math.isfinite(value) else f"must be finite, it is {value}"


def positive(value: float) -> str | None:
    return None if 0 < value <= sys.float_info.max else f"must be positive and finite, it is {value}"


def flag(value: Any) -> str | None:
    return None if isinstance(value, bool) else f"must be True or False, it is {value!r}"


def require(owner: str, argument: str, value: Any, rule: Rule) -> None:
    """ArgumentError where a value breaks a rule; of the `owner` whose `argument` it is."""
    wrong = rule(value)
    if wrong is not None:
        raise ArgumentError(owner, argument, wrong)


def require_fields(record: Any) -> None:
    """ArgumentError where a field breaks the rule in its metadata.

    A field whose default is None may be None. One that holds a dataclass has been checked there.
    """
    for field in dataclasses.fields(record):
        rule, value = field.metadata.get("rule"), getattr(record, field.name)
        absent = value is None and field.default is None
        if rule is not None and not absent and not dataclasses.is_dataclass(value):
            require(type(record).__name__, field.name, value, rule)
