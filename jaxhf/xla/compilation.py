"""How jaxhf's own programs are compiled."""

import contextlib
import functools
import gc
import inspect
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import jaxlib.version
from jax.core import Tracer

from .kept import Kept
from .plain import insides

_OPTIONS = {
    # XLA's older emitters of fused loops for the CPU. The newer ones go through MLIR: frames then compile for 1.7 times as
    # long, and do not run faster. The steps of a fit, however, take 1.4 times as long with these. From jaxlib 0.11 on there
    # are only the newer ones.
    "xla_cpu_use_fusion_emitters": False,
    # Where the processor has AVX-512: else XLA takes half of it, and frames 1.25 times as long, gradients 1.1.
    "xla_cpu_prefer_vector_width": 512,
    # Else XLA deals out kernels of microseconds, which a walk's steps are, to threads: on one device pictures and gradients
    # then take twice the processor's and the clock's time, on two 1.1 to 1.3 of it. jaxlib 0.12 does not.
    "xla_disable_hlo_passes": "cpu-parallel-task-assigner",
}


def is_traced() -> bool:
    """Whether JAX is tracing or transforming what calls this; plain mode does not know of `grad` and `vmap` alone."""
    module = insides()
    return is_staged() if module is None else module.is_traced()


def is_staged() -> bool:
    """Whether what is computed here becomes part of a program, as within `jax.jit`; not by `grad` and `vmap` alone."""
    return isinstance(jnp.zeros(()), Tracer)


def is_part_of_more(tree: Any) -> bool:
    """Whether what is computed from these values becomes part of a program or is differentiated or batched, or JAX has been
    told of a mesh."""
    if is_traced() or not jax.sharding.get_abstract_mesh().empty:
        return True
    return any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(tree))


@contextlib.contextmanager
def _garbage_left() -> Iterator[None]:
    """Within, Python looks for no garbage: tracing makes many objects that live on, and else takes up to a fifth longer."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


@functools.cache
def compiler_options(newer: bool = False) -> dict[str, Any] | None:
    """What `jax.jit` takes as `compiler_options`, so that a program of jaxhf's compiles and runs in less time.

    Args:
      newer: for programs without rays, which run faster with XLA's newer emitters of loops.

    Returns:
      The options that this version of XLA knows; None where there are none.
    """
    if insides() is None:
        return None
    options = {"xla_cpu_use_fusion_emitters": True} if newer else _OPTIONS
    return {name: value for name, value in options.items() if _is_known({name: value}) and _is_right(name)} or None


def _is_known(option: dict[str, Any]) -> bool:
    module = insides()
    assert module is not None
    try:
        module.untraced(jax.jit(lambda: (), compiler_options=option))
    except jax.errors.JaxRuntimeError:
        return False
    return True


def _is_right(name: str) -> bool:
    """Whether an option does no harm: with wide vectors the newer emitters of jaxlib 0.10 and 0.11 compile a wrong arctan."""
    if name != "xla_cpu_prefer_vector_width" or jaxlib.version.__version_info__ >= (0, 12):
        return True
    return _is_known({"xla_cpu_use_fusion_emitters": False})


class Compiled:
    """A function by programs that jaxhf compiles; see `compiled`."""

    def __init__(self, fun: Callable[..., Any], jit: Callable[..., Any], newer: bool | None, options: dict[str, Any]):
        self.fun, self.jit, self.newer, self.options = fun, jit, newer, options
        self._inside = jit(fun, **options)
        functools.update_wrapper(self, fun)

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        with _garbage_left():
            if self._serves():
                return self._kept(*args, **kwargs)
            if insides() is None or is_traced():
                return self._inside(*args, **kwargs)
            return self._alone(*args, **kwargs)

    def meanwhile(self, then: Callable[[Any], None], *args: Any, **kwargs: Any) -> Any:
        """As called with these arguments. If its program must be compiled first, then meanwhile `then` is called with the
        `jax.ShapeDtypeStruct`s of what it will return, to `compile_ahead` programs that take this. Its errors do not count."""
        if not self._serves():
            return self(*args, **kwargs)
        compiler_options(False)  # tried out now for what follows: while a program is compiled, JAX's cache is off
        with _garbage_left():
            return self._kept.meanwhile(then, *args, **kwargs)

    def compile_ahead(self, *args: Any, **kwargs: Any) -> Any:
        """See `Kept.compile_ahead`; None, too, where programs are not kept."""
        with _garbage_left():
            return self._kept.compile_ahead(*args, **kwargs) if self._serves() else None

    def _serves(self) -> bool:
        return insides() is not None and Kept.serves(self.fun) and not (is_traced() and is_staged())

    @functools.cached_property
    def _given(self) -> dict[str, Any] | None:
        return None if self.newer is None else compiler_options(self.newer)

    @functools.cached_property
    def _alone(self) -> Callable[..., Any]:
        return self.jit(self.fun, compiler_options=self._given, **self.options)

    @functools.cached_property
    def _kept(self) -> Kept:
        static = self.options.get("static_argnames", ()) if self.jit is jax.jit else None
        donated = list(inspect.signature(self.fun).parameters)[1:] if "donate" in self.options else ()
        return Kept(self.fun, self._given, static, donated)


def compiled(
    fun: Callable[..., Any], jit: Callable[..., Any] = jax.jit, newer: bool | None = False, **options: Any
) -> Compiled:
    """`jit(fun, **options)`, with `compiler_options` where it is called as it is, not as part of another program.

    JAX allows them only there; a program round this one may be compiled with them by its own `jax.jit`.

    Args:
      fun: to be compiled.
      jit: `jax.jit`, or `equinox.filter_jit`.
      newer: with XLA's newer emitters, and its kernels dealt out to threads: passes over tiles of a grid run 3 to 4 times as
        fast. None: as XLA compiles by itself.
      options: of `jit`: `static_argnames`, or "all-except-first" as `donate`.
    """
    return Compiled(fun, jit, newer, options)
