"""The command line: what it prints, what it hands on, and how it ends; once in a process of its own, as a user runs it."""

import dataclasses
import importlib.metadata
import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import jaxhf

SCENE = Path(__file__).parents[2] / "scenes" / "debug4x4.toml"  # 320 x 240
REPORT = re.compile(
    r"(.*): (\d+) x (\d+) pixels, (\d+) camera rays \((\d+) a pixel\), ([\d.e-]+) s \+ ([\d.e-]+) s compiling, .+, "
    r"([\d.e+-]+) rays/s, (\d+) rays exhausted\n"
)


def jaxhf_command(*arguments, **options):
    command = [sys.executable, "-m", "jaxhf", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, **options)


def test_help_is_quick():
    """In seconds of the processor: others may be at work."""

    def cost():
        begin = os.times()
        run = jaxhf_command("--help")
        assert (run.returncode, "render" in run.stdout, "info" in run.stdout) == (0, True, True)
        end = os.times()
        return end.children_user + end.children_system - begin.children_user - begin.children_system

    assert min(cost() for _ in range(3)) < 0.3


def test_help_and_version_do_not_import_jax():
    script = """
import contextlib, sys
import jaxhf
from jaxhf.cli.main import main
for words in (["--help"], *([name, "--help"] for name in sys.argv[1:]), ["--version"]):
    with contextlib.suppress(SystemExit):
        main(words)
print(jaxhf.__version__, {"jax", "numpy", "tqdm"} & sys.modules.keys())
"""
    commands = "render", "hillshade", "relief", "fit", "tradeoff", "convert", "info"
    run = subprocess.run([sys.executable, "-c", script, *commands], capture_output=True, text=True, timeout=120, check=True)
    version = importlib.metadata.version("jaxhf")
    assert run.stdout.splitlines()[-2:] == [f"jaxhf {version}", f"{version} set()"]


def test_every_setting_has_one_help(monkeypatch, command):
    """What `render --help` says of a setting is what the docstring of `Settings` says; it has all but that of derivatives."""

    def words(text):
        return " ".join(text.split())

    monkeypatch.setenv("COLUMNS", "1000")
    code, said, _ = command("render", "--help")
    assert code == 0
    attributes = words(jaxhf.Settings.__doc__ or "")
    for knob in dataclasses.fields(jaxhf.Settings):
        option = f"--{'no-' * (knob.type is bool)}{knob.name.replace('_', '-')} "
        assert (option in said) == (knob.metadata["help"] in said) == (knob.name != "edge_samples")
        assert f"{knob.name}: {knob.metadata['help']}" in attributes


def test_render(tmp_path):
    """--width alone keeps the scene's proportions; single precision; a pipe gets nothing but the report."""
    path = tmp_path / "out.npy"
    run = jaxhf_command("render", SCENE, "-o", path, "--width", 20)
    assert run.returncode == 0, run.stderr
    assert run.stderr == ""
    found = REPORT.fullmatch(run.stdout)
    assert found, run.stdout
    assert found.group(1, 2, 3, 4, 5, 9) == (str(path), "20", "15", "1200", "4", "0")
    assert all(float(number) > 0 for number in found.group(6, 7, 8))  # seconds, of compiling, and the rate
    image = np.load(path)
    assert (image.shape, image.dtype) == ((15, 20, 3), np.float32)
    assert np.isfinite(image).all()
    assert image.max() > 2 * image.min() > 0


@pytest.fixture
def rendered(monkeypatch):
    """Replaces the renderer by noise with two exhausted rays in it; lists the scenes and settings that it was given."""
    given = []

    def render(scene, settings, *, aovs, progress, mesh):
        given.append((scene, settings))
        shape = scene.camera.height, scene.camera.width
        progress(0, shape[0] * shape[1])
        exhausted = np.zeros(shape, np.int32)
        exhausted[2, 3] = 2
        image = np.random.default_rng(0).uniform(0, 1.2, (*shape, 3)).astype(scene.heights.dtype)
        return image, {"exhausted": exhausted}

    monkeypatch.setattr("jaxhf.cli.commands.render.render", render)
    return given


