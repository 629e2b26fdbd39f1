"""What the documents say is so: each page's blocks run, in the reader's own configuration, and the site builds strictly."""

import ast
import inspect
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from unittest import SkipTest

import jax
import numpy as np
import pytest
from sybil import Document, Example, Region, Sybil
from sybil.evaluators.python import PythonEvaluator
from sybil.parsers.markdown import SkipParser
from sybil.parsers.markdown.lexers import RawFencedCodeBlockLexer

import jaxhf
from jaxhf.cli.catalogue import COMMANDS
from jaxhf.cli.main import main
from jaxhf.io.scenes.toml import fit
from jaxhf.io.scenes.toml.fit import load_case
from jaxhf.scene.procedural import fractal
from jaxhf.xla.machine import available_bytes

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", *sorted(DOCS.rglob("*.md"))]
NAMES = [str(page.relative_to(ROOT)) for page in PAGES]
SLOW = {"docs/gallery.md", "docs/tutorials/photographs.md"}  # minutes; what the latter finds has a test of its own
DEEP = {  # over four seconds of a processor
    "README.md",
    *(f"docs/api/{name}.md" for name in ("fit", "maps", "mujoco", "render")),
    "docs/coming-from/asp.md",
    "docs/coming-from/blender.md",
    "docs/coming-from/gdal.md",
    "docs/coming-from/mitsuba.md",
    "docs/coming-from/rayshader.md",
    "docs/index.md",
    *(f"docs/{name}.md" for name in ("concepts/shading", "guides/fitting", "guides/maps", "guides/sun-and-sky", "guides/view")),
    *(f"docs/reference/{name}.md" for name in ("faq", "limits")),
    *(f"docs/tutorials/{name}.md" for name in ("exactness", "gradient", "picture", "robots")),
}
MUJOCO = [name for name in vars(jaxhf.mujoco) if not name.startswith("_") and not inspect.ismodule(vars(jaxhf.mujoco)[name])]
PUBLIC = {f"jaxhf.{name}": getattr(jaxhf, name) for name in dir(jaxhf) if name not in ("mujoco", "__version__")} | {
    f"jaxhf.mujoco.{name}": getattr(jaxhf.mujoco, name) for name in MUJOCO
}
FOREIGN = {"gdaldem", "gdalinfo", "gdal_translate", "gdal_viewshed"}  # programs that may not be here
EXTRAS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]


def blocks(language: str, evaluate: Callable[[Example], None]) -> Callable[[Document], Iterator[Region]]:
    """A parser of fenced blocks in one language, which may have a title: the name of a file."""
    lexer = RawFencedCodeBlockLexer(re.compile(rf'{language}(?: title="(?P<title>[^"\n]+)")?$\n', re.MULTILINE))

    def parse(document: Document) -> Iterator[Region]:
        for region in lexer(document):
            yield Region(region.start, region.end, (region.lexemes or {})["source"], evaluate, region.lexemes)

    return parse


def shell(example: Example) -> None:
    """Runs the lines of a block one by one: jaxhf's and Python's in this process, what installs only as far as its names."""
    for line in re.split(r"\n|&&", example.parsed.replace("\\\n", " ")):
        program, *arguments = shlex.split(line, comments=True) or [""]
        program = program.removeprefix(".venv/bin/")
        if program == "jaxhf":
            assert main(arguments) == 0, line
        elif (program, arguments[:1]) == ("python", ["-c"]):
            exec(arguments[1], {})
        elif program == "pytest":
            assert arguments == ["-n", "2"]
        elif (program, arguments[:2]) == ("python3", ["-m", "venv"]):
            pass  # as below: tests/test_release.py installs
        elif program == "pip":
            assert set(re.findall(r"\w+", "".join(re.findall(r"\[(.*?)\]", line)))) <= EXTRAS.keys(), line
        elif program in FOREIGN:
            if shutil.which(program):
                subprocess.run([program, *arguments], check=True, capture_output=True)
        else:
            assert program in ("", "source"), f"{example.path}:{example.line}: {line}"


