"""The cases on which the default call of `jaxhf.fit` is judged, all of which were looked at while it was built.

A case gives what a user would have, and no more: scenes, pictures, the noise where it is known, a coarse map and its deviation
where there is one. Where Mitsuba made the pictures, settings say how it weights normals: whoever has a renderer's pictures
knows the renderer. What each has to reach stands in docs/measurements/fit-cases.csv.
"""

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import imageio.v3 as iio
import numpy as np
from benchmark import SOURCES, have
from peers import common_work, mitsuba_picture

import jaxhf
from jaxhf.scene.procedural import bumps, fractal

LIGHTS = ((0.5, -0.3, 0.6), (0.3, 0.5, 0.6), (-0.5, 0.3, 0.6), (-0.3, -0.5, 0.6))
SAMPLES = 1024  # a pixel, of Mitsuba's pictures
MITSUBAS = {"settings": jaxhf.Settings(normals="six-angle")}


class Missing(Exception):
    """A case cannot be made here; says what it needs."""


class Sources(NamedTuple):
    """Where cases find what the package does not have.

    Attributes:
      targets: folder of Mitsuba's pictures, which are made where they are not there; None: they are made each time.
      peers: folder of common_work.py and of its pictures.
      hfield: MuJoCo Playground's hfield.png.
    """

    targets: Path | None = None
    peers: Path | None = None
    hfield: Path | None = None

    def pictures(self, name: str, make: Callable[[], np.ndarray]) -> np.ndarray:
        """The pictures of this case, from the folder where it has them."""
        kept = None if self.targets is None else self.targets / f"{name}.npz"
        if (kept is None or not kept.exists()) and not have("mitsuba"):
            raise Missing(f"it needs mitsuba ({SOURCES['mitsuba']}), or {name}.npz in the folder of --targets")
        if self.targets is None or kept is None:
            return make()
        if not kept.exists():
            self.targets.mkdir(parents=True, exist_ok=True)
            np.savez(kept, images=make())
        return np.load(kept)["images"]


@dataclasses.dataclass(frozen=True)
class Case:
    """A fit whose answer is known.

    Attributes:
      truth: heights (ny, nx).
      scenes: one a picture, over the heights of the start.
      targets: the pictures.
      given: what else is handed to `jaxhf.fit`.
      reference: the heights that a user has beforehand, (ny, nx): the prior, or else the start.
    """

    truth: np.ndarray
    scenes: Sequence[jaxhf.Scene]
    targets: Sequence[np.ndarray]
    given: dict[str, Any]
    reference: np.ndarray


class Definition(NamedTuple):
    """How a case is made, and in which precision it is solved; JAX's x64 mode must be set to that before.

    `warns`: the names, out of `WARNINGS`, of what the fit may say against its heights.
    """

    precision: str
    make: Callable[[Sources], Case]
    warns: tuple[str, ...] = ()


WARNINGS = {  # a name for each sentence of `Fit.warnings`, by words of it
    "do not use": "do not use these heights",
    "no noise": "is no noise",
    "strayed": "heights differ from the prior",
    "chi2": "chi2 is",
    "no nearer": "it came no nearer",
    "stalled": "it stalled",
    "noise allowed for": "standard deviations allow for what is left",
    "boundaries allowed for": "standard deviations allow for shadows",
    "unseen": "no picture shows",
    "one light": "all pictures have the same light",
    "mean unsure": "most of what is unsure of the heights they share",
}


def names_of(warnings: Sequence[str]) -> list[str]:
    """A name for each warning; the sentence itself where it has none."""
    return [next((name for name, words in WARNINGS.items() if words in warning), warning) for warning in warnings]


def viewed(
    ground: jaxhf.Object, cameras: Sequence[jaxhf.Perspective | jaxhf.Orthographic], lights: Sequence[jaxhf.Directional]
) -> list[jaxhf.Scene]:
    """A scene a picture, over the same ground."""
    return [jaxhf.Scene([ground], camera, [light]) for camera, light in zip(cameras, lights, strict=True)]


