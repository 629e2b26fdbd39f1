"""Recovers terrains from pictures and prints how near to the truth, and in what time.

`flat`: noise-free pictures of our own, four lights, no shadows. `common`: the common recovery of `--peers`, whose pictures
Mitsuba made, or makes (pip install mitsuba) for other cameras and sizes. `jacksboro`: the Jacksboro terrain from a smoothed
prior and three noisy pictures at another sample count. One case a process: the times include compilation, as a user meets it.
"""

import argparse
import os
import resource
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np
from peers import common_work, mitsuba_picture

import jaxhf
from jaxhf.io._procedural import fractal

LIGHTS = ((0.5, -0.3, 0.6), (0.3, 0.5, 0.6), (-0.5, 0.3, 0.6), (-0.3, -0.5, 0.6))


def report(name: str, found: jaxhf.Fit, truth: np.ndarray, seconds: float, **more: Any) -> None:
    span = np.ptp(truth)
    error = np.asarray(found.heights, np.float64) - truth
    inside = error[2:-2, 2:-2]
    numbers = {
        "RMSE/range": np.sqrt(np.mean(error**2)) / span,
        "mean removed": error.std() / span,
        "without border": inside.std() / span,
        "seconds": seconds,
        "steps": found.stats["steps"],
        "chi2": found.stats["chi2"],
        "peak MB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        **more,
    }
    print(name, ", ".join(f"{key} {value:.3g}" for key, value in numbers.items()), "|", found.result.value, flush=True)


def timed(*arguments: Any, **options: Any) -> tuple[jaxhf.Fit, float]:
    begin = time.perf_counter()
    found = jaxhf.fit(*arguments, **options)
    return found, time.perf_counter() - begin


def flat(options: argparse.Namespace) -> None:
    """Smooth terrain seen from straight above, nothing hidden: what is left is the solver's own error."""
    n = 64
    truth = fractal([n, n], seed=3, exponent=3.0, range=(0.0, 0.1)).astype(options.dtype)
    # Its frame ends just inside the terrain, whose border would move with the heights in a way that only edge derivatives know.
    fov = 2 * np.degrees(np.arctan(0.4995 / 5.0))
    camera = jaxhf.Perspective.look_at((0.5, 0.5, 5.0), (0.5, 0.5, 0.0), up=(0, 1, 0), fov=fov, width=128, height=128)
    settings = jaxhf.Settings(shadows=False, samples=1)

    def scenes(heights: np.ndarray) -> list[jaxhf.Scene]:
        field = jaxhf.Object(jaxhf.Heightfield(heights))
        return [jaxhf.Scene([field], camera, [jaxhf.Directional(towards)]) for towards in LIGHTS]

    targets = [np.asarray(jaxhf.render(scene, settings))[..., 0] for scene in scenes(truth)]
    found, seconds = timed(
        scenes(np.full_like(truth, 0.05)),
        targets,
        settings=settings,
        tolerance=1e-9,
        max_steps=options.max_steps,
        progress=options.verbose,
    )
    report("flat start, noise-free, 4 images:", found, truth, seconds)


def common(options: argparse.Namespace) -> None:
    work = common_work(options.peers)
    view = eye, target, fov = work.CAMERAS[options.camera]
    camera = jaxhf.Perspective.look_at(eye, target, fov=fov, width=options.pixels, height=options.pixels)
    truth = work.terrain(options.size).astype(np.float64)
    stored = options.peers / f"targets_{options.camera}_{options.light}.npz"
    if stored.exists() and (options.size, options.pixels) == (64, 128):
        lights, targets = (np.load(stored)[name] for name in ("lights", "images"))
    else:
        lights = work.turned_lights(options.light, 4)
        targets = [mitsuba_picture(truth, view, towards, options.pixels, 256, work.ALBEDO) for towards in lights]
    field = jaxhf.Object(jaxhf.Heightfield(np.full(truth.shape, 0.1, options.dtype)), jaxhf.Matte(work.ALBEDO))
    scenes = [jaxhf.Scene([field], camera, [jaxhf.Directional(towards)]) for towards in lights][: options.images]
    settings = jaxhf.Settings(normals="six-angle", samples=options.samples, edge_samples=options.edge_samples)
    found, seconds = timed(
        scenes, list(targets)[: options.images], settings=settings, loss=options.loss, solver=options.solver,
        max_steps=options.max_steps, progress=options.verbose,
    )  # fmt: skip
    name = f"common, {options.size}² heights, {options.pixels}² pixels, camera {options.camera}, {options.light}"
    report(f"{name}, {options.images} images, {options.loss}:", found, truth, seconds)


