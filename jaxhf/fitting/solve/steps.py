"""The steps of a fit: after Levenberg (1944) and Marquardt (1963), by optimistix, and in the end Gauss-Newton ones by factors.

Pictures of few samples a pixel change by jumps, and the loss with them. A trust region, which accepts by the loss, stops where
the jumps are lucky, short of the end along all that pictures tell little of. So the last steps are judged by the next one,
which must be shorter (Deuflhard's natural monotonicity test, Newton Methods for Nonlinear Problems, 2004, chapters 3 and 4). A
quarter of a step is left where pictures are linear; where more than 0.6 is, it mostly follows jumps, and the fit ends.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax import lax
from jaxtyping import Array, Float, Int

from ...core.types import AnyArray, Flag, Scalar
from ...xla.compilation import compiled
from ...xla.devices import divided, on_every_device
from ...xla.plain import insides
from ..model.expansion import Expansion, residuals
from ..model.normal_matrix import in_row, robust_matrix
from ..model.unknowns import Unknowns

FIRST_DAMPING = 1e-2  # as a share of the loss's curvature along a mode
_REJECTED = 0.25  # by which 1 / λ is multiplied at a rejected step, the first in a row
_LEAST_GAIN = 0.01  # of what was predicted: a step that lowers the loss by less is rejected
_GOOD = 0.75  # of it: after a step that lowers the loss by more, 1 / λ is multiplied by _HIGHER
_HIGHER = 4.0
_TOLERANCE = 0.1  # of a step's linear problem: solved to 0.01 steps took twice as long, and fits came no nearer
_ITERATIONS = 120  # of conjugate gradients
# Beside an `AlbedoField`, which can undo most of what heights and lights do: solved to 0.1 a sun stayed 6 degrees off.
_FIELD_TOLERANCE, _FIELD_ITERATIONS = 0.01, 300
RELAXED = 0.75  # of a whole step, part of which is made by jumps of the loss
SHORTER = 0.9  # of the step before: a longer one follows jumps alone, and the one before is not accepted
LAST = 0.6  # of the step before: a longer one is mostly made by jumps, and is not taken
_WHOLE_TOLERANCE = 1e-3  # of its linear problem


class ConjugateGradients(optx.AbstractDescent[Any, Any, Any]):
    """The step argmin |J d + r|² + λ |d|², as far as it is needed: an inexact Newton method (Eisenstat and Walker, SIAM
    Journal on Scientific Computing 17, 16, 1996).

    Until the gradient of the damped model is a share `tolerance` of that at the beginning. The modes have balanced units, which
    is Jacobi's preconditioner; the other unknowns are preconditioned by `others`, the curvature along them over that along the
    modes.
    """

    tolerance: Float[Array, ""] = eqx.field(converter=jnp.asarray)
    iterations: Int[Array, ""] = eqx.field(converter=jnp.asarray)
    others: Any

    def init(self, y: Unknowns, f_info_struct: Any) -> Any:
        return _empty(f_info_struct), _empty(y)

    def query(self, y: Unknowns, f_info: Any, state: Any) -> Any:
        """What is linear there, and its gradient."""
        return f_info, _transposed(f_info.jac)(f_info.residual)

    def step(self, step_size: Scalar, state: Any) -> Any:
        (linear, gradient), tolerance = state, self.tolerance.astype(step_size.dtype)
        pull = _transposed(linear.jac)

        def product(change: Unknowns) -> Unknowns:
            return jax.tree.map(lambda a, b: a + b / step_size, pull(linear.jac.mv(change)), change)

        def inverse(x: Unknowns) -> Unknowns:
            others = jax.tree.map(lambda value, curvature: value / curvature, x.without_modes(), self.others)
            return others.with_modes(x.coefficients)

        right = jax.tree.map(jnp.negative, gradient)
        return conjugate_gradients(product, right, inverse, tolerance, self.iterations), optx.RESULTS.successful


def _transposed(jac: Any) -> Callable[[Any], Unknowns]:
    """Jᵀ, to be called with a number for each residual."""
    pull = jax.linear_transpose(jac.mv, jac.in_structure())
    return lambda residual: pull(residual)[0]


def _dot(a: Any, b: Any) -> Any:
    return sum(jax.tree.leaves(jax.tree.map(functools.partial(jnp.vdot, precision=lax.Precision.HIGHEST), a, b)))


def change_of_loss(step: Any, gradient: Any, step_size: Scalar) -> Scalar:
    """By a step, were pictures linear: g d + |J d|² / 2, of which (JᵀJ + λ) d = -g makes (g d - λ |d|²) / 2. What conjugate
    gradients leave of that equation is orthogonal to d, but for rounding."""
    return _dot(step, jax.tree.map(lambda g, d: g - d / step_size, gradient, step)) / 2


def conjugate_gradients(
    product: Callable[[Any], Any], right: Any, inverse: Callable[[Any], Any], tolerance: Scalar, most: Int[Array, ""]
) -> Any:
    """x whose `product` is `right`, to a share `tolerance` of that, in `most` iterations at most, from x = 0; `inverse`: the
    preconditioner (Saad, Iterative Methods for Sparse Linear Systems, 2003, algorithm 9.1).

    It gives the bits of `jax.scipy.sparse.linalg.cg`. That multiplies the first x, too, though it is 0: its programs hold the
    product twice, and the product is traced five times.
    """

    def along(here: Any, step: Scalar, direction: Any) -> Any:
        return jax.tree.map(lambda a, b: a + step * b, here, direction)

    def unsolved(state: Any) -> Flag:
        _, left, _, _, count = state
        return (_dot(left, left) > least) & (count < most)

    def iteration(state: Any) -> Any:
        x, left, size, direction, count = state
        change = product(direction)
        step = size / _dot(direction, change)
        x, left = along(x, step, direction), along(left, -step, change)
        found = inverse(left)
        size, before = _dot(left, found), size
        return x, left, size, along(found, size / before, direction), count + 1

    least, found = tolerance**2 * _dot(right, right), inverse(right)
    begin = jax.tree.map(jnp.zeros_like, right), right, _dot(right, found), found, 0
    return lax.while_loop(unsolved, iteration, begin)[0]


class TrustRegion(optx.ClassicalTrustRegion):
    """optimistix's own, but told how a step was predicted to change the loss, for which that makes another product with J."""

    reduction: Any = 0.0

    def predict_reduction(self, y_diff: Any, f_info: Any) -> Any:
        return self.reduction


