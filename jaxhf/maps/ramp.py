"""Colour ramps: a colour for each height, from a colour file as gdaldem reads it, from matplotlib, or our own."""

import difflib
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, UInt8

from ..core.extras import import_extra
from ..io.errors import SceneError
from ..io.files import PathLike
from ..io.terrain.colours import Colour, load_colours

# Land from the lowest height to the highest, in shares of 1: green lowlands, yellow hills, brown mountains, pale heights.
_LAND = (
    (0.0, (104, 152, 112)),
    (0.15, (152, 184, 128)),
    (0.3, (200, 208, 150)),
    (0.45, (232, 220, 166)),
    (0.6, (214, 184, 132)),
    (0.75, (178, 140, 104)),
    (0.9, (190, 172, 160)),
    (1.0, (246, 244, 242)),
)
# Sea, from the deepest (-1) to the shore (0).
_SEA = ((-1.0, (58, 98, 140)), (-0.4, (98, 146, 180)), (-0.1, (146, 188, 206)), (0.0, (178, 210, 220)))

_NOTHING: Colour = (0, 0, 0, 0)


class Ramp(NamedTuple):
    """Heights in rising order with their colours."""

    heights: Float[np.ndarray, " n"]
    colours: UInt8[np.ndarray, "n 4"]  # red, green, blue and opacity
    nodata: Colour = _NOTHING  # where there is no height
    default: Colour = _NOTHING  # of heights without an entry, where only entries count


def ramp_of(entries: Iterable[tuple[float, tuple[int, ...]]], nodata: Colour = _NOTHING, default: Colour = _NOTHING) -> Ramp:
    """Sorts entries. Where several have one height, colours jump: as gdaldem does, they are moved apart by its rounding."""
    ordered = sorted(entries, key=lambda entry: entry[0])
    heights = np.array([height for height, _ in ordered], np.float64)
    colours = np.array([(*colour, 255)[:4] for _, colour in ordered], np.uint8)
    values, first, count = np.unique(heights, return_index=True, return_counts=True)
    for run in np.flatnonzero(count[:-1] > 1):
        here, after, many = values[run], values[run + 1], count[run]
        below = here - values[run - 1] if run else 0.0
        total, rounding = below + after - here if run else after - here, abs(here) * np.finfo(float).eps
        if total > many * rounding:
            heights[first[run] : first[run] + many] += rounding * (0.5 - many * below / total + np.arange(many))
    return Ramp(heights, colours, nodata, default)


def hypsometric(low: float, high: float) -> Ramp:
    """Our own: blue below 0, and from green lowlands to pale heights above it; over the range of the heights."""
    if low >= 0 or high <= 0:  # all land, or a basin of which nobody knows whether it is sea
        return ramp_of((low + share * (high - low), colour) for share, colour in _LAND)
    shore = np.nextafter(0.0, -1.0)
    sea = [(-share * low if share else shore, colour) for share, colour in _SEA]
    return ramp_of([*sea, *((share * high, colour) for share, colour in _LAND)])


def matplotlib_ramp(name: str, low: float, high: float) -> Ramp:
    """A colour map of matplotlib's, from the lowest height to the highest."""
    matplotlib = import_extra("matplotlib", f"the colour ramp {name!r} needs", "plot")
    if name not in matplotlib.colormaps:
        known = {known.lower(): known for known in reversed(list(matplotlib.colormaps))}
        close = difflib.get_close_matches(name.lower(), known, n=3, cutoff=0.5)
        meant = " or ".join(known[word] for word in close)
        meant = f"did you mean {meant}?" if meant else "terrain, gist_earth or viridis are some"
        shown = "matplotlib.org/stable/gallery/color/colormap_reference.html shows all"
        raise SceneError(name, None, f"there is no such file, nor a matplotlib colour map of this name; {meant} ({shown})")
    table = matplotlib.colormaps[name](np.linspace(0, 1, 256), bytes=True)
    return Ramp(np.linspace(low, high, 256), table)


def coloured(ramp: Ramp, z: Float[np.ndarray, "k m"], entries: str) -> UInt8[np.ndarray, "k m 4"]:
    """The colours of heights; `entries` is one of `ENTRIES`."""
    holes = np.isnan(z)
    z = np.where(holes, ramp.heights[0], z)
    above = np.minimum(np.searchsorted(ramp.heights, z), len(ramp.heights) - 1)
    before = np.maximum(above - 1, 0)
    over, gap = z - ramp.heights[before], ramp.heights[above] - ramp.heights[before]
    if entries == "exact":
        colours = np.where((ramp.heights[above] == z)[..., None], ramp.colours[above], np.array(ramp.default, np.uint8))
    elif entries == "nearest":
        colours = ramp.colours[np.where(over < ramp.heights[above] - z, before, above)]
    else:
        share = np.where(gap > 0, over / np.where(gap > 0, gap, 1), 1)[..., None]
        first, last = ramp.colours[before].astype(float), ramp.colours[above].astype(float)
        colours = 0.45 + first + np.clip(share, 0, 1) * (last - first)  # not one half: so gdaldem rounds
    colours[holes] = ramp.nodata
    return colours.astype(np.uint8)


def as_ramp(ramp: Ramp | str | PathLike | None, low: float, high: float) -> Ramp:
    """The ramp that a file, a name or None (our own) means, for heights in this range; a ramp itself is it."""
    if isinstance(ramp, Ramp):
        return ramp
    if ramp is None:
        return hypsometric(low, high)
    if isinstance(ramp, str) and not Path(ramp).exists() and not any(mark in ramp for mark in "./\\"):
        return matplotlib_ramp(ramp, low, high)
    entries, special = load_colours(ramp, low, high)
    default = special.get("default", _NOTHING)
    return ramp_of(entries, special.get("nv", default), default)