def flat(_: Sources, dtype: str = "float64") -> Case:
    """Smooth terrain seen from straight above, by our own noise-free pictures; four lights."""
    n = 64
    truth = fractal([n, n], seed=3, exponent=3.0, range=(0.0, 0.1)).astype(dtype)
    # Its frame ends just inside the terrain, whose border would move with the heights in a way that only edge derivatives know.
    fov = 2 * np.degrees(np.arctan(0.4995 / 5.0))
    camera = jaxhf.Perspective.look_at((0.5, 0.5, 5.0), (0.5, 0.5, 0.0), up=(0, 1, 0), fov=fov, width=128, height=128)

    def scenes(heights: np.ndarray) -> list[jaxhf.Scene]:
        ground = jaxhf.Object(jaxhf.Heightfield(heights))
        return viewed(ground, [camera] * len(LIGHTS), [jaxhf.Directional(towards) for towards in LIGHTS])

    targets = [np.asarray(jaxhf.render(scene))[..., 0] for scene in scenes(truth)]
    start = np.full_like(truth, 0.05)
    return Case(truth, scenes(start), targets, {}, start)


def common(sources: Sources, count: int) -> Case:
    """The first pictures that Mitsuba made for the common work; the terrain's border is in sight. Flat start."""
    if sources.peers is None:
        raise Missing("it needs --peers, the folder of common_work.py and targets_D_std.npz")
    work = common_work(sources.peers)
    eye, target, fov = work.CAMERAS["D"]
    truth = work.terrain(64).astype(np.float64)
    stored = np.load(sources.peers / "targets_D_std.npz")
    start = np.full(truth.shape, 0.1, np.float32)
    field = jaxhf.Object(jaxhf.Heightfield(start), jaxhf.Matte(work.ALBEDO))
    camera = jaxhf.Perspective.look_at(eye, target, fov=fov, width=128, height=128)
    lights = [jaxhf.Directional(towards) for towards in stored["lights"][:count]]
    scenes = viewed(field, [camera] * count, lights)
    return Case(truth, scenes, list(stored["images"][:count]), MITSUBAS, start)


def by_mitsuba(
    sources: Sources,
    name: str,
    scenes: Sequence[jaxhf.Scene],
    eyes: Sequence[np.ndarray],
    at: np.ndarray,
    texels: np.ndarray | None = None,
    samples: int = SAMPLES,
) -> np.ndarray:
    """Pictures (pictures, h, w) by Mitsuba, or with texels (pictures, h, w, 3), one a scene and an eye that looks `at`.

    A scene has one heightfield, at the origin, under one directional light. Texels: row 0 in the south; without them the albedo
    is the material's number.
    """

    def picture(scene: jaxhf.Scene, eye: np.ndarray) -> np.ndarray:
        field, material, camera, (light,) = scene.objects[0].shape, scene.objects[0].material, scene.camera, scene.lights
        assert isinstance(field, jaxhf.Heightfield)
        assert isinstance(material, jaxhf.Matte)
        assert isinstance(light, jaxhf.Directional)
        heights, flat = np.asarray(field.heights), isinstance(camera, jaxhf.Orthographic)
        shown = camera.extent if isinstance(camera, jaxhf.Orthographic) else camera.fov
        extent = (heights.shape[1] - 1) * float(field.dx), (heights.shape[0] - 1) * float(field.dy)
        view = eye.tolist(), at.tolist(), float(shown)
        albedo = float(np.asarray(material.albedo)[0]) if texels is None else texels
        made = mitsuba_picture(
            heights, view, np.asarray(light.towards).tolist(), (camera.width, camera.height), samples=samples, albedo=albedo,
            extent=extent, orthographic=flat,
        )  # fmt: skip
        return made[..., 0] if texels is None else made

    return sources.pictures(name, lambda: np.stack([picture(*pair) for pair in zip(scenes, eyes, strict=True)]))


def suns(*angles: tuple[float, float]) -> list[jaxhf.Directional]:
    """Lights by azimuth and altitude, degrees."""
    return [jaxhf.Directional.from_angles(azimuth=azimuth, altitude=altitude) for azimuth, altitude in angles]


