"""What all commands have in common: their help, words that are meant otherwise, what they replace, what they print when."""

import io
import re
import shlex
import sys
from types import SimpleNamespace

import numpy as np
import pytest

import jaxhf
from jaxhf.cli import main as entry, parser
from jaxhf.cli.main import main
from jaxhf.cli.overwriting import require_no_input
from jaxhf.cli.progress import bar, compiled_bar, quiet

GROUPS = {
    "terrain maps": "hillshade slope aspect curvature ruggedness relief skyview horizon insolation viewshed",
    "pictures": "view render",
    "recovery": "fit tradeoff",
    "files": "convert info",
}


def test_help_has_the_commands_in_groups_and_each_examples_that_it_takes(command):
    code, text, _ = command("--help")
    assert code == 0
    for title, names in GROUPS.items():
        listed = text.split(f"\n{title}:\n")[1].split("\n\n")[0]
        assert [line.split()[0] for line in listed.splitlines()] == names.split()
    for name in " ".join(GROUPS.values()).split():
        code, text, _ = command(name, "--help")
        assert (code, "--quiet" in text) == (0, True)
        examples = [line.strip() for line in text.split("\nexamples:\n")[1].splitlines()]
        assert len(examples) >= 2
        for example in examples:
            program, *words = shlex.split(example)
            assert (program, words[0]) == ("jaxhf", name)
            parser.parse(words)  # SystemExit where it is refused


