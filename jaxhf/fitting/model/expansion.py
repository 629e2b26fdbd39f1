"""The loss of a fit about some unknowns: pictures, residuals, and products with their derivative J.

This is the only place that knows how J is kept: as `Linearised` pictures, or, where mirrors or a sun with a size make samples
depend on more than one triangle, as a program that renders again for each product.
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ...core.types import AnyArray
from ...rendering.render import render_each
from ...scene.scene import Scene
from ...xla.compilation import compiled
from ...xla.devices import on_every_device
from .linearise import Linearised, changing_pixels, linearise_each
from .pictures import Group, can_be_linearised, with_albedo, with_material
from .problem import Problem
from .products import picture_each
from .unknowns import KNOWN, Basis, Unknowns, View, moved_each

Rows = list[Float[Array, "_ _ _ _"]]
"""A number for each value of each picture, group by group, shape (n, h, w, c); groups differ in it."""
Surface = tuple[Float[Array, "my mx"], Unknowns]
"""A number for each height of the padded surface, and the other unknowns, without `coefficients`."""
_PROBES = 8  # of the pictures' curvature


class Expansion(eqx.Module):
    """A problem about some unknowns, and there the pictures of each group with their derivatives; None where these are not
    kept, see `can_be_linearised`."""

    problem: Problem
    unknowns: Unknowns
    linearised: tuple[Linearised | None, ...]

    @property
    def heights(self) -> Float[Array, "ny nx"]:
        return self.problem.basis.crop(surface_of(self.unknowns, self.problem.basis))

    def of(self, problem: Problem) -> "Expansion":
        """The same pictures in a problem that differs in noise, priors or basis alone."""
        return dataclasses.replace(self, problem=problem)

    def with_noise(self, noise: Float[np.ndarray, " pictures"]) -> "Expansion":
        """The same with another standard deviation of each picture's values at weight 1, beside the error of their samples."""
        sampling = [None if known is None else np.asarray(known.sampling) for known in self.linearised]
        return self.of(self.problem.with_noise(noise, sampling))

    def pictures(self) -> Rows:
        """As they would be measured."""
        return _pictures(on_every_device(self, self.problem.mesh))

    def left(self) -> list[Float[np.ndarray, "n h w c"]]:
        """(picture - target) / noise, by NumPy: each operation of JAX's would be a program to compile."""
        pairs = zip(self.problem.groups, self.pictures(), strict=True)
        return [np.asarray(group.weights) * (np.asarray(image) - np.asarray(group.targets)) for group, image in pairs]

    def informing(self) -> list[Bool[np.ndarray, "n h w c"]]:
        """Which values depend on the heights; all of those with a weight where that is not known."""
        found = [np.asarray(group.given) > 0 for group in self.problem.groups]
        pairs = zip(found, self.linearised, strict=True)
        return [counts if known is None else counts & changing_pixels(known)[..., None] for counts, known in pairs]

    def push(self, change: Surface) -> Rows:
        """J times a change of the surface and of the other unknowns: by what the pictures change, in units of the noise."""
        return _push(*on_every_device((self, change), self.problem.mesh))

    def pull(self, rows: Rows) -> Surface:
        """Jᵀ times a number for each value of the pictures."""
        return _pull(*on_every_device((self, rows), self.problem.mesh))

    def random_gradients(self) -> tuple[Float[np.ndarray, "k ny nx"], list[Any]]:
        """The derivatives in each height, and in the other unknowns, of sums of residuals with random normal factors, of a few
        such sums.

        They are exactly zero for a height on which no picture depends, as its column of J is zero; for another height they are
        zero with probability zero. Their covariance over the factors is JᵀJ.
        """
        found, of_others = [], []
        for seed in range(_PROBES):
            rng = np.random.default_rng(seed)
            rows = [rng.standard_normal(group.targets.shape, np.float32) for group in self.problem.groups]
            gradient, others = self.pull([jnp.asarray(row, self.unknowns.coefficients.dtype) for row in rows])
            found.append(self.problem.basis.crop(np.asarray(gradient, np.float64)))
            of_others.append(jax.tree.map(np.asarray, others))
        return np.stack(found), of_others


def expand(unknowns: Unknowns, problem: Problem) -> Expansion:
    """The problem about these unknowns: its pictures are rendered here, by one program."""
    # What enters a compiled program must lie in the same places each time, or it is compiled again for the other ones.
    unknowns, problem = on_every_device((unknowns, problem), problem.mesh)
    return Expansion(problem, unknowns, _linearised(unknowns, problem))


def residuals(unknowns: Unknowns, about: Expansion) -> tuple[Any, None]:
    """All residuals, whose half squares add up to the loss; the second value is optimistix's auxiliary output.

    Those of the pictures pass through `soften`, so that a solver that accepts steps by the loss needs to know nothing of
    reweighting. (Steps by reweighted least squares left the terrain's border in a wrong place: far outliers pull.)
    """
    problem = about.problem
    pairs = zip(problem.groups, _simulate(unknowns, about, problem.basis.heights(unknowns.coefficients)), strict=True)
    parts = [soften(group.weights * (image - group.targets), problem.loss_scale) for group, image in pairs]
    return (parts, prior_residuals(unknowns, problem)), None


def prior_residuals(unknowns: Unknowns, problem: Problem) -> list[Array]:
    """How far the unknowns are from what is known of them without the pictures, in standard deviations."""
    surface = problem.terms.surface.of_surface(unknowns.coefficients, problem.basis)
    return [surface, *(term.residual(values) for term, values in problem.terms.others(unknowns))]


