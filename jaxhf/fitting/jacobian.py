"""The derivative of a fit's pictures in its unknowns as one sparse matrix, put together from `Linearised`.

A product with it needs no loop over samples, and it can be multiplied by itself: the matrix of the samples' derivatives in the
heights and normals at vertices, times that of these in the heights.
"""

import dataclasses
import functools
import itertools
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
import scipy.sparse
from jax import lax
from jaxtyping import Array, Float

from ..boundary.term import resampled_side
from ..preparation.world import make_world
from ..rendering.samples import PictureSamples
from ..rendering.tiles import Tiling
from ..scene.heightfield import Heightfield
from ..scene.scene import Scene
from ..xla.compilation import compiled
from ..xla.devices import on_every_device
from .basis import Unknowns
from .groups import Group
from .linearise import Linearised, vertex_values
from .problem import Problem
from .residuals import completion, heights_of, simulate, views
from .robust import robust_weight, soften

sp: Any = scipy.sparse  # whose stubs miss much
Sparse = Any
"""A `scipy.sparse.csr_array`."""

_THREADS = min(4, os.cpu_count() or 1)  # each holds the rows of a picture's samples, of 100 bytes and more
_REACH = 3  # A vertex's normal depends on heights one row and one column off: of each 3 x 3 heights on one.


def images_jacobian(unknowns: Unknowns, problem: Problem) -> Sparse:
    """The derivative of the pictures in the heights, without exposures and weights.

    Args:
      unknowns: whose albedo is known.
      problem: `linearised` there.

    Returns:
      A row for each value of each picture, in the order of `in_rows`, a column for each height without padding.
    """
    assert problem.linearised is not None
    heights = heights_of(unknowns, problem.basis)
    # A small program for each scheme: that of normals by angle takes ten times as long to compile (2.9 s, not 0.3).
    decided = dataclasses.replace(problem, settings=problem.found_settings, by_angle=None)
    slopes, blocks = _slopes(*on_every_device((heights, unknowns, decided), problem.mesh)), []
    for number, (group, here) in enumerate(zip(problem.groups, slopes, strict=True)):
        of_heights = vertices_by_heights(np.asarray(here, np.float64), group.complete(group.scenes, heights))
        blocks += group_by_vertices(problem, number, heights, of_heights)
    return sp.vstack(blocks, format="csr")


def group_by_vertices(problem: Problem, number: int, heights: Float[Array, "ny nx"], right: Sparse) -> list[Any]:
    """The derivatives of the pictures of one group, which are `linearised` at these heights, in what stands at the vertices:
    `picture_by_vertices` times a matrix or vector, in the order of `in_rows`."""
    assert problem.linearised is not None
    group, known = problem.groups[number], problem.linearised[number]
    camera = group.complete(group.scenes, heights).camera

    def product(which: tuple[int, int]) -> Any:
        k, channel = which
        one = jax.tree.map(lambda leaf: np.asarray(leaf)[k], known)
        samples = PictureSamples(camera, problem.settings, None if one.edges is None else one.edges.resampled)
        return picture_by_vertices(one, samples, channel, right.shape[0]) @ right

    # NumPy and SciPy let other threads run as they look up and multiply.
    with ThreadPoolExecutor(_THREADS) as threads:
        return list(threads.map(product, itertools.product(range(len(group.indices)), range(group.targets.shape[-1]))))


def in_rows(pictures: Sequence[Any]) -> Float[np.ndarray, " rows"]:
    """Values of the pictures of each group, (n, h, w, c), one after the other: picture by picture, channel by channel."""
    return np.concatenate([np.moveaxis(np.asarray(part), -1, 1).ravel() for part in pictures]).astype(np.float64)


def scaled_rows(matrix: Sparse, factors: Float[np.ndarray, " rows"]) -> Sparse:
    """A matrix with each row multiplied."""
    values = matrix.data * np.repeat(factors, np.diff(matrix.indptr))
    return sp.csr_array((values, matrix.indices, matrix.indptr), shape=matrix.shape)


def other_unknowns(unknowns: Unknowns) -> Any:
    """What is unknown besides heights, as a tree."""
    return eqx.tree_at(lambda unknowns: unknowns.coefficients, unknowns, None)


