"""Compiled programs in a folder, from where a later process takes them without tracing them again.

JAX's own cache finds a program by what tracing gives, and a picture is traced for longer than it takes to render. These are
found by all that tracing depends on: the package's source, JAX's configuration, and the arguments' structure, shapes and types.
"""

import hashlib
import inspect
import os
import pickle
import threading
import time
import warnings
import zlib
from collections.abc import Callable, Collection
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from functools import cached_property
from pathlib import Path
from types import ModuleType
from typing import Any

import equinox as eqx
import jax
from jax.core import Tracer
from jax.sharding import NamedSharding, SingleDeviceSharding

from . import folder, identity
from .plain import insides

LOADED = "/jaxhf/program_loaded"
"""JAX's monitoring is told under this name how long it took to load a program, in seconds."""

_LOCK = threading.RLock()
# How names of JAX's settings begin that change no program: `without_jax_cache` and `takes_numbers` set them.
_NO_MATTER = "jax_enable_compilation_cache", "jax_transfer_guard"
_PLACES = (NamedSharding, SingleDeviceSharding)


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
        return _called(*self._found(*args, **kwargs))

    def compile_ahead(self, *args: Any, **kwargs: Any) -> Any:
        """As `Program.compile_ahead`; among the arguments may be `jax.ShapeDtypeStruct`s, for arrays to come."""
        return _compiled_ahead(*self._found(*args, **kwargs))

    def meanwhile(self, then: Callable[[Any], None], *args: Any, **kwargs: Any) -> Any:
        """See `Compiled.meanwhile`."""
        program, leaves = self._found(*args, **kwargs)
        forms = _compiled_ahead(program, leaves)
        if forms is not None:
            with suppress(Exception):  # which the user is told of by what is called then
                then(forms)
        return _called(program, leaves)

    def _found(self, *args: Any, **kwargs: Any) -> tuple["Program", list[Any]]:
        """The program for these arguments, and their arrays."""
        given = self.signature.bind(*args, **kwargs).arguments
        static = tuple((name, given.pop(name)) for name in self.static or () if name in given)
        leaves, tree = jax.tree.flatten(given)
        others = {}
        if self.static is None:
            others = {k: leaf for k, leaf in enumerate(leaves) if not _is_array(leaf)}
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
        return program, leaves

    def _program(self, static: Any, others: dict[int, Any], tree: Any, types: Any) -> "Program":
        def flat(*leaves: Any) -> tuple[list[Any], Any]:
            returned = self.fun(**dict(static), **jax.tree.unflatten(tree, _among(others, leaves)))
            results, structure = jax.tree.flatten(returned)
            no_arrays = {k: value for k, value in enumerate(results) if self.static is None and not eqx.is_array(value)}
            note = jax.tree.unflatten(structure, range(len(results))), no_arrays  # a structure with modules cannot be pickled
            return [value for k, value in enumerate(results) if k not in no_arrays], note

        name = f"{self.fun.__module__}.{self.fun.__qualname__}"
        said = {k: identity.named(value) for k, value in others.items()}
        places = jax.tree.unflatten(tree, _among(dict.fromkeys(others), range(len(types))))
        donated = tuple(jax.tree.leaves([places[name] for name in self.donated if name in places]))
        known = repr((name, static, said, tree, identity.classes(tree), types, self.options, donated))
        return Program(name, known if identity.says_all((static, said, tree)) else None, flat, self.options, donated)


def _called(program: "Program", leaves: list[Any]) -> Any:
    module = insides()
    assert module is not None
    traced = any(isinstance(leaf, Tracer) for leaf in leaves)
    return program.returned(module.call_program(program, leaves) if traced else program(*leaves))


def _compiled_ahead(program: "Program", leaves: list[Any]) -> Any:
    forms = None if any(isinstance(leaf, Tracer) for leaf in leaves) else program.compile_ahead(*leaves)
    return None if forms is None else program.returned(forms)


def _type(leaf: Any) -> tuple[Any, ...]:
    """What a trace sees of an array; JAX's own type also has a mesh, which differs between the results of programs."""
    form = jax.typeof(leaf)
    return form.shape, form.dtype, form.weak_type


