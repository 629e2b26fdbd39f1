"""Commands keep all compiled programs for the next run, also those of JAX alone; and what becomes of damaged ones."""

import os
import re
import warnings
from glob import escape
from pathlib import Path
from typing import Any

import jax

from ..xla import folder
from ..xla.plain import is_asked_for


def keep_programs(wanted: bool) -> None:
    """Lets JAX keep its programs, if that is `wanted`, beside ours, unless the user has named a folder to JAX itself.

    Where they cannot be kept a warning says so, no more. In plain mode none are.
    """
    if is_asked_for():
        return
    if not wanted:
        jax.config.update("jax_enable_compilation_cache", False)
        return
    if "JAX_COMPILATION_CACHE_DIR" in os.environ or not jax.config.values["jax_enable_compilation_cache"]:
        return
    try:
        kept_in = folder.opened()
    except (OSError, RuntimeError) as error:  # the latter where there is no home folder
        warnings.warn(f"compiled programs are not kept: {error}", stacklevel=2)
        kept_in = None
    folder.keep_in(kept_in)
    if kept_in is None:
        return
    jax.config.update("jax_compilation_cache_dir", str(kept_in))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    _mend(kept_in)


def _mend(kept_in: Path) -> None:
    """Lets one warning stand for all about programs in this folder, and removes damaged ones, which JAX would not replace."""
    show, told = warnings.showwarning, set()
    pattern = r"Error (reading|writing) persistent compilation cache entry for '(.*?)': (.*)"

    def mend(message: Warning | str, *place: Any, **more: Any) -> None:
        found = re.fullmatch(pattern, str(message), re.DOTALL)
        if found is None:
            return show(message, *place, **more)
        doing, program, why = found.groups()
        if doing == "reading":
            for path in kept_in.glob(f"{escape(program)}-*-cache"):
                path.unlink(missing_ok=True)
        if doing not in told:
            told.add(doing)
            said = "damaged programs are compiled again" if doing == "reading" else "compiled programs are not kept"
            show(UserWarning(f"{kept_in}: {said}: {why}"), *place, **more)

    warnings.filterwarnings("always", pattern)
    warnings.showwarning = mend
