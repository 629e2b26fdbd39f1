"""What a sweep measures, in the process of a `Worker`: errors of pictures and of derivatives."""

import dataclasses
from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from ..core.settings import Settings
from ..io.files import reading, replacing
from ..io.scenes.load import load_scene
from ..rendering.cast import cast_camera
from ..rendering.render import render
from ..scene.scene import Scene, resized, shrunk
from ..xla.compilation import compiled
from ..xla.devices import peak_device_mb
from .table import SETTINGS, Row, Sweep
from .worker import Answers, timed

DERIVATIVE_PIXELS = 160  # of the longer side: a derivative costs some times a picture
MODES = 8  # a side: the gradient is compared along the 8 x 8 smoothest DCT modes of the heights
DRAWS = 4  # of the points on edges, whose errors are taken together: one draw's error is as much luck as settings
LEAST_SECONDS = 0.25  # of a measurement: single runs of 5 ms differed by a third from sweep to sweep
_CAST = 1 << 16  # rays that are cast together where hits are compared


def dct_modes(n: int, count: int) -> Float[np.ndarray, "n k"]:
    """The first modes of the DCT-II, a column each."""
    return np.cos(np.pi * np.arange(count) * (np.arange(n)[:, None] + 0.5) / n)


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

    def __init__(self, scene: Scene, settings: Settings):
        self.scene, self.settings = scene, settings

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

    def __init__(self, scene: Scene, settings: Settings):
        scene = shrunk(scene, DERIVATIVE_PIXELS)
        self.heights = jnp.asarray(scene.heights)
        modes = dct_modes(scene.camera.height, 6), dct_modes(scene.camera.width, 6)
        amplitudes = np.random.default_rng(0).normal(size=(6, 6, 3))
        weights = jnp.asarray(np.einsum("yi,xj,ijc->yxc", *modes, amplitudes), self.heights.dtype)

        def loss(heights: jax.Array, key: jax.Array) -> jax.Array:
            return jnp.sum(weights * render(scene.with_heights(heights), settings, key=key))

        self.step = compiled(jax.value_and_grad(loss))

    def run(self, draw: int = 0) -> jax.Array:
        return jax.block_until_ready(self.step(self.heights, jax.random.key(draw)))[1]

    def along_modes(self, draw: int) -> Float[np.ndarray, " n"]:
        """The gradient along the smoothest DCT modes; in single heights it drowns in the noise of the points on edges."""
        gradient = np.asarray(self.run(draw), np.float64)
        modes = [dct_modes(n, MODES) for n in gradient.shape]
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


def prepare(job: tuple[Sweep, Row]) -> Answers:
    """What a process answers of one configuration: "ready", "frame", "errors", and "reference", which keeps its results."""
    sweep, one = job
    jax.config.update("jax_enable_x64", one["precision"] == "float64")
    jax.config.update("jax_num_cpu_devices", sweep.devices)
    jax.config.update("jax_enable_compilation_cache", False)  # the time of compilation is a figure
    scene = resized(load_scene(sweep.path, np.dtype(one["precision"])), sweep.width, sweep.height)
    settings = Settings(**{name: one[name] for name in SETTINGS})
    measured = {"picture": Picture, "derivative": Derivative}[one["task"]](scene, settings)
    path = sweep.reference(one["task"])

    def first() -> dict[str, float]:
        return {"first_seconds": timed(measured.run)["seconds"], "peak_mb": peak_device_mb()}

    def keep() -> dict[str, float]:
        with replacing(path) as temporary, temporary.open("wb") as file:
            np.savez(file, **measured.reference())
        return {}

    def errors() -> dict[str, float]:
        with reading(path), np.load(path) as reference:
            return measured.errors(reference)

    return {"ready": first, "frame": lambda: timed(measured.run, LEAST_SECONDS), "errors": errors, "reference": keep}
