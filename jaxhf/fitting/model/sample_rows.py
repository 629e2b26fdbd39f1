"""The rows of a linearised picture's matrix, traced by programs for terrains and pictures of any size."""

import dataclasses
import functools
from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.sharding import Mesh
from jaxtyping import Float, Int

from ...boundary.points import Packed
from ...boundary.sample import BoundarySample, deciding_vertices, picture_point
from ...core.types import AnyArray, Index
from ...preparation.any_size import of_any_terrain
from ...preparation.world import World
from ...scene.camera import Camera, of_any_size
from ...scene.light import Light
from ...scene.texture import FlatTexture, ImageTexture
from ...shade.radiance import direct
from ...trace.hit import Hit
from ...trace.triangle import Corners, triangle_vertices
from ...xla.compilation import compiled
from ...xla.devices import map_first
from ...xla.kernel import one_kernel
from ...xla.materialise import materialise
from ...xla.parts import by_item, in_parts
from .pictures import albedo_of
from .unknowns import View, moved, with_numbers

_SAMPLES = 2**16
"""That a program traces at once: with fewer devices wait more often, with more it clears memory for longer."""


class SampleRows(NamedTuple):
    """The derivatives of the samples of a picture, chunk by chunk; the last chunk may be there several times.

    Attributes:
      slopes: k = 3 or 12 of each sample: in the heights of three vertices, then, vertex by vertex, in the normals.
      vertices: the numbers of those vertices.
      view: in the numbers of the light and of the camera that are sought, see `moved`, (chunks, c, 2 or 6, samples).
      albedo: in the factors of the albedo that are sought; None where it is known.
    """

    slopes: Float[AnyArray, "*n chunks c k samples"]
    vertices: Int[AnyArray, "*n chunks 3 samples"]
    view: View
    albedo: "AlbedoRows | None"


class AlbedoRows(NamedTuple):
    """Derivatives of each sample in the relative changes of an albedo's factors at four texels, channel by channel of these or,
    where the picture's share them, of the picture; and the texels' numbers, row by row."""

    slopes: Float[AnyArray, "*n chunks k 4 samples"]
    texels: Int[AnyArray, "*n chunks 4 samples"]


class Kind(NamedTuple):
    """What a row has, beside its heights.

    Attributes:
      channels: of the picture.
      factors: whether each texel of the albedo has factors of its own, and in how many channels; None where it is known.
    """

    channels: int
    factors: tuple[bool, int] | None


class Seen(NamedTuple):
    """What a picture shows, under the light, from the camera and of the material as they are moved; the lights, the camera and
    those numbers of the first heightfield's material as they were given; and by what they are moved."""

    world: World
    camera: Camera
    given: tuple[tuple[Light, ...], Camera, tuple[Any, ...]]
    view: View

    def of_any_size(self) -> "Seen":
        lights, camera, numbers = self.given
        given = lights, of_any_size(camera), numbers
        return Seen(of_any_terrain(self.world), of_any_size(self.camera), given, self.view)

    def moved(self, view: View) -> tuple[World, Camera]:
        """The world and its camera with other such numbers."""
        lights, camera, numbers = self.given
        lights, camera = moved(lights, camera, view)
        number, *_ = self.world.grids[0]
        materials = list(self.world.materials)
        materials[number] = with_numbers(materials[number], view, numbers)
        return dataclasses.replace(self.world, lights=lights, materials=tuple(materials)), camera

    def view_for(self, count: int) -> View:
        """The same numbers for each of so many samples, which come last."""
        return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf[:, None], (*leaf.shape, count)), self.view)


Positions = tuple[Float[AnyArray, "chunks n"], Float[AnyArray, "chunks n"]]


def rows_of_samples(seen: Seen, positions: Positions, kind: Kind, mesh: Mesh) -> Iterator[tuple[slice, Any]]:
    """Radiance of each chunk of samples at these places in the picture, (n, c), whether it changes with the sought heights,
    (n, 1), and its `SampleRows`: which chunks, and theirs, of NumPy. Vertices may be too large numbers where slopes are 0."""
    most = _most(positions[0].shape[1], mesh)

    def traced(positions: Positions, count: np.int32) -> Any:
        return _rows_of_samples(seen, positions, count, mesh, kind)

    for first, end, part in in_parts(traced, positions, most, most):
        yield from by_item(part, first, end, mesh.devices.size)


def rows_of_points(
    seen: Seen, drawn: Packed[tuple[BoundarySample, jax.Array]], chunks: int, channels: int, mesh: Mesh
) -> Iterator[tuple[slice, Any]]:
    """Slopes, vertices and view of the first `chunks` chunks of boundary samples, see `LinearisedEdges`: which chunks, and
    theirs, of NumPy. Vertices may be too large numbers where slopes are 0."""
    return by_item(_rows_of_points(seen, drawn, np.int32(chunks), mesh, channels), 0, chunks, mesh.devices.size)


def compile_rows_ahead(
    seen: Seen, size: int, kind: Kind, drawn: Packed[tuple[BoundarySample, jax.Array]] | None, mesh: Mesh
) -> None:
    """The programs of `rows_of_samples`, of chunks of this size, and of `rows_of_points`, whose samples may be
    `jax.ShapeDtypeStruct`s; None: there are none."""
    positions, count = 2 * (np.zeros((_most(size, mesh), size), seen.camera.world_from_camera.dtype),), np.int32(0)
    _rows_of_samples.compile_ahead(seen, positions, count, mesh, kind)
    if drawn is not None:
        _rows_of_points.compile_ahead(seen, drawn, count, mesh, kind.channels)


