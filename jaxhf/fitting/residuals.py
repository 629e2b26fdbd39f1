"""How far a terrain is from its pictures and from what is known beforehand, in standard deviations."""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from ..rendering.render import render_each
from ..scene.material import Matte
from ..scene.scene import Scene
from ..scene.texture import ImageTexture
from ..xla.compilation import compiled
from ..xla.devices import on_every_device
from .basis import Basis, Unknowns
from .groups import Group
from .linearise import Linearised, linearise_each, picture_each
from .problem import Problem
from .robust import soften
from .view import moved


def residuals(unknowns: Unknowns, problem: Problem) -> tuple[Any, None]:
    """All residuals, to be squared and added up; the second value is optimistix's auxiliary output.

    Those of the pictures pass through `soften`, so the sum is the robust loss itself, and a solver that accepts steps by
    it needs to know nothing of reweighting.
    """
    parts = [soften(part, problem.loss, problem.loss_scale) for part in picture_residuals(unknowns, problem)]
    return (parts, prior_residuals(unknowns, problem)), None


def half_squares(unknowns: Unknowns, problem: Problem) -> tuple[Float[Array, ""], None]:
    """Half the sum of the squared residuals: what minimisers take."""
    leaves = jax.tree.leaves(residuals(unknowns, problem)[0])
    return sum((jnp.sum(leaf * leaf) for leaf in leaves), start=jnp.zeros((), leaves[0].dtype)) / 2, None


def picture_residuals(unknowns: Unknowns, problem: Problem) -> list[Float[Array, "n h w c"]]:
    """(picture - target) / noise, a group at a time."""
    images = simulate(unknowns, problem)
    return [group.weights * (image - group.targets) for group, image in zip(problem.groups, images, strict=True)]


def simulate(
    unknowns: Unknowns, problem: Problem, heights: Float[Array, "ny nx"] | None = None
) -> list[Float[Array, "n h w c"]]:
    """The pictures as they would be measured: with their exposures and offsets; a grey one is the mean of the channels.

    Args:
      unknowns: of the fit.
      problem: see `Problem.linearised`.
      heights: in place of those of `unknowns`.
    """
    heights = problem.basis.heights(unknowns.coefficients) if heights is None else heights
    linearised = [None] * len(problem.groups) if problem.linearised is None else problem.linearised
    return [_simulate(unknowns, problem, heights, *pair) for pair in zip(problem.groups, linearised, strict=True)]


def linearised(unknowns: Unknowns, problem: Problem) -> Problem:
    """The problem with its pictures at these unknowns and their derivatives, so that its residuals there render nothing.

    With mirrors, or an unknown albedo, there is no such derivative: then the problem as it is; also where it has them already.
    """
    if problem.linearised is not None or unknowns.albedo is not None:
        return problem
    if not problem.can_be_linearised:
        return problem
    heights = heights_of(unknowns, problem.basis)
    found = _linearised(*on_every_device((heights, unknowns, problem), problem.mesh))
    return dataclasses.replace(problem, linearised=found)


@eqx.filter_jit
def heights_of(unknowns: Unknowns, basis: Basis) -> Float[Array, "ny nx"]:
    """The heights, from one program, so that they can be compared bit for bit."""
    return basis.heights(unknowns.coefficients)


@eqx.filter_jit
def surface_of(unknowns: Unknowns, basis: Basis) -> Float[Array, "my mx"]:
    """The heights with their padding, as `heights_of`."""
    return basis.surface(unknowns.coefficients)


@functools.partial(compiled, jit=eqx.filter_jit)
def _linearised(heights: Float[Array, "ny nx"], unknowns: Unknowns, problem: Problem) -> tuple[Linearised, ...]:
    still = jax.tree.map(lambda leaf: jnp.zeros_like(leaf[0]), unknowns.view)
    pictures = tuple(
        linearise_each(
            views(unknowns, problem, group),
            completion(unknowns, group, heights),
            problem.settings,
            problem.mesh,
            group.targets.shape[-1],
            still,
            problem.by_angle,
        )
        for group in problem.groups
    )
    return on_every_device(pictures, problem.mesh)


def views(unknowns: Unknowns, problem: Problem, group: Group) -> Scene:
    """`group.scenes` under the lights and from the cameras that are sought."""
    given, found = (group.scenes.lights, group.scenes.camera), []
    if not jax.tree.leaves(unknowns.view):
        return group.scenes
    for n, k in enumerate(group.indices):
        lights, camera = jax.tree.map(lambda leaf, n=n: leaf[n], given)
        by = jax.tree.map(lambda values, unit, k=k: values[k] * unit, unknowns.view, problem.view_unit)
        found.append(moved(lights, camera, by))
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *found)
    return eqx.tree_at(lambda scenes: (scenes.lights, scenes.camera), group.scenes, stacked)


def completion(unknowns: Unknowns, group: Group, heights: Float[Array, "ny nx"]) -> Callable[[Scene], Scene]:
    """Makes the scene of one picture from its own leaves, those that the group shares, these heights and the unknowns."""

    def complete(scene: Scene) -> Scene:
        scene = group.complete(scene, heights)
        return scene if unknowns.albedo is None else _with_albedo(scene, unknowns.albedo)

    return complete