# What a block may leave out of a scene that is read whole, so that its own keys meet the reader of scenes.
LACKING = {
    "camera": '[camera]\ntype = "perspective"\neye = [0, 0, 9]\ntarget = [0, 1, 0]\n',
    "objects": '[[objects]]\nshape = "heightfield"\nheights = [[0, 0], [0, 0]]\n',
}
PICTURE = '[[pictures]]\nimage = "noon.png"\n'
TITLE = "scenes/recover/untitled.toml"


def read_toml(text: str, path: str = TITLE) -> None:
    """Reads a scene or what to fit; without a title of its own it may be a part of one, or of an object."""
    tables = tomllib.loads(text)
    if "transform" in tables:
        text = LACKING["objects"] + text
        tables = tomllib.loads(text)
    fits = not tables.keys().isdisjoint(("pictures", "fit"))
    if path == TITLE:
        lacking = LACKING | ({"pictures": PICTURE} if fits else {})
        text += "\n" + "".join(more for name, more in lacking.items() if name not in tables)
    Path(path).write_text(text)
    (load_case if fits else jaxhf.load_scene)(path)


def toml(example: Example) -> None:
    read_toml(example.parsed, (example.region.lexemes or {})["title"] or TITLE)


SYBIL = Sybil([blocks("python", PythonEvaluator()), blocks("sh", shell), blocks("toml", toml), SkipParser()])


@pytest.fixture
def reader(tmp_path, monkeypatch) -> Iterator[None]:
    """A folder that holds nothing but `scenes`, and JAX as it begins."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "agg")
    monkeypatch.setattr("jaxhf.cli.limits.set_up_jax", lambda options: None)  # this process is set up
    shutil.copytree(ROOT / "scenes", "scenes")
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        yield


def page(name: str) -> Any:
    """README's blocks as users run them; the others compile sooner, to slower programs."""
    tier = [pytest.mark.slow] if name in SLOW else [pytest.mark.deep] if name in DEEP else []
    how = [pytest.mark.optimised] if name == "README.md" else []
    return pytest.param(name, marks=[*tier, *how])


@pytest.mark.parametrize("name", [page(name) for name in NAMES])
def test_blocks_run(name, reader):
    """One after the other, in one namespace. `<!-- skip: next if(...) -->` leaves out what needs another renderer."""
    document = SYBIL.parse(ROOT / name)
    document.namespace |= {"installed": lambda module: find_spec(module) is not None, "available_bytes": available_bytes}
    for example in document.examples():
        try:
            example.evaluate()
        except SkipTest as reason:
            print(f"{name}:{example.line}: skipped, {reason}")


def test_a_misspelt_key_is_refused_in_every_part_of_a_scene(reader):
    refused = 0
    for example in (example for name in NAMES for example in SYBIL.parse(ROOT / name).examples()):
        if example.region.evaluator is toml and not (example.region.lexemes or {})["title"]:
            for key in re.finditer(r"^\w+(?= = )", example.parsed, re.MULTILINE):
                with pytest.raises(jaxhf.SceneError, match=f"unknown key '{key[0]}x'"):
                    read_toml(f"{example.parsed[: key.end()]}x{example.parsed[key.end() :]}")
                refused += 1
    assert refused > 40


@pytest.mark.deep  # test_fit_truth.py has a fit of another's pictures
def test_the_photographs_show_what_is_found_in_them(reader):
    """The page's own command, and its parts of the case; scenes/recover/case.toml says of which hills the pictures are.

    Heights are 0.00018 off, root mean square. Hills that are mirrored would be 0.07 off, by a cell to the side 0.008.
    """
    examples = list(SYBIL.parse(ROOT / "docs" / "tutorials" / "photographs.md").examples())
    parts = "".join(example.parsed for example in examples if example.region.evaluator is toml)
    case = tomllib.loads(Path("scenes/recover/case.toml").read_text())
    pictures = case.pop("pictures")
    assert tomllib.loads(parts) == {**case, "lights": pictures[0]["lights"]}
    next(example for example in examples if example.region.evaluator is shell).evaluate()
    off = jaxhf.load_heights("heights.npz").heights - fractal([41, 41], seed=7, exponent=2.2, range=(0.0, 0.22))
    assert np.sqrt(np.mean(off**2)) < 3e-4
    assert 0.55 < np.mean(np.abs(off) < jaxhf.load_heights("heights_std.npz").heights) < 0.85  # of normal ones 0.68


