"""The command line: a parser with one module a command, and how errors end. JAX is imported only when a command runs."""

import argparse
import sys
import warnings
from collections.abc import Sequence
from typing import NoReturn

from ..core.errors import UserError
from ..core.version import __version__
from . import convert, fit, hillshade, info, render, tradeoff


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: error: {message} (see {self.prog} --help)\n")


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs one command; returns its exit code: 0, 2 after an error of the user's, 130 after Ctrl-C."""
    options = _parser().parse_args(arguments)
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("always", ".* is now called", DeprecationWarning)  # of keys in files, which Python hides
            warnings.showwarning = lambda message, *_, **__: print(f"jaxhf: warning: {message}", file=sys.stderr)
            options.run(options)
    except KeyboardInterrupt as interruption:
        print(f"\njaxhf: {str(interruption) or 'interrupted'}", file=sys.stderr)
        return 130
    except (UserError, OSError) as error:
        print(f"jaxhf: error: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    except (MemoryError, RuntimeError) as error:
        if isinstance(error, RuntimeError) and "RESOURCE_EXHAUSTED" not in str(error):  # which is what JAX calls it
            raise
        print(
            "jaxhf: error: memory ran out; a smaller picture or terrain needs less (render: also a smaller --chunk)",
            file=sys.stderr,
        )
        return 2
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="jaxhf", description="Renders heightfields, and recovers them from pictures.")
    parser.add_argument("--version", action="version", version=f"jaxhf {__version__}")
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")
    for command in (render, fit, hillshade, convert, info, tradeoff):
        command.add(commands)
    return parser
