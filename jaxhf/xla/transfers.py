"""What goes from the host to a device under `jax.transfer_guard`."""

import functools
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import jax

P = ParamSpec("P")
R = TypeVar("R")


def takes_numbers(fun: Callable[P, R]) -> Callable[P, R]:
    """`fun`, within which NumPy's arrays may go to devices whatever `jax.transfer_guard` says of the caller's own program.

    Cameras, lights and transforms are NumPy's until they are rendered. Compiled programs take them as they are, in less time
    than `jax.device_put` takes for each leaf; to the guard that is a transfer by mistake.
    """

    @functools.wraps(fun)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        with jax.transfer_guard_host_to_device("allow"):
            return fun(*args, **kwargs)

    return call
