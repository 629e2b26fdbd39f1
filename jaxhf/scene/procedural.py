"""Heights and textures made from a formula and a seed, in NumPy.

The same seed gives the same numbers wherever NumPy's `default_rng` does, up to rounding. A size is (rows, columns); row 0 lies
at v = 0 (of heights: in the south), column 0 at u = 0 (in the west). Heights fill their `range`, (lowest, highest), exactly;
textures are linear colours.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from ..core.errors import ArgumentError
from ..core.rules import Whole, require
from ..core.types import POSITIVE, Number
from .heightfield import MOST_CELLS

Pair = Sequence[float]
Colour = Sequence[float]


def fractal(
    size: Sequence[int], seed: int = 0, exponent: float = 2.0, range: Pair = (0.0, 1.0), level: float | None = None
) -> Float[np.ndarray, "ny nx"]:
    """Heights whose amplitudes fall as 1 / frequency^`exponent`: 1.5 is rough, 2.5 smooth. Opposite borders match.

    What lies below the `level`, if there is one, is filled up to it, as by a lake.
    """
    heights = _stretched(_noise(size, seed, exponent), range)
    return heights if level is None else np.maximum(heights, level)


def waves(
    size: Sequence[int],
    seed: int = 0,
    count: int = 48,
    direction: float = 0.0,
    spread: float = 30.0,
    lengths: Pair = (0.04, 0.4),
    range: Pair = (0.0, 1.0),
) -> Float[np.ndarray, "ny nx"]:
    """Heights of a sea: `count` sine waves with random phases, each as high as its length allows.

    They run in a direction, degrees counter-clockwise from +x, with a spread, the standard deviation; the shortest and the
    longest are parts of the field's longer side.
    """
    require("", "count", count, Whole(1))
    if not 0 < lengths[0] <= lengths[1]:
        raise ArgumentError("", "lengths", f"must be (shortest, longest), both positive, they are {list(lengths)}")
    x, y = _positions(size)
    random = _generator(seed)
    total = np.zeros(np.shape(x))
    for angle, share, phase in zip(random.normal(size=count), random.random(count), random.random(count), strict=True):
        length = lengths[0] * (lengths[1] / lengths[0]) ** share
        along = np.radians(direction + spread * angle)
        total += length * np.sin(2 * np.pi * ((x * np.cos(along) + y * np.sin(along)) / length + phase))
    return _stretched(total, range)


def bumps(
    size: Sequence[int], seed: int = 0, count: int = 12, radius: float = 0.12, range: Pair = (0.0, 1.0)
) -> Float[np.ndarray, "ny nx"]:
    """Heights of round hills: `count` Gaussians in random places, whose deviation is `radius` times the field's longer side."""
    require("", "count", count, Whole(1))
    require("", "radius", radius, POSITIVE)
    x, y = _positions(size)
    total = np.zeros(np.shape(x))
    for along_x, along_y in _generator(seed).random((count, 2)):
        total += np.exp(-((x - along_x * x.max()) ** 2 + (y - along_y * y.max()) ** 2) / (2 * radius**2))
    return _stretched(total, range)


def grid(size: Sequence[int], lines: int = 10) -> Float[np.ndarray, "h w 3"]:
    """A texture that shows (u, v): `lines` cells a side, redder along u, greener along v; the axes are red and green."""
    require("", "lines", lines, Whole(1))
    u, v = _texel_centres(size)
    h, w = size
    colour = np.stack(np.broadcast_arrays(0.25 + 0.65 * u, 0.25 + 0.65 * v, 0.35), axis=-1)
    for coordinate, texels in ((u, w), (v, h)):
        distance = np.abs((coordinate * lines + 0.5) % 1 - 0.5) / lines
        colour = _painted(colour, _coverage(distance, 0.05 / lines, texels), (0.03, 0.03, 0.03))
    for coordinate, texels, axis in ((v, h, (0.8, 0.02, 0.02)), (u, w, (0.02, 0.6, 0.02))):
        colour = _painted(colour, _coverage(coordinate, 0.25 / lines, texels), axis)
    return colour


def checker(
    size: Sequence[int], squares: int = 8, first: Colour = (0.8, 0.8, 0.8), second: Colour = (0.15, 0.15, 0.15)
) -> Float[np.ndarray, "h w 3"]:
    """A texture of `squares` x `squares` squares in turn of the `first` and the `second` colour; the first at (0, 0)."""
    require("", "squares", squares, Whole(1))
    u, v = _texel_centres(size)
    odd = (np.floor(u * squares) + np.floor(v * squares)) % 2
    return _painted(np.broadcast_to(first, (*odd.shape, 3)), odd, second)


