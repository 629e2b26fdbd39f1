"""Recovers a terrain window by window, where it has more heights than one fit can hold."""

import dataclasses
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float

from ..core.errors import ArgumentError, counted
from ..core.precision import numbers
from ..core.rules import Whole, require
from ..core.settings import Settings
from ..io.checkpoint import digest, load_arrays, load_facts_of, save_checkpoint
from ..preparation.localise import localise
from ..scene.scene import Scene
from .cropped import Seen, cropped, sides_in_sight, surroundings
from .fit import fit
from .given import Checkpoint, Draws, Prior, Step
from .model.pictures import EDGE_SAMPLES, checked_pictures, choose_edge_samples, choose_samples
from .model.unknowns import Window, make_heights, with_seam
from .trust.judge import Fit, in_short

_LEAST_WINDOW, _LEAST_OVERLAP = 32, 8  # heights: the outermost four or so of a window are hardly told by its pictures
_REACH = 3.0  # deviations by which heights may differ from what is known of them
_ARRAYS = ("heights", "std", "seen")  # of a terrain while it is found: float64, and a mask


class Fitted(NamedTuple):
    """What became of a window.

    Attributes:
      y, x, ny, nx: which heights it has: ny rows from row y on, nx columns from column x on.
      pictures: how many show it; without any its heights stay as they were.
      result: why its fit stopped, see `Stop`; empty where there was none.
      steps, seconds, chi2: of its fit.
      seam: root mean square difference between its heights and those of the windows before, in the middle of where they
        overlap and are seen; nan: nowhere.
      warnings: of its fit.
    """

    y: int
    x: int
    ny: int
    nx: int
    pictures: int
    result: str = ""
    steps: int = 0
    seconds: float = 0.0
    chi2: float = math.nan
    seam: float = math.nan
    warnings: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True, eq=False)
class Mosaic:
    """What `fit_windows` found.

    Attributes:
      heights: shape (ny, nx), in the dtype of the scenes' heights.
      std: standard deviation of each, as that of `Fit`; None where no draws were asked for.
      seen: whether a change of the height would change any picture, shape (ny, nx).
      windows: what became of each.
    """

    heights: Float[np.ndarray, "ny nx"]
    std: Float[np.ndarray, "ny nx"] | None
    seen: Bool[np.ndarray, "ny nx"]
    windows: tuple[Fitted, ...]

    def __repr__(self) -> str:
        """In one line, without arrays."""
        return f"Mosaic({in_short(self.heights, self.std)}, {counted(len(self.windows), 'window')})"


