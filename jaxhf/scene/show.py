"""How the parts of a scene print: by their numbers, short, also while they are traced."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import numpy as np


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


def fields(module: Any) -> str:
    """The `repr` of a module whose fields are all numbers: "Sky(radiance=(0.4, 0.4, 0.4))"."""
    values = (f"{field.name}={numbers(getattr(module, field.name))}" for field in dataclasses.fields(module))
    return f"{type(module).__name__}({', '.join(values)})"
