"""What is known of the unknowns without the pictures: Gaussian priors, also of the logarithm of an albedo."""

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from ...core.errors import ArgumentError
from ...core.precision import numbers
from ...scene.heightfield import Heightfield
from ..given import Prior, Unknown
from .unknowns import Basis, Unknowns, View, dct_matrix, laplacian, make_heights, pad, padding, slope_units

OCTAVES = 6
"""Into which the modes of the heights' prior are divided, at most."""


class Term(eqx.Module):
    """A Gaussian prior of some numbers: weight · (them - mean) is N(0, 1), or of a surface `spectrum` times the DCT of that.

    Attributes:
      mean: what they are expected to be.
      weight: 1 / their standard deviation. Where errors are correlated: 1 / the standard deviation that is left when each DCT
        coefficient of the errors is divided by its amplitude. 0 where they are held.
      spectrum: of a surface's prior, 1 / the amplitude of each DCT coefficient of the errors over their deviation, shape
        (my, mx).
    """

    mean: Float[Array, "..."]
    weight: Float[Array, "..."]
    spectrum: Float[Array, "my mx"] | Float[Array, ""]

    def residual(self, values: Float[Array, "..."]) -> Float[Array, "..."]:
        """How far these numbers are from what is expected, in standard deviations."""
        return self.weight * (values - self.mean)

    def of_surface(self, coefficients: Float[Array, "my mx"], basis: Basis) -> Float[Array, "my mx"]:
        """The residuals of a surface by its modes."""
        if self.weight.ndim == 0 and basis.free is None:  # then nothing is to be transformed again for each product
            modes = basis.analysis(basis.base - self.mean) + basis.scale * coefficients
            return self.spectrum * (self.weight * modes)
        return self.spectrum * basis.analysis(self.weight * (basis.surface(coefficients) - self.mean))


class Terms(eqx.Module):
    """The `Term` of the surface, and those of what else is sought, as its numbers follow one another in `Unknowns`."""

    surface: Term
    besides: tuple[Term, ...]

    def others(self, unknowns: Unknowns) -> list[tuple[Term, Float[Array, "..."]]]:
        """Those of what is sought besides the surface, each with its numbers."""
        return list(zip(self.besides, jax.tree.leaves(unknowns.without_modes()), strict=True))


class AlbedoField(eqx.Module):
    """Factors of an albedo by the DCT modes of their logarithms, in units of a root mean square of 1 over the terrain.

    So each changes a picture by about as much as a mode of one slope does; see `Basis`.

    Attributes:
      rows, columns: the DCT-II matrices of the two axes, their rows of root mean square 1, shapes (ty, ty) and (tx, tx).
      weight: 1 / the standard deviation of each mode, shape (ty, tx, 1).
    """

    rows: Float[Array, "ty ty"]
    columns: Float[Array, "tx tx"]
    weight: Float[Array, "ty tx 1"]

    def factors(self, modes: Float[Array, "ty tx c"]) -> Float[Array, "ty tx c"]:
        """What the albedo is multiplied by."""
        return jnp.exp(_transformed(self.rows.T, self.columns.T, modes))

    def modes(self, factors: Float[Array, "ty tx c"]) -> Float[Array, "ty tx c"]:
        """The inverse of `factors`."""
        return _transformed(self.rows, self.columns, jnp.log(factors)) / (len(self.rows) * len(self.columns))


def _transformed(rows: Any, columns: Any, values: Float[Array, "ty tx c"]) -> Float[Array, "ty tx c"]:
    return jnp.einsum("ki,ijc,lj->klc", rows, values, columns, precision=lax.Precision.HIGHEST)


def make_albedo_field(shape: tuple[int, ...], spacing: tuple[float, ...], std: float, length: float, dtype: Any) -> AlbedoField:
    """The field of these texels or vertices, of spacing (y, x), whose logarithm has this deviation and the correlation
    exp(-distance / length).

    That is Matérn's of smoothness 1/2, as patches with sharp borders have it; heights are smoother. The amplitudes of its modes
    go as (1 + (length · frequency)²)^(-3/4).
    """
    amplitude = (1 + length**2 * laplacian(shape, spacing)) ** -0.75
    amplitude = std * amplitude / np.sqrt(np.sum(amplitude**2))  # the squares of all modes add up to the field's variance
    rows, columns = (jnp.asarray(np.sqrt(n) * dct_matrix(n), dtype) for n in shape)
    return AlbedoField(rows, columns, jnp.asarray(1 / amplitude[:, :, None], dtype))


