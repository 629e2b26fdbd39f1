"""Linearised pictures: their derivative in the heights as a sparse matrix, for the many products of a fit.

The radiance of a sample depends on the heights and normals at the three vertices of one triangle (and on which triangle
that is, which has no derivative). So its row of the matrix is a dozen numbers, taken once by reverse differentiation. A
product then is three lookups for each sample, where JAX's own linearised picture reads every intermediate value of its
shading again. A sample of a moving boundary depends on five heights at most.
"""

import dataclasses
import functools
import math
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.sharding import Mesh
from jaxtyping import Bool, Float, Int

from ..boundary.guiding import has_edges
from ..boundary.sample import BoundarySample, deciding_vertices, picture_point
from ..boundary.term import Packed, draw_boundaries
from ..core.autodiff import with_tangent
from ..core.settings import Settings
from ..core.types import Flag
from ..preparation.world import World, make_world
from ..rendering.samples import PictureSamples
from ..scene.camera import Camera
from ..scene.light import Sun
from ..scene.scene import Scene
from ..shade.radiance import direct, has_mirrors
from ..trace.grid import Grid
from ..trace.hit import Hit
from ..trace.triangle import Corners, triangle_vertices
from ..xla.devices import map_over, on_every_device
from ..xla.kernel import one_kernel
from ..xla.materialise import materialise
from .view import KNOWN, View, motion, moved

# Chunks of samples that one lookup serves: in pieces of 64 a product took half as long again.
_TOGETHER = 1024
# Points on edges for each pixel that is resampled: about as many as a pixel on a boundary has.
_POINTS_PER_PIXEL = 4
_SAMPLING_ERROR = 0.25


class Linearised(eqx.Module):
    """A picture, and its derivative in the heights and normals at the vertices of its scene.

    Attributes:
      image: shape (h, w, c). Pixels that are resampled have the mean of those samples: where a boundary crosses a pixel, few
        samples make a staircase, on which no step along the derivative leads down.
      depends: whether any of a pixel's samples changes with the heights, shape (h, w).
      sampling: standard deviation of a pixel's error from its having so few samples, radiance, shape (h, w).
      slopes: derivatives of each sample, (chunks, c, 3 or 12, samples): in the three heights, then, vertex by vertex, in the
        normals.
      vertices: the numbers of those three vertices over all grids, (chunks, 3, samples).
      edges: of samples of moving boundaries; None where the settings ask for none.
      view: derivatives of each sample in the numbers of the light and of the camera that are sought, see `moved`,
        (chunks, c, 2 or 6, samples).
    """

    image: Float[jax.Array, "*n h w c"]
    depends: Bool[jax.Array, "*n h w"]
    sampling: Float[jax.Array, "*n h w"]
    slopes: Float[jax.Array, "*n chunks c k samples"]
    vertices: Int[jax.Array, "*n chunks 3 samples"]
    edges: "LinearisedEdges | None"
    view: View = KNOWN


class LinearisedEdges(eqx.Module):
    """The boundary term's part of a linearised picture.

    Attributes:
      slopes: derivatives of the light in five heights, (chunks, c, 5, size).
      vertices: the numbers of their vertices, (chunks, 5, size).
      pixel: which pixel each boundary sample is in; they are numbered row by row.
      kind: 0 where a sample does not count, 1 where its edge is seen where it stands, 2 where its shadow is.
      resampled: the pixels that are resampled, by samples after the picture's.
      view: as that of `Linearised`, (chunks, c, 2 or 6, size).
    """

    slopes: Float[jax.Array, "*n chunks c 5 size"]
    vertices: Int[jax.Array, "*n chunks 5 size"]
    pixel: Int[jax.Array, "*n points"]
    kind: Int[jax.Array, "*n points"]
    resampled: Int[jax.Array, "*n pixels"]
    view: View = KNOWN


