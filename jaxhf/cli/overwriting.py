"""Which files a command may write: outputs replace files that are there, but never one that the same command reads."""

import argparse
import re
from collections.abc import Iterator
from pathlib import Path

from ..core.errors import UserError
from ..io.files import file_path

_SCENES = (".toml", ".pbrt")
# Files of the same name that say where one of this ending lies: read with a terrain, and those of a map are written with it.
_BESIDE = {".png": (".pgw", ".prj"), ".asc": (".prj",), ".tif": (".tfw",), ".tiff": (".tfw",)}
_PLACED = (".png", ".asc")  # are written with what lies beside them


def require_no_input(options: argparse.Namespace, *others: Path) -> None:
    """UserError where an output of a command is one of its inputs: a file that another option names, or a scene's file.

    `output`, `report` and the `others` are written; every other string that names a file counts as read.
    """
    values = {name: value for name, value in vars(options).items() if isinstance(value, str)}
    for value in values.values():  # as it was written: a path would lose one of its slashes
        file_path("", value)
    outputs = [Path(values.pop(name)) for name in ("output", "report") if name in values] + list(others)
    if options.command.placed:
        outputs += [beside for path in outputs if path.suffix.lower() in _PLACED for beside in _beside(path)]
    outputs = [path for path in outputs if path.is_file()]
    if not outputs:
        return
    for value in values.values():
        for path in _read(Path(value)):
            for output in outputs:
                if path.samefile(output):
                    verb = "names" if Path(value).suffix.lower() in _SCENES else "comes with"
                    place = "" if path == Path(value) else f", which {value} {verb}"
                    raise UserError(f"{output}: the output cannot replace an input of the same command{place}")


def _beside(path: Path) -> list[Path]:
    """The files that exist beside one of a terrain or a map, and say where it lies."""
    beside = (path.with_suffix(ending) for ending in _BESIDE.get(path.suffix.lower(), ()))
    return [path for path in beside if path.is_file()]


def _read(path: Path, seen: frozenset[Path] = frozenset()) -> Iterator[Path]:
    """A file and, if it is a scene, all that exist of those whose names stand in quotes in it."""
    try:
        if path in seen or not path.is_file():
            return
        yield path
        yield from _beside(path)
        if path.suffix.lower() in _SCENES:
            for name in re.findall(r'"([^"\n]+)"|\'([^\'\n]+)\'', path.read_text(encoding="utf-8", errors="replace")):
                yield from _read(path.parent / "".join(name), seen | {path})
    except (OSError, ValueError):  # no system takes the word for a name, or nobody may read the file: its reader says so
        return
