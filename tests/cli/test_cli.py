"""The command line: what it prints, what it hands on, and how it ends; once in a process of its own, as a user runs it."""

import dataclasses
import importlib.metadata
import importlib.util
import os
import re
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import jaxhf
from jaxhf.cli.main import main
from jaxhf.cli.progress import bar

SCENE = Path(__file__).parents[2] / "scenes" / "debug4x4.toml"  # 320 x 240
REPORT = re.compile(
    r"(?P<path>.*): (?P<width>\d+) x (?P<height>\d+) pixels, (?P<rays>\d+) camera rays \((?P<samples>\d+) a pixel\), "
    r"(?P<seconds>[\d.e-]+) s \+ (?P<compiling>[\d.e-]+) s compiling, (?P<device>.+), "
    r"(?P<rate>[\d.e+-]+) rays/s, (?P<exhausted>\d+) rays exhausted"
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


def report(out):
    """The one line that a rendering prints, in its parts."""
    found = REPORT.fullmatch(out.rstrip("\n"))
    assert found, out
    return found.groupdict()


def test_help_is_quick():
    def timed():
        begin = time.perf_counter()
        run = jaxhf_command("--help")
        return time.perf_counter() - begin, run

    runs = [timed() for _ in range(5)]
    assert min(seconds for seconds, _ in runs) < 0.3
    for _, run in runs:
        assert run.returncode == 0
        assert "render" in run.stdout
        assert "info" in run.stdout


def test_help_does_not_import_jax():
    script = """
import contextlib, sys
from jaxhf.cli.main import main
for command in ([], ["render"], ["hillshade"], ["relief"], ["fit"], ["tradeoff"], ["convert"], ["info"]):
    with contextlib.suppress(SystemExit):
        main([*command, "--help"])
print({"jax", "numpy", "tqdm"} & sys.modules.keys())
"""
    run = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120)
    assert run.returncode == 0
    assert run.stdout.splitlines()[-1] == "set()"


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


def test_version():
    """Without JAX, by `import jaxhf` too."""
    run = jaxhf_command("--version")
    assert (run.returncode, run.stdout) == (0, f"jaxhf {importlib.metadata.version('jaxhf')}\n")
    script = "import sys, jaxhf; print(jaxhf.__version__, 'jax' in sys.modules)"
    run = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120)
    assert run.stdout == f"{importlib.metadata.version('jaxhf')} False\n"


def test_render(tmp_path):
    """--width alone keeps the scene's proportions; single precision; a pipe gets nothing but the report."""
    path = tmp_path / "out.npy"
    run = jaxhf_command("render", SCENE, "-o", path, "--width", 20)
    assert run.returncode == 0, run.stderr
    assert run.stderr == ""
    found = report(run.stdout)
    assert found["path"] == str(path)
    assert (found["width"], found["height"], found["rays"], found["samples"]) == ("20", "15", "1200", "4")
    assert found["exhausted"] == "0"
    for name in ("seconds", "compiling", "rate"):
        assert float(found[name]) > 0
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
    found = report(out)
    assert (found["width"], found["height"], found["samples"], found["exhausted"]) == ("16", "12", "1", "2")
    assert np.load(tmp_path / "out.npy").dtype == np.float64

    assert in_this_process("render", SCENE, "-o", tmp_path / "out.npy", "--shading", "flat")[0] == 0
    assert rendered.pop()[1] == jaxhf.Settings(shading="flat")
    assert in_this_process("render", SCENE, "-o", tmp_path / "out.npy")[0] == 0
    scene, settings = rendered[1]
    assert settings == jaxhf.Settings()
    assert (scene.camera.width, scene.camera.height, scene.heights.dtype) == (320, 240, np.float32)


@pytest.mark.parametrize("ending", [".png", ".npy", ".exr", ".pfm"])
def test_formats(tmp_path, in_this_process, rendered, ending):
    if ending == ".exr":
        pytest.importorskip("OpenEXR")
    for path in ("exact.npy", f"out{ending}"):
        code, _, err = in_this_process("render", SCENE, "-o", tmp_path / path, "--width", 16, "--height", 10)
        assert (code, err) == (0, "")
    exact, image = np.load(tmp_path / "exact.npy"), jaxhf.load_image(tmp_path / f"out{ending}")
    assert exact.shape == (10, 16, 3)
    if ending == ".png":  # half of 1/255 in sRGB, where the curve is steepest: 2.3
        np.testing.assert_allclose(image, np.clip(exact, 0, 1), atol=2.3 / 510)
    else:
        np.testing.assert_array_equal(image, exact)


def test_bars_are_for_terminals_and_long_work(monkeypatch, capsys):
    def show(**options):
        with bar(unit=" pixels", **options) as shown:
            shown.total = 100
            shown.update(10)
            if not shown.disable:
                shown.start_t, shown.last_print_t = shown.start_t - 1, shown.last_print_t - 1  # as if begun a second ago
            shown.update(40)
        return capsys.readouterr().err

    assert show(delay=0.5) == ""
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    assert "50/100" in show(delay=0.5)
    assert show(delay=0.5).endswith("\r")  # wiped out
    assert show(delay=5.0) == ""


