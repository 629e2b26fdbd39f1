"""The settings of the renderer: what trades accuracy for speed."""

import dataclasses
import inspect
import math
import textwrap
from typing import Any, Literal

from .errors import ArgumentError, whole_number
from .rules import OneOf, Rule, Whole, flag, require_fields

Traversal = Literal["pyramid", "dda"]
Shading = Literal["smooth", "flat"]
NormalScheme = Literal["central", "four", "six", "six-angle", "six-equal"]

_MOST_CHUNK = 2**20  # of 1024 x 1024 pixels; each device takes 300 bytes a ray
MOST_SAMPLES = 2**20  # of a grid of 1024 x 1024 in each pixel
_MOST = 2**31 - 1


def _setting(default: Any, rule: Rule, help: str, **more: str) -> Any:
    """A field of `Settings`.

    Args:
      help: for its documentation and the command line's --help.
      more: `none`, what None stands for, and `metavar`, what the command line calls the value; that is N for whole numbers.
    """
    return dataclasses.field(default=default, metadata={"rule": rule, "help": help, **more})


@dataclasses.dataclass(frozen=True)
class Settings:
    """How a scene is rendered. Frozen and hashable, so that it can be a static argument of a compiled function."""

    traversal: Traversal = _setting(
        "pyramid",
        OneOf(Traversal),
        "search for a ray's first hit: pyramid, which skips blocks of cells by their bounds (Tevs et al. 2008), or "
        "dda, cell by cell (Amanatides and Woo 1987); the hits are the same, bit for bit",
        metavar="SEARCH",
    )
    max_steps: int | None = _setting(
        None,
        Whole(1, _MOST),
        "step budget of one search; a ray that exhausts it is black, and the AOVs status and exhausted say so",
        none="as many as any ray needs",
    )
    early_exit: bool = _setting(
        True,
        flag,
        "the end of a search when all rays of its batch have ended; without it each search is a loop of max_steps "
        "steps, or of as many as any ray needs, nothing else is skipped either where no ray needs it, and all views of "
        "a scene take the same time; the hits are the same, bit for bit",
    )
    shading: Shading = _setting(
        "smooth", OneOf(Shading), "smooth, by interpolated normals, or flat, by the triangle's own normal"
    )
    normals: NormalScheme | None = _setting(
        None,
        OneOf(NormalScheme),
        "normals at the vertices: central, of central differences; four, the mean of four triangles; the mean of "
        "the six that touch the vertex, weighted by area (six), by angle (six-angle) or equally (six-equal)",
        none="six",
        metavar="SCHEME",
    )
    shadows: bool = _setting(True, flag, "shadows of every light but the sky, which casts none")
    samples: int | None = _setting(
        None,
        Whole(1, MOST_SAMPLES),
        "rays a pixel, a square number: the centres of a regular n x n grid",
        none="the scene's, rounded up to a square",
    )
    max_depth: int = _setting(4, Whole(0, _MOST), "mirror bounces of a ray, beyond which the rest counts as black")
    edge_samples: int | None = _setting(
        None,
        Whole(0, _MOST),
        "points on terrain edges, in all, at which the derivative of moving silhouettes and shadow boundaries is "
        "taken, and about as many samples more in the pixels that see them, see docs/concepts/boundary.md; 0: the "
        "derivative that each sample has by itself, no more; a picture that is not differentiated takes none",
        none="0, but in a fit, which chooses by what its scenes show",
    )
    chunk: int = _setting(
        1024, Whole(64), "rays traced together, rounded down to a square of 8 x 8, 16 x 16, ... pixels", metavar="RAYS"
    )

    @classmethod
    def draft(cls) -> "Settings":
        """One sample a pixel: to find a view. RMSE of the picture at most 0.35 of its mean, see docs/guides/settings.md."""
        return cls(samples=1, edge_samples=10_000)

    @classmethod
    def balanced(cls) -> "Settings":
        """Nine samples a pixel: to look at. RMSE of the picture at most 0.07 of its mean, see docs/guides/settings.md."""
        return cls(samples=9, edge_samples=100_000)

    @classmethod
    def exact(cls) -> "Settings":
        """64 samples a pixel: to measure with. RMSE of the picture at most 0.02 of its mean, see docs/guides/settings.md."""
        return cls(samples=64, edge_samples=300_000)

    def __post_init__(self):
        for knob in dataclasses.fields(self):
            object.__setattr__(self, knob.name, whole_number(getattr(self, knob.name)))
        require_fields(self)
        if self.chunk > _MOST_CHUNK:
            rule = f"must be at most {_MOST_CHUNK}, it is {self.chunk}; with 1024, the default, rays are traced fastest"
            raise ArgumentError("Settings", "chunk", rule)
        if self.samples is not None and math.isqrt(self.samples) ** 2 != self.samples:
            raise ArgumentError("Settings", "samples", f"must be a square number (1, 4, 9, ...), it is {self.samples}")


def _attribute(knob: "dataclasses.Field[Any]") -> str:
    none = f"; None: {knob.metadata['none']}" if "none" in knob.metadata else ""
    return textwrap.fill(f"{knob.name}: {knob.metadata['help']}{none}.", 116, initial_indent="  ", subsequent_indent="    ")


Settings.__doc__ = "\n".join(
    [inspect.cleandoc(Settings.__doc__ or ""), "", "Attributes:", *map(_attribute, dataclasses.fields(Settings))]
)
