"""On which line a table or a key of a TOML file stands, which tomllib does not tell."""

import tomllib
from typing import Any

Where = tuple[str | int, ...]  # the way to a value: ("objects", 0, "heights")


def line_of(text: str, where: Where) -> int | None:
    """The line behind the longest beginning of the file that is TOML without the value of `where`, or the nearest table around
    it; None: that is the whole file."""
    lines, begin, deepest, found = text.split("\n"), 1, 0, None
    for end, line in enumerate(lines, 1):
        if line.rstrip().endswith(",") and "#" not in line:  # the row of an array, of which there may be many
            continue
        try:
            depth, _ = follow(tomllib.loads("\n".join(lines[:end])), where)
        except tomllib.TOMLDecodeError:  # inside a value of several lines
            continue
        if depth > deepest:
            deepest, found = depth, begin
        if depth == len(where):
            break
        begin = end + 1
    return found


def follow(content: Any, where: Where) -> tuple[int, Any]:
    """How many steps of the way there are, and what stands behind them."""
    for depth, step in enumerate(where):
        try:
            content = content[step]
        except (KeyError, IndexError, TypeError):
            return depth, content
    return len(where), content
