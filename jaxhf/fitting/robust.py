"""Robust losses."""

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..core.types import AnyArray
from ..xla.compilation import compiled


def soften(residual: Array, loss: str, scale: Float[Array, ""] | None) -> Array:
    """A residual whose half square is the robust loss ρ of the given one: sign(r) √(2ρ(r)).

    With k the scale, in standard deviations. huber: quadratic up to k, then linear (Huber 1964); cauchy: k²/2 log(1 + (r/k)²);
    geman: r²/2 / (1 + (r/k)²) (Geman and McClure 1985), which forgets what is far off altogether.
    """
    if loss == "squares" or scale is None:
        return residual
    x = residual / scale
    square = x * x
    if loss == "huber":
        far = square > 1
        size = jnp.sqrt(2 * jnp.where(far, jnp.abs(x), 1) - 1)
        return scale * jnp.where(far, jnp.sign(x) * size, x)
    if loss == "cauchy":
        small = square < 1e-4
        ratio = jnp.log1p(jnp.where(small, 1, square)) / jnp.where(small, 1, square)
        return residual * jnp.sqrt(jnp.where(small, 1 - square / 2, ratio))
    return residual / jnp.sqrt(1 + square)


def robust_weight(residual: Array, loss: str, scale: Float[Array, ""] | None) -> Array:
    """ρ'(r) / r: the weight that a residual has in iteratively reweighted least squares."""
    if loss == "squares" or scale is None:
        return jnp.ones_like(residual)
    square = (residual / scale) ** 2
    if loss == "huber":
        return 1 / jnp.sqrt(jnp.maximum(square, 1))
    return 1 / (1 + square) if loss == "cauchy" else 1 / (1 + square) ** 2


@functools.partial(compiled, static_argnames=("loss",))
def influence_function(
    residual: Float[AnyArray, " n"], loss: str, scale: Float[Array, ""] | None
) -> tuple[Float[Array, " n"], Float[Array, " n"], Float[Array, " n"]]:
    """ψ = ρ', its derivative, and the weight ψ / r of residuals."""

    def psi(residual: Array) -> Array:
        return robust_weight(residual, loss, scale) * residual

    values, slope = jax.jvp(psi, (residual,), (jnp.ones_like(residual),))
    return values, slope, robust_weight(residual, loss, scale)
