"""Recovers heights from pictures."""

import dataclasses
import math
import os
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Bool, Float

from ..core.devices import local_mesh
from ..core.errors import ArgumentError
from ..core.settings import Settings
from ..core.types import AnyArray
from ..io.errors import FileError
from ..io.files import require_folder
from ..scene.scene import Scene
from .basis import beyond, make_basis
from .history import Step, Stop, print_step
from .loop import Descent, make_stages
from .problem import Albedo, Asked, Loss, Problem, first_unknowns, make_groups, make_heights, make_prior, prior_margin
from .residuals import pictures_and_influence
from .solvers import BFGS_UNKNOWNS, Solver, count_unknowns, make_solver
from .uncertainty import require_small, standard_deviations


@dataclasses.dataclass(frozen=True, eq=False)
class Fit:
    """What `fit` found.

    Attributes:
      heights: shape (ny, nx), in the dtype of the scenes' heights.
      result: why it stopped.
      std: standard deviation of each height, shape (ny, nx); infinite where nothing says anything about it. None where
        `uncertainty` was not asked for.
      seen: whether a change of the height would change any picture, shape (ny, nx).
      albedo: what the albedo of the scenes is to be multiplied by, shape (ty, tx, c); None where it was known.
      exposures, offsets: of each picture; None where they were known.
      images: the pictures as they would be measured, (h, w) or (h, w, c) each, as their targets.
      residuals: `images` - targets; 0 where a target has no weight.
      stats: steps, accepted, seconds, loss; chi2, the mean square of the pictures' residuals in units of `noise`: about 1
        where `noise` is right and all is explained.
      history: a `Step` for each step.
    """

    heights: Float[AnyArray, "ny nx"]
    result: Stop
    std: Float[np.ndarray, "ny nx"] | None
    seen: Bool[np.ndarray, "ny nx"]
    albedo: Float[AnyArray, "ty tx c"] | None
    exposures: Float[AnyArray, " pictures"] | None
    offsets: Float[AnyArray, " pictures"] | None
    images: tuple[np.ndarray, ...]
    residuals: tuple[np.ndarray, ...]
    stats: dict[str, int | float]
    history: tuple[Step, ...]


