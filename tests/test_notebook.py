"""The notebook runs from top to bottom, and is the same as its text."""

import re
from pathlib import Path
from typing import Any

import jupytext
import nbclient
import nbformat
import pytest

NOTEBOOK = Path(__file__).parents[1] / "notebooks" / "inverse_rendering.ipynb"


def cells(notebook: Any) -> list[tuple[str, str]]:
    return [(cell.cell_type, cell.source) for cell in notebook.cells]


def test_notebook_and_text_agree():
    """After a change of the text: `jupytext --update --to ipynb notebooks/inverse_rendering.py`, then run the notebook."""
    assert cells(nbformat.read(NOTEBOOK, 4)) == cells(jupytext.read(NOTEBOOK.with_suffix(".py")))
    assert NOTEBOOK.stat().st_size < 2**20


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # of Jupyter's own
def test_notebook_runs_from_top_to_bottom(monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(NOTEBOOK.parents[1]))
    notebook = nbformat.read(NOTEBOOK, 4)
    nbclient.NotebookClient(notebook, timeout=900, kernel_name="python3").execute(cwd=str(NOTEBOOK.parent))
    printed = "".join(output.get("text", "") for cell in notebook.cells for output in cell.get("outputs", []))
    before, during, after = (float(value) for value in re.findall(r"(?:before|during|after) ([\d.]+) m", printed))
    assert before > during > after
    assert after < before / 4
    errors = dict(re.findall(r"^(\w.*\w) +RMSE +([\d.]+) m", printed, re.MULTILINE))
    for other in ("no shadows", "shadows, still edges"):
        assert float(errors["shadows"]) < 1.02 * float(errors[other])
    assert 60 < float(re.findall(r"within 1 std: (\d+)%", printed)[0]) < 97
