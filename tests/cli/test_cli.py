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
from jaxhf.cli.main import main

SCENE = Path(__file__).parents[2] / "scenes" / "debug4x4.toml"  # 320 x 240
REPORT = re.compile(
    r"(.*): (\d+) x (\d+) pixels, (\d+) camera rays \((\d+) a pixel\), ([\d.e-]+) s \+ ([\d.e-]+) s compiling, .+, "
    r"([\d.e+-]+) rays/s, (\d+) rays exhausted\n"
)


def jaxhf_command(*arguments, **options):
    command = [sys.executable, "-m", "jaxhf", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, **options)


@pytest.fixture
def in_this_process(monkeypatch, capsys):
    """Runs `main` here, where JAX is set up already; returns exit code, standard output and standard error."""
    monkeypatch.setattr("jaxhf.cli.arguments.set_up_jax", lambda options: None)

    def run(*arguments):
        try:
            code = main(list(map(str, arguments)))
        except SystemExit as ended:
            code = ended.code
        return code, *capsys.readouterr()

    return run


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


def test_every_setting_has_one_help(monkeypatch, in_this_process):
    """What `render --help` says of a setting is what the docstring of `Settings` says; it has all but that of derivatives."""

    def words(text):
        return " ".join(text.split())

    monkeypatch.setenv("COLUMNS", "1000")
    code, said, _ = in_this_process("render", "--help")
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

    monkeypatch.setattr("jaxhf.rendering.render.render", render)
    return given


@pytest.mark.x64  # as --precision float64 would set it
def test_options_reach_the_renderer(tmp_path, in_this_process, rendered):
    options = [
        "--precision", "float64", "--height", 12, "--samples", 1, "--max-steps", 1, "--no-early-exit",
        "--no-shadows", "--traversal", "dda", "--normals", "central", "--max-depth", 2, "--chunk", 256,
    ]  # fmt: skip
    code, out, err = in_this_process("render", SCENE, "-o", tmp_path / "out.npy", *options)
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
    assert in_this_process("render", SCENE, "-o", tmp_path / "out.png", *options)[0] == 0
    # Half of 1/255 in sRGB, where the curve is steepest: 2.3.
    np.testing.assert_allclose(jaxhf.load_image(tmp_path / "out.png"), np.clip(exact, 0, 1), atol=2.3 / 510)

    rendered.clear()
    assert in_this_process("render", SCENE, "-o", tmp_path / "out.npy", "--shading", "flat")[0] == 0
    assert rendered.pop()[1] == jaxhf.Settings(shading="flat")
    assert in_this_process("render", SCENE, "-o", tmp_path / "out.npy")[0] == 0
    ((scene, settings),) = rendered
    assert settings == jaxhf.Settings()
    assert (scene.camera.width, scene.camera.height, scene.heights.dtype) == (320, 240, np.float32)


def test_info(in_this_process):
    code, out, err = in_this_process("info", SCENE)
    assert (code, err) == (0, "")
    size, camera, field, point, sky = out.splitlines()
    assert size == f"{SCENE}: 320 x 240 pixels, 4 samples a pixel"
    assert camera == "camera: Perspective, at (-0.9, -1.3, 1.5)"
    assert field.startswith(
        "object 0: Heightfield, 4 x 4 heights, cells 0.333333 x 0.333333, origin (0, 0), range (0, 0.6), matte"
    )
    assert point.startswith("light 0: Point, p (-0.9, -1.3, 1.5), intensity (18, 18, 18)")
    assert sky.startswith("light 1: Sky, radiance (0.05, 0.07, 0.1)")


def test_an_old_key_gets_one_line(tmp_path, in_this_process):
    """Python hides DeprecationWarnings that are not of the main module."""
    path = tmp_path / "old.toml"
    old = SCENE.read_text() + '\n[[lights]]\ntype = "directional"\nradiance = 2\n'
    path.write_text(old)
    code, said, complained = in_this_process("info", path)
    assert (code, "irradiance (2, 2, 2)" in said) == (0, True)
    number = old.count("[[lights]]") - 1
    where = f"{path}:{old.count(chr(10))}: lights[{number}].radiance"
    assert complained == f"jaxhf: warning: {where} is now called irradiance\n"


def test_our_own_bug_keeps_its_traceback(tmp_path, monkeypatch, in_this_process):
    """Only what is known for the user's mistake becomes one line."""

    def broken(*_, **__):
        raise ValueError("a bug")

    monkeypatch.setattr("jaxhf.rendering.render.render", broken)
    with pytest.raises(ValueError, match=r"^a bug$"):
        in_this_process("render", SCENE, "-o", tmp_path / "out.png")


