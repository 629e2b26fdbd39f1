"""How time and memory grow with heights, pixels, samples, pictures and devices: figures, one page of plots, the exponents.

Each point is a process of its own, so that its peak of memory is its own. One quantity varies, the others stay at 1024 x 1024
heights, 512 x 512 pixels, one sample, one picture, all cores, in the view of camera B of forward.py. All heights have as
many cores as the largest terrain fits into memory for, once for each. The terrain is a sum of waves, from the whole side down
to eight cells, which takes no memory beyond its heights. "frame" is from new heights to the picture, "prepared" has their
normals and bounds at hand; several pictures are seen from several places. "fits" are of square terrains by the plain call, in
float32, with all compilation: three pictures from straight above with a pixel a height and 1 % noise, and a map of the terrain
smoothed over eight cells. An exponent e says that a cost grows as quantity ** e: the slope of the logarithms over the upper
half of the points.
"""

import json
import math
import os
import time
from pathlib import Path
from typing import Any

import benchmark
import numpy as np

from jaxhf.study.worker import Answers, MeasurementError, Worker, timed
from jaxhf.xla.machine import available_bytes, peak_mb

COSTS = ("frame", "prepared", "fit", "peak_mb")
BASE = {"heights": 1024, "pixels": 512, "samples": 1, "images": 1}
UNITS = {
    "heights": "heights", "pixels": "pixels", "samples": "samples a pixel", "images": "pictures", "devices": "cores",
    "fits": "heights of a fit",
}  # fmt: skip
SQUARE = ("heights", "pixels", "fits")
# At the peak, for each device, which has the scene to itself: 54 to 65 measured with one, 107 with two.
BYTES_A_HEIGHT = 66


def waves(size: int, count: int = 48) -> np.ndarray:
    """A terrain over the unit square, from products of vectors alone."""
    rng = np.random.default_rng(0)
    frequency = np.exp(rng.uniform(0, math.log(size / 8), count))
    angle, phase = rng.uniform(0, 2 * np.pi, (2, count))
    place = np.linspace(0, 2 * np.pi, size)
    x = np.outer(place, frequency * np.cos(angle)) + phase
    y = np.outer(place, frequency * np.sin(angle))
    amplitude = 0.03 / frequency
    rows = np.concatenate([np.cos(y), np.sin(y)], 1).astype(np.float32)
    columns = np.concatenate([amplitude * np.cos(x), -amplitude * np.sin(x)], 1).astype(np.float32)
    return rows @ columns.T


def prepare(job: dict[str, Any]) -> Answers:
    os.sched_setaffinity(0, job["cores"])
    import jax
    from forward import CAMERAS, LIGHTS

    import jaxhf

    jax.config.update("jax_num_cpu_devices", job["devices"])
    eye, target, fov = CAMERAS["B"]
    side = job["pixels"]
    cameras = [
        jaxhf.Perspective.look_at(np.add(eye, (0.01 * k, 0, 0)), target, fov=fov, width=side, height=side)
        for k in range(job["images"])
    ]
    scene = jaxhf.Scene(
        [jaxhf.Object(jaxhf.Heightfield(waves(job["heights"])))], cameras[0], [jaxhf.Directional(LIGHTS["B"])], job["samples"]
    )
    ready: Any = None

    def frame() -> None:
        nonlocal ready
        if job["images"] == 1:
            jax.block_until_ready(jaxhf.render(scene))
        else:
            ready = jaxhf.prepare(scene)
            views()

    def views() -> None:
        for camera in cameras:
            jax.block_until_ready(jaxhf.render(ready.with_camera(camera)))

    def first() -> dict[str, float]:
        frame()
        return {"peak_mb": peak_mb()}

    def prepared() -> dict[str, float]:
        nonlocal ready
        if ready is None:
            ready = jaxhf.prepare(scene)
            views()
        return timed(views)

    return {"ready": first, "frame": lambda: timed(frame), "prepared": prepared}


def fit(job: dict[str, Any]) -> Answers:
    os.sched_setaffinity(0, job["cores"])
    import jax
    from cases import map_of, noisy, times_nearer

    import jaxhf

    jax.config.update("jax_num_cpu_devices", job["devices"])
    size = job["heights"]
    truth = waves(size)
    prior = map_of(truth.astype(np.float64))
    camera = jaxhf.Orthographic.look_at((0.5, 0.5, 2), (0.5, 0.5, 0), up=(0, 1, 0), extent=1, width=size, height=size)
    suns = [jaxhf.Directional.from_angles(azimuth, 35) for azimuth in (0, 120, 240)]

    def scenes(heights: np.ndarray) -> list[jaxhf.Scene]:
        return [jaxhf.Scene([jaxhf.Object(jaxhf.Heightfield(heights), jaxhf.Matte(0.5))], camera, [sun]) for sun in suns]

    def ready() -> dict[str, float]:
        exact = [np.asarray(jaxhf.render(scene, jaxhf.Settings(samples=16)))[..., 0] for scene in scenes(truth)]
        targets, _ = noisy(np.stack(exact))
        begin = time.perf_counter()
        found = jaxhf.fit(scenes(prior.heights.astype(np.float32)), list(targets), prior=prior)
        taken = time.perf_counter() - begin
        return {"fit": taken, "ratio": times_nearer(prior, found.heights, truth), "peak_mb": peak_mb()}

    return {"ready": ready}


