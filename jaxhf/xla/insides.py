"""All that jaxhf takes from JAX's insides, or adds to them: for speed alone, and no version of JAX promises any of it.

Only `plain.insides` imports this module: where something in it does not fit the JAX at hand, jaxhf does without all of it.
"""

import functools
import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax._src.config import trace_context
from jax._src.util import cache
from jax.experimental.compilation_cache import compilation_cache as compilation_cache
from jax.experimental.serialize_executable import deserialize_and_load as deserialize_and_load, serialize as serialize
from jax.extend.core import ClosedJaxpr, Primitive, get_opaque_trace_state, jaxpr_as_fun
from jax.extend.mlir import ir
from jax.extend.mlir.dialects import func
from jax.interpreters import ad, batching, mlir

from .linearised import all_stored, chosen, linearised, merged
from .program_calls import call_program as call_program

TRIED = (0, 12)
"""The newest version of JAX whose insides are known to take what is below."""

# Operations for which XLA has code within a kernel: all but sorts, scatters, products of matrices, and calls of libraries and
# of other devices.
_STABLEHLO = """abs add and atan2 bitcast_convert broadcast_in_dim case cbrt ceil clamp compare complex concatenate constant
convert cosine count_leading_zeros divide dynamic_slice dynamic_update_slice exponential exponential_minus_one floor gather if
iota is_finite log log_plus_one logistic maximum minimum multiply negate not optimization_barrier or pad popcnt power reduce
reduce_precision remainder reshape return reverse round_nearest_afz round_nearest_even rsqrt select shift_left
shift_right_arithmetic shift_right_logical sign sine slice sqrt subtract tan tanh transpose while xor"""
_CHLO = "acos acosh asin asinh atan atanh cosh erf erf_inv erfc is_inf is_neg_inf is_pos_inf next_after sinh square tan"
_KNOWN = {"func.return", *(f"stablehlo.{name}" for name in _STABLEHLO.split()), *(f"chlo.{name}" for name in _CHLO.split())}
# Of so many numbers on, XLA hands sums and extrema to a library (YNNPACK), which a kernel cannot call.
_REDUCED_BY_LIBRARY = 4096

_Function = Callable[..., Any]


class _Call(Primitive):
    """A function that is called as a whole. What it consists of is lowered by the call's own rule."""

    multiple_results = True

    def is_high(self, *_: Any, **__: Any) -> bool:
        """From JAX 0.12 on, a primitive is taken to be high-level itself where one within it is (as `jnp.searchsorted` is
        there), and asked for a rule of another kind."""
        return False


configuration = trace_context
"""All of JAX's configuration, also by context managers, that a trace depends on: hashable."""

kernel, in_turn, in_memory = _Call("kernel"), _Call("in_turn"), Primitive("in_memory")


def bound(primitive: Primitive, fun: _Function, args: Any, **others: _Function | None) -> Any:
    """`fun(*args)` by a primitive that knows other functions of the same arguments, too."""
    leaves, structure = jax.tree.flatten(args)

    def flat(fun: _Function) -> _Function:
        return lambda *leaves: fun(*jax.tree.unflatten(structure, leaves))

    known = {name: other and flat(other) for name, other in others.items()}
    jaxpr, shapes = jax.make_jaxpr(flat(fun), return_shape=True)(*leaves)
    return jax.tree.unflatten(jax.tree.structure(shapes), primitive.bind(*leaves, jaxpr=jaxpr, **known))


def _batched_together(
    leaves: Any, axes: Any, *, jaxpr: ClosedJaxpr, elsewhere: _Function | None = None
) -> tuple[list[Any], list[int]]:
    other = elsewhere and jax.vmap(elsewhere, in_axes=tuple(axes))
    results = bound(kernel, jax.vmap(jaxpr_as_fun(jaxpr), in_axes=tuple(axes)), leaves, elsewhere=other)
    return results, [0] * len(results)


