"""Linearised pictures: their derivative in the heights as a sparse matrix, for the many products of a fit.

The radiance of a sample depends on the heights and normals at the three vertices of one triangle (and on which triangle
that is, which has no derivative). So its row of the matrix is a dozen numbers, taken once by reverse differentiation. A
product then is three lookups for each sample, where JAX's own linearised picture reads every intermediate value of its
shading again. A sample of a moving boundary depends on five heights at most, and on the albedo at four texels.
"""

import dataclasses
import functools
import math
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.sharding import Mesh
from jaxtyping import Bool, Float, Int

from ...boundary.points import Packed, Points
from ...boundary.sample import BoundarySample, deciding_vertices, picture_point
from ...boundary.term import choose_resampled
from ...core.settings import Settings
from ...core.types import AnyArray
from ...preparation.world import VisibleSky, World, make_world
from ...rendering.samples import PictureSamples
from ...scene.camera import Camera
from ...scene.light import Light
from ...scene.material import Material, Mirror
from ...scene.scene import Scene
from ...scene.texture import ImageTexture
from ...shade.radiance import direct
from ...trace.hit import Hit
from ...trace.triangle import Corners, triangle_vertices
from ...xla.devices import Spread, map_and_spread, map_over, on_every_device
from ...xla.kernel import one_kernel
from ...xla.materialise import materialise
from .edge_points import EdgePoints
from .pictures import Group, albedo_of
from .problem import Problem
from .unknowns import KNOWN, Unknowns, View, moved, with_numbers

# Points on edges for each pixel that is resampled: about as many as a pixel on a boundary has.
_POINTS_PER_PIXEL = 4
_SAMPLING_ERROR = 0.25


class Linearised(eqx.Module):
    """A picture, and its derivative in the heights and normals at the vertices of its first heightfield.

    These are numbered row by row; the number beyond the last one stands for those of other surfaces, whose slopes are 0.

    Attributes:
      image: shape (h, w, c). Pixels that are resampled have the mean of those samples: where a boundary crosses a pixel, few
        samples make a staircase, on which no step along the derivative leads down.
      depends: whether any of a pixel's samples changes with the heights of the first heightfield, shape (h, w).
      sampling: standard deviation of a pixel's error from its having so few samples, radiance, shape (h, w).
      samples: a `SampleRows`, of which each device has a part.
      edges: of samples of moving boundaries; None where the settings ask for none.
    """

    image: Float[AnyArray, "*n h w c"]
    depends: Bool[AnyArray, "*n h w"]
    sampling: Float[AnyArray, "*n h w"]
    samples: Spread
    edges: "LinearisedEdges | None"


class SampleRows(NamedTuple):
    """The derivatives of the samples of a picture, chunk by chunk; the last chunk may be there several times.

    Attributes:
      slopes: k = 3 or 12 of each sample: in the heights of three vertices, then, vertex by vertex, in the normals.
      vertices: the numbers of those vertices.
      view: in the numbers of the light and of the camera that are sought, see `moved`, (chunks, c, 2 or 6, samples).
      albedo: in the factors of the albedo that are sought; None where it is known.
    """

    slopes: Float[jax.Array, "*n chunks c k samples"]
    vertices: Int[jax.Array, "*n chunks 3 samples"]
    view: View
    albedo: "AlbedoRows | None"


class AlbedoRows(NamedTuple):
    """Derivatives of each sample in the relative changes of an albedo's factors at four texels, channel by channel of these or,
    where the picture's share them, of the picture; and the texels' numbers, row by row."""

    slopes: Float[jax.Array, "*n chunks k 4 samples"]
    texels: Int[jax.Array, "*n chunks 4 samples"]


class LinearisedEdges(eqx.Module):
    """The boundary term's part of a linearised picture.

    Attributes:
      slopes, vertices: derivatives of the light in five heights, and the numbers of their vertices.
      pixel: which pixel each boundary sample is in; they are numbered row by row.
      kind: 0 where a sample does not count, 1 where its edge is seen where it stands, 2 where its shadow is.
      resampled: the pixels that are resampled, by samples after the picture's.
      view: as that of `SampleRows`, (chunks, c, 2 or 6, size).
    """

    slopes: Float[jax.Array, "*n chunks c 5 size"]
    vertices: Int[jax.Array, "*n chunks 5 size"]
    pixel: Int[jax.Array, "*n points"]
    kind: Int[jax.Array, "*n points"]
    resampled: Int[jax.Array, "*n pixels"]
    view: View = KNOWN


def changing_pixels(known: Linearised) -> Bool[np.ndarray, "n h w"]:
    """Which pixels of pictures change with the heights; of one in which no shading does, those that a boundary crosses."""
    found = np.array(known.depends)
    if known.edges is not None:
        for picture, pixel, kind in zip(found, np.asarray(known.edges.pixel), np.asarray(known.edges.kind), strict=True):
            if not picture.any():
                picture.ravel()[pixel[kind > 0]] = True
    return found


