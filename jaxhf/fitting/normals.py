"""What the scheme of the normals at vertices changes in the pictures of a fit."""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..core.types import AnyArray
from ..scene.heightfield import Heightfield
from ..trace.normals import vertex_normals
from ..xla.compilation import compiled
from .jacobian import group_by_vertices, in_rows
from .problem import Problem

_BLOCK = 8  # pixels


def share_of_normals(problem: Problem, heights: Float[AnyArray, "ny nx"]) -> float:
    """By about how much pictures change, in units of the noise, as normals are weighted by angle, not by area: the horizontal
    part of what they turn by times the pictures' brightness; 0 where the settings are not the default ones."""
    settings = problem.found_settings
    if settings.normals not in (None, "six") or settings.shading != "smooth":
        return 0.0
    horizontal = _turned(problem, heights)[0][..., :2]
    return float(np.sqrt(np.mean(np.square(horizontal))) * np.median(problem.brightness / problem.noise))


def evidence_for_angles(problem: Problem, heights: Float[AnyArray, "ny nx"], left: Float[np.ndarray, " rows"]) -> float:
    """What the pictures say for normals weighted by angle in place of area: about N(0, 1) where these explain nothing.

    It is the product of what is left of the pictures with their change by such normals, to first order, over its standard
    deviation. Heights that were fitted make up for a part of it, never for more than all.

    Args:
      problem: `linearised`, with smooth shading.
      heights: at which it is.
      left: picture - target in units of the noise, in the order of `in_rows`.
    """
    turned, lengths = _turned(problem, heights)
    turned = np.pad(turned * lengths, ((0, 0), (0, 0), (1, 0)))  # heights stay
    changes = []
    for number, group in enumerate(problem.groups):
        shapes = [
            obj.shape.heights.shape[-2:]
            for obj in group.complete(group.scenes, heights).objects
            if isinstance(obj.shape, Heightfield)
        ]
        parts = [turned.ravel() if shape == turned.shape[:2] else np.zeros(4 * math.prod(shape)) for shape in shapes]
        change = np.concatenate(parts)
        changes += group_by_vertices(problem, number, heights, change)
    change = in_rows([group.weights for group in problem.groups]) * np.concatenate(changes)
    return deviations_above_zero(-change * left, problem)


def deviations_above_zero(values: Float[np.ndarray, " rows"], problem: Problem) -> float:
    """The sum of values, one for each of the pictures', over its standard deviation by the sums over blocks of 8 x 8 pixels.

    So values may hang together nearby, as what is left does where light, prior or scale are off (clustered standard errors:
    Liang and Zeger, Longitudinal data analysis using generalized linear models, Biometrika 73, 1986).
    """
    sums, first = [], 0
    for group in problem.groups:
        n, h, w, c = group.targets.shape
        here = values[first : first + n * h * w * c].reshape(n * c, h, w)
        first += here.size
        rows = np.add.reduceat(here, np.arange(0, h, _BLOCK), axis=1)
        sums.append(np.add.reduceat(rows, np.arange(0, w, _BLOCK), axis=2).ravel())
    blocks = np.concatenate(sums)
    size = math.sqrt(blocks @ blocks)
    return float(np.sum(blocks) / size) if size else 0.0


def _turned(problem: Problem, heights: Float[AnyArray, "ny nx"]) -> tuple[np.ndarray, np.ndarray]:
    """By what unit normals differ that are weighted by angle from those by area, and the lengths of the latter."""
    field = problem.groups[0].shared.heightfields[0]
    area, angle = (np.asarray(normals, np.float64) for normals in _by_area_and_angle(jnp.asarray(heights), field.dx, field.dy))
    lengths = np.linalg.norm(area, axis=-1, keepdims=True)
    return angle - area / lengths, lengths


@functools.partial(compiled, static_argnames=("dx", "dy"))
def _by_area_and_angle(heights: Float[jax.Array, "ny nx"], dx: float, dy: float) -> list[Float[jax.Array, "ny nx 3"]]:
    return [vertex_normals(heights, dx, dy, scheme) for scheme in ("six", "six-angle")]
