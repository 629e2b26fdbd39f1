"""Compiled programs in a folder, from where a later process takes them without tracing them again.

JAX's own cache finds a program by what tracing gives, and a picture is traced for longer than it takes to render. These are
found by all that tracing depends on: the package's source, JAX's configuration, and the arguments' structure, shapes and types.
"""

import hashlib
import inspect
import os
import pickle
import sys
import threading
import time
import warnings
import zlib
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from functools import cache, cached_property
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from types import FunctionType, MethodType, ModuleType
from typing import Any

import equinox as eqx
import jax
from jax.core import Tracer
from jax.sharding import Mesh, NamedSharding, SingleDeviceSharding

from . import folder
from .plain import insides

LOADED = "/jaxhf/program_loaded"
"""JAX's monitoring is told under this name how long it took to load a program, in seconds."""

_PACKAGE, _IMPORTED = Path(__file__).parents[1], time.time()
_LOCK = threading.RLock()
_PLACES = (NamedSharding, SingleDeviceSharding)
_OURS = {"jaxhf", "jax", "jaxlib", "equinox", "optimistix", "lineax", "jaxtyping", "numpy", "collections", "builtins"}


class Kept:
    """A function that is called by its compiled programs, one for each form of its arguments, which are kept in the folder.

    So is its derivative where `jax.grad`, `jax.vjp`, `jax.jvp` or `jax.linearize` are called as they are, not within a program
    of the caller's: see `program_calls`.
    """

    def __init__(
        self,
        fun: Callable[..., Any],
        options: dict[str, Any] | None,
        static: Collection[str] | None,
        donated: Collection[str] = (),
    ):
        """
        Args:
          fun: a module's function, without positional-only or variable arguments.
          options: of the compiler; derivatives do without, so that they have the bits that they have within a program.
          static: names of the arguments that are not arrays; None: whatever in the arguments is no array, as for
            `equinox.filter_jit`.
          donated: names of arguments whose arrays make room for the results.
        """
        self.fun, self.options, self.static, self.donated = fun, options, static, donated
        self.signature = inspect.signature(fun)
        self.ready: dict[Any, Program] = {}
        self.generation: object = None

    @staticmethod
    def serves(fun: Callable[..., Any]) -> bool:
        """Whether programs of this function can be had here: tried on CPUs, of one process, and where no flag asks JAX to do
        more than to run them. A function within another may hold values of it."""
        config = jax.config
        watched = config.jax_disable_jit or config.jax_debug_nans or config.jax_debug_infs  # pyright: ignore
        if watched or not inspect.isfunction(fun) or "<" in fun.__qualname__ or not jax.sharding.get_abstract_mesh().empty:
            return False
        return jax.default_backend() == "cpu" and jax.process_count() == 1

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        given = self.signature.bind(*args, **kwargs).arguments
        static = tuple((name, given.pop(name)) for name in self.static or () if name in given)
        leaves, tree = jax.tree.flatten(given)
        others = {}
        if self.static is None:
            others = {k: leaf for k, leaf in enumerate(leaves) if not eqx.is_array(leaf)}
            leaves = [leaf for k, leaf in enumerate(leaves) if k not in others]
        module = insides()
        assert module is not None
        if self.generation is not (generation := module.generation()):
            self.ready, self.generation = {}, generation
        kinds = tuple(type(value) for _, value in static), tuple(map(type, others.values()))  # 2 equals 2.0
        types = tuple(map(_type, leaves))
        form = static, tuple(others.items()), kinds, tree, types, module.configuration()
        program = self.ready.get(form)
        if program is None:
            program = self.ready.setdefault(form, self._program(static, others, tree, types))
        traced = any(isinstance(leaf, Tracer) for leaf in leaves)
        results = module.call_program(program, leaves) if traced else program(*leaves)
        structure, others = program.outcome
        return jax.tree.unflatten(structure, _among(others, results))

    def _program(self, static: Any, others: dict[int, Any], tree: Any, types: Any) -> "Program":
        def flat(*leaves: Any) -> tuple[list[Any], Any]:
            returned = self.fun(**dict(static), **jax.tree.unflatten(tree, _among(others, leaves)))
            results, structure = jax.tree.flatten(returned)
            no_arrays = {k: value for k, value in enumerate(results) if self.static is None and not eqx.is_array(value)}
            note = jax.tree.unflatten(structure, range(len(results))), no_arrays  # a structure with modules cannot be pickled
            return [value for k, value in enumerate(results) if k not in no_arrays], note

        name = f"{self.fun.__module__}.{self.fun.__qualname__}"
        said = {k: _named(value) for k, value in others.items()}
        places = jax.tree.unflatten(tree, _among(dict.fromkeys(others), range(len(types))))
        donated = tuple(jax.tree.leaves([places[name] for name in self.donated if name in places]))
        known = repr((name, static, said, tree, _classes(tree), types, self.options, donated))
        return Program(name, known if _says_all((static, said, tree)) else None, flat, self.options, donated)


