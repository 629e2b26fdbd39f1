"""Colour files as gdaldem reads them: a colour for each height."""

import numpy as np

from ..errors import SceneError, nearest
from ..files import PathLike, reading, require_file

Colour = tuple[int, int, int, int]  # red, green, blue and opacity, 0 to 255

# GRASS's names, which gdaldem knows, with its colours.
_NAMED = {
    "white": (255, 255, 255),
    "black": (0, 0, 0),
    "red": (255, 0, 0),
    "green": (0, 255, 0),
    "blue": (0, 0, 255),
    "yellow": (255, 255, 0),
    "magenta": (255, 0, 255),
    "cyan": (0, 255, 255),
    "aqua": (0, 191, 191),
    "grey": (191, 191, 191),
    "gray": (191, 191, 191),
    "orange": (255, 127, 0),
    "brown": (191, 127, 63),
    "purple": (127, 0, 255),
    "violet": (127, 0, 255),
    "indigo": (0, 127, 255),
}


def load_colours(path: PathLike, low: float, high: float) -> tuple[list[tuple[float, Colour]], dict[str, Colour]]:
    """The heights in a colour file of gdaldem's with their colours, in its order, and the colours of `nv` and `default`.

    A line holds a height and red, green, blue (and opacity), or a colour's name. Numbers are separated by spaces, tabs, commas
    or colons; lines that begin with # or / are comments. For the height may stand a percentage (of the range `low` to `high`),
    `nv` (where there is no height) or `default` (no entry fits; GRASS).
    """
    path = require_file(path)
    with reading(path):
        lines = path.read_text(encoding="utf-8-sig", errors="replace").splitlines()
    entries: list[tuple[float, Colour]] = []
    special: dict[str, Colour] = {}
    for number, line in enumerate(lines, 1):
        words = line.translate(_SEPARATORS).split()
        if not words or words[0][0] in "#/":
            continue
        try:
            colour = _colour(words[1:])
            if words[0].lower() in ("nv", "default"):
                special[words[0].lower()] = colour
            else:
                entries.append((_height(words[0], low, high), colour))
        except ValueError as error:
            raise SceneError(path, number, str(error)) from error
    if not entries:
        raise SceneError(path, None, "a colour file must hold a height and its colour, it holds none")
    return entries, special


_SEPARATORS = str.maketrans(",\t:", "   ")


def _height(word: str, low: float, high: float) -> float:
    value = _number(word.removesuffix("%"), "a height, a percentage, nv or default")
    if not word.endswith("%"):
        return value
    if not 0 <= value <= 100:
        raise ValueError(f"a percentage must lie between 0 and 100, it is {word}")
    return low + value / 100 * (high - low)


def _colour(words: list[str]) -> Colour:
    if words and words[0][0].isalpha():
        if words[0].lower() not in _NAMED:
            raise ValueError(f"there is no colour {words[0]!r}; {nearest(words[0].lower(), _NAMED)}")
        parts = [*_NAMED[words[0].lower()], *(_byte(word) for word in words[1:2])]
    elif len(words) >= 3:
        parts = [_byte(word) for word in words[:4]]
    else:
        raise ValueError("a height must be followed by red, green and blue, or by a colour's name")
    red, green, blue, opacity = (*parts, 255)[:4]
    return red, green, blue, opacity


def _byte(word: str) -> int:
    value = _number(word, "a number from 0 to 255")
    if not 0 <= value <= 255:
        raise ValueError(f"a colour's parts must lie between 0 and 255, one is {word}")
    return int(value)


def _number(word: str, wanted: str) -> float:
    try:
        value = float(word)
    except ValueError:
        raise ValueError(f"there must be {wanted}, there is {word!r}") from None
    if not np.isfinite(value):
        raise ValueError(f"numbers must be finite, one is {word}")
    return value
