"""What a sweep has measured so far: a table that grows by whole rows, and the reference that errors are taken against."""

import csv
import io
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..io.files import PathLike, reading, replacing


def read_rows(path: PathLike, columns: Sequence[str]) -> list[dict[str, str]]:
    """The table's rows; none where there is no file. A last row that a kill cut off does not count.

    Raises:
      ValueError: the columns are others.
    """
    path = Path(path)
    if not path.exists():
        return []
    with reading(path):
        text = _whole_lines(path.read_bytes()).decode()
        table = csv.DictReader(io.StringIO(text))
        rows = list(table)
        if text and table.fieldnames != list(columns):
            raise ValueError("line 1: its columns are not those of this version of jaxhf; name another folder")
        for row in rows:
            if None in row or None in row.values():
                raise ValueError(f"line {table.line_num}: a row must have {len(columns)} values")
        return rows


def append_row(path: PathLike, columns: Sequence[str], row: Mapping[str, str]) -> None:
    """Adds one row, which is on the disk when this returns; what a kill left of an earlier one is cut off."""
    path = Path(path)
    with path.open("a+b") as file:
        file.seek(0)
        size = len(_whole_lines(file.read()))
        file.truncate(size)
        text = io.StringIO()
        table = csv.DictWriter(text, columns, lineterminator="\n")
        if size == 0:
            table.writeheader()
        table.writerow(row)
        file.write(text.getvalue().encode())
        file.flush()
        os.fsync(file.fileno())


def _whole_lines(content: bytes) -> bytes:
    return content[: content.rfind(b"\n") + 1]


def save_reference(path: PathLike, identity: str, arrays: Mapping[str, np.ndarray]) -> None:
    with replacing(Path(path)) as temporary, temporary.open("wb") as file:
        everything: dict[str, Any] = {"identity": np.array(identity), **arrays}
        np.savez(file, **everything)


def known_reference(path: PathLike, identity: str) -> dict[str, np.ndarray]:
    """As `load_reference`; nothing where there is no file, or one that is damaged or of something else."""
    try:
        return load_reference(path, identity)
    except (FileNotFoundError, ValueError):
        return {}


def load_reference(path: PathLike, identity: str) -> dict[str, np.ndarray]:
    """The arrays; FileNotFoundError where there is no file, ValueError where it is damaged or of something else."""
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"{path}: there is no such file")
    with reading(path):
        with path.open("rb") as file, np.load(file) as data:
            arrays = {name: data[name] for name in data.files}
        if str(arrays.pop("identity", "")) != identity:
            raise ValueError("this reference is of another scene, size or version of jaxhf")
        return arrays