def can_be_linearised(scene: Scene, settings: Settings) -> bool:
    """Whether each sample depends on one triangle alone: where no mirror shows another one, and none makes a penumbra.

    How much of a `Sky` with `occlusion` the terrain hides is taken as it is at each step, without its derivative: it changes
    slowly, and points on edges are worth more.
    """
    if any(isinstance(light, Sun) for light in scene.lights):
        return False
    return not has_mirrors((obj.material for obj in scene.objects), settings)


def linearise_each(
    scenes: Scene,
    change: Callable[[Scene], Scene],
    settings: Settings,
    mesh: Mesh,
    channels: int,
    still: View = KNOWN,
    by_angle: Flag | None = None,
) -> Linearised:
    """Pictures of scenes that differ in numbers only, one after the other, and their derivatives in the heights, and in the
    light and the camera that `still` names.

    Args:
      scenes: one `localise`d scene that `can_be_linearised`; its leaves have a leading axis of n scenes.
      change: what is done to each before it is rendered.
      settings: the knobs.
      mesh: the devices that share the work.
      channels: 3, or 1 for their mean.
      still: zeros, (2,) for a light and (6,) for a camera in which the derivative is taken.
      by_angle: see `make_world`.

    Returns:
      Leaves with a leading axis of n pictures.
    """

    def one(scene: Scene) -> Linearised:
        scene = on_every_device(change(scene), mesh)
        return _linearise(make_world(scene, settings, by_angle), scene.camera, mesh, channels, still)

    return lax.map(one, scenes)


def picture_each(
    known: Linearised,
    scenes: Scene,
    change: Callable[[Scene], Scene],
    settings: Settings,
    mesh: Mesh,
    by_angle: Flag | None = None,
) -> Float[jax.Array, "n h w c"]:
    """The pictures that are known, with their derivatives in the heights, light and camera that `change` gives to the scenes.

    Those must be the ones at which `linearise_each` was called.
    """

    def one(pair: tuple[Linearised, Scene]) -> Float[jax.Array, "h w c"]:
        scene = on_every_device(change(pair[1]), mesh)
        return _picture(pair[0], scene, make_world(scene, settings, by_angle), mesh)

    return lax.map(one, (known, scenes))


def _linearise(world: World, camera: Camera, mesh: Mesh, channels: int, still: View) -> Linearised:
    drawn, edge_samples = None, world.settings.edge_samples or 0
    if has_edges(world):
        drawn = draw_boundaries(world, camera, None, mesh, math.ceil(edge_samples / _POINTS_PER_PIXEL))
    samples = PictureSamples(camera, world.settings, None if drawn is None else drawn.resampled)
    sampled = functools.partial(_samples, channels)
    seen = world, camera, still
    light, slopes, vertices, view = map_over(mesh, lambda *args: one_kernel(sampled, *args), seen, samples.positions())
    image, edges = samples.in_pixels(light), None
    sampling = _sampling_error(samples.in_rows(light), math.isqrt(world.settings.samples or 1))
    if drawn is not None:
        followed = functools.partial(_boundary_samples, channels)
        edge_slopes, edge_vertices, edge_view = map_over(mesh, followed, seen, drawn.contributions)
        points, _ = drawn.contributions.unpacked()
        kind = jnp.where(points.valid, jnp.where(points.light < 0, 1, 2), 0).ravel().astype(jnp.int32)
        edges = LinearisedEdges(edge_slopes, edge_vertices, drawn.pixel, kind, drawn.resampled, edge_view)
        finer = samples.of_resampled(light)
        side = math.isqrt(finer.shape[1])
        error = jax.vmap(lambda pixel: _sampling_error(pixel.reshape(side, side, channels), side)[0, 0])(finer)
        image, sampling = (
            known.reshape(-1, channels).at[drawn.resampled].set(new, unique_indices=True).reshape(image.shape)
            for known, new in ((image, finer.mean(1)), (sampling, error))
        )
    moving = (slopes != 0).any(axis=(1, 2)).astype(light.dtype)[..., None]
    depends = samples.in_pixels(moving)[..., 0] > 0
    return Linearised(image, depends, jnp.sqrt(jnp.mean(sampling * sampling, axis=-1)), slopes, vertices, edges, view)


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


