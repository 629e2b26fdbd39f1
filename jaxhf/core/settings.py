"""The settings of the renderer: what trades accuracy for speed."""

import dataclasses
import math
from typing import Literal, get_args

from .errors import ArgumentError

Traversal = Literal["pyramid", "dda"]
Shading = Literal["smooth", "flat"]
NormalScheme = Literal["central", "four", "six", "six-angle", "six-equal"]


@dataclasses.dataclass(frozen=True)
class Settings:
    """How a scene is rendered. Frozen and hashable, so that it can be a static argument of a compiled function.

    Attributes:
      traversal: "pyramid", a walk that passes over blocks of cells of all sizes by their bounds (Tevs et al. 2008);
        "dda", over single cells (Amanatides and Woo 1987). Both find the same hits, bit for bit.
      max_steps: the step budget of one walk, see `first_hit`; None: a bound that suffices for any ray. A ray that runs
        out of it ends with `Status.EXHAUSTED`, which `render` shows black and the AOVs "status" and "exhausted" report.
      shading: "smooth", interpolated normals; "flat", the triangle's own.
      normals: at the vertices, see `vertex_normals`.
      shadows: whether surfaces between a light and a point keep its light off.
      samples: rays a pixel, a square number: the centres of a regular n x n grid. None: what the scene says, rounded up
        to a square.
      max_depth: how often a ray may be mirrored; what it would meet after that counts as black.
      edge_samples: for derivatives alone: how many points are drawn on the terrain's edges, in all, to take the derivative of
        moving silhouettes and shadow boundaries, with about as many additional samples in the pixels where these are seen,
        see docs/gradients.md. 0: only the derivative of each sample's radiance. The picture is the same.
      chunk: rays that are traced together; rounded down to a square of 8 x 8, 16 x 16, ... pixels.
    """

    traversal: Traversal = "pyramid"
    max_steps: int | None = None
    shading: Shading = "smooth"
    normals: NormalScheme = "six"
    shadows: bool = True
    samples: int | None = None
    max_depth: int = 4
    edge_samples: int = 0
    chunk: int = 1024

    @classmethod
    def draft(cls) -> "Settings":
        """One sample a pixel: to find a view. RMSE of the picture at most 0.35 of its mean, see docs/tradeoff.md."""
        return cls(samples=1, edge_samples=10_000)

    @classmethod
    def balanced(cls) -> "Settings":
        """Nine samples a pixel: to look at. RMSE of the picture at most 0.07 of its mean, see docs/tradeoff.md."""
        return cls(samples=9, edge_samples=100_000)

    @classmethod
    def exact(cls) -> "Settings":
        """64 samples a pixel: to measure with. RMSE of the picture at most 0.02 of its mean, see docs/tradeoff.md."""
        return cls(samples=64, edge_samples=300_000)

    def __post_init__(self):
        for name, kind in (("traversal", Traversal), ("shading", Shading), ("normals", NormalScheme)):
            if getattr(self, name) not in get_args(kind):
                raise ArgumentError(
                    "Settings", name, f"must be one of {', '.join(get_args(kind))}; it is {getattr(self, name)!r}"
                )
        if not isinstance(self.shadows, bool):
            raise ArgumentError("Settings", "shadows", f"must be True or False, it is {self.shadows!r}")
        for name, least in (("max_steps", 1), ("samples", 1), ("max_depth", 0), ("edge_samples", 0), ("chunk", 64)):
            value = getattr(self, name)
            if value is None and name in ("max_steps", "samples"):
                continue
            if not isinstance(value, int) or isinstance(value, bool) or value < least:
                raise ArgumentError("Settings", name, f"must be a whole number from {least} on, it is {value!r}")
        if self.samples is not None and math.isqrt(self.samples) ** 2 != self.samples:
            raise ArgumentError("Settings", "samples", f"must be a square number (1, 4, 9, ...), it is {self.samples}")
