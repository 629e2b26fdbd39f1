"""The cases on which the default call of `jaxhf.fit` is judged: six that were looked at while it was built.

A case gives what a user would have, and no more: scenes, pictures, the noise where it is known, a coarse map and its deviation
where there is one. No settings, loss, length, levels or solver; `hfield-angle` alone has settings.
"""

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import imageio.v3 as iio
import numpy as np
from matplotlib.cbook import get_sample_data
from peers import View, common_work, mitsuba_picture

import jaxhf
from jaxhf.io.procedural import fractal

LIGHTS = ((0.5, -0.3, 0.6), (0.3, 0.5, 0.6), (-0.5, 0.3, 0.6), (-0.3, -0.5, 0.6))
SAMPLES = 1024  # a pixel, of Mitsuba's pictures


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
        if self.targets is None:
            return make()
        kept = self.targets / f"{name}.npz"
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
    """How a case is made, and in which precision it is solved; JAX's x64 mode must be set to that before."""

    precision: str
    make: Callable[[Sources], Case]


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
    return Case(truth, scenes, list(stored["images"][:count]), {}, start)


def surveyed(
    sources: Sources,
    name: str,
    whole: np.ndarray,
    part: tuple[slice, slice],
    spacing: tuple[float, float],
    cells: float,
    suns: Sequence[tuple[float, float]],
    noise_known: bool,
) -> Case:
    """A part of a terrain of which a smoothed map is known, from 256 x 256 pictures by Mitsuba with 1 % noise.

    The cameras stand around the part, 31 degrees from the vertical, and see all of its border.

    Args:
      whole: all heights that there are of this terrain.
      spacing: dx, dy.
      cells: standard deviation of the Gaussian by which the map was smoothed.
      suns: azimuth and altitude of one light a picture, degrees.
      noise_known: whether the fit is told how large the noise is.
    """
    coarse = smoothed(whole, cells)
    # What the map is off by over the whole terrain, to two digits, as a map's legend would say.
    spread = float(f"{np.sqrt(np.mean((coarse - whole) ** 2)):.1e}")
    truth, prior = whole[part], coarse[part]
    extent = ((truth.shape[1] - 1) * spacing[0], (truth.shape[0] - 1) * spacing[1])
    middle = np.array([extent[0] / 2, extent[1] / 2, prior.mean()])
    views: list[View] = []
    for turn in np.radians((190, 80, 280))[: len(suns)]:
        offset = 1.38 * max(extent) * np.array([np.sin(turn), np.cos(turn), 1.64])
        views.append(((middle + offset).tolist(), middle.tolist(), 28.0))
    lights = [jaxhf.Directional.from_angles(azimuth=azimuth, altitude=altitude) for azimuth, altitude in suns]
    exact = sources.pictures(
        name,
        lambda: np.stack(
            [
                mitsuba_picture(truth, view, np.asarray(light.towards).tolist(), 256, SAMPLES, 0.7, extent)
                for view, light in zip(views, lights, strict=True)
            ]
        ),
    )
    cameras = [jaxhf.Perspective.look_at(eye, at, fov=fov, width=256, height=256) for eye, at, fov in views]
    ground = jaxhf.Object(jaxhf.Heightfield(prior.astype(np.float32), *spacing), jaxhf.Matte(0.7))
    scenes = viewed(ground, cameras, lights)
    targets, noise = noisy(exact)
    given = {"prior": prior, "prior_std": spread} | ({"noise": noise} if noise_known else {})
    return Case(truth, scenes, list(targets), given, prior)


def jacksboro(sources: Sources) -> Case:
    """128 x 128 heights of a valley in Tennessee; the noise is given."""
    terrain = jaxhf.jacksboro()
    whole, spacing = terrain.heights.astype(np.float64), (terrain.dx, terrain.dy)
    suns = [(azimuth, 35) for azimuth in (315, 75, 195)]
    return surveyed(sources, "jacksboro", whole, np.s_[100:228, 100:228], spacing, 8, suns, True)


def topobathy(sources: Sources) -> Case:
    """91 x 96 heights of land and sea floor around Juan de Fuca Strait, as if without water; the noise is not given."""
    data = np.load(get_sample_data("topobathy.npz", asfileobj=False))
    whole, east, north = (data[key].astype(np.float64) for key in ("topo", "longitude", "latitude"))
    degree = np.pi / 180 * 6_371_000
    spacing = (degree * np.cos(np.radians(north.mean())) * (east[1] - east[0]), degree * (north[1] - north[0]))
    suns = [(azimuth, 35) for azimuth in (300, 60, 180)]
    return surveyed(sources, "topobathy", whole, np.s_[:, 24:], spacing, 8, suns, False)


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
    suns = [(azimuth, 22) for azimuth in (315, 75, 195)]
    return surveyed(sources, "hfield", whole, np.s_[:64, :64], (20 / 255, 20 / 255), 2, suns, True)


def hfield_angle(sources: Sources) -> Case:
    """`hfield` by a user who knows that normals are weighted by angle, as Mitsuba's are."""
    case = hfield(sources)
    return dataclasses.replace(case, given=case.given | {"settings": jaxhf.Settings(normals="six-angle")})


CASES = {
    "flat": Definition("float64", flat),
    "common-4": Definition("float32", lambda sources: common(sources, 4)),
    "common-1": Definition("float32", lambda sources: common(sources, 1)),
    "jacksboro": Definition("float32", jacksboro),
    "topobathy": Definition("float32", topobathy),
    "hfield": Definition("float32", hfield),
    "hfield-angle": Definition("float32", hfield_angle),
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
