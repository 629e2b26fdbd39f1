"""Makes tests/references: what Mitsuba 3 makes of terrains of ours, and a part of what pbrt-v2 made of a seed scene.

    python benchmarks/references.py [NAME ...]             those of Mitsuba, or some of them; a minute in all
    python benchmarks/references.py hftest --pbrt FOLDER   from FOLDER/ref/hftest.npz and FOLDER/scenes/hf4x4.pbrt
    python benchmarks/references.py --check [NAME ...]     writes nothing; fails where a file is not what would be made now

Mitsuba (pip install mitsuba; 3.9.1 made these) runs without LLVM. A file holds its scene in numbers: tests need nothing of this
script. Normals are rounded to 1 / 32767, row 0 is at the top.
"""

import argparse
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from cases import smoothed
from peers import View
from scalar import Arrays, matte, mesh, mitsuba, picture, scattering, texture, traced

import jaxhf

sys.path.append(str(Path(__file__).parents[1] / "tests"))
from reflectance import LAWS

from jaxhf.scene.procedural import bumps, fractal, grid, waves

FOLDER = Path(__file__).parents[1] / "tests" / "references"


def rays(
    mi: Any, heights: np.ndarray, spacing: Sequence[float], view: View, sun: Sequence[float], lamp: Sequence[float]
) -> Arrays:
    """A terrain under a low sun and, apart from it, a lamp (its place and its intensity); 96 x 96 pixels."""
    lights = jaxhf.Directional(sun), jaxhf.Point(lamp[:3], lamp[3])
    both = [traced(mi, {"land": mesh(mi, heights, spacing)}, light, view, 96) for light in lights]
    made = both[0] | {name: np.stack([one[name] for one in both]) for name in ("visible", "radiance")}
    del made["kind"]
    scene = {"heights": heights, "spacing": spacing, "eye": view[0], "target": view[1], "fov": view[2]}
    return made | scene | {"towards": np.asarray(lights[0].towards), "lamp": lamp}


def rays_hills(mi: Any) -> Arrays:
    """Hills on a unit square, seen from the south; under the sun every second pixel by other laws of reflectance, too."""
    heights = bumps([65, 65], seed=4, count=16, radius=0.06, range=(0, 0.25)).astype(np.float32)
    view = (0.5, -0.75, 0.9), (0.5, 0.45, 0.05), 42.0
    sun = (0.8, 0.1, 0.25)
    made = rays(mi, heights, (1 / 64, 1 / 64), view, sun, (0.15, 0.8, 0.35, 0.2))
    land, laws = mesh(mi, heights, (1 / 64, 1 / 64)), {}
    for name, (_, law) in LAWS.items():
        land.set_bsdf(scattering(mi, law))
        laws[name] = traced(mi, {"land": land}, jaxhf.Directional(sun), view, 96)["radiance"][::2, ::2]
    return made | {"laws": list(laws), "by_law": np.stack(list(laws.values()))}


def valley(cells: float, size: int) -> tuple[np.ndarray, np.ndarray, tuple[float, float], list[View]]:
    """Of the Jacksboro fault, in metres: heights, those smoothed over so many cells, spacing, and three views of all of it."""
    terrain = jaxhf.jacksboro()
    part = np.s_[100 : 100 + size, 100 : 100 + size]
    truth, prior = terrain.heights[part], smoothed(terrain.heights.astype(np.float64), cells)[part]
    truth, prior = truth - truth.min(), prior - truth.min()
    side = (size - 1) * np.array([terrain.dx, terrain.dy])
    middle = np.array([*side / 2, prior.mean()])
    turns = np.radians((190, 80, 280))
    offsets = [1.38 * max(side) * np.array([np.sin(turn), np.cos(turn), 1.64]) for turn in turns]
    views = [((middle + offset).tolist(), middle.tolist(), 28.0) for offset in offsets]
    return truth, prior, (terrain.dx, terrain.dy), views


def rays_valley(mi: Any) -> Arrays:
    """A real valley, seen from the south."""
    heights, _, spacing, _ = valley(0, 65)
    east, north = 64 * spacing[0], 64 * spacing[1]
    view = (east / 2, -0.6 * north, 0.8 * north), (east / 2, north / 2, 200.0), 42.0
    lamp = (0.3 * east, 0.6 * north, 900.0, 1e6)
    return rays(mi, heights, spacing, view, np.asarray(jaxhf.Directional.from_angles(315, 14).towards).tolist(), lamp)


