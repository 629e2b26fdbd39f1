"""Recovers heights from pictures: first, where pixels are many, from the same pictures with coarser heights and pixels."""

import collections
import dataclasses
import math
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Float

from ..core.errors import ArgumentError, kind_of
from ..core.precision import numbers
from ..core.settings import Settings
from ..scene.camera import Camera, Perspective
from ..scene.heightfield import Heightfield
from ..scene.scene import Scene
from ..xla.devices import automatic_axes, on_every_device, takes_numbers
from .given import Checkpoint, Draws, Given, Prior, Step, Unknown
from .model.pictures import checked_pictures
from .model.problem import Problem, make_problem
from .model.unknowns import Unknowns, interpolation, resample
from .solve.run import Ended, run
from .solve.stages import State, fingerprint, first_state, load_state, save_state, steps_to_come
from .trust.judge import Fit, judged

_FACTOR = 4  # between levels: a sixteenth of the work
_MOST_SAMPLES = 2**21  # of all pictures, with which steps take about as long as it takes to compile another level


@takes_numbers
def fit(
    scenes: Sequence[Scene],
    targets: Sequence[Any],
    *,
    prior: Prior | None = None,
    unknown: Unknown | None = None,
    noise: Any = None,
    weights: Sequence[Any] | None = None,
    start: Any = None,
    draws: int = 0,
    settings: Settings | None = None,
    max_steps: int = 100,
    progress: Callable[[Step | Draws], None] | bool = False,
    checkpoint: Checkpoint | None = None,
    mesh: Mesh | None = None,
) -> Fit:
    """Recovers the heights of a terrain from pictures of it.

    Minimises Σ ρ((exposure · picture(heights) + offset - target) / noise) + Σ ((heights - prior) / std)² / 2 over the heights
    and what else is unknown, from coarse to fine, by Levenberg-Marquardt steps that form no dense matrix. Every term is in
    standard deviations, so the deviations of the result follow from it.

    Scenes and pictures are enough: noise, samples, and whether moving silhouettes and shadows take part are chosen by what is
    in sight, the loss ρ is robust, Geman and McClure's (1985), and `Fit.warnings` says what speaks against the result. What
    changes no picture (the height of a plain under a vertical view) stays as it was at the start.

    Args:
      scenes: one a picture. Their first heightfields share shape, precision, spacing and origin, and are what is sought.
      targets: linear radiance, shape (h, w), (h, w, 1) or (h, w, 3) as the scene's camera says, top row first. One without or
        with one channel is compared with the mean over a picture's channels.
      prior: heights that are known beforehand, and how well; None: nothing.
      unknown: what is to be found besides the heights; None: nothing.
      noise: standard deviation of a target's values at weight 1, radiance, or a `Noise`, by which it grows with the value; one
        or one for each picture. None: each picture's is estimated from what the fit leaves of it, see `Fit.noise`.
      weights: for each picture None or a map (h, w) or (h, w, c), from 0 (masked: the target may be nan there)
        on; it divides the noise.
      start: heights to begin with: a number (flat), a grid over the same footprint, of any size, or None: those of the
        first scene. They may have no holes: fill in what is not known; where a picture shows no ground there, give its
        pixels no weight.
      draws: from how many random draws the standard deviations are estimated, each to 1 / √(2 · draws); 0: they are not.
        Ctrl-C while they are drawn ends with those that there are, from two on. Where pictures are not explained to their
        noise, or boundaries stand elsewhere in them, deviations are those that residuals bear out.
      settings: how to render. Samples that it leaves open are 4 a pixel, or the scene's if that is more. Where it leaves
        `edge_samples` open, points on edges are taken where silhouettes, the terrain's border or shadows may be in sight, 2048
        to 32768 by their length in the pictures; not where a mirror is in the scene.
      max_steps: over all levels.
      progress: called after each step with a `Step`, and after each draw with a `Draws`, which says what is left to do, as
        `Step.to_come` does; True prints lines to standard error.
      checkpoint: a file in which the fit keeps where it stands, also on Ctrl-C.
      mesh: the devices that share each picture's tiles, see `render`.

    Returns:
      A `Fit`. It is returned however the fit ended; `result` says how.

    Raises:
      ValueError: anything about the arguments, before anything is traced; a checkpoint that is of another fit.
      KeyboardInterrupt: Ctrl-C, after the checkpoint was written, if there was anything to keep.
    """
    for name, values in (("scenes", scenes), ("targets", targets)):
        if isinstance(values, Scene | str) or not hasattr(values, "__iter__"):
            raise ArgumentError("fit", name, f"must be a list, one for each picture, it is {kind_of(values)}")
    scenes, targets = tuple(scenes), tuple(targets)
    given = Given(
        prior=prior, unknown=Unknown() if unknown is None else unknown, noise=noise, weights=weights, start=start, draws=draws,
        settings=Settings() if settings is None else settings, max_steps=max_steps, progress=progress, checkpoint=checkpoint,
        mesh=mesh,
    )  # fmt: skip
    with automatic_axes("fit", given.mesh) as automatic:
        found = _found(scenes, targets, dataclasses.replace(given, mesh=automatic))
    if automatic is None or automatic is given.mesh:
        return found
    arrays = {name: getattr(found, name) for name in ("heights", "albedo", "exposures", "offsets", "scenes")}
    return dataclasses.replace(found, **on_every_device(arrays, automatic))


