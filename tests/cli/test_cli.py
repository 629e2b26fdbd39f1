"""The command line as a user runs it: its own process, single precision, what it prints and how it ends."""

import importlib.metadata
import importlib.util
import re
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import jaxhf
from jaxhf.cli import main as command

SCENE = Path(__file__).parents[2] / "scenes" / "debug4x4.toml"  # 320 x 240
REPORT = re.compile(
    r"(?P<path>.*): (?P<width>\d+) x (?P<height>\d+) pixels, (?P<rays>\d+) camera rays \((?P<samples>\d+) a pixel\), "
    r"(?P<seconds>[\d.e-]+) s \+ (?P<compiling>[\d.e-]+) s compiling, (?P<device>.+), "
    r"(?P<rate>[\d.e+-]+) rays/s, (?P<exhausted>\d+) rays exhausted"
)


def python(*arguments, **options):
    return subprocess.run([sys.executable, *map(str, arguments)], capture_output=True, text=True, timeout=120, **options)


def jaxhf_command(*arguments, **options):
    return python("-m", "jaxhf", *arguments, **options)


def report(run):
    """The last line that a rendering prints, in its parts. A pipe gets nothing but that line."""
    assert run.returncode == 0, run.stderr
    assert run.stderr == ""
    found = REPORT.fullmatch(run.stdout.splitlines()[-1])
    assert found, run.stdout
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


@pytest.mark.parametrize("arguments", [["--help"], ["render", "--help"], ["fit", "--help"]])
def test_help_does_not_import_jax(arguments):
    script = "import sys\nfrom jaxhf.cli.main import main\ntry: main(sys.argv[1:])\nfinally: print('jax' in sys.modules)"
    run = python("-c", script, *arguments)
    assert run.returncode == 0
    assert run.stdout.splitlines()[-1] == "False"


def test_version():
    """Without JAX, by `import jaxhf` too."""
    run = jaxhf_command("--version")
    assert (run.returncode, run.stdout) == (0, f"jaxhf {importlib.metadata.version('jaxhf')}\n")
    run = python("-c", "import sys, jaxhf; print(jaxhf.__version__, 'jax' in sys.modules)")
    assert run.stdout == f"{importlib.metadata.version('jaxhf')} False\n"


def test_render(tmp_path):
    """--width alone keeps the scene's proportions; the picture is that of `render`."""
    path = tmp_path / "out.npy"
    found = report(jaxhf_command("render", SCENE, "-o", path, "--width", 20))
    assert found["path"] == str(path)
    assert (found["width"], found["height"], found["rays"], found["samples"]) == ("20", "15", "1200", "4")
    assert found["exhausted"] == "0"
    for name in ("seconds", "compiling", "rate"):
        assert float(found[name]) > 0
    image = np.load(path)
    assert (image.shape, image.dtype) == ((15, 20, 3), np.float32)
    assert np.isfinite(image).all()
    assert image.max() > 2 * image.min() > 0


def test_options_reach_the_renderer(tmp_path):
    path = tmp_path / "out.npy"
    options = ["--precision", "float64", "--height", 12, "--samples", 1, "--max-steps", 1, "--shading", "flat", "--no-shadows"]
    found = report(jaxhf_command("render", SCENE, "-o", path, *options))
    assert (found["width"], found["height"], found["samples"]) == ("16", "12", "1")
    assert 0 < int(found["exhausted"]) <= 16 * 12
    assert np.load(path).dtype == np.float64


@pytest.fixture(scope="module")
def pictures(tmp_path_factory):
    """One small picture in every format, by one process: it compiles only once."""
    folder = tmp_path_factory.mktemp("pictures")
    script = """
import sys
from jaxhf.cli.main import main
for path in sys.argv[2:]:
    assert main(["render", sys.argv[1], "-o", path, "--width", "16", "--height", "10", "--samples", "1"]) == 0
"""
    endings = [".png", ".npy", ".pfm"] + [".exr"] * (importlib.util.find_spec("OpenEXR") is not None)
    paths = {ending: folder / f"out{ending}" for ending in endings}
    run = python("-c", script, SCENE, *paths.values())
    assert run.returncode == 0, run.stderr
    assert len(run.stdout.splitlines()) == len(paths)
    assert run.stderr == ""
    return paths


@pytest.mark.parametrize("ending", [".png", ".npy", ".exr", ".pfm"])
def test_formats(pictures, ending):
    if ending == ".exr":
        pytest.importorskip("OpenEXR")
    exact = np.load(pictures[".npy"])
    assert exact.shape == (10, 16, 3)
    image = jaxhf.load_image(pictures[ending])
    if ending == ".png":  # half of 1/255 in sRGB, where the curve is steepest: 2.3
        np.testing.assert_allclose(image, np.clip(exact, 0, 1), atol=2.3 / 510)
    else:
        np.testing.assert_array_equal(image, exact)