def _batched_in_turn(leaves: Any, axes: Any, **params: Any) -> tuple[list[Any], list[int]]:
    many = [axis is not None for axis in axes]
    moved = [jnp.moveaxis(leaf, axis, 0) for leaf, axis in zip(leaves, axes, strict=True) if axis is not None]
    results = lax.map(lambda own: in_turn.bind(*merged(many, own, leaves), **params), moved)
    return results, [0] * len(results)


def _differentiated(
    primitive: Primitive,
    primals: Any,
    tangents: Any,
    *,
    jaxpr: ClosedJaxpr,
    derivative_of: _Function | None = None,
    **_: Any,
) -> tuple[list[Any], list[Any]]:
    """The value and the tangent. What the linearised function stores of its arguments as they are does not leave the call."""
    moving = [not isinstance(tangent, ad.Zero) for tangent in tangents]
    fun = derivative_of or jaxpr_as_fun(jaxpr)
    forms: list[Any] = []

    def value_and_stored(*leaves: Any) -> tuple[list[Any], list[Any]]:
        values, linear, own, places = linearised(fun, moving, leaves)
        forms.append((jax.tree.structure(linear), places))
        return values, own

    values, own = bound(primitive, value_and_stored, primals)
    structure, places = forms[-1]
    linear = jax.tree.unflatten(structure, all_stored(own, places, primals))
    return values, linear(*chosen(moving, tangents))


def _called(*leaves: Any, jaxpr: ClosedJaxpr, **_: Any) -> list[Any]:
    return jaxpr_as_fun(jaxpr)(*leaves)


def _called_elsewhere(*leaves: Any, jaxpr: ClosedJaxpr, elsewhere: _Function | None = None) -> list[Any]:
    return _called(*leaves, jaxpr=jaxpr) if elsewhere is None else jax.tree.leaves(elsewhere(*leaves))


def _called_between_barriers(*leaves: Any, jaxpr: ClosedJaxpr) -> list[Any]:
    """XLA 0.10 ends the process where a small call does not use an argument, also where that is a constant, which it moves into
    the call. So a number of each argument is returned besides, and barriers hide what the arguments are."""

    def with_uses(*leaves: Any) -> tuple[list[Any], jax.Array]:
        return _called(*leaves, jaxpr=jaxpr), jnp.stack([leaf.reshape(-1)[0].astype(jnp.float32) for leaf in leaves])

    return lax.optimization_barrier(jax.jit(with_uses)(*lax.optimization_barrier(leaves)))[0]


def _lower_as_kernel(context: Any, *leaves: Any, jaxpr: ClosedJaxpr, **_: Any) -> Any:
    if not all(math.prod(aval.shape) for aval in jaxpr.in_avals):
        return _lower(context, *leaves, jaxpr=jaxpr)
    results = mlir.lower_fun(_called_between_barriers, multiple_results=True)(context, *leaves, jaxpr=jaxpr)
    call = results[0].owner.operands[0].owner  # before the barrier
    if call.operation.name == "func.call" and _fits(call, context.module_context.symbol_table, set()):
        names = {"inlineable": "false", "xla_cpu_small_call": "true"}
        attributes: dict[str, Any] = {name: ir.StringAttr.get(value) for name, value in names.items()}
        call.attributes["mhlo.frontend_attributes"] = ir.DictAttr.get(attributes)
    return results


def _fits(operation: Any, functions: Any, seen: set[str]) -> bool:
    """Whether XLA has code within a kernel for an operation, for those in its regions, and for the functions that it calls."""
    name = operation.operation.name
    if name == "func.call":
        called = ir.FlatSymbolRefAttr(operation.attributes["callee"]).value
        if called in seen:
            return True
        seen.add(called)
        return all(_fits(each, functions, seen) for each in functions[called].regions[0].blocks[0].operations)
    if name not in _KNOWN:
        return False
    if name == "stablehlo.reduce":
        for operand in operation.operands:
            form = ir.RankedTensorType(operand.type)
            if str(form.element_type) in ("bf16", "f16", "f32", "f64") and math.prod(form.shape) >= _REDUCED_BY_LIBRARY:
                return False
    within = (each for region in operation.regions for block in region.blocks for each in block.operations)
    return all(_fits(each, functions, seen) for each in within)


