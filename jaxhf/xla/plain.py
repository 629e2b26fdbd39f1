"""Whether jaxhf leaves JAX's insides alone."""

import functools
import os
import warnings
from types import ModuleType

import jax


def is_asked_for() -> bool:
    """Whether the user wants jaxhf without anything that JAX does not promise: `JAXHF_PLAIN=1`."""
    return os.environ.get("JAXHF_PLAIN", "") not in ("", "0")


@functools.cache
def insides() -> ModuleType | None:
    """The module `insides`; None where `JAXHF_PLAIN=1` asks for a plain mode, or the JAX at hand does not take what it does.

    All that a caller has of it is speed: who gets None does the same by public functions of JAX. Asked for at the first use,
    not on import, and the answer holds for the process. One warning tells where JAX does not take it; a version that is newer
    than those known is tried out first, by a small program.
    """
    if is_asked_for():
        return None
    try:
        from . import insides as module  # here, as it may fail

        if jax.__version_info__[:2] > module.TRIED:
            module.try_out()
    except Exception as error:
        said = f"{type(error).__name__}: {error}".splitlines()[0]
        warnings.warn(
            f"jaxhf is slower than it could be: JAX {jax.__version__} does not take its kernels ({said})", stacklevel=2
        )
        return None
    return module
