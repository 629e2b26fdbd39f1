"""Compiled programs are kept for the next run: in which folder, how many, and what becomes of damaged ones."""

import hashlib
import itertools
import os
import platform
import re
import sys
import warnings
from contextlib import suppress
from glob import escape
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax

from ..xla import kept
from ..xla.plain import is_asked_for

_MOST = 500_000_000  # bytes; a picture's programs take 0.3 million


def keep_programs(wanted: bool) -> None:
    """Lets JAX keep compiled programs in `programs_folder()`, unless the user has named a folder to JAX itself.

    Where they cannot be kept a warning says so, no more. In plain mode none are.

    Args:
      wanted: whether to keep any; if not, a folder that the user has named to JAX is not used either.
    """
    if is_asked_for():
        return
    if not wanted:
        jax.config.update("jax_enable_compilation_cache", False)
        return
    if "JAX_COMPILATION_CACHE_DIR" in os.environ or not jax.config.values["jax_enable_compilation_cache"]:
        return
    try:
        folder = programs_folder()
        if folder is None:
            return
        folder.mkdir(parents=True, exist_ok=True)
        if not os.access(folder, os.W_OK):
            raise PermissionError(f"{folder} is read-only")
        _remove_oldest(folder.parent, _MOST)
    except (OSError, RuntimeError) as error:  # the latter where there is no home folder
        warnings.warn(f"compiled programs are not kept: {error}", stacklevel=2)
        return
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    kept.keep_in(folder)
    _mend(folder)


def programs_folder() -> Path | None:
    """That of this version and this processor, by `JAXHF_CACHE` or in the platform's cache folder; None: keep nothing."""
    named = os.environ.get("JAXHF_CACHE")
    if named in ("", "off"):
        return None
    versions = "-".join(f"{package}-{version(package)}" for package in ("jaxhf", "jax", "jaxlib"))
    return (Path(named) if named else _platform_folder() / "jaxhf") / f"{versions}-{_processor()}"


def _platform_folder() -> Path:
    home = Path.home()
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA") or home / "AppData" / "Local")
    if sys.platform == "darwin":
        return home / "Library" / "Caches"
    return Path(os.environ.get("XDG_CACHE_HOME") or home / ".cache")


def _processor() -> str:
    """A hash of the processor's model and instructions: a program compiled for others may not run."""
    said = Path("/proc/cpuinfo")
    lines = [platform.machine()]
    if not said.exists():
        lines.append(platform.processor())
    else:
        with said.open() as cores:
            first = itertools.takewhile(str.strip, cores)
            lines += [line for line in first if re.match(r"vendor|model|cpu family|flags|Features|CPU [a-z]", line)]
    return hashlib.sha256("".join(lines).encode()).hexdigest()[:16]


def _remove_oldest(root: Path, most: int) -> None:
    """Removes the programs used longest ago, of all versions, until the rest has at most so many bytes."""
    found = []
    for path in root.glob("jaxhf-*-jax-*/*"):
        with suppress(FileNotFoundError):  # removed by another process
            found.append((path, path.stat()))
    total = sum(said.st_size for _, said in found)
    for path, said in sorted(found, key=lambda one: max(one[1].st_atime, one[1].st_mtime)):
        if total <= most:
            break
        path.unlink(missing_ok=True)
        total -= said.st_size


def _mend(folder: Path) -> None:
    """Lets one warning stand for all about programs in this folder, and removes damaged ones, which JAX would not replace."""
    show, told = warnings.showwarning, set()
    pattern = r"Error (reading|writing) persistent compilation cache entry for '(.*?)': (.*)"

    def mend(message: Warning | str, *place: Any, **more: Any) -> None:
        found = re.fullmatch(pattern, str(message), re.DOTALL)
        if found is None:
            return show(message, *place, **more)
        doing, program, why = found.groups()
        if doing == "reading":
            for path in folder.glob(f"{escape(program)}-*-cache"):
                path.unlink(missing_ok=True)
        if doing not in told:
            told.add(doing)
            said = "damaged programs are compiled again" if doing == "reading" else "compiled programs are not kept"
            show(UserWarning(f"{folder}: {said}: {why}"), *place, **more)

    warnings.filterwarnings("always", pattern)
    warnings.showwarning = mend
