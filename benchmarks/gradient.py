"""Accuracy and time of the picture's derivative with respect to heights, with and without moving boundaries.

Accuracy: on the common work of `--peers` (a folder with common_work.py), 64 x 64 bumps, 128 x 128 pixels. For camera B in low
light its gradient_B_low.npz is the reference, central differences of another renderer; for other views it is made here, by
central differences of our own picture with `--fine` samples a pixel, at two steps whose difference is printed as its error.
Medians over the directions: cosine and relative error, and the noise of the edge points alone, from two keys.

Cost: value and gradient of a loss against the plain frame, interleaved; with `--mitsuba` also against its integrators `direct`
and `direct_projective`.

With `--precision` the derivative in single precision against that in double, direction by direction, with the same key: the
difference relative to the norm, the cosine, the pixel that differs most relative to the largest, and how many pixels hold 99 %
of the squared difference.

With `--mitsuba` its `direct_projective` integrator is held against the same reference, and timed.
"""

import argparse
import itertools
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import benchmark
import jax
import jax.numpy as jnp
import numpy as np
from forward import report
from peers import MitsubaScene, common_work, mitsuba_scene, need_fast_mitsuba

import jaxhf

PIXELS, VERTICES = 128, 64
LEAST = ((100_000, 0.99), (10_000, 0.94))  # cosine from so many points on: docs/measurements/gradients.md has 0.997 and 0.955


def make_scene(work: Any, heights: Any, camera: str, light: str, pixels: int) -> jaxhf.Scene:
    eye, target, fov = work.CAMERAS[camera]
    return jaxhf.Scene(
        [jaxhf.Object(jaxhf.Heightfield(jnp.asarray(heights)), jaxhf.Matte(work.ALBEDO))],
        jaxhf.Perspective.look_at(eye, target, fov=fov, width=pixels, height=pixels),
        [jaxhf.Directional(work.light(light))],
    )


def central_differences(scene: jaxhf.Scene, directions: dict[str, np.ndarray], fine: int, step: float) -> dict[str, np.ndarray]:
    """d picture / d direction at one step."""
    settings = jaxhf.Settings(normals="six-angle", samples=fine)

    def at(heights: Any) -> np.ndarray:
        return np.asarray(jaxhf.render(scene.with_heights(heights), settings)[..., 0])

    return {
        name: (at(scene.heights + step * direction) - at(scene.heights - step * direction)) / (2 * step)
        for name, direction in directions.items()
    }


def compare(rows: list[np.ndarray], reference: list[np.ndarray]) -> tuple[float, float]:
    """Median cosine and relative error."""
    cosines = [np.vdot(a, b) / np.linalg.norm(a) / np.linalg.norm(b) for a, b in zip(rows, reference, strict=True)]
    errors = [np.linalg.norm(a - b) / np.linalg.norm(b) for a, b in zip(rows, reference, strict=True)]
    return float(np.median(cosines)), float(np.median(errors))