def fit(
    scenes: Sequence[Scene],
    targets: Sequence[Any],
    *,
    settings: Settings | None = None,
    weights: Sequence[Any] | None = None,
    noise: Any = 0.01,
    start: Any = None,
    prior: Any = None,
    prior_std: Any = None,
    prior_length: float | int | None = None,
    prior_exponent: float | int = 2.0,
    smoothness: float | int | None = None,
    albedo: Albedo | str = "known",
    albedo_smoothness: float | int | None = None,
    exposures: bool = False,
    offsets: bool = False,
    loss: Loss | str = "squares",
    loss_scale: float | int = 3.0,
    solver: Solver | str = "lm",
    levels: Sequence[float] | None = None,
    max_steps: int = 100,
    inner_steps: int = 60,
    tolerance: float | int = 1e-4,
    uncertainty: int | str | None = None,
    progress: Callable[[Step], None] | bool = False,
    checkpoint: str | os.PathLike[str] | None = None,
    checkpoint_every: int = 10,
    resume: bool = False,
    mesh: Mesh | None = None,
) -> Fit:
    """Recovers the heights of a terrain from pictures of it.

    Minimises Σ ρ((exposure · picture(heights) + offset - target) / noise) + Σ ((heights - prior) / prior_std)² / 2
    + Σ (Laplacian / smoothness)² / 2 over the heights and what else is unknown, from coarse to fine, by Levenberg-Marquardt
    steps that never form a dense matrix. Every term is in standard deviations, so that the result's are those of the heights.

    The derivative is `render`'s, which knows that shadows, silhouettes and the terrain's border move where the settings ask
    for it by `edge_samples`. What shows in nothing (the height of a plain under a vertical view) stays where it began.

    Args:
      scenes: one a picture. Their first heightfields share shape, precision, spacing and origin, and are what is sought.
      targets: linear radiance, shape (h, w), (h, w, 1) or (h, w, 3) as the scene's camera says, top row first. One without or
        with one channel is compared with the mean over a picture's channels.
      settings: how to render; None: `Settings()`.
      weights: for each picture None or a map (h, w) or (h, w, c), from 0 (masked: the target may be nan there)
        on; it divides the noise.
      noise: standard deviation of a target's values at weight 1, radiance; one number or one for each picture.
      start: heights to begin with: a number (flat), a grid over the same footprint, of any size, or None: those of the
        first scene. They may have no holes: fill in what is not known; where a picture shows no ground there, give its
        pixels no weight.
      prior: heights known beforehand, as `start`; None: nothing.
      prior_std: how far they may be off, a number or shape (ny, nx), height units.
      prior_length: over what distance L they are off together, in units of dx and dy; None: each by itself. For a terrain
        that was smoothed by a Gaussian of standard deviation s, L is about s / √2, see docs/fitting.md.
      prior_exponent: the amplitudes of the waves in these errors, over prior_std, go as (1 + (L · frequency)²)^(-exponent / 2)
        (Matérn's family). 2 is Whittle's of 1954, with the correlation (r/L) K₁(r/L) at the distance r; 3 is smoother.
      smoothness: standard deviation of the sum of a height's differences to its four neighbours, height units; None: no
        such term.
      albedo: "known"; "constant", one unknown factor on the heightfield's albedo; "map", a factor for each texel of its image,
        or for each vertex where it has none.
      albedo_smoothness: as `smoothness`, of those factors.
      exposures, offsets: whether each picture has an unknown factor, an unknown addend. Where the albedo is unknown too, only
        the product of exposure and albedo is known; the fit keeps near 1.
      loss: ρ, see `loss_scale`: "squares", r²/2; "huber", "cauchy" and "geman" make less of what is far off, such as
        pixels that a moved shadow explains. They begin with a scale as wide as the residuals and come down (Black and
        Rangarajan 1996).
      loss_scale: where that begins, in standard deviations.
      solver: "lm"; "bfgs" (4096 unknowns at most) and "lbfgs"; "adam", optax's, for its robustness against a noisy derivative.
      levels: shares of the highest frequency up to which heights are varied, one after the other, the last being 1; None:
        from 8 waves a side, doubled each time, for "lm", all at once for the others.
      max_steps: over all levels.
      inner_steps: LSMR iterations in one step of Levenberg-Marquardt, at most.
      tolerance: of the relative change of unknowns and residuals in one step at which the fit has converged.
      uncertainty: None; the number of samples from which standard deviations are estimated, each to 1 / √(2 · samples); or
        "exact", where pictures times unknowns are few. See `standard_deviations`.
      progress: called after each step; True prints a line to standard error.
      checkpoint: a file in which the state is kept every `checkpoint_every` steps, after the last one and on Ctrl-C;
        `fit` never removes it.
      resume: goes on from that file if it is there; the result is bitwise that of a fit that was not interrupted. Without
        it a file that is there is refused, as it may hold hours of work.
      mesh: the devices that share each picture's tiles, see `render`.

    Returns:
      A `Fit`. It is returned however the fit ended; `result` says how.

    Raises:
      ValueError: anything about the arguments, before anything is traced; a checkpoint that is damaged or of another fit.
      FileNotFoundError, PermissionError: the checkpoint's folder is not there or cannot be written to, before as well.
      KeyboardInterrupt: Ctrl-C, after the checkpoint was written, if there was anything to keep.
    """
    scenes, targets, settings = tuple(scenes), tuple(targets), settings or Settings()
    asked = Asked(
        weights, noise, prior, prior_std, prior_length, prior_exponent, smoothness, albedo, albedo_smoothness, exposures,
        offsets, loss, loss_scale,
    )  # fmt: skip
    _check_choices(asked, solver, levels, max_steps, inner_steps, checkpoint_every, tolerance, uncertainty)
    path = None if checkpoint is None else Path(checkpoint)
    if path is not None:
        _require_place(path, resume)
    elif resume:
        raise ArgumentError("fit", "resume", "must come with a checkpoint to go on from")
    groups = make_groups(scenes, targets, settings, asked)
    first = scenes[0]
    shape, dtype = first.heights.shape, first.heights.dtype
    if start is None:
        start = _without_holes(np.asarray(first.heights))
    heights = make_heights("start", start, shape)
    known = make_prior(first.heightfields[0], prior, prior_std, prior_length, prior_exponent)
    margin = prior_margin(first.heightfields[0], prior_length)
    basis = make_basis(first.heightfields[0], beyond(heights, margin))
    unknowns = first_unknowns(first, basis, max(group.targets.shape[-1] for group in groups), len(scenes), asked)
    problem = Problem(
        groups,
        basis,
        known,
        None if smoothness is None else jnp.asarray(1 / smoothness, dtype),
        None if albedo_smoothness is None else jnp.asarray(1 / albedo_smoothness, dtype),
        None if loss == "squares" else jnp.asarray(loss_scale, dtype),
        loss,
        settings,
        local_mesh() if mesh is None else mesh,
    )
    if solver == "bfgs" and count_unknowns(unknowns) > BFGS_UNKNOWNS:
        raise ArgumentError(
            "fit", "solver", f"bfgs takes at most {BFGS_UNKNOWNS} unknowns, there are {count_unknowns(unknowns)}; take lbfgs"
        )
    sampled = uncertainty is not None and uncertainty != "exact"
    if (solver == "lm" or sampled) and dtype == np.float32 and jax.config.jax_enable_x64:  # pyright: ignore
        # lineax's LSMR then mixes single with double precision, a TypeError from deep inside.
        raise ArgumentError("fit", "scenes", "must have float64 heights where JAX's x64 mode is on, theirs are float32")
    if uncertainty == "exact":
        require_small(unknowns, problem)
    run = Descent(
        problem,
        unknowns,
        make_solver(solver, tolerance, inner_steps, known is not None),
        make_stages(shape, solver, levels, loss),
        tolerance,
        max_steps,
        print_step if progress is True else progress or None,
        path,
        checkpoint_every,
        f"{solver} {levels} {inner_steps} {tolerance}",
    )
    result = run.go(first, resume)
    # Whatever the level at which it stopped, all waves are in doubt.
    basis = make_basis(first.heightfields[0], np.asarray(run.problem.basis.surface(run.unknowns.waves)))
    run.problem = eqx.tree_at(lambda problem: problem.basis, run.problem, basis)
    run.unknowns = eqx.tree_at(lambda unknowns: unknowns.waves, run.unknowns, jnp.zeros_like(run.unknowns.waves))
    return _report(run, result, targets, uncertainty, inner_steps)