@functools.partial(compiled, jit=eqx.filter_jit, newer=None)
def surface_of(unknowns: Unknowns, basis: Basis) -> Float[Array, "my mx"]:
    """The heights with their padding, by one program."""
    return basis.surface(unknowns.coefficients)


@functools.partial(compiled, jit=eqx.filter_jit)
def _linearised(unknowns: Unknowns, problem: Problem) -> tuple[Linearised | None, ...]:
    def of(group: Group) -> Linearised | None:
        return linearise_each(group, unknowns, problem) if can_be_linearised(group.scenes, problem.settings) else None

    return on_every_device(tuple(map(of, problem.groups)), problem.mesh)


@functools.partial(compiled, jit=eqx.filter_jit, newer=None)
def _pictures(expansion: Expansion) -> Rows:
    unknowns = expansion.unknowns
    return _simulate(unknowns, expansion, expansion.problem.basis.heights(unknowns.coefficients))


def _by_surface(expansion: Expansion) -> tuple[Callable[[Float[Array, "my mx"], Unknowns], Rows], Surface]:
    """Pictures in units of the noise as a function of the surface and the other unknowns, and these."""
    problem, unknowns = expansion.problem, expansion.unknowns

    def pictures(surface: Float[Array, "my mx"], others: Unknowns) -> Rows:
        images = _simulate(others, expansion, problem.basis.crop(surface))
        return [group.weights * image for group, image in zip(problem.groups, images, strict=True)]

    return pictures, (problem.basis.surface(unknowns.coefficients), unknowns.without_modes())


@functools.partial(compiled, jit=eqx.filter_jit, newer=None)
def _push(expansion: Expansion, change: Surface) -> Rows:
    pictures, here = _by_surface(expansion)
    return jax.jvp(pictures, here, change)[1]


@functools.partial(compiled, jit=eqx.filter_jit, newer=None)
def _pull(expansion: Expansion, rows: Rows) -> Surface:
    pictures, here = _by_surface(expansion)
    return jax.vjp(pictures, *here)[1](rows)


def _simulate(unknowns: Unknowns, about: Expansion, heights: Float[Array, "ny nx"]) -> Rows:
    """The pictures as they would be measured: with their exposures and offsets; a grey one is the mean of the channels."""
    problem, images = about.problem, []
    for group, known in zip(problem.groups, about.linearised, strict=True):
        if known is not None:
            image = picture_each(known, group, heights, unknowns, problem)
        else:
            factors, seen = problem.factors(unknowns), _common(unknowns, problem)
            complete = functools.partial(group.complete, heights=heights, factors=factors, numbers=seen)
            views = moved_each(group.scenes, problem.moves(unknowns, group))
            image = render_each(views, complete, problem.settings, problem.mesh)
            if group.targets.shape[-1] == 1:
                image = jnp.mean(image, axis=-1, keepdims=True)
        if unknowns.exposures is not None:
            image = image * group.each(unknowns.exposures)
        if unknowns.offsets is not None:
            image = image + problem.bright * group.each(unknowns.offsets)
        images.append(image)
    return images


def _common(unknowns: Unknowns, problem: Problem) -> View:
    """By what a material's numbers are moved in all pictures."""
    material, unit = unknowns.view.material, problem.view_unit.material
    return KNOWN if material is None or unit is None else View(material=material[0] * unit, names=unknowns.view.names)


def found_scenes(scenes: Sequence[Scene], unknowns: Unknowns, problem: Problem) -> tuple[Scene, ...]:
    """The scenes as they were given, with all that was found; positions keep double precision."""
    heights, found = problem.basis.crop(surface_of(unknowns, problem.basis)), list(scenes)
    factors = problem.factors(unknowns)
    for group in problem.groups:
        # A far camera moves as one whose rays begin at its matrix: by that the eye moves, and given ones have no `_ahead`.
        plain = eqx.tree_at(lambda scenes: scenes.camera._ahead, group.scenes, None, is_leaf=lambda leaf: leaf is None)
        views = moved_each(plain, problem.moves(unknowns, group))
        new, old = ((part.lights, part.camera) for part in (views, plain))
        change = jax.tree.map(lambda new, old: np.asarray(new) - np.asarray(old), new, old)
        for n, k in enumerate(group.indices):
            scene = with_material(scenes[k].with_heights(heights), jax.tree.map(np.asarray, _common(unknowns, problem)))
            if factors is not None:
                scene = with_albedo(scene, factors)
            if jax.tree.leaves(unknowns.view):
                given = scene.lights, scene.camera
                lights, camera = jax.tree.map(lambda leaf, more, n=n: np.asarray(leaf) + more[n], given, change)
                scene = scene.with_lights(lights).with_camera(camera)
            found[k] = scene
    return tuple(found)


def soften(residual: Array, scale: Float[AnyArray, ""]) -> Array:
    """A residual whose half square is ρ of the given one: sign(r) √(2ρ(r)); k = scale, in standard deviations.

    ρ is the robust loss of the pictures: Geman and McClure's (1985), ρ(r) = r²/2 / (1 + (r/k)²), which forgets what is far off.
    """
    return residual / jnp.sqrt(1 + (residual / scale) ** 2)


def influence_function(
    residual: Float[np.ndarray, " n"], scale: Float[AnyArray, ""]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """ψ = ρ', its derivative, and ψ / r, the weight of residuals in iteratively reweighted least squares."""
    square = (residual / float(scale)) ** 2
    weight = 1 / (1 + square) ** 2
    return weight * residual, weight * (1 - 3 * square) / (1 + square), weight