SCENE = """samples = 1
camera = { type = "perspective", eye = [0, -3, 2], target = [0, 0, 0] }
textures.rock = { image = 'rock.png' }
objects = [{ shape = "heightfield", file = "hills.npy", albedo = "rock" }]
"""
CAMERA = 'camera = { type = "perspective", eye = [0, -3, 2], target = [0, 0, 0] }\n'
BROKEN = {
    "key.toml": CAMERA + 'objects = [{ shape = "heightfield", hieghts = [[0, 1], [2, 3]] }]',
    "few.pbrt": 'Camera "perspective"\nWorldBegin\n'
    'Shape "heightfield" "integer nu" [2] "integer nv" [2] "float Pz" [0 1 2]\nWorldEnd\n',
    "image.toml": SCENE.replace("'rock.png'", "'none.png'").replace("samples = 1\n", ""),
    "none.png": "none",
    "bare.toml": CAMERA + 'objects = [{ shape = "cylinder" }]',
    "vrt.toml": SCENE.replace("hills.npy", "x.vrt"),
    "x.vrt": "",
}
TIMES = "--sun-from 2026-06-21T05:00:00Z --sun-to 2026-06-21T18:00+01:00"
ADDRESS = "http://a/b.tif: this is an address, files are neither read from the network nor"
# What each command refuses; hills are 4 x 4 with a spacing, none has no heights.
REFUSED = [
    ("", "jaxhf: error: "),
    # Words that are meant otherwise, and endings.
    ("rendr scene.toml", "unknown command 'rendr'; did you mean 'render'?"),
    ("terrain.tif", "'terrain.tif' is no command; one stands before its files, as in 'jaxhf info terrain.tif'"),
    ("slope a.tif -o b.tif --percnt", "unknown option --percnt; did you mean --percent?"),
    ("hillshade a.tif -o b.tif -az 315", "unknown option -az; did you mean --azimuth?"),
    ("render a.toml -o b.png --preset exact", "unknown option --preset; jaxhf view has it (see"),
    ("hillshade a.tif -o b.tif --variant igo", "--variant must be one of regular, combined, "),
    ("render a.toml -o b.png --samples 1.5", "--samples must be a whole number, it is '1.5'"),
    ("render hills.npz -o a.png", "known: .pbrt, .toml; this is a terrain, for jaxhf view, hillshade, relief or convert\n"),
    ("hillshade scene.toml -o a.png", ".xyz; this is a scene, for jaxhf render\n"),
    ("render scene.toml -o a.tif", "known: .exr, .jpeg, .jpg, .npy, .pfm, .png, .webp\n"),  # not the .pfm that is spelt alike
    ("render scene.toml -o a.pgn", "did you mean '.png'?\n"),
    ("convert hills.npz a.gbl", "cannot write heights with the ending '.gbl'; did you mean '.glb'?"),
    ("convert none.tif a.jpg", "cannot write heights with the ending '.jpg'"),  # before it reads
    ("info x.tfi", "cannot describe the ending '.tfi'; did you mean '.tif'?"),
    ("info none.tif", "none.tif: there is no such file"),
    ("render none.toml -o a.png", "none.toml: there is no such file"),
    ("render scene.toml -o a.png --spp 3", "unknown option --spp (see"),
    ("render scene.toml -o", "-o/--output expected one argument"),
    ("render scene.toml -o a.bmp", "a.bmp: cannot write an image with the ending '.bmp'"),
    # What stands in scenes, one of each kind: `io` has what may be wrong there.
    ("render key.toml -o a.png", "key.toml:2: unknown key 'hieghts'"),
    ("render few.pbrt -o a.png", "few.pbrt:3: Pz must hold nu * nv = 2 * 2 = 4 heights, it holds 3"),
    ("render image.toml -o a.png", "image.toml:2: textures.rock.image: "),
    ("render image.toml -o a.png", "none.png: it is not a PNG"),
    ("render vrt.toml -o a.png", "'x.vrt' names other files, which a scene cannot open"),
    ("info http://a/b.tif", ADDRESS),
    ("render http://a/b.tif -o b.png", ADDRESS),
    ("slope hills.npz -o http://a/b.tif", ADDRESS),
    # Options that would change nothing.
    ("relief hills.npz -o a.png --no-shading --shadows", "--shadows would change nothing: --no-shading leaves the light out"),
    ("relief hills.npz -o a.png --variant igor --altitude 9", "--altitude would change nothing: --variant igor has lights of"),
    ("hillshade hills.npz -o a.png --variant multidirectional --azimuth 9", "--azimuth would change nothing: --variant multi"),
    ("horizon hills.npz -o a.npy --azimuth 90 --azimuths 8", "--azimuths would change nothing: --azimuth asks for one"),
    ("view hills.npz -o a.png --frames 24", "--frames would change nothing: a.png is one picture, a film is .gif or .mp4"),
    ("view hills.npz -o a.png --title x", "--title would change nothing: without --annotate there is no caption"),
    ("view hills.npz -o a.gif --annotate", "--annotate would change nothing: a.gif is a film, and pictures have captions"),
    ("view hills.npz -o a.exr --annotate", "a.exr: cannot write a picture with a caption with the ending '.exr'; known: .pdf"),
    ("view hills.npz -o a.gif --sun-from 90,9 --sun-to 99,9 --altitude 8", "--altitude would change nothing: the sun moves"),
    ("view hills.npz -o a.png --ramp terrain --drape rock.png", "--ramp would change nothing: --drape gives the terrain its"),
    ("render scene.toml -o a.png --shading flat --normals six", "--normals would change nothing: --shading flat takes those"),
    ("tradeoff scene.toml --knobs max_depth", "tradeoff: knobs 'max_depth' changes nothing here: the scene has no mirror"),
    # Values.
    ("render scene.toml -o a.png --width -4", "--width must be a whole number from 1 on, it is -4"),
    ("render scene.toml -o a.png --shading x", "jaxhf: error: Settings: shading must be one of smooth, flat; it is 'x'\n"),
    ("render scene.toml -o a.png --samples 3", "samples must be a square number (1, 4, 9, ...), it is 3"),
    ("render scene.toml -o a.exr --aovs depth,deep", "aovs must be among depth, normal, uv, status, object,"),
    ("render scene.toml -o a.exr --aovs depth,deep", "; one is 'deep'"),
    ("hillshade hills.npz -o a.npy --altitude 0", "hillshade: altitude must be above 0 and at most 90 degrees, it is 0.0"),
    ("slope hills.npz -o a.npy --dx 0", "slope: dx must be positive and finite, it is 0.0"),
    ("slope hills.npz -o a.png", "a.png: a .png holds whole numbers from 0 to 255, no slope; write .tif or .npy"),
    ("relief hills.npz -o a.npy --ramp terain", "nor a matplotlib colour map of this name; did you mean terrain or "),
    ("hillshade none.npz -o a.npy", "hillshade: heights must hold a finite one"),
    ("skyview hills.npz -o a.npy --azimuths 0", "--azimuths must be a whole number from 1 on, it is 0"),
    ("horizon hills.npz -o a.npy --azimuth nan", "--azimuth must be finite, it is nan"),
    ("convert hills.npz a.tif --base 0", "--base would change nothing: meshes are .glb"),
    ("convert hills.npz a.glb --base 5", "base must lie below all heights, the lowest is 0, it is 5"),
    ("view hills.npz -o a.gif --sun-from 90,10", "--sun-from and --sun-to belong together"),
    ("view hills.npz -o a.png --sun-from 90,10 --sun-to 90,20", "a moving sun makes a film"),
    ("view hills.npz -o a.gif --sun-from 90,10 --sun-to 2026-06-21T05:00:00Z", "must both be angles or both be times"),
    (f"view hills.npz -o a.gif {TIMES}", "hills.npz: it has no georeference"),
    (f"view hills.npz -o a.gif {TIMES} --latitude 46.5", "--latitude and --longitude belong together, one is missing"),
    (f"view hills.npz -o a.gif {TIMES} --latitude -80 --longitude 8", "the sun must be up all the time, its altitude is"),
    ("view hills.npz -o a.png --water nan", "--water must be finite"),
    ("view hills.npz -o a.png --exaggeration 0", "--exaggeration must be positive and finite"),
    ("view hills.npz -o a.png --exaggeration 1e9", "must leave a terrain at most 100 times its length high; times 1e+09 it"),
    ("view hills.npz -o a.png --demo", "IN or --demo must say what to show, not both"),
    ("view", "there is neither"),
    ("tradeoff bare.toml", "bare.toml: there is no heightfield"),
    ("tradeoff scene.toml --error -1", "--error must be positive, it is -1"),
    ("tradeoff scene.toml --knobs x", "knobs must be among "),
    ("tradeoff scene.toml --knobs x", "; one is 'x'"),
    ("tradeoff scene.toml --width 0", "--width must be positive, it is 0"),
    ("tradeoff scene.toml --devices -1", "--devices must be positive, it is -1"),
    ("fit case.toml -o a.npy --overlap 8", "--overlap must stand with --window"),
    ("fit case.toml -o a.npy --window 32 --report page.html", "--report must stand without --window: it shows one fit"),
    ("fit hills.npz -o a.npy", "hills.npz: cannot read what to fit from"),
    ("fit scene.toml -o a.npz", "scene.toml: a fit must have 'pictures'"),
    ("fit case.toml -o none/a.npy", "none/a.npy: there is no folder"),
    ("fit case.toml -o a.png", "known: .npy, .npz, .tif, .tiff\n"),
    ("fit case.toml -o a.npy --report a.pdf", "a.pdf: cannot write a page with"),
]