def sky(
    size: Sequence[int],
    seed: int = 0,
    zenith: Colour = (0.12, 0.27, 0.62),
    horizon: Colour = (0.75, 0.78, 0.8),
    sun: Pair = (0.25, 0.45),
    sun_radius: float = 0.02,
    sun_radiance: Colour = (8.0, 6.5, 4.5),
    clouds: float = 0.4,
) -> Float[np.ndarray, "h w 3"]:
    """A texture for a cylinder as a dome: v = 0 is the horizon, v = 1 the upper rim; u closes on itself.

    Args:
      size: (h, w), with w about four times h for round clouds.
      sun: its (u, v); `sun_radius` is that of its disc in v, `sun_radiance` its radiance, of which a glow has a tenth.
      clouds: the part of the sky that is covered, 0..1.
    """
    require("", "clouds", clouds, Number("lie in 0..1", lambda value: 0 <= value <= 1))
    require("", "sun_radius", sun_radius, POSITIVE)
    u, v = _texel_centres(size)
    h, w = size
    colour = _painted(np.broadcast_to(horizon, (*np.broadcast_shapes(u.shape, v.shape), 3)), 1 - (1 - v) ** 2.5, zenith)
    away = np.hypot(((u - sun[0] + 0.5) % 1 - 0.5) * w / h, v - sun[1])
    glow = 0.1 * np.exp(-away / (6 * sun_radius)) + 0.02 * np.exp(-away / (20 * sun_radius))
    colour = colour + glow[..., None] * np.asarray(sun_radiance)
    colour = _painted(colour, _coverage(away, sun_radius, h), sun_radiance)
    noise = _noise(size, seed, 1.5)
    edge = np.quantile(noise, 1 - clouds)
    cover = np.clip((noise - edge) / 1.1, 0, 1) if clouds else np.zeros_like(noise)
    lit = 0.55 + 0.45 * np.exp(-away / 0.5)
    return _painted(colour, 0.9 * cover**2 * (3 - 2 * cover) * (1 - 0.5 * v), lit[..., None] * (1.0, 0.96, 0.92))


HEIGHTS = {"fractal": fractal, "waves": waves, "bumps": bumps}
TEXTURES = {"grid": grid, "checker": checker, "sky": sky}


def _generator(seed: int) -> np.random.Generator:
    require("", "seed", seed, Whole(0))
    return np.random.default_rng(seed)


def _require_size(size: Sequence[int], least: int) -> None:
    if min(size) < least:
        raise ArgumentError("", "size", f"must be at least {least} x {least}, it is {list(size)}")
    rows, columns = size
    if rows * columns > MOST_CELLS:
        raise ArgumentError("", "size", f"must hold at most {MOST_CELLS} pixels, it declares {columns} x {rows}")


def _noise(size: Sequence[int], seed: int, exponent: float) -> np.ndarray:
    """Periodic noise with mean 0 and standard deviation 1: white noise, filtered in the frequency domain."""
    _require_size(size, 2)
    rows, columns = size
    white = _generator(seed).normal(size=(rows, columns))
    frequency = np.hypot(np.fft.fftfreq(rows)[:, None], np.fft.rfftfreq(columns))
    frequency[0, 0] = np.inf
    noise = np.fft.irfft2(np.fft.rfft2(white) * frequency**-exponent, s=(rows, columns))
    return (noise - noise.mean()) / noise.std()


def _positions(size: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
    """x and y of the vertices; the longer side runs from 0 to 1."""
    _require_size(size, 2)
    step = 1 / (max(size) - 1)
    y, x = np.meshgrid(np.arange(size[0]) * step, np.arange(size[1]) * step, indexing="ij")
    return x, y


def _texel_centres(size: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
    """u of the columns, shape (1, w), and v of the rows, shape (h, 1)."""
    _require_size(size, 1)
    h, w = size
    return (np.arange(w)[None, :] + 0.5) / w, (np.arange(h)[:, None] + 0.5) / h


def _stretched(values: np.ndarray, range: Pair) -> np.ndarray:
    """`values`, mapped linearly so that their least is range[0] and their greatest range[1], to the bit."""
    low, high = range
    if not low <= high:
        raise ArgumentError("", "range", f"must be (lowest, highest), it is {list(range)}")
    share = (values - values.min()) / max(values.max() - values.min(), np.finfo(values.dtype).tiny)
    return np.clip((1 - share) * low + share * high, low, high)


def _coverage(distance: np.ndarray, radius: float, texels: int) -> np.ndarray:
    """How much of a texel lies within `radius` of a line, from its centre's `distance`: linear over one texel's width."""
    return np.clip((radius - distance) * texels + 0.5, 0, 1)


def _painted(under: np.ndarray, cover: np.ndarray, over: np.ndarray | Colour) -> np.ndarray:
    return under + cover[..., None] * (np.asarray(over) - under)
