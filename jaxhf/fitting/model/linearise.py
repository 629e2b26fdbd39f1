"""Linearised pictures: their derivative in the heights as a sparse matrix, for the many products of a fit.

The radiance of a sample depends on the heights and normals at the three vertices of one triangle (and on which triangle
that is, which has no derivative). So its row of the matrix is a dozen numbers, taken once by reverse differentiation. A
product then is three lookups for each sample, where JAX's own linearised picture reads every intermediate value of its
shading again. A sample of a moving boundary depends on five heights at most, and on the albedo at four texels.
"""

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Array, Bool, Float, Int

from ...boundary.points import Points, asked_for, compile_points_ahead, draw_points, require_edges_followed
from ...core.settings import Settings
from ...core.types import AnyArray, room
from ...preparation.world import World, resolve_settings
from ...rendering.render import prepared_world
from ...rendering.samples import PictureSamples
from ...scene.scene import Scene
from ...xla.compilation import compiled
from ...xla.devices import Spread, everywhere, held_everywhere
from .pictures import can_be_linearised, with_material
from .problem import Problem, surface_of
from .sample_rows import AlbedoRows, Kind, SampleRows, Seen, compile_rows_ahead, rows_of_points, rows_of_samples
from .unknowns import KNOWN, Unknowns, View, moved, numbers_of

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


class LinearisedEdges(eqx.Module):
    """The boundary term's part of a linearised picture.

    Attributes:
      slopes, vertices: derivatives of the light in five heights, and the numbers of their vertices.
      pixel: which pixel each boundary sample is in; they are numbered row by row.
      kind: 0 where a sample does not count, 1 where its edge is seen where it stands, 2 where its shadow is.
      resampled: the pixels that are resampled, by samples after the picture's.
      view: as that of `SampleRows`, (chunks, c, 2 or 6, size).
    """

    slopes: Float[AnyArray, "*n chunks c 5 size"]
    vertices: Int[AnyArray, "*n chunks 5 size"]
    pixel: Int[AnyArray, "*n points"]
    kind: Int[AnyArray, "*n points"]
    resampled: Int[AnyArray, "*n pixels"]
    view: View = KNOWN


def changing_pixels(known: Linearised) -> Bool[np.ndarray, "n h w"]:
    """Which pixels of pictures change with the heights; of one in which no shading does, those that a boundary crosses."""
    found = np.array(known.depends)
    if known.edges is not None:
        for picture, pixel, kind in zip(found, np.asarray(known.edges.pixel), np.asarray(known.edges.kind), strict=True):
            if not picture.any():
                picture.ravel()[pixel[kind > 0]] = True
    return found


OnHost = Any
"""A `Linearised`, or a part of one, of NumPy's arrays."""


def _form(unknowns: Unknowns, problem: Problem, number: int) -> Linearised | None:
    """`jax.ShapeDtypeStruct`s in place of the pictures of a group; no operation of JAX's, as each would be compiled."""
    group, dtype = problem.groups[number], problem.field.heights.dtype
    if not can_be_linearised(group.scenes, problem.settings):
        return None
    (n, h, w, c), kind = group.targets.shape, _kind(unknowns, problem, number)
    settings, count = resolve_settings(problem.settings, group.scenes), _resampled(problem.settings, h * w)
    none: Any = np.zeros(count, np.int32) if count else None
    samples = PictureSamples(group.scenes.camera, settings, none)
    size, devices = samples.size, problem.mesh.devices.size
    chunks = math.ceil(samples.chunks / devices) * devices  # each device has as many

    def form(*shape: int, dtype: Any = dtype) -> Any:
        return np.broadcast_to(np.zeros((), dtype), (n, *shape))  # no `ShapeDtypeStruct` yet: annotations ask for arrays

    def view(chunks: int, size: int) -> View:
        return jax.tree.map(lambda leaf: form(chunks, c, leaf.shape[-1], size), unknowns.view)

    albedo, edges = None, None
    if kind.factors is not None:
        k = 3 if 3 in (c, kind.factors[1]) else 1
        albedo = AlbedoRows(form(chunks, k, 4, size), form(chunks, 4, size, dtype=np.int32))
    numbers = 12 if settings.shading == "smooth" else 3
    rows = SampleRows(form(chunks, c, numbers, size), form(chunks, 3, size, dtype=np.int32), view(chunks, size), albedo)
    if count:
        of, draws = asked_for(problem.settings.edge_samples or 0, settings)
        vertices, pixel, resampled = (form(*shape, dtype=np.int32) for shape in ((of, 5, draws), (of * draws,), (count,)))
        edges = LinearisedEdges(form(of, c, 5, draws), vertices, pixel, pixel, resampled, view(of, draws))
    known = Linearised(form(h, w, c), form(h, w, dtype=np.bool_), form(h, w), Spread(rows), edges)
    return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype), known)