def test_each_public_name_has_an_example():
    """Below it on its page of the API, before the next name."""
    lacking = dict(PUBLIC)
    for path in (DOCS / "api").glob("*.md"):
        for part in re.split("^::: ", path.read_text(), flags=re.MULTILINE)[1:]:
            name = part.split("\n")[0]
            examples = re.findall("^```python\n(.*?)^```$", part, re.MULTILINE | re.DOTALL)
            assert any(re.search(rf"\b{re.escape(name)}\b", example) for example in examples), f"{path.name}: {name}"
            del lacking[name]
    assert not lacking


def test_public_docstrings_name_nothing_private():
    """In backquotes stand public names, their attributes and parameters, and others' names, but nothing else of jaxhf's."""
    things = list(PUBLIC.values())
    for thing in PUBLIC.values():
        if inspect.isclass(thing):
            members = {name: vars(thing)[name] for name in vars(thing) if not name.startswith("_")}
            things += [getattr(member, "__func__", getattr(member, "fget", member)) for member in members.values()]
    known = {name.split(".")[-1] for name in PUBLIC}
    known |= {name for thing in things for name in getattr(thing, "__annotations__", ())}
    known |= {name for thing in PUBLIC.values() for name in dir(thing) if not name.startswith("_")}
    inside = {path.stem for path in (ROOT / "jaxhf").rglob("*.py")}
    for path in (ROOT / "jaxhf").rglob("*.py"):
        inside |= {node.name for node in ast.parse(path.read_text()).body if isinstance(node, ast.FunctionDef | ast.ClassDef)}
    texts = [inspect.getdoc(thing) or "" for thing in things if not isinstance(thing, int | str | tuple)]
    texts += [path.read_text() for path in (DOCS / "api").glob("*.md")]
    words = {word for text in texts for word in re.findall(r"`([A-Za-z_][\w.]*)`", text)}
    assert len(words) > 100  # or nothing was found
    words -= {"_FillValue", "values"}  # of xarray's arrays
    assert not {word for word in words if re.search(r"(^|\.)_(?!_)", word) or word.split(".")[0] in inside - known}


def test_docstrings_leave_examples_to_the_pages():
    """Where they run."""
    for path in (ROOT / "jaxhf").rglob("*.py"):
        assert not re.search("```|>>>", path.read_text()), path


def test_pages_are_easy_to_read():
    """A sentence first, that says what the page is for; lines that fit, blocks in languages that are run, short tables outside
    of the measurements; README on two screens."""
    for name in NAMES:
        text = (ROOT / name).read_text()
        made = name.startswith(("docs/api/", "docs/notebooks/"))  # of docstrings, of notebooks
        assert made or re.match(r"# .+\n\n(!\[.*\n\n)?(?:\w|\*\*|`)[^|]", text), f"{name}: what has a reader after this page?"
        assert not [line for line in text.splitlines() if len(line) > 120], name
        assert not re.search(r"^[^\s|#*>-](?!\. ).*\n- ", text, re.MULTILINE), f"{name}: a list needs an empty line before it"
        assert not re.search(r"^ *\d{4}\. ", text, re.MULTILINE), f"{name}: a year there begins a list"
        fences = re.findall(r"^```(.*)\n(?:.*\n)*?```$", text, re.MULTILINE)
        assert {fence.split(" ")[0] for fence in fences} <= {"python", "sh", "toml", "text"}, name
        if "/measurements/" not in name:
            assert "measured(" not in text, name
            assert all(table.count("\n") <= 14 for table in re.findall(r"(?:^\|.*\n)+", text, re.MULTILINE)), name
    assert len((ROOT / "README.md").read_text().splitlines()) <= 100


