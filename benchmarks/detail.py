"""Speed and error of `Settings.detail` on a large terrain, from prepared frames.

Two terrains of 4096 x 4096 heights: the waves of growth.py, which are smooth, and a fractal, which is not; 512 x 512 pixels,
one sample, in the views of forward.py. Frames with all values of the knob take turns in one process, in an order that is drawn
anew for each round; "time" and "core time" are the medians of ratios to the exact frame of the same round, by the clock and by
the processors. In the first row the exact frame is held against itself: that says how far a ratio can be trusted.

Error: RMSE of the picture, over its mean, against an exact one with 16 samples a pixel, which tells what is lost from what is
only another of the many triangles in a pixel. All else is against the exact frame. RMSE: the same. Cells, status: the shares of
pixels whose centre meets another cell, and of those whose centre meets the surface in one of the two pictures only. Depth: root
mean square and largest difference where both do, in widths of a pixel there. Steps: of the search for the first hit, the mean,
and the mean over tiles of 32 x 32 pixels of the slowest, for which the others wait.
"""

import argparse
import math
import time
from typing import Any

import jax
import numpy as np
from forward import CAMERAS, LIGHTS
from growth import waves

import jaxhf
from jaxhf._worker import timed
from jaxhf.io._procedural import fractal

VALUES = (None, 0.1, 0.25, 0.5, 1.0, 2.0)
AOVS = ("depth", "cell", "status", "steps")


def terrain(name: str, size: int) -> np.ndarray:
    if name == "waves":
        return waves(size)
    return fractal([size, size], seed=0, exponent=2.0, range=(0.0, 0.25)).astype(np.float32)


def scene(heights: np.ndarray, camera: str, pixels: int) -> jaxhf.Scene:
    eye, target, fov = CAMERAS[camera]
    view = jaxhf.Perspective.look_at(eye, target, fov=fov, width=pixels, height=pixels)
    return jaxhf.Scene([jaxhf.Object(jaxhf.Heightfield(heights))], view, [jaxhf.Directional(LIGHTS[camera])], 1)


def observed(seen: jaxhf.Scene, detail: float | None) -> dict[str, np.ndarray]:
    """AOVs, by a program that is compiled sooner than that of the frame."""
    return jax.device_get(jaxhf.render(seen, jaxhf.Settings(shading="flat", shadows=False, detail=detail), aovs=AOVS)[1])


def rmse(image: np.ndarray, reference: np.ndarray) -> float:
    return float(np.sqrt(np.mean((image - reference) ** 2)) / np.mean(reference))


def errors(aovs: dict[str, np.ndarray], known: dict[str, np.ndarray], camera: Any) -> dict[str, float]:
    met = np.isfinite(aovs["depth"]) & np.isfinite(known["depth"])
    pixel = 2 * np.tan(np.deg2rad(camera.fov) / 2) / camera.height * known["depth"][met]
    off = np.abs(aovs["depth"][met] - known["depth"][met]) / pixel
    steps, tiles = aovs["steps"], camera.height // 32
    return {
        "cells": float(np.mean((aovs["cell"] != known["cell"]).any(-1))),
        "status": float(np.mean(aovs["status"] != known["status"])),
        "depth": float(np.sqrt(np.mean(off**2))),
        "farthest": float(off.max()),
        "steps": float(np.mean(steps)),
        "slowest": float(np.mean(steps.reshape(tiles, 32, tiles, 32).max((1, 3)))),
    }


def measure(heights: np.ndarray, camera: str, pixels: int, repeats: int, shadows: bool) -> list[dict[str, Any]]:
    seen = scene(heights, camera, pixels)
    frames = [jaxhf.prepare(seen, jaxhf.Settings(detail=value, shadows=shadows)) for value in VALUES]
    images = [np.asarray(jaxhf.render(frame)) for frame in frames]
    turns = [0, *range(len(frames))]
    seconds, cores = np.zeros((2, repeats, len(turns)))
    generator = np.random.default_rng(0)
    for k in range(repeats):
        for turn in generator.permutation(len(turns)):
            taken = timed(lambda turn=turn: jax.block_until_ready(jaxhf.render(frames[turns[turn]])))
            seconds[k, turn], cores[k, turn] = taken["seconds"], taken["cpu_seconds"]
    ratios, core_ratios = (np.median(times / times[:, 1:2], axis=0) for times in (seconds, cores))
    known = observed(seen, None)
    fine = np.asarray(jaxhf.render(seen, jaxhf.Settings(samples=16, shadows=shadows)))
    rows = []
    for turn, k in enumerate(turns):
        found = errors(known if k == 0 else observed(seen, VALUES[k]), known, seen.camera)
        found |= {"rmse": rmse(images[k], images[0]), "error": rmse(images[k], fine)}
        rows.append({"detail": VALUES[k], "time": ratios[turn], "core": core_ratios[turn], **found})
    return [rows[0], *rows[2:]]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, default=4096, help="heights a side")
    parser.add_argument("--pixels", type=int, default=512, help="of the picture, a side; a multiple of 32")
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--terrains", nargs="+", default=["waves", "fractal"], choices=["waves", "fractal"])
    parser.add_argument("--cameras", nargs="+", default=["B"], choices=sorted(CAMERAS))
    parser.add_argument("--no-shadows", action="store_true")
    options = parser.parse_args()
    begin = time.perf_counter()
    views = len(options.terrains) * len(options.cameras)
    print(
        f"about {math.ceil(views * (50 + 2.5 * options.repeats) / 60)} minutes at 4096² heights on two free cores", flush=True
    )
    print("| terrain | detail | time | core time | steps | slowest | error | RMSE | cells | status | depth | farthest |")
    print("|---|---|---|---|---|---|---|---|---|---|---|---|")
    for name in options.terrains:
        heights = terrain(name, options.size)
        for camera in options.cameras:
            for row in measure(heights, camera, options.pixels, options.repeats, not options.no_shadows):
                print(
                    f"| {name}, {camera} | {row['detail']} | {row['time']:.2f} | {row['core']:.2f} "
                    f"| {row['steps']:.1f} | {row['slowest']:.1f} | {row['error']:.3f} | {row['rmse']:.2g} "
                    f"| {row['cells']:.2g} | {row['status']:.1e} | {row['depth']:.2g} | {row['farthest']:.2g} |",
                    flush=True,
                )
    print(f"{time.perf_counter() - begin:.0f} s")


if __name__ == "__main__":
    main()
