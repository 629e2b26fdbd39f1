"""Measurements in processes of their own: what a process has once (precision, devices, peak of memory) is then each one's."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any


class Worker:
    """A process that runs a module, is given a job, and then answers questions, in lines of JSON.

    It is in a session of its own, so that Ctrl-C reaches only its parent; it ends when that does.
    """

    def __init__(self, module: str, job: Mapping[str, Any], cores: set[int] | None = None):
        """Starts it and hands it the job; the first `answer` is to that.

        Args:
          module: what to run: a module's dotted name, or the path of a file.
          job: for the module's `serve`.
          cores: of the CPU, to which it is confined; None: all.
        """
        folder = str(Path(__file__).parents[2])
        path = os.pathsep.join(entry for entry in (folder, os.environ.get("PYTHONPATH", "")) if entry)
        self.complaints = tempfile.TemporaryFile("w+")  # noqa: SIM115 - closed with the process
        self.process = subprocess.Popen(
            # -P: not what happens to lie in the current folder.
            [sys.executable, *([module] if module.endswith(".py") else ["-P", "-m", module]), "--serve"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self.complaints,
            text=True,
            # What the last line of a failure says is then its error.
            env={**os.environ, "PYTHONPATH": path, "JAX_TRACEBACK_FILTERING": "off"},
            start_new_session=True,
        )
        if cores is not None:
            os.sched_setaffinity(self.process.pid, cores)
        self.send(json.dumps(dict(job)))

    def send(self, question: str) -> None:
        """Asks one of the questions that the module's `serve` knows, without waiting."""
        assert self.process.stdin is not None
        with contextlib.suppress(BrokenPipeError):  # `answer` says why
            self.process.stdin.write(question + "\n")
            self.process.stdin.flush()

    def answer(self) -> dict[str, Any]:
        """Waits for the answer to what was sent last; MeasurementError where the process has died."""
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if not line:
            code = self.process.wait()
            self.complaints.seek(0)
            said = [line for line in self.complaints.read().splitlines() if line.strip()]
            raise MeasurementError(f"{_ended(code)}: {said[-1] if said else 'it said nothing'}")
        return json.loads(line)

    def ask(self, question: str) -> dict[str, Any]:
        self.send(question)
        return self.answer()

    def close(self) -> None:
        self.process.kill()
        self.process.communicate()
        self.complaints.close()

    def __enter__(self) -> "Worker":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _ended(code: int) -> str:
    if code == -signal.SIGKILL:
        return "the process was killed, as happens where memory runs out"
    return f"the process ended with code {code}"


class MeasurementError(ChildProcessError):
    """A measuring process died: out of memory, or by an error of its own, which the message quotes."""


def serve(prepare: Callable[[dict[str, Any]], Mapping[str, Callable[[], Mapping[str, Any]]]]) -> None:
    """The other end of a `Worker`.

    Args:
      prepare: takes the job; returns what answers each question. What it names "ready" is run at once.
    """
    answers = prepare(json.loads(sys.stdin.readline()))
    print(json.dumps(answers["ready"]()), flush=True)
    for line in sys.stdin:
        print(json.dumps(answers[line.strip()]()), flush=True)


def timed(frame: Callable[[], object], least: float = 0.0) -> dict[str, float]:
    """What one run takes: seconds by the clock, and by the processors together, which a busy machine disturbs less.

    Args:
      least: runs are repeated until they have taken so many seconds together; the mean counts.
    """
    begin, cpu = time.perf_counter(), time.process_time()
    runs, elapsed = 0, 0.0
    while not runs or elapsed < least:
        frame()
        runs, elapsed = runs + 1, time.perf_counter() - begin
    return {"seconds": elapsed / runs, "cpu_seconds": (time.process_time() - cpu) / runs}