def linearise_each(group: Group, unknowns: Unknowns, problem: Problem, drawn: EdgePoints | None) -> Linearised:
    """The pictures of a group whose scenes `can_be_linearised`, one after the other, and their derivatives in the heights and
    in what else is sought; leaves have a leading axis of n pictures. `drawn`: see `draw_edge_points`."""
    heights, factors = problem.basis.heights(unknowns.coefficients), problem.factors(unknowns)

    def one(seen: tuple[Scene, View, EdgePoints | None]) -> Linearised:
        scene, view, drawn = on_every_device((group.complete(seen[0], heights, factors), *seen[1:]), problem.mesh)
        about = _Seen.of(scene, view, problem.settings, None if drawn is None else drawn.sky)
        points = None if drawn is None else drawn.points
        return _linearise(about, points, problem.mesh, group.targets.shape[-1], factors)

    return lax.map(one, (group.scenes, problem.moves(unknowns, group), drawn))


class _Seen(NamedTuple):
    """What a picture shows, under the light, from the camera and of the material as they are moved; these as they were given,
    and by what."""

    world: World
    camera: Camera
    given: tuple[tuple[Light, ...], Camera, Material | Mirror]
    view: View

    @classmethod
    def of(cls, scene: Scene, view: View, settings: Settings, sky: VisibleSky | None) -> "_Seen":
        lights, camera = moved(scene.lights, scene.camera, view)
        world = make_world(scene.with_lights(lights), settings, sky=sky)
        material = scene.objects[scene.first_heightfield].material
        return cls(_with_material(world, material, view), camera, (scene.lights, scene.camera, material), view)

    def moved(self, view: View) -> tuple[World, Camera]:
        """The world and its camera with other such numbers."""
        lights, camera, material = self.given
        lights, camera = moved(lights, camera, view)
        return _with_material(dataclasses.replace(self.world, lights=lights), material, view), camera

    def view_for(self, count: int) -> View:
        """The same numbers for each of so many samples, which come last."""
        return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf[:, None], (*leaf.shape, count)), self.view)


def _with_material(world: World, material: Material | Mirror, view: View) -> World:
    """The world with the first heightfield's material, its numbers moved."""
    number, *_ = world.grids[0]
    materials = (with_numbers(material, view) if k == number else other for k, other in enumerate(world.materials))
    return dataclasses.replace(world, materials=tuple(materials)) if view.names else world


def _linearise(
    seen: _Seen, points: Points | None, mesh: Mesh, channels: int, factors: Float[jax.Array, "ty tx k"] | None
) -> Linearised:
    world, camera, drawn = seen.world, seen.camera, None
    if points is not None:
        resampled = math.ceil((world.settings.edge_samples or 0) / _POINTS_PER_PIXEL)
        drawn = choose_resampled(points, camera, world.settings, resampled)
    samples = PictureSamples(camera, world.settings, None if drawn is None else drawn.resampled)
    sampled = functools.partial(_samples, channels, None if factors is None else factors.shape)
    (light, moving), rows = map_and_spread(mesh, lambda *args: one_kernel(sampled, *args), seen, samples.positions())
    image, edges = samples.in_pixels(light), None
    sampling = _sampling_error(samples.in_rows(light), math.isqrt(world.settings.samples or 1))
    if drawn is not None:
        followed = functools.partial(_boundary_samples, channels)
        edge_slopes, edge_vertices, edge_view = map_over(mesh, followed, seen, drawn.contributions)
        found, _ = drawn.contributions.unpacked()
        kind = jnp.where(found.valid, jnp.where(found.light < 0, 1, 2), 0).ravel().astype(jnp.int32)
        edges = LinearisedEdges(edge_slopes, edge_vertices, drawn.pixel, kind, drawn.resampled, edge_view)
        finer = samples.of_resampled(light)
        side = math.isqrt(finer.shape[1])
        error = jax.vmap(lambda pixel: _sampling_error(pixel.reshape(side, side, channels), side)[0, 0])(finer)
        image, sampling = (
            known.reshape(-1, channels).at[drawn.resampled].set(new, unique_indices=True).reshape(image.shape)
            for known, new in ((image, finer.mean(1)), (sampling, error))
        )
    depends = samples.in_pixels(moving)[..., 0] > 0
    sampling = jnp.sqrt(jnp.mean(sampling * sampling, axis=-1))
    return Linearised(image, depends, sampling, Spread(rows), edges)


