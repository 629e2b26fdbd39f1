"""The derivative of linearised pictures in the heights as a sparse matrix on the host, of all or of a part of them."""

import dataclasses
import functools
import itertools
import os
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from ...preparation.world import make_world
from ...rendering.samples import PictureSamples
from ...scene.scene import Scene
from ...xla.compilation import compiled
from ...xla.devices import on_every_device, on_host
from .expansion import Expansion
from .linearise import OnHost
from .pictures import Group, vertex_values
from .problem import Problem
from .unknowns import Unknowns, Window

sp: Any = scipy.sparse  # whose stubs miss much
Sparse = Any
"""A `scipy.sparse.csr_array`."""

MOST_HEIGHTS = 2**21
"""With their padding; the largest that was tried has half as many."""
THREADS = min(4, os.cpu_count() or 1)
"""Of a host's work on sparse matrices: each holds the rows of a picture's samples, of 100 bytes and more."""
_REACH = 3  # A vertex's normal depends on heights one row and one column off: of each 3 x 3 heights on one.


def pictures_by_heights(expansion: Expansion) -> Sparse | None:
    """The derivative of the pictures in the heights, in units of the noise: a row for each value, in the order of `in_row`, a
    column for each height without padding. None: it is not known, or too large to be factorised."""
    return part_by_heights(expansion, None)[0] if has_rows(expansion) else None


def has_rows(expansion: Expansion) -> bool:
    """Whether `pictures_by_heights` has them."""
    return expansion.problem.basis.base.size <= MOST_HEIGHTS and expansion.is_linearised


def first_vertices(expansion: Expansion) -> Int[np.ndarray, " rows"]:
    """Of each value a vertex of the sought heightfield on which its pixel depends; -1 where its first sample shows another."""
    found, count = [], expansion.problem.field.heights.size
    for group, known in zip(expansion.problem.groups, expansion.linearised, strict=True):
        assert known is not None
        slots = _slots(PictureSamples(group.scenes.camera, expansion.problem.settings))[:, 0]
        vertices = on_host(known.samples.values.vertices)
        chunk, sample = np.divmod(slots, vertices.shape[-1])
        vertices = vertices[:, chunk, 0, sample]
        shown = np.asarray(known.depends).reshape(vertices.shape) & (vertices < count)
        found.append(np.repeat(np.where(shown, vertices, -1), group.targets.shape[-1]))
    return np.concatenate([part.ravel() for part in found])


def _inside(shape: tuple[int, ...], window: Window, rim: int) -> Bool[np.ndarray, "ny nx"]:
    """Which heights are these, without so many at sides beyond which the terrain goes on."""
    found = np.zeros(shape, bool)
    found[window.place] = ~window.rim(shape, rim)
    return found


def part_by_heights(expansion: Expansion, window: Window | None) -> tuple[Sparse, Int[np.ndarray, " rows"]]:
    """The part of `pictures_by_heights` of a window, None: all of it; and its rows' places in the order of `in_row`, rising.

    Its columns are the window's heights, its rows the values that depend on no others, without pixels that a boundary crosses.
    """
    problem, heights = expansion.problem, expansion.heights
    slopes = _slopes(*on_every_device((heights, expansion.unknowns, problem), problem.mesh))
    near, core = (None if window is None else _inside(heights.shape, window, rim) for rim in (0, 1))
    blocks, values, first = [], [], 0
    for group, known, here in zip(problem.groups, expansion.linearised, slopes, strict=True):
        assert known is not None
        known, scene = on_host(known), group.complete(group.scenes, heights)
        n, h, w, c = group.targets.shape
        pixels = [np.arange(h * w) if core is None else _pixels_at(known, k, scene, problem, core) for k in range(n)]
        right = _vertices_by_heights(np.asarray(here, np.float64), scene, near)
        blocks += _of_group(
            problem, group, known if core is None else dataclasses.replace(known, edges=None), scene, right, pixels
        )
        values += [first + (k * h * w + pixels[k]) * c + channel for k in range(n) for channel in range(c)]
        first += n * h * w * c
    exposures = np.ones(problem.count) if expansion.unknowns.exposures is None else np.asarray(expansion.unknowns.exposures)
    factors = np.concatenate([np.ravel(np.asarray(group.weights) * group.each(exposures)) for group in problem.groups])
    places = np.concatenate(values)
    order = np.argsort(places)
    matrix = scaled(sp.vstack(blocks, format="csr")[order], factors[places[order]])
    return matrix if near is None else matrix[:, np.flatnonzero(near)], places[order]