def _picture(known: Linearised, scene: Scene, world: World, mesh: Mesh) -> Float[jax.Array, "h w c"]:
    at_vertices = vertex_values(world)
    numbers = motion(scene.lights, scene.camera, known.view)
    of_samples = _product(mesh, at_vertices, known.slopes, known.vertices)
    of_samples = _with_view(of_samples, known.view, numbers)
    samples = PictureSamples(scene.camera, world.settings, None if known.edges is None else known.edges.resampled)
    change = samples.in_pixels(of_samples)
    if known.edges is not None:
        edges, flat = known.edges, change.reshape(-1, change.shape[-1])
        finer = samples.of_resampled(of_samples).mean(1)
        heights = at_vertices[:, 0].at[edges.vertices].get(mode="promise_in_bounds")
        light = jnp.moveaxis(jnp.sum(edges.slopes * heights[:, None], axis=2), 1, -1)
        light = _with_view(light, edges.view, numbers)
        flat = flat.at[edges.resampled].set(finer, unique_indices=True).at[edges.pixel].add(light.reshape(-1, flat.shape[1]))
        change = flat.reshape(change.shape)
    return with_tangent(known.image, change)


def _with_view(change: Float[jax.Array, "chunks n c"], slopes: View, numbers: View) -> Float[jax.Array, "chunks n c"]:
    """What samples change by, with their part from the light and the camera."""
    for slope, values in zip(jax.tree.leaves(slopes), jax.tree.leaves(numbers), strict=True):
        for k in range(values.shape[0]):
            change = change + jnp.moveaxis(slope[:, :, k] * values[k], 1, -1)
    return change


def _channels(light: Float[jax.Array, "*rest 3"], channels: int) -> Float[jax.Array, "*rest c"]:
    return light if channels == 3 else jnp.mean(light, axis=-1, keepdims=True)


def _samples(channels: int, seen: tuple[World, Camera, View], points: tuple[jax.Array, ...]):
    """Radiance at points of the picture, (n, c), and its slopes, vertices and view, see `Linearised`."""
    world, camera, still = seen
    x, y = points
    smooth = world.settings.shading == "smooth"

    def one(x: jax.Array, y: jax.Array, perturbation: jax.Array, view: View) -> tuple[jax.Array, jax.Array]:
        corners = Corners(perturbation[:3], perturbation[3:].reshape(3, 3) if smooth else None)
        surfaces = tuple(
            dataclasses.replace(surface, perturbation=corners) if isinstance(surface, Grid) else surface
            for surface in world.surfaces
        )
        lights, eye = moved(world.lights, camera, view)
        there = dataclasses.replace(world, surfaces=surfaces, lights=lights)
        light, _, hit = direct(there, materialise(eye.ray(x, y)))
        return _channels(light, channels), _vertices(world, hit)

    def shade(perturbations: jax.Array, view: View) -> tuple[jax.Array, jax.Array]:
        return jax.vmap(one, in_axes=(0, 0, 1, 1), out_axes=(0, 1))(x, y, perturbations, view)

    none = jnp.zeros((12 if smooth else 3, x.shape[0]), x.dtype)
    light, pull_back, vertices = jax.vjp(shade, none, _each(still, x.shape[0]), has_aux=True)
    each = jnp.broadcast_to(jnp.eye(channels, dtype=x.dtype)[:, None], (channels, *light.shape))
    if channels == 1:
        slopes, view = jax.tree.map(lambda leaf: leaf[None], pull_back(each[0]))
    else:
        slopes, view = jax.vmap(pull_back)(each)
    return light, slopes, vertices, view


def _each(still: View, count: int) -> View:
    """The same numbers for each of so many samples, which come last."""
    return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf[:, None], (*leaf.shape, count)), still)


