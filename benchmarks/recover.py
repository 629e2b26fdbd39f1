"""Recovers terrains from pictures and prints how near to the truth, and in what time.

`flat`: noise-free pictures of our own, four lights, no shadows. `common`: the common recovery of `--peers`, whose pictures
Mitsuba made, or makes for other cameras and sizes (pip install mitsuba). `jacksboro`: parts of the Jacksboro terrain from a
map smoothed over 8 cells and three noisy pictures that Mitsuba made (`--targets` keeps them). `shadow`: a hill that no
picture shows, from its shadow. `pose`: lights and cameras that are off by a degree, taken as known and sought. `cases`: what
the default call makes of the cases of cases.py, or with `--held-out` of those of held_out.py. One case a process: the times
include compilation, as a user meets it.
"""

import argparse
import dataclasses
import os
import resource
import sys
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np
import scipy.optimize
from cases import CASES, LIGHTS, Case, Missing, Sources, flat as flat_case, smoothed
from held_out import HELD_OUT
from peers import View, common_work, mitsuba_picture

import jaxhf
from jaxhf.core.affine import rotate
from jaxhf.fitting.view import differences
from jaxhf.io.procedural import fractal


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
    case = flat_case(Sources(), options.precision)
    found, seconds = timed(
        case.scenes,
        case.targets,
        settings=jaxhf.Settings(shadows=False, samples=1),
        tolerance=1e-9,
        max_steps=options.max_steps,
        progress=options.verbose,
    )
    report("flat start, noise-free, 4 images:", found, case.truth, seconds)


def common(options: argparse.Namespace) -> None:
    work = common_work(options.peers)
    view = eye, target, fov = work.CAMERAS[options.camera]
    camera = jaxhf.Perspective.look_at(eye, target, fov=fov, width=options.pixels, height=options.pixels)
    truth = work.terrain(options.size).astype(np.float64)
    stored = options.peers / f"targets_{options.camera}_{options.light}.npz"
    if stored.exists() and (options.size, options.pixels) == (64, 128):
        lights, targets = (np.load(stored)[name] for name in ("lights", "images"))
    else:
        lights = work.turned_lights(options.light, 4)[: options.images]
        targets = [mitsuba_picture(truth, view, towards, options.pixels, 256, work.ALBEDO) for towards in lights]
    field = jaxhf.Object(jaxhf.Heightfield(np.full(truth.shape, 0.1, options.dtype)), jaxhf.Matte(work.ALBEDO))
    scenes = [jaxhf.Scene([field], camera, [jaxhf.Directional(towards)]) for towards in lights][: options.images]
    settings = jaxhf.Settings(normals="six-angle", samples=options.samples, edge_samples=options.edge_samples or 0)
    found, seconds = timed(
        scenes, list(targets)[: options.images], settings=settings, loss=options.loss, solver=options.solver,
        max_steps=options.max_steps, progress=options.verbose,
    )  # fmt: skip
    name = f"common, {options.size}² heights, {options.pixels}² pixels, camera {options.camera}, {options.light}"
    report(f"{name}, {options.images} images, {options.loss}:", found, truth, seconds)


CORNERS = ((100, 100), (200, 50), (20, 300))  # row and column of the south-western vertex of each part
CELLS = 8  # over which the map was smoothed: standard deviation of a Gaussian


