"""What the parts of a scene have in common: their fields keep rules, and they print by their numbers, also while traced."""

import dataclasses
from typing import Any, TypeVar

import equinox as eqx
import jax
import numpy as np

from ..core.rules import require_fields

Module = TypeVar("Module", bound=eqx.Module)


class Record(eqx.Module):
    """A part of a scene. What is not traced in its fields keeps the rules that their metadata hold, see `Rule`."""

    def __check_init__(self):
        require_fields(self)
        self._require_consistent()

    def _require_consistent(self):
        """ArgumentError where fields that keep their rules do not go with each other."""

    def __repr__(self) -> str:
        """The fields by their numbers, but for static ones that have their defaults: "Sky(radiance=(0.4, 0.4, 0.4))"."""
        values = (
            f"{field.name}={numbers(getattr(self, field.name))}"
            for field in dataclasses.fields(self)
            if not (field.metadata.get("static") and getattr(self, field.name) == field.default)
        )
        return f"{type(self).__name__}({', '.join(values)})"


def changed(module: Module, **fields: Any) -> Module:
    """As `dataclasses.replace`, but the module's rules are not asked again, and leaves may be of any kind:
    `jax.ShapeDtypeStruct`s, where a program is only compiled. `equinox.tree_at` would copy the whole tree."""
    new = object.__new__(type(module))
    for name, value in (vars(module) | fields).items():
        object.__setattr__(new, name, value)
    return new


def known(leaf: Any) -> np.ndarray | None:
    """The values of an array leaf on the host; None where it is traced, deleted, on another process or no array at all."""
    if not isinstance(leaf, np.ndarray | jax.Array):
        return None
    try:
        return np.asarray(leaf)
    except (TypeError, RuntimeError):
        return None


def numbers(leaf: Any) -> str:
    """A number as "0.0159", a vector as "(0, 1.5, 4500000.25)"; anything else by its type and shape, as "f32[8,3]"."""
    values = known(leaf)
    if values is None or values.ndim > 1:
        return eqx.tree_pformat(leaf)
    return f"({', '.join(map(number, values))})" if values.ndim else number(values)


def number(value: Any) -> str:
    """A float by its first three digits after the point, or by its first three where it is below 1: "4500000.25", "0.0159"."""
    value = float(value) + 0.0  # -0 becomes 0
    return f"{value:.3f}".rstrip("0").rstrip(".") if 1 <= abs(value) < 1e15 else f"{value:.3g}"


def span(values: np.ndarray) -> str:
    """The lowest and the highest of an array's finite values: "-1.5 .. 27.25"."""
    finite = values[np.isfinite(values)]
    lowest, highest = (finite.min(), finite.max()) if finite.size else (np.nan, np.nan)
    return f"{number(lowest)} .. {number(highest)}"
