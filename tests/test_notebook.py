"""The notebooks run from top to bottom, open with a picture, and are the same as their text."""

import os
import re
from pathlib import Path
from typing import Any

import jupytext
import nbclient
import nbformat
import pytest

NOTEBOOKS = Path(__file__).parents[1] / "notebooks"
NAMES = [path.stem for path in sorted(NOTEBOOKS.glob("*.ipynb"))]


def read(name: str) -> Any:
    return nbformat.read(NOTEBOOKS / f"{name}.ipynb", 4)


def printed(notebook: Any) -> str:
    return "".join(output.get("text", "") for cell in notebook.cells for output in cell.get("outputs", []))


def run(name: str, monkeypatch: pytest.MonkeyPatch) -> str:
    """What it prints when it is run anew."""
    monkeypatch.setenv("PYTHONPATH", str(NOTEBOOKS.parent), prepend=os.pathsep)
    notebook = read(name)
    nbclient.NotebookClient(notebook, timeout=900, kernel_name="python3").execute(cwd=str(NOTEBOOKS))
    return printed(notebook)


def gradients_hold(text: str) -> None:
    """With the boundary term the derivative agrees with differences, and finds mountain and sun; without it, neither."""
    cosines = re.findall(r"^(derivative of the shading|with the boundary term) +cosine (-?[\d.]+)", text, re.MULTILINE)
    assert len(cosines) == 4
    for name, cosine in cosines:
        assert float(cosine) > 0.95 if name.startswith("with") else float(cosine) < 0.5, (name, cosine)
    steps = re.findall(r"^(\w+) .*step 5: height +(-?[\d.]+), azimuth +(-?[\d.]+)", text, re.MULTILINE)
    found = {name: (float(height), float(azimuth)) for name, height, azimuth in steps}
    assert found["with"] == pytest.approx((0.5, 291), rel=2e-3)
    assert abs(found["derivative"][0] - 0.5) > 0.2


def recovery_holds(text: str) -> None:
    """The fit is much nearer than the map, each step of the way, and its deviations hold the truth."""
    ((before, after),) = re.findall(r"error of the heights: ([\d.]+) m before, ([\d.]+) m after", text)
    before, after = float(before), float(after)
    during = float(re.findall(r"after 2 steps: ([\d.]+) m", text)[0])
    assert before > during > after
    assert after < before / 4
    ((off, std),) = re.findall(r"mean of the heights: (-?[\d.]+) m off, ± ([\d.]+) m", text)
    assert abs(float(off)) < 3 * float(std)
    assert 60 < float(re.findall(r"within 1 std: (\d+)%", text)[0]) < 97


def walking_holds(text: str) -> None:
    """By the scan robots go farther than blind ones with the best of clearances, do not stumble, and do not tip over."""
    rows = re.findall(r"^(by the scan|blind) .*: ([\d.]+) m, stumbles +([\d.]+)%, (\d+) of 16 stand$", text, re.MULTILINE)
    scan, blind = ([tuple(map(float, row)) for kind, *row in rows if kind == name] for name in ("by the scan", "blind"))
    assert len(scan) == len(blind) == 4
    assert min(distance for distance, _, _ in scan) > 1.2 * max(distance for distance, _, _ in blind)
    assert max(stumbles for _, stumbles, _ in scan) < 1 < blind[0][1] / 5
    assert min(stand for *_, stand in scan) >= 15 > min(stand for *_, stand in blind)


HOLDS = {"gradients": gradients_hold, "inverse_rendering": recovery_holds, "walking": walking_holds}


@pytest.mark.parametrize("name", NAMES)
def test_notebook_is_kept_as_it_was_run(name):
    """After a change of the text: `jupytext --update --to ipynb notebooks/NAME.py`, then run the notebook."""
    notebook = read(name)
    text = jupytext.read(NOTEBOOKS / f"{name}.py")
    assert [(cell.cell_type, cell.source) for cell in notebook.cells] == [(cell.cell_type, cell.source) for cell in text.cells]
    assert (NOTEBOOKS / f"{name}.ipynb").stat().st_size < 400_000
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in code] == list(range(1, len(code) + 1))
    assert any("image/png" in output.get("data", {}) for output in code[0].outputs)
    HOLDS[name](printed(notebook))


@pytest.mark.slow  # each about a minute on two idle cores
@pytest.mark.filterwarnings("ignore")  # of Jupyter's own
@pytest.mark.parametrize("name", NAMES)
def test_notebook_runs_from_top_to_bottom(name, monkeypatch):
    if name == "walking":
        pytest.importorskip("mujoco.mjx", reason="MJX, in which the robot walks, is not installed: pip install mujoco-mjx")
    HOLDS[name](run(name, monkeypatch))