def _type(leaf: Any) -> tuple[Any, ...]:
    """What a trace sees of an array; JAX's own type also has a mesh, which differs between the results of programs."""
    form = jax.typeof(leaf)
    return form.shape, form.dtype, form.weak_type


def _among(others: dict[int, Any], values: Any) -> list[Any]:
    """Values, with the others in their places."""
    own = iter(values)
    return [others[k] if k in others else next(own) for k in range(len(others) + len(values))]


class Program:
    """A function of arrays, and its compiled form for each place in which these lie.

    Attributes:
      name: of the function.
      known: all that its tracing depends on, but for the package's source and JAX's configuration; None: nothing says that.
      note: what the function returned besides its arrays, once it was traced or found in the folder.
      linear: the linear functions of its derivatives that have been traced, see `program_calls`.
    """

    def __init__(
        self,
        name: str,
        known: str | None,
        fun: Callable[..., tuple[list[Any], Any]],
        options: dict[str, Any] | None = None,
        donated: tuple[int, ...] = (),
    ):
        """
        Args:
          fun: returns arrays, and a note of what they are that is the same whenever it is traced.
          options: of the compiler.
          donated: which arguments make room for the results.
        """
        self.name, self.known, self.fun, self.options, self.donated = name, known, fun, options, donated
        self.note: Any = None
        self.placed: dict[Any, Callable[..., list[Any]]] = {}
        self.made_of_it: dict[str, Program] = {}
        self.linear: dict[Any, Any] = {}

    @cached_property
    def outcome(self) -> tuple[Any, dict[int, Any]]:
        """The structure of what a `Kept` function returns, and what in that is no array."""
        return jax.tree.structure(self.note[0]), self.note[1]

    def __call__(self, *leaves: Any) -> list[Any]:
        place = tuple(leaf.sharding if isinstance(leaf, jax.Array) and leaf.committed else None for leaf in leaves)
        program = self.placed.get(place)
        if program is None:
            with _LOCK:  # round JAX's cache, see below
                program = self.placed.setdefault(place, self._compiled(place, leaves))
        return program(*leaves)

    @cached_property
    def staged(self) -> Callable[..., list[Any]]:
        """By JAX's own `jit`, for what a compiled program cannot do."""
        return jax.jit(self.traced)

    def traced(self, *leaves: Any) -> list[Any]:
        """The same as a part of what is being traced."""
        results, self.note = self.fun(*leaves)
        return results

    def derived(self, kind: str, fun: Callable[..., tuple[list[Any], Any]]) -> "Program":
        """A program of what follows from this one and from `kind`, such as its derivative."""
        if kind not in self.made_of_it:
            known = None if self.known is None else f"{kind} of {self.known}"
            self.made_of_it[kind] = Program(self.name, known, fun)
        return self.made_of_it[kind]

    def _compiled(self, place: tuple[Any, ...], leaves: Any) -> Callable[..., list[Any]]:
        """From the folder, or compiled and put there."""
        module = insides()
        assert module is not None
        path, key = self._path(place)
        if path is not None:
            begin = time.perf_counter()
            try:
                its_key, *parts = pickle.loads(zlib.decompress(folder.read(path)))  # with zlib's checksum
                if its_key != key:
                    raise ValueError("it is another program")
                stored, in_tree, out_tree, note, ids = parts
                devices = {device.id: device for device in jax.devices()}
                program = module.deserialize_and_load(stored, in_tree, out_tree, execution_devices=[devices[k] for k in ids])
                self.note = note
                jax.monitoring.record_event_duration_secs(LOADED, time.perf_counter() - begin)
                return program
            except FileNotFoundError:
                pass
            except Exception as error:  # whatever a damaged file leads to
                self._warn("reading", error)

        def flat(*leaves: Any) -> list[Any]:
            return self.traced(*leaves)

        flat.__name__ = self.name.rpartition(".")[2]
        lowered = jax.jit(flat, compiler_options=self.options, donate_argnums=self.donated).lower(*leaves)
        if path is None:
            return lowered.compile()
        with _without_jax_cache(module):
            program = lowered.compile()
        try:
            ids = [device.id for device in program.runtime_executable().local_devices()]  # pyright: ignore
            folder.write(path, zlib.compress(pickle.dumps((key, *module.serialize(program), self.note, ids))))
        except Exception as error:  # no space, or a backend whose programs cannot be stored
            self._warn("writing", error)
        return program

    def _path(self, place: tuple[Any, ...]) -> tuple[Path | None, str]:
        """Its file, and a hash of all that it is found by; None: it cannot be kept."""
        kept_in = None if self.known is None else folder.current()
        source = None if kept_in is None else _source()
        if kept_in is None or source is None or not all(at is None or isinstance(at, _PLACES) for at in place):
            return None, ""
        config = [(name, getattr(jax.config, name, value)) for name, value in sorted(jax.config.values.items())]
        known = repr((self.known, list(map(_devices, place)), config, os.environ.get("XLA_FLAGS"), jax.devices()))
        key = hashlib.sha256(known.encode() + source).hexdigest()
        return kept_in / f"{self.name}-{key[:32]}", key

    def _warn(self, doing: str, error: Exception) -> None:
        """In JAX's words for its own cache."""
        said = f"Error {doing} persistent compilation cache entry for '{self.name.rpartition('.')[2]}'"
        warnings.warn(f"{said}: {type(error).__name__}: {error}", stacklevel=3)


