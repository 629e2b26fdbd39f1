"""Times one frame, from changed heights to image: 512 x 512 pixels, one sample, smooth normals, a light with shadows.

"prepared" leaves out what a frame of new heights needs first: their normals and bounds.

The variants are run in turn, several times and each time in another order, so that neither a machine whose speed drifts nor
what one leaves to the next favours one, and each twice in a row, as frame after frame: the second counts. Medians are
printed, and the ratio to the first variant, pair by pair. With `--mitsuba` the same terrain is also rendered by Mitsuba 3's
`direct` integrator, with `--embree` by Embree and NumPy, with `--povray` by POV-Ray.
"""

import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import benchmark
import jax
import jax.numpy as jnp
import numpy as np
from peers import embree_frame, mitsuba_scene, need_fast_mitsuba, povray_seconds

import jaxhf
from jaxhf.core.vector import dot, unit
from jaxhf.preparation.ceiling import clears
from jaxhf.preparation.localise import localise
from jaxhf.preparation.world import first_hit, make_world, resolve_settings
from jaxhf.rendering.tiles import Tiling, pixels_from
from jaxhf.scene.procedural import fractal

CAMERAS = {  # eye, target, field of view: a fifth of the picture covered, all of it covered
    "A": ((1.2, -0.9, 0.7), (0.5, 0.5, 0.05), 45.0),
    "B": ((0.5, -0.1, 0.75), (0.5, 0.5, 0.05), 34.0),
}
LIGHTS = {"A": (0.5, -0.3, 0.6), "B": (0.8, 0.1, 0.3)}
PIXELS = 512
# Ratios of docs/measurements/mitsuba.csv over both cameras, and a third more: of new heights, and of a frame.
MITSUBA = {64: (0.95, 1.4), 256: (0.35, 1.4), 1024: (0.14, 0.7)}


def terrain(size: int) -> np.ndarray:
    return fractal([size, size], seed=0, exponent=2.2, range=(0.0, 0.25)).astype(np.float32)


def scene(heights: np.ndarray, camera: str) -> jaxhf.Scene:
    eye, target, fov = CAMERAS[camera]
    return jaxhf.Scene(
        objects=[jaxhf.Object(jaxhf.Heightfield(heights), jaxhf.Matte(0.7))],
        camera=jaxhf.Perspective.look_at(eye, target, fov=fov, width=PIXELS, height=PIXELS),
        lights=[jaxhf.Directional(LIGHTS[camera])],
    )


def ours(heights: np.ndarray, camera: str, settings: jaxhf.Settings) -> Callable[[], object]:
    base = scene(heights, camera)
    return lambda: jax.block_until_ready(jaxhf.render(base, settings))


def prepared(heights: np.ndarray, camera: str) -> Callable[[], object]:
    """Without the normals and bounds of the heights, as Mitsuba's frame."""
    ready = jaxhf.prepare(scene(heights, camera))
    return lambda: jax.block_until_ready(jaxhf.render(ready))


def inside(heights: np.ndarray, camera: str) -> dict[str, Callable[[], object]]:
    """Pictures of given heights within programs of one's own."""
    base, one = scene(heights, camera), jnp.asarray(heights)
    four = jnp.stack([one] * 4)

    def picture(heights: jax.Array) -> jax.Array:
        return jaxhf.render(base.with_heights(heights))

    def timed(fun: Callable[[jax.Array], jax.Array], argument: jax.Array, **options: Any) -> Callable[[], object]:
        compiled = jax.jit(fun, **options)
        return lambda: jax.block_until_ready(compiled(argument))

    return {
        "in jit": timed(picture, one),
        "in jit, with compiler_options": timed(picture, one, compiler_options=jaxhf.compiler_options()),
        "four in scan": timed(lambda four: jax.lax.map(picture, four), four),
        "four in vmap": timed(jax.vmap(picture), four),
    }


def shadow_rays(heights: np.ndarray, camera: str) -> tuple[float, float]:
    """Of the shadow rays the share that has to walk, and of the tiles with shadow rays that in which one does."""
    seen = scene(heights, camera)
    settings = resolve_settings(jaxhf.Settings(), seen)

    @jax.jit
    def judge(seen: jaxhf.Scene) -> tuple[jax.Array, jax.Array]:
        world, wi = make_world(seen, settings), unit(jnp.asarray(LIGHTS[camera], heights.dtype))
        tiling, (_, grid, _), ceiling = (
            Tiling(seen.camera.width, seen.camera.height, settings),
            world.grids[0],
            world.ceilings[0][0],
        )
        assert ceiling is not None

        def one(x: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array]:
            hit = first_hit(world, seen.camera.ray(x + 0.5, y + 0.5))
            wanted = (hit.object == 0) & (dot(wi, hit.n) * hit.side > 0)
            return wanted, wanted & ~clears(ceiling, grid, 0, hit)

        def tile(corner: jax.Array) -> tuple[jax.Array, jax.Array]:
            return jax.vmap(one)(*(place.astype(heights.dtype) for place in pixels_from(corner, tiling.side)))

        return jax.lax.map(tile, tiling.corners())

    wanted, walks = map(np.asarray, judge(localise(seen)))
    return walks.sum() / wanted.sum(), walks.any(1).sum() / wanted.any(1).sum()


