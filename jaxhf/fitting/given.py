"""What a fit is given, as checked records, and what it says of its steps."""

import dataclasses
import enum
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from jax.sharding import Mesh

from ..core.errors import ArgumentError, kind_of, require_kind, whole_number
from ..core.precision import numbers
from ..core.rules import Whole, flag, require
from ..core.settings import Settings
from ..io.checkpoint import load_facts
from ..io.errors import FileError
from ..io.files import require_folder

Albedo = Literal["constant", "map"]
_MOST_ANGLE = 45  # degrees
NOISE_RULE = "must be positive or a jaxhf.Noise, one or one for each scene"


@dataclasses.dataclass(frozen=True, eq=False)
class Prior:
    """Heights that are known beforehand, and how well.

    Attributes:
      heights: a number (flat), or a grid over the same footprint, of any size.
      std: standard deviation of their errors, a number or shape (ny, nx), height units. Where it is 0 heights are held as they
        are: so a window is fitted within a terrain that goes on around it.
      length: correlation length L of those errors, in world units as dx and dy are, not in cells; from one cell to the
        terrain's longer side. The amplitudes of the errors' DCT modes, over std, go as 1 / (1 + (L · frequency)²): Whittle's
        (1954) correlation (r/L) K₁(r/L) at the distance r. For a terrain that was smoothed by a Gaussian of standard deviation
        s, L is about s / √2: cells of 30 m smoothed over 8 of them have s = 240 m and L = 170 m, see docs/concepts/recovery.md.
        None: it is not known. The pictures say how large errors of each wavelength are, octave by octave (restricted maximum
        likelihood, Patterson and Thompson, 1971); where they do not tell it errors count as independent.
      held: heights that are known better than the others, and held as they are: shape (ny, nx), nan elsewhere. Unlike where std
        is 0 they may differ from `heights`, and with a length that tells of the errors beside them. None: there are none.
    """

    heights: Any
    std: Any
    length: float | int | None = None
    held: Any = None

    def __post_init__(self):
        require_heights("Prior", "heights", self.heights)
        require_heights("Prior", "std", self.std)
        require_heights("Prior", "held", self.held)
        std = np.asarray(numbers(self.std), np.float64)
        if not (np.isfinite(std).all() and (std >= 0).all() and (std > 0).any()):
            given = f"{std:g}" if std.ndim == 0 else f"{std.min():g} to {std.max():g}"
            raise ArgumentError("Prior", "std", f"must be finite, from 0 on, not all 0; it is {given}")
        _require_positive("Prior", "length", self.length)


@dataclasses.dataclass(frozen=True)
class Noise:
    """The noise of a detector: read noise, and that of the photons, which grows with what arrives.

    The standard deviation of a value v at weight 1 is sqrt(read² + gain · max(v, 0)): Janesick, Photon Transfer, 2007.
    v is the measured value, so means that count by it are about `gain` too low, which is one photon.

    Attributes:
      read: standard deviation of a value without light, radiance as the targets have it.
      gain: the value of one photon (electron), by which the variance grows with the value.
      saturation: from which value on there is no measurement, so that it gets the weight 0; None: from none.
      nodata: a value that is no measurement, either; it may be nan. None: there is none.
    """

    read: float | int
    gain: float | int = 0.0
    saturation: float | int | None = None
    nodata: float | int | None = None

    def __post_init__(self):
        if not _is_positive(self.read):
            raise ArgumentError("Noise", "read", f"must be positive and finite, it is {self.read!r}")
        if not (_is_positive(self.gain) or np.array_equal(self.gain, 0)):
            raise ArgumentError("Noise", "gain", f"must be from 0 on and finite, it is {self.gain!r}")
        _require_positive("Noise", "saturation", self.saturation)
        nodata = _real(self.nodata)
        if self.nodata is not None and (nodata is None or nodata.shape != ()):
            raise ArgumentError("Noise", "nodata", f"must be a number, it is {self.nodata!r}")