def jacksboro(options: argparse.Namespace) -> None:
    """64 x 64 heights of each part, 128 x 128 pixels; the map is all that is known, and what maps like it miss elsewhere."""
    terrain = jaxhf.jacksboro()
    whole = terrain.heights.astype(np.float64)
    coarse = smoothed(whole, CELLS)
    extent = (63 * terrain.dx, 63 * terrain.dy)
    lights = [jaxhf.Directional.from_angles(azimuth=azimuth, altitude=35) for azimuth in (315, 75, 195)]
    parts = {f"{row},{column}": np.s_[row : row + 64, column : column + 64] for row, column in CORNERS}
    # From three sides: the height of everything shows in parallax only, and is one number, which would decide for all cells.
    eyes = ((0.0, -8000.0, 13000.0), (7000.0, 4000.0, 13000.0), (-7000.0, 4000.0, 13000.0))
    views: dict[str, list[View]] = {}
    for name, part in parts.items():
        middle = (extent[0] / 2, extent[1] / 2, float(coarse[part].mean()))
        views[name] = [((middle[0] + x, middle[1] + y, middle[2] + z), middle, 24.0) for x, y, z in eyes]
    if options.targets is not None and options.targets.exists():
        pictures = dict(np.load(options.targets))
    else:
        pictures: dict[str, Any] = {
            name: np.stack(
                [
                    mitsuba_picture(whole[part], view, np.asarray(light.towards).tolist(), 128, 1024, 0.7, extent)
                    for view, light in zip(views[name], lights, strict=True)
                ]
            )
            for name, part in parts.items()
        }
        if options.targets is not None:
            np.savez(options.targets, **pictures)
    for name in options.parts:
        part = parts[name]
        truth, prior, exact = whole[part], coarse[part], pictures[name]
        cameras = [jaxhf.Perspective.look_at(eye, at, fov=fov, width=128, height=128) for eye, at, fov in views[name]]
        field = jaxhf.Heightfield(prior.astype(options.dtype), dx=terrain.dx, dy=terrain.dy)
        ground = jaxhf.Object(field, jaxhf.Matte(0.7))
        scenes = [jaxhf.Scene([ground], camera, [light]) for camera, light in zip(cameras, lights, strict=True)]
        settings, fine = (jaxhf.Settings(normals="six-angle", samples=n) for n in (options.samples, 64))
        noise = 0.01 * float(np.mean([image.max() for image in exact]))
        targets = exact + noise * np.random.default_rng(0).standard_normal(exact.shape)
        # The terrain's border moves in the picture as only edge derivatives know: pixels within two cells of it do not count,
        # and two more, as the map's errors shift what a pixel shows by up to 1.4 (three times their deviation, seen from 31°).
        places = np.stack([jaxhf.render(scene, settings, aovs=("uv",))[1]["uv"] for scene in scenes])
        weights = np.all((places > 4 / 63) & (places < 59 / 63), axis=-1).astype(float)
        # What the few samples of the fit's pictures leave out is noise too, as large as in pictures of the map.
        few, many = (np.stack([jaxhf.render(scene, some)[..., 0] for scene in scenes]) for some in (settings, fine))
        sampling = float(np.sqrt(np.mean((few - many)[weights > 0] ** 2)))
        spread, length, exponent = _missing(whole, coarse, part)
        found, seconds = timed(
            scenes, targets, settings=settings, weights=weights, noise=float(np.hypot(noise, sampling)), prior=prior,
            prior_std=spread, prior_length=None if options.independent else float(length * np.sqrt(terrain.dx * terrain.dy)),
            prior_exponent=exponent, loss=options.loss, uncertainty=options.uncertainty, max_steps=options.max_steps,
            progress=options.verbose,
        )  # fmt: skip
        error = np.asarray(found.heights, np.float64) - truth
        before = np.sqrt(np.mean((prior - truth) ** 2))
        more = {
            "noise": noise, "of sampling": sampling, "prior_std": spread, "length in cells": length, "exponent": exponent,
            "prior RMSE": before,
            "prior RMSE/RMSE": before / np.sqrt(np.mean(error**2)),
        }  # fmt: skip
        if found.std is not None:
            more |= {f"within {k} std": np.mean(np.abs(error) <= k * found.std) for k in (1, 2)}
        report(f"jacksboro by Mitsuba, {name}, 3 images, 1 % noise:", found, truth, seconds, **more)
        if options.out is not None:
            kept = {"heights": found.heights, "truth": truth, "prior": prior, "targets": targets, "images": found.images}
            np.savez(options.out / f"jacksboro {name}.npz", **kept, std=0 if found.std is None else found.std, weights=weights)