@pytest.mark.parametrize(("line", "answer"), REFUSED)
def test_what_cannot_be_is_refused_in_one_line_before_anything_is_written(folder, command, line, answer, as_users_call_it):
    np.savez(folder / "hills.npz", heights=np.eye(4), dx=1.0, dy=1.0)
    np.savez(folder / "none.npz", heights=np.full((4, 4), np.nan), dx=1.0, dy=1.0)
    for name, text in BROKEN.items():
        (folder / name).write_text(text)
    before = sorted(folder.iterdir())
    code, out, text = command(*line.split())
    assert (code, out, text.count("\n"), answer in text) == (2, "", 1, True), out + text
    assert text.startswith("jaxhf"), text
    assert sorted(folder.iterdir()) == before


def test_options_that_change_something_are_taken(folder, command):
    """Shadows have a direction, whatever the shade; defaults are those of the functions."""
    for line in (
        "hillshade hills.npy -o a.png --variant multidirectional --azimuth 9 --shadows",
        "relief hills.npy -o a.png --no-shading --alpha",
        "relief hills.npy -o a.png --azimuth 0",
        "hillshade hills.npy -o b.npy",
    ):
        assert command(*line.split(), "--quiet")[0] == 0
    np.testing.assert_array_equal(np.load("b.npy"), jaxhf.hillshade(np.eye(4), 1.0))


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scene.toml").write_text(SCENE)
    (tmp_path / "case.toml").write_text(
        'scene = "scene.toml"\n[[pictures]]\nimage = "seen.png"\n[fit.prior]\nheights = "prior.npz"\n'
    )
    np.save("hills.npy", np.eye(4))
    for name in ("rock.png", "seen.png"):
        jaxhf.save_image(name, np.ones((4, 4)))
    (tmp_path / "prior.npz").write_bytes(b"heights")
    (tmp_path / "found_std.npz").write_bytes(b"deviations")
    return tmp_path


@pytest.mark.parametrize(
    ("line", "where"),
    [
        ("hillshade hills.npy -o ./hills.npy", ""),
        ("convert hills.npy linked.npy", ""),
        ("render scene.toml -o rock.png", ", which scene.toml names"),
        ("fit case.toml -o prior.npz", ", which case.toml names"),
        ("fit case.toml -o rock.png", ", which case.toml names"),
    ],
)
def test_an_input_is_never_replaced(folder, command, line, where):
    (folder / "linked.npy").symlink_to("hills.npy")
    before = {path: path.read_bytes() for path in folder.iterdir()}
    said = command(*line.split())
    output = line.split()[-1].removeprefix("./")
    assert said == (2, "", f"jaxhf: error: {output}: the output cannot replace an input of the same command{where}\n")
    assert {path: path.read_bytes() for path in folder.iterdir()} == before


