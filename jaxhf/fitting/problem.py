"""What a fit is given, checked and laid out for tracing."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Array, Float

from ..core.errors import ArgumentError
from ..core.precision import numbers
from ..core.settings import Settings
from ..core.types import Flag
from ..scene.light import Sky
from ..scene.material import Matte
from ..scene.scene import Scene
from ..scene.texture import ImageTexture
from ..xla.devices import chosen_mesh
from .basis import Basis, Unknowns, make_basis, make_heights, pad
from .defaults import choose_edge_samples, choose_samples
from .groups import Group, make_groups, require_scenes
from .linearise import Linearised, can_be_linearised
from .options import FitOptions
from .prior import Prior, make_prior, prior_padding
from .view import KNOWN, View, sun

_FIRST_NOISE = 0.01  # of a picture's brightness, where none is given
_DARK = 0.03  # of a picture's brightness: what lies in shadow
_DARK_SHARE = 0.003  # of its pixels
_LEAST_NOISE = 5e-4  # of it: about the rounding of a picture with 8 bits


class Problem(eqx.Module):
    """All that the residuals depend on beside the unknowns. What is not asked for is None.

    Attributes:
      groups: the pictures.
      basis: from DCT coefficients to heights; another for each level.
      prior: see `Prior`.
      smoothness: 1 / the standard deviation of the Laplacian of the heights (a sum of differences to the neighbours).
      albedo_smoothness: the same of the albedo's factors.
      loss_scale: the size, in standard deviations, above which a residual counts less; changes with the level.
      loss: the robust loss, see `soften`.
      noise: standard deviation of each picture's values at weight 1, by which the groups' weights are divided.
      brightness: of each picture, the value that 1 % of it exceeds.
      settings: how to render.
      mesh: the devices that share the work.
      linearised: the pictures of each group with their derivatives in the heights, at the very unknowns at which residuals are
        evaluated; None: evaluating residuals renders the pictures.
      view_unit: of the numbers of `Unknowns.view`, radians and world units, shapes (2,) and (6,).
      view_weight: 1 / the standard deviations of their priors, in these units.
      by_angle: whether normals are weighted by angle, for the pictures to tell; None: that is not open, or they cannot.
    """

    groups: tuple[Group, ...]
    basis: Basis
    prior: Prior | None
    smoothness: Float[Array, ""] | None
    albedo_smoothness: Float[Array, ""] | None
    loss_scale: Float[Array, ""] | None
    noise: Float[np.ndarray, " pictures"]
    brightness: Float[np.ndarray, " pictures"]
    loss: str = eqx.field(static=True)
    settings: Settings = eqx.field(static=True)
    mesh: Mesh = eqx.field(static=True)
    linearised: tuple[Linearised, ...] | None = None
    view_unit: View = KNOWN
    view_weight: View = KNOWN
    by_angle: Flag | None = None

    @property
    def found_settings(self) -> Settings:
        """The settings, with the normals that the pictures told."""
        if self.by_angle is None or not bool(self.by_angle):
            return self.settings
        return dataclasses.replace(self.settings, normals="six-angle")

    @property
    def can_be_linearised(self) -> bool:
        """Whether the derivatives of all pictures in the heights can be kept, where the albedo is known."""
        return all(can_be_linearised(group.scenes, self.settings) for group in self.groups)

    @property
    def least_noise(self) -> Float[np.ndarray, " pictures"]:
        """Below which no estimate of the noise may fall."""
        return _LEAST_NOISE * self.brightness

    @property
    def count(self) -> int:
        """How many pictures there are."""
        return sum(len(group.indices) for group in self.groups)

    def with_edge_samples(self, heights: Float[Array, "ny nx"], options: FitOptions) -> "Problem":
        """The problem with as many points on edges as pictures of these heights call for, if that is left open.

        Where there were some, others are taken only if it calls for four times as many: all is then compiled again.
        """
        if options.settings.edge_samples is not None or options.albedo != "known":
            return self
        views = [
            group.complete(jax.tree.map(lambda leaf, k=k: np.asarray(leaf)[k], group.scenes), heights)
            for group in self.groups
            for k in range(len(group.indices))
        ]
        dark = self.settings.shadows and any(_shadows_in(group) for group in self.groups)
        count, before = choose_edge_samples(views, self.settings, dark), self.settings.edge_samples
        if count == before or (before and count < 4 * before):
            return self
        return dataclasses.replace(self, settings=dataclasses.replace(self.settings, edge_samples=count), linearised=None)

    def with_noise(self, noise: Float[np.ndarray, " pictures"]) -> "Problem":
        """The same problem with another standard deviation of each picture's values at weight 1.

        To it comes, where pictures are `linearised`, the error of their samples.
        """
        groups = []
        for number, group in enumerate(self.groups):
            # By NumPy: each operation of JAX's would be a program to compile.
            given = np.asarray(group.given)
            variance = noise[list(group.indices)].astype(given.dtype).reshape(-1, 1, 1, 1) ** 2
            variance = variance / np.where(given > 0, given, 1) ** 2
            if self.linearised is not None:
                variance = variance + np.asarray(self.linearised[number].sampling)[..., None] ** 2
            weights = np.where(given > 0, 1 / np.sqrt(variance), 0)
            groups.append(dataclasses.replace(group, weights=jnp.asarray(weights, given.dtype)))
        return dataclasses.replace(self, groups=tuple(groups), noise=noise)


def make_problem(scenes: Sequence[Scene], targets: Sequence[Any], options: FitOptions) -> tuple[Problem, Unknowns]:
    """The problem, and the unknowns from which a fit starts.

    Raises:
      ValueError: scenes, targets and options do not belong together.
    """
    require_scenes(scenes, targets)
    first = scenes[0]
    field, dtype = first.heightfields[0], first.heights.dtype
    start = _without_holes(np.asarray(first.heights)) if options.start is None else options.start
    heights = make_heights("start", start, field)
    settings = choose_samples(scenes, options.settings)
    noise = _noise(options.noise, targets)
    groups = make_groups(scenes, targets, noise, options, settings)
    prior = make_prior(field, options.prior, options.prior_std, options.prior_length, options.prior_exponent)
    basis = make_basis(field, pad(heights, prior_padding(field, options.prior_length)))
    unknowns = first_unknowns(first, basis, max(group.targets.shape[-1] for group in groups), len(scenes), options)
    problem = Problem(
        groups,
        basis,
        prior,
        None if options.smoothness is None else jnp.asarray(1 / options.smoothness, dtype),
        None if options.albedo_smoothness is None else jnp.asarray(1 / options.albedo_smoothness, dtype),
        None if options.loss == "squares" else jnp.asarray(options.loss_scale, dtype),
        noise,
        _brightness(targets),
        options.loss,
        settings,
        chosen_mesh("fit", options.mesh),
        None,
        *_view_priors(scenes, options),
    )
    if _open_normals(problem, options):
        problem = dataclasses.replace(problem, by_angle=jnp.asarray(False))
    return problem.with_edge_samples(jnp.asarray(heights, dtype), options), unknowns


def _open_normals(problem: Problem, options: FitOptions) -> bool:
    """Whether pictures are to tell how normals are weighted, as far as steps know their derivatives."""
    known = options.solver == "lm" and options.albedo == "known" and problem.can_be_linearised
    return known and problem.settings.normals is None and problem.settings.shading == "smooth"


def _view_priors(scenes: Sequence[Scene], options: FitOptions) -> tuple[View, View]:
    """The units and the weights of what is sought of lights and cameras, see `Problem`; ArgumentError where there is no such
    light.

    A radian, and for cameras a quarter of the terrain: so they change pictures about as much as modes of one slope do. In units
    of deviations of 1 degree a light's columns of J were 20 to 40 times smaller: LSMR ended before it had moved any, and a fit
    of 15 steps took 58 and stopped short.
    """
    field, unit, weight = scenes[0].heightfields[0], KNOWN, KNOWN
    dtype = field.heights.dtype
    if options.light_std is not None:
        for k, scene in enumerate(scenes):
            if sun(scene.lights) is None:
                raise ArgumentError("fit", "light_std", f"must stand with Directional lights, scenes[{k}] has none")
        unit = dataclasses.replace(unit, light=jnp.ones(2, dtype))
        weight = dataclasses.replace(weight, light=jnp.full(2, 1 / math.radians(options.light_std), dtype))
    if options.camera_std is not None:
        position, rotation = options.camera_std
        ny, nx = field.heights.shape
        length = max((ny - 1) * field.dy, (nx - 1) * field.dx)
        units = np.array([length / 4] * 3 + [1 / 4] * 3)
        unit = dataclasses.replace(unit, camera=jnp.asarray(units, dtype))
        deviations = np.array([position] * 3 + [math.radians(rotation)] * 3)
        weight = dataclasses.replace(weight, camera=jnp.asarray(units / deviations, dtype))
    return unit, weight


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


def _shadows_in(group: Group) -> bool:
    """Whether pictures without a sky have dark places."""
    if any(isinstance(light, Sky) for light in group.scenes.lights):
        return False
    targets, counts = np.asarray(group.targets), np.asarray(group.given) > 0
    shares = [np.mean(t[c] < _DARK * np.percentile(t[c], 99)) for t, c in zip(targets, counts, strict=True)]
    return bool(max(shares) > _DARK_SHARE)


def _noise(given: Any, targets: Sequence[Any]) -> Float[np.ndarray, " pictures"]:
    """The standard deviation of each picture's values; where none is given, one from which an estimate begins."""
    if given is None:
        return _FIRST_NOISE * _brightness(targets)
    noise = np.asarray(numbers(given), np.float64)
    if noise.shape not in ((), (len(targets),)) or not (np.isfinite(noise) & (noise > 0)).all():
        raise ArgumentError("fit", "noise", f"must be positive, one number or one for each scene, it is {given!r}")
    return np.broadcast_to(noise, (len(targets),)).copy()