def jacksboro(options: argparse.Namespace) -> None:
    terrain = jaxhf.jacksboro()
    truth = terrain.heights[100:164, 100:164].astype(options.dtype)
    extent = 63 * max(terrain.dx, terrain.dy)
    middle = (31.5 * terrain.dx, 31.5 * terrain.dy, float(truth.mean()))
    camera = jaxhf.Orthographic.look_at(
        (middle[0], middle[1] - 0.3 * extent, middle[2] + 2 * extent), middle, extent=1.1 * extent, width=128, height=128
    )
    lights = [jaxhf.Directional.from_angles(azimuth=azimuth, altitude=35) for azimuth in (315, 75, 195)]

    def scenes(heights: np.ndarray) -> list[jaxhf.Scene]:
        field = jaxhf.Object(jaxhf.Heightfield(heights, dx=terrain.dx, dy=terrain.dy))
        return [jaxhf.Scene([field], camera, [light]) for light in lights]

    rng = np.random.default_rng(0)
    targets = [np.asarray(jaxhf.render(scene, jaxhf.Settings(samples=64)))[..., 0] for scene in scenes(truth)]
    noise = 0.01 * float(np.mean([image.max() for image in targets]))
    targets = [image + noise * rng.standard_normal(image.shape) for image in targets]
    prior = smoothed(truth.astype(np.float64), 8)
    spread = float((prior - truth).std())
    found, seconds = timed(
        scenes(prior.astype(options.dtype)), targets, settings=jaxhf.Settings(samples=options.samples), noise=noise,
        prior=prior, prior_std=spread, loss=options.loss, uncertainty=options.uncertainty, max_steps=options.max_steps,
        progress=options.verbose,
    )  # fmt: skip
    error = np.asarray(found.heights, np.float64) - truth
    before = np.sqrt(np.mean((prior - truth) ** 2))
    more = {"prior RMSE/RMSE": before / np.sqrt(np.mean(error**2))}
    if found.std is not None:
        more |= {f"within {k} std": np.mean(np.abs(error) <= k * found.std) for k in (1, 2)}
    report("jacksboro, 3 images, 1 % noise:", found, truth, seconds, **more)


def smoothed(heights: np.ndarray, cells: float) -> np.ndarray:
    """A Gaussian of this standard deviation over the vertices that there are."""
    for axis, n in enumerate(heights.shape):
        at = np.arange(n)
        kernel = np.exp(-0.5 * ((at[:, None] - at) / cells) ** 2)
        kernel /= kernel.sum(1, keepdims=True)
        heights = np.moveaxis(np.tensordot(kernel, heights, (1, axis)), 0, axis)
    return heights


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("case", choices=("flat", "common", "jacksboro"))
    parser.add_argument("--peers", type=Path, help="folder of common_work.py and of its targets")
    parser.add_argument("--camera", default="D", choices=("A", "B", "C", "D"))
    parser.add_argument("--size", type=int, default=64, help="heights a side of the common recovery")
    parser.add_argument("--pixels", type=int, default=128)
    parser.add_argument("--light", default="std", choices=("std", "low"))
    parser.add_argument("--images", type=int, default=4)
    parser.add_argument("--samples", type=int, default=4)
    parser.add_argument("--edge-samples", type=int, default=0, help="of the derivative, a picture")
    parser.add_argument("--solver", default="lm")
    parser.add_argument("--loss", default="squares")
    parser.add_argument("--max-steps", type=int, default=100)
    parser.add_argument("--uncertainty", type=int)
    parser.add_argument("--precision", default="float64", choices=("float32", "float64"))
    parser.add_argument("--devices", type=int, default=len(os.sched_getaffinity(0)))
    parser.add_argument("--verbose", action="store_true")
    options = parser.parse_args()
    if options.case == "common" and options.peers is None:
        parser.error("common needs --peers")
    jax.config.update("jax_enable_x64", options.precision == "float64")
    jax.config.update("jax_num_cpu_devices", options.devices)
    options.dtype = np.dtype(options.precision)
    {"flat": flat, "common": common, "jacksboro": jacksboro}[options.case](options)


if __name__ == "__main__":
    main()
