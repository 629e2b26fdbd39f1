"""The text of a .pbrt file as tokens, each with the line on which it begins.

A bracket with everything in it is one token, so that a million heights cost one regular expression match and one
conversion by NumPy. The repetitions in the patterns are possessive (`*+`): without that an unclosed bracket would be tried
again from every number in it.
"""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ....core.errors import UserError
from ...errors import SceneError

Values = Float[np.ndarray, " n"] | tuple[str, ...]

_NUMBER = r"[-+]?(?:[0-9]++(?:\.[0-9]*+)?|\.[0-9]++)(?:[eE][-+]?[0-9]++)?"
_INSIDE = r'(?:[^]["#]++|\#[^\n]*+|"[^"\n]*+")*+'
_TOKEN = re.compile(
    rf"""
    (?:\s++ | \#[^\n]*+)
    | (?P<string> "[^"\n]*+")
    | (?P<block> \[{_INSIDE}\])
    | (?P<number> {_NUMBER}(?![^\s"\[\]\#]))
    | (?P<word> [^\s"\[\]\#]++)
    """,
    re.VERBOSE,
)
_OPEN_BLOCK = re.compile(rf"\[{_INSIDE}")
_STRING_OR_COMMENT = re.compile(r'("[^"\n]*")|#[^\n]*')
# pbrt has no nan and no inf; they are let in here to be refused with their index later.
_NUMBERS = re.compile(rf"(?:\s*+(?:{_NUMBER}|[-+]?(?:nan|inf))(?!\S))*+\s*+")


@dataclass(frozen=True)
class Token:
    """`text` as it stands in the file: a string with its quotes, a block with its brackets; `line` is where it begins."""

    kind: str
    text: str
    path: Path
    line: int

    def __str__(self) -> str:
        shown = " ".join(self.text[:60].split())
        return shown if len(self.text) <= 60 else f"{shown} ..."

    def error(self, message: str, k: int | None = None) -> SceneError:
        """An error on the line where this token begins, or on that of the k-th number inside a block."""
        at = 0 if k is None else [match.start() for match in re.finditer(r"\S+", self._body)][k]
        return SceneError(self.path, self.line + self._body.count("\n", 0, at), message)

    def name(self) -> str:
        """What a string holds between its quotes."""
        return str(self.values()[0])

    def values(self) -> Values:
        """The numbers or the strings of a value, whether in brackets or alone."""
        body = self._body
        if '"' in body:
            if _STRING_OR_COMMENT.sub("", body).strip():
                raise self.error(f"a bracket holds numbers or strings, this one holds both: {self}")
            if "\\" in body:
                raise self.error(f"a string must not contain a backslash (pbrt's escapes are not supported), it is {self}")
            return tuple(re.findall(r'"([^"\n]*)"', body))
        match = _NUMBERS.match(body)
        end = match.end() if match else 0
        if end < len(body):
            word = body[end : end + 60].split()[0]
            raise self.error(f"{word!r} in the bracket of line {self.line} is not a number", len(body[:end].split()))
        return np.array(body.split(), dtype=np.float64)

    @property
    def _body(self) -> str:
        """What stands inside the brackets, without comments; its lines are counted from that of the bracket."""
        if self.kind != "block":
            return self.text
        body = self.text[1:-1]
        return _STRING_OR_COMMENT.sub(r"\1", body) if "#" in body else body


@contextmanager
def located(token: Token) -> Iterator[None]:
    """Puts the token's file and line before the errors of constructors and of other readers."""
    try:
        yield
    except SceneError:
        raise
    except (UserError, OSError) as error:
        raise token.error(str(error)) from error


def tokenize(path: Path, text: str) -> Iterator[Token]:
    """The tokens of `text`, lines counted from 1; SceneError where a string or a bracket is not closed."""
    at, line = 0, 1
    while at < len(text):
        match = _TOKEN.match(text, at)
        if match is None:
            raise _unclosed(path, text, at, line)
        if match.lastgroup is not None:
            yield Token(match.lastgroup, match.group(), path, line)
        line += text.count("\n", at, match.end())
        at = match.end()


def _unclosed(path: Path, text: str, at: int, line: int) -> SceneError:
    match = _OPEN_BLOCK.match(text, at)
    if match and text[match.end() : match.end() + 1] == '"':  # the bracket goes wrong at a string inside it
        line += text.count("\n", at, match.end())
        at = match.end()
    message = {'"': "this string is not closed on its line", "[": "this bracket is not closed"}
    return SceneError(path, line, message.get(text[at], f"there is no '[' before this {text[at]!r}"))