def surveyed(
    sources: Sources,
    name: str,
    whole: np.ndarray,
    part: tuple[slice, slice],
    spacing: tuple[float, float],
    cells: float,
    lit: Sequence[tuple[float, float]],
    noise_known: bool,
) -> Case:
    """A part of a terrain of which a smoothed map is known, from 256 x 256 pictures by Mitsuba with 1 % noise.

    The cameras stand around the part, 31 degrees from the vertical, and see all of its border.

    Args:
      whole: all heights that there are of this terrain.
      spacing: dx, dy.
      cells: standard deviation of the Gaussian by which the map was smoothed.
      lit: azimuth and altitude of one light a picture, degrees.
      noise_known: whether the fit is told how large the noise is.
    """
    coarse = smoothed(whole, cells)
    # What the map is off by over the whole terrain, to two digits, as a map's legend would say.
    spread = float(f"{np.sqrt(np.mean((coarse - whole) ** 2)):.1e}")
    truth, prior = whole[part], coarse[part]
    extent = ((truth.shape[1] - 1) * spacing[0], (truth.shape[0] - 1) * spacing[1])
    middle = np.array([extent[0] / 2, extent[1] / 2, prior.mean()])
    turns = np.radians((190, 80, 280))[: len(lit)]
    eyes = [middle + 1.38 * max(extent) * np.array([np.sin(turn), np.cos(turn), 1.64]) for turn in turns]
    cameras = [jaxhf.Perspective.look_at(eye, middle, fov=28.0, width=256, height=256) for eye in eyes]

    def scenes(heights: np.ndarray) -> list[jaxhf.Scene]:
        ground = jaxhf.Object(jaxhf.Heightfield(heights.astype(np.float32), *spacing), jaxhf.Matte(0.7))
        return viewed(ground, cameras, suns(*lit))

    targets, noise = noisy(by_mitsuba(sources, name, scenes(truth), eyes, middle))
    given = {"prior": jaxhf.Prior(prior, spread), **MITSUBAS} | ({"noise": noise} if noise_known else {})
    return Case(truth, scenes(prior), list(targets), given, prior)


def jacksboro(sources: Sources) -> Case:
    """128 x 128 heights of a valley in Tennessee; the noise is given."""
    terrain = jaxhf.jacksboro()
    whole, spacing = terrain.heights.astype(np.float64), (terrain.dx, terrain.dy)
    lit = [(azimuth, 35) for azimuth in (315, 75, 195)]
    return surveyed(sources, "jacksboro", whole, np.s_[100:228, 100:228], spacing, 8, lit, True)


def topobathy(sources: Sources) -> Case:
    """91 x 96 heights of land and sea floor around Juan de Fuca Strait, as if without water; the noise is not given."""
    from matplotlib.cbook import get_sample_data

    data = np.load(get_sample_data("topobathy.npz", asfileobj=False))
    whole, east, north = (data[key].astype(np.float64) for key in ("topo", "longitude", "latitude"))
    degree = np.pi / 180 * 6_371_000
    spacing = (degree * np.cos(np.radians(north.mean())) * (east[1] - east[0]), degree * (north[1] - north[0]))
    lit = [(azimuth, 35) for azimuth in (300, 60, 180)]
    return surveyed(sources, "topobathy", whole, np.s_[:, 24:], spacing, 8, lit, False)


def hfield(sources: Sources) -> Case:
    """64 x 64 heights of the ground on which MuJoCo Playground's robots learn to walk; low suns, the noise is given.

    Its heights differ from vertex to vertex like white noise. Size and height are those of its scenes: 20 m, 5 cm.
    """
    if sources.hfield is None:
        raise Missing(
            "it needs --hfield FILE: pip download playground --no-deps, and from this wheel "
            "mujoco_playground/_src/locomotion/go1/xmls/assets/hfield.png"
        )
    image = iio.imread(sources.hfield)
    whole = 0.05 * image[::-1, :, 0].astype(np.float64) / image.max()
    lit = [(azimuth, 22) for azimuth in (315, 75, 195)]
    return surveyed(sources, "hfield", whole, np.s_[:64, :64], (20 / 255, 20 / 255), 2, lit, True)


