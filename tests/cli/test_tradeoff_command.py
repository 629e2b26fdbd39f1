"""`jaxhf tradeoff --fit --time`: what its table and its advice say of small fits, against a fit that is made here."""

import csv
import time

import numpy as np
import pytest

import jaxhf
from jaxhf.cli.main import main
from jaxhf.scene.views import from_above
from jaxhf.study import plan as planning

pytestmark = pytest.mark.deep  # processes that compile fits; `study` has what is done with their figures

TRUTH = np.array([[0, 0.1, 0.3, 0], [0.2, 0, 0.1, 0.1], [0.1, 0.3, 0, 0.2]])
SCENE = f"""samples = 1
lights = [{{ type = "directional" }}]
objects = [{{ shape = "heightfield", heights = {TRUTH.tolist()} }}]
[camera]
type = "orthographic"
eye = [0.5, 0.2, 5]
target = [0.5, 0.5, 0]
up = [0, 1, 0]
extent = 1.2
width = 24
height = 16
"""


def recovered(truth: np.ndarray) -> np.ndarray:
    """The heights that the guide describes: from straight above, in three suns, from a prior of the smoothest modes."""
    field = jaxhf.Heightfield(truth)
    camera = from_above(field, 64, None)
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


def test_a_fit_within_a_time(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(planning._VALUES, "fit", {})  # none but the base
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