def mitsuba(heights: np.ndarray, camera: str) -> dict[str, Callable[[], object]]:
    dr, mi, loaded, parameters, positions = made = mitsuba_scene(heights, CAMERAS[camera], LIGHTS[camera], PIXELS)

    def frame():
        dr.eval(mi.render(loaded, spp=1))
        dr.sync_thread()

    def rebuild():
        parameters[made.place] = positions
        parameters.update()
        frame()

    return {"mitsuba": frame, "mitsuba, new heights": rebuild}


def embree(heights: np.ndarray, camera: str) -> dict[str, Callable[[], object]]:
    frame, build = embree_frame(heights, CAMERAS[camera], LIGHTS[camera], PIXELS)

    def rebuild():
        build()
        frame()

    return {"embree, one core": frame, "embree, one core, new heights": rebuild}


def main() -> None:
    run = benchmark.Run(
        __doc__,
        needs="a package or program for each of --mitsuba (with LLVM's library, see DRJIT_LIBLLVM_PATH), --embree, --povray",
        claims="at 1024² heights that normals and bounds at hand halve a frame, and that the pyramid is no slower than dda; "
        "with --mitsuba at most a third more of its time than docs/measurements/mitsuba.csv has",
    )
    parser = run.parser
    parser.add_argument("--sizes", type=int, nargs="+", default=[64, 256, 1024], help="vertices a side")
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--devices", type=int, default=len(os.sched_getaffinity(0)), help="cores that share the work")
    parser.add_argument("--fixed", action="store_true", help="without early exit, also with a budget of 64 steps")
    parser.add_argument("--inside", action="store_true", help="also within jit, scan and vmap")
    parser.add_argument("--mitsuba", action="store_true")
    parser.add_argument("--embree", action="store_true", help="with embreex, and shading in NumPy")
    parser.add_argument("--povray", action="store_true", help="what povray says of itself, after the others")
    options = run.parse()
    if options.mitsuba:
        need_fast_mitsuba()
    benchmark.need(*(name for name, wanted in (("embreex", options.embree), ("povray", options.povray)) if wanted))
    jax.config.update("jax_num_cpu_devices", options.devices)
    for size in options.sizes:
        for camera in CAMERAS:
            heights = terrain(size)
            variants = {
                "pyramid": ours(heights, camera, jaxhf.Settings()),
                "pyramid, no shadows": ours(heights, camera, jaxhf.Settings(shadows=False)),
                "dda": ours(heights, camera, jaxhf.Settings(traversal="dda")),
                "pyramid, prepared": prepared(heights, camera),
            }
            if options.fixed:
                variants["64 steps"] = ours(heights, camera, jaxhf.Settings(max_steps=64))
                variants["no early exit, 64 steps"] = ours(heights, camera, jaxhf.Settings(early_exit=False, max_steps=64))
                variants["no early exit"] = ours(heights, camera, jaxhf.Settings(early_exit=False))
            if options.inside:
                variants |= inside(heights, camera)
            if options.mitsuba:
                variants |= mitsuba(heights, camera)
            if options.embree:
                variants |= embree(heights, camera)
            title = f"{size}² heights, camera {camera}"
            ratios = report(run, title, variants, options.repeats)
            if size == 1024:
                run.claim(ratios["pyramid, prepared"] < 0.5, f"{title}: prepared {ratios['pyramid, prepared']:.2f}, below 0.5")
                run.claim(ratios["dda"] > 0.9, f"{title}: dda {ratios['dda']:.2f} of the pyramid's time, above 0.9")
            if options.mitsuba and size in MITSUBA:
                new, frame = 1 / ratios["mitsuba, new heights"], ratios["pyramid, prepared"] / ratios["mitsuba"]
                for name, ratio, most in zip(("new heights", "frame"), (new, frame), MITSUBA[size], strict=True):
                    run.claim(ratio <= most, f"{title}, {name}: {ratio:.2f} of Mitsuba's time, at most {most}")
            rays, tiles = shadow_rays(heights, camera)
            run.row(f"{title}, shadow rays that walk", {"share": rays, "of the tiles": tiles})
            if options.povray:
                with tempfile.TemporaryDirectory() as folder:
                    said = [
                        povray_seconds(heights, CAMERAS[camera], LIGHTS[camera], PIXELS, Path(folder))
                        for _ in range(options.repeats)
                    ]
                run.row(f"{title}, povray", {"ms": 1e3 * np.median(said)})
    run.end()


def report(run: benchmark.Run, title: str, variants: dict[str, Callable[[], object]], repeats: int) -> dict[str, float]:
    """A row a variant; its median time as a ratio to the first."""
    times: dict[str, list[float]] = {name: [] for name in variants}
    for variant in variants.values():
        variant()
    order = np.random.default_rng(0)
    for _ in range(repeats):
        for name in order.permutation(list(variants)):
            variants[name]()
            begin = time.perf_counter()
            variants[name]()
            times[name].append(time.perf_counter() - begin)
    first = np.array(next(iter(times.values())))
    ratios = {name: float(np.median(np.array(seconds) / first)) for name, seconds in times.items()}
    for name, seconds in times.items():
        run.row(f"{title}, {name}", {"ms": 1e3 * np.median(seconds), "of the first": ratios[name]})
    return ratios


if __name__ == "__main__":
    main()