def _is_array(leaf: Any) -> bool:
    return eqx.is_array(leaf) or isinstance(leaf, jax.ShapeDtypeStruct)


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
        self.placed: dict[Any, Callable[..., list[Any]] | Future[Any]] = {}
        self.made_of_it: dict[str, Program] = {}
        self.linear: dict[Any, Any] = {}

    def returned(self, results: list[Any]) -> Any:
        """What a `Kept` function returns whose program has these results."""
        structure, others = self._outcome
        return jax.tree.unflatten(structure, _among(others, results))

    @cached_property
    def _outcome(self) -> tuple[Any, dict[int, Any]]:
        return jax.tree.structure(self.note[0]), self.note[1]

    def __call__(self, *leaves: Any) -> list[Any]:
        place = _place(leaves)
        program = self.placed.get(place)
        if program is None or isinstance(program, Future):
            program = self._awaited(place, leaves)
        return program(*leaves)

    def compile_ahead(self, *leaves: Any) -> list[Any] | None:
        """Traces the program and begins to compile it, in another thread; the forms of its results, so that what follows can be
        traced meanwhile. None where it is there or in the folder, or another thread has another configuration or cannot be."""
        module, place = insides(), _place(leaves)
        assert module is not None
        if place in self.placed or not _threads_compile_alike(module):
            return None
        with _LOCK:
            if place in self.placed:
                return None
            path, key = self._path(place)
            if (program := self._loaded(path, key)) is not None:
                self.placed[place] = program
                return None
            traced = self._traced(leaves)
            lowered, other = traced.lower(), ThreadPoolExecutor(1)
            self.placed[place] = other.submit(self._stored, lowered, path, key)
            other.shutdown(wait=False)
        told = {at for at in place if at is not None}  # where on one device results are then
        at = told.pop() if len(told) == 1 else None
        kept_there = at if isinstance(at, SingleDeviceSharding) else None
        return [
            jax.ShapeDtypeStruct(form.shape, form.dtype, weak_type=form.weak_type, sharding=kept_there)
            for form in traced.jaxpr.out_avals
        ]

    def _awaited(self, place: tuple[Any, ...], leaves: Any) -> Callable[..., list[Any]]:
        """What is compiled here, or elsewhere: an error there is raised here, and a later call tries again."""
        with _LOCK:
            program = self.placed.get(place)
            if program is None:
                path, key = self._path(place)
                program = self._loaded(path, key) or self._stored(self._traced(leaves).lower(), path, key)
                self.placed[place] = program
        if not isinstance(program, Future):
            return program
        failed = program.exception() is not None
        with _LOCK:
            if self.placed.get(place) is program:
                if failed:
                    del self.placed[place]
                else:
                    self.placed[place] = program.result()
        return program.result()

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

    def _loaded(self, path: Path | None, key: str) -> Callable[..., list[Any]] | None:
        """From the folder; None where it is not there, or damaged."""
        if path is None:
            return None
        module, begin = insides(), time.perf_counter()
        assert module is not None
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
        return None

    def _traced(self, leaves: Any) -> Any:
        def flat(*leaves: Any) -> list[Any]:
            return self.traced(*leaves)

        flat.__name__ = self.name.rpartition(".")[2]
        return jax.jit(flat, compiler_options=self.options, donate_argnums=self.donated).trace(*leaves)

    def _stored(self, lowered: Any, path: Path | None, key: str) -> Callable[..., list[Any]]:
        """Compiled, and put into the folder."""
        module = insides()
        assert module is not None
        if path is None:
            return lowered.compile()
        with folder.without_jax_cache(module):
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
        source = None if kept_in is None else identity.source()
        if kept_in is None or source is None or not all(at is None or isinstance(at, _PLACES) for at in place):
            return None, ""
        names = sorted(name for name in jax.config.values if not name.startswith(_NO_MATTER))
        config = [(name, getattr(jax.config, name, jax.config.values[name])) for name in names]
        known = repr((self.known, list(map(identity.devices, place)), config, os.environ.get("XLA_FLAGS"), jax.devices()))
        key = hashlib.sha256(known.encode() + source).hexdigest()
        return kept_in / f"{self.name}-{key[:32]}", key

    def _warn(self, doing: str, error: Exception) -> None:
        """In JAX's words for its own cache."""
        said = f"Error {doing} persistent compilation cache entry for '{self.name.rpartition('.')[2]}'"
        warnings.warn(f"{said}: {type(error).__name__}: {error}", stacklevel=3)


def _threads_compile_alike(module: ModuleType) -> bool:
    """Whether another thread has the same configuration of JAX; not where the interpreter ends, and begins none."""
    try:
        return module.configuration() == module.untraced(module.configuration)
    except RuntimeError:
        return False


def _place(leaves: Any) -> tuple[Any, ...]:
    """Where arrays are to be, None for those that may be anywhere."""

    def of(leaf: Any) -> Any:
        is_told = leaf.committed if isinstance(leaf, jax.Array) else isinstance(leaf, jax.ShapeDtypeStruct)
        return leaf.sharding if is_told else None

    return tuple(map(of, leaves))
