"""The command line: how it begins and how errors end. Ctrl-C is looked after first; all else is imported after that."""

import codecs
import contextlib
import gc
import io
import os
import sys
import warnings
from collections.abc import Sequence
from importlib import import_module

from . import interruption


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs one command; returns its exit code: 0, 2 after an error of the user's, 130 after Ctrl-C, 141 where nobody reads on.

    Without arguments those of this process count, which then is the command's, also in what Ctrl-C does to it.
    """
    if arguments is None:
        interruption.end_at_once()
        gc.set_threshold(50_000, 50, 100)  # tracing makes many objects that live on, and so do imports
        _show_any_name()
    from .parser import parse

    options = parse(arguments)
    from ..core.errors import UserError
    from .overwriting import require_no_input
    from .progress import quiet

    try:
        with warnings.catch_warnings():
            warnings.showwarning = lambda message, *_, **__: print(
                f"jaxhf: warning: {' '.join(str(message).split())}", file=sys.stderr
            )
            require_no_input(options)
            with quiet(options.quiet):
                import_module(f".commands.{options.command.module or options.command.name}", __package__).run(options)
                sys.stdout.flush()
    except KeyboardInterrupt as stopped:
        print(f"\njaxhf: {str(stopped) or 'interrupted'}", file=sys.stderr, flush=True)
        if arguments is None:  # where XLA still compiles, the end of Python may crash
            with contextlib.suppress(OSError):
                sys.stdout.flush()
            os._exit(130)
        return 130
    except BrokenPipeError:  # of `jaxhf info x | head -1`: who reads has enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # where Python flushes the rest at the end
        return 128 + 13
    except (UserError, OSError) as error:
        said = " ".join(str(error).split())
    except (MemoryError, RuntimeError) as error:
        if isinstance(error, RuntimeError) and "RESOURCE_EXHAUSTED" not in str(error):  # which is what JAX calls it
            raise
        said = "memory ran out; a smaller picture or terrain needs less (render: also a smaller --chunk)"
    else:
        return 0
    finally:
        if arguments is None:
            gc.freeze()  # nothing is looked through once more at the end
    print(f"jaxhf: error: {said}", file=sys.stderr)
    return 2


def _show_any_name() -> None:
    """Lets what an output's encoding lacks be printed all the same: as \\u5c71, or as the bytes that stand in a name."""

    def shown(error: UnicodeError) -> tuple[str | bytes, int]:
        try:
            return codecs.lookup_error("surrogateescape")(error)
        except UnicodeError:
            return codecs.backslashreplace_errors(error)

    codecs.register_error("jaxhf", shown)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # and not None, where there is no console
            utf8 = codecs.lookup(stream.encoding).name == "utf-8"
            stream.reconfigure(errors="backslashreplace" if utf8 else "jaxhf")
