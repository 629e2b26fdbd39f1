"""A fit that is cut short goes on from its checkpoint, to the same bits."""

import contextlib
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
from small_fits import fit_options

import jaxhf
from jaxhf.fitting import fit as _fit, known as _known, loop as _loop
from jaxhf.fitting.fingerprint import fingerprint as fit_fingerprint
from jaxhf.fitting.problem import make_problem
from jaxhf.fitting.solvers import Outcome

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


def resumed(path: Path, whole: jaxhf.Fit, **options) -> list[jaxhf.Step]:
    """The steps that are taken once more, after which all is as if nothing had happened."""
    again = []
    agree(jaxhf.fit(*problem(), **{**OPTIONS, **options}, checkpoint=path, resume=True, progress=again.append), whole)
    return again


@pytest.mark.parametrize("last", [4, *(pytest.param(step, marks=pytest.mark.deep) for step in (1, 7))])
def test_after_ctrl_c_it_goes_on_to_the_same_bits(tmp_path, whole, last):
    def interrupt(step: Any) -> None:
        if step.step == last:
            raise KeyboardInterrupt

    path = tmp_path / "fit.checkpoint"
    with pytest.raises(KeyboardInterrupt):
        jaxhf.fit(*problem(), **OPTIONS, checkpoint=path, progress=interrupt)
    assert resumed(path, whole)[0].step == last + 1
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


# Which function is interrupted in which of its calls, whether its result is being waited for, and the step that comes next.
CTRL_C = [
    ("pictures_and_influence", 1, False, 1),  # before the first level
    ("advance", 1, True, 1),
    ("save_checkpoint", 1, False, 3),
    ("advance", 5, True, 5),
    ("pictures_and_influence", 11, False, 10),  # the first of those that measure the loss's curvature, as the level changes
    ("reset_state", 3, False, 19),
]
MORE = [
    ("init_state", 1, False, 1), ("advance", 1, False, 1), ("advance", 2, True, 2), ("pictures_and_influence", 10, False, 10),
    ("reset_state", 2, False, 10), ("pictures_and_influence", 19, False, 19),
]  # fmt: skip


@pytest.mark.parametrize(
    ("name", "call", "waiting", "step"), [*CTRL_C, *(pytest.param(*case, marks=pytest.mark.deep) for case in MORE)]
)
def test_ctrl_c_leaves_nothing_half_made(tmp_path, monkeypatch, whole, name, call, waiting, step):
    path = tmp_path / "fit.checkpoint"
    with ctrl_c(monkeypatch, name, call, waiting):
        jaxhf.fit(*problem(), **OPTIONS, checkpoint=path)
    began = (name, call) not in (("init_state", 1), ("pictures_and_influence", 1))
    assert [file.name for file in tmp_path.iterdir()] == ([path.name] if began else [])
    assert resumed(path, whole)[0].step == step


# The first accepted step of a line search is the 16th.
@pytest.mark.deep
@pytest.mark.parametrize(("solver", "step"), [("bfgs", 21), ("lbfgs", 21), ("adam", 5)])
def test_ctrl_c_keeps_the_step_before_of_other_solvers(tmp_path, monkeypatch, solver, step):
    path, options = tmp_path / "fit.checkpoint", {**OPTIONS, "solver": solver, "levels": [1.0], "noise": 0.01}
    whole = jaxhf.fit(*problem(), **options)
    assert whole.history[step - 1].accepted
    with ctrl_c(monkeypatch, "advance", step, waiting=True):
        jaxhf.fit(*problem(), **options, checkpoint=path)
    assert resumed(path, whole, **options)[0].step == step


def test_ctrl_c_after_the_last_step_keeps_them_all(tmp_path, monkeypatch, whole):
    def interrupt(*_):
        raise KeyboardInterrupt

    path, options = tmp_path / "fit.checkpoint", {**OPTIONS, "checkpoint_every": 100}
    with monkeypatch.context() as patched:
        patched.setattr(_fit, "standard_deviations", interrupt)
        with pytest.raises(KeyboardInterrupt):
            jaxhf.fit(*problem(), **options, uncertainty="exact", checkpoint=path)
    assert resumed(path, whole, **options) == []


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


def run_python(program: str, *arguments: str) -> subprocess.Popen:
    """Another process, in which this module's names are there."""
    here = Path(__file__).parent
    start = f"import sys; sys.path[:0] = {[str(here.parents[1]), str(here)]!r}\n"
    return subprocess.Popen([sys.executable, "-c", start + program, *arguments], stdout=subprocess.PIPE, text=True)


