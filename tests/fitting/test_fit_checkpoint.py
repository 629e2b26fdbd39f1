"""A fit that is cut short goes on from its checkpoint, to the same bits."""

import contextlib
import inspect
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import jaxhf
from jaxhf.fitting import fit as _fit, known as _known, loop as _loop
from jaxhf.fitting.fingerprint import fingerprint as fit_fingerprint
from jaxhf.fitting.options import FitOptions
from jaxhf.fitting.problem import make_problem
from jaxhf.fitting.solvers import Outcome

pytestmark = pytest.mark.unoptimised

SETTINGS = jaxhf.Settings(shadows=False, samples=1, chunk=256, edge_samples=0)
# Two levels, steps 1 to 9 and 10 to 18; then the loss becomes as sharp as it is to be.
OPTIONS = {
    "settings": SETTINGS, "checkpoint_every": 2, "max_steps": 24, "tolerance": 1e-9,
    "levels": [0.5, 1.0], "loss": "geman", "noise": 0.001,
}  # fmt: skip


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
    def interrupt(step: Any) -> None:
        if step.step == last:
            raise KeyboardInterrupt

    path = tmp_path / "fit.checkpoint"
    with pytest.raises(KeyboardInterrupt):
        jaxhf.fit(*problem(), **OPTIONS, checkpoint=path, progress=interrupt)
    again = []
    agree(jaxhf.fit(*problem(), **OPTIONS, checkpoint=path, resume=True, progress=again.append), whole)
    assert again[0].step == last + 1
    assert [file.name for file in tmp_path.iterdir()] == [path.name]


class Slow:
    """A number that is still being computed when Ctrl-C comes."""

    def __float__(self) -> float:
        raise KeyboardInterrupt


@contextlib.contextmanager
def ctrl_c(monkeypatch, name: str, call: int, waiting: bool = False):
    """Ctrl-C as `_loop` has called the function of this name for so many times: in it, or where its loss is waited for."""
    original, calls = getattr(_loop, name), []

    def interrupted(*arguments):
        calls.append(arguments)
        found = original(*arguments)
        if len(calls) != call:
            return found
        if not waiting:
            raise KeyboardInterrupt
        unknowns, state, outcome = found
        return unknowns, state, outcome._replace(loss=Slow())

    with monkeypatch.context() as patched:
        patched.setattr(_loop, name, interrupted)
        with pytest.raises(KeyboardInterrupt):
            yield


@pytest.mark.parametrize(
    ("name", "call", "waiting", "kept"),
    [
        ("init_state", 1, False, False),
        ("pictures_and_influence", 1, False, False),  # before the first level
        ("advance", 1, False, True),
        ("advance", 1, True, True),
        ("save_checkpoint", 1, False, True),
    ],
)
def test_ctrl_c_about_the_first_step_leaves_nothing_half_made(tmp_path, monkeypatch, whole, name, call, waiting, kept):
    path = tmp_path / "fit.checkpoint"
    with ctrl_c(monkeypatch, name, call, waiting):
        jaxhf.fit(*problem(), **OPTIONS, checkpoint=path)
    assert [file.name for file in tmp_path.iterdir()] == ([path.name] if kept else [])
    again = []
    agree(jaxhf.fit(*problem(), **OPTIONS, checkpoint=path, resume=True, progress=again.append), whole)
    assert again[0].step == (3 if name == "save_checkpoint" else 1)


# The first accepted step of a line search is the 18th.
@pytest.mark.parametrize(("solver", "step"), [("lm", 2), ("lm", 5), ("bfgs", 21), ("lbfgs", 21), ("adam", 5)])
def test_ctrl_c_while_a_step_is_computed_keeps_the_one_before(tmp_path, monkeypatch, whole, solver, step):
    path, options = tmp_path / "fit.checkpoint", OPTIONS
    if solver != "lm":
        options = {**OPTIONS, "solver": solver, "levels": [1.0], "noise": 0.01}
        whole = jaxhf.fit(*problem(), **options)
        assert whole.history[step - 1].accepted
    with ctrl_c(monkeypatch, "advance", step, waiting=True):
        jaxhf.fit(*problem(), **options, checkpoint=path)
    again = []
    agree(jaxhf.fit(*problem(), **options, checkpoint=path, resume=True, progress=again.append), whole)
    assert again[0].step == step


