"""One configuration's cost and error; `python -m jaxhf.study.measure --serve` does it in a process of its own."""

import dataclasses
import math
from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from ..core.machine import peak_mb
from ..core.settings import Settings
from ..fitting.fit import fit
from ..io.scenes import load_scene
from ..rendering.cast import cast_camera
from ..rendering.render import render
from ..scene.heightfield import Heightfield
from ..scene.light import Directional
from ..scene.material import Matte
from ..scene.scene import Object, Scene
from ..scene.views import from_above, resized, shrunk
from .table import known_reference, load_reference, save_reference
from .worker import serve, timed

DERIVATIVE_PIXELS = 160  # of the longer side: a derivative costs some times a picture


WAVES = 8  # a side: the gradient is compared along the 8 x 8 smoothest changes of the heights


DRAWS = 4  # of the points on edges, whose errors are taken together: one draw's error is as much luck as settings


FIT_HEIGHTS, FIT_PIXELS = 32, 64  # a side, at most


LEAST_SECONDS = 0.25  # of a measurement: single runs of 5 ms differed by a third from sweep to sweep


# Rays that are cast together where hits are compared.
_CAST = 1 << 16


def picture_errors(image: Float[np.ndarray, "h w 3"], reference: Float[np.ndarray, "h w 3"]) -> dict[str, float]:
    """Root mean square and 99.9 % of the difference (of a pixel's worst channel), over the reference's mean radiance."""
    difference = np.asarray(image, np.float64) - reference
    mean = float(np.mean(reference)) or 1.0
    worst = np.abs(difference).max(-1)
    return {"rmse": float(np.sqrt(np.mean(difference**2))) / mean, "p999": float(np.quantile(worst, 0.999)) / mean}


def wrong_share(found: Int[np.ndarray, "n k"], reference: Int[np.ndarray, "n k"]) -> float:
    """Of rows that differ anywhere."""
    return float(np.mean((found != reference).any(-1)))


def gradient_errors(found: Float[np.ndarray, " n"], reference: Float[np.ndarray, " n"]) -> dict[str, float]:
    lengths = float(np.linalg.norm(found)), float(np.linalg.norm(reference))
    cosine = float(np.vdot(found, reference)) / (lengths[0] * lengths[1]) if all(lengths) else 0.0
    return {"cosine": cosine, "relative_error": float(np.linalg.norm(found - reference)) / (lengths[1] or 1.0)}


def centre_hits(scene: Scene, settings: Settings) -> Int[np.ndarray, "n 5"]:
    """Object, cell, triangle and status of the hits through the pixels' centres; the first four -1 where there is none."""
    x, y = np.meshgrid(np.arange(scene.camera.width) + 0.5, np.arange(scene.camera.height) + 0.5)
    x, y = x.ravel(), y.ravel()
    parts = []
    for first in range(0, x.size, _CAST):
        part = np.minimum(np.arange(first, first + _CAST), x.size - 1)
        hit = jax.device_get(cast_camera(scene, x[part], y[part], settings))
        found = hit.object >= 0
        place = np.stack([hit.object, *hit.cell.T, hit.triangle], -1)
        parts.append(np.concatenate([np.where(found[:, None], place, -1), hit.status[:, None]], -1))
    return np.concatenate(parts)[: x.size].astype(np.int32)


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
        wrong = wrong_share(centre_hits(self.scene, self.settings), reference["hits"])
        return picture_errors(np.asarray(self.image), reference["picture"]) | {"wrong_hits": wrong}


class Derivative:
    """Value and gradient, in all heights, of a loss: the picture under a smooth seeded weight.

    What is compared is the gradient along the smoothest changes of the heights, as single heights are lost in the noise of
    the points on edges.
    """

    def __init__(self, scene: Scene, settings: Settings):
        self.scene = scene = shrunk(scene, DERIVATIVE_PIXELS)
        self.heights = jnp.asarray(scene.heights)
        waves = np.random.default_rng(0).normal(size=(6, 6, 3))
        rows, columns = _cosines(scene.camera.height, 6), _cosines(scene.camera.width, 6)
        weights = jnp.asarray(np.einsum("yi,xj,ijc->yxc", rows, columns, waves), self.heights.dtype)

        def loss(heights: jax.Array, key: jax.Array) -> jax.Array:
            return jnp.sum(weights * render(scene.with_heights(heights), settings, key=key))

        self.step = eqx.filter_jit(jax.value_and_grad(loss))

    def run(self, draw: int = 0) -> jax.Array:
        return jax.block_until_ready(self.step(self.heights, jax.random.key(draw)))[1]

    def reference(self) -> dict[str, np.ndarray]:
        """The mean over draws, none of which is one that `errors` looks at."""
        return {"gradient": np.mean([self._along_waves(DRAWS + draw) for draw in range(DRAWS)], axis=0)}

    def errors(self, reference: Mapping[str, np.ndarray]) -> dict[str, float]:
        draws = [gradient_errors(self._along_waves(draw), reference["gradient"]) for draw in range(DRAWS)]
        relative = np.array([errors["relative_error"] for errors in draws])
        return {
            "cosine": float(np.mean([errors["cosine"] for errors in draws])),
            "relative_error": float(np.sqrt(np.mean(relative**2))),
            "spread": float(relative.std(ddof=1)),
        }

    def _along_waves(self, draw: int) -> Float[np.ndarray, " n"]:
        gradient = np.asarray(self.run(draw), np.float64)
        ny, nx = gradient.shape
        return np.einsum("yi,yx,xj->ij", _cosines(ny, WAVES), gradient, _cosines(nx, WAVES)).ravel()


