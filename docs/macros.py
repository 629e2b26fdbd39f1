"""Macros of the pages: measurements as tables and in prose, notebooks as they were run, commands with their help.

A figure in prose is that of a file of measurements/, found by words that stand in its row and by the name of its column:

    a scan is {{ figure("robots-speed", "`height_scan`", "times mj_ray (one thread)") }} times as fast
"""

import csv
import json
import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).parent / "measurements"
Words = str | Sequence[str]  # that stand in a row


def _read(name: str) -> tuple[str, list[str], list[list[str]]]:
    """The command that made a file of measurements/, its first line `# command`; the names of its columns; its rows."""
    command, *lines = (FOLDER / f"{name}.csv").read_text().splitlines()
    head, *rows = csv.reader(lines)
    return command.removeprefix("# "), head, rows


def measured(name: str) -> str:
    """A table from measurements/, under the command that makes it."""
    command, names, body = _read(name)
    head, *rows = ([cell.replace("|", "\\|") for cell in row] for row in (names, *body))
    rule = ["--:" if k and rows[0][k][:1].isdigit() else "---" for k in range(len(head))]
    lines = "\n".join("| " + " | ".join(row) + " |" for row in (head, rule, *rows))
    return f"`{command}` ([{name}.csv]({name}.csv))\n\n{lines}\n"


def _cells(name: str, row: Words, column: str | None = None) -> list[str]:
    """The cells of a column, or the first ones, of the rows that hold all of these words.

    A word is a whole cell; where no row holds them as such, it may be a part of one, between commas. An empty first cell stands
    for the one above it.
    """
    _, head, rows = _read(name)
    if column is not None and head.count(column) != 1:
        raise ValueError(f"{name}.csv: {head.count(column)} columns are called {column!r} among {head}")
    words, place = {row} if isinstance(row, str) else set(row), 0 if column is None else head.index(column)
    whole, parts, first = [], [], ""
    for cells in rows:
        first = cells[0] or first
        if words <= {"", first, *cells}:
            whole.append(cells[place])
        if words <= {part for cell in (first, *cells) for part in cell.split(", ")}:
            parts.append(cells[place])
    if not (whole or parts):
        raise ValueError(f"{name}.csv: no row holds {row!r}")
    return whole or parts


def _leading(cell: str) -> str:
    """The number with which a cell begins, as it stands there: `10 000` and `4,319` too."""
    found = re.match(r"-?\d{1,3}(?:[ ,]\d{3})+(?!\d)|-?\d+(?:\.\d+)?(?:e[+-]\d+)?", cell)
    if found is None:
        raise ValueError(f"{cell!r} does not begin with a number")
    return found[0]


def _number(cell: str) -> float:
    return float(re.sub("[ ,]", "", _leading(cell)))


def _rounded(value: float, digits: int) -> str:
    return f"{float(f'{value:.{digits}g}'):.12g}"


def figure(name: str, row: Words, column: str, over: tuple[Words, str] | None = None, digits: int | None = None) -> str:
    """The cell of measurements/NAME.csv in the one row that holds these words, as it stands there.

    With `over`, the row and the column of another cell, how many times that is, to two digits; with `digits`, to so many.
    """
    cells = [_cells(name, *place) for place in ((row, column), over) if place is not None]
    if any(len(found) > 1 for found in cells):
        raise ValueError(f"{name}.csv: {cells} stand in rows that hold {row!r} or {over!r}")
    values = [_number(cell) for (cell,) in cells] if over or digits else []
    return _rounded(values[0] / (values[1] if over else 1), digits or 2) if values else cells[0][0]


def span(names: Words, column: str, row: Words = "", digits: int | None = None) -> str:
    """The least and the largest number of a column, `0.46 to 1.20`, in the rows that hold these words, of one file or more."""
    files = [names] if isinstance(names, str) else names
    cells = [cell for name in files for cell in _cells(name, row, column) if cell]
    ends = min(cells, key=_number), max(cells, key=_number)
    return " to ".join(_rounded(_number(cell), digits) if digits else _leading(cell) for cell in ends)


def count(name: str, row: Words = "") -> str:
    """How many rows hold these words; all of them without."""
    return str(len(_cells(name, row)))


def notebook(name: str) -> str:
    """A notebook with what it printed and its pictures; links to pages of docs/ lead to those of the site."""
    parts = []
    for cell in json.loads((FOLDER.parents[1] / "notebooks" / f"{name}.ipynb").read_text())["cells"]:
        text = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            parts.append(text.replace("](../docs/", "](../").replace(".ipynb)", ".md)"))
            continue
        parts.append(f"```python\n{text}\n```")
        printed = "".join("".join(output.get("text", "")) for output in cell["outputs"])
        pictures = (output.get("data", {}).get("image/png") for output in cell["outputs"])
        parts += [f'<img alt="" src="data:image/png;base64,{"".join(picture).strip()}">' for picture in pictures if picture]
        parts += [f"```text\n{printed.strip()}\n```"] if printed.strip() else []
    return "\n\n".join(parts)


def commands() -> str:
    """What each command's --help says, which its table of options holds."""
    from jaxhf.cli.parser import COMMANDS, parser_of

    os.environ["COLUMNS"] = "88"  # which argparse fills
    return "\n\n".join(f"## {name}\n\n```text\n{parser_of(command).format_help()}```" for name, command in COMMANDS.items())


def define_env(env: Any) -> None:
    """Called by the site's builder."""
    env.macro(measured)
    env.macro(figure)
    env.macro(span)
    env.macro(count)
    env.macro(notebook)
    env.macro(commands)
