"""What all readers share: where an error is, which word was meant, and which files a scene may open."""

import difflib
import os
from collections.abc import Iterable
from pathlib import Path

from ..core.errors import UserError


class FileError(UserError):
    """Something is wrong with a file, or with its name, which begins the message where it is known."""


class SceneError(FileError):
    """Something is wrong in a file that the user wrote; the message begins with `file:line:` where a line is known."""

    def __init__(self, path: Path | str, line: int | None, message: str):
        super().__init__(f"{path}:{line}: {message}" if line is not None else f"{path}: {message}")


def nearest(word: str, known: Iterable[str], cutoff: float = 0.5) -> str:
    """A tail for an error message about an unknown word: what may have been meant, else what is known."""
    known = sorted(known)
    close = difflib.get_close_matches(word, known, n=1, cutoff=cutoff)
    return f"did you mean {close[0]!r}?" if close else f"known: {', '.join(known)}"


def resolve_inside(root: Path, folder: Path, name: str) -> Path:
    """The file that `name` in a scene of this folder means; none outside `root`, the folder of the outermost scene."""
    if "\0" in name:
        raise FileError(f"{name!r} is no file's name")
    root = root.resolve()
    path = (folder / os.fsdecode(name.encode())).resolve()  # in a C locale letters are bytes in the names of files
    if not path.is_relative_to(root):
        raise FileError(f"{name!r} lies outside the scene's folder {str(root)!r}")
    if path.suffix.lower() == ".vrt":  # whose sources may lie anywhere
        raise FileError(f"{name!r} names other files, which a scene cannot open (gdal_translate makes a .tif of it)")
    if not path.is_file():
        raise FileNotFoundError(f"there is no file {name!r} in {str(folder)!r}")
    return path