@pytest.mark.x64  # as --precision float64 would set it
def test_options_reach_the_renderer(tmp_path, command, rendered):
    options = [
        "--precision", "float64", "--height", 12, "--samples", 1, "--max-steps", 1, "--no-early-exit",
        "--no-shadows", "--traversal", "dda", "--normals", "central", "--max-depth", 2, "--chunk", 256,
    ]  # fmt: skip
    code, out, err = command("render", SCENE, "-o", tmp_path / "out.npy", *options)
    assert (code, err) == (0, "")
    ((scene, settings),) = rendered
    assert settings == jaxhf.Settings(
        samples=1, max_steps=1, early_exit=False, shadows=False, traversal="dda", normals="central", max_depth=2, chunk=256,
    )  # fmt: skip
    assert (scene.camera.width, scene.camera.height, scene.heights.dtype) == (16, 12, np.float64)
    found = REPORT.fullmatch(out)
    assert found, out
    assert found.group(2, 3, 5, 9) == ("16", "12", "1", "2")
    exact = np.load(tmp_path / "out.npy")
    assert exact.dtype == np.float64
    assert command("render", SCENE, "-o", tmp_path / "out.png", *options)[0] == 0
    # Half of 1/255 in sRGB, where the curve is steepest: 2.3.
    np.testing.assert_allclose(jaxhf.load_image(tmp_path / "out.png"), np.clip(exact, 0, 1), atol=2.3 / 510)

    rendered.clear()
    assert command("render", SCENE, "-o", tmp_path / "out.npy", "--shading", "flat")[0] == 0
    assert rendered.pop()[1] == jaxhf.Settings(shading="flat")
    assert command("render", SCENE, "-o", tmp_path / "out.npy")[0] == 0
    ((scene, settings),) = rendered
    assert settings == jaxhf.Settings()
    assert (scene.camera.width, scene.camera.height, scene.heights.dtype) == (320, 240, np.float32)


def test_info(command):
    code, out, err = command("info", SCENE)
    assert (code, err) == (0, "")
    size, camera, field, point, sky = out.splitlines()
    assert size == f"{SCENE}: 320 x 240 pixels, 4 samples a pixel"
    assert camera == "camera: Perspective, at (-0.9, -1.3, 1.5)"
    assert field.startswith(
        "object 0: Heightfield, 4 x 4 heights, cells 0.333333 x 0.333333, origin (0, 0), range (0, 0.6), matte"
    )
    assert point.startswith("light 0: Point, p (-0.9, -1.3, 1.5), intensity (18, 18, 18)")
    assert sky.startswith("light 1: Sky, radiance (0.05, 0.07, 0.1)")


def test_our_own_bug_keeps_its_traceback(tmp_path, monkeypatch, command):
    """Only what is known for the user's mistake becomes one line."""

    def broken(*_, **__):
        raise ValueError("a bug")

    monkeypatch.setattr("jaxhf.cli.commands.render.render", broken)
    with pytest.raises(ValueError, match=r"^a bug$"):
        command("render", SCENE, "-o", tmp_path / "out.png")


@pytest.mark.parametrize("error", [MemoryError("8 GiB"), RuntimeError("RESOURCE_EXHAUSTED: Out of memory")])
def test_no_memory_is_an_error_in_one_line(monkeypatch, command, error):
    def fail(*_):
        raise error

    monkeypatch.setattr("jaxhf.io.scenes.load.load_scene", fail)
    said = "jaxhf: error: memory ran out; a smaller picture or terrain needs less (render: also a smaller --chunk)\n"
    assert command("info", SCENE) == (2, "", said)


SCENE_OF_A_FILE = """camera = { type = "perspective", eye = [0, -3, 2], target = [0, 0, 0] }
objects = [{ shape = "heightfield", file = "é.npy" }]
"""
C_LOCALE = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}


@pytest.mark.skipif(sys.platform in ("darwin", "win32"), reason="these take names in Unicode alone")
@pytest.mark.parametrize(
    ("variables", "source", "output", "shown"),
    [
        (C_LOCALE, "dém 1.tif", "c ü.tif", "c ü.tif"),
        pytest.param({"PYTHONIOENCODING": "latin-1"}, "a.tif", "c 山.tif", r"c \u5c71.tif", marks=pytest.mark.deep),
        pytest.param({}, os.fsdecode(b"d\xe9m.tif"), os.fsdecode(b"\xfc.tif"), r"\udcfc.tif", marks=pytest.mark.deep),
        pytest.param(C_LOCALE, "dém.toml", "ü.npy", "ü.npy", marks=pytest.mark.deep),
    ],
)
def test_any_name_is_taken_and_shown(tmp_path, variables, source, output, shown):
    """Also by a terminal whose encoding lacks its letters, and where a scene names another file."""
    pytest.importorskip("rasterio")
    heights = tmp_path / ("é.npy" if source.endswith(".toml") else source)
    terrain = jaxhf.Terrain(np.random.default_rng(0).uniform(0, 9, (7, 8)), 10.0, 10.0)
    jaxhf.save_heights(heights, terrain)
    (tmp_path / "dém.toml").write_text(SCENE_OF_A_FILE, encoding="utf-8")
    command = ["render", "--width", "8"] if source.endswith(".toml") else ["hillshade"]
    words = [sys.executable, "-m", "jaxhf", *command, source, "-o", output]
    environment = {**os.environ, "PYTHONPATH": str(Path(jaxhf.__file__).parents[1]), **variables}
    run = subprocess.run(words, capture_output=True, timeout=120, cwd=tmp_path, env=environment)
    assert run.returncode == 0, run.stderr
    assert run.stdout.decode().startswith(f"{shown}: ")
    assert (tmp_path / output).exists()
