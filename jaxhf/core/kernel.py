"""A function as one kernel of XLA's on the CPU, where it would become one for each fused loop in it."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jax.experimental.xla_metadata import set_xla_metadata


def one_kernel(fun: Callable[..., Any], *args: Any) -> Any:
    """`fun(*args)`, compiled by XLA on the CPU to a single function: its loops and conditionals become branches within.

    A tile of a picture is some 350 loops of about a microsecond each. That XLA's runtime starts them one by one, and asks each
    loop and conditional how it goes on, was a third of a frame's time. The bits stay the same. XLA calls this a small call;
    versions and platforms that do not know it ignore the attribute.

    XLA 0.10 ends the process where such a call does not use an argument, also where that is a constant, which it moves into
    the call. So a number of each argument is returned besides, and barriers hide what the arguments are.

    Args:
      fun: without sorting, scatters, large products of matrices and calls of other libraries, for which XLA has no code within
        a kernel. Nothing in it is differentiated: a reverse derivative would make whole arrays of what the barriers hide.
      args: pytrees of arrays of real numbers, integers and flags.
    """
    if jax.default_backend() != "cpu" or not all(leaf.size for leaf in jax.tree.leaves(args)):
        return fun(*args)

    def with_uses(*args: Any) -> tuple[Any, jax.Array]:
        return fun(*args), jnp.stack([leaf.reshape(-1)[0].astype(jnp.float32) for leaf in jax.tree.leaves(args)])

    called = jax.jit(with_uses)(*lax.optimization_barrier(args))
    return lax.optimization_barrier(set_xla_metadata(called, inlineable="false", xla_cpu_small_call="true"))[0]


def traced_once(fun: Callable[..., Any]) -> Callable[..., Any]:
    """`fun`, which JAX traces once for arguments of one form, however often it is called within a program."""
    return jax.jit(fun)
