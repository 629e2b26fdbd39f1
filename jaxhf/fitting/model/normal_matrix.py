"""The normal matrix H = JᵀJ of all residuals about some unknowns, and random draws from N(0, H⁻¹)."""

import copy
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
import scipy.fft
import scipy.ndimage
import scipy.sparse.linalg
from jaxtyping import Float

from .expansion import Expansion, surface_of
from .surface import Unknowns, Window

linalg: Any = scipy.sparse.linalg  # whose stubs miss much
fft: Any = scipy.fft
Flat = Float[np.ndarray, " n"]
MOST_OTHERS = 64
"""Unknowns besides heights whose columns of J are kept, and that are eliminated."""
_MOST_ITERATIONS = 300


class Residuals(NamedTuple):
    """A number for each residual: of the pictures, of the modes of the surface's prior, and of the other priors."""

    pictures: Float[np.ndarray, " rows"]
    modes: Float[np.ndarray, "my mx"]
    others: Float[np.ndarray, " k"]


class NormalMatrix:
    """H as products with it, on the host and in double precision but for those with J where that has no rows.

    Vectors are flat: the heights of the padded surface, and then the other unknowns' numbers.

    Attributes:
      inverse: times which vectors are about H⁻¹ times them; at first by the modes' units, in which H is about the unit matrix.

    Args:
      expansion: all of whose modes are varied.
      roots: of the weights of the pictures' residuals, flat as `in_row`.
      rows: `pictures_by_heights` there, with which products take a tenth of the time; None: by JAX.
      window: whose `part_by_heights` rows and roots are: all else counts as known.
    """

    def __init__(self, expansion: Expansion, roots: Float[np.ndarray, " rows"], rows: Any = None, window: Window | None = None):
        self.expansion, self.roots, self.rows = expansion, roots, rows
        self.inverse: Callable[[Flat], Flat] = self._by_modes
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
        result[: surface.size] += self._prior_pull(self._prior_push(surface)).ravel()
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
        product, near = (linalg.LinearOperator((n, n), f, dtype=np.float64) for f in (self.product, self.inverse))
        return linalg.cg(product, right, begin, rtol=tolerance, maxiter=_MOST_ITERATIONS, M=near)[0]

    def gradient(self, pictures: Float[np.ndarray, " rows"]) -> Flat:
        """Of half the squares of all residuals: those of the pictures are given, times the roots, those of the priors known."""
        return self.gathered(Residuals(pictures, self._prior_push(self.off), self.others_off))

    def gathered(self, residuals: Residuals) -> Flat:
        """Jᵀ times a number for each residual."""
        result = self._pulled(residuals.pictures * self.roots)
        result[: residuals.modes.size] += self._prior_pull(residuals.modes).ravel()
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
        return self._prior_push(self.split(x)[0])

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
        count = int(np.prod(self.shape))
        return x[:count].reshape(self.shape), x[count:]

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
