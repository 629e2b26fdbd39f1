"""A function as one kernel of XLA's on the CPU, where it would become one for each fused loop in it."""

from collections.abc import Callable
from typing import Any

import jax
from jax.experimental.xla_metadata import set_xla_metadata


def one_kernel(fun: Callable[..., Any], *args: Any) -> Any:
    """`fun(*args)`, compiled by XLA on the CPU to a single function: its loops and conditionals become branches within.

    A tile's few hundred loops take about a microsecond each; that the runtime starts them one by one, and asks every loop and
    conditional how it goes on, is a third of a frame's time. The bits stay the same. XLA's own name for this is a small call;
    other versions, and other platforms, ignore what is said here. A derivative is computed as without it.

    Args:
      fun: without sorting, scatters and calls of other libraries, for which XLA has no code within a kernel.
      args: pytrees of arrays.
    """
    result = jax.jit(fun)(*args)
    if jax.default_backend() != "cpu":
        return result
    return set_xla_metadata(result, inlineable="false", xla_cpu_small_call="true")