def bay(mi: Any) -> Arrays:
    """Turned land with a texture, in a sea that mirrors, within a dome with the same texture; a lamp beside the mountains."""
    land = fractal([49, 49], seed=8, exponent=2.2, range=(-0.15, 0.35)).astype(np.float32)
    sea = waves([33, 33], seed=1, range=(-0.004, 0.004)).astype(np.float32)
    turn = np.radians(25)
    world = np.eye(4)
    world[:2, :2] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
    world[:3, 3] = 0.2, -0.1, 0.02
    texels = grid([24, 24], lines=4).astype(np.float32)
    dome = mi.ScalarTransform4f().translate([0.5, 0.5, -1]).scale([2.5, 2.5, 4])
    shapes = {
        "land": mesh(mi, land, (1 / 48, 1 / 48), texture(mi, texels), world),
        "sea": mesh(mi, sea, (1 / 32, 1 / 32)),
        "dome": {"type": "cylinder", "to_world": dome, "bsdf": matte(texture(mi, texels))},
    }
    view, lamp = ((0.5, -0.6, 0.45), (0.5, 0.5, 0.05), 50.0), (0.1, 0.7, 0.35, 0.5)
    scene = {"land": land, "sea": sea, "land_from": world, "texels": texels, "lamp": lamp}
    scene |= {"eye": view[0], "target": view[1], "fov": view[2]}
    return traced(mi, shapes, jaxhf.Point(lamp[:3], lamp[3]), view, 96) | scene


def fit_valley(mi: Any, size: int = 49, pixels: int = 64) -> Arrays:
    """Three pictures of a real valley, its border and its shadows in sight, and the map of it that is known before."""
    truth, prior, spacing, views = valley(4, size)
    suns = [jaxhf.Directional.from_angles(azimuth=azimuth, altitude=18) for azimuth in (315, 75, 195)]
    images = [picture(mi, mesh(mi, truth, spacing), sun, view, pixels) for sun, view in zip(suns, views, strict=True)]
    scene = {"truth": truth, "prior": prior.astype(np.float32), "spacing": spacing}
    eyes, targets, fovs = zip(*views, strict=True)
    given = {"towards": [np.asarray(sun.towards) for sun in suns], "eyes": eyes, "targets": targets, "fov": fovs[0]}
    return {"images": np.stack(images)} | scene | given


def turned(axis: int, degrees: float) -> np.ndarray:
    """A rotation about x, y or z."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.roll([[1, 0, 0], [0, c, -s], [0, s, c]], axis, (0, 1))


def hftest(pbrt: Path) -> Arrays:
    """Every second pixel of what pbrt-v2 (flat: stock; smooth: with Phong normals) found; red, to which all is in proportion.

    Its camera stands at the origin and looks along +z, y up, with a field of view of 45 degrees; a lamp of intensity 8 with it.
    """
    numbers = re.findall(r"-?[\d.]+", (pbrt / "scenes" / "hf4x4.pbrt").read_text().split("Pz")[1])
    seen = {name: values[::2, ::2] for name, values in np.load(pbrt / "ref" / "hftest.npz").items()}
    colours = {name: seen.pop(name)[..., :1] for name in list(seen) if "rgb" in name}
    whole = {name: np.round(32767 * seen.pop(name)).astype(np.int16) for name in ("n", "smooth_ns")}
    world = np.eye(4)
    world[:3] = np.c_[turned(1, 10) @ turned(2, -20) @ turned(0, 30), (-0.6, -0.2, 2)]
    scene = {"heights": np.reshape(np.array(numbers, np.float32), (4, 4)), "world_from_object": world, "albedo": 0.4}
    return scene | seen | colours | whole


MADE = {
    "rays-hills": rays_hills,
    "rays-valley": rays_valley,
    "bay": bay,
    "fit-valley": fit_valley,
    "fit-small": lambda mi: fit_valley(mi, 33, 48),
}


def agrees(made: Arrays, kept: Arrays) -> bool:
    """Whether all but a thousandth of each array is the same, to 1e-4 of its largest value; pictures to 1 %, their noise."""
    if set(made) != set(kept):
        return False
    for name, values in ((name, np.asarray(values, np.float64)) for name, values in kept.items() if values.dtype.kind != "U"):
        finite, other = np.isfinite(values), np.asarray(made[name], np.float64)
        allowed = (0.01 if name == "images" else 1e-4) * np.abs(values[finite]).max()
        if other.shape != values.shape or (~finite & np.isfinite(other)).mean() > 1e-3:
            return False
        if (np.abs(np.where(finite, other - values, 0)) > allowed).mean() > 1e-3:
            return False
    return True


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join([*MADE, "hftest"]))
    parser.add_argument("--pbrt", type=Path)
    parser.add_argument("--check", action="store_true")
    options = parser.parse_args()
    mi, failed = None, []
    for name in options.names or [*MADE, *(["hftest"] if options.pbrt else [])]:
        if name == "hftest":
            made = hftest(options.pbrt or parser.error("hftest needs --pbrt"))
        else:
            mi = mi or mitsuba()
            made = MADE[name](mi)
        made = {key: np.asarray(values) for key, values in made.items()}
        maker = f"Mitsuba {mi.__version__}" if mi and name != "hftest" else "pbrt-v2, and Phong normals in it"
        made["origin"] = np.array(f"{maker}: benchmarks/references.py {name}")
        file = FOLDER / f"{name}.npz"
        if not options.check:
            np.savez_compressed(file, allow_pickle=False, **made)
        same = agrees(made, dict(np.load(file)))
        failed += [] if same else [name]
        print(f"{name}: {file.stat().st_size / 1000:.0f} kB, {'as made now' if same else 'NOT as made now'}")
    return bool(failed)


if __name__ == "__main__":
    sys.exit(main())
