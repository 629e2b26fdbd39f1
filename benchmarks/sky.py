"""Horizon angles, sky-view factors and sunlight: errors, and times, of the sky-view factor beside rvt-py's function.

Terrain is the Jacksboro valley, resampled to n x n heights over the same ground by cubic splines, in single precision, with 32
directions. rvt-py (Relief Visualization Toolbox, by the authors of the sky-view factor of 2011) looks no further than a radius
of 10 pixels unless told otherwise; jaxhf has none. It runs in the Python that --peer names, where it is installed:
`pip install --no-deps rvt-py` with numpy and scipy. xarray-spatial 0.5.3 has no such function; richdem 0.3.4 does not compile
for Python 3.11.

Sunlight of the valley as it is, of a day and of a year, by the number of azimuths: errors against 1024 of these, as shares of
the mean (tests/maps/test_insolation.py holds it against rays to 2048 suns).
"""

import json
import subprocess
import tempfile
import time
from pathlib import Path

import benchmark
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


def errors(run: benchmark.Run) -> None:
    """The largest error of a slope, and of a sky-view factor, at 1025 x 1025 vertices of which the middle one is at 0, 0."""
    y, x = np.mgrid[-512:513, -512:513].astype(float)
    turns = np.deg2rad(np.arange(AZIMUTHS) * 360 / AZIMUTHS)
    r = np.hypot(x, y)

    def report(name: str, z: np.ndarray, at: tuple[int, int], slopes: np.ndarray, most: tuple[float, float]) -> None:
        row, column = 512 + at[1], 512 + at[0]
        found = np.tan(np.deg2rad(np.asarray(jaxhf.horizon(z.astype(np.float32), AZIMUTHS, dx=1.0))[:, row, column]))
        seen = float(jaxhf.sky_view(z.astype(np.float32), AZIMUTHS, dx=1.0)[row, column])
        slopes = np.fmax(slopes, 0)
        share = np.mean(1 - slopes / np.hypot(1, slopes))
        off = float(np.abs(found - slopes).max()), float(abs(seen - share))
        run.row(name, {"largest error of a slope": off[0], "of the sky-view factor": off[1]})
        run.claim(off[0] <= most[0] and off[1] <= most[1], f"{name}: errors {off[0]:.1e}, {off[1]:.1e}, at most {most}")

    # At most: docs/measurements/sky-error.csv and a half more, or some roundings.
    report("plane", 0.3 * x + 0.2 * y, (37, -120), 0.3 * np.sin(turns) + 0.2 * np.cos(turns), (3e-7, 1e-7))
    report("V-shaped valley, from its bottom", 0.7 * np.abs(x), (0, 33), 0.7 * np.abs(np.sin(turns)), (3e-7, 1e-7))
    report("cone, from its flank", -0.4 * r, (300, 0), 0.4 * -np.sin(turns), (1e-3, 2.7e-4))
    pit, walls = 0.5 * np.clip(r - 100, 0, 300), np.full(AZIMUTHS, 0.375)
    report("round pit with conical walls, from its middle", pit, (0, 0), walls, (3.2e-4, 1.7e-4))
    off = 150 * -np.sin(turns) + np.sqrt(400**2 - (150 * np.cos(turns)) ** 2)  # from (150, 0) to the rim
    pit = 80.0 * (r >= 400)
    report("round pit with a flat floor and a wall, off its middle", pit, (150, 0), 80 / off, (1.2e-3, 3.8e-4))


def sunlight(run: benchmark.Run) -> None:
    """Whose errors and seconds `docs/measurements/insolation.csv` has."""
    whole, begin = jaxhf.jacksboro(), np.datetime64("2026-03-10")
    for name, end in (("day", begin + np.timedelta64(1, "D")), ("year", begin + np.timedelta64(365, "D"))):
        exact = np.asarray(jaxhf.insolation(whole, begin, end, azimuths=1024))
        for azimuths in (8, 16, 32, 64, 128, 256):
            times, found = [], exact
            for _ in range(3):
                start = time.perf_counter()
                found = np.asarray(jaxhf.insolation(whole, begin, end, azimuths=azimuths))
                times.append(time.perf_counter() - start)
            off = 100 * np.abs(found - exact) / exact.mean()
            row = {"mean, %": off.mean(), "99th percentile, %": np.percentile(off, 99), "largest, %": off.max()}
            run.row(f"sunlight of a {name}, {azimuths} azimuths", row | {"seconds": min(times)})
            if azimuths == 64:
                run.claim(row["99th percentile, %"] < 0.12, f"64 azimuths: 99 % of a {name}'s errors are below 0.12 %")


def main() -> None:
    claims = "errors of half more, at most, than docs/measurements/sky-error.csv has; of sunlight by 64 azimuths below 0.12 %"
    run = benchmark.Run(__doc__, needs="matplotlib (Jacksboro's heights), for --peer rvt-py", claims=claims)
    parser = run.parser
    parser.add_argument("--sizes", type=int, nargs="*", default=[41, 1024, 4096])
    parser.add_argument("--devices", type=int, default=default_devices(), help="cores of jaxhf's [all]")
    parser.add_argument("--peer", help="a Python in which rvt-py is installed")
    options = run.parse()
    benchmark.need("matplotlib")
    if options.peer and subprocess.run([options.peer, "-c", "import rvt.vis"], capture_output=True).returncode:
        benchmark.refuse(f"{options.peer} has no rvt-py: pip install --no-deps rvt-py")
    jax.config.update("jax_num_cpu_devices", options.devices)
    errors(run)
    sunlight(run)
    print(f"Seconds, {AZIMUTHS} directions, {options.devices} cores for jaxhf, one for rvt-py.")
    for size in options.sizes:
        z, cell = terrain(size)
        repeats = 3 if size < 2000 else 1
        row = {}
        if size < 2000:
            row["jaxhf.horizon"] = min(benchmark.seconds(lambda z=z, cell=cell: jaxhf.horizon(z, AZIMUTHS, dx=cell), repeats))
        row["jaxhf.sky_view"] = min(benchmark.seconds(lambda z=z, cell=cell: jaxhf.sky_view(z, AZIMUTHS, dx=cell), repeats))
        for radius in (10, 100) if options.peer else ():
            if size * radius > 200_000:
                continue
            with tempfile.TemporaryDirectory() as folder:
                path = Path(folder) / "z.npy"
                np.save(path, z)
                command = [options.peer, "-c", PEER, str(path), str(cell), str(radius), str(repeats)]
                row[f"rvt-py, radius {radius}"] = json.loads(subprocess.check_output(command))
        run.row(f"{size} x {size}", row)
    run.end()


if __name__ == "__main__":
    main()