def _kind(unknowns: Unknowns, problem: Problem, number: int) -> Kind:
    factors = problem.albedo_shape if unknowns.albedo is not None else None
    told = None if factors is None else (factors[:2] != (1, 1), factors[2])
    return Kind(problem.groups[number].targets.shape[-1], told)


def _resampled(settings: Settings, pixels: int) -> int:
    """How many pixels of a picture are resampled."""
    return min(math.ceil((settings.edge_samples or 0) / _POINTS_PER_PIXEL), pixels)


LinearisedEach = tuple[Linearised | None, ...]
"""For each group; None where its scenes cannot be linearised."""


def linearise(unknowns: Unknowns, problem: Problem, begin: Callable[[LinearisedEach], None]) -> LinearisedEach:
    """The pictures of each group whose scenes `can_be_linearised`, and their derivatives in the heights and in what else is
    sought; leaves have a leading axis of the group's pictures.

    Args:
      unknowns, problem: where; on each device of the problem's mesh.
      begin: called once, while programs may be compiled for that, with `jax.ShapeDtypeStruct`s in place of what is returned.
    """
    forms = tuple(_form(unknowns, problem, number) for number in range(len(problem.groups)))
    begin_once = functools.cache(lambda: begin(forms))

    def of_group(number: int, form: Linearised) -> Linearised:
        surface, kind = surface_of(unknowns, problem.basis), _kind(unknowns, problem, number)
        into = jax.tree.map(lambda leaf: room(leaf.shape, np.dtype(leaf.dtype)), form)
        for k in range(len(problem.groups[number].indices)):
            scene, about = _picture_seen(unknowns, problem, surface, number, np.asarray(k, np.int32))
            one = jax.tree.map(lambda leaf, k=k: leaf[k], into)
            _fill(one, scene, about, kind, problem, begin_once if k == 0 else None)
        return everywhere(into, problem.mesh)

    found = tuple(None if form is None else of_group(number, form) for number, form in enumerate(forms))
    begin_once()
    return found


@functools.partial(compiled, jit=eqx.filter_jit)
def _picture_seen(
    unknowns: Unknowns, problem: Problem, surface: Float[Array, "my mx"], number: int, k: Array
) -> tuple[Scene, tuple[Any, View]]:
    """What the k-th picture of a group shows, and what `Seen` has beside a world; `surface`: the heights with their padding."""
    group = problem.groups[number]
    scene, view = jax.tree.map(lambda leaf: leaf[k], (group.scenes, problem.moves(unknowns, group)))
    scene = group.complete(scene, problem.basis.crop(surface), problem.factors(unknowns))
    lights, camera = moved(scene.lights, scene.camera, view)
    given = scene.lights, scene.camera, numbers_of(scene.objects[scene.first_heightfield].material, view)
    return with_material(scene.with_lights(lights).with_camera(camera), view), (given, view)


def _fill(
    into: OnHost, scene: Scene, about: tuple[Any, View], kind: Kind, problem: Problem, begin: Callable[[], None] | None
) -> None:
    """Traces a picture into arrays of NumPy's; `begin`: as of `linearise`, None where programs have been compiled."""
    settings, mesh, camera, edges = resolve_settings(problem.settings, scene), problem.mesh, scene.camera, into.edges
    vertices, drawing = scene.heightfields[0].heights.size, (settings.edge_samples or 0, about[1].camera is None)
    if edges is not None:
        require_edges_followed((obj.shape for obj in scene.objects), drawing[0])

    def ahead(world: World) -> None:
        if begin is None:
            return
        seen, drawn = Seen(world, camera, *about).of_any_size(), None
        if edges is not None:
            drawn = compile_points_ahead(world, camera, mesh, *drawing).contributions
        compile_rows_ahead(seen, PictureSamples(camera, settings).size, kind, drawn, mesh)
        begin()

    # Those for which other programs, too, make a world: how many samples and points there are is data.
    world = prepared_world(scene, dataclasses.replace(settings, samples=1, edge_samples=0), mesh, ahead)
    world = held_everywhere(world, mesh)
    ahead(world)
    seen = Seen(world, camera, *about).of_any_size()
    if edges is not None:
        points = jax.tree.map(np.asarray, draw_points(world, camera, mesh, *drawing))
        _fill_edges(edges, seen, points, into.depends.size, kind, mesh)
        np.minimum(edges.vertices, vertices, out=edges.vertices)
    samples: Any = PictureSamples(camera, settings, None if edges is None else edges.resampled)
    rows, positions = into.samples.values, samples.positions(np)
    chunks, *_, size = rows.slopes.shape
    light, moving = (np.empty((chunks, size, count), rows.slopes.dtype) for count in (kind.channels, 1))
    if chunks > samples.chunks:
        positions = jax.tree.map(lambda at: np.pad(at, ((0, chunks - len(at)), (0, 0)), mode="edge"), positions)
    for places, values in rows_of_samples(seen, positions, kind, mesh):
        _write(((light, moving), rows), places, values)
    np.minimum(rows.vertices, vertices, out=rows.vertices)
    with np.errstate(all="ignore"):  # of a picture that is not finite
        sampling = np.ascontiguousarray(_sampling_error(samples.in_rows(light), math.isqrt(settings.samples or 1)))
        into.image[...], into.depends[...] = samples.in_pixels(light), samples.in_pixels(moving)[..., 0] > 0
        if edges is not None:
            finer = samples.of_resampled(light)
            into.image.reshape(-1, kind.channels)[edges.resampled] = finer.mean(1)
            sampling.reshape(-1, kind.channels)[edges.resampled] = _errors_of(finer)
        into.sampling[...] = np.sqrt(np.mean(sampling * sampling, axis=-1))


