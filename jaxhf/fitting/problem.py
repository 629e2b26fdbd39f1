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

from ..core.devices import local_mesh
from ..core.errors import ArgumentError
from ..core.settings import Settings
from ..scene.light import Sky
from ..scene.localise import localise
from ..scene.material import Matte
from ..scene.scene import Scene
from ..scene.texture import ImageTexture
from ..trace.world import resolve_settings
from .basis import Basis, Unknowns, make_basis, make_heights, pad
from .defaults import choose_edge_samples, choose_samples
from .linearise import Linearised
from .options import FitOptions
from .prior import Prior, make_prior, prior_padding
from .view import KNOWN, View, sun

_FIRST_NOISE = 0.01  # of a picture's brightness, where none is given
_DARK = 0.03  # of a picture's brightness: what lies in shadow
_DARK_SHARE = 0.003  # of its pixels
_LEAST_NOISE = 5e-4  # of it: about the rounding of a picture with 8 bits


class Group(eqx.Module):
    """Pictures whose scenes differ in numbers only; they are rendered one after the other by one program.

    Attributes:
      scenes: what differs from picture to picture: a scene whose leaves have a leading axis of n pictures, None for the others.
      shared: those others, once for all pictures. The heights that are sought are None in both.
      targets: shape (n, h, w, c), c = 1 for grey.
      given: the user's weights, by which the noise is divided, zero where a value does not count, shape (n, h, w, c).
      weights: 1 / standard deviation of each value, zero where there is none, shape (n, h, w, c).
      indices: the pictures' positions among the caller's.
    """

    scenes: Scene
    shared: Scene
    targets: Float[Array, "n h w c"]
    given: Float[Array, "n h w c"]
    weights: Float[Array, "n h w c"]
    indices: tuple[int, ...] = eqx.field(static=True)

    def complete(self, scene: Scene, heights: Float[Array, "ny nx"]) -> Scene:
        """One picture's leaves of `scenes`, with those that are shared and these heights."""
        return _with_heights(eqx.combine(scene, self.shared), heights)


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
    field, shape, dtype = first.heightfields[0], first.heights.shape, first.heights.dtype
    start = _without_holes(np.asarray(first.heights)) if options.start is None else options.start
    heights = make_heights("start", start, shape)
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
        local_mesh() if options.mesh is None else options.mesh,
        None,
        *_view_priors(scenes, options),
    )
    return problem.with_edge_samples(jnp.asarray(heights, dtype), options), unknowns


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


def require_scenes(scenes: Sequence[Scene], targets: Sequence[Any]) -> None:
    """Checks that there is a scene for each picture, and that all have the same first heightfield but for its heights."""
    if len(scenes) == 0:
        raise ArgumentError("fit", "scenes", "must hold at least one Scene, it is empty")
    if len(targets) != len(scenes):
        raise ArgumentError(
            "fit", "targets", f"must hold a picture for each of the {len(scenes)} scenes, they are {len(targets)}"
        )
    for k, scene in enumerate(scenes):
        _require_alike(k, scene, scenes[0])