def _simulate(
    unknowns: Unknowns, problem: Problem, heights: Float[Array, "ny nx"], group: Group, linear: Linearised | None
) -> Float[Array, "n h w c"]:
    n, change, scenes = len(group.indices), completion(unknowns, group, heights), views(unknowns, problem, group)
    if linear is not None:
        image = picture_each(linear, scenes, change, problem.settings, problem.mesh, problem.by_angle)
    else:
        image = render_each(scenes, change, problem.settings, problem.mesh)
        if group.targets.shape[-1] == 1:
            image = jnp.mean(image, axis=-1, keepdims=True)
    if unknowns.exposures is not None:
        image = image * jnp.stack([unknowns.exposures[k] for k in group.indices]).reshape(n, 1, 1, 1)
    if unknowns.offsets is not None:
        image = image + jnp.stack([unknowns.offsets[k] for k in group.indices]).reshape(n, 1, 1, 1)
    return image


def _with_albedo(scene: Scene, factor: Float[Array, "ty tx c"]) -> Scene:
    """The scene with the albedo of its first heightfield multiplied."""
    k = next(k for k, obj in enumerate(scene.objects) if obj.shape is scene.heightfields[0])
    material = scene.objects[k].material
    assert isinstance(material, Matte)
    old = material.albedo
    texture = old if isinstance(old, ImageTexture) else ImageTexture(jnp.asarray(old).reshape(1, 1, 3))
    shape = (*(max(pair) for pair in zip(texture.texels.shape[:2], factor.shape[:2], strict=True)), 3)
    new = jnp.broadcast_to(texture.texels, shape) * jnp.broadcast_to(factor, shape)
    albedo = new.reshape(3) if shape[:2] == (1, 1) and texture is not old else dataclasses.replace(texture, texels=new)
    return eqx.tree_at(lambda scene: scene.objects[k].material, scene, Matte(albedo))


def prior_residuals(unknowns: Unknowns, problem: Problem) -> list[Array]:
    """Residuals of what is known without the pictures: of the lights and cameras that are sought, of the prior heights, and of
    the smoothness of heights and albedo."""
    surface = problem.basis.surface(unknowns.coefficients)
    parts: list[Array] = jax.tree.leaves(jax.tree.map(lambda x, weight: x * weight[None], unknowns.view, problem.view_weight))
    if problem.prior is not None:
        off = problem.prior.weight * (surface - problem.prior.heights)
        stiffness = problem.prior.stiffness
        parts.append(off if stiffness is None else stiffness * problem.basis.transform(off))
    if problem.smoothness is not None:
        parts.append(problem.smoothness * laplacian(problem.basis.crop(surface)))
    if problem.albedo_smoothness is not None and unknowns.albedo is not None:
        parts += [problem.albedo_smoothness * laplacian(unknowns.albedo[..., c]) for c in range(unknowns.albedo.shape[-1])]
    return parts


def laplacian(values: Float[Array, "ny nx"]) -> Float[Array, "ny nx"]:
    """The sum of the differences to the neighbours that a vertex has."""
    padded = jnp.pad(values, 1, mode="edge")
    return padded[2:, 1:-1] + padded[:-2, 1:-1] + padded[1:-1, 2:] + padded[1:-1, :-2] - 4 * values


def pictures_and_influence(
    unknowns: Unknowns, problem: Problem, key: int = 0
) -> tuple[list[Float[Array, "n h w c"]], Float[Array, "ny nx"]]:
    """The pictures, and the derivative in each height of a sum of their residuals with random normal factors, shape (ny, nx).

    That derivative is exactly zero for a height on which no picture depends, as its column of the Jacobian J is zero; for
    another height it is zero with probability zero. Its covariance over the factors is JᵀJ.

    Args:
      unknowns: of the fit.
      problem: `linearised` at these unknowns, or it is here.
      key: of the random factors.
    """
    problem = linearised(unknowns, problem)
    return _pictures_and_influence(*on_every_device((unknowns, problem, jax.random.key(key)), problem.mesh))


@eqx.filter_jit
def _pictures_and_influence(
    unknowns: Unknowns, problem: Problem, key: PRNGKeyArray
) -> tuple[list[Float[Array, "n h w c"]], Float[Array, "ny nx"]]:
    def pictures(heights: Float[Array, "ny nx"]) -> tuple[list[Array], list[Array]]:
        images = simulate(unknowns, problem, heights)
        return [group.weights * image for group, image in zip(problem.groups, images, strict=True)], images

    parts, vjp, images = jax.vjp(pictures, problem.basis.heights(unknowns.coefficients), has_aux=True)
    keys = jax.random.split(key, len(parts))
    draws = [jax.random.normal(key, part.shape, part.dtype) for key, part in zip(keys, parts, strict=True)]
    return images, vjp(draws)[0]


def found_scenes(scenes: Sequence[Scene], unknowns: Unknowns, problem: Problem) -> tuple[Scene, ...]:
    """The scenes as they were given, with all that was found; positions keep double precision."""
    heights, found = heights_of(unknowns, problem.basis), list(scenes)
    for group in problem.groups:
        new, old = ((part.lights, part.camera) for part in (views(unknowns, problem, group), group.scenes))
        change = jax.tree.map(lambda new, old: np.asarray(new) - np.asarray(old), new, old)
        for n, k in enumerate(group.indices):
            scene = scenes[k].with_heights(heights)
            if unknowns.albedo is not None:
                scene = _with_albedo(scene, unknowns.albedo)
            if jax.tree.leaves(unknowns.view):
                given = scene.lights, scene.camera
                lights, camera = jax.tree.map(lambda leaf, more, n=n: np.asarray(leaf) + more[n], given, change)
                scene = scene.with_lights(lights).with_camera(camera)
            found[k] = scene
    return tuple(found)
