"""What Ctrl-C does to a command: it ends at once, or, where work is under way, it raises KeyboardInterrupt."""

import os
import signal
import sys
import threading
from typing import Any

_AGAIN = 0.01  # seconds
_waiting: threading.Timer | None = None


def end_at_once() -> None:
    """Lets Ctrl-C end this process with a line and exit code 130, until `raise_from_now_on`. Where it is ignored it stays so.

    While modules are imported a KeyboardInterrupt gets lost, or crashes: of 40 at delays up to 1.5 seconds three were dropped
    by JAX's callback of the garbage collector, one hit the initialisation of a compiled module.
    """
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _end)


def raise_from_now_on() -> None:
    """Lets Ctrl-C raise KeyboardInterrupt: there are files or processes to be cleared away, or steps to be kept."""
    if signal.getsignal(signal.SIGINT) is _end:
        sys.unraisablehook = _raise_again
        signal.signal(signal.SIGINT, signal.default_int_handler)


def _end(*_: object) -> None:
    os.write(2, b"\njaxhf: interrupted\n")  # sys.stderr may be in use
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
