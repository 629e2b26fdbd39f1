"""What Ctrl-C does to a command: it ends at once, or, where steps are to be kept, it raises KeyboardInterrupt."""

import os
import signal
import sys
import threading
from typing import Any

_AGAIN = 0.01  # seconds
_waiting: threading.Timer | None = None


def end_at_once() -> None:
    """Lets Ctrl-C end this process with a line and exit code 130, until `raise_from_now_on`. Where it is ignored it stays so.

    A thread does that: Python's own handlers wait for the call that runs, and encoding a large picture is one of 13 seconds.

    While modules are imported a KeyboardInterrupt gets lost, or crashes: of 40 at delays up to 1.5 seconds three were dropped
    by JAX's callback of the garbage collector, one hit the initialisation of a compiled module.
    """
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        heard, told = os.pipe()
        if os.name != "nt":  # where a file that may block is taken
            os.set_blocking(told, False)
        signal.set_wakeup_fd(told)
        signal.signal(signal.SIGINT, _heard)
        threading.Thread(target=_end, args=(heard,), daemon=True).start()


def raise_from_now_on() -> None:
    """Lets Ctrl-C raise KeyboardInterrupt: there are processes to be cleared away, or steps to be kept."""
    if signal.getsignal(signal.SIGINT) is _heard:
        signal.set_wakeup_fd(-1)
        sys.unraisablehook = _raise_again
        signal.signal(signal.SIGINT, signal.default_int_handler)


def _heard(*_: object) -> None:
    """The handler: signals that have none do not reach the thread."""


def _end(heard: int) -> None:
    while os.read(heard, 1) != bytes([signal.SIGINT]):
        pass
    try:
        files: Any = sys.modules.get("jaxhf.io.files")  # an import would wait for those of the main thread
        for path in list(getattr(files, "TEMPORARIES", ())):
            path.unlink(missing_ok=True)
        os.write(2, b"\njaxhf: interrupted\n")  # sys.stderr may be in use
    finally:
        os._exit(130)


def _raise_again(unraisable: Any) -> None:
    """For `sys.unraisablehook`: what a callback of the garbage collector or a finaliser raises, Python drops."""
    global _waiting
    if unraisable.exc_type is KeyboardInterrupt:
        if _waiting is not None and _waiting.is_alive():  # one for several: the next could meet what the first has begun to end
            return
        main = threading.main_thread().ident
        assert main is not None
        # Now it would be dropped once more. Sent to the thread it also ends a wait for another process.
        _waiting = threading.Timer(_AGAIN, signal.pthread_kill, (main, signal.SIGINT))
        _waiting.start()
    else:
        sys.__unraisablehook__(unraisable)