def accuracy(run: benchmark.Run, work: Any, options: argparse.Namespace, camera: str, light: str) -> None:
    heights, directions = work.bumps(VERTICES)
    npz = options.peers / f"gradient_{camera}_{light}.npz"
    stored = np.load(npz) if npz.exists() else None
    names = [name for name in directions if name in np.load(options.peers / "gradient_B_low.npz")]
    directions = {name: directions[name] for name in names}
    scene = make_scene(work, heights, camera, light, PIXELS)
    if stored is None:
        wide, narrow = (central_differences(scene, directions, options.fine, step) for step in (0.01, 0.005))
        reference = [narrow[name] for name in names]
        _, doubt = compare([wide[name] for name in names], reference)
        origin = f"central differences, {options.fine} samples a pixel; a step twice as long differs by {doubt:.3f}"
    else:
        reference, origin = [np.asarray(stored[name], float) for name in names], npz.name
    title = f"camera {camera}, {light} light"
    print(f"{title}, against {origin}")
    for samples in options.samples:
        for count in options.edge_samples:
            settings = jaxhf.Settings(normals="six-angle", samples=samples, edge_samples=count)

            def picture(heights: jax.Array, key: jax.Array, settings: jaxhf.Settings = settings) -> jax.Array:
                return jaxhf.render(scene.with_heights(heights), settings, key=key)[..., 0]

            @jax.jit
            def along(direction: jax.Array, key: jax.Array, picture: Any = picture) -> jax.Array:
                return jax.jvp(lambda heights: picture(heights, key), (scene.heights,), (direction,))[1]

            gradient = jax.jit(jax.value_and_grad(lambda heights, key, picture=picture: jnp.sum(picture(heights, key) ** 2)))
            one, two = ([np.asarray(along(d, jax.random.key(k))) for d in directions.values()] for k in (0, 1))
            cosine, error = compare(one, reference)
            noise = np.median([np.linalg.norm(a - b) / np.linalg.norm(b) / np.sqrt(2) for a, b in zip(one, two, strict=True)])
            row = {"samples": samples, "points": count, "cosine": cosine, "error": error, "noise": float(noise)}
            if not options.untimed:
                times = benchmark.seconds(lambda gradient=gradient: gradient(scene.heights, jax.random.key(0)), 5)
                row["value and gradient, ms"] = 1e3 * float(np.median(times))
            run.row(title, row)
            least = next((least for points, least in LEAST if points <= count), None)
            if least and samples >= 16:
                run.claim(cosine >= least, f"{title}, {count} points: a cosine of {cosine:.4f}, at least {least}")
    if options.mitsuba:
        rows, ms = mitsuba(work, heights, directions, camera, light, options.mitsuba)
        cosine, error = compare(rows, reference)
        run.row(
            f"{title}, Mitsuba", {"samples": options.mitsuba, "cosine": cosine, "error": error, "value and gradient, ms": ms}
        )


def precision(run: benchmark.Run, work: Any, options: argparse.Namespace, camera: str, light: str) -> None:
    """Single against double precision, for every direction."""
    heights, directions = work.bumps(VERTICES)
    names = [name for name in directions if name in np.load(options.peers / "gradient_B_low.npz")]
    stacked = np.stack([directions[name] for name in names])
    settings = jaxhf.Settings(normals="six-angle", samples=options.samples[-1], edge_samples=options.edge_samples[-1])

    def derivatives(dtype: Any, key: int) -> np.ndarray:
        scene = make_scene(work, heights, camera, light, PIXELS)
        scene = jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype), scene)

        @jax.jit
        def along(direction: jax.Array, key: jax.Array) -> jax.Array:
            def picture(heights: jax.Array) -> jax.Array:
                return jaxhf.render(scene.with_heights(heights), settings, key=key)[..., 0]

            return jax.jvp(picture, (scene.heights,), (direction,))[1]

        rows = [along(jnp.asarray(direction, dtype), jax.random.key(key)) for direction in stacked]
        assert all(row.dtype == dtype for row in rows)
        return np.stack(rows).astype(float)

    for key in range(options.keys):
        title = f"camera {camera}, {light} light, {settings.edge_samples} points, key {key}"
        for name, a, b in zip(names, derivatives(np.float64, key), derivatives(np.float32, key), strict=True):
            squares = np.sort(((b - a) ** 2).ravel())[::-1]
            pixels = int(np.searchsorted(np.cumsum(squares), 0.99 * squares.sum())) + 1
            cosine, difference = compare([b], [a])
            worst = np.abs(b - a).max() / np.abs(a).max()
            row = {"float32 differs by": difference, "cosine": cosine, "worst pixel": float(worst), "99 % in": pixels}
            run.row(f"{title}, {name}", row)
            run.claim(cosine > 0.9, f"{title}, {name}: single precision has a cosine of {cosine:.3f} with double, above 0.9")