def _missing(whole: np.ndarray, coarse: np.ndarray, part: Any) -> tuple[float, float, float]:
    """What such a map misses, from a survey of all but this part of the terrain.

    The Fourier amplitudes of what it misses are taken from tiles of the part's size, under a Hann window, without which the
    jump between opposite borders would pass for high frequencies.

    Returns:
      `fit`'s prior_std, prior_length (in cells) and prior_exponent.
    """
    error, n = coarse - whole, 64
    rest, powers = np.ones(whole.shape, bool), []
    rest[part] = False
    hann = np.hanning(n + 2)[1:-1]
    window = np.outer(hann, hann) / np.mean(hann**2)
    for row in range(0, whole.shape[0] - n + 1, 16):
        for column in range(0, whole.shape[1] - n + 1, 16):
            tile = np.s_[row : row + n, column : column + n]
            if rest[tile].all():
                powers.append(np.abs(np.fft.fft2(window * (error[tile] - error[tile].mean()), norm="ortho")) ** 2)
    steps = 2 - 2 * np.cos(2 * np.pi * np.arange(n) / n)
    square = (steps[:, None] + steps[None, :]).ravel()[1:]
    amplitude = np.log(np.mean(powers, axis=0).ravel()[1:]) / 2

    def off(x: np.ndarray) -> np.ndarray:
        # Over the frequency, as there are as many more of the short ones.
        return (amplitude - (x[0] - x[2] / 2 * np.log1p(np.exp(2 * x[1]) * square))) / np.sqrt(square)

    _, length, exponent = scipy.optimize.least_squares(off, [amplitude[0], np.log(CELLS / 1.4), 2.0]).x
    return float(np.sqrt(np.mean(error[rest] ** 2))), float(np.exp(length)), float(exponent)


def shadow(options: argparse.Namespace) -> None:
    """A hill beside the frame, which a map shows at 60 % of its height, from its shadow on surveyed ground.

    The ground is a heightfield of its own; the picture, from straight above, shows nothing else. The map is said to be off by
    about as much as it shows, by all of the hill together. With and without points on edges.
    """
    x, y = np.meshgrid(np.linspace(0, 0.4, 13), np.linspace(0, 1, 25))
    truth = 0.12 * np.exp(-(((x - 0.2) / 0.06) ** 2) / 2 - ((y - 0.5) / 0.12) ** 2 / 2)
    known = 0.6 * truth
    x, y = np.meshgrid(np.linspace(0, 0.6, 13), np.linspace(0, 1, 21))
    ground = jaxhf.Heightfield((0.01 * x * np.sin(6 * y)).astype(options.dtype), dx=0.05, dy=0.05, x0=0.4)
    frame = np.array([[1.0, 0, 0, 0.67], [0, 1, 0, 0.5], [0, 0, -1, 2], [0, 0, 0, 1]])
    camera = jaxhf.Orthographic(frame, 0.5, width=24, height=24)

    def scene(heights: np.ndarray) -> jaxhf.Scene:
        hill = jaxhf.Heightfield(heights.astype(options.dtype), dx=0.4 / 12, dy=1 / 24)
        objects = [jaxhf.Object(field, jaxhf.Matte(0.7)) for field in (hill, ground)]
        return jaxhf.Scene(objects, camera, [jaxhf.Directional((-1, 0.1, 0.25))])

    exact = np.asarray(jaxhf.render(scene(truth), jaxhf.Settings(samples=1024)))[..., 0]
    noise = 0.01 * float(exact.max())
    target = exact + noise * np.random.default_rng(0).standard_normal(exact.shape)
    top = np.unravel_index(truth.argmax(), truth.shape)
    for points in (0, 1000 if options.edge_samples is None else options.edge_samples):
        settings = jaxhf.Settings(samples=16, edge_samples=points)
        found, seconds = timed(
            [scene(known)], [target], settings=settings, noise=noise, prior=known, prior_std=0.0003 + known, prior_length=1.0,
            levels=[1.0], uncertainty=options.uncertainty, max_steps=options.max_steps, progress=options.verbose,
        )  # fmt: skip
        highest = np.asarray(found.heights)[top]
        more = {"top at the start": known[top] / truth[top] - 1, "top": highest / truth[top] - 1}
        if found.std is not None:
            more |= {"std of the top": found.std[top] / truth[top]}
        report(f"hill beside the frame, {points} points on edges:", found, truth, seconds, **more)
        if options.out is not None:
            start = jaxhf.render(scene(known), settings)[..., 0]
            kept = {"heights": found.heights, "truth": truth, "start": start, "target": target, "image": found.images[0]}
            np.savez(options.out / f"shadow {points}.npz", **kept)


