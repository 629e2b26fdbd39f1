"""The sweep as it runs: what it keeps, how it fails, that it can be killed and gone on with; its small fits."""

import csv
import os
import re
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from test_tradeoff import SCENE, SCENES

import jaxhf
from jaxhf.study import sweep as _sweeping
from jaxhf.study.measure import Derivative, Recovery, _thinned
from jaxhf.study.plan import COLUMNS, plan
from jaxhf.study.table import append_row, load_reference, read_rows, save_reference
from jaxhf.study.worker import MeasurementError, Worker, timed

# What is kept.

VALUES = dict.fromkeys(COLUMNS, "1")


def test_a_torn_row_does_not_count(tmp_path):
    path = tmp_path / "a.csv"
    assert read_rows(path, COLUMNS) == []
    append_row(path, COLUMNS, VALUES | {"identity": "first"})
    append_row(path, COLUMNS, VALUES | {"identity": "second, with a comma"})
    content = path.read_bytes()
    for cut in range(content.index(b"\n", content.index(b"first")) + 1, len(content)):
        path.write_bytes(content[:cut])
        assert [row["identity"] for row in read_rows(path, COLUMNS)] == ["first"]
    append_row(path, COLUMNS, VALUES | {"identity": "third"})
    assert [row["identity"] for row in read_rows(path, COLUMNS)] == ["first", "third"]
    path.write_bytes(content[:20])  # in the head
    append_row(path, COLUMNS, VALUES)
    assert len(read_rows(path, COLUMNS)) == 1


