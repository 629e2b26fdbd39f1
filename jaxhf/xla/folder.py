"""The folder in which compiled programs are kept: where it is, whose, and how much may be in it."""

import contextlib
import hashlib
import itertools
import os
import platform
import re
import stat
import sys
import tempfile
import threading
import warnings
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path
from types import ModuleType

import jax

from .plain import is_asked_for

_SWITCH, _WITHIN = threading.Lock(), list[int]()  # see `without_jax_cache`
_MOST = 500_000_000  # bytes; a picture's programs take 0.3 million, a gradient's 0.6

_FOLDER = re.compile(r"jaxhf-.*-jax-.*-jaxlib-.*-[0-9a-f]{16}")
_PROGRAM = re.compile(r"jaxhf\..*-[0-9a-f]{32}(\..*)?|.*-(cache|atime)")  # ours and unfinished ones, and JAX's

# Of the whole process, as JAX's own cache is; empty until `keep_in` is called, and until the first use.
_chosen: list[Path | None] = []
_by_default: list[Path | None] = []


def keep_in(folder: Path | None) -> None:
    """From now on programs are kept in this folder, which exists; None: nowhere."""
    _chosen[:] = [folder]


def current() -> Path | None:
    """Where programs are kept: as `keep_in` said, or else in the folder of `opened`.

    Nowhere where the user has told JAX itself to keep programs, or to keep none, nor in plain mode. Where the folder that
    JAXHF_CACHE names cannot be used one warning says so.
    """
    if _chosen:
        return _chosen[0]
    config = jax.config
    if is_asked_for() or config.jax_compilation_cache_dir or not config.jax_enable_compilation_cache:  # pyright: ignore
        return None
    if not _by_default:
        try:
            _by_default.append(opened())
        except (OSError, RuntimeError) as error:  # the latter where there is no home folder
            _by_default.append(None)
            if os.environ.get("JAXHF_CACHE"):
                warnings.warn(f"compiled programs are not kept: {error}", stacklevel=2)
    return _by_default[0]


def opened() -> Path | None:
    """That of these versions and this processor, by `JAXHF_CACHE` or in the platform's cache folder; None: keep nothing.

    It is made where it is missing, and closed to other users, as a program can do whatever its user can.

    Raises:
      OSError: it cannot be made or written to, or belongs to another user.
      RuntimeError: there is no home folder.
    """
    named = os.environ.get("JAXHF_CACHE")
    if named in ("", "0", "off"):
        return None
    versions = "-".join(f"{package}-{version(package)}" for package in ("jaxhf", "jax", "jaxlib"))
    folder = (Path(named) if named else _platform_folder() / "jaxhf") / f"{versions}-{_processor()}"
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    _require_own(folder, folder.lstat())
    if folder.is_symlink():
        raise PermissionError(f"{folder} is a link")
    if not os.access(folder, os.W_OK):
        raise PermissionError(f"{folder} is read-only")
    if os.name == "posix":
        folder.chmod(0o700)
    _remove_oldest(folder.parent, _MOST)
    return folder


def read(path: Path) -> bytes:
    """A file of the folder; PermissionError where another user has put it there."""
    with path.open("rb") as file:
        _require_own(path, os.fstat(file.fileno()))
        stored = file.read()
    with contextlib.suppress(OSError):
        os.utime(path)  # what was used longest ago is removed first
    return stored


def write(path: Path, stored: bytes) -> None:
    """All of it or nothing, also where another thread or process writes the same."""
    number, part = tempfile.mkstemp(dir=path.parent, prefix=f"{path.name}.")
    try:
        with open(number, "wb") as file:
            file.write(stored)
        os.replace(part, path)
    finally:
        Path(part).unlink(missing_ok=True)


def _require_own(path: Path, said: os.stat_result) -> None:
    if hasattr(os, "getuid") and said.st_uid != os.getuid():
        raise PermissionError(f"{path} belongs to another user")


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
    for folder in root.iterdir():
        if not _FOLDER.fullmatch(folder.name) or folder.is_symlink() or not folder.is_dir():
            continue
        with contextlib.suppress(OSError):  # removed by another process, or another user's
            programs = [(path, path.lstat()) for path in folder.iterdir() if _PROGRAM.fullmatch(path.name)]
            found += [(path, said) for path, said in programs if stat.S_ISREG(said.st_mode)]
    total = sum(said.st_size for _, said in found)
    for path, said in sorted(found, key=lambda one: max(one[1].st_atime, one[1].st_mtime)):
        if total <= most:
            break
        with contextlib.suppress(OSError):
            path.unlink(missing_ok=True)
            total -= said.st_size


@contextlib.contextmanager
def without_jax_cache(module: ModuleType) -> Iterator[None]:
    """A program out of JAX's cache could not be stored again: XLA leaves its kernels out, without an error.

    The cache is off for all threads from the first that is within on to the last.
    """

    def switch(on: bool) -> None:
        jax.config.update("jax_enable_compilation_cache", on)
        module.compilation_cache.reset_cache()

    with _SWITCH:
        has_one = jax.config.values["jax_enable_compilation_cache"] and jax.config.values["jax_compilation_cache_dir"]
        switches = bool(_WITHIN or has_one)
        if switches:
            _WITHIN.append(threading.get_ident())
            switch(False)
    try:
        yield
    finally:
        with _SWITCH:
            if switches:
                _WITHIN.remove(threading.get_ident())
                switch(not _WITHIN)
