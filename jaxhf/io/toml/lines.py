"""On which line a table or a key of a TOML file stands, which tomllib does not tell.

What is read here has passed tomllib: it is valid TOML.
"""

import re
from collections.abc import Iterator

Where = tuple[str | int, ...]  # the way to a value: ("objects", 0, "heights")

_TOKEN = re.compile(
    r"""(?P<string>\"{3}(?:\\.|[^\\])*?\"{3,5}|'{3}.*?'{3,5}|"(?:\\.|[^"\\\n])*"|'[^'\n]*')"""
    r"""|(?P<comment>\#[^\n]*)|(?P<open>[\[{])|(?P<close>[\]}])|(?P<newline>\n)|(?P<other>[^\[\]{}\#"'\n]+)""",
    re.DOTALL,
)


def line_numbers(text: str) -> dict[Where, int]:
    """The line of every table, and of every key that is not inside an inline table."""
    lines: dict[Where, int] = {}
    counts: dict[Where, int] = {}  # of the elements of each [[array of tables]] so far
    here: Where = ()
    for line, statement in _statements(text):
        header = re.fullmatch(r"(\[\[?)(.*?)\]\]?", statement, re.DOTALL)
        names = _key_names(header[2] if header else statement)
        if not header:
            lines.setdefault((*here, *names), line)
            continue
        here = ()
        for k, name in enumerate(names, 1):
            here = (*here, name)
            if header[1] == "[[" and k == len(names):
                counts[here] = counts.get(here, 0) + 1
            lines.setdefault(here, line)
            if here in counts:
                here = (*here, counts[here] - 1)
        lines.setdefault(here, line)
    return lines


def _statements(text: str) -> Iterator[tuple[int, str]]:
    """Each header and each key with its value, comments removed, and the line on which it starts."""
    line, start, depth, statement = 1, 1, 0, ""
    for token in _TOKEN.finditer(text + "\n"):
        kind, found = token.lastgroup, token.group()
        if kind == "newline" and depth == 0:
            if statement.strip():
                yield start, statement.strip()
            start, statement = line + 1, ""
        elif kind != "comment":
            statement += found
        depth += (kind == "open") - (kind == "close")
        line += found.count("\n")


def _key_names(text: str) -> list[str]:
    """The parts of a dotted key at the beginning of `text`."""
    names, at = [], re.compile(r"""\s*(?:"([^"]*)"|'([^']*)'|([\w-]+))\s*(\.?)""")
    found = at.match(text)
    while found:
        names.append(next(part for part in found.groups()[:3] if part is not None))
        found = at.match(text, found.end()) if found[4] else None
    return names