class LevenbergMarquardt(optx.AbstractGaussNewton):
    """optimistix's own class but for the linear solver and the trust region.

    Each rejection in a row raises λ by twice the factor of the one before (Nielsen, Damping parameter in Marquardt's method,
    1999), and the step that is accepted after them does not lower it: else every second step is rejected.
    """

    rtol: float
    atol: float
    norm: Callable[..., Any]
    descent: Any
    search: Any
    verbose: Callable[..., None]

    def __init__(
        self,
        rejections: int,
        others: Any,
        predicted: float = 0.0,
        exactly: tuple[float, int] = (_TOLERANCE, _ITERATIONS),
    ):
        self.rtol = self.atol = 0.0  # when a fit ends, `run` decides
        self.norm = optx.rms_norm
        self.descent = ConjugateGradients(*exactly, others)
        search = TrustRegion(
            high_cutoff=_GOOD,
            low_cutoff=_LEAST_GAIN,
            high_constant=_HIGHER if rejections == 0 else 1.0,
            low_constant=_REJECTED / 2**rejections,
            reduction=-predicted,
        )

        def constants(search: TrustRegion) -> Any:
            return search.high_constant, search.low_constant, search.reduction

        # As arrays, so that one program serves whatever they are; made of numbers first, which it checks by no program.
        self.search = eqx.tree_at(constants, search, jax.tree.map(np.asarray, constants(search)))
        self.verbose = _silent


def _empty(form: Any) -> Any:
    """The same with zeros for its arrays."""

    def zeros(leaf: Any) -> Any:
        # By NumPy: JAX's own zeros are a program for each shape.
        return jax.device_put(np.zeros(leaf.shape, leaf.dtype)) if isinstance(leaf, jax.Array | jax.ShapeDtypeStruct) else leaf

    return jax.tree.map(zeros, form)


