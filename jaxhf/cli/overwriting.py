"""Outputs replace files that are there, but never one that the same command reads."""

import argparse
import re
from collections.abc import Iterator
from pathlib import Path

from ..core.errors import UserError

_SCENES = (".toml", ".pbrt")


def require_no_input(options: argparse.Namespace, *others: Path) -> None:
    """UserError where an output of a command is one of its inputs: a file that another option names, or a scene's file.

    Args:
      options: of the command: `output` and `report` are written; every other string that names a file counts as read.
      others: what the command writes besides.
    """
    values = {name: value for name, value in vars(options).items() if isinstance(value, str)}
    outputs = [Path(values.pop(name)) for name in ("output", "report") if name in values] + list(others)
    outputs = [path for path in outputs if path.is_file()]
    if not outputs:
        return
    for value in values.values():
        for path in _read(Path(value)):
            for output in outputs:
                if path.samefile(output):
                    place = "" if path == Path(value) else f", which {value} names"
                    raise UserError(f"{output}: the output cannot replace an input of the same command{place}")


def _read(path: Path, seen: frozenset[Path] = frozenset()) -> Iterator[Path]:
    """A file and, if it is a scene, all that exist of those whose names stand in quotes in it."""
    try:
        if path in seen or not path.is_file():
            return
        yield path
        if path.suffix.lower() in _SCENES:
            for name in re.findall(r'"([^"\n]+)"|\'([^\'\n]+)\'', path.read_text(encoding="utf-8", errors="replace")):
                yield from _read(path.parent / "".join(name), seen | {path})
    except (OSError, ValueError):  # no system takes the word for a name, or nobody may read the file: its reader says so
        return
