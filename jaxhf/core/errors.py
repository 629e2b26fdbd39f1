"""Errors that are not jaxhf's own: what a caller, or the author of a file, got wrong."""

from numbers import Integral
from types import UnionType
from typing import Any


class UserError(ValueError):
    """A mistake in an argument or a file. The command line shows it as one line; any other ValueError keeps its traceback."""


class ArgumentError(UserError):
    """A value that an argument cannot have: "Perspective: fov must lie between 0 and 180 degrees, it is 200.0".

    Attributes:
      argument: the argument's name as a caller writes it: "fov", "targets[2]".
      rule: what the message says after that name.
    """

    def __init__(self, owner: str, argument: str, rule: str):
        """
        Args:
          owner: the function or class whose argument it is, the first word of the message; "": none.
          argument, rule: the attributes. A rule that begins with a colon follows the name without a space.
        """
        place = f"{owner}: {argument}" if owner else argument
        super().__init__(f"{place}{rule}" if rule.startswith(":") else f"{place} {rule}")
        self.argument = argument
        self.rule = rule.removeprefix(": ")


def require_kind(
    owner: str, argument: str, value: Any, kind: type | UnionType | tuple[type, ...], wanted: str, hint: str = ""
) -> None:
    """ArgumentError where a value is not of this kind.

    Args:
      owner, argument: see `ArgumentError`.
      value, kind: as for `isinstance`.
      wanted: the kind in words, with its article.
      hint: what may be done instead, for the end of the message.
    """
    if not isinstance(value, kind):
        raise ArgumentError(owner, argument, f"must be {wanted}, it is {kind_of(value)}{hint and '; '}{hint}")


def require_progress(owner: str, progress: Any, traced: bool) -> None:
    """ArgumentError where an argument of this name is neither None nor a function, or where there is none to be seen."""
    if progress is not None and not callable(progress):
        raise ArgumentError(owner, "progress", f"must be a function of (done, in all), it is {progress!r}")
    if progress is not None and traced:
        raise ArgumentError(owner, "progress", "must be None within jit, grad, vmap and the like, where nothing is done yet")


def whole_number(value: Any) -> Any:
    """Any kind of whole number, NumPy's above all, as Python's; all else as it is, for who asked for one to judge."""
    return int(value) if isinstance(value, Integral) and not isinstance(value, bool) else value


def kind_of(value: Any) -> str:
    """The name of its type, with an article."""
    name = type(value).__name__
    return f"{'an' if name[0] in 'AEIOaeio' else 'a'} {name}"


def counted(number: int, noun: str) -> str:
    """1 hole, 2 holes."""
    return f"{number} {noun}{'s' * (number != 1)}"