def test_a_print_says_its_size(folder, command):
    pytest.importorskip("trimesh")
    np.save("hills.npy", np.arange(12, dtype=np.float32).reshape(3, 4))
    code, said, err = command("convert", "hills.npy", "a.stl", "--base", -1, "--longer-side", 150, "--z-scale", 2)
    assert (code, said.endswith("; in the file 150 x 100 x 1150 at most\n")) == (0, True), err


def test_nor_is_what_lies_beside_it(folder, command):
    """The .prj that goes with hills.asc, or the deviations of a fit; what is no input is replaced."""
    (folder / "hills.asc").write_text("ncols 2\nnrows 2\nxllcorner 0\nyllcorner 0\ncellsize 1\n1 2\n3 4\n")
    (folder / "hills.prj").write_text('LOCAL_CS["here"]')
    for line in ("hillshade hills.asc -o hills.png", "convert hills.asc hills.png"):
        where = "hills.prj: the output cannot replace an input of the same command, which hills.asc comes with"
        assert command(*line.split()) == (2, "", f"jaxhf: error: {where}\n")
    assert not (folder / "hills.png").exists()
    require_no_input(parser.parse(["view", "hills.asc", "-o", "hills.png"]))  # a picture has no .prj
    (folder / "hills.npy").write_text("old")
    assert command("convert", "hills.asc", "hills.npy")[0] == 0  # which writes no .prj
    np.testing.assert_array_equal(np.load("hills.npy"), [[3, 4], [1, 2]])
    assert (folder / "hills.prj").read_text() == 'LOCAL_CS["here"]'
    (folder / "case.toml").write_text((folder / "case.toml").read_text() + 'std = "found_std.npz"\n')
    code, _, text = command("fit", "case.toml", "-o", "found.npz")
    assert (code, "found_std.npz: the output cannot replace an input" in text) == (2, True)


def test_quiet_drops_reports_and_progress_but_no_error(folder, capsys, monkeypatch, command):
    assert command("slope", "hills.npy", "-o", "slope.npy", "--quiet") == (0, "", "")
    assert (folder / "slope.npy").exists()
    said = command("slope", "none.npy", "-o", "slope.npy", "--quiet")
    assert said == (2, "", "jaxhf: error: none.npy: there is no such file\n")
    with bar(total=3) as shown:  # into a pipe
        shown.update(2)
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    with quiet(True), bar(total=3) as shown:
        shown.update(2)
    with bar(total=3, delay=5.0) as shown:  # of work that is done at once
        shown.update(2)
    assert capsys.readouterr() == ("", "")
    with bar(total=3) as shown:
        shown.update(2)
    said_at_last = capsys.readouterr().err
    assert "/3" in said_at_last
    assert said_at_last.endswith("\r")  # wiped out


def test_a_bar_says_compiling_and_then_how_long(monkeypatch, capsys):
    """Of a picture that took 100 s to compile and 1 s for its first quarter, three seconds are left."""
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    now = [1000.0]
    monkeypatch.setattr("tqdm.std.time", lambda: now[0])
    monkeypatch.setattr("jaxhf.cli.progress.CompileTime", lambda: SimpleNamespace(seconds=100.0))
    with compiled_bar(unit=" pixels") as advance:
        assert capsys.readouterr().err.strip("\r \n") == "compiling"
        now[0] += 101
        advance(16, 64)
        first = capsys.readouterr().err
        now[0] += 1
        advance(32, 64)
        second = capsys.readouterr().err
    assert re.search(r"25%.*16/64 \[00:01<00:03, 16.00 pixels/s\]", first), first
    assert re.search(r"50%.*32/64 \[00:02<00:02, 16.00 pixels/s\]", second), second
    assert "compiling" not in first.split("\r")[-1]


def test_a_reader_that_has_enough_is_no_error(folder, monkeypatch):
    class Closed(io.StringIO):
        def flush(self):
            raise BrokenPipeError

    moved = []
    monkeypatch.setattr(entry.os, "dup2", lambda *files: moved.append(files))
    monkeypatch.setattr(sys, "stdout", Closed())
    assert main(["info", "hills.npy"]) == 141
    assert len(moved) == 1
