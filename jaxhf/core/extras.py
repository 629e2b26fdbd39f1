"""Packages that only some tasks need."""

import importlib
from types import ModuleType

from .errors import UserError


def import_extra(package: str, use: str, extra: str) -> ModuleType:
    """An optional package; UserError where it is not installed.

    Args:
      package: its name.
      use: what needs it, with its verb, as in "a report needs".
      extra: the extra of jaxhf that installs it.
    """
    try:
        return importlib.import_module(package)
    except ImportError as error:
        raise UserError(f"{use} {package}: pip install 'jaxhf[{extra}]'") from error