def test_fit_files_have_their_keys_and_defaults():
    """Those that the reader knows and no others; where one has a default in Python, the same."""
    text = (DOCS / "guides" / "fit-files.md").read_text()
    tables = [
        re.findall(r"^\| `.*", part.split("\n\n")[0], re.MULTILINE) for part in text.split("| key | type | default |")[1:]
    ]
    tables = [{row[0].strip("` "): row[2].strip() for row in (line.split("|")[1:] for line in table)} for table in tables]
    arguments = fit._FIT.keys() - {"prior", "unknown"}  # tables of their own
    expected = [fit._PICTURE.keys(), arguments, fit._NOISE.keys(), fit._PRIOR.keys(), fit._UNKNOWN.keys()]
    assert [table.keys() for table in tables] == expected
    assert [name for name, default in tables[0].items() if not default] == ["image"]
    for table, record in zip(tables[1:], (jaxhf.fit, jaxhf.Noise, jaxhf.Prior, jaxhf.Unknown), strict=True):
        for name, said in table.items():
            match inspect.signature(record).parameters[name].default:
                case inspect.Parameter.empty:
                    assert not said, name
                case None:  # said in words
                    assert said, name
                case bool(default):
                    assert said == str(default).lower(), name
                case default:
                    assert float(said) == default, name


def test_pictures_are_small():
    sizes = {path: path.stat().st_size for path in DOCS.rglob("*") if path.suffix in (".png", ".jpg", ".gif", ".webp", ".svg")}
    assert not {path: size for path, size in sizes.items() if size > 250_000}
    assert sum(sizes.values()) < 3_500_000


def test_tables_have_their_rows():
    """Each CSV file of measurements says by what command it was made, is as wide as its head, and stands on a page."""
    pages = "".join(path.read_text() for path in (DOCS / "measurements").glob("*.md"))
    for path in (DOCS / "measurements").glob("*.csv"):
        assert path.read_text().startswith("# "), path
        assert f'measured("{path.stem}")' in pages, path


@pytest.mark.deep
@pytest.mark.skipif(find_spec("zensical") is None, reason="the site's builder, the extra docs, is not installed")
def test_site_builds_strictly_and_needs_no_other(tmp_path):
    shutil.copytree(DOCS, tmp_path / "docs")
    shutil.copytree(ROOT / "notebooks", tmp_path / "notebooks")
    shutil.copy(ROOT / "zensical.toml", tmp_path)
    (tmp_path / "jaxhf").symlink_to(ROOT / "jaxhf")
    build = [sys.executable, "-m", "zensical", "build", "--strict"]
    done = subprocess.run(build, cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stdout + done.stderr
    pages = list((tmp_path / "site").rglob("*.html"))
    assert len(pages) > 30
    for page in pages:
        text = page.read_text()
        assert not re.search(r'(?:src="|<link[^>]+href="|@import )(?:https?:)?//', text), page
        assert not re.search("&(reg|copy|trade);|[©®™]", text), f"{page}: (c), (r) and (tm) stand between backquotes"
        prose = re.sub(r"<(code|pre).*?</\1>", "", text, flags=re.DOTALL)
        assert "{{" not in prose, page
        links = {link.split("#")[0] for link in re.findall(r'(?:href|src)="(?!https?:|data:|mailto:|#)([^"]+)"', prose)}
        if page.name != "404.html":  # which a server shows in any folder; the others open from the disk
            assert not [link for link in links if not (page.parent / link).is_file()], page
    entry = r'<a href="[^"#]+" class="md-nav__link.*?>\s*<span class="md-ellipsis">\s*(.*?)\s*<'
    titles = re.findall(entry, (tmp_path / "site" / "index.html").read_text())
    assert len(titles) > 30
    assert not [title for title in titles if titles.count(title) > 1]
    text = "".join(path.read_text() for path in (tmp_path / "site" / "api").glob("*.html"))
    assert {name for name in PUBLIC if f'id="{name}"' not in text} == set()
    assert not re.search(r"\]\[jaxhf|_setting|docs/\w+/", text), "what docs/docstrings.py leaves"
    assert len(re.findall(r'class="autorefs[^>]*#jaxhf\.', text)) > 200, "links of types and docstrings"
    text = (tmp_path / "site" / "guides" / "commands.html").read_text()
    assert {name for name in COMMANDS if f"usage: jaxhf {name}" not in text} == set()