@dataclasses.dataclass(frozen=True, eq=False)
class Unknown:
    """What is to be found besides the heights.

    Attributes:
      albedo: "constant", one factor on the heightfield's albedo; "map", a factor for each texel of its image, or for each
        vertex where it has none; None: it is known.
      albedo_std: the standard deviation of these factors about 1, each for itself; with `albedo_length`, of their logarithms.
      albedo_length: correlation length of the logarithms of a map's factors, world units as dx and dy are: their correlation at
        the distance r is exp(-r / albedo_length). So they do not explain all of one picture. `noise` must be given then: what
        they leave does not tell it. None: each factor is for itself.
      albedo_shared: whether all channels of the pictures have the same factors, as where the colour of the ground is known and
        how bright it is varies: a third of the unknowns. False: each channel has factors of its own.
      exposures, offsets: whether each picture has an unknown factor, an unknown addend. Where the albedo is unknown too, only
        the product of exposure and albedo is known; the fit keeps near 1.
      sky_std: the standard deviation of the logarithm of the sky's radiance in each picture: 0.7 is a factor of 2. None: it is
        known.
      material_std: how far numbers of the heightfield's material may be off, the same in all pictures: their standard
        deviations by name, {"limb": 0.2}. None: they are known.
      light_std: how far the direction of each picture's light, of its first Directional one, may be off: the standard deviation
        of either of two angles, degrees. None: it is known.
      camera_std: the same of each picture's camera: of its position along each axis, world units, and of its rotation about
        each, degrees. None: they are known. Pictures alone do not say where everything is: turning or moving the cameras, the
        lights and the terrain together changes none of them. The priors settle that, of the heights above all.
    """

    albedo: Albedo | str | None = None
    albedo_std: float | int = 1.0
    albedo_length: float | int | None = None
    albedo_shared: bool = False
    exposures: bool = False
    offsets: bool = False
    sky_std: float | int | None = None
    material_std: Mapping[str, float] | None = None
    light_std: float | int | None = None
    camera_std: Any = None

    def __post_init__(self):
        if self.albedo is not None and self.albedo not in get_args(Albedo):
            raise ArgumentError("Unknown", "albedo", f"must be None, constant or map; it is {self.albedo!r}")
        if self.albedo_std != 1 and self.albedo is None:
            raise ArgumentError("Unknown", "albedo_std", "must stand with an albedo that is sought")
        if not _is_positive(self.albedo_std):
            raise ArgumentError("Unknown", "albedo_std", f"must be positive and finite, it is {self.albedo_std!r}")
        if self.albedo_length is not None and self.albedo != "map":
            raise ArgumentError("Unknown", "albedo_length", 'must stand with albedo="map"')
        _require_positive("Unknown", "albedo_length", self.albedo_length)
        _require_positive("Unknown", "sky_std", self.sky_std)
        for name in ("albedo_shared", "exposures", "offsets"):
            value = getattr(self, name)
            require("Unknown", name, bool(value) if isinstance(value, np.bool_) else value, flag)
        if self.albedo_shared and self.albedo is None:
            raise ArgumentError("Unknown", "albedo_shared", "must stand with an albedo that is sought")
        if self.material_std is not None and not (isinstance(self.material_std, Mapping) and self.material_std):
            raise ArgumentError("Unknown", "material_std", f"must have deviations by name, it is {self.material_std!r}")
        for name, deviation in (self.material_std or {}).items():
            if not _is_positive(deviation):
                raise ArgumentError("Unknown", "material_std", f"must be positive and finite, of {name} it is {deviation!r}")
        _require_positive("Unknown", "light_std", self.light_std)
        pair = self.camera_std
        if pair is not None and not (np.shape(pair) == (2,) and all(map(_is_positive, pair))):
            rule = f"must be two positive numbers, of the position and, in degrees, of the rotation; it is {pair!r}"
            raise ArgumentError("Unknown", "camera_std", rule)
        for name, angle in (("light_std", self.light_std), ("camera_std", None if pair is None else pair[1])):
            if angle is not None and angle > _MOST_ANGLE:
                raise ArgumentError("Unknown", name, f"must be an angle of at most {_MOST_ANGLE} degrees, it is {angle!r}")


@dataclasses.dataclass(frozen=True)
class Checkpoint:
    """A file in which a fit keeps where it stands, so that a later one can go on.

    Attributes:
      path: of the file; `fit` never removes it.
      every: steps after which it is written; it is also after the last one and on Ctrl-C.
      resume: go on from that file if it is there; the result is bitwise that of a fit that was not interrupted. Without it a
        file that is there is refused, as it may hold hours of work.
    """

    path: str | os.PathLike[str]
    every: int = 10
    resume: bool = False

    def __post_init__(self):
        require_kind("Checkpoint", "path", self.path, (str, os.PathLike), "the name of a file")
        require("Checkpoint", "every", self.every, Whole(1))
        require("Checkpoint", "resume", self.resume, flag)
        path = Path(self.path)
        require_folder(path, "a checkpoint")
        if path.exists() and self.resume:
            load_facts(path)  # refuses what is damaged or no checkpoint
        elif path.exists():
            raise FileError(f"{path}: this checkpoint is there already; resume=True goes on from it, to begin anew remove it")


class Stop(enum.Enum):
    """Why a fit stopped; the values say it in words.

    Attributes:
      CONVERGED: what a step still changes is below the tolerance.
      MAX_STEPS: it took as many steps as it was allowed.
      STALLED: no step along the derivative lowers the loss any more.
      NON_FINITE: the loss is not finite; the heights are the best before that.
    """

    CONVERGED = "converged: what a step still changes is below the tolerance"
    MAX_STEPS = "stopped after max_steps"
    STALLED = "stalled: no step along the derivative lowers the loss any more"
    NON_FINITE = "stopped: the loss is not finite; the heights are the best before that"


