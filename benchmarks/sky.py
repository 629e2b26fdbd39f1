"""Horizon angles and sky-view factors: errors against closed forms, and times beside rvt-py's function of the same name.

Terrain is the Jacksboro valley, resampled to n x n heights over the same ground by cubic splines, in single precision, with 32
directions. rvt-py (Relief Visualization Toolbox, by the authors of the sky-view factor of 2011) looks no further than a radius
of 10 pixels unless told otherwise; jaxhf has none. It runs in the Python that --peer names, where it is installed:
`pip install --no-deps rvt-py` with numpy and scipy. xarray-spatial 0.5.3 has no such function; richdem 0.3.4 does not compile
for Python 3.11.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import jax
import numpy as np
from scipy.ndimage import zoom

import jaxhf
from jaxhf.xla.machine import default_devices

AZIMUTHS = 32
PEER = """
import json, sys, time
import numpy as np
import rvt.vis
z, resolution, radius = np.load(sys.argv[1]), float(sys.argv[2]), int(sys.argv[3])
times = []
for _ in range(int(sys.argv[4])):
    begin = time.perf_counter()
    rvt.vis.sky_view_factor(dem=z, resolution=resolution, svf_n_dir=32, svf_r_max=radius)
    times.append(time.perf_counter() - begin)
print(json.dumps(min(times)))
"""


def terrain(size: int) -> tuple[np.ndarray, float]:
    whole = jaxhf.jacksboro()
    ny, nx = whole.heights.shape
    heights = zoom(np.asarray(whole.heights, np.float64), (size / ny, size / nx), order=3)
    return np.asarray(heights, np.float32), whole.dx * nx / size


def least(repeats: int, fun) -> float:
    """Seconds of the quickest run, after one that compiles."""
    jax.block_until_ready(fun())
    times = []
    for _ in range(repeats):
        begin = time.perf_counter()
        jax.block_until_ready(fun())
        times.append(time.perf_counter() - begin)
    return min(times)


def errors() -> None:
    """The largest error of a slope, and of a sky-view factor, at 1025 x 1025 vertices of which the middle one is at 0, 0."""
    y, x = np.mgrid[-512:513, -512:513].astype(float)
    turns = np.deg2rad(np.arange(AZIMUTHS) * 360 / AZIMUTHS)
    r = np.hypot(x, y)

    def report(name: str, z: np.ndarray, at: tuple[int, int], slopes: np.ndarray) -> None:
        row, column = 512 + at[1], 512 + at[0]
        found = np.tan(np.deg2rad(np.asarray(jaxhf.horizon(z.astype(np.float32), AZIMUTHS, dx=1.0))[:, row, column]))
        seen = float(jaxhf.sky_view(z.astype(np.float32), AZIMUTHS, dx=1.0)[row, column])
        slopes = np.fmax(slopes, 0)
        share = np.mean(1 - slopes / np.hypot(1, slopes))
        print(f"| {name} | {np.abs(found - slopes).max():.1e} | {abs(seen - share):.1e} |", flush=True)

    print("| surface | largest error of a slope | of the sky-view factor |\n|---|---|---|")
    report("plane", 0.3 * x + 0.2 * y, (37, -120), 0.3 * np.sin(turns) + 0.2 * np.cos(turns))
    report("V-shaped valley, from its bottom", 0.7 * np.abs(x), (0, 33), 0.7 * np.abs(np.sin(turns)))
    report("cone, from its flank", -0.4 * r, (300, 0), 0.4 * -np.sin(turns))
    report("round pit with conical walls, from its middle", 0.5 * np.clip(r - 100, 0, 300), (0, 0), np.full(AZIMUTHS, 0.375))
    off = 150 * -np.sin(turns) + np.sqrt(400**2 - (150 * np.cos(turns)) ** 2)  # from (150, 0) to the rim
    report("round pit with a flat floor and a wall, off its middle", 80.0 * (r >= 400), (150, 0), 80 / off)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", type=int, nargs="*", default=[41, 1024, 4096])
    parser.add_argument("--devices", type=int, default=default_devices(), help="cores of jaxhf's [all]")
    parser.add_argument("--peer", help="a Python in which rvt-py is installed")
    options = parser.parse_args()
    jax.config.update("jax_num_cpu_devices", options.devices)
    errors()
    print(f"\nSeconds, {AZIMUTHS} directions, {options.devices} cores for jaxhf, one for rvt-py.\n")
    print("| heights | jaxhf.horizon | jaxhf.sky_view | rvt-py, radius 10 | rvt-py, radius 100 |\n|---|---|---|---|---|")
    for size in options.sizes:
        z, cell = terrain(size)
        repeats = 3 if size < 2000 else 1
        row = [least(repeats, lambda z=z, cell=cell: jaxhf.horizon(z, AZIMUTHS, dx=cell)) if size < 2000 else None]
        row.append(least(repeats, lambda z=z, cell=cell: jaxhf.sky_view(z, AZIMUTHS, dx=cell)))
        for radius in (10, 100) if options.peer else ():
            if size * radius > 200_000:
                row.append(None)
                continue
            with tempfile.TemporaryDirectory() as folder:
                path = Path(folder) / "z.npy"
                np.save(path, z)
                command = [options.peer, "-c", PEER, str(path), str(cell), str(radius), str(repeats)]
                row.append(json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout))
        print(f"| {size} x {size} | " + " | ".join("—" if t is None else f"{t:.3g}" for t in row) + " |", flush=True)


if __name__ == "__main__":
    sys.exit(main())