class PictureValues(NamedTuple):
    """The pictures and their part of the loss; each list has an array for each group.

    Attributes:
      images: the pictures as they would be measured, see `simulate`.
      softened: residuals whose half squares are the robust loss.
      slopes: their derivatives in the residuals.
      roots: of the residuals' robust weights.
      factors: derivatives of the residuals in the pictures: weights times exposures.
      others: derivatives of the residuals in each of `other_unknowns`.
    """

    images: list[Float[Array, "n h w c"]]
    softened: list[Float[Array, "n h w c"]]
    slopes: list[Float[Array, "n h w c"]]
    roots: list[Float[Array, "n h w c"]]
    factors: list[Float[Array, "n h w c"]]
    others: list[Float[Array, "k n h w c"]]


def picture_values(unknowns: Unknowns, problem: Problem) -> PictureValues:
    """See there; the problem is `linearised` at these unknowns."""
    return _picture_values(*on_every_device((unknowns, problem), problem.mesh))


@functools.partial(compiled, jit=eqx.filter_jit)
def _picture_values(unknowns: Unknowns, problem: Problem) -> PictureValues:
    flat, unflat = jax.flatten_util.ravel_pytree(unknowns)  # coefficients are the first of them
    beyond = unknowns.coefficients.size + jnp.arange(flat.size - unknowns.coefficients.size)

    def compared(unknowns: Unknowns) -> tuple[list[Array], list[Array]]:
        images = simulate(unknowns, problem)
        return [group.weights * (image - group.targets) for group, image in zip(problem.groups, images, strict=True)], images

    if beyond.size:
        residuals, changes, images = jax.linearize(compared, unknowns, has_aux=True)
        others = lax.map(lambda k: changes(unflat(jnp.zeros_like(flat).at[k].set(1))), beyond)
    else:
        residuals, images = compared(unknowns)
        others = [jnp.zeros((0, *part.shape), part.dtype) for part in residuals]
    factors = []
    for group in problem.groups:
        exposures = 1 if unknowns.exposures is None else unknowns.exposures[jnp.array(group.indices)].reshape(-1, 1, 1, 1)
        factors.append(group.weights * exposures)
    soft = functools.partial(soften, loss=problem.loss, scale=problem.loss_scale)
    pairs = [jax.jvp(soft, (part,), (jnp.ones_like(part),)) for part in residuals]
    roots = [jnp.sqrt(robust_weight(part, problem.loss, problem.loss_scale)) for part in residuals]
    return PictureValues(images, [value for value, _ in pairs], [slope for _, slope in pairs], roots, factors, others)


@functools.partial(compiled, jit=eqx.filter_jit)
def _slopes(heights: Float[Array, "ny nx"], unknowns: Unknowns, problem: Problem) -> list[Float[Array, "9 vertices m"]]:
    """For each group the `vertex_slopes`."""
    slopes = []
    for group in problem.groups:
        first = jax.tree.map(lambda leaf: leaf[0], views(unknowns, problem, group))

        def values(heights: Array, group: Group = group, scene: Scene = first) -> Array:
            scene = completion(unknowns, group, heights)(scene)
            return vertex_values(make_world(scene, problem.settings))

        slopes.append(vertex_slopes(values, heights))
    return slopes


def vertex_slopes(
    values: Callable[[Float[Array, "ny nx"]], Float[Array, "vertices m"]], heights: Float[Array, "ny nx"]
) -> Float[Array, "9 vertices m"]:
    """How values at vertices change with every third height of every third row, beginning at each of nine."""
    row, column = jnp.indices(heights.shape)
    phase = row % _REACH * _REACH + column % _REACH
    _, change = jax.linearize(values, heights)
    return lax.map(lambda k: change((phase == k).astype(heights.dtype)), jnp.arange(_REACH**2))


