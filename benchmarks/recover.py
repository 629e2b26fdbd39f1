"""Recovers terrains from pictures and prints how near to the truth, and in what time.

`jacksboro`: the case of this name, with a prior from a survey of the land around it. `shadow`: a hill that no picture shows,
from its shadow. `pose`: lights and cameras that are off by a degree, taken as known and sought. `scale`: how time and memory
grow with the heights. `cases`: what the default call makes of the cases of cases.py, beside docs/measurements/fit-cases.csv,
or with `--held-out` of cases that held_out.py draws in this run; coverage is judged with `--draws`. One case a process: times
include compilation, as a user meets it.
"""

import argparse
import csv
import dataclasses
import json
import os
import re
import secrets
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import benchmark
import jax
import numpy as np
import scipy.optimize
from cases import CASES, LIGHTS, Case, Definition, Missing, Sources, map_of, names_of, noisy, smoothed, times_nearer, viewed
from held_out import held_out
from peers import common_work

import jaxhf
from jaxhf.core.affine import rotate
from jaxhf.fitting.model.unknowns import differences
from jaxhf.scene.procedural import fractal
from jaxhf.xla.machine import peak_mb

FEWER = 1.5  # times less than the table's ratio is what a case may reach
APART = (10, 6)  # percent by which the shares within one and two deviations may differ from the table's
Bounds = tuple[float, list[int]]  # of a case of the table: its ratio, and these shares
STEEPEST = 1.1  # power of the number of heights with which a fit's time may grow
FROM = 256  # heights a side from which that is judged: of smaller terrains time is mostly compilation


def report(run: benchmark.Run, name: str, found: jaxhf.Fit, truth: np.ndarray, seconds: float, **more: Any) -> None:
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
        "peak MB": peak_mb(),
        **more,
    }
    run.row(name, numbers | {"end": found.result.value})


def timed(*arguments: Any, **options: Any) -> tuple[jaxhf.Fit, float]:
    begin = time.perf_counter()
    found = jaxhf.fit(*arguments, **options)
    return found, time.perf_counter() - begin


CELLS = 8  # over which the map was smoothed: standard deviation of a Gaussian


def jacksboro(run: benchmark.Run, options: argparse.Namespace) -> None:
    """The case of this name with a prior of the deviation and the length of what maps like it miss elsewhere."""
    try:
        case = CASES["jacksboro"].make(Sources(options.targets))
    except Missing as reason:
        benchmark.refuse(f"jacksboro: {reason}")
    terrain = jaxhf.jacksboro()
    whole = terrain.heights.astype(np.float64)
    spread, length = _missing(whole, smoothed(whole, CELLS), np.s_[100:228, 100:228])
    prior = jaxhf.Prior(case.reference, spread, length * np.sqrt(terrain.dx * terrain.dy))
    found, seconds = timed(
        case.scenes, case.targets, max_steps=options.max_steps, draws=options.draws, progress=options.verbose,
        **case.given | {"prior": prior},
    )  # fmt: skip
    error = np.asarray(found.heights, np.float64) - case.truth
    ratio, least = np.sqrt(np.mean((case.reference - case.truth) ** 2) / np.mean(error**2)), table()["jacksboro"][0] / FEWER
    more = {"prior RMSE/RMSE": ratio, "std of the prior": spread, "length in cells": length}
    report(run, "jacksboro with a surveyed prior", found, case.truth, seconds, **more)
    run.claim(ratio >= least, f"jacksboro with a surveyed prior: {ratio:.3g} times nearer than the map, at least {least:.3g}")


