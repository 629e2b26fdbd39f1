"""A fit that is cut short goes on from its checkpoint, to the same bits."""

import contextlib
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_fits import given, posed

import jaxhf
from jaxhf.fitting import fit as _fit
from jaxhf.fitting.model.expansion import Expansion, found_scenes
from jaxhf.fitting.solve import run as _run, steps as _steps
from jaxhf.fitting.solve.stages import fingerprint as state_fingerprint
from jaxhf.fitting.solve.steps import Outcome
from jaxhf.fitting.trust import judge as _judge

SETTINGS = jaxhf.Settings(shadows=False, samples=1, chunk=256, edge_samples=0)
OPTIONS: dict[str, Any] = {"settings": SETTINGS, "max_steps": 24, "unknown": jaxhf.Unknown(light_std=1.0)}


def problem(count: int = 17) -> tuple[list[jaxhf.Scene], list[np.ndarray]]:
    camera = jaxhf.Perspective.look_at((0.5, 0.5, 3.0), (0.5, 0.5, 0.0), up=(0, 1, 0), fov=18.0, width=12, height=12)

    def scene(heights):
        return jaxhf.Scene([jaxhf.Object(jaxhf.Heightfield(heights))], camera, [jaxhf.Directional((1, 2, 3))])

    y, x = np.mgrid[0 : 1 : count * 1j, 0 : 1 : count * 1j]
    return [scene(np.zeros((count, count)))], [np.asarray(jaxhf.render(scene(0.1 * np.sin(4 * x + y)), SETTINGS))]