def _fill_edges(into: OnHost, seen: Seen, points: Points, pixels: int, kind: Kind, mesh: Mesh) -> None:
    """Follows points on edges in a picture of so many pixels into arrays of NumPy's."""
    chunks, _, draws = into.vertices.shape
    rows = into.slopes, into.vertices, into.view
    for places, values in rows_of_points(seen, points.contributions, chunks, kind.channels, mesh):
        _write(rows, places, jax.tree.map(lambda leaf: leaf[..., :draws], values))
    counted = jax.tree.map(lambda leaf: leaf[:chunks, :, :draws], points)
    found, _ = counted.contributions.unpacked()
    pixel, _, sizes, _ = (values.ravel() for values in counted.seen.unpacked())
    into.pixel[...], into.kind[...] = pixel, np.where(found.valid, np.where(found.light < 0, 1, 2), 0).ravel()
    # They are chosen by the boundaries alone: a choice by the picture's own samples would keep what these happen to miss.
    told = sizes > 0
    changes = np.bincount(pixel[told], sizes[told], minlength=pixels)
    into.resampled[...] = np.argsort(-changes, kind="stable")[: into.resampled.size]


def _write(into: Any, places: slice, values: Any) -> None:
    """Writes results of chunks where they belong."""
    for leaf, part in zip(jax.tree.leaves(into), jax.tree.leaves(values), strict=True):
        leaf[places] = part


def _sampling_error(samples: Float[np.ndarray, "rows columns c"], side: int) -> Float[np.ndarray, "h w c"]:
    """The standard deviation of the means over squares of side x side samples, of rows and columns of regular samples.

    It is 0.25 / side times the root mean square of the second differences in such a square. Where the picture is smooth these
    follow its curvature, on which the error depends (midpoint rule), not its slope; where a boundary crosses, it falls as
    n^(-3/4), n = side² (Mitchell, Consequences of stratified sampling in graphics, SIGGRAPH 1996). The factor was measured on
    pictures of 1024 samples, see docs/measurements/fits.md.
    """
    if side == 1:
        return np.zeros_like(samples)
    along_x, along_y = (_second_differences(lines, side) for lines in (samples, samples.swapaxes(0, 1)))
    squares = along_x * along_x + (along_y * along_y).swapaxes(0, 1)
    h, w = (n // side for n in squares.shape[:2])
    return _SAMPLING_ERROR / side * np.sqrt(squares.reshape(h, side, w, side, -1).mean((1, 3)))


def _errors_of(pixels: Float[np.ndarray, "pixels samples c"]) -> Float[np.ndarray, "pixels c"]:
    """The same for each of some pixels of squares of samples."""
    count, each, channels = pixels.shape
    side = math.isqrt(each)
    squares = pixels.reshape(count, side, side, channels)
    # One above the other, and side by side.
    along_x = _second_differences(squares.reshape(-1, side, channels), side).reshape(squares.shape)
    along_y = _second_differences(squares.swapaxes(1, 2).reshape(-1, side, channels), side).reshape(squares.shape)
    # Turned or not: the mean is over the whole square.
    return _SAMPLING_ERROR / side * np.sqrt((along_x * along_x + along_y * along_y).mean((1, 2)))


def _second_differences(samples: Float[np.ndarray, "rows columns c"], side: int) -> Float[np.ndarray, "rows columns c"]:
    """Sizes of second differences along the rows; the first and last of a square as large as its neighbour's there at most.

    So a boundary between two squares counts for neither.
    """
    padded = np.pad(samples, ((0, 0), (1, 1), (0, 0)), mode="edge")
    size = np.abs(padded[:, 2:] + padded[:, :-2] - 2 * samples).reshape(samples.shape[0], -1, side, samples.shape[2])
    first, last = (np.minimum(size[:, :, a], size[:, :, b]) for a, b in ((0, 1), (-1, -2)))
    size[:, :, 0], size[:, :, -1] = first, last
    return size.reshape(samples.shape)
