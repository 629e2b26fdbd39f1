"""benchmarks/trades.py puts walks and triangles in the place of the package's: they are really there, and change no picture."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

BENCHMARK = Path(__file__).parents[2] / "benchmarks" / "trades.py"
SIDE = 33
SCENE = """
Film "image" "integer xresolution" [40] "integer yresolution" [30]
LookAt .5 -.8 .9  .5 .5 0  0 0 1
Camera "perspective" "float fov" [50]
WorldBegin
LightSource "point" "point from" [1 -1 1] "color I" [2 2 2]
Shape "heightfield" "integer nu" [{side}] "integer nv" [{side}] "float Pz" [{heights}]
WorldEnd
"""


@pytest.mark.slow
def test_variants_give_the_same_picture_from_other_arrays(tmp_path):
    heights = np.random.default_rng(0).uniform(0, 0.3, SIDE * SIDE).astype(np.float32)
    (tmp_path / "small.pbrt").write_text(SCENE.format(side=SIDE, heights=" ".join(map(str, heights))))
    base, stored = "pyramid, triangles on demand, normals of six, smooth", "dda without bounds, triangles stored"
    options = ["--scenes", "small", "--variants", base, stored, "--repeats", "1", "-o", str(tmp_path / "out.json")]
    subprocess.run([sys.executable, str(BENCHMARK), str(tmp_path), *options], check=True, capture_output=True)
    rows = {row["variant"]: row for row in json.loads((tmp_path / "out.json").read_text())}
    assert [row["difference"] for row in rows.values()] == [0, 0]
    # Six numbers a cell in place of one a height; and one number in place of bounds, which a pyramid has on both sides, in rows
    # as long as a side.
    cells = SIDE - 1
    pyramid = 2 * cells * (cells + cells - 1)
    more = 6 * cells**2 - SIDE**2 + 1 - pyramid
    assert rows[stored]["held_mb"] - rows[base]["held_mb"] == 4 * more / 2**20