def evening(sources: Sources) -> Case:
    """One picture of a valley under a sun 18 degrees high, with long shadows, and a map; off-nadir, the noise is given."""
    terrain = jaxhf.jacksboro()
    whole = terrain.heights.astype(np.float64)
    coarse = smoothed(whole, 6)
    part = np.s_[230:310, 60:156]
    truth, prior = whole[part], coarse[part]
    extent = np.array([95 * terrain.dx, 79 * terrain.dy])
    at = np.array([*extent / 2, prior.mean()])
    eye = at + np.array([-5000.0, -9000.0, 19000.0])
    camera = jaxhf.Perspective.look_at(eye, at, fov=29.0, width=224, height=224)

    def scenes(heights: np.ndarray) -> list[jaxhf.Scene]:
        ground = jaxhf.Object(jaxhf.Heightfield(heights.astype(np.float32), terrain.dx, terrain.dy), jaxhf.Matte(0.5))
        return viewed(ground, [camera], suns((250, 18)))

    targets, noise = noisy(by_mitsuba(sources, "evening", scenes(truth), [eye], at))
    spread = float(f"{np.sqrt(np.mean((coarse - whole) ** 2)):.1e}")
    given = {"prior": jaxhf.Prior(prior, spread), "noise": noise, **MITSUBAS}
    return Case(truth, scenes(prior), list(targets), given, prior)


def photographs(sources: Sources) -> Case:
    """Grey photographs, saved as RGB, of a rough patch of soil from far away, as good as orthographic; double precision.

    The patch is 1.2 m wide; that it is level, and by how much it is not, is known.
    """
    spread = 0.02
    truth = fractal([40, 48], seed=11, exponent=1.6, range=(-0.06, 0.06))
    truth *= spread / truth.std()
    spacing = 1.2 / 47
    at = np.array([0.6, 39 / 2 * spacing, 0.0])
    eyes = [at + offset for offset in ((0.3, -1.0, 2.0), (-0.9, 0.5, 2.0), (0.9, 0.6, 2.0), (0.1, 0.2, 2.0))]
    cameras = [jaxhf.Orthographic.look_at(eye, at, extent=1.6, width=160, height=160) for eye in eyes]
    lights = suns((100, 40), (190, 40), (280, 40), (10, 40))

    def scenes(heights: np.ndarray) -> list[jaxhf.Scene]:
        ground = jaxhf.Object(jaxhf.Heightfield(heights, spacing), jaxhf.Matte(0.35))
        return viewed(ground, cameras, lights)

    grey, noise = noisy(by_mitsuba(sources, "photographs", scenes(truth), eyes, at), 0.02)
    targets = [np.repeat(picture[..., None], 3, axis=-1) for picture in grey]
    start = np.zeros_like(truth)
    given = {"prior": jaxhf.Prior(start, spread), "noise": noise, **MITSUBAS}
    return Case(truth, scenes(start), targets, given, start)


def orthophoto(sources: Sources) -> Case:
    """Two colour pictures, wider than high, of hills under a known texture; a rough map, the noise is not given."""
    truth = bumps([72, 72], seed=5, count=30, radius=0.09, range=(0.0, 60.0)) + fractal([72, 72], 6, 2.4, (-9.0, 9.0))
    grain = np.stack([fractal([128, 128], seed, 1.2, (0.0, 1.0)) for seed in (21, 22, 23)], -1)
    texels = np.array([0.45, 0.4, 0.25]) + np.array([0.25, 0.3, 0.2]) * (0.7 * grain[..., :1] + 0.3 * grain - 0.5)
    spacing, error = 5.0, 10 * fractal([72, 72], 31, 2.8, (-1.0, 1.0))
    prior = truth + error - error.mean()
    at = np.array([71 / 2 * spacing, 71 / 2 * spacing, float(prior.mean())])
    eyes = [at + offset for offset in ((350.0, -500.0, 800.0), (-450.0, 350.0, 800.0))]
    cameras = [jaxhf.Perspective.look_at(eye, at, fov=31.0, width=240, height=160) for eye in eyes]
    lights = suns((120, 38), (230, 30))
    material = jaxhf.Matte(jaxhf.ImageTexture(texels.astype(np.float32)))

    def scenes(heights: np.ndarray) -> list[jaxhf.Scene]:
        ground = jaxhf.Object(jaxhf.Heightfield(heights.astype(np.float32), spacing), material)
        return viewed(ground, cameras, lights)

    targets, _ = noisy(by_mitsuba(sources, "orthophoto", scenes(truth), eyes, at, texels))
    given = {"prior": jaxhf.Prior(prior, float(f"{error.std():.1e}")), **MITSUBAS}
    return Case(truth, scenes(prior), list(targets), given, prior)


