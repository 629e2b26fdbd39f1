"""A sparse matrix near to the normal matrix of a fit, and its factors, which make its linear problems quick to solve."""

import functools
import itertools
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize
import scipy.sparse
import scipy.sparse.linalg
from jax import lax
from jaxtyping import Array, Float

from ...boundary.term import resampled_side
from ...preparation.world import make_world
from ...rendering.samples import PictureSamples
from ...rendering.tiles import Tiling
from ...scene.heightfield import Heightfield
from ...scene.scene import Scene
from ...xla.compilation import compiled
from ...xla.devices import on_every_device
from ..model.expansion import Expansion, completion, views
from ..model.linearise import Linearised, vertex_values
from ..model.normal_matrix import Flat, NormalMatrix
from ..model.pictures import Group
from ..model.problem import Problem
from ..model.surface import Unknowns, slope_units

sp: Any = scipy.sparse  # whose stubs miss much
Sparse = Any
"""A `scipy.sparse.csr_array`."""

MOST_HEIGHTS = 2**17
"""With their padding. The factors of 512 x 512 take 5 GB."""
_THREADS = min(4, os.cpu_count() or 1)  # each holds the rows of a picture's samples, of 100 bytes and more
_REACH = 3  # A vertex's normal depends on heights one row and one column off: of each 3 x 3 heights on one.
_MOST_OTHERS = 64  # unknowns besides heights that are eliminated
_PROBES = 8  # of their curvature, where they are more
_DEGREE = 3  # of the polynomial in the Laplacian that stands for a prior


def pictures_by_heights(expansion: Expansion) -> Sparse | None:
    """The derivative of the pictures in the heights, in units of the noise: a row for each value, in the order of `in_row`, a
    column for each height without padding. None: it is not known, or too large to be factorised."""
    problem = expansion.problem
    if problem.basis.base.size > MOST_HEIGHTS or any(known is None for known in expansion.linearised):
        return None
    heights = expansion.heights
    slopes = _slopes(*on_every_device((heights, expansion.unknowns, problem), problem.mesh))
    blocks = []
    for group, known, here in zip(problem.groups, expansion.linearised, slopes, strict=True):
        assert known is not None
        scene = group.complete(group.scenes, heights)
        blocks += _of_group(problem, group, known, scene, _vertices_by_heights(np.asarray(here, np.float64), scene))
    exposures = expansion.unknowns.exposures
    factors = [
        np.asarray(group.weights) * (1 if exposures is None else np.asarray(exposures)[list(group.indices), None, None, None])
        for group in problem.groups
    ]
    matrix = sp.vstack(blocks, format="csr")[_channels_last(problem)]
    return _scaled(matrix, np.concatenate([factor.ravel() for factor in factors]))


def _channels_last(problem: Problem) -> np.ndarray:
    """Where each value stands among those of picture after picture, channel after channel."""
    places, first = [], 0
    for group in problem.groups:
        n, h, w, c = group.targets.shape
        places.append(np.moveaxis(first + np.arange(n * c * h * w).reshape(n, c, h, w), 1, -1).ravel())
        first += n * c * h * w
    return np.concatenate(places)


def _of_group(problem: Problem, group: Group, known: Linearised, scene: Scene, right: Sparse) -> list[Sparse]:
    """The derivatives of the pictures of a group: `_picture_by_vertices` times a matrix."""

    def product(which: tuple[int, int]) -> Sparse:
        k, channel = which
        one = jax.tree.map(lambda leaf: np.asarray(leaf)[k], known)
        samples = PictureSamples(scene.camera, problem.settings, None if one.edges is None else one.edges.resampled)
        return _picture_by_vertices(one, samples, channel, right.shape[0]) @ right

    # NumPy and SciPy let other threads run as they look up and multiply.
    with ThreadPoolExecutor(_THREADS) as threads:
        return list(threads.map(product, itertools.product(range(len(group.indices)), range(group.targets.shape[-1]))))


@functools.partial(compiled, jit=eqx.filter_jit)
def _slopes(heights: Float[Array, "ny nx"], unknowns: Unknowns, problem: Problem) -> list[Float[Array, "9 vertices m"]]:
    """For each group how what stands at vertices changes with every third height of every third row, beginning at each of
    nine."""
    row, column = jnp.indices(heights.shape)
    phase = row % _REACH * _REACH + column % _REACH
    slopes = []
    for group in problem.groups:
        first = jax.tree.map(lambda leaf: leaf[0], views(unknowns, problem, group))

        def values(heights: Array, group: Group = group, scene: Scene = first) -> Array:
            return vertex_values(make_world(completion(unknowns, group, heights)(scene), problem.settings))

        _, change = jax.linearize(values, heights)
        slopes.append(lax.map(lambda k, change=change: change((phase == k).astype(heights.dtype)), jnp.arange(_REACH**2)))
    return slopes