def _check_choices(asked, solver, levels, max_steps, inner_steps, every, tolerance, uncertainty) -> None:
    for name, value, kind in (("solver", solver, Solver), ("loss", asked.loss, Loss), ("albedo", asked.albedo, Albedo)):
        if value not in get_args(kind):
            raise ArgumentError("fit", name, f"must be one of {', '.join(get_args(kind))}; it is {value!r}")
    for name, value in (("max_steps", max_steps), ("inner_steps", inner_steps), ("checkpoint_every", every)):
        if not isinstance(value, int) or isinstance(value, bool) or value < 1:
            raise ArgumentError("fit", name, f"must be a whole number from 1 on, it is {value!r}")
    numbers = {
        "prior_length": asked.prior_length, "prior_exponent": asked.prior_exponent, "smoothness": asked.smoothness,
        "albedo_smoothness": asked.albedo_smoothness, "loss_scale": asked.loss_scale, "tolerance": tolerance,
    }  # fmt: skip
    for name, value in numbers.items():
        if value is not None and not (math.isfinite(value) and value > 0):
            raise ArgumentError("fit", name, f"must be positive and finite, it is {value!r}")
    if levels is not None and not (len(levels) and all(0 < level <= 1 for level in levels) and levels[-1] == 1):
        raise ArgumentError("fit", "levels", f"must be shares above 0, the last of them 1; they are {levels!r}")
    whole = isinstance(uncertainty, int) and not isinstance(uncertainty, bool) and uncertainty >= 2
    if not (uncertainty is None or uncertainty == "exact" or whole):
        raise ArgumentError(
            "fit", "uncertainty", f"must be None, 'exact' or a number of samples from 2 on, it is {uncertainty!r}"
        )


def _require_place(checkpoint: Path, resume: bool) -> None:
    require_folder(checkpoint, "a checkpoint")
    if checkpoint.exists() and not resume:
        raise FileError(f"{checkpoint}: this checkpoint is there already; resume=True goes on from it, to begin anew remove it")


def _without_holes(heights: Float[np.ndarray, "ny nx"]) -> Float[np.ndarray, "ny nx"]:
    """The first scene's heights, where a fit is to begin with them."""
    holes = np.argwhere(~np.isfinite(heights))
    if len(holes):
        iy, ix = holes[0]
        raise ArgumentError(
            "fit",
            "scenes[0]",
            f": the heights must have no holes where there is no start, row {iy} column {ix} is "
            f"{heights[iy, ix]}; fill them, or give a start without holes",
        )
    return heights


def _report(run: Descent, result: Stop, targets: Sequence[Any], uncertainty: int | str | None, inner_steps: int) -> Fit:
    problem, unknowns = run.problem, run.unknowns
    images: list[np.ndarray] = [np.zeros(())] * problem.count
    differences: list[np.ndarray] = [np.zeros(())] * problem.count
    square, count = 0.0, 0
    pictures, influence = pictures_and_influence(unknowns, problem)
    for group, simulated in zip(problem.groups, pictures, strict=True):
        simulated, weights = np.asarray(simulated), np.asarray(group.weights)
        difference = np.where(weights > 0, simulated - np.asarray(group.targets), 0)
        with np.errstate(over="ignore"):
            square += float(np.sum((difference * weights) ** 2))
        count += int(np.sum(weights > 0))
        for place, image, values in zip(group.places, simulated, difference, strict=True):
            shape = np.shape(targets[place])
            images[place], differences[place] = image.reshape(shape), values.reshape(shape)
    seen = np.asarray(influence) != 0
    std = None
    if uncertainty is not None and result is not Stop.NON_FINITE:
        std = standard_deviations(unknowns, problem, uncertainty, inner_steps)
        if problem.prior is None:
            std = np.where(seen, std, np.inf)
    stats = {
        "steps": len(run.history),
        "accepted": sum(step.accepted for step in run.history),
        "seconds": run.seconds + time.perf_counter() - run.begun,
        "loss": run.best[0],
        "chi2": square / count,
    }
    return Fit(
        heights=problem.basis.inside(problem.basis.base),
        result=result,
        std=std,
        seen=seen,
        albedo=unknowns.albedo,
        exposures=unknowns.exposures,
        offsets=unknowns.offsets,
        images=tuple(images),
        residuals=tuple(differences),
        stats=stats,
        history=tuple(run.history),
    )
