"""What all commands have in common: their help, words that are meant otherwise, what they replace, what they print when."""

import io
import re
import shlex
import sys

import numpy as np
import pytest

import jaxhf
from jaxhf.cli import main as entry, parser
from jaxhf.cli.main import main
from jaxhf.cli.progress import bar, compiled_bar, quiet

COMMANDS = [module.__name__.rsplit(".", 1)[1] for modules in parser.GROUPS.values() for module in modules]


def said(capsys, *arguments):
    """Exit code and what is printed; both outputs in one."""
    try:
        code = main(list(map(str, arguments)))
    except SystemExit as ended:
        code = ended.code
    out, err = capsys.readouterr()
    return code, out + err


def test_help_has_the_commands_in_groups(capsys):
    code, text = said(capsys, "--help")
    assert code == 0
    for title, modules in parser.GROUPS.items():
        listed = text.split(f"\n{title}:\n")[1].split("\n\n")[0]
        assert [line.split()[0] for line in listed.splitlines()] == [module.__name__.rsplit(".", 1)[1] for module in modules]


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_examples_that_it_takes(command, capsys):
    code, text = said(capsys, command, "--help")
    assert code == 0
    examples = [line.strip() for line in text.split("\nexamples:\n")[1].splitlines()]
    assert len(examples) >= 2
    for example in examples:
        program, *words = shlex.split(example)
        assert (program, words[0]) == ("jaxhf", command)
        parser.make_parser().parse_args(words)  # SystemExit where it is refused
    assert "--quiet" in text


@pytest.mark.parametrize(
    ("line", "answer"),
    [
        ("rendr scene.toml", "unknown command 'rendr'; did you mean 'render'?"),
        ("hill-shade a -o b", "unknown command 'hill-shade'; did you mean 'hillshade'?"),
        ("terrain.tif", "'terrain.tif' is no command; one stands before its files, as in 'jaxhf info terrain.tif'"),
        ("slope a.tif -o b.tif --percnt", "unknown option --percnt; did you mean --percent?"),
        ("render a.toml -o b.png --widht=5", "unknown option --widht; did you mean --width?"),
        ("render a.toml -o b.png --preset exact", r"unknown option --preset; jaxhf view has it \(see"),
        ("render a.toml -o b.png --xyz", r"unknown option --xyz \(see jaxhf render --help\)"),
        ("info a.tif b.tif", "unexpected argument 'b.tif'"),
        ("hillshade a.tif -o b.tif --variant igo", "--variant must be one of regular, combined, .*; it is 'igo'"),
        ("hillshade a.tif -o b.tif --azimuth north", "--azimuth must be a number, it is 'north'"),
        ("render a.toml -o b.png --samples 1.5", "--samples must be a whole number, it is '1.5'"),
    ],
)
def test_a_slip_gets_the_word_that_was_meant(capsys, line, answer):
    code, text = said(capsys, *line.split())
    assert (code, text.count("\n")) == (2, 1)
    assert re.search(answer, text), text


@pytest.mark.parametrize(
    ("line", "answer"),
    [
        ("render hills.npz -o a.png", "known: .pbrt, .toml; this is a terrain, for jaxhf view, hillshade, relief or convert\n"),
        ("hillshade scene.toml -o a.png", ".xyz; this is a scene, for jaxhf render\n"),
        ("render scene.toml -o a.tif", "known: .exr, .jpeg, .jpg, .npy, .pfm, .png\n"),  # and not the .pfm that is spelt alike
        ("render scene.toml -o a.pgn", "did you mean '.png'?\n"),
        ("fit case.toml -o a.png", "known: .npy, .npz, .tif, .tiff\n"),
        ("fit scene.toml -o a.npz", "scene.toml: a fit must have 'pictures', those that were measured; this is a scene, "
        "for `jaxhf render`\n"),
    ],
)  # fmt: skip
def test_an_ending_gets_what_fits_the_command(folder, capsys, line, answer):
    np.savez(folder / "hills.npz", heights=np.eye(4))
    code, text = said(capsys, *line.split())
    assert (code, text.count("\n"), text.endswith(answer)) == (2, 1, True), text


@pytest.mark.parametrize("line", ["info {}", "slope {} -o b.tif", "view {} -o b.png", "fit {} -o b.npz", "slope a.npy -o {}"])
def test_an_address_is_refused_as_it_was_written(capsys, line):
    code, text = said(capsys, *line.format("http://a/b.tif").split())
    assert (code, text.count("\n")) == (2, 1)
    assert text.startswith("jaxhf: error: http://a/b.tif: this is an address, files are neither read from the network nor")


SCENE = """samples = 1
[camera]
type = "perspective"
eye = [0, -3, 2]
target = [0, 0, 0]
[textures.rock]
image = 'rock.png'
[[objects]]
shape = "heightfield"
file = "hills.npy"
albedo = "rock"
"""