def aslant(sources: Sources) -> Case:
    """A small mountain from four sides, 35 degrees above the horizon, with outlines against the background; no map."""
    x, y = np.meshgrid(np.linspace(-1, 1, 56), np.linspace(-1, 1, 56))
    truth = 0.16 * np.exp(-2.5 * (x**2 + y**2)) * (1 + 0.4 * (x**3 - 3 * x * y**2) / (0.1 + x**2 + y**2))
    truth += fractal([56, 56], 8, 2.2, (-0.04, 0.04))
    at = np.array([0.5, 0.5, 0.06])
    turns = np.radians((20, 115, 200, 290))
    eyes = [at + 2.0 * np.array([np.sin(t) * 0.82, np.cos(t) * 0.82, 0.57]) for t in turns]
    cameras = [jaxhf.Perspective.look_at(eye, at, fov=42.0, width=160, height=160) for eye in eyes]
    lights = suns((60, 48), (60, 48), (150, 48), (330, 48))

    def scenes(heights: np.ndarray) -> list[jaxhf.Scene]:
        ground = jaxhf.Object(jaxhf.Heightfield(heights.astype(np.float32)), jaxhf.Matte(0.6))
        return viewed(ground, cameras, lights)

    targets, noise = noisy(by_mitsuba(sources, "aslant", scenes(truth), eyes, at), 0.005)
    start = np.full(truth.shape, 0.05)
    return Case(truth, scenes(start), list(targets), {"noise": noise, **MITSUBAS}, start)


UNEXPLAINED = (
    "chi2",
    "no nearer",
    "noise allowed for",
    "boundaries allowed for",
)  # boundaries that the pictures have elsewhere
CASES = {
    "flat": Definition("float64", flat, ("mean unsure",)),
    "common-4": Definition("float32", lambda sources: common(sources, 4), UNEXPLAINED),
    "common-1": Definition("float32", lambda sources: common(sources, 1), ("one light", *UNEXPLAINED)),
    "jacksboro": Definition("float32", jacksboro),
    "topobathy": Definition("float32", topobathy),
    "hfield": Definition("float32", hfield, UNEXPLAINED),
    # Begun at the true heights it says so, too.
    "evening": Definition("float32", evening, ("unseen", "one light", *UNEXPLAINED)),
    "photographs": Definition("float64", photographs),
    "orthophoto": Definition("float32", orthophoto),
    "aslant": Definition("float32", aslant),
}


def noisy(exact: np.ndarray, share: float = 0.01) -> tuple[np.ndarray, float]:
    """Pictures with white noise, and its standard deviation, this share of the mean over the pictures of their maxima."""
    noise = share * float(np.mean([image.max() for image in exact]))
    return exact + noise * np.random.default_rng(0).standard_normal(exact.shape), noise


def smoothed(heights: np.ndarray, cells: float) -> np.ndarray:
    """A Gaussian of this standard deviation over the vertices that there are."""
    for axis, n in enumerate(heights.shape):
        at = np.arange(n)
        kernel = np.exp(-0.5 * ((at[:, None] - at) / cells) ** 2)
        kernel /= kernel.sum(1, keepdims=True)
        heights = np.moveaxis(np.tensordot(kernel, heights, (1, axis)), 0, axis)
    return heights


def map_of(truth: np.ndarray, cells: float = 8) -> jaxhf.Prior:
    """The terrain smoothed over so many cells, and how far that is off."""
    coarse = smoothed(truth, cells)
    return jaxhf.Prior(coarse, float(np.sqrt(np.mean((coarse - truth) ** 2))))


def times_nearer(prior: jaxhf.Prior, heights: object, truth: np.ndarray) -> float:
    """How many times nearer to the truth than their map heights are."""
    return prior.std / float(np.sqrt(np.mean((np.asarray(heights, np.float64) - truth) ** 2)))
