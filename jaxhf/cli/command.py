"""A command as a record: what `jaxhf --help` and its own --help say of it, its options, and what it does."""

import argparse
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

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
