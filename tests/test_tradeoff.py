"""The sweep: what it measures, against counts by hand; what it recommends; that it can be killed and gone on with."""

import csv
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import jaxhf
from jaxhf import _sweeping
from jaxhf._curves import plot
from jaxhf._front import curves, front, markdown, recommend
from jaxhf._measure import (
    DERIVATIVE_PIXELS,
    Derivative,
    Recovery,
    _thinned,
    centre_hits,
    gradient_errors,
    picture_errors,
    shrunk,
    wrong_share,
)  # fmt: skip
from jaxhf._tradeoff import COLUMNS, KNOBS, Configuration, Measured, plan
from jaxhf._worker import MeasurementError, Worker, timed
from jaxhf.io._sweep import append_row, load_reference, read_rows, save_reference

SCENES = Path(__file__).parents[1] / "scenes"
SCENE = """samples = 1
[camera]
type = "orthographic"
eye = [0.5, 0.2, 5]
target = [0.5, 0.5, 0]
up = [0, 1, 0]
extent = 1.2
width = 24
height = 16
[[lights]]
type = "directional"
[[objects]]
shape = "heightfield"
heights = [[0, 0.1, 0.3, 0], [0.2, 0, 0.1, 0.1], [0.1, 0.3, 0, 0.2]]
"""


def test_picture_errors_by_hand():
    reference = np.full((10, 100, 3), 2.0)
    image = reference.copy()
    image[0, :5, 1] += 0.5  # five pixels of a thousand, one channel of three
    errors = picture_errors(image, reference)
    np.testing.assert_allclose(errors["rmse"], np.sqrt(0.25 * 5 / 3000) / 2)
    np.testing.assert_allclose(errors["p999"], 0.25)
    image[0, 0, 1] = reference[0, 0, 0]
    image[0, 1:5, 1] = reference[0, 0, 0]
    image[3, 3, 0] = 7.0  # one of a thousand: 99.9 % is next to it
    assert picture_errors(image, reference)["p999"] < 2.5 * 0.01


def test_wrong_share_by_hand():
    found = np.zeros((8, 5), int)
    reference = found.copy()
    reference[2, 1] = reference[2, 3] = reference[5, 4] = 1
    assert wrong_share(found, reference) == 2 / 8


def test_gradient_errors_by_hand():
    errors = gradient_errors(np.array([3.0, 0.0]), np.array([3.0, 4.0]))
    np.testing.assert_allclose([errors["cosine"], errors["relative_error"]], [0.6, 0.8])
    assert gradient_errors(np.zeros(2), np.ones(2)) == {"cosine": 0.0, "relative_error": 1.0}


def test_centre_hits_are_those_of_the_aovs():
    """A terrain that fills the middle of the picture only; its triangles from the place in the cell."""
    heights = np.arange(12.0).reshape(3, 4) / 30
    camera = jaxhf.Orthographic.look_at((0.5, 0.4, 5), (0.5, 0.5, 0), up=(0, 1, 0), extent=1.3, width=30, height=20)
    scene = jaxhf.Scene([jaxhf.Object(jaxhf.Heightfield(heights))], camera)
    _, aovs = jaxhf.render(scene, aovs=("object", "cell", "status", "uv"))
    hits = centre_hits(scene, jaxhf.Settings()).reshape(20, 30, 5)
    np.testing.assert_array_equal(hits[..., 0], aovs["object"])
    np.testing.assert_array_equal(hits[..., 1:3], aovs["cell"])
    np.testing.assert_array_equal(hits[..., 4], aovs["status"])
    met = hits[..., 0] >= 0
    u, v = np.moveaxis(np.asarray(aovs["uv"]) * (3, 2) - np.asarray(aovs["cell"]), -1, 0)
    np.testing.assert_array_equal(hits[..., 3][met], (v > u)[met])
    assert 0.2 < met.mean() < 0.8
    assert (hits[~met][:, :4] == -1).all()


def row(task="picture", seconds=1.0, error=1.0, **knobs: str):
    base = Configuration(task, tolerance=1e-4) if task == "fit" else Configuration(task)
    name = "relative_error" if task == "derivative" else "rmse"
    figures = {"seconds": seconds, "cpu_seconds": seconds, "against_base": seconds, "compile_seconds": 1.0, "peak_mb": 100.0}
    figures |= {"p999": 0.0, "wrong_hits": 0.0, "cosine": 0.0, "spread": 0.1, name: error}
    return Measured(task, base.knobs | knobs, figures)