@pytest.mark.parametrize(
    ("name", "call", "step"),
    [
        ("pictures_and_influence", 10, 10),
        ("pictures_and_influence", 11, 10),  # the first of those that measure the loss's curvature
        ("reset_state", 2, 10),
        ("pictures_and_influence", 19, 19),
        ("reset_state", 3, 19),
    ],
)
def test_ctrl_c_while_a_stage_changes_keeps_the_end_of_the_one_before(tmp_path, monkeypatch, whole, name, call, step):
    path = tmp_path / "fit.checkpoint"
    with ctrl_c(monkeypatch, name, call):
        jaxhf.fit(*problem(), **OPTIONS, checkpoint=path)
    again = []
    agree(jaxhf.fit(*problem(), **OPTIONS, checkpoint=path, resume=True, progress=again.append), whole)
    assert again[0].step == step


def test_ctrl_c_after_the_last_step_keeps_them_all(tmp_path, monkeypatch, whole):
    def interrupt(*_):
        raise KeyboardInterrupt

    path, options = tmp_path / "fit.checkpoint", {**OPTIONS, "checkpoint_every": 100}
    with monkeypatch.context() as patched:
        patched.setattr(_fit, "standard_deviations", interrupt)
        with pytest.raises(KeyboardInterrupt):
            jaxhf.fit(*problem(), **options, uncertainty="exact", checkpoint=path)
    again = []
    agree(jaxhf.fit(*problem(), **options, checkpoint=path, resume=True, progress=again.append), whole)
    assert again == []


def test_a_checkpoint_that_cannot_be_kept_is_refused_first(tmp_path, monkeypatch):
    monkeypatch.setattr(_fit, "FitLoop", None)  # nothing begins
    path = tmp_path / "fit.checkpoint"
    with pytest.raises(FileNotFoundError, match=r"none/fit\.checkpoint: there is no folder"):
        jaxhf.fit(*problem(), **OPTIONS, checkpoint=tmp_path / "none" / "fit.checkpoint", resume=True)
    with pytest.raises(ValueError, match=r"a checkpoint cannot be written here, it is a folder"):
        jaxhf.fit(*problem(), **OPTIONS, checkpoint=tmp_path, resume=True)
    path.write_bytes(b"hours of work")
    with pytest.raises(ValueError, match=r"fit\.checkpoint: this checkpoint is there already; resume=True goes on from it"):
        jaxhf.fit(*problem(), **OPTIONS, checkpoint=path)
    with pytest.raises(ValueError, match=r"fit\.checkpoint: this is not a checkpoint of jaxhf's"):
        jaxhf.fit(*problem(), **OPTIONS, checkpoint=path, resume=True)
    assert path.read_bytes() == b"hours of work"


def without_pictures(setattr: Callable[..., None]) -> None:
    """Replaces all that renders in a fit: steps add to the coefficients what a counter, the solver's state, says."""

    def pictures(unknowns, problem, *_):
        return [jnp.zeros_like(group.targets) for group in problem.groups], np.zeros((9, 9))

    def advance(solver, unknowns, state, problem):
        unknowns = eqx.tree_at(lambda u: u.coefficients, unknowns, unknowns.coefficients + jnp.sin(state))
        loss, yes = 1 / (1 + state), jnp.asarray(True)
        return unknowns, state + 1, Outcome(loss, yes, ~yes, loss, loss, loss, unknowns)

    setattr(_loop, "init_state", lambda solver, unknowns, problem: jnp.zeros(()))
    setattr(_loop, "reset_state", lambda initial, unknowns, step_size: initial)
    setattr(_known, "linearised", lambda unknowns, problem: problem)
    setattr(_loop, "advance", advance)
    setattr(_loop, "pictures_and_influence", pictures)


