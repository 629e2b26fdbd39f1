"""Compiled programs are kept between runs: where, how many, and how a run ends that finds them damaged."""

import os
import subprocess
import sys
from argparse import Namespace
from pathlib import Path

import numpy as np
import pytest

from jaxhf.cli import limits

SCENE = Path(__file__).parents[2] / "scenes" / "debug4x4.toml"


def own(folder):
    """An environment in which programs are kept in this folder, not where this run of the tests keeps its own."""
    return {**{name: value for name, value in os.environ.items() if not name.startswith("JAX_")}, "JAXHF_CACHE": str(folder)}


def test_a_second_run_does_not_trace(tmp_path):
    """The same picture from programs that were found without JAX's cache, which needs the trace."""
    options = ["--width", "16", "--samples", "1", "--shading", "flat", "--traversal", "dda", "--no-shadows"]
    pictures, kept = [], set()
    for name in ("first.npy", "second.npy"):
        command = [sys.executable, "-m", "jaxhf", "render", SCENE, "-o", tmp_path / name, *options]
        run = subprocess.run(command, capture_output=True, text=True, timeout=120, env=own(tmp_path / "kept"))
        assert (run.returncode, run.stderr) == (0, "")
        assert ", 1 x cpu, " in run.stdout  # for so small a picture, wherever there are more
        pictures.append(np.load(tmp_path / name))
        paths = list((tmp_path / "kept").glob("jaxhf-*/*"))
        kept = {path.name.split("-")[0] for path in paths}
        assert {"jaxhf.rendering.picture.trace_picture", "jaxhf.rendering.render._made_world"} <= kept
        for path in paths:
            if path.name.startswith("jit_"):
                path.unlink()
    assert not {"jit_trace_picture", "jit__made_world"} & kept
    np.testing.assert_array_equal(*pictures)


@pytest.mark.deep
def test_a_view_of_another_terrain_compiles_nothing(tmp_path):
    """Of another size and other cells, round which mountains hide the sky."""
    kept = []
    for k, shape in enumerate([(70, 90), (110, 80)]):
        heights = np.random.default_rng(k).random(shape).cumsum(0)
        np.savez(tmp_path / f"{k}.npz", heights=heights.astype(np.float32), dx=1.5 + k, dy=1.5 + k)
        command = [sys.executable, "-m", "jaxhf", "view", f"{k}.npz", "-o", f"{k}.npy", "--size", "300x260"]
        run = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=240, env=own(tmp_path / "kept"))
        assert run.returncode == 0, run.stderr
        kept.append({path.name for path in (tmp_path / "kept").glob("jaxhf-*/*") if not path.name.endswith("-atime")})
    assert any(name.startswith("jaxhf.rendering.render._made_world") for name in kept[0])
    assert kept[1] == kept[0]


PROGRAM = """
import warnings
import jax
from jaxhf.cli.cache import keep_programs
events = []
warnings.showwarning = lambda message, *_, **__: print("warning:", message)
keep_programs(True)
jax.monitoring.register_event_listener(lambda event, **_: events.append(event))
def one(x):
    return 2 * x
def two(x):
    return 3 * x
print(jax.jit(one)(1.0), jax.jit(two)(1.0), events.count("/jax/compilation_cache/cache_hits"))
"""


@pytest.mark.deep
def test_damaged_programs_are_compiled_again(tmp_path):
    """By JAX, which only warns, each time anew."""

    def run():
        said = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, timeout=60, env=own(tmp_path))
        assert said.returncode == 0, said.stderr
        *warned, result = said.stdout.splitlines()
        assert all("damaged programs are compiled again" in line for line in warned)
        return len(warned), result

    assert run() == (0, "2.0 3.0 0")
    assert run() == (0, "2.0 3.0 2")
    one, two = tmp_path.glob("jaxhf-*/jit_one-*-cache"), tmp_path.glob("jaxhf-*/jit_two-*-cache")
    for path, damage in ((next(one), lambda stored: stored[:300]), (next(two), lambda stored: stored[:-9] + bytes(9))):
        path.write_bytes(damage(path.read_bytes()))
    assert run() == (1, "2.0 3.0 0")
    assert run() == (0, "2.0 3.0 2")


@pytest.fixture
def configured(monkeypatch, tmp_path):
    """JAX's configuration as the command line would leave it; this run's own stays as it is."""
    values = {}
    monkeypatch.setattr("jax.config.update", values.__setitem__)
    monkeypatch.setattr("jaxhf.xla.folder.keep_in", lambda folder: values.update(kept=folder))
    monkeypatch.setattr("warnings.showwarning", print)
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR", raising=False)
    monkeypatch.setenv("JAXHF_CACHE", str(tmp_path / "kept"))

    def set_up(wanted=True, precision="float32"):
        values.clear()
        limits.set_up_jax(Namespace(devices=1, precision=precision, cache=wanted))
        assert values["jax_enable_x64"] == (precision == "float64")
        return values

    return set_up


def test_who_says_where_programs_are_kept(configured, monkeypatch, tmp_path):
    values = configured()
    folder = values["kept"]
    assert (folder.parent, values["jax_compilation_cache_dir"]) == (tmp_path / "kept", str(folder))
    assert folder.is_dir()
    values = configured(wanted=False, precision="float64")
    assert (values["jax_enable_compilation_cache"], "kept" in values) == (False, False)
    for off in ("off", "", "0"):
        monkeypatch.setenv("JAXHF_CACHE", off)
        values = configured()
        assert (values["kept"], "jax_compilation_cache_dir" in values) == (None, False)
    monkeypatch.setenv("JAXHF_CACHE", str(tmp_path / "not"))
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(tmp_path / "jax"))
    assert not {"kept", "jax_compilation_cache_dir"} & configured().keys()
    assert not (tmp_path / "not").exists()


def test_where_nothing_can_be_kept_there_is_one_warning(configured, monkeypatch, tmp_path):
    (tmp_path / "file").touch()
    monkeypatch.setenv("JAXHF_CACHE", str(tmp_path / "file"))
    with pytest.warns(UserWarning, match="compiled programs are not kept") as said:
        assert configured()["kept"] is None
    assert len(said) == 1
    monkeypatch.delenv("JAXHF_CACHE")
    monkeypatch.setattr("os.path.expanduser", lambda path: path)  # as it does for a user who is not known
    with pytest.warns(UserWarning, match="compiled programs are not kept: Could not determine home"):
        assert configured()["kept"] is None
