"""The text of a .pbrt file as statements and typed parameters, each with the line on which it stands.

A bracket with everything in it is one token, so that a million heights cost one regular expression match and one
conversion by NumPy. The repetitions in the patterns are possessive (`*+`): without that an unclosed bracket would be tried
again from every number in it.
"""

import math
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from ...core.errors import UserError
from ..errors import SceneError, nearest

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
        line = self.line
        if k is not None and self.kind == "block":
            words = re.finditer(r"\S+", _body(self))
            line = self._line_at(next(match.start() for i, match in enumerate(words) if i == k))
        return SceneError(self.path, line, message)

    def name(self) -> str:
        """What a string holds between its quotes."""
        if "\\" in self.text:
            raise self.error(f"a string must not contain a backslash (pbrt's escapes are not supported), it is {self}")
        return self.text[1:-1]

    def values(self) -> Float[np.ndarray, " n"] | tuple[str, ...]:
        """The numbers or the strings of a value, whether in brackets or alone."""
        if self.kind == "string":
            return (self.name(),)
        body = _body(self)
        return self._strings(body) if '"' in body else self._numbers(body)

    def _strings(self, body: str) -> tuple[str, ...]:
        if _STRING_OR_COMMENT.sub("", body).strip():
            raise self.error(f"a bracket holds numbers or strings, this one holds both: {self}")
        return tuple(Token("string", text, self.path, self.line).name() for text in re.findall(r'"[^"\n]*"', body))

    def _numbers(self, body: str) -> Float[np.ndarray, " n"]:
        match = _NUMBERS.match(body)
        end = match.end() if match else 0
        if end < len(body):
            word = body[end : end + 60].split()[0]
            raise SceneError(self.path, self._line_at(end), f"{word!r} in the bracket of line {self.line} is not a number")
        return np.array(body.split(), dtype=np.float64)

    def _line_at(self, offset: int) -> int:
        return self.line + _body(self).count("\n", 0, offset)


def _body(token: Token) -> str:
    """What stands inside the brackets, without comments; its lines are counted from that of the bracket."""
    if token.kind != "block":
        return token.text
    body = token.text[1:-1]
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


@dataclass(frozen=True)
class Statement:
    """A directive and all that stands before the next one."""

    word: Token
    rest: tuple[Token, ...]

    def numbers(self, n: int) -> list[float]:
        """The n bare numbers that follow the directive, and nothing else."""
        tokens = self._exactly(n, "number", f"{n} numbers")
        values = [float(token.text) for token in tokens]
        for token, value in zip(tokens, values, strict=True):
            if not math.isfinite(value):
                raise token.error(f"{self.word} takes finite numbers, found {token}")
        return values

    def strings(self, n: int) -> tuple[Token, ...]:
        """The n strings that follow the directive, and nothing else."""
        return self._exactly(n, "string", "a name in quotes" if n else "nothing")

    def matrix(self) -> Float[np.ndarray, "4 4"]:
        """The 16 numbers in brackets that follow the directive, column by column as pbrt writes them."""
        (token,) = self._exactly(1, "block", "16 numbers in brackets")
        values = token.values()
        if isinstance(values, tuple) or len(values) != 16:
            raise token.error(f"{self.word} takes 16 numbers, found {_counted(values)}")
        return values.reshape(4, 4).T

    def string(self, k: int) -> Token:
        """The k-th token, which has to be a string; parameters may follow."""
        if k >= len(self.rest) or self.rest[k].kind != "string":
            place = self.rest[k] if k < len(self.rest) else self.word
            found = str(self.rest[k]) if k < len(self.rest) else "nothing"
            raise place.error(f"{self.word} takes a name in quotes here, found {found}")
        return self.rest[k]

    def _exactly(self, n: int, kind: Literal["number", "string", "block"], what: str) -> tuple[Token, ...]:
        for k, token in enumerate(self.rest):
            if k >= n or token.kind != kind:
                raise token.error(f"{self.word} takes {what}, found {token}")
        if len(self.rest) < n:
            raise self.word.error(f"{self.word} takes {what}, found {len(self.rest)}")
        return self.rest


def statements(path: Path, text: str) -> Iterator[Statement]:
    """Splits `text` at its directives, known or not."""
    word, rest = None, []
    for token in tokenize(path, text):
        if token.kind != "word":
            if word is None:
                raise token.error(f"a directive must come first, found {token}")
            rest.append(token)
            continue
        if word is not None:
            yield Statement(word, tuple(rest))
        word, rest = token, []
    if word is not None:
        yield Statement(word, tuple(rest))