_lower = mlir.lower_fun(_called, multiple_results=True)
for _primitive, _batched in ((kernel, _batched_together), (in_turn, _batched_in_turn)):
    _primitive.def_impl(_called)
    _primitive.def_abstract_eval(lambda *_, jaxpr, **__: jaxpr.out_avals)
    batching.primitive_batchers[_primitive] = _batched
    ad.primitive_jvps[_primitive] = functools.partial(_differentiated, _primitive)
    mlir.register_lowering(_primitive, _lower)
mlir.register_lowering(kernel, mlir.lower_fun(_called_elsewhere, multiple_results=True))
mlir.register_lowering(kernel, _lower_as_kernel, platform="cpu")


in_memory.def_impl(lambda array: array)
in_memory.def_abstract_eval(lambda array: array)
batching.defvectorized(in_memory)
ad.deflinear2(in_memory, lambda cotangent, _: [in_memory.bind(cotangent)])


def _lower_in_memory(context: Any, array: Any) -> Any:
    """A call of a function that returns its argument; one function a type in each program."""
    module, name = context.module_context, f"in_memory_{array.type}"
    with ir.InsertionPoint(module.module.body):
        identity = func.FuncOp(name, ([array.type], [array.type]), visibility="private")
        module.symbol_table.insert(identity)
        with ir.InsertionPoint(identity.add_entry_block()):
            func.ReturnOp(identity.arguments)
    call = func.CallOp([array.type], ir.FlatSymbolRefAttr.get(ir.StringAttr(identity.name).value), [array])
    call.operation.attributes["mhlo.frontend_attributes"] = ir.DictAttr.get({"inlineable": ir.StringAttr.get("false")})
    return call.results


mlir.register_lowering(in_memory, lambda context, array: [array])
mlir.register_lowering(in_memory, _lower_in_memory, platform="cpu")


@cache(trace_context_in_key=False)
def generation() -> object:
    """The same until `jax.clear_caches()` is called, then another one."""
    return object()


def untraced(fun: Callable[[], Any]) -> Any:
    """`fun()`, outside of whatever is being traced or transformed: that is the business of one thread."""
    with ThreadPoolExecutor(1) as other:
        return other.submit(fun).result()


_TOP_LEVEL = untraced(get_opaque_trace_state)  # this module may be imported in the midst of a user's `jax.jit`


def is_traced() -> bool:
    """Whether JAX is tracing or transforming what calls this."""
    return get_opaque_trace_state() != _TOP_LEVEL


def try_out() -> None:
    """Raises an error where a small program with all of it has another value or derivative than one without."""
    x, table = np.linspace(0.5, 2, 4, dtype=np.float32), np.arange(3, dtype=np.float32)

    def with_place(x: jax.Array) -> jax.Array:
        return jnp.sin(in_memory.bind(x)) + jnp.searchsorted(jnp.asarray(table), x).astype(x.dtype)

    def loss(x: jax.Array) -> jax.Array:
        each = lax.map(lambda x: bound(kernel, with_place, (x,)), x)
        return jnp.sum(jax.vmap(lambda x: bound(in_turn, jnp.square, (x,)))(each))

    value, slope = untraced(lambda: jax.jit(jax.value_and_grad(loss))(x))
    light = np.sin(x) + np.searchsorted(table, x)
    np.testing.assert_allclose(value, np.sum(light**2), rtol=1e-5)
    np.testing.assert_allclose(slope, 2 * light * np.cos(x), rtol=1e-4)