def _vertices(world: World, hit: Hit) -> Int[jax.Array, "3"]:
    """The numbers of the vertices of the triangle that was hit, over all grids; any that there are where there is no hit."""
    vertices, cell = jnp.zeros(3, jnp.int32), hit.cell
    for number, grid, first in world.grids:
        here = triangle_vertices(grid.shape[1], cell[0], cell[1], hit.triangle == 1)
        vertices = jnp.where(hit.object == number, first + jnp.stack(here), vertices)
    return vertices


def _boundary_samples(channels: int, seen: tuple[World, Camera, View], drawn: Packed[tuple[BoundarySample, jax.Array]]):
    """Slopes, vertices and view of boundary samples, see `LinearisedEdges`."""
    world, camera, still = seen
    samples, flows = drawn.unpacked()
    flows = jnp.moveaxis(_channels(jnp.moveaxis(flows, 1, -1), channels), -1, 0)

    def position(sample: BoundarySample, perturbation: jax.Array, view: View) -> jax.Array:
        lights, eye = moved(world.lights, camera, view)
        there = dataclasses.replace(world, lights=lights)
        return picture_point(there, eye, sample, sample.s, perturbation=perturbation)[0]

    def positions(perturbations: jax.Array, view: View) -> jax.Array:
        return jax.vmap(position, in_axes=(0, 1, 1))(samples, perturbations, view)

    count = flows.shape[1]
    _, pull_back = jax.vjp(positions, jnp.zeros((5, count), flows.dtype), _each(still, count))
    slopes, view = jax.vmap(pull_back)(flows)
    return slopes, jax.vmap(functools.partial(deciding_vertices, world), out_axes=1)(samples), view


def vertex_values(world: World) -> Float[jax.Array, "vertices n"]:
    """Heights and, with smooth shading, the normals' components, over all surfaces."""
    grids = [grid for _, grid, _ in world.grids]
    heights = jnp.concatenate([grid.rows for grid in grids])[:, None]
    normals = [grid.normals for grid in grids if grid.normals is not None]
    return jnp.concatenate([heights, jnp.concatenate(normals)], axis=1) if normals else heights


def _product(
    mesh: Mesh,
    at_vertices: Float[jax.Array, "vertices n"],
    slopes: Float[jax.Array, "chunks c k samples"],
    vertices: Int[jax.Array, "chunks 3 samples"],
) -> Float[jax.Array, "chunks samples c"]:
    """The matrix of all samples times what stands at the vertices."""
    chunks, channels, _, size = slopes.shape
    parts = mesh.devices.size * math.ceil(chunks / (mesh.devices.size * _TOGETHER))

    def in_parts(values: jax.Array) -> jax.Array:
        values = jnp.pad(values, ((0, -chunks % parts), *((0, 0) for _ in values.shape[1:])))
        values = jnp.moveaxis(values.reshape(parts, -1, *values.shape[1:]), 1, -2)
        return values.reshape(*values.shape[:-2], -1)

    def part(at_vertices: jax.Array, rows: tuple[jax.Array, jax.Array]) -> jax.Array:
        slopes, vertices = rows
        total = jnp.zeros((channels, slopes.shape[-1]), slopes.dtype)
        # Looked up a row of four at a time and used number by number: 262144 samples took 0.8 ms, and 2.9 ms transposed. A
        # number at a time it was 1.1 and 10 ms, with sums over the rows 11 and 3.9 ms.
        for vertex in range(3):
            row = at_vertices.at[vertices[vertex]].get(mode="promise_in_bounds")
            for number in range(row.shape[1]):
                slope = slopes[:, vertex if number == 0 else 3 * vertex + number + 2]
                total = total + slope * row[:, number][None]
        return total

    moved = map_over(mesh, part, at_vertices, (in_parts(slopes), in_parts(vertices)))
    moved = jnp.moveaxis(moved.reshape(parts, channels, -1, size), 1, -1)
    return moved.reshape(-1, size, channels)[:chunks]