@pytest.mark.parametrize("error", [MemoryError("8 GiB"), RuntimeError("RESOURCE_EXHAUSTED: Out of memory")])
def test_no_memory_is_an_error_in_one_line(monkeypatch, in_this_process, error):
    def fail(*_):
        raise error

    monkeypatch.setattr("jaxhf.io.scenes.load_scene", fail)
    said = "jaxhf: error: memory ran out; a smaller picture or terrain needs less (render: also a smaller --chunk)\n"
    assert in_this_process("info", SCENE) == (2, "", said)


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
    (tmp_path / "dém.toml").write_text(CAMERA + FIELD.replace("heights = [[0, 1], [2, 3]]", 'file = "é.npy"'), encoding="utf-8")
    command = ["render", "--width", "8"] if source.endswith(".toml") else ["hillshade"]
    words = [sys.executable, "-m", "jaxhf", *command, source, "-o", output]
    environment = {**os.environ, "PYTHONPATH": str(Path(jaxhf.__file__).parents[1]), **variables}
    run = subprocess.run(words, capture_output=True, timeout=120, cwd=tmp_path, env=environment)
    assert run.returncode == 0, run.stderr
    assert run.stdout.decode().startswith(f"{shown}: ")
    assert (tmp_path / output).exists()


# Errors of the user's.

CAMERA = 'camera = { type = "perspective", eye = [0, -3, 2], target = [0, 0, 0] }\n'
FIELD = '[[objects]]\nshape = "heightfield"\nheights = [[0, 1], [2, 3]]\n'
PBRT = """Camera "perspective"
WorldBegin
Shape "heightfield" "integer nu" [2] "integer nv" [2] "float Pz" [0 1 2]
WorldEnd
"""


def toml(field=FIELD, extra=""):
    return {"scene.toml": CAMERA + field + extra}


NO_IMAGE = 'albedo = "a"\n[textures.a]\nimage = "a.png"'
OTHER_FILES = '\n[[objects]]\nshape = "heightfield"\nfile = "x.vrt"\n'
GOOD = toml()
# Files, the words, and what is said: one of each kind of mistake. `io` has what may be wrong in a scene.
BAD = {
    "missing scene": ({}, "missing.toml", r"missing\.toml: there is no such file"),
    "a key of the scene": (toml(extra="hieghts = 1\n"), "scene.toml", r"scene\.toml:5: unknown key 'hieghts'"),
    "a scene of pbrt": ({"scene.pbrt": PBRT}, "scene.pbrt", r"scene\.pbrt:3: .*\b3\b"),
    "no image": ({**toml(extra=NO_IMAGE), "a.png": "none"}, "scene.toml", r"scene\.toml:7: .*a\.png: .*not a PNG"),
    "heights from anywhere": ({**toml(extra=OTHER_FILES), "x.vrt": ""}, "scene.toml", r"'x\.vrt' names other files, which a "),
    "negative width": (GOOD, "scene.toml --width -4", r"--width must be .* it is -4"),
    "samples that are no square": (GOOD, "scene.toml --samples 3", r"samples must be a square number .* it is 3"),
    "unknown shading": (GOOD, "scene.toml --shading x", r"shading.*smooth.*flat.*'x'"),
    "unknown option": (GOOD, "scene.toml --spp 3", r"--spp"),
    "unknown ending of the picture": (GOOD, "scene.toml -o out.bmp", r"out\.bmp: .*'\.bmp'"),
    "no such layer": (GOOD, "scene.toml -o out.exr --aovs depth,deep", r"aovs must be among depth, .*; one is 'deep'"),
    "no output": (GOOD, "scene.toml -o", r"-o"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_input(name, tmp_path, monkeypatch, in_this_process):
    """Exit code 2, one line, no traceback, no file."""
    files, words, message = BAD[name]
    monkeypatch.chdir(tmp_path)
    for file, text in files.items():
        (tmp_path / file).write_text(text)
    arguments = ["render", *words.split(), *([] if "-o" in words else ["-o", "out.png"])]
    if name == "unknown shading":  # in a process, as a user meets it: here jaxtyping would refuse it first
        run = jaxhf_command(*arguments, cwd=tmp_path)
        code, out, err = run.returncode, run.stdout, run.stderr
    else:
        code, out, err = in_this_process(*arguments)
    assert (code, out) == (2, ""), err
    (line,) = err.splitlines()
    assert re.match(r"jaxhf( render)?: error: ", line), line
    assert re.search(message, line), line
    assert {path.name for path in tmp_path.iterdir()} == set(files)