def _named(value: Any) -> Any:
    """A module's function by its name, else the value."""
    if not isinstance(value, FunctionType) or not _is_code_of_ours(value.__module__):
        return value
    is_there = getattr(sys.modules.get(value.__module__), value.__qualname__, None) is value  # and nobody has replaced it
    return f"{value.__module__}.{value.__qualname__}" if is_there else value


def _devices(at: Any) -> Any:
    """A place with the numbers of its devices in their order, which its `repr` does not name."""
    devices = at.mesh.devices.flat if isinstance(at, NamedSharding) else at.device_set if at else ()  # pyright: ignore
    return at, [device.id for device in devices]


def _classes(tree: Any) -> list[str]:
    """The classes of a structure with their modules, which its `repr` does not name."""
    node = tree.node_data()
    own = [] if node is None else [f"{node[0].__module__}.{node[0].__qualname__}"]
    return own + [name for child in tree.children() for name in _classes(child)]


def _says_all(given: Any) -> bool:
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


@contextmanager
def _without_jax_cache(module: ModuleType) -> Iterator[None]:
    """A program out of JAX's cache could not be stored again: XLA leaves its kernels out, without an error."""
    before = jax.config.values["jax_enable_compilation_cache"]
    if not (before and jax.config.values["jax_compilation_cache_dir"]):
        yield
        return
    jax.config.update("jax_enable_compilation_cache", False)
    module.compilation_cache.reset_cache()
    try:
        yield
    finally:
        jax.config.update("jax_enable_compilation_cache", before)
        module.compilation_cache.reset_cache()


def _source() -> bytes | None:
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
