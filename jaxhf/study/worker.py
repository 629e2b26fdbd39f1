"""Measurements in processes of their own: what a process has once (precision, devices, peak of memory) is then each one's."""

import contextlib
import multiprocessing
import os
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from multiprocessing.connection import Connection
from typing import Any

import jax

Answers = Mapping[str, Callable[[], Mapping[str, Any]]]
"""What answers each question; "ready" is answered at once, unasked."""


class MeasurementError(ChildProcessError):
    """A measuring process died: out of memory, or by an error of its own, which the message quotes."""


class Worker:
    """A process that is given a job and then answers questions. Ctrl-C reaches only its parent, with which it ends."""

    def __init__(self, prepare: Callable[[Any], Answers], job: Any):
        """Calls `prepare`, a module's function, there with the job; the first `answer` is to "ready"."""
        context = multiprocessing.get_context("spawn")
        self.errors = tempfile.NamedTemporaryFile("r")  # noqa: SIM115 - closed with the process
        self.pipe, theirs = context.Pipe()
        self.process = context.Process(target=_serve, args=(theirs, self.errors.name, prepare, job), daemon=True)
        handler = signal.signal(signal.SIGINT, signal.SIG_IGN)  # which the process inherits
        self.process.start()
        signal.signal(signal.SIGINT, handler)
        theirs.close()

    def send(self, question: str) -> None:
        """Asks without waiting."""
        with contextlib.suppress(BrokenPipeError):  # `answer` says why
            self.pipe.send(question)

    def answer(self) -> dict[str, Any]:
        """Waits for the answer to what was sent last; MeasurementError where the process has died."""
        try:
            return self.pipe.recv()
        except (EOFError, ConnectionResetError):
            self.process.join()
        said = [line for line in self.errors.read().splitlines() if line.strip()]
        killed = self.process.exitcode == -signal.SIGKILL
        how = "was killed, as happens where memory runs out" if killed else f"ended with code {self.process.exitcode}"
        raise MeasurementError(f"the process {how}: {said[-1] if said else 'it said nothing'}")

    def ask(self, question: str) -> dict[str, Any]:
        self.send(question)
        return self.answer()

    def __enter__(self) -> "Worker":
        return self

    def __exit__(self, *_: object) -> None:
        self.process.kill()
        self.process.join()
        self.pipe.close()
        self.errors.close()


def _serve(pipe: Connection, errors: str, prepare: Callable[[Any], Answers], job: Any) -> None:
    sys.stderr = open(errors, "w")  # noqa: SIM115 - until the process ends
    os.dup2(sys.stderr.fileno(), 2)
    jax.config.update("jax_traceback_filtering", "off")  # or the last line of a failure is not its error
    answers, question = prepare(job), "ready"
    with contextlib.suppress(EOFError):  # when the parent has ended
        while True:
            pipe.send(answers[question]())
            question = pipe.recv()


def timed(frame: Callable[[], object], least: float = 0.0) -> dict[str, float]:
    """Seconds of a run by the clock and by all processors: the mean of as many as take at least so many seconds together."""
    begin, cpu = time.perf_counter(), time.process_time()
    runs, elapsed = 0, 0.0
    while not runs or elapsed < least:
        frame()
        runs, elapsed = runs + 1, time.perf_counter() - begin
    return {"seconds": elapsed / runs, "cpu_seconds": (time.process_time() - cpu) / runs}