def _pixels_at(
    known: OnHost, k: int, scene: Scene, problem: Problem, core: Bool[np.ndarray, "ny nx"]
) -> Int[np.ndarray, " pixels"]:
    """Those of a picture all of whose samples show triangles of these vertices, but for those that a boundary crosses."""
    slots = _slots(PictureSamples(scene.camera, problem.settings))
    vertices = np.moveaxis(known.samples.values.vertices[k], 1, 2).reshape(-1, 3)[slots]
    shown = np.append(core.ravel(), False)[np.minimum(vertices, core.size)].all(axis=(1, 2))
    shown &= known.depends[k].ravel()
    if known.edges is not None:
        edges = jax.tree.map(lambda leaf: leaf[k], known.edges)
        shown[edges.resampled] = False
        shown[edges.pixel[edges.kind > 0]] = False
    return np.flatnonzero(shown)


def _of_group(
    problem: Problem, group: Group, known: OnHost, scene: Scene, right: Sparse, pixels: list[Int[np.ndarray, " pixels"]]
) -> list[Sparse]:
    """The derivatives of these pixels of the pictures of a group: `_picture_by_vertices` times a matrix."""

    def product(which: tuple[int, int]) -> Sparse:
        k, channel = which
        one = jax.tree.map(lambda leaf: leaf[k], known)
        samples = PictureSamples(scene.camera, problem.settings, None if one.edges is None else one.edges.resampled)
        return _picture_by_vertices(one, samples, channel, right.shape[0], pixels[k]) @ right

    # NumPy and SciPy let other threads run as they look up and multiply.
    with ThreadPoolExecutor(THREADS) as threads:
        return list(threads.map(product, itertools.product(range(len(group.indices)), range(group.targets.shape[-1]))))


@functools.partial(compiled, jit=eqx.filter_jit)
def _slopes(heights: Float[Array, "ny nx"], unknowns: Unknowns, problem: Problem) -> list[Float[Array, "9 vertices m"]]:
    """For each group how what stands at vertices changes with every third height of every third row, beginning at each of
    nine."""
    row, column = jnp.indices(heights.shape)
    phase = row % _REACH * _REACH + column % _REACH
    slopes = []
    for group in problem.groups:
        first = jax.tree.map(lambda leaf: leaf[0], group.scenes)

        def values(heights: Array, group: Group = group, scene: Scene = first) -> Array:
            return vertex_values(make_world(group.complete(scene, heights, problem.factors(unknowns)), problem.settings))

        _, change = jax.linearize(values, heights)
        slopes.append(lax.map(lambda k, change=change: change((phase == k).astype(heights.dtype)), jnp.arange(_REACH**2)))
    return slopes


def _vertices_by_heights(
    slopes: Float[np.ndarray, "9 vertices m"], scene: Scene, near: Bool[np.ndarray, "ny nx"] | None
) -> Sparse:
    """The derivative of what stands at the vertices, number by number, in the heights, by `_slopes`; that beyond the last
    stays. `near`: which vertices of the scene's first heightfield matter; None: all."""
    numbers, (ny, nx) = slopes.shape[2], scene.heightfields[0].heights.shape[-2:]
    chosen = np.arange(ny * nx) if near is None else np.flatnonzero(near)
    at = np.divmod(chosen, nx)
    rows, columns, values = [], [], []
    for k in range(_REACH**2):
        # The nearest height of this phase.
        row, column = (i + (phase - i + 1) % _REACH - 1 for i, phase in zip(at, divmod(k, _REACH), strict=True))
        inside = (row >= 0) & (row < ny) & (column >= 0) & (column < nx)
        here = slopes[k, chosen]
        vertex, number = np.nonzero(np.where(inside[:, None], here, 0))
        rows.append(chosen[vertex] * numbers + number)
        columns.append((row * nx + column)[vertex])
        values.append(here[vertex, number])
    entries = np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))
    return sp.csr_array(entries, shape=((ny * nx + 1) * numbers, ny * nx))


