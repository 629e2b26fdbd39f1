"""The settings of the renderer: what trades accuracy for speed."""

import dataclasses
import inspect
import math
import textwrap
from dataclasses import field
from typing import Any, Literal, get_args

from .errors import ArgumentError, whole_number

Traversal = Literal["pyramid", "dda"]
Shading = Literal["smooth", "flat"]
NormalScheme = Literal["central", "four", "six", "six-angle", "six-equal"]

_MOST_CHUNK = 2**20  # of 1024 x 1024 pixels; each device takes 300 bytes a ray
MOST_SAMPLES = 2**20  # of a grid of 1024 x 1024 in each pixel
_MOST = 2**31 - 1


@dataclasses.dataclass(frozen=True)
class Settings:
    """How a scene is rendered. Frozen and hashable, so that it can be a static argument of a compiled function.

    The metadata of each field holds its help, which the end of this docstring and the command line's --help are made from.
    """

    traversal: Traversal = field(
        default="pyramid",
        metadata={
            "help": "search for a ray's first hit: pyramid, which skips blocks of cells by their bounds (Tevs et al. 2008), or "
            "dda, cell by cell (Amanatides and Woo 1987); the hits are the same, bit for bit",
            "metavar": "SEARCH",
        },
    )
    max_steps: int | None = field(
        default=None,
        metadata={
            "help": "step budget of one search; a ray that exhausts it is black, and the AOVs status and exhausted say so",
            "none": "as many as any ray needs",
            "metavar": "N",
        },
    )
    early_exit: bool = field(
        default=True,
        metadata={
            "help": "the end of a search when all rays of its batch have ended; without it each search is a loop of max_steps "
            "steps, or of as many as any ray needs, nothing else is skipped either where no ray needs it, and all views of "
            "a scene take the same time; the hits are the same, bit for bit",
        },
    )
    shading: Shading = field(
        default="smooth", metadata={"help": "smooth, by interpolated normals, or flat, by the triangle's own normal"}
    )
    normals: NormalScheme | None = field(
        default=None,
        metadata={
            "help": "normals at the vertices: central, of central differences; four, the mean of four triangles; the mean of "
            "the six that touch the vertex, weighted by area (six), by angle (six-angle) or equally (six-equal)",
            "none": "six, but in a fit six-angle where its pictures show that",
            "metavar": "SCHEME",
        },
    )
    shadows: bool = field(default=True, metadata={"help": "shadows of every light but the sky, which casts none"})
    samples: int | None = field(
        default=None,
        metadata={
            "help": "rays a pixel, a square number: the centres of a regular n x n grid",
            "none": "the scene's, rounded up to a square",
            "metavar": "N",
        },
    )
    max_depth: int = field(
        default=4, metadata={"help": "mirror bounces of a ray, beyond which the rest counts as black", "metavar": "N"}
    )
    edge_samples: int | None = field(
        default=None,
        metadata={
            "help": "points on terrain edges, in all, at which the derivative of moving silhouettes and shadow boundaries is "
            "taken, and about as many samples more in the pixels that see them, see docs/concepts/boundary.md; 0: the "
            "derivative that each sample has by itself, no more; a picture that is not differentiated takes none",
            "none": "0, but in a fit, which chooses by what its scenes show",
            "metavar": "N",
        },
    )
    chunk: int = field(
        default=1024,
        metadata={"help": "rays traced together, rounded down to a square of 8 x 8, 16 x 16, ... pixels", "metavar": "RAYS"},
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
        for name, kind in (("traversal", Traversal), ("shading", Shading), ("normals", NormalScheme)):
            if getattr(self, name) not in get_args(kind) and (name, getattr(self, name)) != ("normals", None):
                raise ArgumentError(
                    "Settings", name, f"must be one of {', '.join(get_args(kind))}; it is {getattr(self, name)!r}"
                )
        for name in ("early_exit", "shadows"):
            if not isinstance(getattr(self, name), bool):
                raise ArgumentError("Settings", name, f"must be True or False, it is {getattr(self, name)!r}")
        for name, least in (("max_steps", 1), ("samples", 1), ("max_depth", 0), ("edge_samples", 0), ("chunk", 64)):
            value = whole_number(getattr(self, name))
            object.__setattr__(self, name, value)
            if value is None and name in ("max_steps", "samples", "edge_samples"):
                continue
            if not isinstance(value, int) or isinstance(value, bool) or value < least:
                raise ArgumentError("Settings", name, f"must be a whole number from {least} on, it is {value!r}")
            most = MOST_SAMPLES if name == "samples" else _MOST
            if name != "chunk" and value > most:
                raise ArgumentError("Settings", name, f"must be at most {most}, it is {value}")
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