def _brightness(targets: Sequence[Any]) -> Float[np.ndarray, " pictures"]:
    """Of each picture, the value that 1 % of it exceeds; 1 for a black one."""
    bright = [np.nanpercentile(np.asarray(target, np.float64), 99) for target in targets]
    return np.where(np.asarray(bright) > 0, bright, 1.0)


def first_unknowns(scene: Scene, basis: Basis, channels: int, count: int, options: FitOptions) -> Unknowns:
    """Those from which a fit starts: coefficients 0, the albedo, lights and cameras of the scenes, exposure 1 and offset 0."""
    shape, dtype = scene.heights.shape, scene.heights.dtype
    if options.albedo == "known":
        albedo = None
    else:
        material = next(obj.material for obj in scene.objects if obj.shape is scene.heightfields[0])
        if not isinstance(material, Matte):
            raise ArgumentError(
                "fit", "albedo", f"is asked for, the heightfield's material must be Matte, it is {type(material).__name__}"
            )
        if options.albedo == "map" and isinstance(material.albedo, ImageTexture):
            texels = material.albedo.texels.shape[:2]
        else:
            texels = shape if options.albedo == "map" else (1, 1)
        albedo = jnp.ones((*texels, channels), dtype)
    return Unknowns(
        jnp.zeros_like(basis.base),
        albedo,
        jnp.ones(count, dtype) if options.exposures else None,
        jnp.zeros(count, dtype) if options.offsets else None,
        View(
            None if options.light_std is None else jnp.zeros((count, 2), dtype),
            None if options.camera_std is None else jnp.zeros((count, 6), dtype),
        ),
    )
