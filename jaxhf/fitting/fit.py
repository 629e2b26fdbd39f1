"""Recovers heights from pictures."""

import dataclasses
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Bool, Float

from ..core.errors import ArgumentError, kind_of
from ..core.settings import Settings
from ..core.types import AnyArray
from ..io.checkpoint import load_facts
from ..io.errors import FileError
from ..io.files import require_folder
from ..scene.heightfield import Heightfield
from ..scene.scene import Scene
from ..xla.transfers import takes_numbers
from .basis import Unknowns
from .diagnosis import FAR_FROM_ONE, Findings, Region, warnings, where_residuals_are, worst_regions
from .findings import (
    Left,
    boundary_places,
    dependent_channels,
    informing_values,
    light_directions,
    misfit_of_length,
    shows_mean,
    strayed,
    unlike_noise,
    what_may_help,
)
from .groups import masked_targets
from .history import Draws, Step, Stop
from .loop import FitLoop
from .noise import chi_squared, why_noise_is_unsure
from .options import Albedo, FitOptions, Loss, Solver
from .problem import Problem, make_problem
from .residuals import found_scenes
from .solvers import BFGS_UNKNOWNS, count_unknowns
from .uncertainty import require_small, standard_deviations, with_unexplained

_OFF = 3.0  # standard deviations of the noise by which a background must be off to count


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
      noise: standard deviation of each picture's values at weight 1, shape (pictures,): as given, or as estimated.
      scenes: as they were given, with all that was found: heights, albedo, lights and cameras.
      settings: those that were given, with all that was chosen: `render` with them makes `images` of `scenes`, but for the
        pixels that a boundary crosses, which have more samples in a fit.
      images: the pictures as they would be measured, (h, w) or (h, w, c) each, as their targets.
      residuals: `images` - targets; 0 where a target has no weight.
      regions: the three blocks of the pictures with the largest residuals.
      warnings: what speaks against trusting the heights, a sentence each; empty where nothing does.
      stats: steps, accepted, seconds, loss; chi2, the mean square of the pictures' residuals, by degree of freedom, in units of
        `noise` and the error of their samples, without a background that is explained: about 1 where `noise` is right and all
        is explained.
      history: a `Step` for each step.
    """

    heights: Float[AnyArray, "ny nx"]
    result: Stop
    std: Float[np.ndarray, "ny nx"] | None
    seen: Bool[np.ndarray, "ny nx"]
    albedo: Float[AnyArray, "ty tx c"] | None
    exposures: Float[AnyArray, " pictures"] | None
    offsets: Float[AnyArray, " pictures"] | None
    noise: Float[np.ndarray, " pictures"]
    scenes: tuple[Scene, ...]
    settings: Settings
    images: tuple[np.ndarray, ...]
    residuals: tuple[np.ndarray, ...]
    regions: tuple[Region, ...]
    warnings: tuple[str, ...]
    stats: dict[str, int | float]
    history: tuple[Step, ...]


@takes_numbers
def fit(
    scenes: Sequence[Scene],
    targets: Sequence[Any],
    *,
    settings: Settings | None = None,
    weights: Sequence[Any] | None = None,
    noise: Any = None,
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
    light_std: float | int | None = None,
    camera_std: Any = None,
    loss: Loss | str = "geman",
    loss_scale: float | int = 3.0,
    solver: Solver | str = "lm",
    levels: Sequence[float] | None = None,
    max_steps: int = 100,
    inner_steps: int = 60,
    tolerance: float | int | None = None,
    uncertainty: int | str | None = None,
    progress: Callable[[Step | Draws], None] | bool = False,
    checkpoint: str | os.PathLike[str] | None = None,
    checkpoint_every: int = 10,
    resume: bool = False,
    mesh: Mesh | None = None,
) -> Fit:
    """Recovers the heights of a terrain from pictures of it.

    Minimises Σ ρ((exposure · picture(heights) + offset - target) / noise) + Σ ((heights - prior) / prior_std)² / 2
    + Σ (Laplacian / smoothness)² / 2 over the heights and what else is unknown, from coarse to fine, by Levenberg-Marquardt
    steps that form no dense matrix. Every term is in standard deviations, so the deviations of the result follow from it.

    Scenes and pictures are enough: noise, samples, and whether moving silhouettes and shadows take part are chosen by what is
    in sight, the loss is robust, and `Fit.warnings` says what speaks against the result. What changes no picture (the height
    of a plain under a vertical view) stays as it was at the start.

    Args:
      scenes: one a picture. Their first heightfields share shape, precision, spacing and origin, and are what is sought.
      targets: linear radiance, shape (h, w), (h, w, 1) or (h, w, 3) as the scene's camera says, top row first. One without or
        with one channel is compared with the mean over a picture's channels.
      settings: how to render. Samples that it leaves open are 4 a pixel, or the scene's if that is more. Where it leaves
        `edge_samples` open, points on edges are taken where silhouettes, the terrain's border or shadows may be in sight, 2048
        to 32768 by their length in the pictures; not where the albedo is unknown or a mirror in the scene. Where it leaves
        `normals` open: "six", or "six-angle" where the pictures tell.
      weights: for each picture None or a map (h, w) or (h, w, c), from 0 (masked: the target may be nan there)
        on; it divides the noise.
      noise: standard deviation of a target's values at weight 1, radiance; one number or one for each picture. None: each
        picture's is estimated from what the fit leaves of it, see `Fit.noise`.
      start: heights to begin with: a number (flat), a grid over the same footprint, of any size, or None: those of the
        first scene. They may have no holes: fill in what is not known; where a picture shows no ground there, give its
        pixels no weight.
      prior: heights known beforehand, as `start`; None: nothing.
      prior_std: standard deviation of their errors, a number or shape (ny, nx), height units.
      prior_length: correlation length L of those errors, in world units as dx and dy are, not in cells; from one cell to the
        terrain's longer side. None: they are independent. For a terrain that was smoothed by a Gaussian of standard deviation
        s, L is about s / √2: cells of 30 m smoothed over 8 of them have s = 240 m and L = 170 m, see docs/concepts/recovery.md.
      prior_exponent: the amplitudes of these errors' DCT modes, over prior_std, go as (1 + (L · frequency)²)^(-exponent / 2)
        (Matérn's family). 2 is Whittle's of 1954, with the correlation (r/L) K₁(r/L) at the distance r; 3 is smoother.
      smoothness: standard deviation of the sum of a height's differences to its four neighbours, height units; None: no
        such term.
      albedo: "known"; "constant", one unknown factor on the heightfield's albedo; "map", a factor for each texel of its image,
        or for each vertex where it has none.
      albedo_smoothness: as `smoothness`, of those factors.
      exposures, offsets: whether each picture has an unknown factor, an unknown addend. Where the albedo is unknown too, only
        the product of exposure and albedo is known; the fit keeps near 1.
      light_std: how far the direction of each picture's light, of its first Directional one, may be off: the standard deviation
        of either of two angles, degrees. None: it is known.
      camera_std: the same of each picture's camera: of its position along each axis, world units, and of its rotation about
        each, degrees. None: they are known. Pictures alone do not say where everything is: turning or moving the cameras, the
        lights and the terrain together changes none of them. The priors settle that, of the heights above all.
      loss: ρ, see `loss_scale`: "squares", r²/2; "huber", "cauchy" and "geman" make less of what is far off, such as
        pixels that a moved shadow explains. They begin with a scale as wide as the residuals and come down (Black and
        Rangarajan 1996).
      loss_scale: where that begins at last, in standard deviations.
      solver: "lm"; "bfgs" (4096 unknowns at most) and "lbfgs"; "adam", optax's, for its robustness against a noisy derivative.
      levels: shares of the highest frequency up to which heights are varied, one after the other, the last being 1; None:
        from 8 modes a side, doubled each time, for "lm", all at once for the others.
      max_steps: over all levels.
      inner_steps: LSMR iterations in one step of Levenberg-Marquardt, at most; of conjugate gradients, where the pictures'
        derivative is a sparse matrix, at most five times as many.
      tolerance: of the relative change of unknowns and residuals in one step at which the fit has converged. None: with "lm",
        when a step would lower the loss by less than 0.001 for each height, which moves heights by 0.05 of the deviation that
        the noise leaves them with; else 1e-4.
      uncertainty: None; the number of samples from which standard deviations are estimated, each to 1 / √(2 · samples); or
        "exact", where pictures times unknowns are few. Ctrl-C while samples are drawn ends with those that there are, from
        two on. Where pictures are not explained to their noise, or boundaries stand elsewhere in them, deviations are those
        that residuals bear out.
      progress: called after each step with a `Step`, and after each sample of the deviations with a `Draws`, which says what
        is left to do, as `Step.to_come` does; True prints lines to standard error.
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
    for name, values in (("scenes", scenes), ("targets", targets)):
        if isinstance(values, Scene | str) or not hasattr(values, "__iter__"):
            raise ArgumentError("fit", name, f"must be a list, one for each picture, it is {kind_of(values)}")
    scenes, targets = tuple(scenes), tuple(targets)
    options = FitOptions(
        settings=Settings() if settings is None else settings, weights=weights, noise=noise, start=start, prior=prior,
        prior_std=prior_std,
        prior_length=prior_length, prior_exponent=prior_exponent, smoothness=smoothness, albedo=albedo,
        albedo_smoothness=albedo_smoothness, exposures=exposures, offsets=offsets, light_std=light_std, camera_std=camera_std,
        loss=loss, loss_scale=loss_scale,
        solver=solver, levels=levels, max_steps=max_steps, inner_steps=inner_steps, tolerance=tolerance,
        uncertainty=uncertainty, progress=progress, checkpoint=checkpoint, checkpoint_every=checkpoint_every,
        resume=resume, mesh=mesh,
    )  # fmt: skip
    if checkpoint is not None:
        _require_place(Path(checkpoint), resume)
    targets = masked_targets(scenes, targets, options.weights)
    problem, unknowns = make_problem(scenes, targets, options)
    field = scenes[0].heightfields[0]
    _require_solvable(problem, unknowns, field, options)
    loop = FitLoop(problem, unknowns, field, options)
    result = loop.run()
    loop.set_all_modes()
    return _report(loop, result, scenes, targets)


def _require_solvable(problem: Problem, unknowns: Unknowns, field: Heightfield, options: FitOptions) -> None:
    """Refuses what the solver or the standard deviations cannot do with a problem of this size and precision."""
    if options.camera_std is not None:
        _require_near(options.camera_std[0], field)
    if options.solver == "bfgs" and count_unknowns(unknowns) > BFGS_UNKNOWNS:
        raise ArgumentError(
            "fit", "solver", f"bfgs takes at most {BFGS_UNKNOWNS} unknowns, there are {count_unknowns(unknowns)}; take lbfgs"
        )
    sampled = options.uncertainty is not None and options.uncertainty != "exact"
    single = problem.basis.base.dtype == np.float32
    if (options.solver == "lm" or sampled) and single and jax.config.jax_enable_x64:  # pyright: ignore
        # lineax's LSMR then mixes single with double precision, a TypeError from deep inside.
        raise ArgumentError("fit", "scenes", "must have float64 heights where JAX's x64 mode is on, theirs are float32")
    if options.uncertainty == "exact":
        require_small(unknowns, problem)


def _require_near(deviation: float | int, field: Heightfield) -> None:
    """Refuses cameras that may be farther off than the terrain is long, such as by a deviation in another unit."""
    side = max((n - 1) * d for n, d in zip(field.heights.shape, (field.dy, field.dx), strict=True))
    if deviation > side:
        cells = deviation / min(field.dx, field.dy)
        raise ArgumentError(
            "fit",
            "camera_std",
            f"must have a position that is off by at most the terrain's longer side, {side:.6g}; it is {deviation:.6g}, or "
            f"{cells:.3g} cells. It is in the unit of dx and dy",
        )


def _require_place(checkpoint: Path, resume: bool) -> None:
    require_folder(checkpoint, "a checkpoint")
    if checkpoint.exists() and resume:
        load_facts(checkpoint)  # refuses what is damaged or no checkpoint
    elif checkpoint.exists():
        raise FileError(f"{checkpoint}: this checkpoint is there already; resume=True goes on from it, to begin anew remove it")


def _in_shape(image: Float[np.ndarray, "h w c"], shape: tuple[int, ...]) -> np.ndarray:
    """An image in the shape of its target; a grey one that was given with three channels is compared as one."""
    return np.broadcast_to(image, (*image.shape[:2], *shape[2:])).copy() if len(shape) == 3 else image[..., 0]


@np.errstate(over="ignore")  # of a fit that ended as not finite
def _report(loop: FitLoop, result: Stop, scenes: Sequence[Scene], targets: Sequence[Any]) -> Fit:
    problem, unknowns, options = loop.problem, loop.unknowns, loop.options
    images: list[np.ndarray] = [np.zeros(())] * problem.count
    differences: list[np.ndarray] = [np.zeros(())] * problem.count
    left: list[Any] = [None] * problem.count
    informing = informing_values(problem)
    pictures, influence = loop.pictures_and_influence(unknowns)
    for group, simulated in zip(problem.groups, pictures, strict=True):
        simulated, weights, measured = np.asarray(simulated), np.asarray(group.weights), np.asarray(group.targets)
        difference = np.where(weights > 0, simulated - measured, 0)
        for k, image, target, values, weight in zip(group.indices, simulated, measured, difference, weights, strict=True):
            shape = np.shape(targets[k])
            images[k], differences[k] = _in_shape(image, shape), _in_shape(values, shape)
            left[k] = Left(image, target, values * weight, informing[k], float(problem.noise[k]), float(problem.brightness[k]))
    in_noise = [picture.residual for picture in left]
    counts = [picture.informing | (np.abs(picture.residual) > _OFF) for picture in left]
    counted = np.concatenate([values[which] for values, which in zip(in_noise, counts, strict=True)]).astype(np.float64)
    regions, where = worst_regions(in_noise), where_residuals_are(in_noise, boundary_places(problem))
    chi2, free = chi_squared(problem, counted, [int(which.sum()) for which in counts], loop.freedom)
    seen = influence != 0
    std, scaled, draws, displaced = None, None, None, None
    if options.uncertainty is not None and result is not Stop.NON_FINITE:
        borne_out, scaled = with_unexplained(problem, counted, free)
        found = standard_deviations(unknowns, borne_out, options.uncertainty, options.inner_steps, loop.progress)
        std, drawn, displaced = found.std, found.drawn, (found.displacement, found.raised)
        draws = None if drawn is None else (int(options.uncertainty), drawn)
        if problem.prior is None:
            std = np.where(seen, std, np.inf)
    heights = jnp.asarray(problem.basis.crop(np.asarray(problem.basis.base)))
    findings = Findings(
        result=result,
        chi2=chi2,
        noise_given=options.noise is not None,
        where=where,
        regions=regions,
        help=what_may_help(problem, heights, left, options) if chi2 > FAR_FROM_ONE else "",
        unlike_noise=unlike_noise(left, options),
        channels=dependent_channels(left),
        strayed=strayed(problem, np.asarray(heights), seen, options.prior_std),
        seen=seen,
        mean_shown=shows_mean(influence),
        noise_share=float(np.min(problem.noise / problem.brightness)),
        lights=light_directions(problem),
        normals=problem.found_settings.normals if options.settings.normals is None else None,
        unsure_noise=why_noise_is_unsure(problem, unknowns, loop.freedom) if options.noise is None else None,
        length=misfit_of_length(problem, options),
        scaled=scaled,
        displaced=displaced,
        draws=draws,
    )
    stats = {
        "steps": len(loop.history),
        "accepted": sum(step.accepted for step in loop.history),
        "seconds": loop.elapsed(),
        "loss": loop.best[0],
        "chi2": chi2,
    }
    return Fit(
        heights=heights,
        result=result,
        std=std,
        seen=seen,
        albedo=unknowns.albedo,
        exposures=unknowns.exposures,
        offsets=unknowns.offsets,
        noise=problem.noise,
        scenes=found_scenes(scenes, unknowns, problem),
        settings=problem.found_settings,
        images=tuple(images),
        residuals=tuple(differences),
        regions=regions,
        warnings=warnings(findings),
        stats=stats,
        history=tuple(loop.history),
    )
