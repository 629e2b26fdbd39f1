"""The parser of the command line, with one module a command. JAX is imported only when a command runs."""

import argparse
from typing import NoReturn

from ..core.version import __version__
from . import aspect, convert, fit, hillshade, horizon, info, relief, render, skyview, slope, tradeoff, view


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: error: {message} (see {self.prog} --help)\n")


def make_parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="jaxhf", description="Renders heightfields, and recovers them from pictures.")
    parser.add_argument("--version", action="version", version=f"jaxhf {__version__}")
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")
    for command in (view, render, fit, hillshade, slope, aspect, relief, skyview, horizon, convert, info, tradeoff):
        command.add(commands)
    return parser