ROWS = [
    row(seconds=1.0, error=0.1),
    row(seconds=0.5, error=0.5, samples="1"),
    row(seconds=0.7, error=0.6, shading="flat"),  # slower and worse than the one before
    row(seconds=4.0, error=0.01, samples="16"),
    row(seconds=5.0, error=0.01, samples="25"),  # slower and no better
    row(task="derivative", seconds=2.0, error=0.3, edge_samples="1000"),
    row(task="derivative", seconds=3.0, error=0.3, edge_samples="2000"),
]


def test_front_by_hand():
    assert [one.figures["seconds"] for one in front(ROWS, "picture")] == [0.5, 1.0, 4.0]
    assert front(ROWS, "fit") == []


@pytest.mark.parametrize(
    ("error", "seconds", "picture", "derivative"),
    [
        (0.2, None, "Settings(), float32: error 0.1, 1 s", "nothing that was measured keeps that; nearest is Settings(edge"),
        (0.3, None, "Settings(), float32", "Settings(edge_samples=1000), float32: error 0.3, 2 s"),
        (None, 3.0, "Settings(), float32", "Settings(edge_samples=1000)"),
        (None, 9.0, "Settings(samples=16), float32: error 0.01", "Settings(edge_samples=1000)"),
        (None, 0.1, "nothing that was measured keeps that; nearest is Settings(samples=1)", "nothing that was measured"),
        (0.2, 0.6, "nothing that was measured keeps that", "nothing that was measured keeps that"),
    ],
)
def test_recommendations_by_hand(error, seconds, picture, derivative):
    lines = recommend(ROWS, error, seconds)
    assert len(lines) == 2
    assert lines[0].partition(": ")[2].startswith(picture)
    assert lines[1].partition(": ")[2].startswith(derivative)


def test_what_is_recommended_can_be_written_as_it_stands():
    (line,) = recommend([row(detail="1.0", samples="16", normals="four", shadows="False", max_steps="32")], 1.0, None)
    settings = eval(line[line.index("Settings(") : line.index("), float32") + 1], {"Settings": jaxhf.Settings})
    assert settings == jaxhf.Settings(detail=1.0, samples=16, normals="four", shadows=False, max_steps=32)


def test_curves_change_one_knob():
    rows = [*ROWS, row(samples="4", shading="flat"), row(max_steps="8"), row(max_steps="16")]
    found = curves(rows, "picture")
    assert list(found) == ["samples", "shading", "max_steps"]
    assert [value for value, _ in found["max_steps"]] == ["8", "16", "None"]
    assert [value for value, _ in found["samples"]] == ["1", "16", "25", "None"]
    assert [value for value, _ in found["shading"]] == ["flat", "smooth"]  # not with other samples as well


def test_tables_and_plot_hold_every_row():
    text = markdown(ROWS)
    assert text.count("\n| ") == len(ROWS) + 1  # and the second table's head
    assert "| **samples 16** | 0.01 |" in text
    assert "| samples 25 | 0.01 |" in text
    figure = plot(ROWS, "by hand")
    titles = {axes.get_title() for axes in figure.axes} - {""}
    assert titles == {
        "picture", "derivative", "picture: samples", "picture: shading", "derivative: edge_samples",
    }  # fmt: skip


def knobs_of(sweep):
    base = sweep.configurations[0].knobs
    return [
        {knob for knob in KNOBS if one.knobs[knob] != base[knob]} for one in sweep.configurations if one.task == "picture"
    ]  # fmt: skip


def test_plan_sweeps_what_the_scene_has():
    landsea, texture, debug = (plan(SCENES / f"{name}.toml") for name in ("landsea", "texture", "debug4x4"))
    swept = {knob for changed in knobs_of(landsea) for knob in changed}
    assert swept == {
        "precision", "traversal", "max_steps", "samples", "shading", "normals", "shadows", "max_depth", "chunk", "detail",
    }  # fmt: skip
    assert {knob for changed in knobs_of(texture) for knob in changed} == swept - {"max_depth"}
    assert knobs_of(texture)[0] == set()
    assert len(set(debug.configurations)) == len(debug.configurations)
    assert (landsea.width, landsea.height) == (480, 270)
    assert {one.task for one in landsea.configurations} == {"picture", "derivative"}


def test_plan_has_no_shadows_under_a_sky_alone(tmp_path):
    (tmp_path / "a.toml").write_text(SCENE.replace('type = "directional"', 'type = "sky"\nradiance = 0.5'))
    assert not any("shadows" in changed for changed in knobs_of(plan(tmp_path / "a.toml")))


