"""`jaxhf fit`: a terrain on the map, 9 x 9 heights, from one picture.

All that surrounds the fit is tested with one that is pretended: a real one takes seconds to compile.
"""

import base64
import contextlib
import dataclasses
import io
import os
import re
import subprocess
import sys
from pathlib import Path

import geotiffs
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

import jaxhf
from jaxhf.core.affine import rotate
from jaxhf.io.checkpoint import save_checkpoint

if sys.platform != "win32":
    import pty


CASE = """
camera = { type = "perspective", eye = [500120, 4100120, 720], target = [500120, 4100120, 0], up = [0, 1, 0], fov = 18 }
lights = [{ type = "directional", towards = [1, 2, 3] }]
objects = [{ shape = "heightfield", file = "flat.tif" }]
pictures = [{ image = "seen.npy" }]
settings = { shadows = false, samples = 1, chunk = 256 }
[fit]
max_steps = 9
draws = 2
prior = { heights = 0, std = 30 }
unknown = { albedo = "constant", light_std = 1, camera_std = [5, 1] }
"""
SETTINGS = jaxhf.Settings(shadows=False, samples=1, chunk=256)
TRUTH = np.float32(20) * np.sin(4 * np.linspace(0, 1, 9)[None, :] + np.linspace(0, 1, 9)[:, None]).astype(np.float32)


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("fit")
    (folder / "case.toml").write_text(CASE)
    # The north-western corner of the raster, whose pixels are areas: vertex (0, 0) stands at (500000, 4100000).
    geotiffs.write(folder / "flat.tif", np.zeros((9, 9), np.float32), (30, 0, 499985, 0, -30, 4100255))
    np.save(folder / "seen.npy", np.linspace(0, 1, 144).reshape(12, 12))
    return folder


@pytest.fixture
def run(folder, command):
    """`jaxhf fit` of a file in the folder; the exit code, and what it says."""
    return lambda name, *more, case="case.toml": command("fit", folder / case, "-o", folder / name, *more)


def pretended(options: dict, ends: bool = True):
    """What stands for `fit`: it notes its arguments, leaves a checkpoint, and finds the truth or is interrupted."""

    def elsewhere(scene):
        pose = rotate(2.0, 1.0, 2.0, 3.0) @ scene.camera.world_from_camera
        pose[:3, 3] = scene.camera.world_from_camera[:3, 3] + [3, 4, 0]
        camera = dataclasses.replace(scene.camera, world_from_camera=pose)
        return scene.with_camera(camera).with_lights([jaxhf.Directional((1, 2, 10**0.5))])

    def fit(scenes, targets, *, checkpoint, progress, **more) -> jaxhf.Fit:
        options.update(more, scenes=scenes, targets=targets, resume=checkpoint.resume)
        steps = tuple(jaxhf.Step(k, 9, 10.0**-k, k != 2, 0.1, 0.2, 0.5 * k) for k in (1, 2, 3))
        for step in steps:
            progress(step)
        save_checkpoint(checkpoint.path, {}, ())
        if not ends:
            raise KeyboardInterrupt
        image = np.asarray(targets[0])
        return jaxhf.Fit(
            heights=jnp.asarray(TRUTH), result=jaxhf.Stop.CONVERGED, std=np.where(TRUTH > 15, np.inf, 1.5), samples=None,
            seen=TRUTH <= 15,
            albedo=jnp.linspace(0, 1, 6).reshape(3, 2, 1), exposures=jnp.array([1.25]), offsets=None,
            scenes=tuple(map(elsewhere, scenes)), images=(image,), residuals=(0 * image,), history=steps,
            stats={"steps": 3, "accepted": 2, "seconds": 1.5, "loss": 0.001, "chi2": 0.99}, noise=np.array([0.0123]),
            regions=(), warnings=("chi2 is 9",), settings=jaxhf.Settings(),
        )  # fmt: skip

    return fit


