"""The tokens of a .pbrt file as directives with what they take: numbers, a name, or a kind and its typed parameters.

Which kinds and parameters there are stands in `KINDS`.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from ...errors import SceneError, nearest
from .tokens import Token, Values, tokenize

Parameters = Mapping[str, Any]  # the defaults of a kind's parameters by their declarations, "float fov"; ...: must be given
Rule = tuple[Callable[[Any], bool], str]  # whether a value is allowed, and what it must be

_ORIGIN, _WHITE = np.zeros(3), np.ones(3)
# Every kind and parameter that is understood, with pbrt-v2's defaults. Depth 5 counts the camera ray: at most four mirrors.
KINDS: Mapping[str, Mapping[str, Parameters]] = {
    "Film": {"image": {"string filename": "pbrt.exr", "integer xresolution": 640, "integer yresolution": 480}},
    "Sampler": {
        "bestcandidate": {"integer pixelsamples": 4},
        "stratified": {"integer xsamples": 2, "integer ysamples": 2, "bool jitter": True},
    },
    "PixelFilter": {"box": {"float xwidth": 0.5, "float ywidth": 0.5}},
    "SurfaceIntegrator": {"directlighting": {"integer maxdepth": 5}, "whitted": {"integer maxdepth": 5}},
    "Camera": {"perspective": {"float fov": 90.0}},
    "LightSource": {
        "point": {"color I": _WHITE, "color scale": _WHITE, "point from": _ORIGIN},
        "distant": {"color L": _WHITE, "color scale": _WHITE, "point from": _ORIGIN, "point to": np.array([0.0, 0, 1])},
    },
    "Texture": {"imagemap": {"string filename": ...}},
    "Material": {
        "matte": {"color Kd": 0.5 * _WHITE, "texture Kd": None, "float sigma": 0.0},
        "mirror": {"color Kr": 0.9 * _WHITE},
    },
    "Shape": {
        "heightfield": {"integer nu": ..., "integer nv": ..., "float Pz": ...},
        "cylinder": {"float radius": 1.0, "float zmin": -1.0, "float zmax": 1.0, "float phimax": 360.0},
    },
}
_LEAST_ONE: Rule = (lambda count: count >= 1, "be at least 1")
_RULES: Mapping[str, Rule] = {
    **dict.fromkeys(("integer xresolution", "integer yresolution", "integer pixelsamples", "integer xsamples"), _LEAST_ONE),
    **dict.fromkeys(("integer nu", "integer nv"), (lambda count: count >= 2, "be at least 2")),
    **dict.fromkeys(("float xwidth", "float ywidth"), (lambda width: width == 0.5, "be 0.5")),
    **dict.fromkeys(("color I", "color L", "color scale", "color Kd", "color Kr"), (lambda c: min(c) >= 0, "be 0 or more")),
    "integer maxdepth": (lambda depth: depth == 5, "be 5"),
    "float fov": (lambda fov: 0 < fov < 180, "lie between 0 and 180 degrees"),
    "float sigma": (lambda sigma: 0 <= sigma <= 90, "be 0 to 90 degrees"),
    "float phimax": (lambda phi: phi == 360, "be 360 (parts of a circle are not supported)"),
}
_COUNTS = {"color": 3, "point": 3, "float Pz": None}  # of values, by type or declaration: else one; None: any number


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


@dataclass(frozen=True)
class Statement:
    """A directive and all that stands before the next one."""

    word: Token
    rest: tuple[Token, ...]

    def nothing(self) -> Token:
        """The directive itself, behind which nothing may stand."""
        self._exactly(0, "string", "nothing")
        return self.word

    def name(self) -> Token:
        """The string that follows the directive, and nothing else."""
        return self._exactly(1, "string", "a name in quotes")[0]

    def numbers(self, n: int) -> list[float]:
        """The n bare numbers that follow the directive, and nothing else."""
        for token in self._exactly(n, "number", f"{n} numbers"):
            if not np.isfinite(float(token.text)):
                raise token.error(f"{self.word} takes finite numbers, found {token}")
        return [float(token.text) for token in self.rest]

    def matrix(self) -> Float[np.ndarray, "4 4"]:
        """The 16 numbers in brackets that follow the directive, column by column as pbrt writes them."""
        (token,) = self._exactly(1, "block", "16 numbers in brackets")
        values = token.values()
        if isinstance(values, tuple) or len(values) != 16:
            raise token.error(f"{self.word} takes 16 numbers, found {_counted(values)}")
        return values.reshape(4, 4).T

    def string(self, k: int) -> Token:
        """The k-th token, which has to be a string; parameters may follow."""
        place, found = (self.rest[k], str(self.rest[k])) if k < len(self.rest) else (self.word, "nothing")
        if place.kind != "string":
            raise place.error(f"{self.word} takes a name in quotes here, found {found}")
        return place

    def _exactly(self, n: int, kind: Literal["number", "string", "block"], what: str) -> tuple[Token, ...]:
        for k, token in enumerate(self.rest):
            if k >= n or token.kind != kind:
                raise token.error(f"{self.word} takes {what}, found {token}")
        if len(self.rest) < n:
            raise self.word.error(f"{self.word} takes {what}, found {len(self.rest)}")
        return self.rest

    def arguments(self, at: int = 0) -> Arguments:
        """The kind of a `Shape "kind" "type name" value ...` and its parameters; `at`: how many strings precede the kind."""
        word, kind = self.word, self.string(at)
        kinds = KINDS[word.text]
        defaults = kinds.get(kind.name())
        if defaults is None:
            raise kind.error(f"unknown {word} {kind}; {nearest(kind.name()[:60], kinds)}")
        values = dict(defaults)
        tokens: dict[str, Token] = {}
        pairs = self.rest[at + 1 :]
        for k in range(0, len(pairs), 2):
            declared = _declared(f"{word} {kind}", pairs[k], defaults)
            if declared in tokens:
                raise pairs[k].error(f"{declared!r} is given twice")
            if k + 1 == len(pairs):
                raise pairs[k].error(f"{declared!r} has no value")
            tokens[declared] = pairs[k + 1]
            values[declared] = _value(declared, pairs[k + 1])
        for declared, value in values.items():
            if value is ...:
                raise word.error(f"{word} {kind} must have a parameter {declared!r}")
        return Arguments(word, kind.name(), values, tokens)


def statements(path: Path, text: str) -> Iterator[Statement]:
    """Splits `text` at its directives, known or not."""
    found: list[Token] = []
    for token in tokenize(path, text):
        if token.kind == "word" and found:
            yield Statement(found[0], tuple(found[1:]))
            found = []
        elif token.kind != "word" and not found:
            raise token.error(f"a directive must come first, found {token}")
        found.append(token)
    if found:
        yield Statement(found[0], tuple(found[1:]))


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


def _value(declared: str, token: Token) -> Any:
    """The value of a parameter: one of Python's, an array where it has three numbers or more, or a string."""
    kind = declared.split()[0]
    values, is_text = token.values(), kind in ("string", "texture", "bool")
    count = _COUNTS.get(declared, _COUNTS.get(kind, 1))
    if isinstance(values, tuple) != is_text or count not in (None, len(values)):
        raise token.error(f"{declared!r} takes {_amount(count, is_text)}, found {_counted(values)}")
    if isinstance(values, tuple):
        if kind == "bool" and values[0] not in ("true", "false"):
            raise token.error(f'{declared!r} must be "true" or "false", it is {values[0]!r}')
        return values[0] == "true" if kind == "bool" else values[0]
    if count is None:
        return values
    if not np.isfinite(values).all():
        raise token.error(f"{declared!r} must be finite, it is {token}")
    if kind == "integer" and not values[0].is_integer():
        raise token.error(f"{declared!r} must be a whole number, it is {values[0]}")
    value = values if count > 1 else int(values[0]) if kind == "integer" else float(values[0])
    holds, rule = _RULES.get(declared, (None, ""))
    if holds is not None and not holds(value):
        raise token.error(f"{declared.split()[1]} must {rule}, it is {value}")
    return value


def _amount(count: int | None, is_text: bool) -> str:
    noun = ("string" if is_text else "number") + ("" if count == 1 else "s")
    return noun if count is None else f"{count} {noun}"


def _counted(values: Values) -> str:
    return _amount(len(values), isinstance(values, tuple))
