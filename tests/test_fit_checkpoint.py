"""A fit that is cut short goes on from its checkpoint, to the same bits."""

import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import jaxhf

SETTINGS = jaxhf.Settings(shadows=False, samples=1, chunk=256)
OPTIONS = {"settings": SETTINGS, "checkpoint_every": 2, "max_steps": 12, "tolerance": 1e-9}


def problem() -> tuple[list[jaxhf.Scene], list[np.ndarray]]:
    camera = jaxhf.Perspective.look_at((0.5, 0.5, 3.0), (0.5, 0.5, 0.0), up=(0, 1, 0), fov=18.0, width=12, height=12)

    def scene(heights):
        return jaxhf.Scene([jaxhf.Object(jaxhf.Heightfield(heights))], camera, [jaxhf.Directional((1, 2, 3))])

    y, x = np.mgrid[0:1:9j, 0:1:9j]
    return [scene(np.zeros((9, 9)))], [np.asarray(jaxhf.render(scene(0.1 * np.sin(4 * x + y)), SETTINGS))]


@pytest.fixture(scope="module")
def whole() -> jaxhf.Fit:
    return jaxhf.fit(*problem(), **OPTIONS)


def agree(found: jaxhf.Fit, whole: jaxhf.Fit) -> None:
    np.testing.assert_array_equal(found.heights, whole.heights)
    assert found.result is whole.result
    assert [step._replace(seconds=0.0) for step in found.history] == [step._replace(seconds=0.0) for step in whole.history]


@pytest.mark.parametrize("last", [1, 4, 7])
def test_after_ctrl_c_it_goes_on_to_the_same_bits(tmp_path, whole, last):
    def interrupt(step: jaxhf.Step) -> None:
        if step.step == last:
            raise KeyboardInterrupt

    path = tmp_path / "fit.checkpoint"
    with pytest.raises(KeyboardInterrupt):
        jaxhf.fit(*problem(), **OPTIONS, checkpoint=path, progress=interrupt)
    again = []
    agree(jaxhf.fit(*problem(), **OPTIONS, checkpoint=path, resume=True, progress=again.append), whole)
    assert again[0].step == last + 1
    assert [file.name for file in tmp_path.iterdir()] == [path.name]


def test_a_killed_process_loses_at_most_one_interval(tmp_path, whole):
    path = tmp_path / "fit.checkpoint"
    script = (
        "import sys, jax; jax.config.update('jax_enable_x64', True); sys.path[:0] = sys.argv[1:3]\n"
        "import jaxhf, time; from test_fit_checkpoint import OPTIONS, problem\n"
        "def progress(step):\n    print(step.step, flush=True)\n    time.sleep(0.2)\n"
        "jaxhf.fit(*problem(), **OPTIONS, checkpoint=sys.argv[3], progress=progress)"
    )
    here = Path(__file__).parent
    command = [sys.executable, "-c", script, str(here.parent), str(here), str(path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        for line in process.stdout:
            if int(line) == 5:
                process.send_signal(signal.SIGKILL)
                break
    assert process.returncode == -signal.SIGKILL
    again = []
    agree(jaxhf.fit(*problem(), **OPTIONS, checkpoint=path, resume=True, progress=again.append), whole)
    assert 4 <= again[0].step <= 6  # kept after 4, or a step later than it was told


def test_a_damaged_checkpoint_and_that_of_another_fit_are_refused(tmp_path):
    path = tmp_path / "fit.checkpoint"
    scenes, targets = problem()
    jaxhf.fit(scenes, targets, **{**OPTIONS, "max_steps": 2}, checkpoint=path)
    with pytest.raises(ValueError, match=r"fit\.checkpoint: this is the checkpoint of another fit"):
        jaxhf.fit(scenes, [targets[0] + 1], **OPTIONS, checkpoint=path, resume=True)
    content = bytearray(path.read_bytes())
    content[-100] ^= 1
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"fit\.checkpoint: the checkpoint is damaged"):
        jaxhf.fit(scenes, targets, **OPTIONS, checkpoint=path, resume=True)
    path.write_bytes(b"heights")
    with pytest.raises(ValueError, match=r"fit\.checkpoint: this is not a checkpoint"):
        jaxhf.fit(scenes, targets, **OPTIONS, checkpoint=path, resume=True)
