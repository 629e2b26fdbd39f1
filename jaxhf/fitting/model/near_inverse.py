"""What about inverts the normal matrix of a fit: factors of a sparse matrix near to it, or of its blocks."""

import itertools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax.numpy as jnp
import numpy as np
import scipy.optimize
import scipy.sparse
import scipy.sparse.linalg
from jaxtyping import Float

from ...scene.heightfield import Heightfield
from .expansion import Expansion
from .normal_matrix import MOST_OTHERS, Flat, NormalMatrix, in_row
from .robust import robust_weight
from .rows import THREADS, Sparse, pictures_by_heights, scaled
from .surface import interpolation, slope_units

sp: Any = scipy.sparse  # whose stubs miss much
_PROBES = 8  # of their curvature, where they are more
_DEGREE = 3  # of the polynomial in the Laplacian that stands for a prior
_FACTORED = 2**15  # heights, with their padding, whose matrix is factorised at once
_BLOCK, _BEYOND = 32, 4  # heights a side of a block of more, and by how many it reaches into its neighbours
_COARSER = 4  # times wider the cells of the coarse grid that joins the blocks


def robust_matrix(expansion: Expansion) -> NormalMatrix:
    """`normal_matrix` with the weights of the robust loss."""
    weights = robust_weight(jnp.asarray(in_row(expansion.left())), expansion.problem.loss_scale)
    return normal_matrix(expansion, np.sqrt(np.asarray(weights)))


def normal_matrix(expansion: Expansion, roots: Float[np.ndarray, " rows"]) -> NormalMatrix:
    """The normal matrix with these roots of its residuals' weights, and with its near inverse where it `has_rows`."""
    rows = pictures_by_heights(expansion)
    matrix = NormalMatrix(expansion, roots, rows)
    if rows is not None:
        matrix.inverse = near_inverse(matrix)
    return matrix


def near_inverse(matrix: NormalMatrix) -> Callable[[Flat], Flat]:
    """What about inverts a normal matrix: `_inverse` of that of the heights, in which a polynomial in the Laplacian stands for
    their prior, and the Schur complement of the other unknowns; where these are many, their diagonal.

    With it conjugate gradients take 5 to 15 iterations, where LSMR on J took 300. `matrix`: one that has rows.
    """
    shape, count = matrix.shape, int(np.prod(matrix.shape))
    weighted = scaled(matrix.rows, matrix.roots)
    weighted = sp.csr_array((weighted.data, matrix.inside[weighted.indices], weighted.indptr), shape=(weighted.shape[0], count))
    weight = sp.diags_array(np.broadcast_to(matrix.weight, shape).ravel())
    precision = np.broadcast_to(matrix.spectrum**2, shape)
    near = weighted.T @ weighted + weight @ _polynomial(precision, matrix.expansion.problem.field) @ weight
    free = np.broadcast_to(matrix.free, shape).ravel()
    near = sp.diags_array(free) @ near @ sp.diags_array(free) + sp.diags_array(1 - free)
    solve = _inverse(near.tocsr(), shape)
    many = matrix.size - count > MOST_OTHERS

    def by_heights(x: Flat) -> Flat:
        return free * solve(free * x)

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


def _inverse(near: Sparse, shape: tuple[int, ...]) -> Callable[[Flat], Flat]:
    """What about solves with a sparse matrix over a grid: its factors or, of many heights, those of overlapping blocks and of
    the matrix on a coarser grid.

    That is a hybrid Schwarz method of two levels (Toselli and Widlund, Domain Decomposition Methods, 2005, chapter 2): blocks
    mend what the coarse grid leaves, and it once more what they leave. Of 256² heights conjugate gradients take as few
    iterations as with the factors of all, which take 3.7 s for 0.6 and twice the memory; of 512² these were 5 GB.
    """
    if near.shape[0] <= _FACTORED:
        return _factors(near).solve
    numbers = np.arange(near.shape[0]).reshape(shape)
    begins = itertools.product(*(range(0, n, _BLOCK) for n in shape))
    sides = ((slice(max(0, begin - _BEYOND), begin + _BLOCK + _BEYOND) for begin in corner) for corner in begins)
    blocks = [numbers[rows, columns].ravel() for rows, columns in sides]
    share = 1 / np.sqrt(np.bincount(np.concatenate(blocks)))  # of a height in each of its blocks, on both sides of the inverse
    places = [np.arange(n) / _COARSER for n in shape]
    between = sp.kron(*(interpolation(at, int(np.ceil(at[-1])) + 1) for at in places), format="csr")
    coarse = _factors(between.T @ near @ between)
    factors = [_factors(near[block][:, block]) for block in blocks]  # SciPy never frees those of another thread

    def on_coarse(x: Flat) -> Flat:
        return between @ coarse.solve(between.T @ x)

    def in_blocks(x: Flat) -> Flat:
        x, result = share * x, np.zeros_like(x)
        with ThreadPoolExecutor(THREADS) as threads:  # SuperLU lets others run
            solved = threads.map(lambda block, of_block: of_block.solve(x[block]), blocks, factors)
            for block, change in zip(blocks, solved, strict=True):
                result[block] += change
        return share * result

    def solve(x: Flat) -> Flat:
        result = on_coarse(x)
        left = x - near @ result
        change = in_blocks(left)
        return result + change + on_coarse(left - near @ change)

    return solve


def _factors(matrix: Sparse) -> Any:
    """Those of a symmetric matrix that is positive definite, by SuperLU."""
    options = {"SymmetricMode": True}
    return sp.linalg.splu(matrix.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)


def _polynomial(precision: Float[np.ndarray, "my mx"], field: Heightfield) -> Sparse:
    """A matrix whose eigenvalues, along the modes of the surface, come near to these ones: a polynomial in the Laplacian.

    Its coefficients are not negative, so that it is positive definite. (1 + length² · Laplacian)^n is met exactly.
    """
    _, frequency = slope_units(precision.shape, field.dx, field.dy)  # half periods in the longer side
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