@pytest.fixture(scope="module", autouse=True)
def soon_judged() -> Iterator[None]:
    """The noise is estimated on the way, and not once more at the end, which takes longer than all steps."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(_judge, "_restricted", lambda ended, *_: (ended.expansion, None))
        yield


@pytest.fixture(scope="module")
def whole() -> jaxhf.Fit:
    """8 modes a side, then 16, and all once more."""
    found = jaxhf.fit(*problem(), **OPTIONS)
    assert {step.level for step in found.history} == {9, 17}
    return found


def agree(found: jaxhf.Fit, whole: jaxhf.Fit) -> None:
    np.testing.assert_array_equal(found.heights, whole.heights)
    assert found.result is whole.result
    assert [step._replace(seconds=0.0) for step in found.history] == [step._replace(seconds=0.0) for step in whole.history]
    for scene, other in zip(found.scenes, whole.scenes, strict=True):
        (light,), (same,) = scene.lights, other.lights
        assert isinstance(light, jaxhf.Directional)
        assert isinstance(same, jaxhf.Directional)
        np.testing.assert_array_equal(light.towards, same.towards)


def begun(path: Path, every: int = 2, **options) -> jaxhf.Fit:
    return jaxhf.fit(*problem(), **{**OPTIONS, **options}, checkpoint=jaxhf.Checkpoint(path, every))


def resumed(path: Path, whole: jaxhf.Fit, **options) -> list[jaxhf.Step]:
    """The steps that are taken once more, after which all is as if nothing had happened."""
    again, checkpoint = [], jaxhf.Checkpoint(path, 2, resume=True)
    agree(jaxhf.fit(*problem(), **{**OPTIONS, **options}, checkpoint=checkpoint, progress=again.append), whole)
    return again


def interrupted(path: Path, last: int, fit: Callable[..., jaxhf.Fit] = begun) -> None:
    """Ctrl-C after the step of this number."""

    def interrupt(step: Any) -> None:
        if step.step == last:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fit(path, progress=interrupt)


@pytest.mark.parametrize("last", [2, "level", *(pytest.param(step, marks=pytest.mark.deep) for step in (1, 3, 5, "end"))])
def test_after_ctrl_c_it_goes_on_to_the_same_bits(tmp_path, whole, last):
    """In a stage, and after the last step of one."""
    first_of_all = next(step.step for step in whole.history if step.level == 17)
    last = {"level": first_of_all - 1, "end": len(whole.history) - 1}.get(last, last)
    path = tmp_path / "fit.checkpoint"
    interrupted(path, last)
    assert resumed(path, whole)[0].step == last + 1
    assert [file.name for file in tmp_path.iterdir()] == [path.name]


@pytest.mark.deep  # steps go on to the same bits above
def test_it_goes_on_among_rejected_steps(tmp_path, monkeypatch):
    """After one, and after two in a row, where λ grows faster: where hardly a step gains twice what was predicted."""
    monkeypatch.setattr(_steps, "_LEAST_GAIN", 2.0)
    monkeypatch.setattr(_steps, "_GOOD", 3.0)
    whole = jaxhf.fit(*problem(), **OPTIONS)
    accepted = [step.accepted for step in whole.history]
    once, twice = accepted.index(False) + 1, accepted.index(False) + 2
    assert not accepted[twice - 1]
    for last in (once, twice):
        path = tmp_path / f"{last}.checkpoint"
        interrupted(path, last)
        assert resumed(path, whole)[0].step == last + 1


class Slow:
    """A number that is still being computed when Ctrl-C comes."""

    def __float__(self) -> float:
        raise KeyboardInterrupt


@contextlib.contextmanager
def ctrl_c(monkeypatch, name: str, call: int, waiting: bool = False):
    """Ctrl-C as `_run` has called the function of this name for so many times: in it, or where its loss is waited for."""
    original, calls = getattr(_run, name), []

    def stopping(*arguments):
        calls.append(arguments)
        found = original(*arguments)
        if len(calls) != call:
            return found
        if not waiting:
            raise KeyboardInterrupt
        unknowns, position, outcome = found
        return unknowns, position, outcome._replace(loss=Slow())

    with monkeypatch.context() as patched:
        patched.setattr(_run, name, stopping)
        with pytest.raises(KeyboardInterrupt):
            yield


# Which function is interrupted in which of its calls, whether its result is being waited for, and the step that comes next:
# None is the first one of the second stage.
CTRL_C = [("spreads", 1, False, 1), ("advance", 3, True, 3), ("balanced", 2, False, None)]
MORE = [("expand", 1, False, 1), *(("advance", 1, waiting, 1) for waiting in (False, True))]
MORE += [("first_position", 1, False, 1), ("expand", 2, False, 2)]


@pytest.mark.parametrize(
    ("name", "call", "waiting", "step"), [*CTRL_C, *(pytest.param(*case, marks=pytest.mark.deep) for case in MORE)]
)
def test_ctrl_c_leaves_nothing_half_made(tmp_path, monkeypatch, whole, name, call, waiting, step):
    path = tmp_path / "fit.checkpoint"
    with ctrl_c(monkeypatch, name, call, waiting):
        begun(path)
    step = step or next(done.step for done in whole.history if done.level == 17)
    began = name == "advance" or step > 1  # else there is nothing to be kept
    assert [file.name for file in tmp_path.iterdir()] == ([path.name] if began else [])
    assert resumed(path, whole)[0].step == step


def test_ctrl_c_after_the_last_step_keeps_them_all(tmp_path, monkeypatch, whole):
    def interrupt(*_):
        raise KeyboardInterrupt

    path = tmp_path / "fit.checkpoint"
    with monkeypatch.context() as patched:
        patched.setattr(_judge, "standard_deviations", interrupt)
        with pytest.raises(KeyboardInterrupt):
            begun(path, every=100, draws=2)
    assert resumed(path, whole) == []


def test_a_checkpoint_that_cannot_be_kept_is_refused_first(tmp_path):
    """As it is named, so before anything begins."""
    path = tmp_path / "fit.checkpoint"
    with pytest.raises(FileNotFoundError, match=r"none/fit\.checkpoint: there is no folder"):
        jaxhf.Checkpoint(tmp_path / "none" / "fit.checkpoint", resume=True)
    with pytest.raises(ValueError, match=r"a checkpoint cannot be written here, it is a folder"):
        jaxhf.Checkpoint(tmp_path, resume=True)
    path.write_bytes(b"hours of work")
    with pytest.raises(ValueError, match=r"fit\.checkpoint: this checkpoint is there already; resume=True goes on from it"):
        jaxhf.Checkpoint(path)
    with pytest.raises(ValueError, match=r"fit\.checkpoint: this is not a checkpoint of jaxhf's"):
        jaxhf.Checkpoint(path, resume=True)
    assert path.read_bytes() == b"hours of work"
    with pytest.raises(ValueError, match="Checkpoint: every must be a whole number from 1 on, it is 0"):
        jaxhf.Checkpoint(tmp_path / "other", every=0)


def without_pictures(setattr: Callable[..., None]) -> None:
    """Replaces all that renders, where the noise is given: steps add to the coefficients what a counter says."""

    class Position(NamedTuple):
        y_eval: Any
        step_size: jnp.ndarray
        fresh: bool = False

    def advance(unknowns, position, *_):
        if position.fresh:  # only evaluates
            new, size = unknowns, position.step_size
        else:
            new, size = position.y_eval, position.step_size + 1
        there = eqx.tree_at(lambda u: u.coefficients, new, new.coefficients + jnp.sin(size))
        loss = 1e6 * jnp.exp(-size / 10)
        return new, Position(there, size), Outcome(loss, jnp.asarray(True), loss, size, 1 / size)

    setattr(_run, "expand", lambda unknowns, problem, *_: Expansion(problem, unknowns, (None,) * len(problem.groups)))
    setattr(_run, "advance", advance)
    setattr(_run, "first_position", lambda expansion, step_size: Position(expansion.unknowns, step_size, True))
    setattr(_run, "spreads", lambda expansion: np.ones(1))
    setattr(_run, "balanced", units_of_one)
    setattr(_fit, "judged", judged_as_it_is)


def units_of_one(expansion: Expansion) -> tuple[np.ndarray, float, Any]:
    others = jax.tree.map(np.ones_like, expansion.unknowns.without_modes())
    return np.ones(expansion.problem.basis.base.shape), 1.0, others


def judged_as_it_is(ended, scenes, targets, given, report) -> jaxhf.Fit:
    """Without a look at its pictures."""
    problem, unknowns, none = ended.expansion.problem, ended.expansion.unknowns, np.zeros((12, 12, 1))
    return jaxhf.Fit(
        heights=problem.basis.crop(problem.basis.base), result=ended.stop, std=None, samples=None,
        seen=np.ones(ended.expansion.heights.shape, bool), albedo=unknowns.albedo, exposures=None, offsets=None,
        noise=problem.noise, scenes=found_scenes(scenes, unknowns, problem), settings=problem.settings, images=(none,),
        residuals=(none,), regions=(), warnings=(), stats={}, history=ended.state.history,
    )  # fmt: skip


def test_it_goes_on_with_coarse_and_with_fine_heights(tmp_path, monkeypatch):
    """A checkpoint holds as many numbers as its level has: of the heights with their padding, and of the albedo."""
    without_pictures(monkeypatch.setattr)
    monkeypatch.setattr(_fit, "_MOST_SAMPLES", 100)
    monkeypatch.setattr(_fit, "_FACTOR", 2)
    scenes, targets = problem(33)
    unknown = jaxhf.Unknown(albedo="map", light_std=1.0)
    held = np.where(np.indices((33, 33)).sum(0) % 7 == 3, 0.15, np.nan)
    options = OPTIONS | {"noise": 1.0, "prior": jaxhf.Prior(0.1, 1.0, 0.1, held), "unknown": unknown}

    def fit(path: Path | None = None, resume: bool = False, **more: Any) -> jaxhf.Fit:
        return jaxhf.fit(scenes, targets, **options, **more, checkpoint=path and jaxhf.Checkpoint(path, resume=resume))

    whole = fit()
    assert (np.asarray(whole.heights)[np.isfinite(held)] == np.float32(0.15)).all()
    coarse = sum(step.level < 33 for step in whole.history)  # 17 heights a side, with 2 beyond each border
    assert 2 < coarse < len(whole.history) - 2
    for last in (1, coarse - 1, coarse, coarse + 1, len(whole.history) - 1):
        path = tmp_path / f"{last}.checkpoint"
        interrupted(path, last, fit)
        agree(fit(path, resume=True), whole)


def run_python(program: str, *arguments: str) -> subprocess.Popen:
    """Another process, in which this module's names are there."""
    here = Path(__file__).parent
    start = f"import sys; sys.path[:0] = {[str(here.parents[1]), str(here)]!r}\n"
    return subprocess.Popen([sys.executable, "-c", start + program, *arguments], stdout=subprocess.PIPE, text=True)


