"""What the scheme of the normals at vertices changes in the pictures of a fit."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..core.compilation import compiled
from ..core.types import AnyArray
from ..trace.normals import vertex_normals
from .problem import Problem


def share_of_normals(problem: Problem, heights: Float[AnyArray, "ny nx"]) -> float:
    """By about how much pictures change, in units of the noise, as normals are weighted by angle, not by area: the horizontal
    part of what they turn by times the pictures' brightness; 0 where the settings are not the default ones."""
    if problem.settings.normals not in (None, "six") or problem.settings.shading != "smooth":
        return 0.0
    field = problem.groups[0].shared.heightfields[0]
    horizontal = _turned_normals(jnp.asarray(heights), field.dx, field.dy)[..., :2]
    return float(np.sqrt(np.mean(np.square(horizontal))) * np.median(problem.brightness / problem.noise))


@functools.partial(compiled, static_argnames=("dx", "dy"))
def _turned_normals(heights: Float[jax.Array, "ny nx"], dx: float, dy: float) -> Float[jax.Array, "ny nx 3"]:
    """By what unit normals differ that are weighted by angle from those by area."""
    area, angle = (vertex_normals(heights, dx, dy, scheme) for scheme in ("six", "six-angle"))
    return angle - area / jnp.linalg.norm(area, axis=-1, keepdims=True)
