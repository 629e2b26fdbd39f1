"""The table of a sweep: a row for each configuration that was measured, from which the same command goes on."""

import csv
import dataclasses
import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..core.settings import Settings
from ..io.files import reading, save_text

SETTINGS = tuple(field.name for field in dataclasses.fields(Settings))
KNOBS = ("precision", *SETTINGS)
FIGURES = (
    "seconds", "fastest", "cpu_seconds", "against_base", "compile_seconds", "peak_mb",
    "rmse", "p999", "wrong_hits", "cosine", "relative_error", "spread",
)  # fmt: skip
COLUMNS = ("identity", "task", *KNOBS, *FIGURES)
ERRORS = {"picture": "rmse", "derivative": "relative_error"}
"""What a task's "error" is, where one number must do."""

Row = dict[str, Any]
"""A configuration, which one process measures: its "task" and its knobs; once measured, its "error" and figures besides.

The task is a "picture" or a "derivative": value and gradient of a loss.
"""


def changes(row: Row, base: Row) -> dict[str, Any]:
    """The knobs in which a configuration differs from the base."""
    return {knob: row[knob] for knob in KNOBS if row[knob] != base[knob]}


def in_words(row: Row, base: Row) -> str:
    return ", ".join(f"{knob} {value}" for knob, value in changes(row, base).items()) or "the base"


@dataclasses.dataclass(frozen=True)
class Sweep:
    """What is to be measured of one scene, the base first, against what, and where it is kept.

    Its identity is a digest of all that a figure depends on but the machine: the scene, its size, jaxhf's and JAX's version.
    """

    path: Path
    folder: Path
    width: int
    height: int
    devices: int
    identity: str
    configurations: list[Row]
    references: list[Row]

    @property
    def table(self) -> Path:
        return self.folder / "tradeoff.csv"

    def reference(self, task: str) -> Path:
        return self.folder / f"{task}-{self.identity}.npz"

    def measured(self) -> list[Row]:
        """What the table holds of this sweep, in its order; seconds are the ratio to the base in turn times the base's own."""
        rows = {_key(row): row for row in read_rows(self.table) if row["identity"] == self.identity}
        found, base = [], rows.get(_key(self.configurations[0]))
        for one in self.configurations:
            if row := rows.get(_key(one)):
                figures = {name: float(row[name]) for name in FIGURES if row[name]}
                if base:
                    figures["seconds"] = figures["against_base"] * float(base["seconds"])
                found.append(one | figures | {"error": figures.get(ERRORS[one["task"]])})
        return found

    def missing(self) -> list[Row]:
        """What is still to be measured."""
        there = [_key(row) for row in self.measured()]
        return [one for one in self.configurations if _key(one) not in there]

    def add(self, one: Row, figures: Mapping[str, float]) -> None:
        """Adds a row to the table, whole or not at all."""
        knobs = {name: str(value) for name, value in one.items()}  # of None the csv module would write nothing
        row = {"identity": self.identity, **knobs} | {name: f"{value:.9g}" for name, value in figures.items()}
        text = io.StringIO()
        table = csv.DictWriter(text, COLUMNS, lineterminator="\n")
        table.writeheader()
        table.writerows([*read_rows(self.table), row])
        save_text(self.table, text.getvalue())


def _key(row: Mapping[str, Any]) -> tuple[str, ...]:
    """Task and knobs as they stand in the table."""
    return tuple(str(row[name]) for name in ("task", *KNOBS))


def read_rows(path: Path) -> list[dict[str, str]]:
    """The table's rows; none where there is no file. ValueError where the columns are others."""
    if not path.exists():
        return []
    with reading(path):
        table = csv.DictReader(path.read_text().splitlines())
        rows = list(table)
        if table.fieldnames != list(COLUMNS):
            raise ValueError("line 1: its columns are not those of this version of jaxhf; name another folder")
        for line, row in enumerate(rows, 2):
            if None in row or None in row.values():
                raise ValueError(f"line {line}: a row must have {len(COLUMNS)} values")
        return rows
