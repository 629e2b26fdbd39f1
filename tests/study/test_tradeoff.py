"""What a sweep measures, against counts by hand, and what it recommends."""

import dataclasses
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

import jaxhf
from jaxhf.scene.scene import shrunk
from jaxhf.study.measure import DERIVATIVE_PIXELS, Picture, centre_hits
from jaxhf.study.pareto import advice, by_task, markdown, pareto_front
from jaxhf.study.plan import plan
from jaxhf.study.plots import plot
from jaxhf.study.table import changes, in_words

SCENES = Path(__file__).parents[2] / "scenes"
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


def test_picture_errors_by_hand(monkeypatch):
    """A thousand pixels, of whose hits an eighth is wrong."""
    monkeypatch.setattr("jaxhf.study.measure.render", lambda scene, settings: jnp.asarray(image))
    monkeypatch.setattr("jaxhf.study.measure.centre_hits", lambda scene, settings: np.zeros((8, 5), np.int32))
    image = np.full((10, 100, 3), 2.0)
    picture = Picture(jaxhf.load_scene(SCENES / "debug4x4.toml"), jaxhf.Settings())
    reference = picture.reference()
    assert picture.errors(reference) == {"rmse": 0, "p999": 0, "wrong_hits": 0}
    reference["hits"] = np.zeros((8, 5), np.int32)
    reference["hits"][2, 1] = reference["hits"][2, 3] = 1
    image[0, :5, 1] += 0.5  # five pixels, one channel of three
    picture.run()
    errors = picture.errors(reference)
    np.testing.assert_allclose(errors["rmse"], np.sqrt(0.25 * 5 / 3000) / 2)
    np.testing.assert_allclose(errors["p999"], 0.25)
    assert errors["wrong_hits"] == 1 / 8
    image[0, :5, 1] = 2.0
    image[3, 3, 0] = 7.0  # one of a thousand: 99.9 % is next to it
    picture.run()
    assert picture.errors(reference)["p999"] < 2.5 * 0.01


@pytest.mark.deep
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


def row(task="picture", seconds=1.0, error=1.0, **knobs):
    settings = dataclasses.asdict(jaxhf.Settings())
    figures = {"seconds": seconds, "cpu_seconds": seconds, "against_base": seconds, "compile_seconds": 1.0, "peak_mb": 100.0}
    figures |= {"p999": 0.0, "wrong_hits": 0.0, "cosine": 0.0, "spread": 0.1, "rmse": error, "relative_error": error}
    return {"task": task, "precision": "float32", **settings, **knobs, **figures, "error": error}


ROWS = [
    row(seconds=1.0, error=0.1),
    row(seconds=0.5, error=0.5, samples=1),
    row(seconds=0.7, error=0.6, shading="flat"),  # slower and worse than the one before
    row(seconds=4.0, error=0.01, samples=16),
    row(seconds=5.0, error=0.01, samples=25),  # slower and no better
    row(task="derivative", seconds=2.0, error=0.3, edge_samples=1000),
    row(task="derivative", seconds=3.0, error=0.3, edge_samples=2000),
]


def test_pareto_front_by_hand():
    picture, derivative = by_task(ROWS)
    assert [row["seconds"] for row in pareto_front(picture)] == [0.5, 1.0, 4.0]
    assert [row["seconds"] for row in pareto_front(derivative)] == [2.0]
    assert [line.partition(":")[0] for line in advice(ROWS, None, None)] == [
        "picture, Pareto front, the cheapest first",
        "  Settings(samples=1), float32", "  Settings(), float32", "  Settings(samples=16), float32",
        "derivative, Pareto front, the cheapest first", "  Settings(edge_samples=1000), float32",
    ]  # fmt: skip


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
    lines = advice(ROWS, error, seconds)
    assert len(lines) == 2
    assert lines[0].partition(": ")[2].startswith(picture)
    assert lines[1].partition(": ")[2].startswith(derivative)


def test_what_is_recommended_can_be_written_as_it_stands():
    (line,) = advice([row(samples=16, normals="four", shadows=False, max_steps=32)], 1.0, None)
    settings = eval(line[line.index("Settings(") : line.index("), float32") + 1], {"Settings": jaxhf.Settings})
    assert settings == jaxhf.Settings(samples=16, normals="four", shadows=False, max_steps=32)


def test_tables_and_plot_hold_every_row():
    text = markdown(ROWS)
    assert text.count("\n| ") == len(ROWS) + 1  # and the second table's head
    assert "| **samples 16** | 0.01 |" in text
    assert "| samples 25 | 0.01 |" in text
    figure = plot(ROWS, "by hand")
    for task, rows in zip(("picture", "derivative"), by_task(ROWS), strict=True):
        titles = f"{task}: time, of the base", f"{task}: error"
        time, error = (next(axes for axes in figure.axes if axes.get_title() == title) for title in titles)
        names = [tick.get_text() for tick in time.get_yticklabels()]
        assert sorted(names) == sorted(in_words(row, rows[0]) for row in rows)
        for axes, column in ((time, "against_base"), (error, "error")):
            drawn = dict(zip(names, axes.collections[-1].get_offsets()[:, 0], strict=True))
            assert drawn == {in_words(row, rows[0]): max(row[column], 1e-9) for row in rows}
        bold = {tick.get_text() for tick in time.get_yticklabels() if tick.get_weight() == "bold"}
        assert bold == {in_words(row, rows[0]) for row in pareto_front(rows)}


def knobs_of(sweep):
    base = sweep.configurations[0]
    return [set(changes(one, base)) for one in sweep.configurations if one["task"] == "picture"]


def test_plan_sweeps_what_the_scene_has():
    landsea, texture, debug = (plan(SCENES / f"{name}.toml") for name in ("landsea", "texture", "debug4x4"))
    swept = {knob for changed in knobs_of(landsea) for knob in changed}
    assert swept == {
        "precision", "traversal", "max_steps", "early_exit", "samples", "shading", "normals", "shadows", "max_depth", "chunk",
    }  # fmt: skip
    assert {knob for changed in knobs_of(texture) for knob in changed} == swept - {"max_depth"}
    assert knobs_of(texture)[0] == set()
    assert len({tuple(one.items()) for one in debug.configurations}) == len(debug.configurations)
    assert (landsea.width, landsea.height) == (480, 270)
    assert {one["task"] for one in landsea.configurations} == {"picture", "derivative"}


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


@pytest.mark.parametrize(
    ("samples", "quick", "expected"), [(1, False, 256), (1, True, 64), (64, True, 256), (256, False, 1024)]
)
def test_the_reference_is_finer_than_the_base(tmp_path, samples, quick, expected):
    (tmp_path / "a.toml").write_text(SCENE.replace("samples = 1", f"samples = {samples}"))
    assert plan(tmp_path / "a.toml", quick=quick).references[0]["samples"] == expected


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


def test_derivatives_are_measured_in_a_small_picture(tmp_path):
    scene = jaxhf.load_scene(SCENES / "texture.toml")  # 480 x 360
    small = shrunk(scene, DERIVATIVE_PIXELS)
    assert (small.camera.width, small.camera.height) == (160, 120)
    assert (shrunk(small, 1000).camera.width, scene.camera.width) == (160, 480)
