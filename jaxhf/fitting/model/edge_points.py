"""The points on edges of a problem's pictures, drawn before these are linearised: by a program that serves other sizes, too."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float

from ...boundary.points import Points, draw_points, form_of_points, require_edges_followed
from ...preparation.world import resolve_settings
from ...rendering.render import prepared_world
from ...scene.heightfield import Heightfield
from ...scene.scene import Scene, Shape
from ...xla.compilation import compiled
from ...xla.devices import held_everywhere
from .pictures import can_be_linearised
from .problem import Problem, surface_of
from .unknowns import Unknowns, moved


class EdgePoints(eqx.Module):
    """What was drawn for a group's pictures, on the host; leaves have a leading axis of n pictures.

    Attributes:
      points: on edges.
      sky: that of `World`, which takes long to find; None where mountains hide none.
    """

    points: Points
    sky: tuple[Any, ...] | None


EdgePointsEach = tuple[EdgePoints | None, ...]
"""For each group; None where there are no points, or it is not linearised."""


def draw_edge_points(unknowns: Unknowns, problem: Problem, begin: Callable[[], None]) -> EdgePointsEach:
    """Draws for the pictures of each group; `begin` is called once, while a program is compiled for that.

    The scene and the world of each picture are made for this alone: to make them twice is 2 to 5 % of a step.
    """
    begin_once = functools.cache(begin)
    if not any(_has_points(problem, number) for number in range(len(problem.groups))):
        begin_once()
        return (None,) * len(problem.groups)
    surface, edge_samples = surface_of(unknowns, problem.basis), problem.settings.edge_samples or 0

    def of_picture(number: int, k: int) -> EdgePoints:
        scene = _scene_seen(unknowns, problem, surface, number, np.asarray(k, np.int32))
        require_edges_followed((obj.shape for obj in scene.objects), edge_samples)
        # Those for which other programs, too, make a world: how many points there are is data.
        settings = dataclasses.replace(resolve_settings(problem.settings, scene), samples=1, edge_samples=0)
        world = held_everywhere(prepared_world(scene, settings, problem.mesh), problem.mesh)
        still = unknowns.view.camera is None
        points = draw_points(world, scene.camera, problem.mesh, edge_samples, still, begin_once)
        if scene.sky_occlusion is None:
            return EdgePoints(points, None)
        pairs = zip(world.sky, _sky_forms(scene), strict=True)
        return EdgePoints(points, tuple(None if form is None else np.asarray(seen)[: form.shape[0]] for seen, form in pairs))

    def of_group(number: int) -> EdgePoints | None:
        if not _has_points(problem, number):
            return None
        each = [of_picture(number, k) for k in range(len(problem.groups[number].indices))]
        return jax.tree.map(lambda *leaves: np.stack(leaves), *each)

    return tuple(map(of_group, range(len(problem.groups))))


def forms_of_edge_points(problem: Problem) -> EdgePointsEach:
    """`jax.ShapeDtypeStruct`s in place of what `draw_edge_points` returns; no operation of JAX's, as each would be compiled."""

    def of_group(number: int) -> EdgePoints | None:
        if not _has_points(problem, number):
            return None
        scenes = problem.groups[number].scenes
        scene = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape[1:], leaf.dtype), scenes)
        scene = problem.groups[number].complete(scene, problem.field.heights)
        points = form_of_points(problem.settings.edge_samples or 0, problem.settings, problem.field.heights.dtype)
        one = EdgePoints(points, None if scene.sky_occlusion is None else _sky_forms(scene))
        count = len(problem.groups[number].indices)
        return jax.tree.map(lambda form: jax.ShapeDtypeStruct((count, *form.shape), form.dtype), one)

    return tuple(map(of_group, range(len(problem.groups))))


def _has_points(problem: Problem, number: int) -> bool:
    return bool(problem.settings.edge_samples) and can_be_linearised(problem.groups[number].scenes, problem.settings)


def _sky_forms(scene: Scene) -> tuple[Any, ...]:
    """Of what each object leaves to see of the sky, as `jax.ShapeDtypeStruct`s."""

    def form(shape: Shape) -> Any:
        return jax.ShapeDtypeStruct((shape.heights.size, 3), shape.heights.dtype) if isinstance(shape, Heightfield) else None

    return tuple(form(obj.shape) for obj in scene.objects)


@functools.partial(compiled, jit=eqx.filter_jit)
def _scene_seen(unknowns: Unknowns, problem: Problem, surface: Float[Array, "my mx"], number: int, k: Array) -> Scene:
    """What the k-th picture of a group shows; `surface`: the heights with their padding."""
    group = problem.groups[number]
    scene, view = jax.tree.map(lambda leaf: leaf[k], (group.scenes, problem.moves(unknowns, group)))
    scene = group.complete(scene, problem.basis.crop(surface), problem.factors(unknowns), view)
    lights, camera = moved(scene.lights, scene.camera, view)
    return scene.with_lights(lights).with_camera(camera)