def _missing(whole: np.ndarray, coarse: np.ndarray, part: Any) -> tuple[float, float]:
    """What such a map misses, from a survey of all but this part of the terrain.

    The Fourier amplitudes of what it misses are taken from tiles of the part's size, under a Hann window, without which the
    jump between opposite borders would pass for high frequencies.

    Returns:
      The std and the length (in cells) of a `jaxhf.Prior`.
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
        return (amplitude - (x[0] - np.log1p(np.exp(2 * x[1]) * square))) / np.sqrt(square)

    _, length = scipy.optimize.least_squares(off, [amplitude[0], np.log(CELLS / 1.4)]).x
    return float(np.sqrt(np.mean(error[rest] ** 2))), float(np.exp(length))


def shadow(run: benchmark.Run, options: argparse.Namespace) -> None:
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
            [scene(known)], [target], settings=settings, noise=noise, prior=jaxhf.Prior(known, 0.0003 + known, 1.0),
            draws=options.draws, max_steps=options.max_steps, progress=options.verbose,
        )  # fmt: skip
        highest = np.asarray(found.heights)[top]
        more = {"top at the start": known[top] / truth[top] - 1, "top": highest / truth[top] - 1}
        if points:
            run.claim(abs(more["top"]) < 0.02, f"with {points} points the top is off by {more['top']:.2%}, at most 2 %")
        else:
            run.claim(more["top"] < -0.38, f"without points the top stays where it was, -40 %, and is at {more['top']:.2%}")
        if found.std is not None:
            more |= {"std of the top": found.std[top] / truth[top]}
        report(run, f"hill beside the frame, {points} points on edges", found, truth, seconds, **more)


def pose(run: benchmark.Run, options: argparse.Namespace) -> None:
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
    for name, sought in (("known", None), ("sought", jaxhf.Unknown(light_std=1.0, camera_std=(0.01, 1.0)))):
        found, seconds = timed(
            given, targets, settings=jaxhf.Settings(shadows=False, samples=4), noise=0.002, prior=jaxhf.Prior(prior, std),
            unknown=sought, max_steps=options.max_steps, progress=options.verbose,
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
        if sought is not None:
            nearer = more["of seen heights"]
            run.claim(nearer > 1.5, f"with lights and cameras sought, heights are {nearer:.3g} times nearer, at least 1.5")
            run.claim(light < 0.3, f"lights that were off by 1 degree end {light:.2g} degrees off, at most 0.3")
        report(run, f"lights and cameras off by a degree, {name}", found, truth, seconds, **more)


def scale(run: benchmark.Run, options: argparse.Namespace) -> None:
    """The terrain of the common work at several sizes, from three of our own pictures and a map; a process for each size.

    Pictures have a pixel a height, 64 samples a pixel and 1 % noise, of which the fit is not told. The map is the terrain
    smoothed over 8 cells, and its deviation is known.
    """
    if options.peers is None:
        benchmark.refuse("scale: it needs --peers, the folder of common_work.py")
    work, counts, times = common_work(options.peers), [], []
    for size in options.sizes:
        truth = work.terrain(size).astype(np.float64)
        exact = [jaxhf.render(scene, jaxhf.Settings(samples=64)) for scene in _common_scenes(work, truth)]
        targets, _ = noisy(np.stack([np.asarray(image)[..., 0] for image in exact]))
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "pictures.npz"
            np.savez(path, truth=truth, targets=targets)
            command = [sys.executable, __file__, *sys.argv[1:], "--child", str(path)]
            made = json.loads(subprocess.check_output(command, text=True))
        run.row(f"{size} x {size} heights", made)
        counts, times = [*counts, size**2], [*times, made["seconds"]]
    judged_sizes = [k for k, count in enumerate(counts) if count >= FROM**2]
    if len(judged_sizes) > 1:
        along, taken = (np.log([values[k] for k in judged_sizes]) for values in (counts, times))
        power, _ = np.polyfit(along, taken, 1)
        run.claim(power <= STEEPEST, f"time grows as heights ** {power:.3g} from {FROM}² on, at most {STEEPEST}")
        run.row(f"from {FROM}² on", {"power of the heights with which time grows": power})


def _common_scenes(work: Any, heights: np.ndarray) -> list[jaxhf.Scene]:
    """The view D of the common work under three lights, with as many pixels as heights."""
    (eye, target, fov), n, lights = work.CAMERAS["D"], len(heights), work.turned_lights("std", 4)[:3]
    ground = jaxhf.Object(jaxhf.Heightfield(heights.astype(np.float32)), jaxhf.Matte(work.ALBEDO))
    camera = jaxhf.Perspective.look_at(eye, target, fov=fov, width=n, height=n)
    return viewed(ground, [camera] * len(lights), [jaxhf.Directional(towards) for towards in lights])


def scaled(options: argparse.Namespace) -> dict[str, float | str]:
    """One size of `scale`, whose pictures a file has."""
    with np.load(options.child) as kept:
        truth, targets = kept["truth"], kept["targets"]
    prior = map_of(truth, CELLS)
    scenes = _common_scenes(common_work(options.peers), prior.heights)
    if options.window is not None:
        return windowed(scenes, list(targets), prior, truth, options)
    found, seconds = timed(scenes, list(targets), prior=prior, draws=options.draws, progress=options.verbose)
    ratio = times_nearer(prior, found.heights, truth)
    numbers = {"seconds": seconds, "peak MB": peak_mb(), "steps": found.stats["steps"], "ratio": ratio}
    return numbers | {"chi2": found.stats["chi2"], "end": found.result.value, "warns of": "; ".join(names_of(found.warnings))}


def windowed(
    scenes: list[jaxhf.Scene], targets: list[np.ndarray], prior: jaxhf.Prior, truth: np.ndarray, options: argparse.Namespace
) -> dict[str, float | str]:
    """The same by `fit_windows`; seams as shares of the map's error."""
    begin = time.perf_counter()

    def tell(done: int, count: int, _: object) -> None:
        if options.verbose:
            print(f"{done} of {count} windows, {time.perf_counter() - begin:.0f} s", file=sys.stderr, flush=True)

    found = jaxhf.fit_windows(scenes, targets, prior=prior, window=options.window, draws=options.draws, progress=tell)
    seconds = time.perf_counter() - begin
    seams = np.array([window.seam for window in found.windows]) / prior.std
    return {
        "seconds": seconds, "peak MB": peak_mb(), "windows": len(found.windows),
        "ratio": times_nearer(prior, found.heights, truth),
        "median chi2": float(np.nanmedian([window.chi2 for window in found.windows])),
        "median seam": float(np.nanmedian(seams)), "largest seam": float(np.nanmax(seams)),
        "warns of": "; ".join(sorted({name for window in found.windows for name in names_of(window.warnings)})),
    }  # fmt: skip


