"""Levenberg-Marquardt steps by the normal equations, where the pictures' derivative is a sparse matrix."""

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse.linalg
from jaxtyping import Array, Float

from . import solvers
from .basis import Basis, Unknowns
from .jacobian import Sparse, picture_values, sp
from .problem import Problem
from .quadratic import Quadratic, fft, loss_at, surface
from .solvers import FIRST_DAMPING, GOOD, HIGHER, LEAST_GAIN, REJECTED, Outcome

_TOLERANCE = 1e-4  # of the residual of a step's linear problem
_ITERATIONS = 5  # times those of LSMR: each is two cosine transforms and a product with a small matrix


@dataclasses.dataclass(frozen=True)
class NormalEquations:
    """As `LevenbergMarquardt` decides on steps and on λ, but (JᵀJ + λ) d = -Jᵀr is solved on the host, in double precision.

    JᵀJ is formed once for an accepted step. Conjugate gradients in the modes of the basis then take 300 iterations in the time
    of a few of LSMR's, and need no program to be compiled.

    Attributes:
      tolerance: of unknowns and loss, see `Outcome.converged`.
      inner_steps: see `fit`.
      rejections: how many of the steps before were rejected in a row.
      jacobian: gives the `images_jacobian` where the step is evaluated; called if the step is accepted.
    """

    tolerance: float
    inner_steps: int
    rejections: int = 0
    jacobian: Callable[[], Sparse] | None = None

    @np.errstate(over="ignore", invalid="ignore")  # a fit says by itself that a loss is not finite
    def advance(self, unknowns: Unknowns, state: "Position", problem: Problem) -> tuple[Unknowns, "Position", Outcome]:
        """See `solvers.advance`."""
        assert self.jacobian is not None
        new, size, model = state.y_eval, float(state.step_size), state.model
        values = picture_values(new, problem)
        loss, before = loss_at(new, problem, values), state.loss
        first, moved, converged = model is None, 0.0, False
        accepted = first or before - loss >= LEAST_GAIN * state.predicted
        if model is None or accepted:
            if not first:
                moved = _rms(surface(new, problem) - surface(unknowns, problem))
                converged = self._converged(unknowns, new, before, loss)
                if before - loss >= GOOD * state.predicted:
                    size *= HIGHER
            unknowns, model = new, Quadratic(new, problem, self.jacobian(), values)
        else:
            size, loss = size * REJECTED / 2**self.rejections, before
        step, predicted = _solved(model, problem.basis, 1 / size, _ITERATIONS * self.inner_steps)
        dtype = unknowns.coefficients.dtype
        state = Position(_moved(unknowns, step), jnp.asarray(size, dtype), loss, predicted, model)
        number: Any = np.asarray
        outcome = Outcome(
            number(loss), number(accepted), number(converged), number(predicted), number(1 / size), number(moved), unknowns
        )
        return unknowns, state, outcome

    def _converged(self, old: Unknowns, new: Unknowns, before: float, loss: float) -> bool:
        """Whether unknowns and loss changed by less than the tolerance, of themselves and of 1."""
        a, b = (np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(unknowns)]) for unknowns in (old, new))
        return bool(_rms((b - a) / (1 + np.abs(b))) < self.tolerance and abs(before - loss) < self.tolerance * (1 + abs(loss)))


@dataclasses.dataclass(frozen=True)
class Position:
    """Where such a fit stands.

    Attributes:
      y_eval: at which the next step evaluates the pictures.
      step_size: 1 / λ.
      loss: at the last accepted unknowns.
      predicted: by how much the model lowers it at `y_eval`.
      model: of the loss about them; None: nothing was evaluated, so the next step is accepted.
    """

    y_eval: Unknowns
    step_size: Float[Array, ""]
    loss: float = math.inf
    predicted: float = 0.0
    model: Quadratic | None = None


def init_state(solver: Any, unknowns: Unknowns, problem: Problem) -> Any:
    """See `solvers.init_state`."""
    if isinstance(solver, NormalEquations):
        return Position(unknowns, jnp.asarray(1 / FIRST_DAMPING, unknowns.coefficients.dtype))
    return solvers.init_state(solver, unknowns, problem)


def reset_state(initial: Any, unknowns: Unknowns, step_size: Float[Array, ""] | None) -> Any:
    """See `solvers.reset_state`."""
    if isinstance(initial, Position):
        return dataclasses.replace(initial, y_eval=unknowns, step_size=step_size)
    return solvers.reset_state(initial, unknowns, step_size)


def advance(solver: Any, unknowns: Unknowns, state: Any, problem: Problem) -> tuple[Unknowns, Any, Outcome]:
    """See `solvers.advance`."""
    if isinstance(solver, NormalEquations):
        return solver.advance(unknowns, state, problem)
    return solvers.advance(solver, unknowns, state, problem)


def with_rejections(solver: Any, rejections: int, jacobian: Callable[[], Sparse]) -> Any:
    """See `solvers.with_rejections` and `NormalEquations`."""
    if isinstance(solver, NormalEquations):
        return dataclasses.replace(solver, rejections=rejections, jacobian=jacobian)
    return solvers.with_rejections(solver, rejections)


def has_damping(state: Any) -> bool:
    """Whether this is a state of Levenberg-Marquardt, in which rejected steps raise a λ."""
    return isinstance(state, Position) or hasattr(state, "num_steps_since_acceptance")


def step_size(state: Any) -> Float[Array, ""]:
    """1 / λ of a state that `has_damping`."""
    return state.step_size if isinstance(state, Position) else state.search_state.step_size


def _solved(model: Quadratic, basis: Basis, damping: float, iterations: int) -> tuple[Float[np.ndarray, " n"], float]:
    """The change of coefficients and of the other unknowns that minimises the damped model, and by how much it lowers that
    without the damping."""
    scale = np.asarray(basis.scale, np.float64)

    def spread(change: np.ndarray) -> np.ndarray:
        heights = fft.idctn(scale * change[: scale.size].reshape(scale.shape), norm="ortho")
        return np.concatenate([heights.ravel(), change[scale.size :]])

    def gathered(values: np.ndarray) -> np.ndarray:
        modes = scale * fft.dctn(values[: scale.size].reshape(scale.shape), norm="ortho")
        return np.concatenate([modes.ravel(), values[scale.size :]])

    n, right = model.gradient.size, -gathered(model.gradient)
    if not math.isfinite(right @ right):
        return np.full(n, np.nan), math.nan
    product: Any = sp.linalg.LinearOperator(
        (n, n), lambda change: gathered(model.product(spread(change))) + damping * change, dtype=np.float64
    )
    step = scipy.sparse.linalg.cg(product, right, rtol=_TOLERANCE, maxiter=iterations)[0]
    change = spread(step)
    return step, float(-(model.gradient @ change + change @ model.product(change) / 2))


def _moved(unknowns: Unknowns, step: Float[np.ndarray, " n"]) -> Unknowns:
    """The unknowns after a step, number by number."""
    leaves, structure = jax.tree.flatten(unknowns)
    ends = np.cumsum([leaf.size for leaf in leaves])[:-1]
    parts = zip(leaves, np.split(step, ends), strict=True)
    changed = [np.asarray(leaf, np.float64) + part.reshape(leaf.shape) for leaf, part in parts]
    return jax.tree.unflatten(structure, [jnp.asarray(new, leaf.dtype) for new, leaf in zip(changed, leaves, strict=True)])


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values, dtype=np.float64))))
