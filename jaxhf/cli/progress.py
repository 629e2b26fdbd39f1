"""Progress bars: on a terminal only, not under --quiet, and gone when the work is done."""

import contextlib
import os
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tqdm import tqdm

_QUIET = ContextVar("_QUIET", default=False)


@contextlib.contextmanager
def quiet(wanted: bool) -> Iterator[None]:
    """Within, standard output is dropped and no bar is shown, if that is wanted; warnings and errors are as ever."""
    if not wanted:
        yield
        return
    token = _QUIET.set(True)
    try:
        with open(os.devnull, "w") as nowhere, contextlib.redirect_stdout(nowhere):
            yield
    finally:
        _QUIET.reset(token)


def is_quiet() -> bool:
    return _QUIET.get()


def bar(**options: Any) -> "tqdm[Any]":
    """A bar on standard error, as `tqdm` with these options; in a pipe it shows nothing."""
    from tqdm import tqdm

    return tqdm(disable=True if is_quiet() else None, leave=False, dynamic_ncols=True, **options)


@contextlib.contextmanager
def compiled_bar(compiling: Callable[[], float] | None = None, **options: Any) -> Iterator[Callable[[int, int], None]]:
    """A bar that says "compiling" until the first report, and from then on how much of the time is left.

    Args:
      compiling: the seconds that went to compilation since the bar began: what is left is estimated without them. None:
        those that JAX reports.
      options: of `bar`.

    Yields:
      What is to be called with (done, in all): the `progress` of `render`.
    """
    spent = compiling or CompileTime().so_far
    with bar(bar_format="{desc}", desc="compiling", smoothing=0, **options) as shown:

        def advance(done: int, total: int) -> None:
            if shown.disable:
                return
            if shown.bar_format:
                shown.bar_format = None
                shown.set_description_str(refresh=False)
                shown.start_t += spent()
                shown.last_print_t = 0  # the first report is shown, however soon it comes
            shown.total = total
            shown.update(done - shown.n)

        yield advance


class CompileTime:
    """Adds up the seconds that go to tracing and compiling programs, or to loading kept ones, from now on."""

    def __init__(self) -> None:
        import jax

        from ..core.kept import LOADED

        self.seconds, self.events = 0.0, ("/jax/core/compile/", LOADED)
        jax.monitoring.register_event_duration_secs_listener(self._add)

    def so_far(self) -> float:
        return self.seconds

    def _add(self, event: str, duration_secs: float, **_: Any) -> None:
        if event.startswith(self.events):
            self.seconds += duration_secs