def _most(size: int, mesh: Mesh) -> int:
    """Chunks of so many samples that a program traces at once."""
    return max(mesh.devices.size, _SAMPLES // size)


@functools.partial(compiled, static_argnames=("mesh", "kind"))
def _rows_of_samples(seen: Seen, positions: Positions, count: Index, mesh: Mesh, kind: Kind) -> Any:
    sampled = functools.partial(_samples, kind)
    return map_first(mesh, lambda *args: one_kernel(sampled, *args), seen, positions, count)


@functools.partial(compiled, static_argnames=("mesh", "channels"))
def _rows_of_points(
    seen: Seen, drawn: Packed[tuple[BoundarySample, jax.Array]], count: Index, mesh: Mesh, channels: int
) -> Any:
    return map_first(mesh, functools.partial(_boundary_samples, channels), seen, drawn, count)


def _channels(light: Float[jax.Array, "*rest 3"], channels: int) -> Float[jax.Array, "*rest c"]:
    return light if channels == 3 else jnp.mean(light, axis=-1, keepdims=True)


def _samples(kind: Kind, seen: Seen, points: tuple[jax.Array, ...]):
    """Radiance at points of the picture, (n, c), whether it changes with the sought heights, (n, 1), and its `SampleRows`."""
    (x, y), world = points, seen.world
    (number, sought, _), smooth = world.grids[0], world.settings.shading == "smooth"

    def one(x: jax.Array, y: jax.Array, perturbation: jax.Array, view: View) -> tuple[jax.Array, Any]:
        corners = Corners(perturbation[:3], perturbation[3:].reshape(3, 3) if smooth else None)
        surfaces = list(world.surfaces)
        surfaces[number] = dataclasses.replace(sought, perturbation=corners)
        there, eye = seen.moved(view)
        light, _, hit = direct(dataclasses.replace(there, surfaces=tuple(surfaces)), materialise(eye.ray(x, y)))
        albedo = None if kind.factors is None else _texels(world, hit, lax.stop_gradient(light), kind)
        return _channels(light, kind.channels), (_vertices(world, hit), albedo)

    def shade(perturbations: jax.Array, view: View) -> tuple[jax.Array, Any]:
        return jax.vmap(one, in_axes=(0, 0, 1, 1), out_axes=(0, -1))(x, y, perturbations, view)

    none = jnp.zeros((12 if smooth else 3, x.shape[0]), x.dtype)
    light, pull_back, (vertices, albedo) = jax.vjp(shade, none, seen.view_for(x.shape[0]), has_aux=True)
    each = jnp.broadcast_to(jnp.eye(kind.channels, dtype=x.dtype)[:, None], (kind.channels, *light.shape))
    if kind.channels == 1:
        slopes, view = jax.tree.map(lambda leaf: leaf[None], pull_back(each[0]))
    else:
        slopes, view = jax.vmap(pull_back)(each)
    moving = (slopes != 0).any(axis=(0, 1))
    return (light, moving.astype(light.dtype)[:, None]), SampleRows(slopes, vertices, view, albedo)


def _texels(world: World, hit: Hit, light: jax.Array, kind: Kind) -> AlbedoRows:
    """How the light from a hit goes with the factors of the first heightfield's albedo."""
    number, (of_each_texel, channels) = world.grids[0][0], kind.factors or (False, 3)
    places, shares = jnp.zeros(4, jnp.int32), jnp.zeros((3, 4), light.dtype).at[:, 0].set(1)
    if isinstance(texture := albedo_of(world.materials[number]), ImageTexture | FlatTexture):
        rows, columns, weights = texture.corners(hit.uv)
        parts = weights[None] * texture.at(rows, columns).T
        total = jnp.sum(parts, axis=1, keepdims=True)
        shares = jnp.where(total == 0, 0, parts / jnp.where(total == 0, 1, total))
        if of_each_texel:
            places = rows * texture.columns + columns
    slopes = jnp.where(hit.object == number, light, 0)[:, None] * shares
    if kind.channels == 1:
        slopes = slopes / 3 if channels == 3 else jnp.mean(slopes, axis=0, keepdims=True)
    return AlbedoRows(slopes, places)


def _vertices(world: World, hit: Hit) -> Int[jax.Array, "3"]:
    """The numbers of the vertices of the triangle that was hit; one too large where that is not of the first heightfield."""
    number, grid, _ = world.grids[0]
    here = triangle_vertices(grid.nx, hit.cell[0], hit.cell[1], hit.triangle == 1)
    return jnp.where(hit.object == number, jnp.stack(here), grid.rows.shape[0])


def _boundary_samples(channels: int, seen: Seen, drawn: Packed[tuple[BoundarySample, jax.Array]]):
    """Slopes, vertices and view of boundary samples, see `LinearisedEdges`."""
    samples, flows = drawn.unpacked()
    flows = jnp.moveaxis(_channels(jnp.moveaxis(flows, 1, -1), channels), -1, 0)

    def position(sample: BoundarySample, perturbation: jax.Array, view: View) -> jax.Array:
        return picture_point(*seen.moved(view), sample, sample.s, perturbation=perturbation)[0]

    def positions(perturbations: jax.Array, view: View) -> jax.Array:
        return jax.vmap(position, in_axes=(0, 1, 1))(samples, perturbations, view)

    count = flows.shape[1]
    _, pull_back = jax.vjp(positions, jnp.zeros((5, count), flows.dtype), seen.view_for(count))
    slopes, view = jax.vmap(pull_back)(flows)
    vertices = jax.vmap(functools.partial(deciding_vertices, seen.world), out_axes=1)(samples)
    return jnp.where(vertices < seen.world.grids[0][1].rows.shape[0], slopes, 0), vertices, view
