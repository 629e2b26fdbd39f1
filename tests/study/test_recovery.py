"""Small fits: their camera and terrain, and what `jaxhf tradeoff --fit --time` says of one, against a fit that is made here."""

import csv
import time

import numpy as np
import pytest
from test_tradeoff import SCENE

import jaxhf
from jaxhf.cli.main import main
from jaxhf.study import plan as _plan
from jaxhf.study.measure import prepare
from jaxhf.study.plan import plan
from jaxhf.study.recovery import from_above, thinned
from jaxhf.study.worker import Worker

TRUTH = np.array([[0, 0.1, 0.3, 0], [0.2, 0, 0.1, 0.1], [0.1, 0.3, 0, 0.2]])


@pytest.mark.parametrize("shape", [(4, 61), (61, 4), (9, 30)])
@pytest.mark.parametrize("most", [20, 7, 12])
def test_a_camera_above_sees_all_of_a_field(shape, most):
    """Whatever the proportions and the rounding."""
    camera = from_above(jaxhf.Heightfield(np.zeros(shape), 2.0, 3.0, 100.0, 50.0), most)
    pixels, middle = np.array([camera.width, camera.height]), np.array([2 * (shape[1] - 1), 3 * (shape[0] - 1)]) / 2
    assert pixels[np.argmax(middle)] == most
    np.testing.assert_allclose(np.asarray(camera.world_from_camera)[:2, 3], np.add(middle, [100, 50]))
    half = float(camera.extent) / 2 * pixels / pixels.min()
    assert (half >= middle * (1 - 1e-12)).all()
    assert np.isclose(half, middle).any()
    assert (half - middle < half / pixels).all()  # less than half a pixel on either side is beside it


@pytest.mark.deep
def test_small_fits_are_measured_on_any_shape(tmp_path):
    """The side that is short already stays as it is; there need be no reference."""
    heights = np.random.default_rng(0).uniform(0, 0.1, (3, 40)).astype(np.float32)
    thin = thinned(jaxhf.Heightfield(heights, dx=0.1, dy=0.5), 32)
    np.testing.assert_array_equal(thin.heights, heights[:, ::2])
    assert (thin.dx, thin.dy) == (0.2, 0.5)
    path = tmp_path / "scene.toml"
    path.write_text(SCENE[: SCENE.index("heights = ")] + f"heights = {heights.tolist()}\ndx = 0.1\ndy = 0.5\n")
    sweep = plan(path, tmp_path, knobs=("levels",), devices=1)
    cheap = {"samples": 1, "shadows": False, "chunk": 256, "tolerance": 1e-2, "levels": "1.0"}
    with Worker(prepare, (sweep, sweep.configurations[1] | cheap)) as worker:
        worker.answer()
        assert 0 < worker.ask("errors")["rmse"] < 0.1


def recovered(truth: np.ndarray) -> np.ndarray:
    """The heights that the guide describes: from straight above, in three suns, from a prior of the smoothest modes."""
    field = jaxhf.Heightfield(truth)
    camera = from_above(field, 64)
    suns = [jaxhf.Directional.from_angles(azimuth, 45.0) for azimuth in (30.0, 150.0, 270.0)]
    scenes = [jaxhf.Scene([jaxhf.Object(field, jaxhf.Matte(0.6))], camera, [sun]) for sun in suns]
    targets = [np.asarray(jaxhf.render(scene, jaxhf.Settings(samples=16))) for scene in scenes]
    rows, columns = (np.cos(np.pi * np.arange(2) * (np.arange(n)[:, None] + 0.5) / n) for n in truth.shape)
    prior = rows @ (np.linalg.pinv(rows) @ truth @ np.linalg.pinv(columns).T) @ columns.T
    found = jaxhf.fit(
        scenes, targets, settings=jaxhf.Settings(samples=4), noise=0.01 * float(np.mean(targets)), start=prior, prior=prior,
        prior_std=float((prior - truth).std()), tolerance=1e-4,
    )  # fmt: skip
    return np.asarray(found.heights)


@pytest.mark.deep  # processes that compile fits
def test_a_fit_within_a_time(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(_plan._VALUES, "fit", {})  # none but the base
    (tmp_path / "scene.toml").write_text(SCENE)
    command = ["tradeoff", "scene.toml", "-o", "out", "--knobs", "tolerance", "--fit", "--devices", "1", "--repeats", "1"]
    begin = time.perf_counter()
    assert main([*command, "--time", "1e9"]) == 0
    took = time.perf_counter() - begin
    said = [capsys.readouterr().out]
    with open("out/tradeoff.csv") as file:
        picture, fit = csv.DictReader(file)
    assert (picture["task"], fit["task"], fit["tolerance"], fit["levels"]) == ("picture", "fit", "0.0001", "coarse to fine")
    error = float(np.sqrt(np.mean((recovered(TRUTH) - TRUTH) ** 2)) / np.ptp(TRUTH))
    np.testing.assert_allclose(float(fit["rmse"]), error, rtol=0.05)  # at the end of a fit in single precision
    # Seconds that passed: compiling comes before what is measured, which is no faster than its fastest run.
    assert 0 < float(fit["fastest"]) <= float(fit["seconds"]) < float(fit["seconds"]) + float(fit["compile_seconds"]) < took
    seconds = float(fit["against_base"]) * float(picture["seconds"])
    for bound in (1.01 * seconds, 0.99 * seconds):
        assert main([*command, "--time", str(bound)]) == 0  # at once: all is in the table
        said.append(capsys.readouterr().out)
    words = "Settings(samples=4), float32, tolerance=0.0001, levels coarse to fine"
    for text, nearest in zip(said, (False, False, True), strict=True):
        (line,) = (line for line in text.splitlines() if line.startswith("fit, "))
        assert line.partition(" s: ")[2] == (
            f"{'nothing that was measured keeps that; nearest is ' * nearest}{words}: error {float(fit['rmse']):.3g}, "
            f"{seconds:.3g} s, {float(fit['peak_mb']):.0f} MiB"
        )