def test_a_foreign_table_is_refused(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("a,b\n1,2\n")
    with pytest.raises(ValueError, match=r"a\.csv: line 1: its columns are not those"):
        read_rows(path, COLUMNS)
    append_row(tmp_path / "b.csv", COLUMNS, VALUES)
    with (tmp_path / "b.csv").open("a") as file:
        file.write("1,2\n")
    with pytest.raises(ValueError, match=rf"b\.csv: line 3: a row must have {len(COLUMNS)} values"):
        read_rows(tmp_path / "b.csv", COLUMNS)


def test_a_reference_is_of_one_sweep(tmp_path):
    path = tmp_path / "a.npz"
    with pytest.raises(FileNotFoundError):
        load_reference(path, "one")
    save_reference(path, "one", {"picture": np.arange(3.0)})
    assert load_reference(path, "one")["picture"].tolist() == [0, 1, 2]
    with pytest.raises(ValueError, match="of another scene"):
        load_reference(path, "two")
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(ValueError, match=r"a\.npz: "):
        load_reference(path, "one")


# Processes.

SERVED = """
from jaxhf.core.machine import peak_mb
from jaxhf.study.worker import serve

def prepare(job):
    def die():
        raise ZeroDivisionError("on purpose")
    def traced():
        import jax
        def program(x):
            raise ZeroDivisionError("while tracing")
        jax.jit(program)(0)
    return {
        "ready": lambda: {"peak_mb": peak_mb(), "job": job}, "frame": lambda: {"seconds": 1.5}, "errors": die, "traced": traced
    }

serve(prepare)
"""


@pytest.fixture
def served(tmp_path):
    path = tmp_path / "served.py"
    path.write_text(SERVED)
    return str(path)


def test_a_worker_answers_until_it_dies(served):
    with Worker(served, {"size": [1, 2]}) as worker:
        assert worker.answer()["job"] == {"size": [1, 2]}
        assert worker.ask("frame") == {"seconds": 1.5}
        with pytest.raises(MeasurementError, match="ended with code 1: ZeroDivisionError: on purpose"):
            worker.ask("errors")
    assert worker.process.returncode is not None


def test_a_worker_says_why_it_died_while_tracing(served):
    with Worker(served, {}) as worker:
        worker.answer()
        with pytest.raises(MeasurementError, match="ended with code 1: ZeroDivisionError: while tracing"):
            worker.ask("traced")


def test_a_worker_that_is_killed_is_said_to_be(served):
    with Worker(served, {}) as worker:
        worker.answer()
        worker.process.kill()
        with pytest.raises(MeasurementError, match="was killed, as happens where memory runs out: it said nothing"):
            worker.ask("frame")


def test_a_worker_does_not_inherit_its_parents_peak(served):
    ours = np.ones(1 << 25)  # 256 MiB
    with Worker(served, {}) as worker:
        assert 5 < worker.answer()["peak_mb"] < 128
    assert ours[0] == 1


class Pretended(Worker):
    """What stands for `Worker`: a derivative's reference finds no memory, all else has figures."""

    def __init__(self, module, job):
        self.job, self.question = job, "ready"

    def send(self, question):
        self.question = question

    def answer(self):
        if self.job["task"] == "reference":
            if self.job["of"] == "derivative":
                raise MeasurementError("killed")
            save_reference(self.job["reference"], self.job["identity"], {"picture": np.zeros(1), "hits": np.zeros(1)})
        return {
            "ready": {"peak_mb": 100.0, "first_seconds": 2.0}, "frame": {"seconds": 1.0, "cpu_seconds": 1.0},
            "errors": {"rmse": 0.1, "p999": 0.1, "wrong_hits": 0.0},
        }[self.question]  # fmt: skip

    def ask(self, question):
        self.send(question)
        return self.answer()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass


def test_a_terrain_too_large_for_derivatives_has_pictures_measured(tmp_path, monkeypatch):
    monkeypatch.setattr(_sweeping, "Worker", Pretended)
    (tmp_path / "scene.toml").write_text(SCENE)
    sweep = plan(tmp_path / "scene.toml", tmp_path / "out", knobs=("traversal", "edge_samples"))
    told = []
    (failure,) = _sweeping.run(sweep, 1, told.append, lambda *_: None)
    assert failure == "derivative, the reference, and so all else of it: killed"
    assert [row.task for row in sweep.measured()] == ["picture", "picture"]
    assert {one.task for one in sweep.missing()} == {"derivative"}
    assert len(told) == 1


def test_errors_of_a_derivative_are_taken_over_draws(monkeypatch):
    """Of four, against the mean of four others."""
    exact, off = np.array([3.0, 4.0]), {0: 1.0, 1: 2.0, 2: 2.0, 3: 4.0, 4: -1.0, 5: 1.0, 6: -2.0, 7: 2.0}
    monkeypatch.setattr(Derivative, "_along_waves", lambda self, draw: exact + np.array([off[draw], 0.0]))
    derivative = Derivative.__new__(Derivative)
    reference = derivative.reference()
    np.testing.assert_array_equal(reference["gradient"], exact)
    errors = derivative.errors(reference)
    np.testing.assert_allclose(errors["relative_error"], np.sqrt((1 + 4 + 4 + 16) / 4) / 5)
    np.testing.assert_allclose(errors["spread"], np.std([0.2, 0.4, 0.4, 0.8], ddof=1))
    cosines = [(3 * (3 + d) + 16) / (5 * np.hypot(3 + d, 4)) for d in (1, 2, 2, 4)]
    np.testing.assert_allclose(errors["cosine"], np.mean(cosines))


def test_small_fits_are_measured_on_any_shape():
    """The side that is short already stays as it is."""
    heights = np.random.default_rng(0).uniform(0, 0.1, (3, 40))
    field = jaxhf.Heightfield(heights, dx=0.1, dy=0.5)
    thin = _thinned(field, 32)
    np.testing.assert_array_equal(thin.heights, heights[:, ::2])
    assert (thin.dx, thin.dy) == (0.2, 0.5)
    scene = jaxhf.Scene([jaxhf.Object(field)], jaxhf.Orthographic.look_at((2, 0.5, 5), (2, 0.5, 0), up=(0, 1, 0)))
    recovery = Recovery(scene, jaxhf.Settings(samples=1, shadows=False, chunk=256), 1e-2, [1.0])
    recovery.run()
    assert 0 < recovery.errors({})["rmse"] < 0.1


def test_short_runs_are_repeated(monkeypatch):
    """By a clock of which a run takes three seconds, and one of the processors on which it takes five."""
    runs = []
    monkeypatch.setattr(time, "perf_counter", lambda: 3.0 * len(runs))
    monkeypatch.setattr(time, "process_time", lambda: 5.0 * len(runs))
    for least, count in ((0.0, 1), (3.0, 1), (3.5, 2), (8.0, 3)):
        runs.clear()
        assert timed(lambda: runs.append(None), least) == {"seconds": 3, "cpu_seconds": 5}
        assert len(runs) == count


def test_fits_alone_need_no_reference(tmp_path):
    """All else of the sweep may be there from before, and the reference of another sweep."""
    job = {
        "task": "fit", "precision": "float32", "devices": 1, "settings": {"samples": 1, "shadows": False, "chunk": 256},
        "tolerance": 1e-2, "levels": [1.0], "scene": str(tmp_path / "scene.toml"), "width": 24, "height": 16,
        "reference": str(tmp_path / "missing.npz"), "identity": "",
    }  # fmt: skip
    (tmp_path / "scene.toml").write_text(SCENE)
    with Worker("jaxhf.study.measure", job) as worker:
        worker.answer()
        assert 0 < worker.ask("errors")["rmse"] < 1


def test_sweep_can_be_interrupted_and_gone_on_with(tmp_path):
    """Ctrl-C after the first row; then the rest, with the first row as it was; then nothing but a recommendation."""
    (tmp_path / "scene.toml").write_text(SCENE)
    table = tmp_path / "scene-tradeoff" / "tradeoff.csv"
    command = [
        sys.executable, "-m", "jaxhf", "tradeoff", "scene.toml", "--devices", "1", "--repeats", "3",
        "--knobs", "precision", "traversal",
    ]  # fmt: skip
    environment = {**os.environ, "PYTHONPATH": str(SCENES.parent)}
    pipes = {"cwd": tmp_path, "env": environment, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    # A suite in the background would hand on that it ignores Ctrl-C; a signal with a handler starts a program as default.
    ours = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        sweep = subprocess.Popen(command, **pipes)
    finally:
        signal.signal(signal.SIGINT, ours)
    with sweep:
        while not (table.exists() and table.read_text().count("\n") > 1):
            assert sweep.poll() is None, sweep.communicate()
            time.sleep(0.02)
        sweep.send_signal(signal.SIGINT)
        out, err = sweep.communicate(timeout=60)
    assert sweep.returncode == 130, err
    assert out == ""
    announced, *said = err.splitlines()
    assert re.search(r"3 of 3 configurations to measure, 24 x 16 pixels; about \d+ minutes", announced)
    assert said == ["", "jaxhf: interrupted"]
    begun = table.read_text()

    done = subprocess.run([*command, "--markdown"], **pipes, timeout=300)
    assert done.returncode == 0, done.stderr
    (announced,) = done.stderr.splitlines()
    assert "of 3 configurations to measure" in announced
    assert "3 of 3" not in announced
    assert done.stdout.startswith("| picture |")
    assert "|\n\n3 configurations: " in done.stdout
    assert table.read_text().startswith(begun)
    assert (table.parent / "tradeoff.png").read_bytes().startswith(b"\x89PNG")
    with table.open() as file:
        base, exact, dda = csv.DictReader(file)
    errors = ("rmse", "p999", "wrong_hits")
    assert [base[name] for name in errors] == [dda[name] for name in errors]  # the same hits, bit for bit
    assert (exact["precision"], dda["traversal"]) == ("float64", "dda")
    assert abs(float(exact["rmse"]) - float(base["rmse"])) < 1e-6
    assert float(exact["wrong_hits"]) == 0
    assert 0.01 < float(base["rmse"]) < 1  # one sample a pixel against 256
    for name in ("seconds", "against_base", "cpu_seconds", "compile_seconds"):
        assert float(base[name]) > 0
    assert float(base["peak_mb"]) > 100

    begin = time.perf_counter()
    asked = subprocess.run([*command, "--error", "1"], **pipes, timeout=60)
    assert asked.stderr == ""
    assert asked.stdout.startswith("picture, error 1: Settings(")
    assert time.perf_counter() - begin < 30


def test_options_are_checked_first(tmp_path):
    (tmp_path / "scene.toml").write_text(SCENE)
    for options, message in ((["--error", "-1"], "--error must be positive, it is -1"), (["--knobs", "x"], "one is 'x'")):
        run = subprocess.run(
            [sys.executable, "-m", "jaxhf", "tradeoff", "scene.toml", *options], cwd=tmp_path, capture_output=True, text=True,
            env={**os.environ, "PYTHONPATH": str(SCENES.parent)}, timeout=60,
        )  # fmt: skip
        assert run.returncode == 2
        (line,) = run.stderr.splitlines()
        assert message in line
    assert [path.name for path in tmp_path.iterdir()] == ["scene.toml"]


@pytest.mark.slow
def test_two_sweeps_agree(tmp_path):
    """In every error; and in the order of times that are at least a fifth apart."""
    (tmp_path / "scene.toml").write_text(SCENE)
    found = []
    for folder in ("one", "two"):
        command = [sys.executable, "-m", "jaxhf", "tradeoff", "scene.toml", "-o", folder, "--quick", "--width", "192"]
        subprocess.run(command, cwd=tmp_path, check=True, env={**os.environ, "PYTHONPATH": str(SCENES.parent)}, timeout=3600)
        found.append(plan(tmp_path / "scene.toml", tmp_path / folder, quick=True, width=192).measured())
    for one, two in zip(*found, strict=True):
        for name in ("rmse", "p999", "wrong_hits", "cosine", "relative_error"):
            assert one.figures.get(name) == two.figures.get(name), (one.knobs, name)
    times = [np.array([row.figures["against_base"] for row in rows if row.task == "picture"]) for rows in found]
    apart = times[0][:, None] > 1.2 * times[0]
    assert apart.sum() > 20
    assert (times[1][:, None] > times[1])[apart].all()
