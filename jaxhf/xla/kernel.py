"""Functions that are called as a whole: as one kernel of XLA's on the CPU, and one after the other under `vmap`."""

import functools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jax.extend.core import ClosedJaxpr, Primitive, jaxpr_as_fun
from jax.extend.mlir import ir
from jax.interpreters import ad, batching, mlir

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


def one_kernel(fun: _Function, *args: Any) -> Any:
    """`fun(*args)`, compiled by XLA on the CPU to a single function: its loops and conditionals become branches within.

    A tile of a picture is some 350 loops of about a microsecond each. That XLA's runtime starts them one by one, and asks each
    loop and conditional how it goes on, was a third of a frame's time. XLA calls this a small call; versions and platforms
    that do not know it ignore the attribute, and a function that XLA has no code for within a kernel is called as it is.

    A derivative is taken of the function linearised: what that stores comes from the same kernel as the value, and what it
    computes again and sums up stands outside, as its sums are scatters.

    Args:
      fun: with no other traced values than its arguments.
      args: pytrees of arrays.
    """
    return _bound(_kernel, fun, args)


def in_turn(fun: _Function, *args: Any, derivative_of: _Function | None = None) -> Any:
    """`fun(*args)`; under `vmap` for one after the other, so that none waits for the slowest.

    Args:
      fun: with no other traced values than its arguments.
      args: pytrees of arrays.
      derivative_of: a function of the same values, up to rounding, which stands for `fun` wherever that is differentiated.
    """
    return _bound(_in_turn, fun, args, derivative_of)


def traced_once(fun: _Function) -> _Function:
    """`fun`, which JAX traces once for arguments of one form, however often it is called within a program."""
    return jax.jit(fun)


_kernel, _in_turn = Primitive("kernel"), Primitive("in_turn")


def _bound(primitive: Primitive, fun: _Function, args: Any, derivative_of: _Function | None = None) -> Any:
    leaves, structure = jax.tree.flatten(args)

    def flat(fun: _Function) -> _Function:
        return lambda *leaves: fun(*jax.tree.unflatten(structure, leaves))

    other = None if derivative_of is None else flat(derivative_of)
    jaxpr, shapes = jax.make_jaxpr(flat(fun), return_shape=True)(*leaves)
    return jax.tree.unflatten(jax.tree.structure(shapes), primitive.bind(*leaves, jaxpr=jaxpr, derivative_of=other))


def _batched_together(leaves: Any, axes: Any, *, jaxpr: ClosedJaxpr, **_: Any) -> tuple[list[Any], list[int]]:
    results = one_kernel(jax.vmap(jaxpr_as_fun(jaxpr), in_axes=tuple(axes)), *leaves)
    return results, [0] * len(results)


def _batched_in_turn(leaves: Any, axes: Any, **params: Any) -> tuple[list[Any], list[int]]:
    many = [axis is not None for axis in axes]
    moved = [jnp.moveaxis(leaf, axis, 0) for leaf, axis in zip(leaves, axes, strict=True) if axis is not None]
    results = lax.map(lambda own: _in_turn.bind(*_merged(many, own, leaves), **params), moved)
    return results, [0] * len(results)


def _differentiated(
    primitive: Primitive,
    primals: Any,
    tangents: Any,
    *,
    jaxpr: ClosedJaxpr,
    derivative_of: _Function | None,
) -> tuple[list[Any], list[Any]]:
    """The value and the tangent. What the linearised function stores of its arguments as they are does not leave the call."""
    moving = [not isinstance(tangent, ad.Zero) for tangent in tangents]
    fun = derivative_of or jaxpr_as_fun(jaxpr)
    forms: list[Any] = []

    def linearised(*leaves: Any) -> tuple[list[Any], list[Any]]:
        moved = (leaf for leaf, moves in zip(leaves, moving, strict=True) if moves)
        values, linear = jax.linearize(lambda *moved: jax.tree.leaves(fun(*_merged(moving, moved, leaves))), *moved)
        stored, structure = jax.tree.flatten(linear)
        places = [next((k for k, leaf in enumerate(leaves) if leaf is value), None) for value in stored]
        forms.append((structure, places))
        return values, [value for value, place in zip(stored, places, strict=True) if place is None]

    values, own = _bound(primitive, linearised, primals)
    structure, places = forms[-1]
    stored = iter(own)
    linear = jax.tree.unflatten(structure, [next(stored) if place is None else primals[place] for place in places])
    return values, linear(*(tangent for tangent, moves in zip(tangents, moving, strict=True) if moves))


def _merged(chosen: list[bool], own: Any, others: Any) -> list[Any]:
    """Where chosen, the next of `own`, elsewhere the one of `others` in that place."""
    following = iter(own)
    return [next(following) if take else other for take, other in zip(chosen, others, strict=True)]


def _called(*leaves: Any, jaxpr: ClosedJaxpr, **_: Any) -> list[Any]:
    return jaxpr_as_fun(jaxpr)(*leaves)


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
for _primitive, _batched in ((_kernel, _batched_together), (_in_turn, _batched_in_turn)):
    _primitive.multiple_results = True
    _primitive.def_impl(_called)
    _primitive.def_abstract_eval(lambda *_, jaxpr, **__: jaxpr.out_avals)
    batching.primitive_batchers[_primitive] = _batched
    ad.primitive_jvps[_primitive] = functools.partial(_differentiated, _primitive)
    mlir.register_lowering(_primitive, _lower)
mlir.register_lowering(_kernel, _lower_as_kernel, platform="cpu")