def interior(run: benchmark.Run, work: Any, options: argparse.Namespace, camera: str, light: str) -> None:
    """The error of the interior derivative alone, against that of `--fine` samples: of n x n samples everywhere, and with 8 x 8
    where a boundary was seen."""
    heights, directions = work.bumps(VERTICES)
    names = ["scale_all", "amp0", "amp17", "xshift0"]
    scene = make_scene(work, heights, camera, light, PIXELS)

    def derivatives(samples: int, edge_samples: int = 0) -> np.ndarray:
        settings = jaxhf.Settings(normals="six-angle", samples=samples, edge_samples=edge_samples)

        @jax.jit
        def along(direction: jax.Array) -> jax.Array:
            return jax.jvp(lambda z: jaxhf.render(scene.with_heights(z), settings)[..., 0], (scene.heights,), (direction,))[1]

        return np.stack([np.asarray(along(directions[name])) for name in names])

    reference, finer = derivatives(options.fine), derivatives(64)
    size = np.linalg.norm(reference, axis=(1, 2))
    plain = {samples: derivatives(samples) for samples in (1, 4, 16)}
    seen = (derivatives(1, options.edge_samples[-1]) != plain[1]).any(0)  # moved, or looked at again
    title = f"camera {camera}, {light} light, against {options.fine} samples"

    def report_errors(label: str, rays: float, rows: np.ndarray) -> None:
        errors = np.linalg.norm(rows - reference, axis=(1, 2)) / size
        run.row(f"{title}, {label}", {"samples a pixel": rays} | dict(zip(names, errors.tolist(), strict=True)))

    for samples, rows in plain.items():
        report_errors("everywhere alike", samples, rows)
        report_errors("8 x 8 where boundaries were seen", samples + 64 * seen.mean(), np.where(seen, finer, rows))
    report_errors("everywhere alike", 64, finer)


def mitsuba(
    work: Any, heights: np.ndarray, directions: dict[str, np.ndarray], camera: str, light: str, samples: int
) -> tuple[list[np.ndarray], float]:
    """Its derivatives by `direct_projective`, and the time of one step: new heights, picture, gradient of a loss."""
    dr, mi, scene, parameters, base = made = mitsuba_scene(
        heights, work.CAMERAS[camera], work.light(light), PIXELS, "direct_projective", samples, work.ALBEDO
    )
    place = made.place

    rows = []
    for direction in directions.values():
        z = mi.Float(0.0)
        dr.enable_grad(z)
        offset = np.zeros((heights.size, 3), np.float32)
        offset[:, 2] = direction.ravel()
        parameters[place] = mi.Float(base) + z * mi.Float(offset.ravel())
        parameters.update()
        image = mi.render(scene, parameters, spp=samples)
        dr.forward(z)
        rows.append(np.array(dr.grad(image))[..., 0].astype(float))
    step, seeds = mitsuba_step(made, samples), itertools.count()
    return rows, 1e3 * float(np.median(benchmark.seconds(lambda: step(next(seeds)), 5)))


def mitsuba_step(made: MitsubaScene, samples: int) -> Callable[[int], None]:
    """New heights, picture, gradient of a loss in every vertex; takes a seed."""
    dr, mi = made.dr, made.mi

    def step(seed: int) -> None:
        positions = mi.Float(made.positions)
        dr.enable_grad(positions)
        made.parameters[made.place] = positions
        made.parameters.update()
        image = mi.render(made.scene, made.parameters, spp=samples, seed=seed)
        dr.backward(dr.sum(image * image, axis=None))
        dr.eval(dr.grad(positions))
        dr.sync_thread()

    return step


