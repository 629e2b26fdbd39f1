"""The trades that the seed's reports weighed, measured again on their scenes: space against time, exactness against time.

Walks: the pyramid of bounds, single cells with bounds of their own ("dda"), single cells without any bounds (Amanatides and
Woo 1987 as it stands). Triangles: made on demand from the heights, or all stored beforehand. Normals: the three schemes of
the reports, and flat shading. The package has neither walks without bounds nor stored triangles: both are put in its place
here, in a process of their own. Every variant is a process; frames take turns with the first variant's, and ratios are the
medians of pairs. "difference" is the RMSE of the picture to the first variant's, over its mean.
"""

import itertools
import json
import os
import tempfile
from pathlib import Path
from typing import Any

import benchmark
import numpy as np
from seeds import SCENES

from jaxhf.study.worker import Answers, Worker, timed
from jaxhf.xla.machine import peak_mb

VARIANTS: dict[str, dict[str, Any]] = {
    "pyramid, triangles on demand, normals of six, smooth": {},
    "dda with bounds": {"settings": {"traversal": "dda"}},
    "dda without bounds": {"settings": {"traversal": "dda"}, "bounds": False},
    "triangles stored": {"triangles": True},
    "dda without bounds, triangles stored": {"settings": {"traversal": "dda"}, "bounds": False, "triangles": True},
    "normals central": {"settings": {"normals": "central"}},
    "normals of four": {"settings": {"normals": "four"}},
    "flat": {"settings": {"shading": "flat"}},
}

HELD = [  # pairs of variants, of which the first holds less
    ("dda without bounds", "dda with bounds"),
    ("dda with bounds", next(iter(VARIANTS))),
    (next(iter(VARIANTS)), "triangles stored"),
    ("dda without bounds", "dda without bounds, triangles stored"),
]


def without_bounds() -> None:
    """Walks look at no block before they visit a cell, and no bounds are held but one number: tiles with an empty array take
    two to three times as long."""
    import equinox as eqx
    import jax.numpy as jnp

    from jaxhf.preparation import world as _world
    from jaxhf.trace import search as _search, walk as _walk

    make_grid = _world.make_grid

    def grid_of(*arguments: Any, **options: Any) -> Any:
        grid = make_grid(*arguments, **options)
        return eqx.tree_at(lambda grid: grid.pyramid.bounds, grid, jnp.zeros(1, grid.z_top.dtype))

    _search.SKIPS = 0
    _walk.Walk.skip = lambda self, state: state
    _world.make_grid = grid_of


def with_stored_triangles() -> None:
    """Each cell's two triangles as six heights, one cell after the other: six numbers a cell in place of one a height.

    Heights are the arrays of one axis: normals keep theirs a vertex. Scenes have one heightfield, whose first height is at 0.
    """
    import equinox as eqx
    import jax

    from jaxhf.preparation import world as _world
    from jaxhf.trace import grid as _grid, intersect as _hit, triangle as _triangle, walk as _walk
    from jaxhf.xla.materialise import values_at

    triangle_corners, make_grid = _triangle.triangle_corners, _world.make_grid

    def corners_of(values: jax.Array, nx: int, ix: jax.Array, iy: jax.Array, grid: Any) -> tuple[jax.Array, ...]:
        first = 6 * (iy * (nx - 1) + ix)
        return values_at(values, first, (1, 4, 2))

    def triangle_corners_of(
        values: jax.Array, nx: int, ix: jax.Array, iy: jax.Array, upper: jax.Array, grid: Any = None
    ) -> tuple[jax.Array, ...]:
        if values.ndim > 1:
            return triangle_corners(values, nx, ix, iy, upper, grid)
        first = 6 * (iy * (nx - 1) + ix) + 3 * upper.astype(ix.dtype)
        return values_at(values, first, (1, 2))

    def grid_of(*arguments: Any, **options: Any) -> Any:
        grid = make_grid(*arguments, **options)
        z = grid.z
        z00, z10, z01, z11 = z[:-1, :-1], z[:-1, 1:], z[1:, :-1], z[1:, 1:]
        stored = jax.numpy.stack([z00, z10, z11, z00, z01, z11], -1).reshape(-1)
        return eqx.tree_at(lambda grid: grid.rows, grid, stored)

    _triangle.corners = _walk.corners = corners_of
    _grid.triangle_corners = _hit.triangle_corners = triangle_corners_of
    _world.make_grid = grid_of


def as_long_as_the_terrain() -> None:
    """Arrays of a world have no room for larger terrains, which would be part of what is held."""
    from jaxhf.preparation import any_size as _any_size

    _any_size._room = lambda *_: None