def _silent(**_: Any) -> None:
    pass


class Outcome(NamedTuple):
    """What one step did: the loss after it, whether it was accepted, by how much the next one is to lower the loss (0: it would
    follow jumps of the loss), 1 / λ of that one, and the change of the heights, root mean square."""

    loss: Scalar | float
    accepted: Flag | bool
    predicted: Scalar | float
    step_size: Scalar
    change: Scalar | float


def first_position(expansion: Expansion, step_size: Float[Array, ""]) -> Any:
    """optimistix's state where the unknowns are those of an expansion, before anything is evaluated there.

    The next step evaluates there, and always accepts: the state is then, to the bit, what it was after the step that reached
    them, if 1 / λ is the same. So a checkpoint need not hold linearised pictures.
    """
    empty = _empty(_form_of(expansion))
    begin = jnp.ones_like(empty.first_step), expansion.unknowns, step_size.astype(empty.search_state.step_size.dtype)
    return eqx.tree_at(lambda state: (state.first_step, state.y_eval, state.search_state.step_size), empty, begin)


def _form_of(expansion: Expansion) -> Any:
    """That of optimistix's state, see `_form`."""
    leaves, structure = jax.tree.flatten(expansion)
    forms = tuple(_shape_of(leaf) if hasattr(leaf, "shape") else leaf for leaf in leaves)
    if (module := insides()) is not None:
        traced_in = module.configuration(), module.generation()
    else:
        traced_in = jax.config.jax_default_matmul_precision, jax.sharding.get_abstract_mesh()  # pyright: ignore
    return _form(structure, forms, traced_in)


def _shape_of(array: AnyArray | jax.ShapeDtypeStruct) -> jax.ShapeDtypeStruct:
    """In the precision in which JAX takes it."""
    form = jax.typeof(array)
    return jax.ShapeDtypeStruct(form.shape, form.dtype, weak_type=form.weak_type)


@functools.lru_cache(maxsize=16)
def _form(structure: Any, leaves: tuple[Any, ...], _: Any) -> Any:
    """The form of optimistix's state of a fit, with `jax.ShapeDtypeStruct`s for its arrays; for each configuration of JAX, the
    last argument, and anew after `jax.clear_caches`.

    Once for each form of an expansion: a state also holds compiled functions, which compare by identity, so that a step that is
    given others would be compiled again.
    """

    def first(expansion: Expansion) -> Any:
        solver = LevenbergMarquardt(0, expansion.unknowns.without_modes())
        shape, _ = eqx.filter_eval_shape(residuals, expansion.unknowns, expansion)
        return solver.init(residuals, expansion.unknowns, expansion, {}, shape, None, frozenset())

    def strongly_typed(leaf: Any) -> Any:  # as `_empty` and steps make them
        return leaf.update(weak_type=False) if isinstance(leaf, jax.ShapeDtypeStruct) else leaf

    return jax.tree.map(strongly_typed, eqx.filter_eval_shape(first, jax.tree.unflatten(structure, leaves)))


def advance(
    unknowns: Unknowns, position: Any, expansion: Expansion, others: Any, rejections: int, predicted: float
) -> tuple[Unknowns, Any, Outcome]:
    """One step from the last one's unknowns and optimistix's state, with the expansion at `position.y_eval`, after so many
    rejections in a row: new unknowns, which are the old ones if it is rejected, a new state, and what it did. `predicted`: by
    the last one, of the step that led to `position.y_eval`; of no account where that is a stage's first.

    What the old state holds of J makes room for that of the new one: it is gone.
    """
    new, arrays, outcome = _advance(*_arguments(unknowns, position, expansion, others, rejections, predicted))
    # What else the state holds, functions among it, stays as it is, and could not be kept with a compiled program.
    following, (leaves, structure) = iter(arrays), jax.tree.flatten(position)
    return new, jax.tree.unflatten(structure, [next(following) if eqx.is_array(leaf) else leaf for leaf in leaves]), outcome