def test_what_the_file_says_reaches_fit_and_results_lie_where_the_terrain_lies(folder, monkeypatch, run):
    rasterio = pytest.importorskip("rasterio")
    options = {}
    monkeypatch.setattr("jaxhf.cli.commands.fit.fit", pretended(options))
    assert run("out.tif", "--report", folder / "out.html") == (
        0,
        "noise, estimated: 0.0123\n"
        "exposures: 1.25\n"
        "light: azimuth 26.57 altitude 54.74 (turned by 1.43 degrees)\n"
        "camera: eye 500123 4100124 720 (moved by 5, turned by 2.00 degrees)\n"
        f"{folder}/out.tif: 9 x 9 heights from 1 picture, {jaxhf.Stop.CONVERGED.value}; "
        "3 steps, 1.5 s, loss 0.001, chi2 0.99\n",
        "jaxhf: warning: chi2 is 9\n",
    )
    (scene,), (target,) = options["scenes"], options["targets"]
    assert (scene.heights.dtype, target.shape) == (np.float32, (12, 12, 3))
    assert options["settings"] == SETTINGS
    assert (options["noise"], options["weights"], options["resume"]) == (None, (None,), False)
    assert (options["prior"].heights, options["prior"].std, options["max_steps"], options["draws"]) == (0, 30, 9, 2)
    assert (options["unknown"].albedo, options["unknown"].camera_std) == ("constant", [5, 1])
    with rasterio.open(folder / "flat.tif") as flat:
        for name, values in (("out.tif", TRUTH), ("out_std.tif", np.where(TRUTH > 15, np.nan, 1.5))):
            np.testing.assert_array_equal(jaxhf.load_heights(folder / name).heights, values)
            with rasterio.open(folder / name) as file:
                assert (file.transform, file.crs) == (flat.transform, flat.crs)
                assert file.tags()["AREA_OR_POINT"] == "Area"
    albedo = np.linspace(0, 1, 6, dtype=np.float32).reshape(3, 2)
    np.testing.assert_array_equal(np.load(folder / "out_albedo.npy"), albedo[::-1])
    assert not (folder / "out.tif.checkpoint").exists()
    page = (folder / "out.html").read_text()
    assert "<th>steps</th><td>3, 2 of them accepted</td>" in page
    assert "<th>exposures</th><td>1.25</td>" in page
    assert re.findall(r"<h2>(\w+)</h2>", page) == ["Heights", "Pictures", "Convergence"]
    assert "http" not in page  # it needs no other file
    for encoded in re.findall(r'src="data:image/png;base64,([^"]+)"', page):
        image = np.asarray(Image.open(io.BytesIO(base64.b64decode(encoded))).convert("L"), float)
        assert min(image.shape) > 200
        assert image.std() > 20


def windowed(options: dict, ends: bool = True):
    """The same for `fit_windows`."""

    def fit_windows(scenes, targets, *, checkpoint, progress, **more) -> jaxhf.Mosaic:
        options.update(more, scenes=scenes, resume=checkpoint.resume)
        progress(1, 2, jaxhf.Step(1, 9, 0.1, True, 0.1, 0.2, 0.5))
        save_checkpoint(checkpoint.path, {}, ())
        if not ends:
            raise KeyboardInterrupt
        first = jaxhf.Fitted(0, 0, 9, 6, 1, jaxhf.Stop.CONVERGED.value, 3, 1.0, 0.98765, float("nan"), ("chi2 is 9",))
        done = first, jaxhf.Fitted(0, 3, 9, 6, 1, jaxhf.Stop.MAX_STEPS.value, 1, 1.0, 1.5, 0.125)
        return jaxhf.Mosaic(TRUTH, 0 * TRUTH + 1.5, TRUTH <= 15, done)

    return fit_windows


def test_windows_are_told_one_by_one(folder, monkeypatch, run):
    options, checkpoint = {}, folder / "all.npz.checkpoint"
    code, _, said = run("all.npz", "--window", 32)  # a case with unknowns
    assert (code, "unknown must be left out: windows share no unknowns" in said) == (2, True)
    monkeypatch.setattr("jaxhf.cli.commands.fit.fit_windows", windowed(options, ends=False))
    code, _, said = run("all.npz", "--window", 32, "--overlap", 8)
    assert (code, said) == (130, f"\njaxhf: interrupted; the same command with --resume goes on from {checkpoint}\n")
    monkeypatch.setattr("jaxhf.cli.commands.fit.fit_windows", windowed(options))
    code, said, warned = run("all.npz", "--window", 32, "--overlap", 8, "--resume")
    lines = said.splitlines()
    assert code == 0
    assert re.fullmatch(rf"{folder}/all.npz: 9 x 9 heights from 1 picture in 2 windows, [0-9.e-]+ s", lines[0])
    assert lines[1:] == [
        f"rows 0-8 columns 0-5: {jaxhf.Stop.CONVERGED.value}; 3 steps, chi2 0.9877",
        f"rows 0-8 columns 3-8: {jaxhf.Stop.MAX_STEPS.value}; 1 step, chi2 1.5, 0.125 off its neighbours",
    ]
    assert warned == "jaxhf: warning: rows 0-8 columns 0-5: chi2 is 9\n"
    assert [options[name] for name in ("window", "overlap", "resume", "draws")] == [32, 8, True, 2]
    assert (options["prior"].std, options["unknown"].camera_std) == (30, [5, 1])
    np.testing.assert_array_equal(jaxhf.load_heights(folder / "all.npz").heights, TRUTH)
    np.testing.assert_array_equal(jaxhf.load_heights(folder / "all_std.npz").heights, 0 * TRUTH + 1.5)
    assert not checkpoint.exists()


