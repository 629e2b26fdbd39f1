"""Options that several commands share, and what a command makes of them."""

import argparse
import dataclasses
from collections.abc import Collection
from typing import Any, get_args

from ..core.errors import UserError
from ..core.settings import Settings

TERRAIN = ".tif and others that GDAL reads, .npz, .npy, .asc, .hgt, .png (grey), .exr, .pfm or .hfield (MuJoCo)"


def examples(*commands: str) -> str:
    """The end of a command's --help."""
    return "\n  ".join(("examples:", *commands))


def given(options: argparse.Namespace, *names: str) -> dict[str, Any]:
    """Those of these options that were given; where one was not, what takes them has a default of its own."""
    return {name: value for name in names if (value := getattr(options, name)) is not None}


def refuse(options: argparse.Namespace, *names: str, because: str) -> None:
    """UserError where one of these options was given that would change nothing."""
    for name in given(options, *names):
        raise UserError(f"--{name.replace('_', '-')} would change nothing: {because}")


def add_settings(command: argparse.ArgumentParser, names: Collection[str]) -> None:
    """Adds an option for each of these fields of `Settings`, with the help that its metadata holds.

    Args:
      command: gets the options; one that is not given is absent from the parsed namespace.
      names: of the fields.
    """
    group = command.add_argument_group("accuracy and speed")
    for knob in dataclasses.fields(Settings):
        option = knob.name.replace("_", "-")
        if knob.name not in names:
            continue
        if knob.type is bool:
            group.add_argument(
                f"--no-{option}", dest=knob.name, action="store_false", default=argparse.SUPPRESS,
                help=f"leave out {knob.metadata['help']}",
            )  # fmt: skip
            continue
        default = knob.metadata.get("none", knob.default)
        group.add_argument(
            f"--{option}", type=whole_number if int in (knob.type, *get_args(knob.type)) else str, default=argparse.SUPPRESS,
            metavar=knob.metadata.get("metavar"), help=f"{knob.metadata['help']} [{default}]",
        )  # fmt: skip


def whole_number(text: str) -> int:
    """Of what may be written as 1e6, too."""
    value = float(text)
    if not value.is_integer():
        raise ValueError(text)
    return int(value)


def settings(options: argparse.Namespace) -> Settings:
    return Settings(**{name: value for name, value in vars(options).items() if name in Settings.__dataclass_fields__})


def add_size(command: argparse.ArgumentParser) -> None:
    group = command.add_argument_group("size")
    group.add_argument(
        "--width",
        type=whole_number,
        metavar="PIXELS",
        help="of the picture; with one of the two, the other keeps the proportions",
    )
    group.add_argument("--height", type=whole_number, metavar="PIXELS", help="of the picture")


def size(options: argparse.Namespace) -> tuple[int | None, int | None]:
    """Width and height, None where not given; ValueError where they are not positive."""
    for name in ("width", "height"):
        value = getattr(options, name)
        if value is not None and value < 1:
            raise UserError(f"--{name} must be a whole number of pixels from 1 on, it is {value}")
    return options.width, options.height


def add_raster(command: argparse.ArgumentParser) -> None:
    """How numbers stored in a file of heights are to be read."""
    group = command.add_argument_group("heights as they are stored")
    group.add_argument("--z-scale", type=float, default=1.0, metavar="S", help="heights are multiplied by it [1]")
    group.add_argument("--nodata", type=float, metavar="V", help="a stored value that means no height [as the file says]")


def add_machine(command: argparse.ArgumentParser) -> None:
    group = command.add_argument_group("machine")
    group.add_argument(
        "--devices",
        type=whole_number,
        metavar="N",
        help="cores that share the work, each with a copy [all, at most 16, fewer for a small picture]",
    )
    group.add_argument("--precision", choices=("float32", "float64"), default="float32", help="of heights and rays [float32]")
    group.add_argument(
        "--no-cache", dest="cache", action="store_false",
        help="keep no compiled programs for the next run [kept in the folder JAXHF_CACHE, by default one in the user's cache "
        "folder; JAXHF_CACHE=off: keep none]",
    )  # fmt: skip


def set_up_jax(options: argparse.Namespace) -> None:
    """Configures JAX by the options of `add_machine`, which can only be done before its first use."""
    import jax

    from ..xla.machine import default_devices
    from .cache import keep_programs
    from .limits import require_devices

    require_devices(options.devices)
    jax.config.update("jax_enable_x64", options.precision == "float64")
    jax.config.update("jax_num_cpu_devices", options.devices or default_devices())
    keep_programs(options.cache)