def test_plan_of_some_knobs():
    sweep = plan(SCENES / "texture.toml", knobs=("samples", "shading"), quick=True, width=96)
    assert (sweep.width, sweep.height) == (96, 72)
    assert {frozenset(changed) for changed in knobs_of(sweep)} == {
        frozenset(), frozenset({"samples"}), frozenset({"shading"}), frozenset({"samples", "shading"}),
    }  # fmt: skip
    assert len(plan(SCENES / "texture.toml", knobs=("edge_samples",)).configurations) == 5
    fits = plan(SCENES / "texture.toml", knobs=("shading",), fits=True).configurations
    assert [one.tolerance for one in fits if one.task == "fit"] == [1e-4, 1e-2, 1e-3, 1e-5, 1e-4]
    fits = plan(SCENES / "texture.toml", knobs=("levels",)).configurations
    assert [(one.task, one.levels) for one in fits] == [("picture", None), ("fit", None), ("fit", (1.0,))]


@pytest.mark.parametrize(
    ("samples", "quick", "expected"), [(1, False, 256), (1, True, 64), (64, True, 256), (256, False, 1024)]
)
def test_the_reference_is_finer_than_the_base(tmp_path, samples, quick, expected):
    (tmp_path / "a.toml").write_text(SCENE.replace("samples = 1", f"samples = {samples}"))
    assert plan(tmp_path / "a.toml", quick=quick).reference_samples == expected


def test_plan_refuses_fits_of_holes(tmp_path):
    np.save(tmp_path / "hole.npy", np.array([[0, 0.1, 0.3], [0.2, np.nan, 0.1]]))
    (tmp_path / "a.toml").write_text(SCENE[: SCENE.index("heights = ")] + 'file = "hole.npy"\n')
    with pytest.raises(ValueError, match=r"a\.toml: a fit's terrain must be without holes, this one has 1"):
        plan(tmp_path / "a.toml", fits=True)
    assert plan(tmp_path / "a.toml").configurations


def test_identity(tmp_path):
    """It tells scenes, sizes and devices apart, and does not mind where the file lies or which knobs are asked for."""

    def identity(text=SCENE, name="a.toml", **options):
        (tmp_path / name).write_text(text)
        return plan(tmp_path / name, devices=options.pop("devices", 1), **options).identity

    one = identity()
    assert one == identity(name="b.toml", knobs=("samples",))
    others = [
        identity(SCENE.replace("0.3", "0.31")), identity(SCENE.replace("extent = 1.2", "extent = 1.3")), identity(width=20),
        identity(devices=2), identity(quick=True), identity(SCENE + "dx = 0.5\n"),
    ]  # fmt: skip
    assert len({one, *others}) == 7


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"knobs": ("sample",)}, r"knobs must be among .*'sample'"),
        ({"width": 0}, r"width must be a whole number from 1 on, it is 0"),
        ({"devices": -1}, r"devices must be .* it is -1"),
    ],
)
def test_plan_refuses(options, message):
    with pytest.raises(ValueError, match=message):
        plan(SCENES / "texture.toml", **options)


def test_plan_refuses_a_scene_without_terrain(tmp_path):
    text = SCENE[: SCENE.index("[[objects]]")] + '[[objects]]\nshape = "cylinder"\n'
    (tmp_path / "a.toml").write_text(text)
    with pytest.raises(ValueError, match=r"a\.toml: there is no heightfield"):
        plan(tmp_path / "a.toml")


def test_derivatives_are_measured_in_a_small_picture(tmp_path):
    scene = jaxhf.load_scene(SCENES / "texture.toml")  # 480 x 360
    small = shrunk(scene, DERIVATIVE_PIXELS)
    assert (small.camera.width, small.camera.height) == (160, 120)
    assert (shrunk(small, 1000).camera.width, scene.camera.width) == (160, 480)


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
from jaxhf._worker import peak_mb, serve

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


def test_short_runs_are_repeated():
    taken, runs = timed(lambda: time.sleep(0.01), 0.1), []
    assert 0.01 <= taken["seconds"] < 0.05
    assert taken["cpu_seconds"] < taken["seconds"]
    timed(lambda: runs.append(time.sleep(0.01)), 0.1)
    assert 3 <= len(runs) <= 10
    timed(lambda: runs.clear())
    assert runs == []


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
