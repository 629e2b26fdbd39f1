"""Options as tables, what stands behind them on the command line, and what a command makes of them."""

import argparse
import contextlib
import dataclasses
import datetime
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from ..core.errors import UserError
from ..core.rules import OneOf, Rule, Whole
from ..core.settings import Settings

Option = tuple[tuple[str, ...], dict[str, Any]]
"""What argparse's `add_argument` takes: names, and keywords."""


def option(*names: str, **keywords: Any) -> Option:
    return names, keywords


def flag(name: str, help: str) -> Option:
    return option(name, action="store_true", help=help)


def number(name: str, metavar: str, help: str, default: float | None = None, rule: Rule | None = None, **more: Any) -> Option:
    return option(name, type=partial(_converted, real_number, rule), metavar=metavar, default=default, help=help, **more)


def whole(name: str, metavar: str, help: str, least: int | None = None, default: int | None = None) -> Option:
    rule = None if least is None else Whole(least)
    return option(name, type=partial(_converted, whole_number, rule), metavar=metavar, default=default, help=help)


def choice(name: str, names: Sequence[str], help: str, default: str | None = None) -> Option:
    kind = partial(_converted, str, OneOf(names))
    return option(name, type=kind, metavar=f"{{{','.join(names)}}}", default=default, help=help)


def _converted(convert: Callable[[str], Any], rule: Rule | None, text: str) -> Any:
    value = convert(text)
    if rule is not None and (wrong := rule(value)):
        raise argparse.ArgumentTypeError(wrong)
    return value


def real_number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"must be a number, it is {text!r}") from None


def whole_number(text: str) -> int:
    """Of what may be written as 1e6, too."""
    try:
        value = float(text)
        if value.is_integer():
            return int(value)
    except ValueError:
        pass
    raise argparse.ArgumentTypeError(f"must be a whole number, it is {text!r}")


def size(text: str) -> tuple[int, int]:
    try:
        width, height = (int(word) for word in text.lower().split("x"))
    except ValueError:
        raise argparse.ArgumentTypeError(f"must be two numbers of pixels, as 1280x800, it is {text!r}") from None
    if min(width, height) < 1:
        raise argparse.ArgumentTypeError(f"must be positive, it is {text}")
    return width, height


def sun(text: str) -> tuple[float, float] | datetime.datetime:
    """Azimuth and altitude, or a time with its offset from UTC."""
    with contextlib.suppress(ValueError):
        if "," in text:
            azimuth, altitude = text.split(",")
            return float(azimuth), float(altitude)
        return _time(text)
    rule = "must be an azimuth and an altitude, as 90,10, or a time with its offset from UTC, as 2026-06-21T07:00-05:00"
    raise argparse.ArgumentTypeError(f"{rule}; it is {text!r}")


def moment(text: str) -> datetime.date:
    """A date, or a `datetime` with its offset from UTC."""
    with contextlib.suppress(ValueError):
        return datetime.date.fromisoformat(text)
    with contextlib.suppress(ValueError):
        return _time(text)
    rule = "must be a date, as 2026-06-21, or a time with its offset from UTC, as 2026-06-21T07:00-05:00"
    raise argparse.ArgumentTypeError(f"{rule}; it is {text!r}")


def _time(text: str) -> datetime.datetime:
    """A time with its offset from UTC; ValueError of other text."""
    time = datetime.datetime.fromisoformat(text)
    if time.tzinfo is None:
        raise ValueError
    return time


def names(text: str) -> tuple[str, ...]:
    return tuple(name.strip() for name in text.split(","))


def knob(field: "dataclasses.Field[Any]") -> Option:
    """An option for a field of `Settings`; one that is not given is absent from what is parsed."""
    name, about = field.name.replace("_", "-"), field.metadata["help"]
    if field.type is bool:
        off, about = f"--no-{name}", f"leave out {about}"
        return option(off, dest=field.name, action="store_false", default=argparse.SUPPRESS, help=about)
    kind, metavar = (whole_number, "N") if isinstance(field.metadata["rule"], Whole) else (str, None)
    metavar, about = field.metadata.get("metavar", metavar), f"{about} [{field.metadata.get('none', field.default)}]"
    return option(f"--{name}", type=kind, metavar=metavar, default=argparse.SUPPRESS, help=about)


def settings(options: argparse.Namespace) -> Settings:
    return Settings(**{name: value for name, value in vars(options).items() if name in Settings.__dataclass_fields__})


def given(options: argparse.Namespace, *names: str) -> dict[str, Any]:
    """Those of these options that were given; where one was not, what takes them has a default of its own."""
    values = {name: getattr(options, name) for name in names}
    return {name: value for name, value in values.items() if value is not None and value is not False}


def reading(options: argparse.Namespace) -> dict[str, Any]:
    """Those of a command's options that say how its terrain is read."""
    return {name: getattr(options, name) for name in ("z_scale", "nodata", "band", "bbox", "window") if name in options}


def refuse(options: argparse.Namespace, *names: str, because: str) -> None:
    """UserError where one of these options was given that would change nothing."""
    for name in given(options, *names):
        raise UserError(f"--{name.replace('_', '-')} would change nothing: {because}")