def _found(scenes: tuple[Scene, ...], targets: tuple[Any, ...], given: Given) -> Fit:
    targets, weights, noise = checked_pictures(scenes, targets, given.weights, given.noise)
    given = dataclasses.replace(given, weights=weights, noise=noise)
    problem, unknowns = make_problem(scenes, targets, given)
    levels = factors(scenes, problem.settings.samples or 1)
    coarse = [make_problem(*coarser(scenes, targets, given, factor)) for factor in levels[:-1]]
    problems, unknowns = (*(other for other, _ in coarse), problem), coarse[0][1] if coarse else unknowns
    if problem.field.heights.dtype == np.float32 and jax.config.jax_enable_x64:  # pyright: ignore
        # optimistix then mixes single with double precision.
        raise ArgumentError("fit", "scenes", "must have float64 heights where JAX's x64 mode is on, theirs are float32")
    report = printed_progress() if given.progress is True else given.progress or None
    ended = _run(problems, unknowns, given, report)
    return judged(ended, scenes, targets, given, report)


def _run(problems: Sequence[Problem], unknowns: Unknowns, given: Given, report: Callable[[Step | Draws], None] | None) -> Ended:
    """From the first state, or that of a checkpoint, to the last, reported and kept on the way."""
    checkpoint, first = given.checkpoint, first_state(problems[0], unknowns)
    latest, path, name = first, None, ""
    if checkpoint is not None:
        path, name = Path(checkpoint.path), fingerprint(problems[-1], unknowns, given)
        if path.exists():
            first = latest = load_state(path, first, name)

    def keep() -> None:
        if path is not None and latest is not first:  # which a file has, or nothing is lost with
            save_state(path, latest, name)

    def watch(state: State) -> None:
        nonlocal latest
        stepped = len(state.history) > len(latest.history)
        latest = state
        if stepped and report is not None:
            report(state.history[-1]._replace(to_come=steps_to_come(state, problems, given)))
        if stepped and checkpoint is not None and len(state.history) % checkpoint.every == 0:
            keep()

    try:
        ended = run(problems, first, given, watch)
    finally:
        keep()  # what comes now, standard deviations, may take long
    return ended


class Pace:
    """How long steps take, by when the last few of them ended.

    `begin`: when the first step began; None: how long that took, compilation above all, says nothing.
    """

    def __init__(self, begin: float | None = None):
        self._ends = collections.deque([] if begin is None else [begin], maxlen=6)

    def remaining(self, end: float, to_come: int | None) -> float | None:
        """The seconds that so many steps will take after one that ended now; None: not known."""
        self._ends.append(end)
        steps = len(self._ends) - 1
        return None if steps < 1 or to_come is None else (self._ends[-1] - self._ends[0]) / steps * to_come


def printed_progress() -> Callable[[Step | Draws], None]:
    """A function that prints a line on standard error for each step, and for each sample of the deviations."""
    pace = Pace()

    def line(done: Step | Draws) -> str:
        if isinstance(done, Draws):
            return f"sample {done.drawn} of {done.wanted}, {done.seconds:.1f} s, {done.remaining:.1f} s to come"
        remaining = pace.remaining(done.seconds, done.to_come)
        to_come = "" if remaining is None else f", about {remaining:.0f} s to come"
        return (
            f"step {done.step}: {done.level} modes a side, loss {done.loss:.6g}, λ {done.damping:.2g}, "
            f"change {done.change:.3g}, {done.seconds:.1f} s{to_come}{'' if done.accepted else ', not accepted'}"
        )

    return lambda done: print(line(done), file=sys.stderr, flush=True)


def factors(scenes: Sequence[Scene], samples: int) -> list[int]:
    """How many times coarser the levels of a fit are, from coarse to fine: 1 last."""
    field, pixels = scenes[0].heightfields[0], sum(scene.camera.width * scene.camera.height for scene in scenes)
    # A skirt has the terrain's shape; a seam is finer than coarse heights, and would be moved by their steps.
    plain = field.seam is None and all(len(scene.objects) == len(scene.heightfields) for scene in scenes)
    found = [1]
    while plain and pixels * samples > found[0] ** 2 * _MOST_SAMPLES and min(field.heights.shape) > 16 * found[0] * _FACTOR:
        found.insert(0, found[0] * _FACTOR)
    return found


