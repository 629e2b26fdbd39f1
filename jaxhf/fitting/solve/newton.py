"""Gauss-Newton steps by factors, with which a fit ends.

Pictures of few samples a pixel change by jumps, and the loss with them. A trust region, which accepts by the loss, stops where
the jumps are lucky, short of the end along all that pictures tell little of. So these steps are judged by the next one, which
must be shorter (Deuflhard's natural monotonicity test, Newton Methods for Nonlinear Problems, 2004, chapters 3 and 4). A
quarter of a step is left where pictures are linear; where more than 0.6 is, it mostly follows jumps, and the fit ends.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..model.expansion import Expansion
from ..model.near_inverse import robust_matrix
from ..model.normal_matrix import in_row
from ..model.robust import soften
from ..model.surface import Unknowns

RELAXED = 0.75  # of a whole step, part of which is made by jumps of the loss
SHORTER = 0.9  # of the step before: a longer one follows jumps alone, and the one before is not accepted
LAST = 0.6  # of the step before: a longer one is mostly made by jumps, and is not taken
_TOLERANCE = 1e-3  # of the linear problem


class WholeStep(NamedTuple):
    """The Gauss-Newton step from where an expansion is: the change of the unknowns, that of the heights, root mean square, by
    how much it would lower the loss, were pictures linear, and the loss where it begins."""

    change: Unknowns
    length: float
    predicted: float
    loss: float


def whole_step(expansion: Expansion) -> WholeStep:
    """`expansion`: one that `has_rows`, all of whose modes are varied."""
    left, matrix = in_row(expansion.left()), robust_matrix(expansion)
    gradient = matrix.gradient(matrix.roots * left)
    change = matrix.solved(-gradient, _TOLERANCE)
    soft = np.asarray(soften(jnp.asarray(left), expansion.problem.loss_scale), np.float64)
    loss = (np.sum(soft**2) + np.sum(matrix.modes_before() ** 2) + np.sum(matrix.others_off**2)) / 2
    length = float(np.sqrt(np.mean(matrix.heights_of(change) ** 2)))
    return WholeStep(matrix.unknowns_of(change), length, float(-(gradient @ change) / 2), float(loss))


def relaxed(unknowns: Unknowns, step: WholeStep) -> Unknowns:
    return jax.tree.map(lambda value, change: value + RELAXED * change, unknowns, step.change)
