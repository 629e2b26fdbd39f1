"""Ctrl-C ends a command whenever it comes: each time in a process of its own."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

pytestmark = pytest.mark.skipif(os.name == "nt", reason="Windows sends no SIGINT to another process")

ROOT = Path(__file__).parents[2]
SCENE = ROOT / "scenes" / "debug4x4.toml"  # 320 x 240
START = "import gc, signal, sys; from jaxhf.cli.main import main\n"


def started(script: str, *words: object) -> subprocess.Popen[str]:
    """A process that hears Ctrl-C, also where this one was started so that it does not (by `nohup`, or behind a shell's &)."""
    here = signal.signal(signal.SIGINT, signal.default_int_handler)
    command, pipe = [sys.executable, "-c", script, *map(str, words)], subprocess.PIPE
    try:
        return subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True, cwd=ROOT)
    finally:
        signal.signal(signal.SIGINT, here)


def interrupted(script: str, delay: float, *words: object) -> float:
    """Sends Ctrl-C some seconds after the process is ready; how long it then takes to end, with one line and nothing left."""
    with started(script, *words) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        time.sleep(delay)
        begin = time.perf_counter()
        process.send_signal(2)
        out, err = process.communicate(timeout=60)
    assert (process.returncode, out, err) == (130, "", "\njaxhf: interrupted\n")
    return time.perf_counter() - begin


@pytest.mark.parametrize("delay", [0.02, 0.35, *(pytest.param(s, marks=pytest.mark.deep) for s in (0.1, 0.2, 0.6, 1.0))])
def test_ctrl_c_in_the_first_second_ends_it_with_one_line(delay, tmp_path):
    """From the first line of `main` on; before it is Python's own start."""
    interrupted(START + "print('ready', flush=True); sys.exit(main())", delay, "render", SCENE, "-o", tmp_path / "out.npy")
    assert not list(tmp_path.iterdir())


ENCODING = """
import os, pathlib, sys, zlib
from jaxhf.cli import interruption
interruption.end_at_once()
from jaxhf.io.files import replacing
with replacing(pathlib.Path(sys.argv[1])) as temporary:
    temporary.write_bytes(b"half")
    print("ready", flush=True)
    while True:
        zlib.compress(os.urandom(1 << 20) * 400, 9)
"""


def test_ctrl_c_waits_for_no_call_and_leaves_no_half_of_a_file(tmp_path):
    """Such as the encoding of a PNG of 8192 x 8192 heights, 13 seconds: here one of more than that."""
    assert interrupted(ENCODING, 1.0, tmp_path / "out.png") < 5
    assert not list(tmp_path.iterdir())


COLLECTED = """
def collected(phase, info):
    if "jax" in sys.modules:
        gc.callbacks.remove(collected)
        signal.raise_signal(signal.SIGINT)
gc.callbacks.append(collected)
sys.exit(main())
"""


DROPPED = """
import gc, signal, time
from jaxhf.cli import interruption
interruption.end_at_once()
interruption.raise_from_now_on()
gc.callbacks.append(lambda *_: signal.raise_signal(signal.SIGINT))
try:
    gc.collect()
    gc.callbacks.clear()
    time.sleep(20)
except KeyboardInterrupt:
    print("obeyed")
"""


IGNORED = """
import signal
from jaxhf.cli import interruption
signal.signal(signal.SIGINT, signal.SIG_IGN)
interruption.end_at_once()
interruption.raise_from_now_on()
signal.raise_signal(signal.SIGINT)
print("went on")
"""


LITTLE = "import sys, jaxhf.cli.main; print({'argparse', 'importlib.metadata', 'numpy', 'jax'} & {*sys.modules})"


@pytest.mark.parametrize(
    ("script", "answer"),
    [
        # Python drops what a callback of garbage collection raises; JAX has one that runs for a part of its import.
        pytest.param(START + COLLECTED, ("", "\njaxhf: interrupted\n", 130), id="during an import, where Python drops it"),
        pytest.param(DROPPED, ("obeyed\n", "", 0), id="that Python drops, it comes again"),
        pytest.param(IGNORED, ("went on\n", "", 0), id="where it is ignored, as behind a shell's &, it stays so"),
        pytest.param(LITTLE, ("set()\n", "", 0), id="little is imported before it is looked after"),
    ],
)
def test_ctrl_c(script, answer, tmp_path):
    process = started(script, "render", SCENE, "-o", tmp_path / "out.npy")
    assert (*process.communicate(timeout=60), process.returncode) == answer