def judged(run: benchmark.Run, options: argparse.Namespace) -> None:
    """The default call on each case, beside what the table says of it, or on cases that are drawn now."""
    definitions, bounds = CASES, table()
    if options.held_out:
        seed = secrets.randbelow(2**32) if options.seed is None else options.seed
        print(f"drawn from --seed {seed}", flush=True)
        definitions, bounds = held_out(seed, options.count), {}
    sources = Sources(options.targets, options.peers, options.hfield)
    names = definitions if options.names is None else options.names
    if unknown := set(names) - set(definitions):
        benchmark.refuse(f"there is no case {', '.join(sorted(unknown))} among {', '.join(definitions)}")
    for name in names:
        definition = definitions[name]
        jax.config.update("jax_enable_x64", definition.precision == "float64")
        try:
            case = definition.make(sources)
        except Missing as reason:
            run.skip(name, reason)
            continue
        found, seconds = timed(case.scenes, case.targets, draws=options.draws, progress=options.verbose, **case.given)
        judge(run, name, definition, case, found, seconds, bounds.get(name))
        if options.out is not None:
            kept = {"heights": found.heights, "truth": case.truth, "reference": case.reference, "seen": found.seen}
            np.savez(options.out / f"{name}.npz", **kept, std=0 if found.std is None else found.std)


def table() -> dict[str, Bounds]:
    """For each case the ratio and the percents within one and two deviations, of docs/measurements/fit-cases.csv."""
    lines = (Path(__file__).parents[1] / "docs/measurements/fit-cases.csv").read_text().splitlines()
    rows = csv.DictReader(line for line in lines if not line.startswith("#"))
    within = "within 1, 2 deviations"
    return {row["case"].strip("`"): (float(row["ratio"]), [int(n) for n in re.findall(r"\d+", row[within])]) for row in rows}