def prepare(job: dict[str, Any]) -> Answers:
    os.sched_setaffinity(0, job["cores"])
    os.environ["JAXHF_CACHE"] = "0"  # programs there are of the code as it lies on the disk
    import jax

    import jaxhf

    as_long_as_the_terrain()

    jax.config.update("jax_num_cpu_devices", len(job["cores"]))
    variant = VARIANTS[job["variant"]]
    if not variant.get("bounds", True):
        without_bounds()
    if variant.get("triangles"):
        with_stored_triangles()
    scene = jaxhf.load_scene(job["scene"])
    ready = jaxhf.prepare(scene, jaxhf.Settings(**variant.get("settings", {})))

    def frame() -> None:
        """From normals, bounds and triangles at hand: what is stored costs no time."""
        jax.block_until_ready(jaxhf.render(ready))

    def first() -> dict[str, float]:
        frame()
        return {"peak_mb": peak_mb(), "held_mb": sum(leaf.nbytes for leaf in jax.tree.leaves(ready)) / 2**20}

    def picture() -> dict[str, float]:
        np.save(job["picture"], np.asarray(jaxhf.render(ready)))
        return {}

    return {"ready": first, "frame": lambda: timed(frame), "picture": picture}


def measure(scene: Path, cores: list[int], repeats: int, names: list[str]) -> list[dict[str, Any]]:
    rows = []
    with tempfile.TemporaryDirectory() as folder:

        def start(name: str, k: int) -> Worker:
            return Worker(prepare, {"scene": str(scene), "variant": name, "cores": cores, "picture": f"{folder}/{k}.npy"})

        with start(names[0], 0) as base:
            base.answer()
            base.ask("picture")
            reference = np.load(f"{folder}/0.npy").astype(np.float64)
            for k, name in enumerate(names, 1):
                with start(name, k) as worker:
                    ready = worker.answer()
                    pairs = [(worker.ask("frame")["seconds"], base.ask("frame")["seconds"]) for _ in range(repeats)]
                    worker.ask("picture")
                difference = np.load(f"{folder}/{k}.npy").astype(np.float64) - reference
                seconds, base_seconds = np.array(pairs).T
                rows.append(
                    {
                        "scene": scene.stem,
                        "variant": name,
                        "seconds": float(np.median(seconds)),
                        "ratio": float(np.median(seconds / base_seconds)),
                        "difference": float(np.sqrt(np.mean(difference**2)) / reference.mean()),
                        **ready,
                    }
                )
    return rows


def main() -> None:
    claims = "that walks and stored triangles change no picture by a bit, and that what is said to be stored, or not, is"
    run = benchmark.Run(__doc__, needs="a folder of the seed scenes", claims=claims)
    parser = run.parser
    parser.add_argument("folder", type=Path, help="where the .pbrt scenes lie")
    parser.add_argument("--scenes", nargs="+", default=[name for name in SCENES if name != "landsea-big64"])
    parser.add_argument("--variants", nargs="+", default=list(VARIANTS), choices=VARIANTS)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--cores", type=int, default=1, help="that share the work; one by default, as in the reports")
    parser.add_argument("-o", "--output", type=Path, help="keep the figures in this .json")
    options = run.parse()
    for name in options.scenes:
        if not (options.folder / f"{name}.pbrt").is_file():
            benchmark.refuse(f"{options.folder / name}.pbrt: there is no such file")
    cores = sorted(os.sched_getaffinity(0))[: options.cores]
    print(f"about {len(options.scenes) * len(options.variants) / 4:.0f} minutes", flush=True)
    rows: list[dict[str, Any]] = []
    for name in options.scenes:
        rows += measure(options.folder / f"{name}.pbrt", cores, options.repeats, options.variants)
        if options.output:
            options.output.write_text(json.dumps(rows, indent=1))
    held = {(row["scene"], row["variant"]): row["held_mb"] for row in rows}
    for name, (less, more) in itertools.product(options.scenes, HELD):
        if {less, more} <= set(options.variants):
            run.claim(held[name, less] < held[name, more], f"{name}: {less} holds less than {more}")
    for row in rows:
        title, variant = f"{row.pop('scene')}, {row['variant']}", VARIANTS[row.pop("variant")].get("settings", {})
        run.row(title, row)
        if set(variant) <= {"traversal"}:
            run.claim(row["difference"] == 0, f"{title}: another picture, by {row['difference']:.2g}")
    run.end()


if __name__ == "__main__":
    main()
