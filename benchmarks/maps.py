"""Times hillshades, slopes, aspects, tints and shadows beside GDAL's gdaldem, and counts the bytes in which they differ.

Times are seconds of arrays in, arrays out; gdaldem's are of the whole command, with a file in and out, on a RAM disk where
there is one.
"""

import itertools
import os
import resource
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import benchmark
import numpy as np

import jaxhf
from jaxhf.maps.choices import ALGORITHMS, VARIANTS

HOLE = -9999.0
RAMP = "0% 0 60 0\n30% 220 220 120\n60% brown\n100% white\nnv 1 2 3\n"


def terrain(rows: int, columns: int, seed: int = 0) -> np.ndarray:
    """Heights with a spectrum like that of hills, 2 m apart a cell on the average."""
    noise = np.fft.rfft2(np.random.default_rng(seed).normal(size=(rows, columns)))
    frequency = np.hypot(np.fft.fftfreq(rows)[:, None], np.fft.rfftfreq(columns))
    frequency[0, 0] = 1
    heights = np.fft.irfft2(noise * frequency**-1.9, (rows, columns))
    return (heights - heights.min()) * (6 / np.abs(np.diff(heights)).mean())


def with_holes(heights: np.ndarray) -> np.ndarray:
    random = np.random.default_rng(1)
    heights = np.where(random.uniform(size=heights.shape) < 0.003, HOLE, heights)
    heights[100:130, 40:90] = heights[:2, :7] = HOLE
    return heights.astype(np.float32)


def grids() -> dict[str, tuple[np.ndarray, float, float, float | None]]:
    """Of some 1e5 heights, for the comparison of bytes: stored heights, dx, dy, scale of degrees."""
    valley, rough = jaxhf.jacksboro(), terrain(401, 307)
    return {
        "Jacksboro, metres": (valley.heights.astype(np.float32), valley.dx, valley.dy, None),
        "Jacksboro, degrees": (valley.heights.astype(np.float32), 1 / 1200, 1 / 1200, 111120.0),
        "fractal, square cells, float64": (rough, 30.0, 30.0, None),
        "fractal, oblong cells, holes": (with_holes(rough), 25.0, 31.7, None),
        "fractal, square cells, holes": (with_holes(terrain(350, 350, 2)), 25.0, 25.0, None),
        "fractal, square cells, integers": (np.round(rough).astype(np.int16), 30.0, 30.0, None),
        "fractal, oblong cells, integers, holes": (with_holes(rough).astype(np.int16), 10.0, 30.0, None),
    }


class Gdal:
    """gdaldem in a folder of its own, through ENVI's plain files."""

    def __init__(self, folder: Path, heights: np.ndarray, dx: float, dy: float):
        kind = {"i2": 2, "f4": 4, "f8": 5}[heights.dtype.str[1:]]
        self.folder, self.shape = folder, heights.shape
        header = [f"samples = {heights.shape[1]}", f"lines = {heights.shape[0]}", "bands = 1", f"data type = {kind}"]
        header += ["byte order = 0", "interleave = bsq", f"map info = {{Arbitrary, 1, 1, 0, 0, {dx!r}, {dy!r}}}"]
        header += [f"data ignore value = {HOLE}"] if (heights == HOLE).any() else []
        (folder / "in.hdr").write_text("\n".join(["ENVI", *header]) + "\n")
        (folder / "ramp.txt").write_text(RAMP)
        heights[::-1].tofile(folder / "in.bin")

    def __call__(self, mode: str, *options: object) -> np.ndarray:
        for old in (*self.folder.glob("out.*"), *self.folder.glob("*.aux.xml")):
            old.unlink(missing_ok=True)
        ramp = ["ramp.txt"] if mode == "color-relief" else []
        command = ["gdaldem", mode, "in.bin", *ramp, "out.bin", "-q", "-of", "ENVI", *map(str, options)]
        subprocess.run(command, check=True, cwd=self.folder, capture_output=True)
        dtype = np.float32 if mode in ("slope", "aspect") else np.uint8
        found = np.fromfile(self.folder / "out.bin", dtype).reshape(-1, *self.shape)[:, ::-1]
        return found[0] if len(found) == 1 else np.moveaxis(found, 0, -1)


