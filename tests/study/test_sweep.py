"""The sweep as it runs: what it keeps, how it fails, that it can be interrupted and gone on with.

One sweep is real. What surrounds it is tested with pretended processes: real ones take seconds to compile, each.
"""

import csv
import dataclasses
import os
import re
import subprocess
import sys
import time

import numpy as np
import pytest
import served
from test_tradeoff import SCENE

from jaxhf.cli.main import main
from jaxhf.study import sweep as _sweeping
from jaxhf.study.measure import Derivative
from jaxhf.study.plan import plan
from jaxhf.study.table import COLUMNS, FIGURES, Row, Sweep, read_rows
from jaxhf.study.worker import MeasurementError, Worker, timed


@pytest.fixture
def sweep(tmp_path) -> Sweep:
    """Of the base, double precision and the other traversal."""
    (tmp_path / "scene.toml").write_text(SCENE)
    (tmp_path / "out").mkdir()
    return plan(tmp_path / "scene.toml", tmp_path / "out", knobs=("precision", "traversal"), devices=1)


def command(sweep: Sweep, *options: str) -> list[str]:
    return ["tradeoff", str(sweep.path), "-o", str(sweep.folder), "--devices", "1", "--knobs", *options]


def run_quietly(sweep: Sweep, repeats: int = 1, tell=lambda line: None) -> list[str]:
    return _sweeping.run(sweep, repeats, tell, lambda *_: None)


# What is kept.