def _vertices_by_heights(slopes: Float[np.ndarray, "9 vertices m"], scene: Scene) -> Sparse:
    """The derivative of what stands at the vertices of all grids, number by number, in the first heightfield's heights.

    Args:
      slopes: `_slopes`.
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
    entries = np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))
    return sp.csr_array(entries, shape=(first * numbers, ny * nx))


def _picture_by_vertices(known: Linearised, samples: PictureSamples, channel: int, columns: int) -> Sparse:
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


def _scaled(matrix: Sparse, factors: Float[np.ndarray, " rows"]) -> Sparse:
    """A matrix with each row multiplied."""
    values = matrix.data * np.repeat(factors, np.diff(matrix.indptr))
    return sp.csr_array((values, matrix.indices, matrix.indptr), shape=matrix.shape)


def near_inverse(matrix: NormalMatrix, rows: Sparse) -> Callable[[Flat], Flat]:
    """What about inverts a normal matrix: the factors (SuperLU) of that of the heights, in which a polynomial in the Laplacian
    stands for their prior, and the Schur complement of the other unknowns; where these are many, their diagonal.

    With them conjugate gradients take 4 or 5 iterations, where LSMR on J took 300.

    Args:
      matrix: the normal matrix.
      rows: `pictures_by_heights` there.
    """
    problem = matrix.expansion.problem
    basis, shape, term = problem.basis, problem.basis.base.shape, problem.terms.surface
    within = np.asarray(basis.crop(np.arange(basis.base.size).reshape(shape))).ravel()
    scaled = _scaled(rows, matrix.roots)
    scaled = sp.csr_array((scaled.data, within[scaled.indices], scaled.indptr), shape=(scaled.shape[0], basis.base.size))
    weight = sp.diags_array(np.broadcast_to(np.asarray(term.weight, np.float64), shape).ravel())
    near = scaled.T @ scaled + weight @ _polynomial(np.asarray(term.spectrum, np.float64) ** 2, problem) @ weight
    free = np.ones(basis.base.size) if basis.free is None else np.asarray(basis.free, np.float64).ravel()
    near = sp.diags_array(free) @ near @ sp.diags_array(free) + sp.diags_array(1 - free)
    options = {"SymmetricMode": True}
    factors = sp.linalg.splu(near.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)
    count, many = free.size, matrix.size - free.size > _MOST_OTHERS

    def by_heights(x: Flat) -> Flat:
        return free * factors.solve(free * x)

    if many:
        draws = [matrix.gathered(matrix.drawn(seed))[count:] for seed in range(_PROBES)]
        diagonal = np.maximum(np.mean(np.square(draws), axis=0), matrix.others_weight**2)
        return lambda x: np.concatenate([by_heights(x[:count]), x[count:] / diagonal])
    columns = [
        matrix.product(row.astype(np.float64)) for row in (np.arange(matrix.size) == k for k in range(count, matrix.size))
    ]
    beside = np.stack([column[:count] for column in columns], axis=1) if columns else np.zeros((count, 0))
    moved = np.stack([by_heights(column) for column in beside.T], axis=1) if columns else beside
    schur = np.reshape([column[count:] for column in columns], (len(columns), len(columns))) - beside.T @ moved

    def inverse(x: Flat) -> Flat:
        heights = by_heights(x[:count])
        others = np.linalg.solve(schur, x[count:] - beside.T @ heights)
        return np.concatenate([heights - moved @ others, others])

    return inverse


def _polynomial(precision: Float[np.ndarray, "my mx"], problem: Problem) -> Sparse:
    """A matrix whose eigenvalues, along the modes of the surface, come near to these ones: a polynomial in the Laplacian.

    Its coefficients are not negative, so that it is positive definite. (1 + length² · Laplacian)^n is met exactly.
    """
    _, frequency = slope_units(precision.shape, problem.field.dx, problem.field.dy)  # half periods in the longer side
    steps = [(2 - 2 * np.cos(np.pi * np.arange(n) / n)) * ((n - 1) / np.pi) ** 2 for n in precision.shape]
    weights = frequency[1, 0] ** 2, frequency[0, 1] ** 2
    eigenvalue = (weights[0] * steps[0][:, None] + weights[1] * steps[1][None, :]).ravel()
    largest = eigenvalue.max()
    powers = (eigenvalue / largest)[:, None] ** np.arange(_DEGREE + 1)
    # Modes evenly over their frequencies' logarithm: most of all modes have the highest.
    chosen = np.searchsorted(np.sort(eigenvalue), np.geomspace(eigenvalue[eigenvalue > 0].min(), largest, 200))
    chosen = np.r_[0, np.argsort(eigenvalue)[np.minimum(chosen, eigenvalue.size - 1)]]
    relative = powers[chosen] / precision.ravel()[chosen, None]
    size = relative.max(axis=0)
    coefficients = scipy.optimize.nnls(relative / size, np.ones(len(chosen)))[0] / size
    along = [
        weight * ((n - 1) / np.pi) ** 2 / largest
        * sp.diags_array([np.r_[1.0, np.full(n - 2, 2.0), 1.0], -np.ones(n - 1), -np.ones(n - 1)], offsets=[0, 1, -1])
        for n, weight in zip(precision.shape, weights, strict=True)
    ]  # fmt: skip
    eyes = [sp.eye_array(n) for n in precision.shape]
    laplacian = sp.kron(along[0], eyes[1]) + sp.kron(eyes[0], along[1])
    result = coefficients[-1] * sp.eye_array(precision.size)
    for coefficient in coefficients[-2::-1]:
        result = result @ laplacian + coefficient * sp.eye_array(precision.size)
    return result.tocsr()