def cost(run: benchmark.Run, work: Any, options: argparse.Namespace) -> None:
    side, pixels, samples = options.cost, options.cost_pixels, options.cost_samples
    heights = work.bumps(side)[0].astype(np.float32)
    scene = make_scene(work, heights, "B", "low", pixels)

    def loss(heights: jax.Array, key: jax.Array, settings: jaxhf.Settings) -> jax.Array:
        return jnp.sum(jaxhf.render(scene.with_heights(heights), settings, key=key) ** 2)

    def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
        return jax.jit(function, compiler_options=jaxhf.compiler_options())

    key = jax.random.key(0)
    frame = compiled(lambda heights: jaxhf.render(scene.with_heights(heights), jaxhf.Settings(samples=samples)))
    variants: dict[str, Callable[[], object]] = {"frame": lambda: jax.block_until_ready(frame(scene.heights))}
    for count in options.edge_samples:
        settings = jaxhf.Settings(samples=samples, edge_samples=count)
        step = compiled(jax.value_and_grad(lambda heights, key, s=settings: loss(heights, key, s)))
        variants[f"value and gradient, {count} points"] = lambda step=step: jax.block_until_ready(step(scene.heights, key))
    if options.mitsuba:
        for integrator in ("direct", "direct_projective"):
            made = mitsuba_scene(heights, work.CAMERAS["B"], work.light("low"), pixels, integrator, samples, work.ALBEDO)
            step = mitsuba_step(made, samples)
            variants[f"value and gradient, Mitsuba, {integrator}"] = lambda step=step: step(0)
    title = f"{side} x {side} heights, {pixels} x {pixels} pixels, {samples} samples, camera B, low light, float32"
    report(run, title, variants, repeats=9)


def main() -> None:
    claims = (
        "with 16 samples cosines with the true derivative of 0.94 from 10 000 points on and 0.99 from 100 000, in float32 0.9"
    )
    run = benchmark.Run(__doc__, needs="the folder --peers; for --mitsuba Mitsuba with LLVM's library", claims=claims)
    parser = run.parser
    parser.add_argument("--peers", type=Path, required=True, help="folder of common_work.py and gradient_B_low.npz")
    parser.add_argument("--views", nargs="*", default=["B-low", "A-low", "A-std"], help="camera and light")
    parser.add_argument("--samples", type=int, nargs="*", default=[16], help="of the picture, a pixel")
    parser.add_argument("--edge-samples", type=int, nargs="*", default=[0, 10000, 100000])
    parser.add_argument("--fine", type=int, default=48 * 48, help="samples a pixel of the differences made here")
    parser.add_argument("--cost", type=int, default=256, help="heights a side; 0: leave it out")
    parser.add_argument("--cost-pixels", type=int, default=256, help="a side (256)")
    parser.add_argument("--cost-samples", type=int, default=1, help="a pixel (1)")
    parser.add_argument("--interior", action="store_true", help="the interior derivative's error, in place of the whole's")
    parser.add_argument("--precision", action="store_true", help="float32 against float64, in place of either's accuracy")
    parser.add_argument("--keys", type=int, default=1, help="of random numbers, for --precision")
    parser.add_argument("--untimed", action="store_true", help="accuracy alone, where the machine is not quiet")
    parser.add_argument("--mitsuba", type=int, default=0, metavar="SAMPLES")
    parser.add_argument("--devices", type=int, default=len(os.sched_getaffinity(0)), help="of the CPU")
    options = run.parse()
    if missing := [name for name in ("common_work.py", "gradient_B_low.npz") if not (options.peers / name).is_file()]:
        benchmark.refuse(f"{options.peers} has no {missing[0]}")
    if options.mitsuba:
        need_fast_mitsuba()
    jax.config.update("jax_num_cpu_devices", options.devices)
    work = common_work(options.peers)
    if options.cost:
        cost(run, work, options)
    jax.config.update("jax_enable_x64", True)
    measured = precision if options.precision else interior if options.interior else accuracy
    for view in options.views:
        measured(run, work, options, *view.split("-"))


if __name__ == "__main__":
    main()
