"""Recovers heights from pictures."""

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh

from ..core.errors import ArgumentError, kind_of
from ..core.settings import Settings
from ..scene.scene import Scene
from ..xla.devices import automatic_axes, on_every_device, takes_numbers
from .coarser import coarser, factors
from .given import Checkpoint, Given, Prior, Unknown
from .history import Draws, Step, printed_progress
from .model.pictures import checked_pictures
from .model.problem import Problem, make_problem
from .model.surface import Unknowns
from .solve.run import Ended, run
from .solve.stages import steps_to_come
from .solve.state import State, fingerprint, first_state, load_state, save_state
from .trust.judge import Fit, judged


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
    return judged(ended, problems, scenes, targets, given, report)


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