def test_a_killed_process_loses_at_most_one_interval(tmp_path, monkeypatch):
    path, options = tmp_path / "fit.checkpoint", {**OPTIONS, "max_steps": 12}
    program = (
        "import time; from test_fit_checkpoint import *; without_pictures(setattr)\n"
        "def progress(step):\n    print(step.step, flush=True)\n    time.sleep(0.2)\n"
        "jaxhf.fit(*problem(), **{**OPTIONS, 'max_steps': 12}, checkpoint=sys.argv[1], progress=progress)"
    )
    with run_python(program, str(path)) as process:
        assert process.stdout is not None
        for line in process.stdout:
            if int(line) == 5:
                process.send_signal(signal.SIGKILL)
                break
    assert process.returncode == -signal.SIGKILL
    without_pictures(monkeypatch.setattr)
    whole = jaxhf.fit(*problem(), **options)
    assert len(whole.history) == 12
    assert 4 <= resumed(path, whole, **options)[0].step - 1 <= 5  # kept after 4, or a step later than it was told


@pytest.mark.slow
def test_steps_are_compiled_once_on_two_devices():
    """Where a step's results lay elsewhere than its arguments, two thirds of the compilation came after the first step."""
    program = """
import jax
jax.config.update("jax_num_cpu_devices", 2)  # before it is first used
from test_fit_checkpoint import *
spent, by_then = [], []
jax.monitoring.register_event_duration_secs_listener(
    lambda event, seconds, **_: spent.append(seconds) if event.startswith("/jax/core/compile/") else None
)
jaxhf.fit(*problem(), **OPTIONS, progress=lambda step: by_then.append(sum(spent)))
print(len(jax.devices()), by_then[0], by_then[-1])
"""
    devices, first, last = map(float, run_python(program).communicate()[0].split())
    assert devices == 2
    assert last < 1.2 * first


def fingerprint(size=(4, 6), material: jaxhf.Matte | jaxhf.Mirror | None = None, samples: int = 1, **options) -> str:
    """That of a fit of one black picture, by the sampling that its scene asks for."""
    height, width = size
    camera = jaxhf.Perspective.look_at((0.5, 0.5, 3.0), (0.5, 0.5, 0.0), up=(0, 1, 0), fov=18.0, width=width, height=height)
    terrain = jaxhf.Object(jaxhf.Heightfield(np.zeros((3, 3))), material or jaxhf.Matte(0.5))
    scene = jaxhf.Scene([terrain], camera, [jaxhf.Directional((1, 2, 3))], samples=samples)
    chosen = fit_options(**options)
    return fit_fingerprint(*make_problem([scene], [np.zeros(size)], chosen), chosen)


def test_a_fingerprint_tells_problems_apart_that_hold_the_same_numbers():
    """Pictures of 4 x 6 and 6 x 4 zeros, a reflected share of 0.5, ...: the bytes of all arrays are the same."""
    options: list[dict[str, Any]] = [
        {}, {"samples": 4}, {"material": jaxhf.Mirror(0.5)}, {"size": (6, 4)}, {"settings": jaxhf.Settings(samples=9)},
        {"solver": "adam"}, {"levels": [0.5, 1.0]}, {"inner_steps": 50}, {"tolerance": 1e-5}, {"exposures": True},
        {"offsets": True}, {"albedo": "constant"}, {"loss": "cauchy"}, {"loss": "huber"},
    ]  # fmt: skip
    found = [fingerprint(**given) for given in options]
    assert len(set(found)) == len(found)
    # What is chosen at first may be what another fit is given: 1 % of the brightness, 2048 points.
    assert fingerprint(noise=0.01) != found[0]
    assert fingerprint(settings=jaxhf.Settings(edge_samples=2048)) != found[0]
    assert fingerprint(max_steps=7, checkpoint_every=3, uncertainty=5) == found[0]  # what does not decide on the steps


@pytest.mark.deep  # a killed process has left one, too
def test_another_process_finds_the_same_fingerprint():
    program = "from test_fit_checkpoint import *; print(fingerprint(albedo='map', loss='geman', levels=[0.5, 1.0]))"
    found, _ = run_python(program).communicate(timeout=120)
    assert found.strip() == fingerprint(albedo="map", loss="geman", levels=[0.5, 1.0])


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