def vertices_by_heights(slopes: Float[np.ndarray, "9 vertices m"], scene: Scene) -> Sparse:
    """The derivative of what stands at the vertices of all grids, number by number, in the first heightfield's heights.

    Args:
      slopes: `vertex_slopes`.
      scene: whose grids they are.
    """
    # Of several pictures, where that differs from one to the other, heights have an axis for them.
    shapes = [obj.shape.heights.shape[-2:] for obj in scene.objects if isinstance(obj.shape, Heightfield)]
    shape = scene.heightfields[0].heights.shape
    numbers, (ny, nx) = slopes.shape[2], shape
    rows, columns, values, first = [], [], [], 0
    for other in shapes:
        count = other[0] * other[1]
        if other == shape:  # of another size it has heights of its own
            at = np.divmod(np.arange(count), nx)
            for k in range(_REACH**2):
                # The nearest height of this phase.
                row, column = (i + (phase - i + 1) % _REACH - 1 for i, phase in zip(at, divmod(k, _REACH), strict=True))
                inside = (row >= 0) & (row < ny) & (column >= 0) & (column < nx)
                here = slopes[k, first : first + count]
                vertex, number = np.nonzero(np.where(inside[:, None], here, 0))
                rows.append((first + vertex) * numbers + number)
                columns.append((row * nx + column)[vertex])
                values.append(here[vertex, number])
        first += count
    return sp.csr_array(
        (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), shape=(first * numbers, ny * nx)
    )


def picture_by_vertices(known: Linearised, samples: PictureSamples, channel: int, columns: int) -> Sparse:
    """The derivative of a channel of one picture in what stands at the vertices: a row for each pixel, and so many columns."""
    tiling = Tiling(samples.camera, samples.settings)
    pixels, (chunks, _, numbers, size) = tiling.width * tiling.height, known.slopes.shape
    at_vertex = 4 if numbers == 12 else 1
    vertex, number = np.arange(3), np.zeros(3, int)
    if numbers == 12:  # the three heights, then each vertex's normal
        vertex, number = np.concatenate([vertex, np.repeat(vertex, 3)]), np.concatenate([number, np.tile([1, 2, 3], 3)])
    slopes = np.moveaxis(np.asarray(known.slopes)[:, channel], 1, 2).reshape(chunks * size, numbers)
    places = np.moveaxis(np.asarray(known.vertices), 1, 2).reshape(chunks * size, 3)[:, vertex] * at_vertex + number
    shape = pixels, columns
    # Which samples each pixel has: `PictureSamples.in_pixels` of their numbers.
    each = samples.settings.samples or 1
    slots = np.moveaxis(np.arange(tiling.count * each * size).reshape(tiling.count, each, size), 1, 2)
    slots = tiling.assemble(slots).reshape(pixels, each)
    share = np.full((pixels, 1), 1 / each)
    if known.edges is None:
        return _rows(slopes[slots] * share[..., None], places[slots], shape)
    resampled, pixel, edges = np.asarray(known.edges.resampled), np.asarray(known.edges.pixel), known.edges
    share[resampled] = 0
    once_more = tiling.count * each * size + np.arange(resampled.size * resampled_side(samples.settings) ** 2)
    once_more = once_more.reshape(resampled.size, -1)
    finer = _rows(slopes[once_more] / once_more.shape[1], places[once_more], (resampled.size, shape[1]))
    moving = np.moveaxis(np.asarray(edges.slopes)[:, channel], 1, 2).reshape(-1, 5)
    heights = np.moveaxis(np.asarray(edges.vertices), 1, 2).reshape(-1, 5) * at_vertex
    moving = _rows(moving[:, None], heights[:, None], (len(pixel), shape[1]))
    return (
        _rows(slopes[slots] * share[..., None], places[slots], shape)
        + _selection(resampled, pixels) @ finer
        + _selection(pixel, pixels) @ moving
    )


def _rows(values: Float[np.ndarray, "rows n k"], columns: np.ndarray, shape: tuple[int, int]) -> Sparse:
    """A matrix whose rows hold equally many entries, some of them for the same column, which are added up."""
    ends = np.arange(shape[0] + 1) * (values.size // shape[0])
    return sp.csr_array((values.astype(np.float64).ravel(), columns.ravel(), ends), shape=shape)


def _selection(rows: np.ndarray, count: int) -> Sparse:
    """The matrix that adds its operand's rows to these of `count`."""
    return sp.csr_array((np.ones(rows.size), (rows.ravel(), np.arange(rows.size))), shape=(count, rows.size))