def make_groups(
    scenes: Sequence[Scene],
    targets: Sequence[Any],
    noise: Float[np.ndarray, " pictures"],
    options: FitOptions,
    settings: Settings,
) -> tuple[Group, ...]:
    """Checks pictures, and gathers those that one program can render with these settings."""
    weights = options.weights
    if weights is not None and len(weights) != len(scenes):
        raise ArgumentError("fit", "weights", f"must hold one for each of the {len(scenes)} scenes, they are {len(weights)}")
    found: dict[Any, list[tuple[int, Scene, Any, Any]]] = {}
    for k, scene in enumerate(scenes):
        target, weight = _picture(k, scene, targets[k], None if weights is None else weights[k])
        local = _with_heights(localise(scene), None)
        leaves, structure = jax.tree.flatten(local)
        kind = (
            structure,
            resolve_settings(settings, scene).samples,
            tuple(leaf.shape for leaf in leaves),
            target.shape,
        )
        found.setdefault(kind, []).append((k, local, target, weight))
    dtype = scenes[0].heights.dtype
    groups = []
    for members in found.values():
        given = np.stack([weight for *_, weight in members])
        indices = tuple(k for k, *_ in members)
        groups.append(
            Group(
                *_stacked([local for _, local, _, _ in members]),
                jnp.asarray(np.stack([target for *_, target, _ in members]), dtype),
                jnp.asarray(given, dtype),
                jnp.asarray(given / noise[list(indices)].reshape(-1, 1, 1, 1), dtype),
                indices,
            )
        )
    return tuple(groups)


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
    noise = np.asarray(given, np.float64)
    if noise.shape not in ((), (len(targets),)) or not (np.isfinite(noise) & (noise > 0)).all():
        raise ArgumentError("fit", "noise", f"must be positive, one number or one for each scene, it is {given!r}")
    return np.broadcast_to(noise, (len(targets),)).copy()


def _brightness(targets: Sequence[Any]) -> Float[np.ndarray, " pictures"]:
    """Of each picture, the value that 1 % of it exceeds; 1 for a black one."""
    bright = [np.nanpercentile(np.asarray(target, np.float64), 99) for target in targets]
    return np.where(np.asarray(bright) > 0, bright, 1.0)


def _with_heights(scene: Scene, heights: Array | None) -> Scene:
    """`scene` over other heights of its first heightfield; None where they are to be filled in later."""
    return eqx.tree_at(lambda scene: scene.heightfields[0].heights, scene, heights, is_leaf=lambda leaf: leaf is None)


def _stacked(scenes: Sequence[Scene]) -> tuple[Scene, Scene]:
    """Cameras, lights and what else differs, stacked; and what all scenes share bit for bit: leaves are None in the other."""
    first = scenes[0]

    def same(leaf: Any, *others: Any) -> bool:
        return all(leaf is other or np.asarray(leaf).tobytes() == np.asarray(other).tobytes() for other in others)

    shared = jax.tree.map(same, *scenes)
    # A loop over pictures needs something to go through also where there is but one.
    views = jax.tree.map(lambda _: False, (first.camera, first.lights))
    shared = eqx.tree_at(lambda scene: (scene.camera, scene.lights), shared, views)
    stacked = jax.tree.map(
        lambda *leaves: jnp.asarray(np.stack(leaves)), *(eqx.filter(scene, shared, inverse=True) for scene in scenes)
    )
    return stacked, jax.tree.map(jnp.asarray, eqx.filter(first, shared))


def _require_alike(k: int, scene: Scene, first: Scene) -> None:
    """All scenes have the same first heightfield, but for the heights."""
    if not isinstance(scene, Scene):
        raise ArgumentError("fit", f"scenes[{k}]", f"must be a Scene, it is a {type(scene).__name__}")
    if not scene.heightfields:
        raise ArgumentError("fit", f"scenes[{k}]", "must have a heightfield, there is none among its objects")
    field, other = scene.heightfields[0], first.heightfields[0]
    for name in ("shape", "dtype"):
        mine, theirs = getattr(field.heights, name), getattr(other.heights, name)
        if mine != theirs:
            raise ArgumentError(
                "fit", f"scenes[{k}]", f": the heights must have the {name} of the first scene's, {theirs}; it is {mine}"
            )
    for name in ("dx", "dy", "x0", "y0"):
        mine, theirs = getattr(field, name), getattr(other, name)
        if mine != theirs:
            raise ArgumentError(
                "fit", f"scenes[{k}]", f": {name} must be that of the first scene's heightfield, {theirs}; it is {mine}"
            )


