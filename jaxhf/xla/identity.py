"""What a kept program is found by: all that its tracing depends on, as far as `repr` says all about it."""

import hashlib
import sys
import time
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from types import FunctionType, MethodType
from typing import Any

import jax
from jax.sharding import Mesh, NamedSharding

_PACKAGE, _IMPORTED = Path(__file__).parents[1], time.time()
_OURS = {"jaxhf", "jax", "jaxlib", "equinox", "optimistix", "lineax", "jaxtyping", "numpy", "collections", "builtins"}


def named(value: Any) -> Any:
    """A module's function by its name, else the value."""
    if not isinstance(value, FunctionType) or not _is_code_of_ours(value.__module__):
        return value
    is_there = getattr(sys.modules.get(value.__module__), value.__qualname__, None) is value  # and nobody has replaced it
    return f"{value.__module__}.{value.__qualname__}" if is_there else value


def devices(at: Any) -> Any:
    """A place with the numbers of its devices in their order, which its `repr` does not name."""
    there = at.mesh.devices.flat if isinstance(at, NamedSharding) else at.device_set if at else ()  # pyright: ignore
    return at, [device.id for device in there]


def classes(tree: Any) -> list[str]:
    """The classes of a structure with their modules, which its `repr` does not name."""
    node = tree.node_data()
    own = [] if node is None else [f"{node[0].__module__}.{node[0].__qualname__}"]
    return own + [name for child in tree.children() for name in classes(child)]


def says_all(given: Any) -> bool:
    """Whether the `repr` of these static values and structures says all about them, in any process.

    Not where a class is of somebody else's code, which may change; where a `Mesh` has other devices than the first ones,
    which it does not name; or where something is named by its address, or an array is too long to be written out.
    """
    said = repr(given)
    return " at 0x" not in said and "..." not in said and _is_ours(given)


def _is_ours(value: Any) -> bool:
    if isinstance(value, MethodType):
        return False
    if isinstance(value, Mesh):
        return list(value.devices.ravel()) == jax.devices()[: value.devices.size]
    if isinstance(value, jax.tree_util.PyTreeDef):
        node = value.node_data()
        return node is None or (_is_ours(node) and all(map(_is_ours, value.children())))
    if isinstance(value, dict):
        return all(map(_is_ours, value.values()))
    if isinstance(value, tuple | list | frozenset):
        return _is_code_of_ours(type(value).__module__) and all(map(_is_ours, value))
    return _is_code_of_ours((value if isinstance(value, type) else type(value)).__module__)


def _is_code_of_ours(module: str) -> bool:
    return module.partition(".")[0] in _OURS


def source() -> bytes | None:
    """A hash of all that traces: this package, and those that its modules and steps are made of; None where nothing tells, or
    where files have changed since they were imported."""
    try:
        files = sorted(_PACKAGE.rglob("*.py"))
        is_as_imported = files and max(path.stat().st_mtime for path in files) < _IMPORTED
        return _hashed(tuple(files)) if is_as_imported else None
    except (OSError, PackageNotFoundError):
        return None


@cache
def _hashed(files: tuple[Path, ...]) -> bytes:
    said = hashlib.sha256(repr([version(name) for name in ("equinox", "optimistix", "lineax")]).encode())
    for path in files:
        said.update(f"{path.relative_to(_PACKAGE)}".encode() + path.read_bytes())
    return said.digest()