@dataclass(frozen=True)
class Parameter:
    """What a parameter is when it is not given; `required`: it has to be; `many`: it takes any number of values."""

    default: Any = None
    required: bool = False
    many: bool = False


Parameters = Mapping[str, Parameter]  # keys as in the file, "float fov"


@dataclass(frozen=True)
class Arguments:
    """The parameters of one statement: `values` of all that there are, the `tokens` of those that were given."""

    word: Token
    kind: str
    values: Mapping[str, Any]
    tokens: Mapping[str, Token]

    def __getitem__(self, declared: str) -> Any:
        return self.values[declared]

    def error(self, declared: str, message: str, k: int | None = None) -> SceneError:
        """An error where that parameter's value stands, else at the directive."""
        return self.tokens.get(declared, self.word).error(message, k)

    def require(self, declared: str, valid: bool, rule: str) -> None:
        if not valid:
            raise self.error(declared, f"{declared.split()[1]} must {rule}, it is {self.values[declared]}")

    def colour(self, declared: str) -> Any:
        """Of a light or a surface: SceneError where it is negative."""
        self.require(declared, bool(np.all(self[declared] >= 0)), "be 0 or more")
        return self[declared]


def read_arguments(statement: Statement, kinds: Mapping[str, Parameters], at: int = 0) -> Arguments:
    """The kind of a `Shape "kind" "type name" value ...` and its parameters; `at`: how many strings precede the kind."""
    word, kind = statement.word, statement.string(at)
    table = kinds.get(kind.name())
    if table is None:
        raise kind.error(f"unknown {word} {kind}; {nearest(kind.name()[:60], kinds)}")
    values = {declared: parameter.default for declared, parameter in table.items()}
    tokens: dict[str, Token] = {}
    pairs = statement.rest[at + 1 :]
    for k in range(0, len(pairs), 2):
        declared = _declared(f"{word} {kind}", pairs[k], table)
        if declared in tokens:
            raise pairs[k].error(f"{declared!r} is given twice")
        if k + 1 == len(pairs):
            raise pairs[k].error(f"{declared!r} has no value")
        tokens[declared] = pairs[k + 1]
        values[declared] = _value(declared, pairs[k + 1], table[declared].many)
    for declared, parameter in table.items():
        if parameter.required and declared not in tokens:
            raise word.error(f"{word} {kind} must have a parameter {declared!r}")
    return Arguments(word, kind.name(), values, tokens)


def _declared(place: str, token: Token, table: Parameters) -> str:
    """The key in `table` that `token` declares."""
    if token.kind != "string":
        raise token.error(f"{place} takes a parameter such as {next(iter(table))!r} here, found {token}")
    declared = " ".join(token.name().split())
    if declared in table:
        return declared
    same_name = [known for known in table if known.split()[1] == declared.split()[-1]] if declared else []
    if same_name:
        raise token.error(f"{place} takes {' or '.join(map(repr, same_name))}, not {declared!r}")
    raise token.error(f"unknown parameter {declared!r} of {place}; {nearest(declared[:60], table)}")


_COUNTS = {"integer": 1, "float": 1, "color": 3, "point": 3, "string": 1, "texture": 1, "bool": 1}
_TEXT = ("string", "texture", "bool")


def _value(declared: str, token: Token, many: bool) -> Any:
    kind = declared.split()[0]
    values, count = token.values(), _COUNTS[kind]
    is_text = isinstance(values, tuple)
    if is_text != (kind in _TEXT) or not (many or len(values) == count):
        wanted = f"{'' if many else count} {'string' if kind in _TEXT else 'number'}{'' if count == 1 and not many else 's'}"
        raise token.error(f"{declared!r} takes {wanted.strip()}, found {_counted(values)}")
    if kind == "bool" and values[0] not in ("true", "false"):
        raise token.error(f'{declared!r} must be "true" or "false", it is {values[0]!r}')
    if isinstance(values, tuple):
        return values[0] == "true" if kind == "bool" else values[0]
    if many:
        return values
    return _numeric(declared, token, kind, values)


def _numeric(declared: str, token: Token, kind: str, values: Float[np.ndarray, " n"]) -> Any:
    if not np.isfinite(values).all():
        raise token.error(f"{declared!r} must be finite, it is {token}")
    if kind == "integer" and not values[0].is_integer():
        raise token.error(f"{declared!r} must be a whole number, it is {values[0]}")
    if len(values) > 1:
        return values
    return int(values[0]) if kind == "integer" else float(values[0])


def _counted(values: Float[np.ndarray, " n"] | tuple[str, ...]) -> str:
    kind = "string" if isinstance(values, tuple) else "number"
    return f"{len(values)} {kind if len(values) == 1 else kind + 's'}"