def _slots(samples: PictureSamples) -> Int[np.ndarray, "pixels each"]:
    """Which samples each pixel has: `PictureSamples.in_pixels` of their numbers."""
    tiling, each, size = samples.tiling, samples.tiling.samples, samples.size
    slots = np.moveaxis(np.arange(tiling.count * each * size).reshape(tiling.count, each, size), 1, 2)
    return tiling.assemble(slots).reshape(tiling.width * tiling.height, each)


def _picture_by_vertices(
    known: OnHost, samples: PictureSamples, channel: int, columns: int, pixels: Int[np.ndarray, " pixels"]
) -> Sparse:
    """The derivative of a channel of these pixels of a picture in what stands at the vertices: a row for each, and so many
    columns; all pixels, where it has boundaries."""
    of_samples = known.samples.values
    chunks, _, numbers, size = of_samples.slopes.shape
    at_vertex = 4 if numbers == 12 else 1
    vertex, number = np.arange(3), np.zeros(3, int)
    if numbers == 12:  # the three heights, then each vertex's normal
        vertex, number = np.concatenate([vertex, np.repeat(vertex, 3)]), np.concatenate([number, np.tile([1, 2, 3], 3)])
    slopes = np.moveaxis(of_samples.slopes[:, channel], 1, 2).reshape(chunks * size, numbers)
    places = np.moveaxis(of_samples.vertices, 1, 2).reshape(chunks * size, 3)
    slots, shape = _slots(samples)[pixels], (pixels.size, columns)
    share = np.full((*slots.shape, 1), 1 / slots.shape[1])

    def rows(samples: np.ndarray, share: Any, shape: tuple[int, int]) -> Sparse:
        return _rows(slopes[samples] * share, places[samples][..., vertex] * at_vertex + number, shape)

    if known.edges is None:
        return rows(slots, share, shape)
    resampled, pixel, edges = known.edges.resampled, known.edges.pixel, known.edges
    share[resampled] = 0
    once_more = samples.tiling.count * slots.shape[1] * size + np.arange(resampled.size * samples.resampled_side**2)
    once_more = once_more.reshape(resampled.size, -1)
    moving = np.moveaxis(edges.slopes[:, channel], 1, 2).reshape(-1, 5)
    heights = np.moveaxis(edges.vertices, 1, 2).reshape(-1, 5) * at_vertex
    moving = _rows(moving[:, None], heights[:, None], (len(pixel), columns))
    return (
        rows(slots, share, shape)
        + _selection(resampled, pixels.size) @ rows(once_more, 1 / once_more.shape[1], (resampled.size, columns))
        + _selection(pixel, pixels.size) @ moving
    )


def _rows(values: Float[np.ndarray, "rows n k"], columns: np.ndarray, shape: tuple[int, int]) -> Sparse:
    """A matrix whose rows hold equally many entries, some of them for the same column, which are added up."""
    ends = np.arange(shape[0] + 1) * (values.size // shape[0])
    return sp.csr_array((values.astype(np.float64).ravel(), columns.ravel(), ends), shape=shape)


def _selection(rows: np.ndarray, count: int) -> Sparse:
    """The matrix that adds its operand's rows to these of `count`."""
    return sp.csr_array((np.ones(rows.size), (rows.ravel(), np.arange(rows.size))), shape=(count, rows.size))


def scaled(matrix: Sparse, factors: Float[np.ndarray, " rows"]) -> Sparse:
    """A matrix with each row multiplied."""
    values = matrix.data * np.repeat(factors, np.diff(matrix.indptr))
    return sp.csr_array((values, matrix.indices, matrix.indptr), shape=matrix.shape)