def pose(options: argparse.Namespace) -> None:
    """Three pictures whose lights and cameras are 1 degree off, the cameras also by 1 % of the terrain's side.

    Pictures alone do not say that: terrain, cameras and lights could turn or move together. So one height in eight is surveyed,
    to 0.5 % of the range; the others are known from a map smoothed over 2 cells. Pictures have 0.2 % noise and 144 samples.
    """
    n, rng = 32, np.random.default_rng(0)
    truth = fractal([n, n], seed=3, exponent=3.0, range=(0.0, 0.1)).astype(options.dtype)
    coarse = smoothed(truth, 2)
    surveyed = np.zeros(truth.shape, bool)
    surveyed[1::4, 1::4] = surveyed[3::4, 3::4] = True
    std = np.where(surveyed, 0.0005, np.std(coarse - truth))
    prior = np.where(surveyed, truth, coarse).astype(options.dtype)
    ground = jaxhf.Object(jaxhf.Heightfield(prior))
    given, taken = [], []
    for eye, towards in zip(((0.5, -0.6, 2.2), (1.5, 1.0, 2.2), (-0.5, 1.0, 2.2)), LIGHTS, strict=False):
        camera = jaxhf.Perspective.look_at(eye, (0.5, 0.5, 0.05), fov=14.0, width=64, height=64)
        step, axis, across = rng.standard_normal((3, 3))
        matrix = rotate(1.0, *axis) @ np.asarray(camera.world_from_camera)
        matrix[:3, 3] = eye + 0.01 * step / np.linalg.norm(step)
        turned = jaxhf.Directional(rotate(1.0, *np.cross(towards, across))[:3, :3] @ towards)
        given.append(jaxhf.Scene([ground], camera, [jaxhf.Directional(towards)]))
        moved = dataclasses.replace(camera, world_from_camera=matrix)
        taken.append(given[-1].with_camera(moved).with_lights([turned]).with_heights(truth))
    exact = [np.asarray(jaxhf.render(scene, jaxhf.Settings(shadows=False, samples=144)))[..., 0] for scene in taken]
    targets = [image + 0.002 * rng.standard_normal(image.shape) for image in exact]
    before = np.sqrt(np.mean((prior - truth) ** 2))
    for name, sought in (("known", {}), ("sought", {"light_std": 1.0, "camera_std": (0.01, 1.0)})):
        found, seconds = timed(
            given, targets, settings=jaxhf.Settings(shadows=False, samples=4), noise=0.002, prior=prior, prior_std=std,
            max_steps=options.max_steps, progress=options.verbose, **sought,
        )  # fmt: skip
        off = [differences(*pair) for pair in zip(found.scenes, taken, strict=True)]
        light, distance, rotation = (float(np.mean(values)) for values in zip(*off, strict=True))
        square = (np.asarray(found.heights, np.float64) - truth) ** 2
        part = found.seen
        more = {
            "prior RMSE/RMSE": before / np.sqrt(np.mean(square)),
            "of seen heights": np.sqrt(np.mean((prior - truth)[part] ** 2) / np.mean(square[part])),
            "light off, degrees": light, "camera off": distance, "turned": rotation,
        }  # fmt: skip
        report(f"lights and cameras off by a degree, {name}:", found, truth, seconds, **more)