def compile_steps_ahead(expansion: Expansion) -> None:
    """The program of `advance`, for an expansion whose pictures may be forms of those to come."""
    others = jax.tree.map(np.asarray, expansion.unknowns.without_modes())
    _advance.compile_ahead(*_arguments(expansion.unknowns, _form_of(expansion), expansion, others, 0, 0.0))


def _arguments(
    unknowns: Unknowns, position: Any, expansion: Expansion, others: Any, rejections: int, predicted: float
) -> tuple[Any, Any]:
    """What `_advance` takes."""
    exactly = (_TOLERANCE, _ITERATIONS) if expansion.problem.albedo is None else (_FIELD_TOLERANCE, _FIELD_ITERATIONS)
    solver = LevenbergMarquardt(rejections, others, predicted, exactly)
    of_j, rest = _of_j(position)
    mesh = expansion.problem.mesh
    return on_every_device((solver, unknowns, rest, expansion), mesh), divided(of_j, mesh)


def _of_j(position: Any) -> tuple[Any, Any]:
    """What optimistix's state holds of J, and the rest."""
    which = eqx.tree_at(
        lambda state: (state.f_info.jac, state.descent_state[0].jac), jax.tree.map(lambda _: False, position), (True, True)
    )
    return eqx.partition(position, which)


@functools.partial(compiled, jit=eqx.filter_jit, newer=None, donate="all-except-first")
def _advance(
    kept: tuple[LevenbergMarquardt, Unknowns, Any, Expansion], of_j: Any
) -> tuple[Unknowns, list[Array | np.ndarray], Outcome]:
    solver, unknowns, rest, expansion = kept
    problem, position = expansion.problem, eqx.combine(of_j, rest)
    with jax.numpy_dtype_promotion("standard"):
        new, state, _ = solver.step(residuals, unknowns, expansion, {}, position, frozenset())
    step = jax.tree.map(lambda to, here: to - here, state.y_eval, new)
    moved = problem.basis.heights(new.coefficients) - problem.basis.heights(unknowns.coefficients)
    outcome = Outcome(
        loss=state.f_info.as_min(),
        accepted=state.num_accepted_steps > position.num_accepted_steps,
        predicted=-change_of_loss(step, state.descent_state[1], state.search_state.step_size),
        step_size=state.search_state.step_size,
        change=jnp.sqrt(jnp.mean(moved * moved)),
    )
    of_j, rest = _of_j(state)
    new, rest, outcome = on_every_device((new, rest, outcome), problem.mesh)
    arrays = jax.tree.leaves(eqx.filter(eqx.combine(divided(of_j, problem.mesh), rest), eqx.is_array))
    return new, arrays, outcome


class WholeStep(NamedTuple):
    """The Gauss-Newton step from where an expansion is: the change of the unknowns, that of the heights, root mean square, by
    how much it would lower the loss, were pictures linear, and the loss where it begins."""

    change: Unknowns
    length: float
    predicted: float
    loss: float


def whole_step(expansion: Expansion) -> WholeStep:
    """`expansion`: one that `has_rows`, all of whose modes are varied."""
    left = in_row(expansion.left())
    matrix = robust_matrix(expansion, left)
    gradient = matrix.gradient(matrix.roots * left)
    change = matrix.solved(-gradient, _WHOLE_TOLERANCE)
    softened = matrix.roots * left**2  # the squares of `soften`
    loss = (np.sum(softened) + np.sum(matrix.modes_before() ** 2) + np.sum(matrix.others_off**2)) / 2
    length = float(np.sqrt(np.mean(matrix.heights_of(change) ** 2)))
    return WholeStep(matrix.unknowns_of(change), length, float(-(gradient @ change) / 2), float(loss))


def relaxed(unknowns: Unknowns, step: WholeStep) -> Unknowns:
    def moved(value: Array, change: Array) -> Array:
        return jax.device_put(np.asarray(value) + RELAXED * np.asarray(change))

    return jax.tree.map(moved, unknowns, step.change)