def judge(
    run: benchmark.Run, name: str, definition: Definition, case: Case, found: jaxhf.Fit, seconds: float, bounds: Bounds | None
) -> None:
    """A case must be as near as the table says, within `FEWER` and `APART`; one that was drawn three times nearer than its map.

    To warn excuses nothing, and only cases of the table that say so may warn, of what they say.
    """
    error, before = np.asarray(found.heights, np.float64) - case.truth, case.reference - case.truth
    numbers: dict[str, Any] = {}
    for where, mask in (("", np.ones_like(found.seen)), (" seen", found.seen)):
        old, new = (np.sqrt(np.mean(values[mask] ** 2)) for values in (before, error))
        numbers |= {f"before{where}": old, f"after{where}": new, f"ratio{where}": old / new}
    numbers |= {"chi2": found.stats["chi2"], "steps": found.stats["steps"], "seconds": seconds}
    ratio, expected = (3.0, []) if bounds is None else (bounds[0] / FEWER, bounds[1])
    silent = "" if found.warnings else ", and it does not warn"
    run.claim(numbers["ratio"] >= ratio, f"{name}: {numbers['ratio']:.3g} times nearer, at least {ratio:.3g}{silent}")
    if found.std is not None:
        fitting = found.history[-1].seconds if found.history else 0.0
        numbers |= {"seconds to the last step": fitting, "seconds of deviations": seconds - fitting}
        shares = [100 * float(np.mean(np.abs(error) <= k * found.std)) for k in (1, 2)]
        numbers |= {f"within {k} std, %": share for k, share in enumerate(shares, 1)}
        for share, wanted, apart in zip(shares, expected, APART, strict=False):
            run.claim(abs(share - wanted) <= apart, f"{name}: deviations hold {share:.0f} %, {wanted} within {apart}")
    names = names_of(found.warnings)
    if bounds is not None:
        others = [warning for warning in names if warning not in definition.warns]
        run.claim(not others, f"{name}: warns of {others}, and may of {list(definition.warns)}")
    run.row(name, numbers | {"end": found.result.value, "warns of": "; ".join(names)})
    for warning in found.warnings:
        print(f"  {warning}", flush=True)


def main() -> None:
    run = benchmark.Run(
        __doc__,
        needs="matplotlib for jacksboro and cases, and Mitsuba for pictures that --targets does not have "
        "(slowly without LLVM's library)",
        claims="bounds of the heights' errors; of cases ratio, coverage and warnings as "
        "docs/measurements/fit-cases.csv and cases.py have them, of drawn ones a ratio of 3",
    )
    parser = run.parser
    parser.add_argument("case", choices=("jacksboro", "shadow", "pose", "scale", "cases"))
    parser.add_argument("--targets", type=Path, help="a folder of Mitsuba's pictures; made where they are not there")
    parser.add_argument("--names", nargs="+", help=f"of cases [all: {', '.join(CASES)}]; one a process for times")
    parser.add_argument("--held-out", action="store_true", help="cases that are drawn now, and that nobody has looked at")
    parser.add_argument("--seed", type=int, help="of the cases that are drawn, to repeat a run [another one in each run]")
    parser.add_argument("--count", type=int, default=4, help="how many cases are drawn")
    parser.add_argument(
        "--hfield", type=Path, help="mujoco_playground/_src/locomotion/go1/xmls/assets/hfield.png of PyPI's wheel of playground"
    )
    parser.add_argument("--out", type=Path, help="a folder for what cases find, as .npz")
    parser.add_argument(
        "--peers", type=Path, help="folder of common_work.py and targets_D_std.npz, for scale and cases common-4, common-1"
    )
    parser.add_argument(
        "--sizes", type=int, nargs="+", default=[64, 128, 256, 512], help="heights a side, for scale [64 128 256 512]"
    )
    parser.add_argument("--window", type=int, help="heights a side of the windows in which scale fits its terrain")
    parser.add_argument("--edge-samples", type=int, help="a picture [shadow: 1000]")
    parser.add_argument("--max-steps", type=int, default=100)
    parser.add_argument("--draws", type=int, default=0, help="of the standard deviations")
    parser.add_argument("--precision", default="float64", choices=("float32", "float64"))
    parser.add_argument("--devices", type=int, default=len(os.sched_getaffinity(0)))
    parser.add_argument("--verbose", action="store_true")
    parser.add_argument("--child", type=Path, help=benchmark.HIDDEN)
    options = run.parse()
    if options.case in ("jacksboro", "cases"):
        benchmark.need("matplotlib")
    jax.config.update("jax_enable_x64", options.precision == "float64" and options.case != "scale")
    jax.config.update("jax_num_cpu_devices", options.devices)
    options.dtype = np.dtype(options.precision)
    if options.child is not None:
        print(json.dumps(scaled(options)))
        return
    makers = {"jacksboro": jacksboro, "shadow": shadow, "pose": pose, "scale": scale, "cases": judged}
    makers[options.case](run, options)
    run.end()


if __name__ == "__main__":
    main()