def test_rows_appear_whole(sweep, monkeypatch):
    assert sweep.measured() == []
    for k, one in enumerate(sweep.configurations[:2]):
        sweep.add(one, {"seconds": 2.0 + k, "against_base": 1.5 + k})
    text = sweep.table.read_text()
    with monkeypatch.context() as patched:
        patched.setattr(os, "replace", lambda *_: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            sweep.add(sweep.configurations[2], {"seconds": 3.0})
    assert sweep.table.read_text() == text
    assert list(sweep.folder.iterdir()) == [sweep.table]
    assert text.splitlines()[0] == ",".join(COLUMNS)
    assert [row["seconds"] for row in sweep.measured()] == [3.0, 5.0]  # ratios, in units of the base's own
    assert sweep.missing() == [sweep.configurations[2]]
    sweep.table.write_text(text.replace(sweep.identity, "another"))
    assert sweep.measured() == []


def test_a_foreign_table_is_refused(sweep):
    sweep.table.write_text("a,b\n1,2\n")
    with pytest.raises(ValueError, match=r"tradeoff\.csv: line 1: its columns are not those"):
        read_rows(sweep.table)
    sweep.table.unlink()
    sweep.add(sweep.configurations[0], {"seconds": 1.0})
    with sweep.table.open("a") as file:
        file.write("1,2\n")
    with pytest.raises(ValueError, match=rf"tradeoff\.csv: line 3: a row must have {len(COLUMNS)} values"):
        sweep.missing()


# Processes.


def test_a_worker_answers_until_it_is_killed():
    """It neither takes over its parent's peak of memory nor listens to Ctrl-C."""
    ours = np.ones(1 << 26)  # 512 MiB
    with Worker(served.prepare, {"size": [1, 2]}) as worker:
        ready = worker.answer()
        assert ready["job"] == {"size": [1, 2]}
        assert 5 < ready["peak_mb"] < 400
        assert worker.ask("frame") == {"seconds": 1.5}
        worker.ask("interrupted")
        assert worker.ask("frame") == {"seconds": 1.5}
        worker.process.kill()
        with pytest.raises(MeasurementError, match="was killed, as happens where memory runs out: it said nothing"):
            worker.ask("frame")
    assert not worker.process.is_alive()
    assert ours[0] == 1


@pytest.mark.parametrize(("question", "said"), [("errors", "on purpose"), ("traced", "while tracing")])
def test_a_worker_says_why_it_died(question, said):
    with Worker(served.prepare, {}) as worker:
        worker.answer()
        with pytest.raises(MeasurementError, match=f"ended with code 1: ZeroDivisionError: {said}"):
            worker.ask(question)


class Pretended(Worker):
    """Stands for a process that measures; notes who was started, and dies where `fatal` says so."""

    started: list[Row]
    fatal: tuple[str, str, str]

    def __init__(self, prepare, job):
        (self.sweep, self.one), self.question = job, "ready"
        self.started.append(self.one)

    def send(self, question):
        self.question = question

    def answer(self):
        if (self.one["task"], self.one["traversal"], self.question) == self.fatal:
            raise MeasurementError("killed")
        if self.question == "reference":
            np.savez(self.sweep.reference(self.one["task"]), picture=np.zeros(1))
        frame = {"seconds": 2.0 if self.one["traversal"] == "dda" else 1.0, "cpu_seconds": 1.0}
        return {
            "ready": {"peak_mb": 100.0, "first_seconds": 3.0}, "frame": frame, "reference": {},
            "errors": {"rmse": 0.1, "p999": 0.1, "wrong_hits": 0.0},
        }[self.question]  # fmt: skip

    def __exit__(self, *_):
        pass


@pytest.fixture
def started(monkeypatch) -> list[Row]:
    monkeypatch.setattr(Pretended, "started", [], raising=False)
    monkeypatch.setattr(Pretended, "fatal", (), raising=False)
    monkeypatch.setattr(_sweeping, "Worker", Pretended)
    return Pretended.started


def test_a_terrain_too_large_for_derivatives_has_pictures_measured(tmp_path, sweep, started, monkeypatch):
    monkeypatch.setattr(Pretended, "fatal", ("derivative", "pyramid", "reference"))
    sweep = plan(sweep.path, sweep.folder, knobs=("traversal", "edge_samples"))
    told = []
    (failure,) = run_quietly(sweep, tell=told.append)
    assert failure == "derivative, the reference, and so all else of it: killed"
    assert [row["task"] for row in sweep.measured()] == ["picture", "picture"]
    assert {one["task"] for one in sweep.missing()} == {"derivative"}
    assert len(told) == 1


@pytest.mark.parametrize("question", ["frame", *(pytest.param(name, marks=pytest.mark.deep) for name in ("ready", "errors"))])
def test_a_process_that_dies_is_listed(sweep, started, monkeypatch, capsys, question):
    monkeypatch.setattr(Pretended, "fatal", ("picture", "dda", question))
    assert main(command(sweep, "precision", "traversal")) == 2
    out, err = capsys.readouterr()
    assert "2 configurations: " in out
    assert err.splitlines()[1:] == ["failed: picture, traversal dda: killed", "jaxhf: error: 1 configuration failed"]
    assert [one["traversal"] for one in sweep.missing()] == ["dda"]
    monkeypatch.setattr(Pretended, "fatal", ("picture", "pyramid", question))
    with pytest.raises(MeasurementError, match="killed"):
        run_quietly(dataclasses.replace(sweep, folder=sweep.folder / "another"))


def test_runs_are_taken_in_turn_with_those_of_the_base(sweep, started):
    assert run_quietly(sweep, 5) == []
    base, exact, dda = sweep.measured()
    assert (base["against_base"], exact["against_base"], dda["against_base"]) == (1, 1, 2)
    assert {name: dda[name] for name in FIGURES if name in dda} == {
        "seconds": 2, "fastest": 2, "cpu_seconds": 1, "against_base": 2, "compile_seconds": 1, "peak_mb": 100,
        "rmse": 0.1, "p999": 0.1, "wrong_hits": 0,
    }  # fmt: skip


def test_interrupted_it_goes_on_where_it_was(sweep, started, monkeypatch, capsys):
    """Ctrl-C after the first row; then the rest, with the first row as it was; then nothing but a recommendation."""
    arguments, add = command(sweep, "precision", "traversal"), Sweep.add

    def add_one(self, *row):
        add(self, *row)
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(Sweep, "add", add_one)
        assert main(arguments) == 130
    out, err = capsys.readouterr()
    assert out == ""
    announced, *said = err.splitlines()
    assert re.search(r"3 of 3 configurations to measure, 24 x 16 pixels; about \d+ minutes", announced)
    assert said == ["", "jaxhf: interrupted"]
    begun = sweep.table.read_text()
    assert begun.count("\n") == 2
    base, exact, dda = sweep.configurations
    assert started == [base, sweep.references[0], base]

    started.clear()
    assert main([*arguments, "--markdown"]) == 0
    out, err = capsys.readouterr()
    assert "2 of 3 configurations to measure" in err
    assert out.startswith("| picture |")
    assert started == [base, exact, dda]  # no reference again
    assert sweep.table.read_text().startswith(begun)

    started.clear()
    assert main([*arguments, "--error", "1"]) == 0
    out, err = capsys.readouterr()
    assert (started, err) == ([], "")
    assert out.startswith("picture, error 1: Settings(")


def test_progress_is_shown_on_a_terminal(sweep, started, monkeypatch, capsys):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    assert main(command(sweep, "traversal")) == 0
    err = capsys.readouterr().err
    for text in ("0/2", "the base", "the picture's reference, in double precision", "1/2", "picture, traversal dda"):
        assert text in err


def test_errors_of_a_derivative_are_taken_over_draws(monkeypatch):
    """Of four, against the mean of four others."""
    exact, off = np.array([3.0, 4.0]), {0: 1.0, 1: 2.0, 2: 2.0, 3: 4.0, 4: -1.0, 5: 1.0, 6: -2.0, 7: 2.0}
    monkeypatch.setattr(Derivative, "along_modes", lambda self, draw: exact + np.array([off[draw], 0.0]))
    derivative = Derivative.__new__(Derivative)
    reference = derivative.reference()
    np.testing.assert_array_equal(reference["gradient"], exact)
    errors = derivative.errors(reference)
    np.testing.assert_allclose(errors["relative_error"], np.sqrt((1 + 4 + 4 + 16) / 4) / 5)
    np.testing.assert_allclose(errors["spread"], np.std([0.2, 0.4, 0.4, 0.8], ddof=1))
    cosines = [(3 * (3 + d) + 16) / (5 * np.hypot(3 + d, 4)) for d in (1, 2, 2, 4)]
    np.testing.assert_allclose(errors["cosine"], np.mean(cosines))


def test_a_gradient_of_zero_points_nowhere(monkeypatch):
    monkeypatch.setattr(Derivative, "along_modes", lambda self, draw: np.zeros(2))
    errors = Derivative.__new__(Derivative).errors({"gradient": np.ones(2)})
    assert errors == {"cosine": 0.0, "relative_error": 1.0, "spread": 0.0}


def test_short_runs_are_repeated(monkeypatch):
    """By a clock of which a run takes three seconds, and one of the processors on which it takes five."""
    runs = []
    monkeypatch.setattr(time, "perf_counter", lambda: 3.0 * len(runs))
    monkeypatch.setattr(time, "process_time", lambda: 5.0 * len(runs))
    for least, count in ((0.0, 1), (3.0, 1), (3.5, 2), (8.0, 3)):
        runs.clear()
        assert timed(lambda: runs.append(None), least) == {"seconds": 3, "cpu_seconds": 5}
        assert len(runs) == count


@pytest.mark.slow  # each part of it is in the tests above
def test_a_real_sweep(tmp_path, sweep):
    words = [sys.executable, "-m", "jaxhf", *command(sweep, "precision", "--repeats", "3", "--markdown")]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    (announced,) = done.stderr.splitlines()
    assert "2 of 2 configurations to measure" in announced
    assert done.stdout.startswith("| picture |")
    assert "|\n\n2 configurations: " in done.stdout
    assert (sweep.folder / "tradeoff.png").read_bytes().startswith(b"\x89PNG")
    with sweep.table.open() as file:
        base, exact = csv.DictReader(file)
    assert exact["precision"] == "float64"
    assert abs(float(exact["rmse"]) - float(base["rmse"])) < 1e-6
    assert float(exact["wrong_hits"]) == 0
    assert 0.01 < float(base["rmse"]) < 1  # one sample a pixel against 256
    for name in ("seconds", "against_base", "cpu_seconds", "compile_seconds"):
        assert float(base[name]) > 0
    assert float(base["peak_mb"]) > 100


@pytest.mark.slow
def test_two_sweeps_agree(tmp_path):
    """In every error; and in the order of times that are at least a fifth apart."""
    (tmp_path / "scene.toml").write_text(SCENE)
    found = []
    for folder in ("one", "two"):
        words = [sys.executable, "-m", "jaxhf", "tradeoff", "scene.toml", "-o", folder, "--quick", "--width", "192"]
        subprocess.run(words, cwd=tmp_path, check=True, timeout=3600)
        found.append(plan(tmp_path / "scene.toml", tmp_path / folder, quick=True, width=192).measured())
    for one, two in zip(*found, strict=True):
        for name in ("rmse", "p999", "wrong_hits", "cosine", "relative_error"):
            assert one.get(name) == two.get(name), (one, name)
    times = [np.array([row["against_base"] for row in rows if row["task"] == "picture"]) for rows in found]
    apart = times[0][:, None] > 1.2 * times[0]
    assert apart.sum() > 20
    assert (times[1][:, None] > times[1])[apart].all()
