"""Compares what two checkouts compute, bit for bit: pictures, output variables, casts, gradients, robots' rays and maps.

    git worktree add /tmp/before main && python benchmarks/same.py /tmp/before

Each checkout runs in a process of its own, with this script's cases and its own package. What may differ by rounding, as one
piece of code now serves two, is named by `--rounding`: beginnings of names, within 1e-6 of the largest value. Exits with 1
where anything else differs, or is in one of the two only.
"""

import argparse
import dataclasses
import functools
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

SIZE = 48, 32
ROUNDING = 1e-6
Named = Iterator[tuple[str, Any]]
RNG = np.random.default_rng(7)
RAYS = RNG.uniform((0, 0, 0.3), (1, 1, 0.6), (500, 3)).astype("f"), RNG.uniform((-1, -1, -1), (1, 1, 0), (500, 3)).astype("f")
HEIGHTS = RNG.uniform(0, 0.2, (17, 23)).astype("f")


def pictures() -> Named:
    import jaxhf

    for path in sorted(Path(__file__).parents[1].joinpath("scenes").glob("*.toml")):
        scene = jaxhf.load_scene(path)
        camera = dataclasses.replace(scene.camera, width=SIZE[0], height=SIZE[1])
        image, aovs = jaxhf.render(scene.with_camera(camera), jaxhf.Settings(samples=1), aovs=jaxhf.AOVS)
        yield f"picture {path.stem}", image
        yield from ((f"aov {path.stem} {name}", values) for name, values in aovs.items())


def scene(lights: Any, material: Any = None) -> Any:
    import jaxhf

    camera = jaxhf.Perspective.look_at((0.5, -1, 1), (0.5, 0.5, 0), fov=40, width=SIZE[0], height=SIZE[1])
    return jaxhf.Scene([jaxhf.Object(jaxhf.Heightfield(HEIGHTS), material or jaxhf.Matte(0.7))], camera, lights)


def settings() -> Named:
    """Each setting that changes a picture, under each light."""
    import jaxhf

    sun = jaxhf.Directional((1, 0.2, 0.4))
    knobs: dict[str, dict[str, Any]] = {f"normals {name}": {"normals": name} for name in ("central", "four", "six-angle")}
    knobs |= {"flat": {"shading": "flat"}, "dda": {"traversal": "dda"}, "fixed": {"early_exit": False}, "9": {"samples": 9}}
    for name, knob in knobs.items():
        yield f"picture {name}", jaxhf.render(scene([sun]), jaxhf.Settings(**knob))
    lights = {"point": jaxhf.Point((0.2, 0.3, 0.9), 2), "sun": jaxhf.Sun((1, 0, 0.5)), "sky": jaxhf.Sky(0.3)}
    for name, light in lights.items():
        yield f"picture {name}", jaxhf.render(scene([light]))
    yield "picture mirror", jaxhf.render(scene([sun, jaxhf.Sky(0.3)], jaxhf.Mirror(0.8)))


def derivatives() -> Named:
    import jax
    import jax.numpy as jnp

    import jaxhf

    def loss(given: Any, points: int) -> Any:
        return jnp.sum(jaxhf.render(given, jaxhf.Settings(edge_samples=points)) ** 2)

    floats = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), scene([jaxhf.Directional((1, 0.2, 0.4))]))
    for points in (0, 500):
        gradient = jax.grad(functools.partial(loss, points=points))(floats)
        for path, leaf in jax.tree_util.tree_leaves_with_path(gradient):
            yield f"gradient {points}{jax.tree_util.keystr(path)}", leaf


def rays() -> Named:
    import jaxhf

    field = jaxhf.Heightfield(HEIGHTS)
    for name, surface in (("field", field), ("scene", scene([])), ("prepared", jaxhf.prepare(field))):
        hit = jaxhf.cast(surface, *RAYS)
        yield from ((f"cast {name} {key}", getattr(hit, key)) for key in ("t", "p", "n", "ns", "uv", "cell", "status", "dn_du"))
    hfield = jaxhf.mujoco.HField(HEIGHTS, (1, 1, 0.2, 0.1))
    met = jaxhf.mujoco.ray(hfield, *RAYS)
    met = met if isinstance(met, tuple) else (met.dist, met.n)  # a tuple before b4482a0
    yield from zip(("mujoco distance", "mujoco normal"), met, strict=True)
    for align in ("yaw", "world"):
        scan = jaxhf.mujoco.height_scan(hfield, np.array([[0.1, 0.2, 0.5]]), np.array([[0.9, 0.1, 0.2, 0.3]]), align=align)
        yield f"mujoco scan {align}", scan.heights
    yield "mujoco lidar", jaxhf.mujoco.lidar(hfield, np.array([[0.1, 0.2, 0.5]]), np.array([[1.0, 0, 0, 0]])).dist


def maps() -> Named:
    import jaxhf

    terrain = jaxhf.jacksboro()
    for name in ("hillshade", "slope", "aspect", "relief"):
        yield f"map {name}", getattr(jaxhf, name)(terrain)
    yield "map shadows", jaxhf.relief(terrain, shadows=True, altitude=12)
    yield "map horizon", jaxhf.horizon(terrain, 8)
    yield "map sky_view", jaxhf.sky_view(terrain, 8)


def results(out: Path) -> None:
    """All of them, computed by the package that this process imports."""
    parts = (pictures, settings, derivatives, rays, maps)
    named: dict[str, Any] = {name: np.asarray(values) for part in parts for name, values in part()}
    np.savez(out, **named)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("other", type=Path, help="a checkout, as of git worktree add")
    parser.add_argument("--rounding", nargs="*", default=[], metavar="NAME", help="what may differ by rounding")
    parser.add_argument("--out", type=Path, help=argparse.SUPPRESS)  # of a process that computes
    options = parser.parse_args()
    if options.out is not None:
        results(options.out)
        return
    found = []
    with tempfile.TemporaryDirectory() as folder:
        for k, root in enumerate((options.other, Path(__file__).parents[1])):
            if not (root / "jaxhf").is_dir():
                parser.error(f"{root} is no checkout: it has no folder jaxhf")
            out = Path(folder) / f"{k}.npz"
            environment = {**os.environ, "PYTHONPATH": str(root.resolve())}
            subprocess.run([sys.executable, __file__, root, "--out", out], env=environment, check=True)
            found.append(dict(np.load(out)))
    before, after = found
    wrong = [f"{name}: in one of the two only" for name in sorted(before.keys() ^ after.keys())]
    for name in sorted(before.keys() & after.keys()):
        a, b = before[name], after[name]
        if a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes():
            continue
        off = np.inf if a.shape != b.shape else float(np.abs(a.astype(float) - b.astype(float)).max())
        if off > ROUNDING * np.abs(a.astype(float)).max() or not name.startswith(tuple(options.rounding)):
            wrong.append(f"{name}: differs by up to {off:.3g}")
    print(f"{len(before.keys() & after.keys())} results compared, {len(wrong)} differ", *wrong, sep="\n  ")
    sys.exit(bool(wrong))


if __name__ == "__main__":
    main()