def _cosines(n: int, count: int) -> Float[np.ndarray, "n k"]:
    return np.cos(np.pi * np.arange(count) * (np.arange(n)[:, None] + 0.5) / n)


class Recovery:
    """A small fit: the scene's first heightfield, thinned, found again from a smoothed prior and three pictures.

    They are taken from straight above, each in the light of a sun of its own, as from one picture in the scene's own view a
    fit of such terrain ends wherever its first shadows stop it, whatever its tolerance.
    """

    def __init__(self, scene: Scene, settings: Settings, tolerance: float, levels: list[float] | None):
        field = _thinned(scene.heightfields[0], FIT_HEIGHTS)
        self.truth = np.asarray(field.heights, np.float64)
        ny, nx = self.truth.shape
        wide = (nx - 1) * field.dx > (ny - 1) * field.dy
        camera = from_above(field, FIT_PIXELS if wide else None, None if wide else FIT_PIXELS)
        ground = Object(field, Matte(0.6))
        scenes = [Scene([ground], camera, [Directional.from_angles(azimuth, 45.0)]) for azimuth in (30.0, 150.0, 270.0)]
        targets = [np.asarray(render(scene, dataclasses.replace(settings, samples=16))) for scene in scenes]
        basis = [_cosines(n, max(2, n // 8)) for n in self.truth.shape]
        inverse = [np.linalg.pinv(one) for one in basis]
        prior = basis[0] @ (inverse[0] @ self.truth @ inverse[1].T) @ basis[1].T
        options: dict[str, Any] = {
            "settings": settings, "noise": 0.01 * float(np.mean(targets)), "start": prior, "prior": prior,
            "prior_std": float((prior - self.truth).std()), "tolerance": tolerance, "levels": levels,
        }  # fmt: skip
        self.fit: Callable[[], Any] = lambda: fit(scenes, targets, **options)

    def run(self) -> Float[np.ndarray, "ny nx"]:
        self.heights = np.asarray(self.fit().heights, np.float64)
        return self.heights

    def errors(self, reference: Mapping[str, np.ndarray]) -> dict[str, float]:
        del reference  # the truth is known
        return {"rmse": float(np.sqrt(np.mean((self.heights - self.truth) ** 2)) / np.ptp(self.truth))}


def _thinned(field: Heightfield, most: int) -> Heightfield:
    """Every n-th height, along each side, so that there are at most so many a side."""
    down, across = (max(1, math.ceil(n / most)) for n in field.heights.shape)
    return Heightfield(np.asarray(field.heights)[::down, ::across], across * field.dx, down * field.dy, field.x0, field.y0)


def _make(job: dict[str, Any], task: str, settings: Settings) -> Picture | Derivative | Recovery:
    scene = resized(load_scene(job["scene"], np.dtype(job["precision"])), job["width"], job["height"])
    if task == "picture":
        return Picture(scene, settings)
    if task == "derivative":
        return Derivative(scene, settings)
    return Recovery(scene, settings, job["tolerance"], job["levels"])


def _prepare(job: dict[str, Any]) -> dict[str, Callable[[], Mapping[str, Any]]]:
    jax.config.update("jax_enable_x64", job["precision"] == "float64")
    jax.config.update("jax_num_cpu_devices", job["devices"])
    jax.config.update("jax_enable_compilation_cache", False)  # the time of compilation is a figure
    settings = Settings(**job["settings"])
    if job["task"] == "reference":

        def make_reference() -> dict[str, Any]:
            others = known_reference(job["reference"], job["identity"])
            made = _make(job, job["of"], dataclasses.replace(settings, **job["finest"]))
            assert not isinstance(made, Recovery)
            save_reference(job["reference"], job["identity"], others | made.reference())
            return {}

        return {"ready": make_reference}
    measured = _make(job, job["task"], settings)

    def first() -> dict[str, float]:
        taken = timed(measured.run)
        return {"first_seconds": taken["seconds"], "peak_mb": _peak()}

    return {
        "ready": first,
        "frame": lambda: timed(measured.run, LEAST_SECONDS),
        "errors": lambda: measured.errors({} if job["task"] == "fit" else load_reference(job["reference"], job["identity"])),
    }


def _peak() -> float:
    device = jax.local_devices()[0]
    if device.platform == "cpu":
        return peak_mb()
    return (device.memory_stats() or {}).get("peak_bytes_in_use", 0) / 2**20


if __name__ == "__main__":
    serve(_prepare)
