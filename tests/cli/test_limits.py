"""What does not fit on the machine is refused in one line, before anything is traced."""

from pathlib import Path

import numpy as np
import pytest

import jaxhf
from jaxhf.cli import limits
from jaxhf.cli.main import main
from jaxhf.core.errors import UserError

SCENE = str(Path(__file__).parents[2] / "scenes" / "debug4x4.toml")  # 320 x 240, 4 samples


@pytest.fixture
def refused(monkeypatch, capsys, tmp_path):
    """The one line of a command that is refused."""
    monkeypatch.setattr("jaxhf.cli.limits.set_up_jax", lambda options: limits.require_devices(options.devices))
    monkeypatch.setattr("jaxhf.cli.commands.render.render", lambda *_, **__: pytest.fail("began to render"))

    def run(*arguments):
        assert main([*arguments, "-o", str(tmp_path / "out.npy")]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        return line.removeprefix("jaxhf: error: ")

    return run


def test_devices_that_cannot_pay(refused, monkeypatch):
    monkeypatch.setattr(limits, "usable_cores", lambda: 24)
    monkeypatch.setattr(limits, "default_devices", lambda: 16)
    for command, count in (("render", "0"), ("render", "1000"), ("tradeoff", "1000")):
        wanted = f"--devices must be a whole number from 1 to 24, it is {count}; 16 are best here"
        assert refused(command, SCENE, "--devices", count) == wanted


def test_a_picture_that_does_not_fit(refused, monkeypatch):
    """What may fit is tried: 14 bytes a pixel."""
    monkeypatch.setattr(limits, "available_bytes", lambda: 4e9)
    line = refused("render", SCENE, "--width", "20000", "--devices", "1")
    assert line.startswith("20000 x 15000 pixels of 16 heights take more than 4.2 GB of memory on 1 device, 4 GB are free")
    monkeypatch.setattr(limits, "available_bytes", lambda: 13.5 * 320 * 240)
    assert "pixels of 16 heights" in refused("render", SCENE, "--devices", "1")
    monkeypatch.setattr(limits, "available_bytes", lambda: 14.5 * 320 * 240)
    with pytest.raises(pytest.fail.Exception, match="began to render"):
        refused("render", SCENE, "--devices", "1")


def test_a_terrain_counts_on_each_device(refused, monkeypatch):
    field = jaxhf.Heightfield(np.zeros((100, 100), np.float32))
    camera = jaxhf.Perspective.look_at((0, 0, 1), (0.5, 0.5, 0), width=10, height=10)
    scene = jaxhf.Scene([jaxhf.Object(field)], camera, [])
    monkeypatch.setattr(limits, "available_bytes", lambda: 5e5)
    limits.require_memory(scene, 1)
    with pytest.raises(UserError, match=r"take more than 0\.000901 GB of memory on 2 devices, 0\.0005 GB are free"):
        limits.require_memory(scene, 2)


def test_a_map_that_does_not_fit(refused, monkeypatch, tmp_path):
    monkeypatch.setattr(limits, "available_bytes", lambda: 8e5)
    jaxhf.save_heights(tmp_path / "in.npz", jaxhf.Terrain(np.zeros((100, 150), np.float32)))
    words = "viewshed", str(tmp_path / "in.npz"), "--observer", "3", "3", "--dx", "1", "--dy", "1"
    said = "viewshed: 15000 heights take more than 0.00135 GB of memory, 0.0008 GB are free; --bbox takes a part"
    assert refused(*words) == said
    assert "take more than 0.0027 GB" in refused(*words, "--precision", "float64")
    day = "--begin", "2026-06-21", "--end", "2026-06-22", "--latitude", "46", "--longitude", "8"
    one, all_in_one = ("--azimuth", "90"), ("--azimuths", "10")
    cases = ("skyview", (), 60), ("horizon", one, 55), ("horizon", all_in_one, 135), ("insolation", day, 95)
    for command, more, size in cases:
        words = command, str(tmp_path / "in.npz"), "-o", str(tmp_path / "out.npy"), "--dx", "1", "--dy", "1", *more
        assert refused(*words).startswith(f"{command}: 15000 heights take more than {size * 15e-6:.3g} GB")
