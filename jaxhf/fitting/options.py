"""The keyword arguments of `fit`, as one checked record."""

import dataclasses
import math
import os
from collections.abc import Callable, Sequence
from typing import Any, Literal, get_args

import numpy as np
from jax.sharding import Mesh

from ..core.errors import ArgumentError, whole_number
from ..core.settings import Settings
from .history import Draws, Step

Albedo = Literal["known", "constant", "map"]
Loss = Literal["squares", "huber", "cauchy", "geman"]
Solver = Literal["lm", "bfgs", "lbfgs", "adam"]

_LAST_STAGES = 3  # at most, over which the scale of a robust loss comes down to its own, and the noise is estimated


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class FitOptions:
    """The keyword arguments of `fit`, which documents them and has their defaults; checked without scenes and targets.

    Raises:
      ValueError: a value is none of its choices, or out of range.
    """

    settings: Settings
    weights: Sequence[Any] | None
    noise: Any
    start: Any
    prior: Any
    prior_std: Any
    prior_length: float | int | None
    prior_exponent: float | int
    smoothness: float | int | None
    albedo: Albedo | str
    albedo_smoothness: float | int | None
    exposures: bool
    offsets: bool
    light_std: float | int | None
    camera_std: Any
    loss: Loss | str
    loss_scale: float | int
    solver: Solver | str
    levels: Sequence[float] | None
    max_steps: int
    inner_steps: int
    tolerance: float | int | None
    uncertainty: int | str | None
    progress: Callable[[Step | Draws], None] | bool
    checkpoint: str | os.PathLike[str] | None
    checkpoint_every: int
    resume: bool
    mesh: Mesh | None

    def __post_init__(self):
        for name, kind in (("solver", Solver), ("loss", Loss), ("albedo", Albedo)):
            value = getattr(self, name)
            if value not in get_args(kind):
                raise ArgumentError("fit", name, f"must be one of {', '.join(get_args(kind))}; it is {value!r}")
        object.__setattr__(self, "uncertainty", whole_number(self.uncertainty))
        for name in ("max_steps", "inner_steps", "checkpoint_every"):
            value = whole_number(getattr(self, name))
            object.__setattr__(self, name, value)
            if not isinstance(value, int) or isinstance(value, bool) or value < 1:
                raise ArgumentError("fit", name, f"must be a whole number from 1 on, it is {value!r}")
        for name in (
            "prior_length",
            "prior_exponent",
            "smoothness",
            "albedo_smoothness",
            "light_std",
            "loss_scale",
            "tolerance",
        ):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and value > 0):
                raise ArgumentError("fit", name, f"must be positive and finite, it is {value!r}")
        pair = self.camera_std
        if pair is not None and not (np.shape(pair) == (2,) and all(math.isfinite(value) and value > 0 for value in pair)):
            rule = f"must be two positive numbers, of the position and, in degrees, of the rotation; it is {pair!r}"
            raise ArgumentError("fit", "camera_std", rule)
        levels, uncertainty = self.levels, self.uncertainty
        if levels is not None and not (len(levels) and all(0 < level <= 1 for level in levels) and levels[-1] == 1):
            raise ArgumentError("fit", "levels", f"must be shares above 0, the last of them 1; they are {levels!r}")
        whole = isinstance(uncertainty, int) and not isinstance(uncertainty, bool) and uncertainty >= 2
        if not (uncertainty is None or uncertainty == "exact" or whole):
            raise ArgumentError(
                "fit", "uncertainty", f"must be None, 'exact' or a number of samples from 2 on, it is {uncertainty!r}"
            )
        if self.resume and self.checkpoint is None:
            raise ArgumentError("fit", "resume", "must come with a checkpoint to go on from")


def make_stages(shape: tuple[int, ...], options: FitOptions) -> list[float]:
    """The share of the highest frequency that each stage varies.

    The levels, then 1 while the loss is sharpened and the noise estimated.
    """
    levels = options.levels
    if levels is None:
        doublings = max(0, math.floor(math.log2(max(shape) / 8))) if options.solver == "lm" else 0
        levels = [0.5**k for k in range(doublings, -1, -1)]
    return [*levels, *[1.0] * (0 if options.loss == "squares" and options.noise is not None else _LAST_STAGES)]
