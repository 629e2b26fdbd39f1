"""The parser of the command line. JAX is imported only when a command runs."""

import argparse
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NoReturn

from ..core.version import __version__
from .catalogue import COMMANDS, GROUPS
from .command import Command

_EXAMPLES = """
examples:
  jaxhf view terrain.tif -o terrain.png         a look at a terrain
  jaxhf hillshade terrain.tif -o shaded.tif     a map in the place of its terrain
  jaxhf render scene.toml -o picture.png        a picture of a scene
  jaxhf hillshade --help                        what a command takes

An output file that is there is replaced, whole or not at all; never one that the same command reads.
Exit codes: 0, done; 2, a mistake, which one line on standard error names; 130, interrupted by Ctrl-C."""


class _Formatter(argparse.HelpFormatter):
    """Keeps the lines of a text that has several, and fills one that has not."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        return text.strip("\n") if "\n" in text else super()._fill_text(text, width, indent)


class _Parser(argparse.ArgumentParser):
    """Says in one line what is wrong with a command line."""

    def __init__(self, **options: Any):
        super().__init__(formatter_class=_Formatter, exit_on_error=False, **options)

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: error: {message} (see {self.prog} --help)\n")

    def read(self, words: Sequence[str]) -> argparse.Namespace:
        """What these words say; SystemExit, after one line, where there is something wrong with them."""
        try:
            options, unknown = self.parse_known_args(words)
        except argparse.ArgumentError as error:
            self.error(" ".join(filter(None, (error.argument_name, error.message))))
        if unknown:
            self.error(_unexpected(unknown, self))
        return options


def parser_of(command: Command) -> _Parser:
    """Reads the words after a command's name, and says by --help what may stand there."""
    examples = "\n  ".join(("examples:", *(f"jaxhf {command.name} {words}" for words in command.examples)))
    about = f"{command.line[0].upper()}{command.line[1:]}. {command.about}"
    parser = _Parser(prog=f"jaxhf {command.name}", description=about.strip(), epilog=examples)
    parser.add_argument("--quiet", action="store_true", help="print no report and no progress; warnings stay")
    for title, options in command.options.items():
        group = parser.add_argument_group(title) if title else parser
        for names, keywords in options:
            group.add_argument(*names, **keywords)
    parser.set_defaults(command=command)
    return parser


def parse(words: Sequence[str] | None = None) -> argparse.Namespace:
    """The options of the command that these words, or those of this process, name, with itself as `command`."""
    words = sys.argv[1:] if words is None else words
    about = ["Renders heightfields, makes maps of them, and recovers them from pictures."]
    for title, group in GROUPS.items():
        about += ["", f"{title}:", *(f"  {command.name:<11} {command.line}" for command in group)]
    usage = "jaxhf [-h] [--version] COMMAND ..."
    overview = _Parser(prog="jaxhf", usage=usage, description="\n".join(about), epilog=_EXAMPLES)
    overview.add_argument("--version", action="version", version=f"jaxhf {__version__}")
    overview.add_argument("name", metavar="COMMAND", help=argparse.SUPPRESS)
    end = next((k for k, word in enumerate(words, 1) if not word.startswith("-")), len(words))
    name = overview.read(words[:end]).name
    if name not in COMMANDS:
        overview.error(_unknown_command(name))
    return parser_of(COMMANDS[name]).read(words[end:])


def _unknown_command(word: str) -> str:
    if Path(word).suffix:
        return f"{word!r} is no command; one stands before its files, as in 'jaxhf info {word}'"
    from ..io.errors import nearest

    return f"unknown command {word!r}; {nearest(word, COMMANDS)}"


def _unexpected(words: Sequence[str], parser: _Parser) -> str:
    """That a parser does not know these words; which of its options may have been meant, or which command has it."""
    word = next((word for word in words if word.startswith("-")), None)
    if word is None:
        return f"unexpected argument {words[0]!r}"
    import difflib

    word = word.partition("=")[0]
    name, known = word.lstrip("-"), _options(parser)
    begun = [option for option in known if option.startswith(name)]  # as GDAL's -az and -alt, which have one dash
    close = begun if len(begun) == 1 else difflib.get_close_matches(name, known, n=1)
    others = [command.name for command in COMMANDS.values() if name in _options(parser_of(command))]
    tail = f"; jaxhf {others[0]} has it" if others else ""
    return f"unknown option {word}" + (f"; did you mean --{close[0]}?" if close else tail)


def _options(parser: _Parser) -> list[str]:
    """The names of its options without the dashes, which would make all of them alike."""
    return re.findall(r"--([a-z][\w-]*)", parser.format_usage())
