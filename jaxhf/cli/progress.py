"""Progress: on a terminal a bar or a line that is gone when the work is done, elsewhere a line a minute; none under --quiet."""

import contextlib
import os
import sys
import threading
from collections.abc import Callable, Iterator
from typing import Any

from tqdm import tqdm

_EACH_SECOND, _EACH_MINUTE = 1.0, 60.0


@contextlib.contextmanager
def quiet(wanted: bool) -> Iterator[None]:
    """Within, standard output is dropped and no bar is shown, if that is wanted; warnings and errors are as ever."""
    with open(os.devnull, "w", errors="replace") as nowhere, contextlib.redirect_stdout(nowhere if wanted else sys.stdout):
        yield


def is_quiet() -> bool:
    """Whether standard output leads to where `quiet` has opened."""
    return getattr(sys.stdout, "name", None) == os.devnull


def bar(**options: Any) -> tqdm:
    """A bar on standard error, as `tqdm` with these options; in a pipe it shows nothing."""
    window: dict[str, Any] = {"dynamic_ncols": True}
    with contextlib.suppress(OSError, ValueError):  # which is what a stream without a descriptor raises
        if os.get_terminal_size(sys.stderr.fileno()).columns == 0:  # of a terminal that has no window, as one in a container
            window = {"ncols": 80, "nrows": 24}
    return tqdm(disable=True if is_quiet() else None, leave=False, **window, **options)


@contextlib.contextmanager
def compiled_bar(**options: Any) -> Iterator[Callable[[int, int], None]]:
    """A bar that says "compiling" until the first report, and from then on how much time is left, without that of compilation.

    It yields what is to be called with (done, in all): the `progress` of `render`.
    """
    compiling = CompileTime()
    with bar(bar_format="{desc}", desc="compiling", smoothing=0, **options) as shown:

        def advance(done: int, total: int) -> None:
            if shown.disable:
                return
            if shown.bar_format:
                shown.bar_format = None
                shown.set_description_str(refresh=False)
                shown.start_t += compiling.seconds
                shown.last_print_t = 0  # the first report is shown, however soon it comes
            shown.total = total
            shown.update(done - shown.n)

        yield advance


@contextlib.contextmanager
def told(line: Callable[[], str]) -> Iterator[None]:
    """Says what work of unknown length has come to: each second on a terminal, elsewhere once a minute on standard error.

    The line is asked for in a thread of its own.
    """
    ended = threading.Event()
    with bar(bar_format="{desc}", desc=line()) as shown:

        def keep_telling() -> None:
            while not ended.wait(_EACH_MINUTE if shown.disable else _EACH_SECOND):
                if not shown.disable:
                    shown.set_description_str(line())
                elif not is_quiet():
                    print(f"jaxhf: {line()}", file=sys.stderr, flush=True)

        thread = threading.Thread(target=keep_telling, daemon=True)
        thread.start()
        try:
            yield
        finally:
            ended.set()
            thread.join()


def duration(seconds: float) -> str:
    """In the unit that suits: 45 s, 12 min, 3.5 h."""
    if seconds < 99.5:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5940 else f"{seconds / 3600:.1f} h"


class CompileTime:
    """Adds up the seconds that go to tracing and compiling programs, or to loading kept ones, from now on."""

    def __init__(self) -> None:
        import jax

        from ..xla.kept import LOADED

        self.seconds, self.events = 0.0, ("/jax/core/compile/", LOADED)
        jax.monitoring.register_event_duration_secs_listener(self._add)

    def _add(self, event: str, duration_secs: float, **_: Any) -> None:
        if event.startswith(self.events):
            self.seconds += duration_secs