def _picture(k: int, scene: Scene, target: Any, weight: Any) -> tuple[np.ndarray, np.ndarray]:
    """Target and weight of one picture, shape (h, w, c); what has no weight is zero."""
    size = (scene.camera.height, scene.camera.width)
    target = np.asarray(target)
    if target.dtype.kind not in "fV":  # the latter are bfloat16 and its like
        rule = f"must hold linear radiance in floats, 1 being white; it holds {target.dtype} (load_image decodes a picture)"
        raise ArgumentError("fit", f"targets[{k}]", rule)
    target = target.astype(np.float64)
    if target.shape not in (size, (*size, 1), (*size, 3)):
        raise ArgumentError(
            "fit", f"targets[{k}]", f"must have shape {size} or {(*size, 3)}, as its camera says; it is {target.shape}"
        )
    target = target.reshape(*size, -1)
    weight = np.ones(size) if weight is None else np.asarray(weight, np.float64)
    if weight.shape not in (size, target.shape):
        raise ArgumentError("fit", f"weights[{k}]", f"must have shape {size}, its shape is {weight.shape}")
    if not np.isfinite(weight).all() or weight.min() < 0 or weight.max() == 0:
        raise ArgumentError(
            "fit", f"weights[{k}]", f"must be finite, from 0 on, not all 0; they are {weight.min()} to {weight.max()}"
        )
    weight = np.broadcast_to(weight.reshape(*size, -1), target.shape)
    if target.shape[-1] == 3 and _is_grey(target, weight):
        target, weight = target[..., :1], weight[..., :1]
    bad = ~np.isfinite(target) & (weight > 0)
    if bad.any():
        y, x, c = np.argwhere(bad)[0]
        raise ArgumentError(
            "fit", f"targets[{k}]", f"must be finite where it has a weight; row {y} column {x} channel {c} is {target[y, x, c]}"
        )
    return np.where(weight > 0, target, 0), weight


def _is_grey(target: Float[np.ndarray, "h w 3"], weight: Float[np.ndarray, "h w 3"]) -> bool:
    """Whether its channels are one measurement, stored three times."""
    counts = (weight > 0).all(axis=-1)
    return bool(np.all(target[counts] == target[counts][:, :1]) and np.all(weight == weight[..., :1]))


def mode_curvature(problem: Problem, influences: Sequence[np.ndarray]) -> Float[np.ndarray, "my mx"]:
    """The curvature of the loss along each DCT mode of unit height.

    That of the pictures, the diagonal of JᵀJ, is the mean square of Jᵀz over draws of z, and over neighbouring modes; in that
    of the prior, weights count by their mean square.

    Args:
      problem: see there.
      influences: Jᵀz in the heights, (ny, nx) each, see `pictures_and_influence`.
    """
    basis = problem.basis
    rows, columns = np.asarray(basis.rows, np.float64), np.asarray(basis.columns, np.float64)
    padding = [(n, n) for n in basis.padding]
    squares = np.mean([(rows @ np.pad(influence, padding) @ columns.T) ** 2 for influence in influences], axis=0)
    curvature = _over_neighbours(squares)
    curvature[0, 0] = squares[0, 0]  # unlike any other
    if problem.prior is not None:
        weight = float(np.mean(np.square(np.asarray(problem.prior.weight))))
        stiffness = 1.0 if problem.prior.stiffness is None else np.asarray(problem.prior.stiffness, np.float64)
        curvature += weight * stiffness**2
    if problem.smoothness is not None:
        y, x = (2 - 2 * np.cos(np.pi * np.arange(n) / n) for n in curvature.shape)
        curvature += (float(problem.smoothness) * (y[:, None] + x[None, :])) ** 2
    return curvature


def _over_neighbours(values: Float[np.ndarray, "my mx"]) -> Float[np.ndarray, "my mx"]:
    """The mean over 3 x 3 values, without [0, 0] but in its own."""
    padded = np.pad(values, 1, mode="reflect")
    padded[1, 1] = np.mean([values[0, 1], values[1, 0]])
    ny, nx = values.shape
    return np.mean([padded[y : y + ny, x : x + nx] for y in range(3) for x in range(3)], axis=0)


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