def measure(quantity: str, value: int, cores: list[int], repeats: int) -> dict[str, Any]:
    job = BASE | {quantity: value} if quantity in BASE else dict(BASE)
    used = cores[:value] if quantity == "devices" else cores
    about = {"quantity": quantity, "value": value, "count": value**2 if quantity in SQUARE else value, "devices": len(used)}
    if quantity == "fits":
        with Worker(fit, {"heights": value, "devices": len(used), "cores": used}) as worker:
            return about | worker.answer()
    with Worker(prepare, job | {"devices": len(used), "cores": used}) as worker:
        peak = worker.answer()["peak_mb"]
        frames = [worker.ask("frame")["seconds"] for _ in range(repeats)]
        worker.ask("prepared")
        prepared = [worker.ask("prepared")["seconds"] for _ in range(repeats)]
    return about | {"frame": float(np.median(frames)), "prepared": float(np.median(prepared)), "peak_mb": peak}


def exponent(points: list[dict[str, Any]], cost: str) -> float:
    """Least squares through the logarithms of the upper half of the points, two at least."""
    points = sorted(points, key=lambda point: point["count"])[-max(2, (len(points) + 1) // 2) :]
    slope, _ = np.polyfit(np.log([point["count"] for point in points]), np.log([point[cost] for point in points]), 1)
    return float(slope)


def plot(points: list[dict[str, Any]], path: Path) -> None:
    import matplotlib

    matplotlib.use("agg")
    from matplotlib import pyplot as plt

    quantities = list(dict.fromkeys(point["quantity"] for point in points))
    figure, axes = plt.subplots(2, len(quantities), figsize=(3.6 * len(quantities), 7), layout="constrained", squeeze=False)
    for column, quantity in enumerate(quantities):
        mine = sorted((point for point in points if point["quantity"] == quantity), key=lambda point: point["count"])
        counts = [point["count"] for point in mine]
        for row, costs in enumerate((("frame", "prepared", "fit"), ("peak_mb",))):
            panel, costs = axes[row][column], [cost for cost in costs if cost in mine[0]]
            for cost in costs:
                label = cost.replace("peak_mb", "peak") + (f", exponent {exponent(mine, cost):.2f}" if len(mine) > 1 else "")
                panel.plot(counts, [point[cost] for point in mine], "o-", label=label)
            panel.set(xscale="log", yscale="log", xlabel=UNITS[quantity], ylabel="MiB" if row else "seconds")
            names = [f"{point['value']}²" if quantity in SQUARE else str(point["value"]) for point in mine]
            panel.set_xticks(counts, names, rotation=90 if len(names) > 5 else 0)
            panel.set_xticks([], minor=True)
            panel.set_ylim(*whole_decades([point[cost] for cost in costs for point in mine]))
            panel.grid(True, alpha=0.3)
            panel.legend(fontsize="small")
    figure.savefig(path)


def whole_decades(values: list[float]) -> tuple[float, float]:
    """Powers of ten around them, so that noise does not fill a panel."""
    return 10 ** math.floor(math.log10(min(values))), 10 ** math.ceil(math.log10(max(values)))


def main() -> None:
    claims = "of what has five points exponents below 1.2, below 0.5 of a prepared frame over heights"
    run = benchmark.Run(__doc__, needs="matplotlib for its plot", claims=claims)
    parser = run.parser
    parser.add_argument("-o", "--output", type=Path, default=Path("growth"), help="growth.json and growth.png go here")
    parser.add_argument("--quantities", nargs="+", default=list(UNITS), choices=UNITS)
    parser.add_argument("--largest", type=int, default=16384, help="heights a side, at most")
    parser.add_argument("--repeats", type=int, default=5)
    options = run.parse()
    benchmark.need("matplotlib")
    cores = sorted(os.sched_getaffinity(0))
    values = {
        "heights": [2**k for k in range(6, 15) if 2**k <= options.largest],
        "pixels": [2**k for k in range(6, 14)],
        "samples": [n * n for n in (1, 2, 4, 8)],
        "images": [1, 2, 4, 8, 16],
        "devices": [n for n in (1, 2, 4, 8, 16) if n <= len(cores)],
        "fits": [2**k for k in range(5, 9)],
    }
    print("about three minutes a quantity on two free cores, five of fits", flush=True)
    options.output.mkdir(parents=True, exist_ok=True)
    points: list[dict[str, Any]] = []
    for quantity in options.quantities:
        used = cores
        if quantity == "heights":
            copies = available_bytes() / BYTES_A_HEIGHT
            values[quantity] = [value for value in values[quantity] if value**2 <= copies]
            largest = values[quantity][-1]
            used = cores[: min(len(cores), int(copies / largest**2))]
            print(f"heights up to {largest}², on {len(used)} cores: as many as memory holds copies for", flush=True)
        for value in values[quantity]:
            try:
                points.append(measure(quantity, value, used, options.repeats))
                (options.output / "growth.json").write_text(json.dumps(points, indent=1))
            except MeasurementError as error:
                print(f"{quantity} {value}: {error}", flush=True)
    plot(points, options.output / "growth.png")
    for quantity in dict.fromkeys(point["quantity"] for point in points):
        mine = [point for point in points if point["quantity"] == quantity]
        for point in mine:
            name = f"{point['value']}²" if quantity in SQUARE else point["value"]
            run.row(f"{name} {UNITS[quantity]}", {key: point[key] for key in ("devices", *COSTS, "ratio") if key in point})
        slopes = {cost: exponent(mine, cost) for cost in COSTS if cost in mine[0]} if len(mine) > 1 else {}
        run.row(f"exponent of {UNITS[quantity]}", slopes)
        most = dict.fromkeys(COSTS, 1.2) | ({"prepared": 0.5} if quantity == "heights" else {})
        for cost, slope in slopes.items():
            if len(mine) > 4:
                run.claim(slope < most[cost], f"{cost} grows as {quantity} ** {slope:.2f}, below {most[cost]}")
    run.end()


if __name__ == "__main__":
    main()
