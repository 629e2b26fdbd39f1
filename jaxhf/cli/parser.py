"""The parser of the command line, with one module a command. JAX is imported only when a command runs."""

import argparse
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn

from ..core.version import __version__
from . import tradeoff
from .commands import aspect, convert, fit, hillshade, horizon, info, relief, render, skyview, slope, view

GROUPS = {
    "terrain maps": (hillshade, slope, aspect, relief, skyview, horizon),
    "pictures": (view, render),
    "recovery": (fit, tradeoff),
    "files": (convert, info),
}
_EXAMPLES = """
examples:
  jaxhf view terrain.tif -o terrain.png         a look at a terrain
  jaxhf hillshade terrain.tif -o shaded.tif     a map in the place of its terrain
  jaxhf render scene.toml -o picture.png        a picture of a scene
  jaxhf hillshade --help                        what a command takes

An output file that is there is replaced, whole or not at all; never one that the same command reads.
Exit codes: 0, done; 2, a mistake, which one line on standard error names; 130, interrupted by Ctrl-C."""


_KINDS = {"float": "a number", "int": "a whole number", "whole_number": "a whole number", "_angles": "two angles, as 90,10"}


class _Formatter(argparse.HelpFormatter):
    """Keeps the lines of a text that has several, and fills one that has not."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        return text.strip("\n") if "\n" in text else super()._fill_text(text, width, indent)


class _Parser(argparse.ArgumentParser):
    """Says in one line what is wrong with a command line, and which word may have been meant."""

    commands: Mapping[str, argparse.ArgumentParser] = {}  # all of them, by their names

    def __init__(self, **options: Any):
        super().__init__(**{"formatter_class": _Formatter, **options})

    def error(self, message: str) -> NoReturn:
        choice = re.fullmatch(r"argument (.+): invalid choice: '?(.*?)'? \(choose from (.*)\)", message)
        if choice is not None:
            name, word, known = choice[1], choice[2], re.findall(r"[\w-]+", choice[3])
            among = f"{name} must be one of {', '.join(known)}; it is {word!r}"
            message = _unknown_command(word, known) if name == "COMMAND" else among
        kind = re.fullmatch(r"argument (.+): invalid (\w+) value: (.*)", message)
        if kind is not None:
            message = f"{kind[1]} must be {_KINDS.get(kind[2], kind[2])}, it is {kind[3]}"
        message = re.sub(r"^argument (\S+):", r"\1", message)
        self.exit(2, f"{self.prog}: error: {message} (see {self.prog} --help)\n")

    def parse_known_args(self, *args: Any, **options: Any) -> Any:
        """Refuses what is not known here, where the options of this command are."""
        found, unknown = super().parse_known_args(*args, **options)
        if not unknown:
            return found, unknown
        word = next((word for word in unknown if word.startswith("-")), None)
        if word is None:
            self.error(f"unexpected argument {unknown[0]!r}")
        import difflib

        word = word.partition("=")[0]
        close = difflib.get_close_matches(word[2:], _options(self), n=1)
        others = [name for name, command in self.commands.items() if word[2:] in _options(command)]
        tail = f"; jaxhf {others[0]} has it" if others else ""
        self.error(f"unknown option {word}" + (f"; did you mean --{close[0]}?" if close else tail))


def _options(command: argparse.ArgumentParser) -> list[str]:
    """Their names without the dashes, which would make all of them alike."""
    return re.findall(r"--([a-z][\w-]*)", command.format_usage())


def _unknown_command(word: str, known: Sequence[str]) -> str:
    if Path(word).suffix:
        return f"{word!r} is no command; one stands before its files, as in 'jaxhf info {word}'"
    from ..io.errors import nearest

    return f"unknown command {word!r}; {nearest(word, known)}"


class _Group:
    """Takes the place of argparse's subparsers for the commands of one group, and keeps a line about each."""

    def __init__(self, commands: Any, title: str):
        self._commands, self.lines = commands, [f"{title}:"]

    def add_parser(self, name: str, *, help: str, **options: Any) -> argparse.ArgumentParser:
        self.lines.append(f"  {name:<11} {help}")
        command = self._commands.add_parser(name, **options)
        command.add_argument("--quiet", action="store_true", help="print no report and no progress; warnings stay")
        return command


def make_parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="jaxhf", usage="jaxhf [-h] [--version] COMMAND ...")
    parser.add_argument("--version", action="version", version=f"jaxhf {__version__}")
    commands = parser.add_subparsers(prog="jaxhf", required=True, metavar="COMMAND", help=argparse.SUPPRESS)
    lines = ["Renders heightfields, makes maps of them, and recovers them from pictures."]
    for title, modules in GROUPS.items():
        group = _Group(commands, title)
        for module in modules:
            module.add(group)
        lines += ["", *group.lines]
    _Parser.commands = commands.choices
    parser.description, parser.epilog = "\n".join(lines), _EXAMPLES
    return parser
