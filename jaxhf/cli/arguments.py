"""Options as tables, those that several commands share, and what a command makes of them."""

import argparse
import dataclasses
import math
from collections.abc import Callable, Collection, Sequence
from functools import partial
from typing import Any

from ..core.errors import UserError
from ..core.rules import Whole
from ..core.settings import Settings

Option = tuple[tuple[str, ...], dict[str, Any]]
"""What argparse's `add_argument` takes: names, and keywords."""
Rule = tuple[str, Callable[[Any], bool]]
"""What a value must be, in words, and whether it is."""

_ANY: Rule = "", lambda value: True
FINITE: Rule = "finite", math.isfinite
POSITIVE: Rule = "positive and finite", lambda value: 0 < value < math.inf


def option(*names: str, **keywords: Any) -> Option:
    return names, keywords


def flag(name: str, help: str) -> Option:
    return option(name, action="store_true", help=help)


def number(name: str, metavar: str, help: str, default: float | None = None, rule: Rule = _ANY, **more: Any) -> Option:
    return option(name, type=partial(_converted, real_number, rule), metavar=metavar, default=default, help=help, **more)


def whole(name: str, metavar: str, help: str, least: int | None = None, default: int | None = None) -> Option:
    rule = _ANY if least is None else (f"a whole number from {least} on", lambda value: value >= least)
    return option(name, type=partial(_converted, whole_number, rule), metavar=metavar, default=default, help=help)


def choice(name: str, names: Sequence[str], help: str, default: str | None = None) -> Option:
    rule = f"one of {', '.join(names)}", names.__contains__
    return option(name, type=partial(_converted, str, rule), metavar=f"{{{','.join(names)}}}", default=default, help=help)


def _converted(convert: Callable[[str], Any], rule: Rule, text: str) -> Any:
    value = convert(text)
    words, holds = rule
    if not holds(value):
        raise argparse.ArgumentTypeError(f"must be {words}{';' if ',' in words else ','} it is {value!r}")
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


TERRAIN = ".tif and others that GDAL reads, .npz, .npy, .asc, .hgt, .png (grey), .exr, .pfm or .hfield (MuJoCo)"
IN = option("terrain", metavar="IN", help=f"heights: {TERRAIN}")
NODATA = number("--nodata", "V", "a stored value that means no height [as the file says]")
RASTER = {"heights as they are stored": (number("--z-scale", "S", "heights are multiplied by it [1]", default=1.0), NODATA)}
MACHINE = {
    "machine": (
        whole("--devices", "N", "cores that share the work, each with a copy [all, at most 16, fewer for a small picture]"),
        choice("--precision", ("float32", "float64"), "of heights and rays [float32]", default="float32"),
        option(
            "--no-cache", dest="cache", action="store_false",
            help="keep no compiled programs for the next run [kept in the folder JAXHF_CACHE, by default one in the user's "
            "cache folder; JAXHF_CACHE=off: keep none]",
        ),
    )
}  # fmt: skip


def output(help: str) -> Option:
    return option("-o", "--output", required=True, metavar="OUT", help=help)


def settings_options(names: Collection[str]) -> Sequence[Option]:
    """An option for each of these fields of `Settings`; one that is not given is absent from what is parsed."""
    return [_knob(field) for field in dataclasses.fields(Settings) if field.name in names]


def _knob(field: "dataclasses.Field[Any]") -> Option:
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


def refuse(options: argparse.Namespace, *names: str, because: str) -> None:
    """UserError where one of these options was given that would change nothing."""
    for name in given(options, *names):
        raise UserError(f"--{name.replace('_', '-')} would change nothing: {because}")


def set_up_jax(options: argparse.Namespace) -> None:
    """Configures JAX by the options of `MACHINE`, which can only be done before its first use."""
    import jax

    from ..xla.machine import default_devices
    from .cache import keep_programs
    from .limits import require_devices

    require_devices(options.devices)
    jax.config.update("jax_enable_x64", options.precision == "float64")
    jax.config.update("jax_num_cpu_devices", options.devices or default_devices())
    keep_programs(options.cache)