def test_after_ctrl_c_it_says_how_to_go_on(folder, monkeypatch, run):
    options, checkpoint = {}, folder / "part.tif.checkpoint"
    monkeypatch.setattr("jaxhf.cli.commands.fit.fit", pretended(options, ends=False))
    said = f"interrupted; the same command with --resume goes on from {checkpoint}"
    assert run("part.tif") == (130, "", f"\njaxhf: {said}\n")
    assert not (folder / "part.tif").exists()
    code, _, err = run("part.tif")
    said = f"jaxhf: error: {checkpoint}: an interrupted fit left this checkpoint; --resume"
    assert (code, err.startswith(said)) == (2, True)

    monkeypatch.setattr("jaxhf.cli.commands.fit.fit", pretended(options))
    assert run("part.tif", "--resume")[0] == 0
    assert options["resume"]
    assert not checkpoint.exists()


SLOW = """
import sys, time
from jaxhf.fitting.given import Draws, Step
from jaxhf.cli import main, progress
from jaxhf.cli.commands import fit

def pretended(scenes, targets, *, progress, **options):
    time.sleep(1.5)
    for k in (1, 2, 3):
        progress(Step(k, 9, 10.0**-k, True, 0.1, 0.2, 0.5 * k, 12 - 4 * k))
        time.sleep(0.5)
    progress(Draws(1, 3, 1.0, 2.0))
    time.sleep(0.5)
    raise KeyboardInterrupt

fit.fit = pretended
progress._EACH_SECOND = 0.2
progress._EACH_MINUTE = float(sys.argv.pop(1))
sys.exit(main.main())
"""


def slow(folder, minute, *more, **streams):
    words = ["fit", str(folder / "case.toml"), "-o", str(folder / "slow.tif"), *more]
    return subprocess.Popen([sys.executable, "-c", SLOW, str(minute), *words], **streams)


@pytest.mark.deep
@pytest.mark.skipif(sys.platform == "win32", reason="there are no pseudo-terminals")
def test_a_terminal_is_told_what_is_to_come(folder):
    """Before the first step is done, while one is under way, and of the deviations."""
    terminal, other = pty.openpty()
    process, shown = slow(folder, 0.0, stderr=other, stdout=subprocess.DEVNULL), b""
    os.close(other)
    with contextlib.suppress(OSError):  # as Linux ends it
        while piece := os.read(terminal, 4096):
            shown += piece
    os.close(terminal)
    assert process.wait(60) == 130
    lines = [line.strip() for line in shown.decode().split("\r") if line.strip()]
    assert lines[0] == "compiling, then the first step, 0 s so far"
    assert not any("to come" in line for line in lines if line.startswith("compiling"))
    first, second, third = ([line for line in lines if re.match(rf"step {k}, \d s so far, .*; 9 DCT", line)] for k in (1, 2, 3))
    assert min(len(first), len(second), len(third)) > 1  # also within a step
    left = re.fullmatch(r"step 1, [1-3] s so far, about (\d+) s to come, then deviations; .*", first[0])
    assert left
    assert 8 <= int(left[1]) <= 20  # eight steps of 1.5 s, or of some more where others work
    assert any(re.search(r"sample 1 of 3, \d s so far, about 2 s to come \(Ctrl-C: enough\)", line) for line in lines)


@pytest.mark.deep
@pytest.mark.parametrize("quiet", [False, True])
def test_elsewhere_a_line_a_minute_tells_it(folder, quiet):
    """Here of 0.7 s; a minute without one is silent, and so is --quiet."""
    process = slow(folder, 0.7, *["--quiet"] * quiet, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    out, err = process.communicate(timeout=60)
    assert (process.returncode, out) == (130, "")
    lines = err.splitlines()[:-2]
    if quiet:
        assert lines == []
        return
    assert 3 <= len(lines) <= 6
    assert lines[0] == "jaxhf: compiling, then the first step, 1 s so far"
    assert re.fullmatch(r"jaxhf: step \d, \d s so far, about \d+ s to come, then deviations; 9 DCT modes .*", lines[-2])
    assert "\r" not in err