def _sampling_error(samples: Float[jax.Array, "rows columns c"], side: int) -> Float[jax.Array, "h w c"]:
    """The standard deviation of the means over squares of side x side samples, of rows and columns of regular samples.

    It is 0.25 / side times the root mean square of the second differences in such a square. Where the picture is smooth these
    follow its curvature, on which the error depends (midpoint rule), not its slope; where a boundary crosses, it falls as
    n^(-3/4), n = side² (Mitchell, Consequences of stratified sampling in graphics, SIGGRAPH 1996). The factor was measured on
    pictures of 1024 samples, see docs/measurements/fits.md.
    """
    if side == 1:
        return jnp.zeros_like(samples)
    along_x, along_y = (_second_differences(rows, side) for rows in (samples, samples.swapaxes(0, 1)))
    squares = along_x * along_x + (along_y * along_y).swapaxes(0, 1)
    h, w = (n // side for n in squares.shape[:2])
    return _SAMPLING_ERROR / side * jnp.sqrt(squares.reshape(h, side, w, side, -1).mean((1, 3)))


def _second_differences(samples: Float[jax.Array, "rows columns c"], side: int) -> Float[jax.Array, "rows columns c"]:
    """Sizes of second differences along the rows; the first and last of a square as large as its neighbour's there at most.

    So a boundary between two squares counts for neither.
    """
    padded = jnp.pad(samples, ((0, 0), (1, 1), (0, 0)), mode="edge")
    size = jnp.abs(padded[:, 2:] + padded[:, :-2] - 2 * samples).reshape(samples.shape[0], -1, side, samples.shape[2])
    first, last = (jnp.minimum(size[:, :, a], size[:, :, b])[:, :, None] for a, b in ((0, 1), (-1, -2)))
    return jnp.concatenate([first, size[:, :, 1:-1], last], axis=2).reshape(samples.shape)


def _channels(light: Float[jax.Array, "*rest 3"], channels: int) -> Float[jax.Array, "*rest c"]:
    return light if channels == 3 else jnp.mean(light, axis=-1, keepdims=True)


def _samples(channels: int, factors: tuple[int, ...] | None, seen: _Seen, points: tuple[jax.Array, ...]):
    """Radiance at points of the picture, (n, c), whether it changes with the sought heights, (n, 1), and its `SampleRows`;
    `factors` is the shape of those that are sought."""
    (x, y), world = points, seen.world
    (number, sought, _), smooth = world.grids[0], world.settings.shading == "smooth"

    def one(x: jax.Array, y: jax.Array, perturbation: jax.Array, view: View) -> tuple[jax.Array, Any]:
        corners = Corners(perturbation[:3], perturbation[3:].reshape(3, 3) if smooth else None)
        surfaces = list(world.surfaces)
        surfaces[number] = dataclasses.replace(sought, perturbation=corners)
        there, eye = seen.moved(view)
        light, _, hit = direct(dataclasses.replace(there, surfaces=tuple(surfaces)), materialise(eye.ray(x, y)))
        albedo = None if factors is None else _texels(world, hit, lax.stop_gradient(light), channels, factors)
        return _channels(light, channels), (_vertices(world, hit), albedo)

    def shade(perturbations: jax.Array, view: View) -> tuple[jax.Array, Any]:
        return jax.vmap(one, in_axes=(0, 0, 1, 1), out_axes=(0, -1))(x, y, perturbations, view)

    none = jnp.zeros((12 if smooth else 3, x.shape[0]), x.dtype)
    light, pull_back, (vertices, albedo) = jax.vjp(shade, none, seen.view_for(x.shape[0]), has_aux=True)
    each = jnp.broadcast_to(jnp.eye(channels, dtype=x.dtype)[:, None], (channels, *light.shape))
    if channels == 1:
        slopes, view = jax.tree.map(lambda leaf: leaf[None], pull_back(each[0]))
    else:
        slopes, view = jax.vmap(pull_back)(each)
    moving = (slopes != 0).any(axis=(0, 1))
    return (light, moving.astype(light.dtype)[:, None]), SampleRows(slopes, vertices, view, albedo)


def _texels(world: World, hit: Hit, light: jax.Array, channels: int, factors: tuple[int, ...]) -> AlbedoRows:
    """How the light from a hit goes with the factors of the first heightfield's albedo."""
    number = world.grids[0][0]
    places, shares = jnp.zeros(4, jnp.int32), jnp.zeros((3, 4), light.dtype).at[:, 0].set(1)
    if isinstance(texture := albedo_of(world.materials[number]), ImageTexture):
        rows, columns, weights = texture.corners(hit.uv)
        parts = weights[None] * jnp.asarray(texture.texels)[rows, columns].T
        total = jnp.sum(parts, axis=1, keepdims=True)
        shares = jnp.where(total == 0, 0, parts / jnp.where(total == 0, 1, total))
        if factors[:2] != (1, 1):
            places = rows * factors[1] + columns
    slopes = jnp.where(hit.object == number, light, 0)[:, None] * shares
    if channels == 1:
        slopes = slopes / 3 if factors[2] == 3 else jnp.mean(slopes, axis=0, keepdims=True)
    return AlbedoRows(slopes, places)


def _vertices(world: World, hit: Hit) -> Int[jax.Array, "3"]:
    """The numbers of the vertices of the triangle that was hit; one too large where that is not of the first heightfield."""
    number, grid, _ = world.grids[0]
    here = triangle_vertices(grid.nx, hit.cell[0], hit.cell[1], hit.triangle == 1)
    return jnp.where(hit.object == number, jnp.stack(here), grid.rows.shape[0])


def _boundary_samples(channels: int, seen: _Seen, drawn: Packed[tuple[BoundarySample, jax.Array]]):
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
    beyond = seen.world.grids[0][1].rows.shape[0]
    return jnp.where(vertices < beyond, slopes, 0), jnp.minimum(vertices, beyond), view