@pytest.mark.deep  # what is kept on Ctrl-C is kept as it goes
def test_a_killed_process_loses_at_most_one_interval(tmp_path, monkeypatch):
    path, options = tmp_path / "fit.checkpoint", {"max_steps": 12, "noise": 1.0}
    program = (
        "import time; from test_fit_checkpoint import *; without_pictures(setattr)\n"
        "def progress(step):\n    print(step.step, flush=True)\n    time.sleep(0.2)\n"
        "begun(sys.argv[1], max_steps=12, noise=1.0, progress=progress)"
    )
    with run_python(program, str(path)) as process:
        assert process.stdout is not None
        for line in process.stdout:
            if int(line) == 5:
                process.send_signal(signal.SIGKILL)
                break
    assert process.returncode == -signal.SIGKILL
    without_pictures(monkeypatch.setattr)
    whole = jaxhf.fit(*problem(), **{**OPTIONS, **options})
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
    chosen = given(**options)
    return state_fingerprint(*posed([scene], [np.zeros(size)], chosen), chosen)


def test_a_fingerprint_tells_problems_apart_that_hold_the_same_numbers():
    """Pictures of 4 x 6 and 6 x 4 zeros, a reflected share of 0.5, ...: the bytes of all arrays are the same."""
    options: list[dict[str, Any]] = [
        {}, {"samples": 4}, {"material": jaxhf.Mirror(0.5)}, {"size": (6, 4)}, {"settings": jaxhf.Settings(samples=9)},
        {"unknown": jaxhf.Unknown(exposures=True)}, {"unknown": jaxhf.Unknown(offsets=True)},
        {"unknown": jaxhf.Unknown(albedo="constant")}, {"unknown": jaxhf.Unknown(albedo="constant", albedo_std=2)},
        {"unknown": jaxhf.Unknown(light_std=1)}, {"prior": jaxhf.Prior(0.0, 1.0)}, {"prior": jaxhf.Prior(0.0, 1.0, 0.5)},
    ]  # fmt: skip
    found = [fingerprint(**given) for given in options]
    assert len(set(found)) == len(found)
    # What is chosen at first may be what another fit is given: 1 % of the brightness, 2048 points.
    assert fingerprint(noise=0.01) != found[0]
    assert fingerprint(settings=jaxhf.Settings(edge_samples=2048)) != found[0]
    assert fingerprint(max_steps=7, draws=5) == found[0]  # what does not decide on the steps


@pytest.mark.deep  # a killed process has left one, too
def test_another_process_finds_the_same_fingerprint():
    program = "from test_fit_checkpoint import *; print(fingerprint(unknown=jaxhf.Unknown(albedo='map')))"
    found, _ = run_python(program).communicate(timeout=120)
    assert found.strip() == fingerprint(unknown=jaxhf.Unknown(albedo="map"))


def test_a_damaged_checkpoint_and_that_of_another_fit_are_refused(tmp_path, monkeypatch):
    """Before anything is rendered."""
    path = tmp_path / "fit.checkpoint"
    scenes, targets = problem()
    begun(path, max_steps=2)
    monkeypatch.setattr(_run, "expand", None)
    with pytest.raises(ValueError, match=r"fit\.checkpoint: this is the checkpoint of another fit"):
        jaxhf.fit(scenes, [targets[0] + 1], **OPTIONS, checkpoint=jaxhf.Checkpoint(path, resume=True))
    content = bytearray(path.read_bytes())
    content[-100] ^= 1
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"fit\.checkpoint: the checkpoint is damaged"):
        jaxhf.Checkpoint(path, resume=True)
