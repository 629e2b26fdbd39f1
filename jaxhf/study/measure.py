"""What a sweep measures: errors of pictures, of derivatives and of small fits, in the process of a `Worker`."""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from ..core.settings import Settings
from ..fitting.fit import fit
from ..io.files import reading, replacing
from ..io.scenes import load_scene
from ..rendering.cast import cast_camera
from ..rendering.render import render
from ..scene.heightfield import Heightfield
from ..scene.light import Directional
from ..scene.material import Matte
from ..scene.scene import Object, Scene
from ..scene.views import from_above, resized, shrunk
from ..xla.compilation import compiled
from ..xla.machine import peak_mb
from .plan import Configuration, Sweep
from .worker import Answers, timed

DERIVATIVE_PIXELS = 160  # of the longer side: a derivative costs some times a picture
MODES = 8  # a side: the gradient is compared along the 8 x 8 smoothest DCT modes of the heights
DRAWS = 4  # of the points on edges, whose errors are taken together: one draw's error is as much luck as settings
FIT_HEIGHTS, FIT_PIXELS = 32, 64  # a side, at most
LEAST_SECONDS = 0.25  # of a measurement: single runs of 5 ms differed by a third from sweep to sweep
_CAST = 1 << 16  # rays that are cast together where hits are compared