def test_a_killed_process_loses_at_most_one_interval(tmp_path, monkeypatch):
    path, options = tmp_path / "fit.checkpoint", {**OPTIONS, "max_steps": 12}
    script = (
        "import sys, jax; jax.config.update('jax_enable_x64', True); sys.path[:0] = sys.argv[1:3]\n"
        "import time; from test_fit_checkpoint import *; without_pictures(setattr)\n"
        "def progress(step):\n    print(step.step, flush=True)\n    time.sleep(0.2)\n"
        "jaxhf.fit(*problem(), **{**OPTIONS, 'max_steps': 12}, checkpoint=sys.argv[3], progress=progress)"
    )
    here = Path(__file__).parent
    command = [sys.executable, "-c", script, str(here.parents[1]), str(here), str(path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        for line in process.stdout:
            if int(line) == 5:
                process.send_signal(signal.SIGKILL)
                break
    assert process.returncode == -signal.SIGKILL
    without_pictures(monkeypatch.setattr)
    again, whole = [], jaxhf.fit(*problem(), **options)
    agree(jaxhf.fit(*problem(), **options, checkpoint=path, resume=True, progress=again.append), whole)
    assert len(whole.history) == 12
    assert 4 <= again[0].step - 1 <= 5  # kept after 4, or a step later than it was told


def fingerprint(size=(4, 6), material: jaxhf.Matte | jaxhf.Mirror | None = None, samples: int = 1, **options) -> str:
    """That of a fit of one black picture, by the sampling that its scene asks for."""
    height, width = size
    camera = jaxhf.Perspective.look_at((0.5, 0.5, 3.0), (0.5, 0.5, 0.0), up=(0, 1, 0), fov=18.0, width=width, height=height)
    terrain = jaxhf.Object(jaxhf.Heightfield(np.zeros((3, 3))), material or jaxhf.Matte(0.5))
    scene = jaxhf.Scene([terrain], camera, [jaxhf.Directional((1, 2, 3))], samples=samples)
    defaults = {name: option.default for name, option in list(inspect.signature(jaxhf.fit).parameters.items())[2:]}
    chosen = FitOptions(**{**defaults, "settings": jaxhf.Settings(), **options})
    return fit_fingerprint(*make_problem([scene], [np.zeros(size)], chosen), chosen)


def test_a_fingerprint_tells_problems_apart_that_hold_the_same_numbers():
    """Pictures of 4 x 6 and 6 x 4 zeros, a reflected share of 0.5, ...: the bytes of all arrays are the same."""
    found = [
        fingerprint(),
        fingerprint(samples=4),
        fingerprint(material=jaxhf.Mirror(0.5)),
        fingerprint(size=(6, 4)),
        fingerprint(settings=jaxhf.Settings(samples=9)),
        fingerprint(solver="adam"),
        fingerprint(levels=[0.5, 1.0]),
        fingerprint(inner_steps=50),
        fingerprint(tolerance=1e-5),
        fingerprint(exposures=True),
        fingerprint(offsets=True),
        fingerprint(albedo="constant"),
        fingerprint(loss="cauchy"),
        fingerprint(loss="huber"),
    ]
    assert len(set(found)) == len(found)
    # What is chosen at first may be what another fit is given: 1 % of the brightness, 2048 points.
    assert fingerprint(noise=0.01) != found[0]
    assert fingerprint(settings=jaxhf.Settings(edge_samples=2048)) != found[0]
    assert fingerprint(max_steps=7, checkpoint_every=3, uncertainty=5) == found[0]  # what does not decide on the steps


def test_another_process_finds_the_same_fingerprint():
    script = (
        "import sys, jax; jax.config.update('jax_enable_x64', True); sys.path[:0] = sys.argv[1:]\n"
        "from test_fit_checkpoint import *; print(fingerprint(albedo='map', loss='geman', levels=[0.5, 1.0]))"
    )
    here = Path(__file__).parent
    command = [sys.executable, "-c", script, str(here.parents[1]), str(here)]
    found = subprocess.run(command, capture_output=True, text=True, check=True, timeout=120)
    assert found.stdout.strip() == fingerprint(albedo="map", loss="geman", levels=[0.5, 1.0])


def test_a_damaged_checkpoint_and_that_of_another_fit_are_refused(tmp_path, monkeypatch):
    """Before anything is rendered."""
    path = tmp_path / "fit.checkpoint"
    scenes, targets = problem()
    jaxhf.fit(scenes, targets, **{**OPTIONS, "max_steps": 2}, checkpoint=path)
    monkeypatch.setattr(_loop.FitLoop, "_initial_state", None)
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
