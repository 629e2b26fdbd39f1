"""The normal matrix H = JᵀJ of all residuals about some unknowns, random draws from N(0, H⁻¹), and what about inverts it:
factors of a sparse matrix near to it, or of its blocks."""

import copy
import itertools
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
import scipy.fft
import scipy.ndimage
import scipy.optimize
import scipy.sparse
import scipy.sparse.linalg
from jaxtyping import Float

from ...scene.heightfield import Heightfield
from .expansion import Expansion, influence_function
from .problem import surface_of
from .rows import THREADS, Sparse, pictures_by_heights, scaled
from .unknowns import Unknowns, Window, interpolation, slope_units

sp: Any = scipy.sparse  # whose stubs miss much
fft: Any = scipy.fft
Flat = Float[np.ndarray, " n"]
MOST_OTHERS = 64
"""Unknowns besides heights whose columns of J are kept, and that are eliminated."""
_MOST_ITERATIONS = 300
_PROBES = 8  # of the curvature of other unknowns, where they are more
_DEGREE = 3  # of the polynomial in the Laplacian that stands for a prior
_FACTORED = 2**15  # heights, with their padding, whose matrix is factorised at once
_BLOCK, _BEYOND = 32, 4  # heights a side of a block of more, and by how many it reaches into its neighbours
_COARSER = 4  # times wider the cells of the coarse grid that joins the blocks


class Residuals(NamedTuple):
    """A number for each residual: of the pictures, of the modes of the surface's prior, and of the other priors."""

    pictures: Float[np.ndarray, " rows"]
    modes: Float[np.ndarray, "my mx"]
    others: Float[np.ndarray, " k"]