def judged(options: argparse.Namespace) -> None:
    """The default call on each case: how much better than what was known before, or whether it warns."""
    definitions = HELD_OUT if options.held_out else CASES
    sources = Sources(options.targets, options.peers, options.hfield)
    names = definitions if options.names is None else options.names
    if unknown := set(names) - set(definitions):
        raise SystemExit(f"there is no case {', '.join(sorted(unknown))} among {', '.join(definitions)}")
    for name in names:
        definition = definitions[name]
        jax.config.update("jax_enable_x64", definition.precision == "float64")
        try:
            case = definition.make(sources)
        except Missing as reason:
            print(f"{name}: skipped, {reason}", flush=True)
            continue
        found, seconds = timed(
            case.scenes, case.targets, uncertainty=options.uncertainty, progress=options.verbose, **case.given
        )
        judge(name, case, found, seconds)
        if options.out is not None:
            kept = {"heights": found.heights, "truth": case.truth, "reference": case.reference, "seen": found.seen}
            np.savez(options.out / f"{name}.npz", **kept, std=0 if found.std is None else found.std)


def judge(name: str, case: Case, found: jaxhf.Fit, seconds: float) -> None:
    error, before = np.asarray(found.heights, np.float64) - case.truth, case.reference - case.truth
    numbers: dict[str, Any] = {}
    for where, mask in (("", np.ones_like(found.seen)), (" seen", found.seen)):
        old, new = (np.sqrt(np.mean(values[mask] ** 2)) for values in (before, error))
        numbers |= {f"before{where}": old, f"after{where}": new, f"ratio{where}": old / new}
    numbers |= {"chi2": found.stats["chi2"], "steps": found.stats["steps"], "seconds": seconds}
    if found.std is not None:
        fitting = found.history[-1].seconds if found.history else 0.0
        numbers |= {"seconds to the last step": fitting, "seconds of deviations": seconds - fitting}
        for k in (1, 2):
            inside = np.abs(error) <= k * found.std
            numbers |= {f"within {k} std": np.mean(inside), f"within {k} std seen": np.mean(inside[found.seen])}
    verdict = "beats by 3" if numbers["ratio"] >= 3 else "warns" if found.warnings else "SILENT"
    print(f"{name}: {verdict} |", ", ".join(f"{key} {value:.3g}" for key, value in numbers.items()), "|", found.result.value)
    for warning in found.warnings:
        print(f"  {warning}")
    sys.stdout.flush()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("case", choices=("flat", "common", "jacksboro", "shadow", "pose", "cases"))
    parser.add_argument(
        "--targets", type=Path, help="Mitsuba's pictures, an .npz file [cases: a folder]; made where they are not there"
    )
    parser.add_argument("--names", nargs="+", help=f"of cases [all: {', '.join(CASES)}]; one a process for times")
    parser.add_argument("--held-out", action="store_true", help="cases that were not looked at while the fit was built")
    parser.add_argument(
        "--hfield",
        type=Path,
        help="assets/hfield.png in the folder mujoco_playground/_src/locomotion/go1/xmls of the wheel that "
        "pip download --no-deps playground fetches",
    )
    parser.add_argument("--parts", nargs="+", default=[f"{row},{column}" for row, column in CORNERS], help="of Jacksboro")
    parser.add_argument("--independent", action="store_true", help="a prior of jacksboro whose errors are independent")
    parser.add_argument("--out", type=Path, help="a folder for what jacksboro, shadow and cases find, as .npz")
    parser.add_argument("--peers", type=Path, help="folder of common_work.py and of its targets")
    parser.add_argument("--camera", default="D", choices=("A", "B", "C", "D"))
    parser.add_argument("--size", type=int, default=64, help="heights a side of the common recovery")
    parser.add_argument("--pixels", type=int, default=128)
    parser.add_argument("--light", default="std", choices=("std", "low"))
    parser.add_argument("--images", type=int, default=4)
    parser.add_argument("--samples", type=int, default=4)
    parser.add_argument("--edge-samples", type=int, help="a picture [shadow: 1000, common: none]")
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
    makers = {"flat": flat, "common": common, "jacksboro": jacksboro, "shadow": shadow, "pose": pose, "cases": judged}
    makers[options.case](options)


if __name__ == "__main__":
    main()
