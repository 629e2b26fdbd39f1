"""Functions that are called as a whole: as one kernel of XLA's on the CPU, and one after the other under `vmap`."""

from collections.abc import Callable
from typing import Any

import jax
from jax import lax

from .plain import insides

_Function = Callable[..., Any]


def one_kernel(fun: _Function, *args: Any, elsewhere: _Function | None = None) -> Any:
    """`fun(*args)`, compiled by XLA on the CPU to a single function: its loops and conditionals become branches within.

    A tile of a picture is some 350 loops of about a microsecond each. That XLA's runtime starts them one by one, and asks each
    loop and conditional how it goes on, was a third of a frame's time. XLA calls this a small call; versions and platforms
    that do not know it ignore the attribute, and a function that XLA has no code for within a kernel is called as it is.

    A derivative is taken of the function linearised: what that stores comes from the same kernel as the value, and what it
    computes again and sums up stands outside, as its sums are scatters.

    Args:
      fun: with no other traced values than its arguments.
      args: pytrees of arrays.
      elsewhere: a function of the same values that stands for `fun` on what is no CPU.
    """
    module = insides()
    if module is not None:
        return module.bound(module.kernel, fun, args, elsewhere=elsewhere)
    return fun(*args) if elsewhere is None else lax.platform_dependent(*args, cpu=fun, default=elsewhere)


PART = 128
"""Items that are dealt with together on CPUs; of a larger batch more would wait for the slowest."""


def in_parts(fun: _Function, own: Any, shared: Any) -> Any:
    """`fun(own, shared)` as one kernel; on CPUs for `PART` items after `PART` items, if that divides their number.

    `own` and what `fun` returns have a leading axis that counts the items; for the rest see `one_kernel`.
    """
    count = jax.tree.leaves(own)[0].shape[0]

    def parts(own: Any, shared: Any) -> Any:
        split = jax.tree.map(lambda leaf: leaf.reshape(-1, PART, *leaf.shape[1:]), own)
        results = lax.map(lambda own: fun(own, shared), split)
        return jax.tree.map(lambda leaf: leaf.reshape(count, *leaf.shape[2:]), results)

    return one_kernel(fun, own, shared) if count <= PART or count % PART else one_kernel(parts, own, shared, elsewhere=fun)


def in_turn(fun: _Function, *args: Any, derivative_of: _Function | None = None) -> Any:
    """`fun(*args)`; under `vmap` for one after the other, so that none waits for the slowest (not so in plain mode).

    Args:
      fun, args: as for `one_kernel`.
      derivative_of: a function of the same values, up to rounding, which stands for `fun` wherever that is differentiated.
    """
    module = insides()
    if module is not None:
        return module.bound(module.in_turn, fun, args, derivative_of=derivative_of)
    if derivative_of is None:
        return fun(*args)
    plain = jax.custom_jvp(fun)
    plain.defjvp(lambda primals, tangents: jax.jvp(derivative_of, primals, tangents))
    return plain(*args)