def pairs(
    heights: np.ndarray, dx: float, dy: float, scale: float | None, gdal: Gdal
) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    """Our maps and GDAL's, with all options, in two lights."""
    ours = np.where(heights == HOLE, np.nan, heights) if (heights == HOLE).any() else heights
    scaled = [] if scale is None else ["-s", scale]
    for algorithm, edges in itertools.product(ALGORITHMS, (False, True)):
        common = [*(["-alg", "ZevenbergenThorne"] if algorithm != "horn" else []), *(["-compute_edges"] if edges else [])]
        options = {"algorithm": algorithm, "compute_edges": edges}
        for variant, (azimuth, altitude, z_factor) in itertools.product(VARIANTS, ((315.0, 45.0, 1.0), (77.3, 12.9, 2.5))):
            words = [*common, *scaled, "-z", z_factor, *([] if variant == "regular" else [f"-{variant}"])]
            words += [] if variant == "multidirectional" else ["-az", azimuth]
            words += [] if variant == "igor" else ["-alt", altitude]
            light = {"azimuth": azimuth, "altitude": altitude, "z_factor": z_factor, "variant": variant, "scale": scale}
            yield f"hillshade {variant}", jaxhf.hillshade(ours, dx, dy, **light, **options), gdal("hillshade", *words)
        for flag in (False, True):
            words = [*common, *scaled, *(["-p"] if flag else [])]
            yield "slope", jaxhf.slope(ours, dx, dy, percent=flag, scale=scale, **options), gdal("slope", *words)
            for flat in (False, True):
                words = [*common, *(["-trigonometric"] if flag else []), *(["-zero_for_flat"] if flat else [])]
                yield "aspect", jaxhf.aspect(ours, trigonometric=flag, zero_for_flat=flat, **options), gdal("aspect", *words)
    for entries, words in (("interpolate", []), ("nearest", ["-nearest_color_entry"])):
        tints = jaxhf.color_relief(ours, gdal.folder / "ramp.txt", entries=entries, alpha=True)
        yield "color-relief", tints, gdal("color-relief", "-alpha", *words)


def compare(run: benchmark.Run, folder: Path) -> None:
    total = np.zeros((2, 2), int)
    for name, (heights, dx, dy, scale) in grids().items():
        found: dict[str, list[int]] = {}
        for kind, ours, theirs in pairs(heights, dx, dy, scale, Gdal(folder, heights, dx, dy)):
            differ = ours != theirs
            counts = found.setdefault(kind, [0, 0])
            counts[0], counts[1] = counts[0] + differ.size, counts[1] + int(differ.sum())
        shape = f"{heights.shape[0]} x {heights.shape[1]}"
        run.row(f"{name} ({shape})", {kind: f"{wrong}/{size}" for kind, (size, wrong) in found.items()})
        for kind, counts in found.items():
            total[int(kind.startswith("hillshade"))] += counts
    (others, wrong), (hillshades, ties) = total.tolist()
    run.claim(wrong == 0, f"{wrong} of {others} values of slopes, aspects and tints differ from GDAL's, none")
    run.claim(ties <= 1e-6 * hillshades, f"{ties} of {hillshades} bytes of hillshades differ from GDAL's, at most 1e-6 of them")


def clock(run: benchmark.Run, side: int, folder: Path, repeats: int) -> None:
    heights = terrain(side, side).astype(np.float32)
    gdal = Gdal(folder, heights, 10.0, 10.0)
    rows: list[tuple[str, Callable[[], object], tuple[object, ...] | None]] = [
        *(
            (f"hillshade {variant}", lambda v=variant: jaxhf.hillshade(heights, 10.0, 10.0, variant=v), ("hillshade", *words))
            for variant, words in zip(VARIANTS, ((), *((f"-{name}",) for name in VARIANTS[1:])), strict=True)
        ),
        ("slope", lambda: jaxhf.slope(heights, 10.0, 10.0), ("slope",)),
        ("aspect", lambda: jaxhf.aspect(heights), ("aspect",)),
        ("color relief", lambda: jaxhf.color_relief(heights, folder / "ramp.txt"), ("color-relief",)),
        ("relief", lambda: jaxhf.relief(heights, 10.0, 10.0), None),
        *(
            (f"hillshade, shadows at {h:g}", lambda h=h: jaxhf.hillshade(heights, 10.0, 10.0, altitude=h, shadows=True), None)
            for h in (45.0, 20.0, 5.0)
        ),
    ]
    for name, work, words in rows:
        theirs = {"gdaldem": min(benchmark.seconds(lambda words=words: gdal(*map(str, words)), repeats))} if words else {}
        run.row(f"{side}², {name}", {"jaxhf, s": min(benchmark.seconds(work, repeats))} | theirs)


def main() -> None:
    claims = "that slopes, aspects and tints have GDAL's bytes, and all but a millionth of the hillshades"
    run = benchmark.Run(__doc__, needs="matplotlib (Jacksboro's heights), and GDAL's program gdaldem", claims=claims)
    run.parser.add_argument("--sides", type=int, nargs="*", default=[41, 1024, 4096])
    run.parser.add_argument("--repeats", type=int, default=3)
    options = run.parse()
    benchmark.need("matplotlib", "gdaldem")
    with tempfile.TemporaryDirectory(dir="/dev/shm" if os.access("/dev/shm", os.W_OK) else None) as folder:
        print(subprocess.run(["gdaldem", "--version"], capture_output=True, text=True).stdout.splitlines()[0])
        compare(run, Path(folder))
        for side in options.sides:
            clock(run, side, Path(folder), options.repeats)
    run.row("peak memory", {"GB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6})
    run.end()


if __name__ == "__main__":
    main()