def centre_hits(scene: Scene, settings: Settings) -> Int[np.ndarray, "n 5"]:
    """Object, cell, triangle and status of the hits through the pixels' centres; the first four -1 where there is none."""
    settings = dataclasses.replace(settings, samples=1, edge_samples=0)  # one program for any
    width, count = scene.camera.width, scene.camera.width * scene.camera.height
    parts = []
    for first in range(0, count, _CAST):
        pixels = np.minimum(np.arange(first, first + _CAST), count - 1)
        hit = jax.device_get(cast_camera(scene, pixels % width + 0.5, pixels // width + 0.5, settings))
        where = np.stack([hit.object, *hit.cell.T, hit.triangle], -1)
        parts.append(np.concatenate([np.where(hit.object[:, None] >= 0, where, -1), hit.status[:, None]], -1))
    return np.concatenate(parts)[:count].astype(np.int32)


class Picture:
    """A frame from heights to image, normals and bounds included."""

    def __init__(self, scene: Scene, one: Configuration):
        self.scene, self.settings = scene, one.settings

    def run(self) -> jax.Array:
        self.image = jax.block_until_ready(render(self.scene, self.settings))
        return self.image

    def reference(self) -> dict[str, np.ndarray]:
        return {"picture": np.asarray(self.run(), np.float64), "hits": centre_hits(self.scene, self.settings)}

    def errors(self, reference: Mapping[str, np.ndarray]) -> dict[str, float]:
        """RMSE and 99.9 % of the difference (of a pixel's worst channel) over the mean radiance; the share of wrong hits."""
        difference = np.asarray(self.image, np.float64) - reference["picture"]
        found = np.sqrt(np.mean(difference**2)), np.quantile(np.abs(difference).max(-1), 0.999)
        rmse, p999 = np.array(found) / (np.mean(reference["picture"]) or 1.0)
        wrong = (centre_hits(self.scene, self.settings) != reference["hits"]).any(-1).mean()
        return {"rmse": float(rmse), "p999": float(p999), "wrong_hits": float(wrong)}


class Derivative:
    """Value and gradient, in all heights, of a loss: the picture under a smooth seeded weight."""

    def __init__(self, scene: Scene, one: Configuration):
        scene = shrunk(scene, DERIVATIVE_PIXELS)
        self.heights = jnp.asarray(scene.heights)
        modes = _dct_modes(scene.camera.height, 6), _dct_modes(scene.camera.width, 6)
        amplitudes = np.random.default_rng(0).normal(size=(6, 6, 3))
        weights = jnp.asarray(np.einsum("yi,xj,ijc->yxc", *modes, amplitudes), self.heights.dtype)

        def loss(heights: jax.Array, key: jax.Array) -> jax.Array:
            return jnp.sum(weights * render(scene.with_heights(heights), one.settings, key=key))

        self.step = compiled(jax.value_and_grad(loss))

    def run(self, draw: int = 0) -> jax.Array:
        return jax.block_until_ready(self.step(self.heights, jax.random.key(draw)))[1]

    def along_modes(self, draw: int) -> Float[np.ndarray, " n"]:
        """The gradient along the smoothest DCT modes; in single heights it drowns in the noise of the points on edges."""
        gradient = np.asarray(self.run(draw), np.float64)
        modes = [_dct_modes(n, MODES) for n in gradient.shape]
        return np.einsum("yi,yx,xj->ij", modes[0], gradient, modes[1]).ravel()

    def reference(self) -> dict[str, np.ndarray]:
        """The mean over draws, none of which is one that `errors` looks at."""
        return {"gradient": np.mean([self.along_modes(DRAWS + draw) for draw in range(DRAWS)], axis=0)}

    def errors(self, reference: Mapping[str, np.ndarray]) -> dict[str, float]:
        """Mean cosine to the reference, root mean square and spread of the differences' lengths over the reference's."""
        exact, draws = reference["gradient"], np.stack([self.along_modes(draw) for draw in range(DRAWS)])
        length, lengths = np.linalg.norm(exact) or 1.0, np.linalg.norm(draws, axis=1)
        cosines = draws @ exact / np.where(lengths > 0, lengths, 1.0) / length
        relative = np.linalg.norm(draws - exact, axis=1) / length
        rms = float(np.sqrt(np.mean(relative**2)))
        return {"cosine": float(cosines.mean()), "relative_error": rms, "spread": float(relative.std(ddof=1))}


def _dct_modes(n: int, count: int) -> Float[np.ndarray, "n k"]:
    """The first modes of the DCT-II, a column each."""
    return np.cos(np.pi * np.arange(count) * (np.arange(n)[:, None] + 0.5) / n)


class Recovery:
    """A small fit: the scene's first heightfield, thinned, found again from a smoothed prior and three pictures.

    They are taken from straight above, each in the light of a sun of its own, as from one picture in the scene's own view a
    fit of such terrain ends wherever its first shadows stop it, whatever its tolerance.
    """

    def __init__(self, scene: Scene, one: Configuration):
        field = thinned(scene.heightfields[0], FIT_HEIGHTS)
        self.truth = np.asarray(field.heights, np.float64)
        ny, nx = self.truth.shape
        wide = (nx - 1) * field.dx > (ny - 1) * field.dy
        camera = from_above(field, FIT_PIXELS if wide else None, None if wide else FIT_PIXELS)
        ground = Object(field, Matte(0.6))
        self.scenes = [Scene([ground], camera, [Directional.from_angles(azimuth, 45.0)]) for azimuth in (30.0, 150.0, 270.0)]
        exact = one.replace(samples=16).settings
        self.targets = [np.asarray(render(lit, exact)) for lit in self.scenes]
        rows, columns = (_dct_modes(n, max(2, n // 8)) for n in (ny, nx))
        prior = rows @ (np.linalg.pinv(rows) @ self.truth @ np.linalg.pinv(columns).T) @ columns.T
        self.options: dict[str, Any] = {
            "settings": one.settings, "noise": 0.01 * float(np.mean(self.targets)), "start": prior, "prior": prior,
            "prior_std": float((prior - self.truth).std()), "tolerance": one.tolerance, "levels": one.levels,
        }  # fmt: skip

    def run(self) -> Float[np.ndarray, "ny nx"]:
        self.heights = np.asarray(fit(self.scenes, self.targets, **self.options).heights, np.float64)
        return self.heights

    def reference(self) -> dict[str, np.ndarray]:
        return {}  # the truth is known

    def errors(self, reference: Mapping[str, np.ndarray]) -> dict[str, float]:
        return {"rmse": float(np.sqrt(np.mean((self.heights - self.truth) ** 2)) / np.ptp(self.truth))}


def thinned(field: Heightfield, most: int) -> Heightfield:
    """Every n-th height, along each side, so that there are at most so many a side."""
    down, across = (max(1, math.ceil(n / most)) for n in field.heights.shape)
    return Heightfield(np.asarray(field.heights)[::down, ::across], across * field.dx, down * field.dy, field.x0, field.y0)


def prepare(job: tuple[Sweep, Configuration]) -> Answers:
    """What a process answers of one configuration: "ready", "frame", "errors", and "reference", which keeps its results."""
    sweep, one = job
    jax.config.update("jax_enable_x64", one.precision == "float64")
    jax.config.update("jax_num_cpu_devices", sweep.devices)
    jax.config.update("jax_enable_compilation_cache", False)  # the time of compilation is a figure
    scene = resized(load_scene(sweep.path, np.dtype(one.precision)), sweep.width, sweep.height)
    measured = {"picture": Picture, "derivative": Derivative, "fit": Recovery}[one.task](scene, one)
    path = sweep.reference(one.task)

    def first() -> dict[str, float]:
        seconds, device = timed(measured.run)["seconds"], jax.local_devices()[0]
        held = peak_mb() if device.platform == "cpu" else (device.memory_stats() or {}).get("peak_bytes_in_use", 0) / 2**20
        return {"first_seconds": seconds, "peak_mb": held}

    def keep() -> dict[str, float]:
        with replacing(path) as temporary, temporary.open("wb") as file:
            np.savez(file, **measured.reference())  # pyright: ignore[reportArgumentType] - an array's name is no option
        return {}

    def errors() -> dict[str, float]:
        if one.task == "fit":
            return measured.errors({})
        with reading(path), np.load(path) as reference:
            return measured.errors(reference)

    return {"ready": first, "frame": lambda: timed(measured.run, LEAST_SECONDS), "errors": errors, "reference": keep}
