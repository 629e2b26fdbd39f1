"""The robust loss of the pictures: Geman and McClure's (1985), ρ(r) = r²/2 / (1 + (r/k)²), which forgets what is far off."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from ...core.types import AnyArray
from ...xla.compilation import compiled


def soften(residual: Array, scale: Float[AnyArray, ""]) -> Array:
    """A residual whose half square is ρ of the given one: sign(r) √(2ρ(r)); k = scale, in standard deviations."""
    return residual / jnp.sqrt(1 + (residual / scale) ** 2)


def robust_weight(residual: AnyArray, scale: Float[AnyArray, ""]) -> Array:
    """ρ'(r) / r: the weight that a residual has in iteratively reweighted least squares."""
    return 1 / (1 + (residual / scale) ** 2) ** 2


@compiled
def influence_function(
    residual: Float[AnyArray, " n"], scale: Float[AnyArray, ""]
) -> tuple[Float[Array, " n"], Float[Array, " n"], Float[Array, " n"]]:
    """ψ = ρ', its derivative, and the weight ψ / r of residuals."""
    square = (residual / scale) ** 2
    weight = 1 / (1 + square) ** 2
    return weight * residual, weight * (1 - 3 * square) / (1 + square), weight
