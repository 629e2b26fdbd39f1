"""The solvers, all of them optimistix's, behind one step function that is compiled once."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp
import lineax as lx
import optax
import optimistix as optx
from jaxtyping import Array, Float

from ..core.types import Flag, Scalar
from ..xla.devices import on_every_device
from .basis import Unknowns
from .options import FitOptions
from .problem import Problem
from .residuals import half_squares, linearised, residuals

# BFGS keeps a dense matrix of this many rows at most: 128 MiB in double precision.
BFGS_UNKNOWNS = 4096
FIRST_DAMPING = 1e-2  # as a share of the loss's curvature along a mode
REJECTED = 0.1  # by which 1 / λ is multiplied at a rejected step, the first in a row
LEAST_GAIN = 0.01  # of what was predicted: a step that lowers the loss by less is rejected
GOOD = 0.75  # of it: after a step that lowers the loss by more, 1 / λ is multiplied by HIGHER
HIGHER = 4.0
# Of LSMR, as a share of the matrix's Frobenius norm. That is far above what a height changes that no picture shows: where a
# prior is to say how high it is, such heights wandered off with 1e-3, and came back over twice as many steps as with 1e-4.
_INNER_TOLERANCE = 1e-3
_INNER_TOLERANCE_WITH_PRIOR = 1e-4
DEFAULT_TOLERANCE = 1e-4
_RATE = 0.02  # of Adam, in the units of the unknowns


class _Damped(optx.DampedNewtonDescent):
    """The step argmin |J d - r|² + λ |d|², by the equal problem argmin |√s J d - √s r|² + |d|², s = 1 / λ the step size.

    Given s itself, optimistix takes no step at all where s is below the precision's epsilon: in single precision from λ = 8e6
    on. A fit of rough terrain with shadows begins its last stages there, and took steps of zero for convergence.
    """

    def step(self, step_size: Scalar, state: Any) -> Any:
        root = jnp.sqrt(step_size)
        scaled = optx.FunctionInfo.ResidualJac(jax.tree.map(lambda r: root * r, state.f_info.residual), state.f_info.jac * root)
        return super().step(jnp.ones_like(step_size), eqx.tree_at(lambda state: state.f_info, state, scaled))


class LevenbergMarquardt(optx.AbstractGaussNewton):
    """Damped Gauss-Newton steps (Levenberg 1944, Marquardt 1963), each solved without a dense matrix.

    optimistix's own class is the same with a dense QR decomposition, and lowers the damping only where a step did at
    least 99 % of what was predicted, which a picture with shadows hardly ever lets it.
    """

    rtol: float
    atol: float
    norm: Callable[..., Any]
    descent: Any
    search: Any
    verbose: Callable[..., None]

    def __init__(self, tolerance: float, inner_steps: int, prior: bool):
        inner_tolerance = _INNER_TOLERANCE_WITH_PRIOR if prior else _INNER_TOLERANCE
        self.rtol = self.atol = tolerance
        self.norm = optx.rms_norm
        # LSMR (Fong and Saunders 2011) works on J itself; conjugate gradients on JᵀJ, whose condition is squared, went
        # non-finite in single precision. Its limit on the condition is lifted: the damping bounds it.
        self.descent = _Damped(linear_solver=lx.LSMR(rtol=inner_tolerance, atol=0.0, max_steps=inner_steps, conlim=1e16))
        self.search = optx.ClassicalTrustRegion(
            high_cutoff=GOOD, low_cutoff=LEAST_GAIN, high_constant=HIGHER, low_constant=REJECTED
        )
        self.verbose = _silent


class BFGS(optx.AbstractBFGS):
    """Broyden, Fletcher, Goldfarb and Shanno's method, from a multiple of the identity that the first step has measured.

    That is Nocedal and Wright, Numerical optimization (2006), (6.20). optimistix's own class stays with the identity, which
    is a few thousand times too large here: nearly all of its evaluations were halvings of steps.
    """

    rtol: float
    atol: float
    norm: Callable[..., Any]
    use_inverse: bool
    descent: Any
    search: Any
    verbose: Callable[..., None]

    def __init__(self, tolerance: float):
        self.rtol = self.atol = tolerance
        self.norm = optx.rms_norm
        self.use_inverse = True
        self.descent = optx.NewtonDescent()
        self.search = optx.BacktrackingArmijo()
        self.verbose = _silent

    def init_hessian(self, y: Any, f: Any, grad: Any) -> tuple[Any, Any]:
        return super().init_hessian(y, f, grad)[0], jnp.asarray(True)

    def update_hessian(self, y: Any, y_eval: Any, f_info: Any, f_eval_info: Any, hessian_update_state: Any) -> tuple[Any, Any]:
        step, change = (
            jax.flatten_util.ravel_pytree(after)[0] - jax.flatten_util.ravel_pytree(before)[0]
            for after, before in ((y_eval, y), (f_eval_info.grad, f_info.grad))
        )
        along = (step * change).sum()
        curved = along > jnp.finfo(step.dtype).eps
        first = hessian_update_state & curved
        factor = jnp.where(first, along / jnp.where(first, (change * change).sum(), 1), 1)
        scaled = eqx.tree_at(
            lambda info: info.hessian_inv, f_info, jax.tree.map(lambda leaf: factor * leaf, f_info.hessian_inv)
        )
        return super().update_hessian(y, y_eval, scaled, f_eval_info, None)[0], hessian_update_state & ~curved


def with_rejections(solver: Any, rejections: int) -> Any:
    """The solver for the next step after so many rejections in a row: each raises λ by twice the factor of the one before.

    (Nielsen, Damping parameter in Marquardt's method, 1999.) Solvers without a λ stay as they are.
    """
    if not isinstance(solver, LevenbergMarquardt):
        return solver
    return eqx.tree_at(lambda solver: solver.search.low_constant, solver, jnp.asarray(REJECTED / 2**rejections))


def _silent(**_: Any) -> None:
    pass


class Outcome(NamedTuple):
    """What one step did.

    Attributes:
      loss: half the sum of squared residuals at `unknowns`.
      accepted: whether the unknowns changed.
      converged: whether the solver's tolerance is met.
      predicted: by how much the linear model of Levenberg-Marquardt's next step lowers the loss; 0 for other solvers.
      damping: Levenberg-Marquardt's λ for the next step; 0 for other solvers.
      change: of the heights, root mean square.
      unknowns: those to which `loss` belongs.
    """

    loss: Scalar
    accepted: Flag
    converged: Flag
    predicted: Scalar
    damping: Scalar
    change: Scalar
    unknowns: Unknowns


def make_solver(options: FitOptions) -> Any:
    tolerance = DEFAULT_TOLERANCE if options.tolerance is None else options.tolerance
    if options.solver == "lm":
        return LevenbergMarquardt(tolerance, options.inner_steps, options.prior is not None)
    if options.solver == "adam":
        return optx.OptaxMinimiser(optax.adam(_RATE), rtol=tolerance, atol=tolerance, norm=optx.rms_norm)
    if options.solver == "bfgs":
        return BFGS(tolerance)
    return optx.LBFGS(rtol=tolerance, atol=tolerance, norm=optx.rms_norm)


def _function(solver: Any) -> Callable[[Unknowns, Problem], Any]:
    return residuals if isinstance(solver, optx.AbstractLeastSquaresSolver) else half_squares


_OPTIONS: dict[str, Any] = {}
_TAGS: frozenset[object] = frozenset()


def init_state(solver: Any, unknowns: Unknowns, problem: Problem) -> Any:
    """A solver's state before its first step.

    Call it once for each fit: a state also holds compiled functions, which compare by identity, so that a step that is given
    the state of another call would be compiled again. `reset_state` makes later ones.
    """
    # What enters a compiled step and what leaves it must lie in the same places, or the next step is compiled again for the
    # other ones: 16 x 16 heights on two devices took 89 s of processor time up to the last level, not 30.
    problem = linearised(unknowns, problem)
    return _init_state(solver, *on_every_device((unknowns, problem), problem.mesh))


@eqx.filter_jit
def _init_state(solver: Any, unknowns: Unknowns, problem: Problem) -> Any:
    function = _function(solver)
    shape, _ = eqx.filter_eval_shape(function, unknowns, problem)
    state = solver.init(function, unknowns, problem, _OPTIONS, shape, None, _TAGS)
    if isinstance(solver, LevenbergMarquardt):
        state = _with_step_size(state, jnp.asarray(1 / FIRST_DAMPING, unknowns.coefficients.dtype))
    return on_every_device(state, problem.mesh)


def _with_step_size(state: Any, step_size: Float[Array, ""]) -> Any:
    """A state of Levenberg-Marquardt with another 1 / λ, which optimistix calls the step size."""
    return eqx.tree_at(lambda state: state.search_state.step_size, state, step_size)


def reset_state(initial: Any, unknowns: Unknowns, step_size: Float[Array, ""] | None = None) -> Any:
    """A solver's state at `unknowns`, before anything is evaluated there; `initial` is what `init_state` made.

    The next step of Levenberg-Marquardt evaluates and linearises there, and always accepts: the state is then, to the bit,
    what it was after the step that reached them, if `step_size` is the same. So a checkpoint need not hold linearised pictures.
    """
    if hasattr(initial, "y_eval"):
        initial = eqx.tree_at(lambda state: state.y_eval, initial, unknowns)
    return initial if step_size is None else _with_step_size(initial, step_size)


def evaluated_at(unknowns: Unknowns, state: Any) -> Unknowns:
    """Where the next step evaluates the residuals."""
    return getattr(state, "y_eval", unknowns)


def advance(solver: Any, unknowns: Unknowns, state: Any, problem: Problem) -> tuple[Unknowns, Any, Outcome]:
    """One step of the solver: new unknowns, which are the old ones if the step is rejected, the new state, and what it did.

    The problem is `linearised` at `evaluated_at`, or it is here.
    """
    problem = linearised(evaluated_at(unknowns, state), problem)
    return _advance(*on_every_device((solver, unknowns, state, problem), problem.mesh))


@eqx.filter_jit
def _advance(solver: Any, unknowns: Unknowns, state: Any, problem: Problem) -> tuple[Unknowns, Any, Outcome]:
    with jax.numpy_dtype_promotion("standard"):  # optax mixes its 32-bit counters with 64-bit numbers
        new, new_state, _ = solver.step(_function(solver), unknowns, problem, _OPTIONS, state, _TAGS)
    converged, _ = solver.terminate(_function(solver), new, problem, _OPTIONS, new_state, _TAGS)
    dtype = unknowns.coefficients.dtype
    zero, yes = jnp.zeros((), dtype), jnp.ones((), bool)
    if isinstance(solver, optx.OptaxMinimiser):  # its loss is that of the unknowns before the step
        loss, accepted, damping, evaluated = new_state.f, yes, zero, unknowns
    else:
        loss, evaluated = new_state.f_info.as_min(), new
        accepted = new_state.num_accepted_steps > state.num_accepted_steps
        damping = 1 / new_state.search_state.step_size if isinstance(solver, LevenbergMarquardt) else zero
    predicted = _predicted_gain(solver, new, new_state) if isinstance(solver, LevenbergMarquardt) else zero
    moved = problem.basis.heights(new.coefficients) - problem.basis.heights(unknowns.coefficients)
    change = jnp.sqrt(jnp.mean(moved * moved))
    loss, damping, predicted = (value.astype(dtype) for value in (loss, damping, predicted))
    outcome = Outcome(loss, accepted, converged, predicted, damping, change, evaluated)
    return on_every_device((new, new_state, outcome), problem.mesh)


def _predicted_gain(solver: LevenbergMarquardt, unknowns: Unknowns, state: Any) -> Scalar:
    """See `Outcome.predicted`."""
    step = jax.tree.map(lambda new, old: new - old, state.y_eval, unknowns)
    return -solver.search.predict_reduction(step, state.f_info)


def count_unknowns(unknowns: Unknowns) -> int:
    return sum(leaf.size for leaf in jax.tree.leaves(unknowns))
