"""A small fit of a scene's terrain, whose truth is known."""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from ..core.settings import Settings
from ..fitting.fit import fit
from ..rendering.render import render
from ..scene.camera import Orthographic
from ..scene.heightfield import Heightfield
from ..scene.light import Directional
from ..scene.material import Matte
from ..scene.scene import Object, Scene

FIT_HEIGHTS, FIT_PIXELS = 32, 64  # a side, at most


def dct_modes(n: int, count: int) -> Float[np.ndarray, "n k"]:
    """The first modes of the DCT-II, a column each."""
    return np.cos(np.pi * np.arange(count) * (np.arange(n)[:, None] + 0.5) / n)


def thinned(field: Heightfield, most: int) -> Heightfield:
    """Every n-th height, along each side, so that there are at most so many a side."""
    down, across = (max(1, math.ceil(n / most)) for n in field.heights.shape)
    return Heightfield(np.asarray(field.heights)[::down, ::across], across * field.dx, down * field.dy, field.x0, field.y0)


def from_above(field: Heightfield, pixels: int) -> Orthographic:
    """A camera that sees a whole heightfield from straight above, north up.

    Args:
      pixels: of the picture's longer side. The shorter one has as many as make them square, rounded up, so that less than
        half a pixel on either side shows the surroundings.
    """
    (ny, nx), heights = field.heights.shape, np.asarray(field.heights)
    across, up = (nx - 1) * field.dx, (ny - 1) * field.dy
    longer = max(across, up)
    # A product that is whole but for rounding is not rounded up.
    width, height = (math.ceil(pixels * side / longer - 1e-9) for side in (across, up))
    x, y, z = field.x0 + across / 2, field.y0 + up / 2, float(heights[np.isfinite(heights)].max()) + longer
    extent = max(across / width, up / height) * min(width, height)
    return Orthographic.look_at((x, y, z), (x, y, z - 1), up=(0, 1, 0), extent=extent, width=width, height=height)


class Recovery:
    """A small fit: the scene's first heightfield, thinned, found again from a smoothed prior and three pictures.

    They are taken from straight above, each in the light of a sun of its own, as from one picture in the scene's own view a
    fit of such terrain ends wherever its first shadows stop it, whatever its tolerance.
    """

    def __init__(self, scene: Scene, settings: Settings, tolerance: float, levels: str):
        """
        Args:
          levels: "coarse to fine", or the shares of the highest frequency that `fit` takes as levels, separated by spaces.
        """
        field = thinned(scene.heightfields[0], FIT_HEIGHTS)
        self.truth = np.asarray(field.heights, np.float64)
        camera, ground = from_above(field, FIT_PIXELS), Object(field, Matte(0.6))
        self.scenes = [Scene([ground], camera, [Directional.from_angles(azimuth, 45.0)]) for azimuth in (30.0, 150.0, 270.0)]
        exact = dataclasses.replace(settings, samples=16)
        self.targets = [np.asarray(render(lit, exact)) for lit in self.scenes]
        rows, columns = (dct_modes(n, max(2, n // 8)) for n in self.truth.shape)
        prior = rows @ (np.linalg.pinv(rows) @ self.truth @ np.linalg.pinv(columns).T) @ columns.T
        self.options: dict[str, Any] = {
            "settings": settings, "noise": 0.01 * float(np.mean(self.targets)), "start": prior, "prior": prior,
            "prior_std": float((prior - self.truth).std()), "tolerance": tolerance,
            "levels": None if levels == "coarse to fine" else tuple(map(float, levels.split())),
        }  # fmt: skip

    def run(self) -> Float[np.ndarray, "ny nx"]:
        self.heights = np.asarray(fit(self.scenes, self.targets, **self.options).heights, np.float64)
        return self.heights

    def errors(self, reference: Mapping[str, np.ndarray]) -> dict[str, float]:
        """RMSE of the heights over their range; no reference is needed, as the truth is known."""
        return {"rmse": float(np.sqrt(np.mean((self.heights - self.truth) ** 2)) / np.ptp(self.truth))}
