"""Compiled programs in a folder, from where a later process takes them without tracing them again."""

import hashlib
import inspect
import os
import pickle
import time
import warnings
import zlib
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax

from .plain import insides

LOADED = "/jaxhf/program_loaded"
"""JAX's monitoring is told under this name how long it took to load a program, in seconds."""

_folder: Path | None = None  # for the whole process, as JAX's own cache is


def keep_in(folder: Path | None) -> None:
    """From now on programs are kept in this folder, which exists; None: no longer."""
    global _folder
    _folder = folder


class Kept:
    """A function whose compiled programs are kept, one for each form of its arguments.

    JAX's own cache finds a program by what tracing gives, and a picture is traced for longer than it takes to render. These are
    found by all that tracing depends on: the package's source, JAX's configuration, and the arguments' structure, shapes and
    types. That holds of a module's function, not of one within another.
    """

    def __init__(self, fun: Callable[..., Any], jit: Callable[..., Any], static: Collection[str]):
        """
        Args:
          fun: a module's function, without positional-only or variable arguments.
          jit: compiles a function of arrays.
          static: names of the arguments that are not arrays, whose `repr` says all about them.
        """
        self.fun, self.jit, self.static, self.signature = fun, jit, static, inspect.signature(fun)
        self.ready: dict[Any, tuple[Callable[..., Any], Any]] = {}

    @staticmethod
    def serves(fun: Callable[..., Any]) -> bool:
        """Whether programs are kept at present, and those of this function can be: tried on CPUs only."""
        return _folder is not None and "<" not in getattr(fun, "__qualname__", "<") and jax.default_backend() == "cpu"

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        given = self.signature.bind(*args, **kwargs).arguments
        static = {name: given.pop(name) for name in self.static if name in given}
        leaves, tree = jax.tree.flatten(given)
        placed = (leaf.sharding if isinstance(leaf, jax.Array) and leaf.committed else None for leaf in leaves)
        form = tuple(static.items()), tree, tuple(map(jax.typeof, leaves)), tuple(placed)
        if form not in self.ready:
            self.ready[form] = self._program(form, leaves)
        program, out = self.ready[form]
        return jax.tree.unflatten(out, program(*leaves))

    def _program(self, form: Any, leaves: list[Any]) -> tuple[Callable[..., Any], Any]:
        """From the folder, or compiled and put there; with the structure of what it returns."""
        module = insides()
        assert _folder is not None
        assert module is not None
        name = f"{self.fun.__module__}.{self.fun.__qualname__}"
        known = repr((name, form, sorted(jax.config.values.items()), os.environ.get("XLA_FLAGS"), jax.devices()))
        path = _folder / f"{name}-{hashlib.sha256(known.encode() + _source()).hexdigest()[:32]}"
        begin = time.perf_counter()
        try:
            stored, in_tree, out_tree, out, ids = pickle.loads(zlib.decompress(path.read_bytes()))  # with a checksum of zlib's
            devices = {device.id: device for device in jax.devices()}
            program = module.deserialize_and_load(stored, in_tree, out_tree, execution_devices=[devices[k] for k in ids])
            path.touch()  # the folder's owner may remove what was used longest ago
            jax.monitoring.record_event_duration_secs(LOADED, time.perf_counter() - begin)
            return program, jax.tree.structure(out)
        except FileNotFoundError:
            pass
        except Exception as error:  # whatever a damaged file leads to
            self._warn("reading", error)
        static, tree, *_ = form
        trees = []

        def flat(*leaves: Any) -> list[Any]:
            returned, out = jax.tree.flatten(self.fun(**dict(static), **jax.tree.unflatten(tree, leaves)))
            trees.append(out)
            return returned

        flat.__name__ = self.fun.__name__
        with _without_jax_cache(module.compilation_cache.reset_cache):
            program = self.jit(flat).lower(*leaves).compile()
        out = jax.tree.unflatten(trees[0], range(trees[0].num_leaves))  # a structure with modules in it cannot be pickled
        part = path.with_suffix(f".{os.getpid()}")
        try:
            ids = [device.id for device in program.runtime_executable().local_devices()]
            part.write_bytes(zlib.compress(pickle.dumps((*module.serialize(program), out, ids))))
            part.replace(path)
        except Exception as error:  # no space, or a backend whose programs cannot be stored
            part.unlink(missing_ok=True)
            self._warn("writing", error)
        return program, trees[0]

    def _warn(self, doing: str, error: Exception) -> None:
        """In JAX's words for its own cache."""
        said = (
            f"Error {doing} persistent compilation cache entry for '{self.fun.__qualname__}': {type(error).__name__}: {error}"
        )
        warnings.warn(said, stacklevel=3)


@contextmanager
def _without_jax_cache(reset: Callable[[], None]) -> Iterator[None]:
    """A program out of JAX's cache could not be stored again: XLA leaves its kernels out, without an error."""
    before = jax.config.values["jax_enable_compilation_cache"]
    jax.config.update("jax_enable_compilation_cache", False)
    reset()
    try:
        yield
    finally:
        jax.config.update("jax_enable_compilation_cache", before)
        reset()


@cache
def _source() -> bytes:
    """A hash of all that traces: this package, and the one that its modules are made of."""
    package = Path(__file__).parents[1]
    said = hashlib.sha256(version("equinox").encode())
    for path in sorted(package.rglob("*.py")):
        said.update(f"{path.relative_to(package)}".encode() + path.read_bytes())
    return said.digest()