def make_terms(
    field: Heightfield,
    prior: Prior | None,
    unknown: Unknown,
    start: Float[np.ndarray, "my mx"],
    counts: Float[np.ndarray, "my mx"] | None,
    view_unit: View,
    albedo: AlbedoField | None,
) -> Terms:
    """The priors of a fit from `start`, which is padded; `counts`: 0 where heights are held whose errors tell of no others,
    else 1; `view_unit` and `albedo` are `Problem`'s.

    Factors have their mean 1, offsets 0, and what else is not told the deviation 1.
    """
    dtype = field.heights.dtype
    one, none = jnp.ones((), dtype), jnp.zeros((), dtype)

    def term(mean: Array, weight: Array) -> Term:
        return Term(mean, weight, one)

    surface = _shape_term(field, start) if prior is None else _prior_term(field, prior)
    if counts is not None:
        surface = eqx.tree_at(lambda term: term.weight, surface, surface.weight * jnp.asarray(counts, dtype))
    others = []
    if unknown.albedo is not None:
        others.append(term(one, one / unknown.albedo_std) if albedo is None else term(none, albedo.weight))
    if unknown.exposures:
        others.append(term(one, one))
    if unknown.offsets:
        others.append(term(none, one))
    if view_unit.light is not None and unknown.light_std is not None:
        others.append(term(none, (view_unit.light / math.radians(unknown.light_std))[None]))
    if view_unit.camera is not None and unknown.camera_std is not None:
        position, rotation = unknown.camera_std
        deviations = np.array([position] * 3 + [math.radians(rotation)] * 3, dtype)
        others.append(term(none, (view_unit.camera / deviations)[None]))
    if view_unit.sky is not None and unknown.sky_std is not None:
        others.append(term(none, (view_unit.sky / unknown.sky_std)[None]))
    if view_unit.material is not None:  # whose unit is its deviation
        others.append(term(none, one))
    return Terms(surface, tuple(others))


def _shape_term(field: Heightfield, start: Float[np.ndarray, "my mx"]) -> Term:
    """Where nothing is known: modes about the start whose amplitudes fall as 1 / frequency², the longest a quarter of the
    terrain high. A mode that no picture shows, such as the mean of all heights, then has a large deviation, not an infinite
    one."""
    units, frequency = slope_units(start.shape, field.dx, field.dy)
    dtype = field.heights.dtype
    return Term(jnp.asarray(start, dtype), jnp.ones((), dtype), jnp.asarray((1 + frequency) / units, dtype))


def prior_std(field: Heightfield, prior: Prior) -> Float[np.ndarray, "..."]:
    """The deviations of a prior, () or (ny, nx); ArgumentError where they do not belong to the heights."""
    shape, std = field.heights.shape, np.asarray(numbers(prior.std), np.float64)
    if std.shape not in ((), shape):
        raise ArgumentError("Prior", "std", f"must be a number or of shape {shape}, as the heights; its shape is {std.shape}")
    return std


def _prior_term(field: Heightfield, prior: Prior) -> Term:
    shape, dtype, std = field.heights.shape, field.heights.dtype, prior_std(field, prior)
    if prior.length is not None:
        _require_plausible(field, prior.length)
    border = padding(field, prior.length)
    mean = pad(make_heights("Prior", "heights", prior.heights, field), border)
    with np.errstate(divide="ignore"):
        weight = np.where(std > 0, 1 / std, 0)
    spectrum = np.ones(mean.shape)
    if prior.length is not None:
        spectrum = 1 + prior.length**2 * laplacian(mean.shape, (field.dy, field.dx))  # Whittle's
        rows, columns = (dct_matrix(n) ** 2 for n in mean.shape)
        weight = pad(np.broadcast_to(weight, shape), border) * np.sqrt(rows.T @ spectrum**-2 @ columns)
    return Term(*(jnp.asarray(values, dtype) for values in (mean, weight, spectrum)))


def _require_plausible(field: Heightfield, length: float) -> None:
    """Refuses a correlation length that no terrain of this size and spacing can show, such as one in cells."""
    cell = min(field.dx, field.dy)
    side = max((n - 1) * d for n, d in zip(field.heights.shape, (field.dy, field.dx), strict=True))
    if not cell * (1 - 1e-6) <= length <= side * (1 + 1e-6):
        raise ArgumentError(
            "Prior",
            "length",
            f"must lie from one cell to the terrain's longer side, {cell:.6g} to {side:.6g}; it is {length:.6g}, or "
            f"{length / cell:.3g} cells. It is in the unit of dx and dy: {length:.6g} cells would be {length * cell:.6g}",
        )


def by_mode(widths: Float[np.ndarray, " octaves"], shape: tuple[int, ...]) -> Float[np.ndarray, "my mx"]:
    """The width of each mode: between octaves the logarithm goes straight over that of the frequency."""
    return np.exp(np.tensordot(np.log(widths), octaves(shape), 1))


def octaves(shape: tuple[int, ...]) -> Float[np.ndarray, "octaves my mx"]:
    """How much of each mode belongs to each octave of frequencies, the first being that below the highest along an axis."""
    y, x = (np.arange(n) / n for n in shape)
    at = np.clip(-np.log2(np.maximum(np.hypot(y[:, None], x[None, :]), 1e-9)) - 0.5, 0, OCTAVES - 1)
    return np.maximum(1 - np.abs(at - np.arange(OCTAVES)[:, None, None]), 0)
