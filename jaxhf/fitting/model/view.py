"""A picture's light and camera as unknowns: a direction and a pose, each in a few numbers about what was given."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Float

from ...core.affine import affine
from ...core.types import Vector
from ...core.vector import dot, unit
from ...scene.camera import Camera
from ...scene.light import Directional, Light, Sky
from ...scene.scene import Scene


class View(eqx.Module):
    """What stands for each number of a light's direction and of a camera's pose, and for what all pictures see alike; None for
    what is known.

    Attributes:
      light: two angles by which the first directional light is turned, about axes across it, radians (their tangents).
      camera: by how much the eye is moved, world units, and a rotation vector about it, radians, both along the world's axes.
      sky: by how much the logarithm of the sky's radiance grows.
      material: by how much numbers of the first heightfield's material grow, and their names.
    """

    light: Float[jax.Array, "..."] | None = None
    camera: Float[jax.Array, "..."] | None = None
    sky: Float[jax.Array, "..."] | None = None
    material: Float[jax.Array, "..."] | None = None
    names: tuple[str, ...] = eqx.field(static=True, default=())


KNOWN = View()


def sun(lights: Sequence[Light]) -> Directional | None:
    """The first directional light; None where there is none."""
    return next((light for light in lights if isinstance(light, Directional)), None)


def moved(lights: tuple[Light, ...], camera: Camera, view: View) -> tuple[tuple[Light, ...], Camera]:
    """The light turned, the camera moved and the sky brighter by `view`, leaves (2,), (6,) and (1,); where these are zero, the
    same to the bit."""
    if view.light is not None:
        light = sun(lights)
        assert light is not None
        first, second = _across(light.towards)
        towards = light.towards + view.light[0] * first + view.light[1] * second
        lights = tuple(dataclasses.replace(light, towards=towards) if other is light else other for other in lights)
    if view.sky is not None:
        times = jnp.exp(view.sky[0])
        lights = tuple(_brighter(light, times) if isinstance(light, Sky) else light for light in lights)
    if view.camera is not None:
        world = affine(jnp.asarray(camera.world_from_camera))
        # Cayley's transform, of half the angle's tangent: for the angle itself that has no singular derivative at zero, and
        # a rotation of a degree is a degree to 3e-5 of it.
        q = view.camera[3:] / 2
        factor = 2 / (1 + dot(q, q))
        columns = []
        for k in range(3):
            column = jnp.cross(q, world.linear[:, k])
            columns.append(world.linear[:, k] + factor * (column + jnp.cross(q, column)))
        moved_by = view.camera[:3]
        if camera._ahead is not None:  # the eye is so far behind the place of the matrix
            moved_by = moved_by + camera._ahead * (columns[2] - world.linear[:, 2])
        columns.append(world.offset + moved_by)
        matrix = jnp.asarray(camera.world_from_camera).at[:3].set(jnp.stack(columns, axis=1))
        camera = eqx.tree_at(lambda camera: camera.world_from_camera, camera, matrix)
    return lights, camera


def moved_each(scenes: Scene, view: View) -> Scene:
    """Stacked scenes with their lights and cameras `moved`."""
    if not jax.tree.leaves(view):
        return scenes
    found = lax.map(lambda seen: moved(*seen), (scenes.lights, scenes.camera, view))
    return eqx.tree_at(lambda scenes: (scenes.lights, scenes.camera), scenes, found)


def _brighter(sky: Sky, times: Any) -> Sky:
    return dataclasses.replace(sky, radiance=times * jnp.asarray(sky.radiance))


def with_numbers(material: Any, view: View) -> Any:
    """A material with the numbers that `view` seeks moved by it."""
    changes = () if view.material is None else view.material
    for name, change in zip(view.names, changes, strict=True):
        moved_number = jnp.asarray(getattr(material, name)) + change
        material = eqx.tree_at(lambda material, name=name: getattr(material, name), material, moved_number)
    return material


def differences(scene: Scene, other: Scene) -> tuple[float, float, float]:
    """Between two scenes: the angle of their first directional lights, degrees (nan where there is none); the distance of
    their cameras, world units, and the angle by which these are turned, degrees."""
    first, second, angle = sun(scene.lights), sun(other.lights), np.nan
    if first is not None and second is not None:
        a, b = (np.asarray(light.towards, np.float64) for light in (first, second))
        angle = np.arctan2(np.linalg.norm(np.cross(a, b)), np.dot(a, b))
    a, b = (np.asarray(each.camera.world_from_camera, np.float64) for each in (scene, other))
    turn = b[:3, :3] @ np.linalg.inv(a[:3, :3])
    sine = np.linalg.norm([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    rotation = np.arctan2(sine, np.trace(turn) - 1)
    return float(np.degrees(angle)), float(np.linalg.norm(b[:3, 3] - a[:3, 3])), float(np.degrees(rotation))


def _across(towards: Any) -> tuple[Vector, Vector]:
    """Two vectors across `towards` and each other, of its length."""
    towards = jnp.asarray(towards)
    axis = jnp.where(jnp.abs(towards[0]) < jnp.abs(towards[1]), jnp.array([1, 0, 0]), jnp.array([0, 1, 0]))
    first = unit(jnp.cross(towards, axis.astype(towards.dtype)))
    size = jnp.sqrt(dot(towards, towards))
    return size * first, jnp.cross(towards, first)
