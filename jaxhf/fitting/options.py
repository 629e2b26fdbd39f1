"""The keyword arguments of `fit`, as one checked record."""

import dataclasses
import math
import os
from collections.abc import Callable, Sequence
from typing import Any, Literal, get_args

import numpy as np
from jax.sharding import Mesh

from ..core.errors import ArgumentError, kind_of, require_kind, whole_number
from ..core.precision import numbers
from ..core.settings import Settings
from .history import Draws, Step

Albedo = Literal["known", "constant", "map"]
Loss = Literal["squares", "huber", "cauchy", "geman"]
Solver = Literal["lm", "bfgs", "lbfgs", "adam"]

_SCALARS = ("prior_length", "prior_exponent", "smoothness", "albedo_smoothness", "light_std", "loss_scale", "tolerance")
_NEEDED = ("prior_exponent", "loss_scale")  # of these; the others may be None
_MOST_EXPONENT = 10  # beyond which amplitudes leave the range of single precision
_MOST_ANGLE = 45  # degrees
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
        require_kind("fit", "settings", self.settings, Settings, "a jaxhf.Settings")
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
        for name in _SCALARS:
            value = getattr(self, name)
            if not (value is None and name not in _NEEDED) and not _is_positive(value):
                raise ArgumentError("fit", name, f"must be positive and finite, it is {value!r}")
        for name in ("start", "prior", "prior_std"):
            _require_heights(name, getattr(self, name))
        noise = _real(self.noise)
        if self.noise is not None and (noise is None or noise.ndim > 1):
            given = repr(self.noise) if noise is None else f"an array of shape {noise.shape}; what varies is for weights to say"
            raise ArgumentError("fit", "noise", f"must be positive, one number or one for each scene, it is {given}")
        for name in ("exposures", "offsets", "resume"):
            require_kind("fit", name, getattr(self, name), (bool, np.bool_), "True or False")
        if not (callable(self.progress) or isinstance(self.progress, bool | None)):
            raise ArgumentError("fit", "progress", f"must be a function, True or False, it is {self.progress!r}")
        for name, kind, wanted in (
            ("weights", (Sequence, np.ndarray), "a list, a map or None for each picture"),
            ("checkpoint", (str, os.PathLike), "the name of a file"),
            ("mesh", (Mesh,), "a jax.sharding.Mesh"),
        ):
            if (value := getattr(self, name)) is not None:
                require_kind("fit", name, value, kind, wanted)
        if self.prior_exponent > _MOST_EXPONENT:
            raise ArgumentError("fit", "prior_exponent", f"must be at most {_MOST_EXPONENT}, it is {self.prior_exponent!r}")
        pair = self.camera_std
        if pair is not None and not (np.shape(pair) == (2,) and all(map(_is_positive, pair))):
            rule = f"must be two positive numbers, of the position and, in degrees, of the rotation; it is {pair!r}"
            raise ArgumentError("fit", "camera_std", rule)
        for name, angle in (("light_std", self.light_std), ("camera_std", None if pair is None else pair[1])):
            if angle is not None and angle > _MOST_ANGLE:
                raise ArgumentError("fit", name, f"must be an angle of at most {_MOST_ANGLE} degrees, it is {angle!r}")
        levels, uncertainty = self.levels, self.uncertainty
        if levels is not None and not (_is_list_of_shares(levels) and levels[-1] == 1):
            raise ArgumentError("fit", "levels", f"must be shares above 0, the last of them 1; they are {levels!r}")
        whole = isinstance(uncertainty, int) and not isinstance(uncertainty, bool) and uncertainty >= 2
        if not (uncertainty is None or uncertainty == "exact" or whole):
            raise ArgumentError(
                "fit", "uncertainty", f"must be None, 'exact' or a number of samples from 2 on, it is {uncertainty!r}"
            )
        self._require_company()

    def _require_company(self):
        """Refuses options that say nothing without another one."""
        if self.resume and self.checkpoint is None:
            raise ArgumentError("fit", "resume", "must come with a checkpoint to go on from")
        for name, default, missing, other in (
            ("prior_exponent", 2, self.prior_length is None, "a prior_length, over which errors are correlated"),
            ("loss_scale", 3, self.loss == "squares", "a robust loss, 'squares' has no scale"),
            ("albedo_smoothness", None, self.albedo != "map", "albedo='map', whose factors it smooths"),
        ):
            if missing and getattr(self, name) != default:
                raise ArgumentError("fit", name, f"must stand with {other}")


def _real(value: Any) -> np.ndarray | None:
    """An array of real numbers; None where the value is something else."""
    try:
        found = numbers(value)
    except (TypeError, ValueError):  # lists of several lengths
        return None
    return found if found.dtype.kind in "iuf" else None


def _is_positive(value: Any) -> bool:
    found = _real(value)
    return found is not None and found.shape == () and bool(np.isfinite(found) & (found > 0))


def _is_list_of_shares(values: Any) -> bool:
    found = _real(values)
    return found is not None and found.ndim == 1 and found.size > 0 and bool(((found > 0) & (found <= 1)).all())


def _require_heights(name: str, value: Any) -> None:
    """Refuses what is no array of numbers, such as the name of a file."""
    if value is None or _real(value) is not None:
        return
    if isinstance(value, str | os.PathLike):
        raise ArgumentError("fit", name, f"must be heights, it is a name: jaxhf.load_heights({os.fspath(value)!r}).heights")
    hint = "; its heights are meant" if hasattr(value, "heights") else ""
    raise ArgumentError("fit", name, f"must be a number or an array of heights, it is {kind_of(value)}{hint}")


def make_stages(shape: tuple[int, ...], options: FitOptions) -> list[float]:
    """The share of the highest frequency that each stage varies.

    The levels, then 1 while the loss is sharpened and the noise estimated.
    """
    levels = options.levels
    if levels is None:
        doublings = max(0, math.floor(math.log2(max(shape) / 8))) if options.solver == "lm" else 0
        levels = [0.5**k for k in range(doublings, -1, -1)]
    return [*levels, *[1.0] * (0 if options.loss == "squares" and options.noise is not None else _LAST_STAGES)]