def fit_windows(
    scenes: Sequence[Scene],
    targets: Sequence[Any],
    *,
    prior: Prior | None,
    window: int,
    overlap: int | None = None,
    weights: Sequence[Any] | None = None,
    start: Any = None,
    noise: Any = None,
    progress: Callable[[int, int, Step | Draws], None] | None = None,
    checkpoint: Checkpoint | None = None,
    **options: Any,
) -> Mosaic:
    """Recovers a terrain by fits of windows of it, one after the other, row by row from y = y0 on.

    Each is fitted within the terrain that goes on around it, as it is known by then: that is seen and casts its shadows into
    the window. The first row and column of each window, which lie in windows before, are held as these found them: the window's
    prior is that of the rest where these are known (see `Prior.held`). In their overlap heights go over from the one to the
    other. Time grows as the number of windows, memory as the size of one,
    besides terrain and pictures themselves.

    What all windows share must be known: lights, cameras, exposures, albedo. `fit` finds them on coarser heights.

    Args:
      scenes, targets, weights, noise, start: as those of `fit`, of the whole terrain.
      prior: see `Prior`; each window needs one.
      window: heights along a window's sides; 64 to 256 are of use. Where the terrain has fewer along a side, all of these.
      overlap: heights that neighbours share at least; None: a quarter of a window. Take two correlation lengths of the prior or
        more: so far the rim is felt.
      progress: called after each step and each draw with the number of windows that are done, how many there are, and a `Step`
        or `Draws`.
      checkpoint: a file for the terrain so far, written after each window, whatever its `every`.
      options: of `fit`: draws, settings, max_steps, mesh.

    Returns:
      A `Mosaic`.

    Raises:
      ValueError: as by `fit`, and a checkpoint of another terrain.
    """
    scenes, targets = tuple(scenes), tuple(targets)
    targets, weights, noise = checked_pictures(scenes, targets, weights, noise)
    field = scenes[0].heightfields[0]
    shape = field.heights.shape
    if not isinstance(prior, Prior):
        raise ArgumentError("fit_windows", "prior", f"must be a jaxhf.Prior, it is {prior!r}")
    if options.get("unknown") is not None:
        raise ArgumentError("fit_windows", "unknown", "must be left out: windows share no unknowns. Find them by `fit` first")
    require("fit_windows", "window", window, Whole(_LEAST_WINDOW))
    overlap = window // 4 if overlap is None else overlap
    require("fit_windows", "overlap", overlap, Whole(_LEAST_OVERLAP, window // 2))
    mean, std = (make_heights("Prior", name, getattr(prior, name), field) for name in ("heights", "std"))
    known = Prior(mean, std, prior.length)
    begin = with_seam(field, make_heights("fit", "start", field.heights if start is None else start, field))
    terrain = Mosaic(with_seam(field, np.where(std > 0, begin, mean)), std.copy(), np.zeros(shape, bool), ())
    order = divided(shape, window, overlap)
    options = {**options, "settings": _settings(scenes, options.get("settings") or Settings(), len(order))}
    known_heights = np.stack([terrain.heights, np.where(std > 0, mean, terrain.heights)])
    off = _REACH * float(std.max())
    around = surroundings(scenes, (float(known_heights.min()) - off, float(known_heights.max()) + off), order)
    sides = sides_in_sight(scenes, terrain.heights, off + float(np.ptp(known_heights, axis=0).max()), order)
    path = None if checkpoint is None else Path(checkpoint.path)
    values = scenes, targets, weights, mean, std, begin, noise
    name = digest((prior.length, window, overlap, sorted(options.items()), jax.tree.structure(values)), values)
    if path is not None and path.exists():
        terrain = _load(path, terrain, name)
    for at in range(len(terrain.windows), len(order)):
        place = order[at]
        here = place.place
        off = _REACH * std[here] + np.where(std[here] > 0, np.abs(mean[here] - terrain.heights[here]), 0)
        seen = cropped(scenes, targets, weights, terrain.heights, float(off.max()), place, around[at], sides)
        tell = False if progress is None else lambda done, at=at: progress(at, len(order), done)
        found = _fit(seen, terrain, known, place, noise, tell, options) if seen else None
        done = Fitted(*place, len(seen))
        if found is not None:
            terrain, seam = _joined(terrain, known, found, place, overlap)
            stats = {key: found.stats[key] for key in ("steps", "seconds", "chi2")}
            done = done._replace(result=found.result.value, seam=seam, warnings=found.warnings, **stats)
        terrain = dataclasses.replace(terrain, windows=(*terrain.windows, done))
        if path is not None:
            facts = {"fingerprint": name, "windows": terrain.windows}  # of which JSON makes lists
            save_checkpoint(path, facts, [getattr(terrain, part) for part in _ARRAYS])
    deviations = terrain.std if options.get("draws") else None
    return dataclasses.replace(terrain, heights=terrain.heights.astype(field.heights.dtype), std=deviations)


def _settings(scenes: Sequence[Scene], settings: Settings, count: int) -> Settings:
    """With one number of points on edges for all windows, so that these share programs: of their boundaries' length, were all
    that the whole pictures show evenly spread. Where these show none each window decides for itself."""
    if settings.edge_samples is not None:
        return settings
    whole = choose_edge_samples(tuple(map(localise, scenes)), choose_samples(scenes, settings))
    each = max(whole // 2 ** round(math.log2(count) / 2), EDGE_SAMPLES[0])
    return dataclasses.replace(settings, edge_samples=each) if whole else settings


def divided(shape: tuple[int, ...], side: int, overlap: int) -> list[Window]:
    """Windows of one size that cover a terrain, neighbours sharing so many heights or more."""
    along = []
    for n in shape:
        count = max(1, math.ceil((n - overlap) / (side - overlap)))
        along.append([round(begin) for begin in np.linspace(0, max(n - side, 0), count)])
    sizes = [min(side, n) for n in shape]
    return [Window(y, x, *sizes) for y in along[0] for x in along[1]]


def _fit(
    seen: Sequence[Seen], terrain: Mosaic, prior: Prior, window: Window, noise: Any, progress: Any, options: dict[str, Any]
) -> Fit | None:
    """The fit of a window; None where all of its heights are held."""
    here = window.place
    held = prior.std[here] == 0
    held[0] |= window.y > 0
    held[:, 0] |= window.x > 0
    if held.all():
        return None
    rim = np.where(held & (prior.std[here] > 0), terrain.heights[here], np.nan)
    known = Prior(prior.heights[here], prior.std[here], prior.length, rim)
    if noise is not None and np.ndim(noise) == 1:
        noise = numbers(noise)[[part.number for part in seen]]
    return fit(
        [part.scene for part in seen], [part.target for part in seen], weights=[part.weight for part in seen],
        prior=known, noise=noise, progress=progress, **options,
    )  # fmt: skip


def _joined(terrain: Mosaic, prior: Prior, found: Fit, window: Window, overlap: int) -> tuple[Mosaic, float]:
    """The terrain with a window's heights, and the difference in its overlap with those before."""
    here, done = window.place, prior.std == 0
    for before in terrain.windows:
        if before.result:
            done[Window(*before[:4]).place] = True
    done = done[here]
    # From 0 at sides in windows before to 1, where these end; what is at the right was fitted in the row before.
    rows = _ramp(window.y > 0, False, window.ny, overlap)
    columns = _ramp(window.x > 0, window.x + window.nx < terrain.heights.shape[1], window.nx, overlap)
    share = np.where(done, rows[:, None] * columns, 1)
    heights, std, seen = (np.array(getattr(terrain, part)) for part in _ARRAYS)
    new = np.asarray(found.heights, np.float64)
    both = done & found.seen & terrain.seen[here] & (np.abs(share - 0.5) < 0.25)
    seam = float(np.sqrt(np.mean((new - heights[here])[both] ** 2))) if both.any() else math.nan
    heights[here] = (1 - share) * heights[here] + share * new
    if found.std is not None:
        std[here] = (1 - share) * std[here] + share * found.std
    seen[here] |= found.seen
    return Mosaic(heights, std, seen, terrain.windows), seam


def _ramp(begins: bool, ends: bool, count: int, overlap: int) -> Float[np.ndarray, " n"]:
    """Numbers from 0 to 1 within an overlap at each side that a terrain goes on beyond."""
    low, high = (np.arange(count) if side else np.full(count, overlap) for side in (begins, ends))
    return np.minimum(np.minimum(low, high[::-1]) / overlap, 1)


def _load(path: Path, like: Mosaic, name: str) -> Mosaic:
    windows = tuple(Fitted._make([*line[:-1], tuple(line[-1])]) for line in load_facts_of(path, name)["windows"])
    heights, std, seen = load_arrays(path, [getattr(like, part) for part in _ARRAYS])
    return Mosaic(heights, std, seen, windows)