class NormalMatrix:
    """H as products with it, on the host and in double precision but for those with J where that has no rows.

    Vectors are flat: the heights of the padded surface, and then the other unknowns' numbers.

    Attributes:
      inverse: times which vectors are about H⁻¹ times them: `_near_inverse` or, without rows, by the modes' units, in which H
        is about the unit matrix.

    Args:
      expansion: all of whose modes are varied.
      roots: of the weights of the pictures' residuals, flat as `in_row`.
      rows: `pictures_by_heights` there, with which products take a tenth of the time; None: by JAX.
      window: whose `part_by_heights` rows and roots are: all else counts as known.
    """

    def __init__(self, expansion: Expansion, roots: Float[np.ndarray, " rows"], rows: Any = None, window: Window | None = None):
        self.expansion, self.roots, self.rows = expansion, roots, rows
        unknowns, basis, terms = expansion.unknowns, expansion.problem.basis, expansion.problem.terms

        def here(values: Any) -> Float[np.ndarray, "..."]:
            values = np.asarray(values, np.float64)
            return values if window is None or values.ndim == 0 else basis.crop(values)[window.place]

        self.weight, self.free = here(terms.surface.weight), here(1.0 if basis.free is None else basis.free)
        self.off = here(surface_of(unknowns, basis)) - here(terms.surface.mean)
        self.spectrum = np.asarray(terms.surface.spectrum, np.float64)
        self.shape, self.dtype = self.off.shape, unknowns.coefficients.dtype
        self.inside = np.asarray(basis.crop(np.arange(self.off.size).reshape(self.shape))).ravel()
        sought, besides = unknowns.without_modes(), terms.others(unknowns)
        if window is not None:
            # That of a part of a terrain has the density of the whole one's modes.
            at = [np.arange(n) * (m / n) for n, m in zip(self.shape, self.spectrum.shape, strict=True)]
            at = np.meshgrid(*at, indexing="ij")
            self.spectrum = scipy.ndimage.map_coordinates(self.spectrum, at, order=1, mode="nearest")
            self.inside, sought, besides = np.arange(self.off.size), (), []
        others, self.unflat = jax.flatten_util.ravel_pytree(sought)
        self.others_weight = in_row([np.broadcast_to(np.asarray(term.weight), values.shape) for term, values in besides])
        self.others_off = in_row([np.asarray(term.residual(values)) for term, values in besides])
        self.size, self.columns = self.off.size + others.size, None
        if rows is not None and others.size <= MOST_OTHERS:
            each = [self._by_jax(np.zeros(self.shape), one) for one in np.eye(others.size)]
            self.columns = np.reshape(each, (others.size, roots.size)).T
        self.inverse: Callable[[Flat], Flat] = self._by_modes if rows is None else _near_inverse(self)

    def weighted(self, roots: Float[np.ndarray, " rows"], widths: Float[np.ndarray, "my mx"]) -> "NormalMatrix":
        """The matrix with other roots, and a prior of the surface whose modes have deviations that are so many times as
        large."""
        other = copy.copy(self)
        other.roots, other.spectrum = roots, self.spectrum / widths
        return other

    def product(self, x: Flat) -> Flat:
        """H x."""
        surface, others = self.split(x)
        result = self._pulled(self.seen(x) * self.roots)
        result[: surface.size] += (self.free * self._prior_pull(self._prior_push(self.free * surface))).ravel()
        result[surface.size :] += self.others_weight**2 * others
        return result

    def seen(self, x: Flat) -> Float[np.ndarray, " rows"]:
        """J x: the change of the pictures, in units of the noise, times the roots."""
        surface, others = self.split(x)
        surface = self.free * surface
        if self.columns is None:
            return self._by_jax(surface, others) * self.roots
        return (self.rows @ surface.ravel()[self.inside] + self.columns @ others) * self.roots

    def _by_jax(self, surface: Float[np.ndarray, "my mx"], others: Float[np.ndarray, " k"]) -> Float[np.ndarray, " rows"]:
        return in_row(self.expansion.push((jnp.asarray(surface, self.dtype), self.unflat(jnp.asarray(others, self.dtype)))))

    def _pulled(self, rows: Float[np.ndarray, " rows"]) -> Flat:
        if self.columns is None:
            surface, others = self.expansion.pull(in_groups(rows.astype(self.dtype), self.expansion))
            others = np.asarray(jax.flatten_util.ravel_pytree(others)[0], np.float64)
            return np.concatenate([(self.free * np.asarray(surface, np.float64)).ravel(), others])
        surface = np.zeros(self.shape)
        surface.ravel()[self.inside] = self.rows.T @ rows
        return np.concatenate([(self.free * surface).ravel(), self.columns.T @ rows])

    def solved(self, right: Flat, tolerance: float, begin: Flat | None = None) -> Flat:
        """H⁻¹ times `right` by conjugate gradients, from `begin` or from 0."""
        n = self.size
        product, near = (sp.linalg.LinearOperator((n, n), f, dtype=np.float64) for f in (self.product, self.inverse))
        return sp.linalg.cg(product, right, begin, rtol=tolerance, maxiter=_MOST_ITERATIONS, M=near)[0]

    def gradient(self, pictures: Float[np.ndarray, " rows"]) -> Flat:
        """Of half the squares of all residuals: those of the pictures are given, times the roots, those of the priors known."""
        return self.gathered(Residuals(pictures, self._prior_push(self.off), self.others_off))

    def gathered(self, residuals: Residuals) -> Flat:
        """Jᵀ times a number for each residual."""
        result = self._pulled(residuals.pictures * self.roots)
        result[: residuals.modes.size] += (self.free * self._prior_pull(residuals.modes)).ravel()
        result[residuals.modes.size :] += self.others_weight * residuals.others
        return result

    def drawn(self, seed: int, widths: float | Float[np.ndarray, "my mx"] = 1.0) -> Residuals:
        """N(0, 1) for each residual, `widths` times as much for the modes of the surface's prior."""
        rng = np.random.default_rng(seed)
        return Residuals(
            rng.standard_normal(self.roots.size),
            rng.standard_normal(self.shape) * widths,
            rng.standard_normal(self.others_weight.size),
        )

    def modes_of(self, x: Flat) -> Float[np.ndarray, "my mx"]:
        """The modes of the surface's prior by which it moves, in units of their deviations."""
        return self._prior_push(self.free * self.split(x)[0])

    def modes_before(self) -> Float[np.ndarray, "my mx"]:
        """By which the surface differs from its prior."""
        return self._prior_push(self.off)

    def heights_of(self, x: Flat) -> Float[np.ndarray, "ny nx"]:
        """The change of the heights, without their padding."""
        return self.expansion.problem.basis.crop(self.free * self.split(x)[0])

    def unknowns_of(self, x: Flat) -> Unknowns:
        """The change of the unknowns."""
        surface, others = self.split(x)
        modes = fft.dctn(self.free * surface, norm="ortho") / np.asarray(self.expansion.problem.basis.scale, np.float64)
        return self.unflat(jnp.asarray(others, self.dtype)).with_modes(jnp.asarray(modes, self.dtype))

    def split(self, x: Flat) -> tuple[Float[np.ndarray, "my mx"], Float[np.ndarray, " k"]]:
        return x[: self.off.size].reshape(self.shape), x[self.off.size :]

    def _prior_push(self, surface: Float[np.ndarray, "my mx"]) -> Float[np.ndarray, "my mx"]:
        return self.spectrum * fft.dctn(self.weight * surface, norm="ortho")

    def _prior_pull(self, modes: Float[np.ndarray, "my mx"]) -> Float[np.ndarray, "my mx"]:
        return self.weight * fft.idctn(self.spectrum * modes, norm="ortho")

    def _by_modes(self, x: Flat) -> Flat:
        surface, others = self.split(x)
        squares = np.asarray(self.expansion.problem.basis.scale, np.float64) ** 2
        return np.concatenate([fft.idctn(squares * fft.dctn(surface, norm="ortho"), norm="ortho").ravel(), others])