class Step(NamedTuple):
    """One line of a fit's history.

    Attributes:
      step: counted over all levels, from 1.
      level: how many DCT modes are varied along the longer side.
      loss: half the sum of squared residuals after it.
      accepted: whether the heights changed.
      damping: Levenberg-Marquardt's λ; 0 of the last steps, see docs/concepts/recovery.md.
      change: of the heights, root mean square, height units.
      seconds: since the fit began; a resumed one goes on counting.
      to_come: about how many steps will follow, by what fits take as a rule; None in `Fit.history`.
    """

    step: int
    level: int
    loss: float
    accepted: bool
    damping: float
    change: float
    seconds: float
    to_come: int | None = None


class Draws(NamedTuple):
    """How far the samples of the standard deviations are.

    Attributes:
      drawn, wanted: samples so far, and in all.
      seconds: that they took.
      remaining: seconds that the others will take.
    """

    drawn: int
    wanted: int
    seconds: float
    remaining: float


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class Given:
    """The keyword arguments of `fit`, which documents them; checked without scenes and targets."""

    prior: Prior | None
    unknown: Unknown
    noise: Any
    weights: Sequence[Any] | None
    start: Any
    draws: int
    settings: Settings
    max_steps: int
    progress: Callable[[Step | Draws], None] | bool
    checkpoint: Checkpoint | None
    mesh: Mesh | None

    def __post_init__(self):
        for name, kind, wanted in (
            ("settings", Settings, "a jaxhf.Settings"),
            ("prior", Prior | None, "a jaxhf.Prior: heights with their deviation"),
            ("unknown", Unknown, "a jaxhf.Unknown"),
            ("checkpoint", Checkpoint | None, "a jaxhf.Checkpoint"),
            ("weights", Sequence | np.ndarray | None, "a list, a map or None for each picture"),
            ("mesh", Mesh | None, "a jax.sharding.Mesh"),
        ):
            require_kind("fit", name, getattr(self, name), kind, wanted)
        require_heights("fit", "start", self.start)
        require("fit", "max_steps", self.max_steps, Whole(1))
        require("fit", "draws", self.draws, Whole(0))
        for name in ("max_steps", "draws"):
            object.__setattr__(self, name, whole_number(getattr(self, name)))
        if self.draws == 1:
            raise ArgumentError("fit", "draws", "must be 0 or from 2 on, it is 1: no deviation comes of one")
        noise = _real(self.noise)
        if not (self.noise is None or has_detector(self.noise)) and (noise is None or noise.ndim > 1):
            given = repr(self.noise) if noise is None else f"an array of shape {noise.shape}; what varies is for weights to say"
            raise ArgumentError("fit", "noise", f"{NOISE_RULE}, it is {given}")
        if self.noise is None and self.unknown.albedo_length is not None:
            raise ArgumentError("fit", "noise", "must be given where albedo_length is: such an albedo leaves too little of it")
        if not (callable(self.progress) or isinstance(self.progress, bool)):
            raise ArgumentError("fit", "progress", f"must be a function, True or False, it is {self.progress!r}")


def _real(value: Any) -> np.ndarray | None:
    """An array of real numbers; None where the value is something else."""
    try:
        found = numbers(value)
    except (TypeError, ValueError):  # lists of several lengths
        return None
    return found if found.dtype.kind in "iuf" else None


def has_detector(noise: Any) -> bool:
    """Whether a `Noise` is among what is given."""
    return any(isinstance(one, Noise) for one in (noise if isinstance(noise, list | tuple) else [noise]))


def noise_of_each(noise: Any, count: int) -> list[Any]:
    """A number or a `Noise` for each of so many pictures, where there is one among what is given."""
    found = list(noise) if isinstance(noise, list | tuple) else [noise] * count
    if len(found) != count or not all(isinstance(one, Noise) or _is_positive(one) for one in found):
        raise ArgumentError("fit", "noise", f"{NOISE_RULE}, it is {noise!r}")
    return found


def _is_positive(value: Any) -> bool:
    found = _real(value)
    return found is not None and found.shape == () and bool(np.isfinite(found) & (found > 0))


def _require_positive(owner: str, name: str, value: Any) -> None:
    if value is not None and not _is_positive(value):
        raise ArgumentError(owner, name, f"must be positive and finite, it is {value!r}")


def require_heights(owner: str, name: str, value: Any) -> None:
    """Refuses what is no array of numbers, such as the name of a file."""
    if value is None or _real(value) is not None:
        return
    if isinstance(value, str | os.PathLike):
        raise ArgumentError(owner, name, f"must be heights, it is a name: jaxhf.load_heights({os.fspath(value)!r}).heights")
    hint = "; its heights are meant" if hasattr(value, "heights") else ""
    raise ArgumentError(owner, name, f"must be a number or an array of heights, it is {kind_of(value)}{hint}")