def coarser(
    scenes: Sequence[Scene], targets: Sequence[np.ndarray], given: Given, factor: int
) -> tuple[list[Scene], list[np.ndarray], Given]:
    """Scenes, pictures and arguments of `fit` for heights and pixels that are so many times as large.

    A coarse pixel has the mean of the pixels that it covers by the information that they bear, the squares of their weights;
    its own is the sum of theirs, so that the loss keeps its size.
    """
    old = scenes[0].heightfields[0]
    shape = tuple(max(2, round((n - 1) / factor) + 1) for n in old.heights.shape)

    def reduced(values: Any) -> Any:
        array = np.asarray(numbers(values), np.float64)
        return array if array.ndim == 0 else _reduced(resample(array, old.heights.shape), shape)

    assert given.weights is not None
    triples = zip(scenes, targets, given.weights, strict=True)
    pictures = [_coarser_picture(scene.camera, target, weight, factor) for scene, target, weight in triples]
    prior = given.prior
    if prior is not None:
        cell = factor * max(old.dx, old.dy)
        length = None if prior.length is None or prior.length < cell else prior.length
        std = np.asarray(numbers(prior.std), np.float64)
        held = None if prior.held is None else _held(np.asarray(numbers(prior.held), np.float64), shape)
        prior = Prior(reduced(prior.heights), std if std.ndim == 0 else resample(std, shape), length, held)
    start = None if given.start is None else reduced(given.start)
    return (
        [_coarser_scene(scene, camera, shape) for scene, (camera, _, _) in zip(scenes, pictures, strict=True)],
        [target for _, target, _ in pictures],
        dataclasses.replace(given, prior=prior, start=start, weights=[weight for _, _, weight in pictures]),
    )


def _held(heights: Float[np.ndarray, "ny nx"], shape: tuple[int, ...]) -> Float[np.ndarray, "my mx"]:
    """Heights that are held, nan elsewhere, where most of what is there is held."""
    there = np.isfinite(heights)
    share = resample(there.astype(np.float64), shape)
    return np.where(share > 0.5, resample(np.where(there, heights, 0), shape) / np.maximum(share, 0.5), np.nan)


def _coarser_scene(scene: Scene, camera: Camera, shape: tuple[int, ...]) -> Scene:
    old = scene.heightfields[0]
    ny, nx = old.heights.shape
    heights = _reduced(np.asarray(old.heights, np.float64), shape).astype(old.heights.dtype)
    field = Heightfield(heights, old.dx * (nx - 1) / (shape[1] - 1), old.dy * (ny - 1) / (shape[0] - 1), old.x0, old.y0)
    k = scene.first_heightfield
    return eqx.tree_at(lambda scene: scene.objects[k].shape, scene, field).with_camera(camera)


def _coarser_picture(
    camera: Camera, target: np.ndarray, weight: np.ndarray, factor: int
) -> tuple[Camera, np.ndarray, np.ndarray]:
    """The camera, the picture and its weights."""
    width, height = (math.ceil(n / factor) for n in (camera.width, camera.height))
    times = factor * min(width, height) / min(camera.width, camera.height)
    if isinstance(camera, Perspective):
        half = times * np.tan(np.radians(np.asarray(camera.fov, np.float64)) / 2)
        camera = dataclasses.replace(camera, fov=np.degrees(2 * np.arctan(half)), width=width, height=height)
    else:
        camera = dataclasses.replace(camera, extent=times * np.asarray(camera.extent), width=width, height=height)
    rows, columns = (_overlap(n, count, factor) for n, count in zip(target.shape[:2], (height, width), strict=True))

    def summed(values: np.ndarray) -> np.ndarray:
        return np.einsum("ih,jw,hwc->ijc", rows, columns, values, optimize=True)

    shaped, weight = (values.reshape(*target.shape[:2], -1) for values in (target, weight))
    told = summed(weight**2)
    mean = summed(weight**2 * np.where(weight > 0, shaped, 0)) / np.where(told > 0, told, 1)
    return camera, mean.reshape(height, width, *target.shape[2:]), np.sqrt(told).reshape(height, width, *target.shape[2:])


def _overlap(n: int, count: int, factor: int) -> Float[np.ndarray, "count n"]:
    """How much of each of n pixels lies in each of `count` pixels that are so many times as large, about the same centre."""
    begin = (np.arange(count) - count / 2) * factor + n / 2
    low, high = np.maximum(begin[:, None], np.arange(n)), np.minimum(begin[:, None] + factor, np.arange(n) + 1)
    return np.maximum(high - low, 0.0)


def _reduced(heights: Float[np.ndarray, "ny nx"], shape: tuple[int, ...]) -> Float[np.ndarray, "my mx"]:
    """Means of heights by the weights that a bilinear surface through fewer vertices would give these."""
    for count in shape:
        weights = interpolation(np.linspace(0, count - 1, len(heights)), count).T
        heights = (weights @ heights / weights.sum(axis=1)[:, None]).T
    return heights