def test_info():
    run = jaxhf_command("info", SCENE)
    assert run.returncode == 0
    assert run.stderr == ""
    lines = run.stdout.splitlines()
    assert lines[0] == f"{SCENE}: 320 x 240 pixels, 4 samples a pixel"
    assert lines[1] == "camera: Perspective, at (-0.9, -1.3, 1.5)"
    assert lines[2] == (
        "object 0: Heightfield, 4 x 4 heights, cells 0.333333 x 0.333333, origin (0, 0), range (0, 0.6), "
        "matte, albedo (0.8, 0.65, 0.5)"
    )
    assert lines[3].startswith("light 0: Point, p (-0.9, -1.3, 1.5), intensity (18, 18, 18)")
    assert lines[4].startswith("light 1: Sky, radiance (0.05, 0.07, 0.1)")


def test_our_own_bug_keeps_its_traceback(tmp_path):
    """Only what is known for the user's mistake becomes one line."""
    script = """
import sys
import jaxhf.rendering.render
from jaxhf.cli.main import main

def broken(*_, **__):
    raise ValueError("a bug")

jaxhf.rendering.render.render = broken
sys.exit(main(sys.argv[1:]))
"""
    run = python("-c", script, "render", SCENE, "-o", tmp_path / "out.png")
    assert run.returncode == 1
    lines = run.stderr.splitlines()
    assert (lines[0], lines[-1]) == ("Traceback (most recent call last):", "ValueError: a bug")
    assert "in broken" in run.stderr


@pytest.mark.parametrize("error", [MemoryError("8 GiB"), RuntimeError("RESOURCE_EXHAUSTED: Out of memory")])
def test_no_memory_is_an_error_in_one_line(monkeypatch, capsys, error):
    def fail(*_):
        raise error

    monkeypatch.setattr(command, "_info", fail)
    assert command.main(["info", str(SCENE)]) == 2
    assert (
        capsys.readouterr().err
        == "jaxhf: error: memory ran out; a smaller picture or terrain needs less (render: also a smaller --chunk)\n"
    )


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
    "size that is no number": (GOOD, "scene.toml", ["--width", "wide"], r"--width: .*'wide'"),
    "negative width in the scene": (
        {"scene.toml": CAMERA + "width = -3\n" + FIELD},
        "scene.toml",
        [],
        r"scene\.toml:5: .*width must be .*-3",
    ),
    "samples that are no square": (GOOD, "scene.toml", ["--samples", "3"], r"samples must be a square number .* it is 3"),
    "unknown shading": (GOOD, "scene.toml", ["--shading", "x"], r"shading.*smooth.*flat.*'x'"),
    "unknown traversal": (GOOD, "scene.toml", ["--traversal", "x"], r"traversal.*'x'"),
    "unknown normals": (GOOD, "scene.toml", ["--normals", "x"], r"normals.*six-angle.*'x'"),
    "unknown precision": (GOOD, "scene.toml", ["--precision", "float16"], r"--precision.*'float16'"),
    "no budget": (GOOD, "scene.toml", ["--max-steps", "0"], r"max_steps must be .* it is 0"),
    "unknown option": (GOOD, "scene.toml", ["--spp", "3"], r"--spp"),
    "no such folder": (GOOD, "scene.toml", ["-o", "nowhere/out.png"], r"nowhere/out\.png: there is no folder"),
    "unknown ending of the picture": (GOOD, "scene.toml", ["-o", "out.bmp"], r"out\.bmp: .*'\.bmp'"),
    "no output": (GOOD, "scene.toml", None, r"-o"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_input(name, tmp_path):
    """Exit code 2, one line, no traceback, no file."""
    files, scene, options, message = BAD[name]
    for file, text in files.items():
        (tmp_path / file).write_text(text)
    output = [] if options is None or "-o" in options else ["-o", "out.png"]
    run = jaxhf_command("render", scene, *output, *(options or []), cwd=tmp_path)
    assert run.returncode == 2, run.stderr
    assert run.stdout == ""
    (line,) = run.stderr.splitlines()
    assert re.match(r"jaxhf( render)?: error: ", line), line
    assert re.search(message, line), line
    assert {path.name for path in tmp_path.iterdir()} == set(files)


def test_bad_scene_for_info(tmp_path):
    (tmp_path / "scene.toml").write_text(CAMERA)
    run = jaxhf_command("info", "scene.toml", cwd=tmp_path)
    assert run.returncode == 2
    assert len(run.stderr.splitlines()) == 1
    assert "objects" in run.stderr


def test_no_command():
    run = jaxhf_command()
    assert run.returncode == 2
    assert len(run.stderr.splitlines()) == 1
