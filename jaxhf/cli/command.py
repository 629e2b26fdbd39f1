"""A command as a record: what `jaxhf --help` and its own --help say of it, its options, and what it does."""

import argparse
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from . import arguments


@dataclass(frozen=True)
class Command:
    """One word after `jaxhf`.

    Attributes:
      name: the word.
      line: about it, in `jaxhf --help`.
      examples: what may stand after its name.
      options: the title of each group and what is in it, with positional arguments; "": without a title.
      run: does it.
      about: what its own --help says besides.
      placed: whether files beside an output that is a map say where it lies.
    """

    name: str
    line: str
    examples: Sequence[str]
    options: Mapping[str, Sequence[arguments.Option]]
    run: Callable[[argparse.Namespace], None]
    about: str = ""
    placed: bool = True

    def add(self, commands: Any) -> None:
        """Adds its parser to those of `parser.Commands`."""
        examples = arguments.examples(*(f"jaxhf {self.name} {words}" for words in self.examples))
        about = f"{self.line[0].upper()}{self.line[1:]}. {self.about}"
        command = commands.add_parser(self.name, help=self.line, description=about.strip(), epilog=examples)
        for title, options in self.options.items():
            group = command.add_argument_group(title) if title else command
            for names, keywords in options:
                group.add_argument(*names, **keywords)
        command.set_defaults(run=self.run, placed=self.placed)
