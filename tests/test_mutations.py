"""Each part of the derivative has a test that fails without it.

A copy of the package loses one part, and the named test is run there in a process of its own. It has to be a test of the
default run.
"""

import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).parents[1]


class Mutation(NamedTuple):
    """In `module` the text `old`, which is there once, becomes `new`; then `test` must fail."""

    module: str
    old: str
    new: str
    test: str


MUTATIONS = {
    "camera silhouettes": Mutation(
        "_lottery.py",
        "flags = silhouettes(grid, Viewpoint(*camera.viewpoint()))",
        "flags = silhouettes(grid, Viewpoint(*camera.viewpoint())) & False",
        "test_edges.py::test_crest_alone_moves_with_heights",
    ),
    "terminators": Mutation(
        "_lottery.py",
        "flags = flags | silhouettes(grid, light)",
        "pass",
        "test_edges.py::test_terminator_moves_with_the_camera",
    ),
    "cast shadows": Mutation(
        "_lottery.py",
        "for light in (None, *casting):",
        "for light in (None,):",
        "test_edges.py::test_cast_shadow_alone_moves[heights]",
    ),
    "borders": Mutation(
        "_silhouette.py",
        "lambda a, b: a != b",
        "lambda a, b: (a != b) & (a != 0) & (b != 0)",
        "test_edges.py::test_silhouette_alone_moves_with_heights",
    ),
    "edges under flat shading": Mutation(
        "_lottery.py",
        "return all_edges(grid)",
        "pass",
        "test_edges.py::test_edges_of_facets_move",
    ),
    "silhouette correction of the shading normal": Mutation(
        "_shade.py",
        "cosine = rounded_abs(dot(wi, hit.ns))",
        "cosine = jnp.maximum(dot(wi, hit.ns), 0)",
        "test_shade.py::test_no_black_holes",
    ),
    "derivative of the shading normal": Mutation(
        "_grid.py",
        "vertex_normals(heights,",
        "vertex_normals(lax.stop_gradient(heights),",
        "test_gradient.py::test_every_leaf_pixel_by_pixel[parallel]",
    ),
    "derivative of the hit": Mutation(
        "_hit.py",
        "t = distance(plane, ray, found)",
        "t = lax.stop_gradient(distance(plane, ray, found))",
        "test_gradient.py::test_every_leaf_pixel_by_pixel[parallel]",
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", MUTATIONS)
def test_a_test_fails_without(name, tmp_path):
    module, old, new, test = MUTATIONS[name]
    for part in ("jaxhf", "tests"):
        shutil.copytree(ROOT / part, tmp_path / part, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    path = tmp_path / "jaxhf" / module
    text = path.read_text()
    assert text.count(old) == 1, f"{module} no longer has this text once: {old}"
    path.write_text(text.replace(old, new))
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", f"tests/{test}"]
    environment = {**os.environ, "PYTHONPATH": str(tmp_path)}  # before an installed jaxhf
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    # 1: some tests failed; other numbers stand for none found, errors of collection and the like.
    assert done.returncode == 1, done.stdout[-2000:] + done.stderr[-2000:]
    assert "AssertionError" in done.stdout, done.stdout[-2000:]
