"""Checks on the tables of a TOML scene; each of them ends with the line on which things went wrong."""

import difflib
import tomllib
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

from ....core.errors import ArgumentError, UserError
from ...errors import SceneError, nearest, resolve_inside
from .tables import Keys

Where = tuple[str | int, ...]  # the way to a value: ("objects", 0, "heights")


class Part(NamedTuple):
    """A table of the file `path`, which holds `text`, and where in it the table stands."""

    path: Path
    text: str
    where: Where
    table: dict[str, Any]

    def at(self, *steps: str | int) -> "Part":
        """What stands in this table under `steps`; what is missing there, or is no table, is an empty one."""
        depth, inner = _follow(self.table, steps)
        is_table = depth == len(steps) and isinstance(inner, dict)
        return self._replace(where=(*self.where, *steps), table=inner if is_table else {})

    def all(self, name: str) -> list["Part"]:
        """The tables in the list `name`; none where it is missing."""
        return [self.at(name, k) for k in range(len(self.table.get(name, ())))]

    @property
    def name(self) -> str:
        """("objects", 0, "dx") as a reader of the file says it: objects[0].dx."""
        return "".join(f"[{step}]" if isinstance(step, int) else f".{step}" for step in self.where).lstrip(".")

    def error(self, message: str) -> SceneError:
        """An error on the line of this part, or of the nearest one around it."""
        return SceneError(self.path, line_of(self.text, self.where), message)

    def must(self, rule: str) -> SceneError:
        """The same by its name, and what it must be or have."""
        return self.error(f"{self.name} must {rule}")

    def read(self, keys: Keys) -> dict[str, Any]:
        """The values of those `keys` that are there, by their kinds; SceneError on any other key, and where one is needed."""
        self.require_known(keys)
        values = {}
        for name, key in keys.items():
            if name in self.table:
                try:
                    values[name] = key.kind(self.table[name])
                except (ValueError, OverflowError) as error:
                    shown = repr(self.table[name])
                    shown = shown if len(shown) <= 60 else f"{shown[:57]}..."
                    raise self.at(name).must(f"be {error}, it is {shown}") from error
            elif key.needed:
                raise self.error(f"{self.name or 'a scene'} must have {name!r}, it is missing")
        return values

    def require_known(self, known: Iterable[str]) -> None:
        for name in self.table:
            if name not in known:
                inside = f" in {self.name}" if self.where else ""
                raise self.at(name).error(f"unknown key {name!r}{inside}; {nearest(name, known)}")

    def choice(self, name: str, options: Iterable[str], default: str | None = None) -> str:
        """The value of the key `name`: one of `options`. Where it is missing, a key that resembles it is taken for a slip."""
        value = self.table.get(name, default)
        if value is None:
            for meant in difflib.get_close_matches(name, self.table, n=1):
                self._replace(table={meant: None}).require_known((name,))
            raise self.must(f"have {name!r}, one of {', '.join(options)}; it is missing")
        if value not in tuple(options):
            close = difflib.get_close_matches(str(value), tuple(options), n=1, cutoff=0.5)
            tail = "".join(f"; did you mean {meant!r}?" for meant in close)
            raise self.at(name).must(f"be one of {', '.join(options)}; it is {value!r}{tail}")
        return value

    def one_of(self, names: Iterable[str], others: Iterable[str]) -> str:
        """Which of `names` the table has: exactly one. Where it has none, a key outside `others` is taken for a slip of it."""
        present = [name for name in names if name in self.table]
        if not present:
            self.require_known({*names, *others})
        if len(present) != 1:
            has = f"it has {' and '.join(present)}" if present else "it has none"
            raise self.at(*present[1:2]).error(f"{self.name} must have exactly one of {', '.join(names)}; {has}")
        return present[0]

    def at_most_one(self, first: str, second: str) -> str | None:
        """Which of two keys the table has; None: neither."""
        present = [name for name in (first, second) if name in self.table]
        if len(present) > 1:
            raise self.at(second).error(f"{self.name} must have {first} or {second}, it has both")
        return present[0] if present else None

    def file(self, key: str, reader: Callable[[Path], Any]) -> Any:
        """What `reader` makes of the file whose name is the value of `key`."""
        folder = self.path.parent
        return self.at(key).made(lambda: reader(resolve_inside(folder, folder, self.table[key])))

    def made(self, function: Callable[..., Any], *args: Any, **values: Any) -> Any:
        """function(*args, **values); what the user got wrong becomes a SceneError, on the line of the key that is to blame."""
        try:
            return function(*args, **values)
        except SceneError:
            raise
        except (UserError, FileNotFoundError) as error:
            if isinstance(error, ArgumentError) and error.argument in self.table:
                place = self.at(error.argument)
                raise place.error(f"{place.name} {error.rule}") from error
            message = str(error)
            raise self.error(
                f"{self.name}: {message}" if self.where and not message.startswith(self.name) else message
            ) from error


def line_of(text: str, where: Where) -> int | None:
    """The line behind the longest beginning of the file that is TOML without the value of `where`, or the nearest table around
    it; None: that is the whole file."""
    lines, begin, deepest, found = text.split("\n"), 1, 0, None
    for end, line in enumerate(lines, 1):
        if line.rstrip().endswith(",") and "#" not in line:  # the row of an array, of which there may be many
            continue
        try:
            depth, _ = _follow(tomllib.loads("\n".join(lines[:end])), where)
        except tomllib.TOMLDecodeError:  # inside a value of several lines
            continue
        if depth > deepest:
            deepest, found = depth, begin
        if depth == len(where):
            break
        begin = end + 1
    return found


def _follow(content: Any, where: Where) -> tuple[int, Any]:
    """How many steps of the way there are, and what stands behind them."""
    for depth, step in enumerate(where):
        try:
            content = content[step]
        except (KeyError, IndexError, TypeError):
            return depth, content
    return len(where), content
