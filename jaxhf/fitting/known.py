"""The pictures of a fit that are known, with their derivatives, by the unknowns that they belong to."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from . import residuals
from .basis import Unknowns
from .jacobian import Sparse, images_jacobian, in_rows, picture_values
from .problem import Problem
from .quadratic import is_sparse
from .residuals import heights_of, linearised


@dataclasses.dataclass
class Known:
    """Linearised pictures.

    Attributes:
      place: of the unknowns that they belong to, see `place_of`.
      linearised: see `Problem.linearised`.
      images: the pictures as they would be measured, see `simulate`, once they were asked for.
      jacobian: their derivative as a sparse matrix, once it was asked for.
    """

    place: list[np.ndarray]
    linearised: Any
    images: list[jax.Array] | None = None
    jacobian: Sparse | None = None

    def is_at(self, place: Sequence[np.ndarray]) -> bool:
        return all(map(np.array_equal, self.place, place))


def place_of(unknowns: Unknowns, problem: Problem) -> list[np.ndarray]:
    """The heights and the other unknowns, on which pictures depend; not how the heights are made of modes."""
    others = eqx.tree_at(lambda u: u.coefficients, unknowns, None, is_leaf=lambda leaf: leaf is None)
    return [np.asarray(heights_of(unknowns, problem.basis)), *map(np.asarray, jax.tree.leaves(others))]


class KnownPictures:
    """Those of the unknowns that were asked for last, and of the best ones, so that no surface is rendered twice."""

    def __init__(self):
        self.kept: list[Known] = []

    def at(self, unknowns: Unknowns, problem: Problem, best: Unknowns) -> Known:
        """The pictures at `unknowns`; from now on they are kept, and of the others only those at `best`."""
        here, there = place_of(unknowns, problem), place_of(best, problem)
        found = next((known for known in self.kept if known.is_at(here)), None)
        if found is None:
            found = Known(here, linearised(unknowns, problem).linearised)
        self.kept = [found, *(known for known in self.kept if known is not found and known.is_at(there))]
        return found


def jacobian_at(unknowns: Unknowns, problem: Problem, known: Known) -> Sparse:
    """The `images_jacobian`, kept with the pictures."""
    if known.jacobian is None:
        known.jacobian = images_jacobian(unknowns, dataclasses.replace(problem, linearised=known.linearised))
    return known.jacobian


def pictures_and_influence(
    unknowns: Unknowns, problem: Problem, key: int, known: Known
) -> tuple[list[jax.Array], Float[np.ndarray, "ny nx"]]:
    """See `residuals.pictures_and_influence`; by the `images_jacobian` where there can be one."""
    problem = dataclasses.replace(problem, linearised=known.linearised)
    if not is_sparse(problem):
        pictures, influence = residuals.pictures_and_influence(unknowns, problem, key)
        return pictures, np.asarray(influence)
    weights = in_rows([group.weights for group in problem.groups])
    draw = weights * np.random.default_rng(key).standard_normal(weights.size)
    shape = problem.basis.crop(np.asarray(problem.basis.base)).shape
    if known.images is None:
        known.images = picture_values(unknowns, problem).images
    return known.images, (jacobian_at(unknowns, problem, known).T @ draw).reshape(shape)