def test_info(in_this_process):
    code, out, err = in_this_process("info", SCENE)
    assert (code, err) == (0, "")
    lines = out.splitlines()
    assert lines[0] == f"{SCENE}: 320 x 240 pixels, 4 samples a pixel"
    assert lines[1] == "camera: Perspective, at (-0.9, -1.3, 1.5)"
    assert lines[2] == (
        "object 0: Heightfield, 4 x 4 heights, cells 0.333333 x 0.333333, origin (0, 0), range (0, 0.6), "
        "matte, albedo (0.8, 0.65, 0.5)"
    )
    assert lines[3].startswith("light 0: Point, p (-0.9, -1.3, 1.5), intensity (18, 18, 18)")
    assert lines[4].startswith("light 1: Sky, radiance (0.05, 0.07, 0.1)")


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

    monkeypatch.setattr("jaxhf.cli.info.run", fail)
    said = "jaxhf: error: memory ran out; a smaller picture or terrain needs less (render: also a smaller --chunk)\n"
    assert in_this_process("info", SCENE) == (2, "", said)


C_LOCALE = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}


@pytest.mark.skipif(sys.platform in ("darwin", "win32"), reason="these take names in Unicode alone")
@pytest.mark.parametrize(
    ("variables", "source", "output", "shown"),
    [
        (C_LOCALE, "dém 1.tif", "c ü.tif", "c ü.tif"),
        ({"PYTHONIOENCODING": "latin-1"}, "a.tif", "c 山.tif", r"c \u5c71.tif"),
        ({}, os.fsdecode(b"d\xe9m.tif"), os.fsdecode(b"\xfc.tif"), r"\udcfc.tif"),
        (C_LOCALE, "dém.toml", "ü.npy", "ü.npy"),
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
    quiet = subprocess.run([*run.args, "--quiet"], capture_output=True, timeout=120, cwd=tmp_path, env=environment)
    assert (quiet.returncode, quiet.stdout) == (0, b""), quiet.stderr


# Errors of the user's.

CAMERA = """[camera]
type = "perspective"
eye = [0, -3, 2]
target = [0, 0, 0]
"""
FIELD = """
[[objects]]
shape = "heightfield"
heights = [[0, 1], [2, 3]]
"""
PBRT = """LookAt 0 -3 2  0 0 0  0 0 1
Camera "perspective" "float fov" [45]
Film "image" "integer xresolution" [8] "integer yresolution" [8]
WorldBegin
LightSource "point" "color I" [1 1 1] "point from" [0 0 5]
Shape "heightfield" "integer nu" [2] "integer nv" [2] "float Pz" [0 1 2 3]
WorldEnd
"""


def toml(field=FIELD, extra=""):
    return {"scene.toml": CAMERA + field + extra}


def pbrt(old="", new=""):
    assert old in PBRT
    return {"scene.pbrt": PBRT.replace(old, new)}


def object_with(line):
    return toml(extra=line + "\n")


GOOD = toml()
BAD = {
    "missing scene": ({}, "missing.toml", [], r"missing\.toml: there is no such file"),
    "unknown ending of the scene": ({"scene.obj": ""}, "scene.obj", [], r"scene\.obj: .*'\.obj'"),
    "unknown key": (toml(extra="hieghts = 1\n"), "scene.toml", [], r"scene\.toml:9: unknown key 'hieghts'"),
    "unknown directive": (pbrt("WorldEnd", "Shpae 1\nWorldEnd"), "scene.pbrt", [], r"scene\.pbrt:7: .*Shpae"),
    "wrong number of heights": (pbrt("[0 1 2 3]", "[0 1 2]"), "scene.pbrt", [], r"scene\.pbrt:6: .*\b3\b"),
    "ragged heights": (toml(FIELD.replace("[2, 3]", "[2]")), "scene.toml", [], r"scene\.toml:8: objects\[0\]\.heights"),
    "nan heights": (toml(FIELD.replace("3", "nan")), "scene.toml", [], r"scene\.toml:8: .*row 1 column 1 is nan"),
    "nan heights in a file": (pbrt("[0 1 2 3]", "[0 1 nan 3]"), "scene.pbrt", [], r"scene\.pbrt:6: .*nan"),
    "one row": (toml(FIELD.replace(", [2, 3]", "")), "scene.toml", [], r"scene\.toml:8: .*at least 2x2.*\(1, 2\)"),
    "no heights": (toml(FIELD.replace("[[0, 1], [2, 3]]", "[]")), "scene.toml", [], r"scene\.toml:8: .*heights"),
    "zero transform": (object_with("transform = [{ scale = 0 }]"), "scene.toml", [], r"scene\.toml:9: .*transform"),
    "singular matrix": (
        object_with("matrix = [[1, 1, 0, 0], [1, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]"),
        "scene.toml",
        [],
        r"scene\.toml:9: .*matrix must be invertible",
    ),
    "zero scale in pbrt": (pbrt("Shape", "Scale 0 1 1\nShape"), "scene.pbrt", [], r"scene\.pbrt:\d: "),
    "texture that is no image": (
        {**object_with('albedo = "a"\n[textures.a]\nimage = "a.png"'), "a.png": "no image"},
        "scene.toml",
        [],
        r"scene\.toml:11: .*a\.png: .*not a PNG",
    ),
    "negative width": (GOOD, "scene.toml", ["--width", "-4"], r"--width must be .* it is -4"),
    "zero height": (GOOD, "scene.toml", ["--height", "0"], r"--height must be .* it is 0"),
    "size that is no number": (GOOD, "scene.toml", ["--width", "wide"], r"--width must be .*'wide'"),
    "negative width in the scene": (
        {"scene.toml": CAMERA + "width = -3\n" + FIELD},
        "scene.toml",
        [],
        r"scene\.toml:5: .*width must be .*-3",
    ),
    "samples that are no square": (GOOD, "scene.toml", ["--samples", "3"], r"samples must be a square number .* it is 3"),
    "chunk that is no number": (GOOD, "scene.toml", ["--chunk", "many"], r"--chunk must be .*'many'"),
    "chunk of a whole picture and more": (GOOD, "scene.toml", ["--chunk", "1e8"], r"chunk must be at most 1048576, .*1024"),
    "unknown shading": (GOOD, "scene.toml", ["--shading", "x"], r"shading.*smooth.*flat.*'x'"),
    "unknown traversal": (GOOD, "scene.toml", ["--traversal", "x"], r"traversal.*'x'"),
    "unknown normals": (GOOD, "scene.toml", ["--normals", "x"], r"normals.*six-angle.*'x'"),
    "unknown precision": (GOOD, "scene.toml", ["--precision", "float16"], r"--precision.*'float16'"),
    "no budget": (GOOD, "scene.toml", ["--max-steps", "0"], r"max_steps must be .* it is 0"),
    "unknown option": (GOOD, "scene.toml", ["--spp", "3"], r"--spp"),
    "no such folder": (GOOD, "scene.toml", ["-o", "nowhere/out.png"], r"nowhere/out\.png: there is no folder"),
    "unknown ending of the picture": (GOOD, "scene.toml", ["-o", "out.bmp"], r"out\.bmp: .*'\.bmp'"),
    "layers of a .png": (GOOD, "scene.toml", ["--aovs", "depth"], r"--aovs are layers of an \.exr, out\.png is none"),
    "no such layer after a space": (
        GOOD,
        "scene.toml",
        ["-o", "out.exr", "--aovs", "depth, deep"],
        r"aovs must be among depth, .*; one is 'deep'",
    ),
    "no such layer": (GOOD, "scene.toml", ["-o", "out.exr", "--aovs", "deep"], r"aovs must be among depth, .*; one is 'deep'"),
    "heights from anywhere": (
        {"scene.toml": GOOD["scene.toml"] + '\n[[objects]]\nshape = "heightfield"\nfile = "x.vrt"\n', "x.vrt": "<VRTDataset/>"},
        "scene.toml",
        [],
        r"'x\.vrt' names other files, which a scene cannot open",
    ),
    "no output": (GOOD, "scene.toml", None, r"-o"),
}


# In the tests' process jaxtyping would refuse these first.
NOT_TYPED = {"unknown shading", "unknown traversal", "unknown normals"}


@pytest.mark.parametrize("name", BAD)
def test_bad_input(name, tmp_path, monkeypatch, in_this_process):
    """Exit code 2, one line, no traceback, no file."""
    files, scene, options, message = BAD[name]
    monkeypatch.chdir(tmp_path)
    for file, text in files.items():
        (tmp_path / file).write_text(text)
    output = [] if options is None or "-o" in options else ["-o", "out.png"]
    arguments = ["render", scene, *output, *(options or [])]
    if name in NOT_TYPED:
        run = jaxhf_command(*arguments, cwd=tmp_path)
        code, out, err = run.returncode, run.stdout, run.stderr
    else:
        code, out, err = in_this_process(*arguments)
    assert (code, out) == (2, ""), err
    (line,) = err.splitlines()
    assert re.match(r"jaxhf( render)?: error: ", line), line
    assert re.search(message, line), line
    assert {path.name for path in tmp_path.iterdir()} == set(files)


def test_bad_scene_for_info(tmp_path):
    """In a process of its own, as a user meets it."""
    (tmp_path / "scene.toml").write_text(CAMERA)
    run = jaxhf_command("info", "scene.toml", cwd=tmp_path)
    assert run.returncode == 2
    assert len(run.stderr.splitlines()) == 1
    assert "objects" in run.stderr


def test_no_command(in_this_process):
    code, _, err = in_this_process()
    assert code == 2
    assert len(err.splitlines()) == 1