IGNORED = [
    ("relief hills.npy -o a.png --no-shading --shadows", "--shadows would change nothing: --no-shading leaves the light out"),
    ("relief hills.npy -o a.png --no-shading --azimuth 0", "--azimuth would change nothing: --no-shading"),
    ("relief hills.npy -o a.png --no-shading --algorithm horn", "--algorithm would change nothing: --no-shading"),
    ("relief hills.npy -o a.png --no-shading --z-factor 1", "--z-factor would change nothing: --no-shading"),
    ("relief hills.npy -o a.png --no-shading --dx 2", "--dx would change nothing: --no-shading"),
    ("relief hills.npy -o a.png --variant igor --altitude 9", "--altitude would change nothing: --variant igor has lights of"),
    ("hillshade hills.npy -o a.png --variant multidirectional --azimuth 9", "--azimuth would change nothing: --variant multi"),
    ("horizon hills.npy -o a.npy --azimuth 90 --azimuths 8", "--azimuths would change nothing: --azimuth asks for one"),
    ("view hills.npy -o a.webm --frames 3", "a.webm: cannot write a film with the ending '.webm'; known: .gif, .mp4"),
    ("view hills.npy -o a.png --frames 24", "--frames would change nothing: a.png is one picture, a film is .gif or .mp4"),
    (
        "view hills.npy -o a.gif --sun-from 90,9 --sun-to 99,9 --altitude 8",
        "--altitude would change nothing: the sun moves from",
    ),
    (
        "render scene.toml -o a.png --shading flat --normals six",
        "--normals would change nothing: --shading flat takes those of",
    ),
    ("convert hills.npy a.tif --base 0", "--base is for meshes (.glb, .obj, .ply), a.tif is none"),
    ("render scene.toml -o a.png --aovs depth", "--aovs are layers of an .exr, a.png is none"),
    ("tradeoff scene.toml --knobs max_depth", "tradeoff: knobs 'max_depth' changes nothing here: the scene has no mirror"),
]


@pytest.mark.parametrize(("line", "answer"), IGNORED)
def test_no_option_is_ignored(folder, capsys, line, answer):
    before = sorted(folder.iterdir())
    code, text = said(capsys, *line.split())
    assert (code, text.count("\n")) == (2, 1), text
    assert text.startswith(f"jaxhf: error: {answer}"), text
    assert sorted(folder.iterdir()) == before


def test_options_that_change_something_are_taken(folder, capsys):
    """Shadows have a direction, whatever the shade; defaults are those of the functions."""
    for line in (
        "hillshade hills.npy -o a.png --variant multidirectional --azimuth 9 --shadows",
        "relief hills.npy -o a.png --no-shading --alpha",
        "relief hills.npy -o a.png --azimuth 0",
        "hillshade hills.npy -o b.npy",
    ):
        assert said(capsys, *line.split(), "--quiet")[0] == 0
    np.testing.assert_array_equal(np.load("b.npy"), jaxhf.hillshade(np.eye(4), 1.0))


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setattr("jaxhf.cli.arguments.set_up_jax", lambda options: None)  # JAX is set up already
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scene.toml").write_text(SCENE)
    (tmp_path / "case.toml").write_text('scene = "scene.toml"\n[[pictures]]\nimage = "seen.png"\n[fit]\nprior = "prior.npz"\n')
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
def test_an_input_is_never_replaced(folder, capsys, line, where):
    (folder / "linked.npy").symlink_to("hills.npy")
    before = {path: path.read_bytes() for path in folder.iterdir()}
    code, text = said(capsys, *line.split())
    output = line.split()[-1].removeprefix("./")
    assert (code, text) == (2, f"jaxhf: error: {output}: the output cannot replace an input of the same command{where}\n")
    assert {path: path.read_bytes() for path in folder.iterdir()} == before


def test_nor_is_what_lies_beside_it(folder, capsys):
    """The .prj that goes with hills.asc; a map that writes none may stand there."""
    (folder / "hills.asc").write_text("ncols 2\nnrows 2\nxllcorner 0\nyllcorner 0\ncellsize 1\n1 2\n3 4\n")
    (folder / "hills.prj").write_text('LOCAL_CS["here"]')
    for line in ("hillshade hills.asc -o hills.png", "convert hills.asc hills.png"):
        where = "hills.prj: the output cannot replace an input of the same command, which hills.asc comes with"
        assert said(capsys, *line.split()) == (2, f"jaxhf: error: {where}\n")
    assert not (folder / "hills.png").exists()
    assert said(capsys, "convert", "hills.asc", "hills.npy")[0] == 0
    assert (folder / "hills.prj").read_text() == 'LOCAL_CS["here"]'


def test_the_deviations_of_a_fit_replace_no_input(folder, capsys):
    (folder / "case.toml").write_text((folder / "case.toml").read_text() + 'prior_std = "found_std.npz"\n')
    code, text = said(capsys, "fit", "case.toml", "-o", "found.npz")
    assert (code, "found_std.npz: the output cannot replace an input" in text) == (2, True)


def test_what_is_no_input_is_replaced(folder, capsys):
    (folder / "old.npy").write_text("old")
    assert said(capsys, "convert", "hills.npy", "old.npy")[0] == 0
    np.testing.assert_array_equal(np.load("old.npy"), np.eye(4))


def test_quiet_drops_reports_and_progress_but_no_error(folder, capsys, monkeypatch):
    assert said(capsys, "slope", "hills.npy", "-o", "slope.npy", "--quiet") == (0, "")
    assert (folder / "slope.npy").exists()
    code, text = said(capsys, "slope", "none.npy", "-o", "slope.npy", "--quiet")
    assert (code, text) == (2, "jaxhf: error: none.npy: there is no such file\n")
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    with quiet(True), bar(total=3) as shown:
        shown.update(2)
    assert capsys.readouterr() == ("", "")


def test_a_bar_says_compiling_and_then_how_long(monkeypatch, capsys):
    """Of a picture that took 100 s to compile and 1 s for its first quarter, three seconds are left."""
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    now = [1000.0]
    monkeypatch.setattr("tqdm.std.time", lambda: now[0])
    with compiled_bar(lambda: 100.0, unit=" pixels") as advance:
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