def in_row(rows: Sequence[Any]) -> Float[np.ndarray, " rows"]:
    """All values of all pictures, one after the other."""
    return np.concatenate([np.zeros(0), *(np.asarray(part, np.float64).ravel() for part in rows)])


def in_groups(row: np.ndarray, expansion: Expansion) -> list[Any]:
    """The inverse of `in_row`."""
    shapes = [group.targets.shape for group in expansion.problem.groups]
    ends = np.cumsum([int(np.prod(shape)) for shape in shapes])[:-1]
    return [jnp.asarray(part.reshape(shape)) for part, shape in zip(np.split(row, ends), shapes, strict=True)]


def robust_matrix(expansion: Expansion, left: Float[np.ndarray, " rows"]) -> NormalMatrix:
    """With the weights of the robust loss; `left`: `Expansion.left`, in a row."""
    _, _, weights = influence_function(left, expansion.problem.loss_scale)
    return NormalMatrix(expansion, np.sqrt(weights), pictures_by_heights(expansion))


def _near_inverse(matrix: NormalMatrix) -> Callable[[Flat], Flat]:
    """What about inverts a normal matrix: `_inverse` of that of the heights, in which a polynomial in the Laplacian stands for
    their prior, and the Schur complement of the other unknowns; where these are many, their diagonal.

    With it conjugate gradients take 5 to 15 iterations, where LSMR on J took 300. `matrix`: one that has rows.
    """
    shape, count = matrix.shape, matrix.off.size
    others = matrix.size - count
    weighted = scaled(matrix.rows, matrix.roots)
    weighted = sp.csr_array((weighted.data, matrix.inside[weighted.indices], weighted.indptr), shape=(weighted.shape[0], count))
    weight = sp.diags_array(np.broadcast_to(matrix.weight, shape).ravel())
    precision = np.broadcast_to(matrix.spectrum**2, shape)
    near = weighted.T @ weighted + weight @ _polynomial(precision, matrix.expansion.problem.field) @ weight
    free = np.broadcast_to(matrix.free, shape).ravel()
    near = sp.diags_array(free) @ near @ sp.diags_array(free) + sp.diags_array(1 - free)
    solve = _inverse(near.tocsr(), shape)

    def by_heights(x: Flat) -> Flat:
        return free * solve(free * x)

    if others > MOST_OTHERS:
        draws = [matrix.gathered(matrix.drawn(seed))[count:] for seed in range(_PROBES)]
        diagonal = np.maximum(np.mean(np.square(draws), axis=0), matrix.others_weight**2)
        return lambda x: np.concatenate([by_heights(x[:count]), x[count:] / diagonal])
    columns = [matrix.product(np.eye(1, matrix.size, k)[0]) for k in range(count, matrix.size)]
    columns = np.reshape(columns, (others, matrix.size))
    beside = columns[:, :count].T.copy()
    moved = np.reshape([by_heights(column) for column in beside.T], (others, count)).T.copy()
    schur = columns[:, count:] - beside.T @ moved

    def inverse(x: Flat) -> Flat:
        heights = by_heights(x[:count])
        rest = np.linalg.solve(schur, x[count:] - beside.T @ heights)
        return np.concatenate([heights - moved @ rest, rest])

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
