"""Compiled programs within JAX's transformations: derivatives of a program are programs of their own.

What `jax.grad` and the like do outside of any `jax.jit` then needs no trace where these programs are found in the folder. Under
`vmap` a program is traced. Only `insides` imports this module.
"""

import contextlib
import functools
from collections.abc import Callable
from typing import Any

import jax
from jax.core import Tracer
from jax.extend.core import Literal, Primitive, jaxpr_as_fun
from jax.interpreters import ad, batching, mlir

from .linearised import all_stored, chosen, linearised, merged

Program = Any
"""A `kept.Program`; here so that modules do not go round in a circle."""

_Moving = tuple[bool, ...]
"""Which values have a tangent."""

_call, _linear = Primitive("program"), Primitive("linear_program")
_call.multiple_results = _linear.multiple_results = True


def call_program(program: Program, leaves: list[Any]) -> list[Any]:
    """`program(*leaves)`, where JAX differentiates or batches, but stages nothing."""
    return _call.bind(*leaves, program=program)


def _differentiated(primals: Any, tangents: Any, *, program: Program) -> tuple[list[Any], list[Any]]:
    moving = tuple(not isinstance(slope, ad.Zero) and slope.dtype != jax.dtypes.float0 for slope in tangents)
    moves = chosen(moving, tangents)
    if not moves:
        values = _call.bind(*primals, program=program)
        return values, _zeros(values)
    if any(isinstance(slope, Tracer) for slope in moves):
        storing = _storing(program, moving)
        if not any(hasattr(slope, "batch_dim") for slope in moves):  # of `jacfwd`, which pushes many
            _compile_reverse_ahead(program, storing, moving, primals)
        results = _call.bind(*primals, program=storing)
        moved, places, program.note = storing.note
        values, stored = results[: len(moved)], all_stored(results[len(moved) :], places, primals)
        forms = tuple(map(jax.typeof, chosen(moved, values)))
        types = tuple(map(jax.typeof, primals))
        slopes = _linear.bind(*stored, *moves, program=program, moving=moving, types=types, forms=forms)
    else:  # forward mode stores nothing
        pushed = _pushed(program, moving)
        results = _call.bind(*primals, *moves, program=pushed)
        moved, program.note = pushed.note
        values, slopes = results[: len(moved)], results[len(moved) :]
    return values, merged(moved, slopes, _zeros(values))


def _zeros(values: list[Any]) -> list[Any]:
    return [ad.Zero(jax.typeof(value).to_tangent_aval()) for value in values]


def _that_move(jaxpr: Any, moves: Any) -> _Moving:
    """Which results of a jaxpr depend on these of its variables."""
    seen = set(moves)

    def depends(value: Any) -> bool:
        return not isinstance(value, Literal) and value in seen

    for equation in jaxpr.eqns:
        if any(map(depends, equation.invars)):
            seen.update(equation.outvars)
    return tuple(map(depends, jaxpr.outvars))


def _pushed(program: Program, moving: _Moving) -> Program:
    """Values, and the tangents of those that move; its note says which, and has that of the program."""

    def pushed(*leaves: Any) -> tuple[list[Any], Any]:
        def both(*leaves: Any) -> tuple[list[Any], list[Any]]:
            primals, moves = leaves[: len(moving)], leaves[len(moving) :]
            return jax.jvp(lambda *own: program.traced(*merged(moving, own, primals)), chosen(moving, primals), list(moves))

        jaxpr = jax.make_jaxpr(both)(*leaves)
        results, count = jaxpr_as_fun(jaxpr)(*leaves), len(jaxpr.out_avals) // 2
        moved = _that_move(jaxpr.jaxpr, jaxpr.jaxpr.invars[len(moving) :])[count:]
        return [*results[:count], *chosen(moved, results[count:])], (moved, program.note)

    return program.derived(f"{moving} pushed", pushed)


def _storing(program: Program, moving: _Moving) -> Program:
    """Values, and what the linear function stores besides the arguments; its note says which values move and what is stored, an
    argument by its place, and has the program's note."""

    def storing(*leaves: Any) -> tuple[list[Any], Any]:
        values, linear, own, places = linearised(program.traced, moving, leaves)
        jaxpr = jax.make_jaxpr(linear)(*chosen(moving, leaves)).jaxpr
        moved = _that_move(jaxpr, jaxpr.invars)
        program.linear[moving] = jax.tree.structure(linear), moved
        return [*values, *own], (moved, places, program.note)

    return program.derived(f"{moving} linearised", storing)


def _compile_reverse_ahead(program: Program, storing: Program, moving: _Moving, primals: Any) -> None:
    """Compiles what differentiates in reverse mode beside what stores for it: on one device, where arrays may be anywhere.

    Most who ask for a linear function want that; for who only pushes through that of `jax.linearize` it is too much.
    """
    if any(isinstance(value, Tracer) or (isinstance(value, jax.Array) and value.committed) for value in primals):
        return
    forms = storing.compile_ahead(*primals)
    if forms is None:
        return
    moved, places, program.note = storing.note
    types, values = tuple(map(jax.typeof, primals)), forms[: len(moved)]
    stored = all_stored(forms[len(moved) :], places, primals)
    with contextlib.suppress(Exception):  # as of a loop that has no reverse mode: said where that is asked for
        _transposed_program(program, moving, types).compile_ahead(*stored, *chosen(moved, values))


def _linear_function(program: Program, moving: _Moving, types: Any) -> tuple[Any, _Moving]:
    """The linear function's structure, into which what it stores is put, and which of its results are not zero."""
    if moving not in program.linear:  # the linearised program was found in the folder
        jax.eval_shape(lambda *leaves: _storing(program, moving).fun(*leaves)[0], *types)
    return program.linear[moving]


def _pushing(program: Program, moving: _Moving, types: Any) -> Callable[..., list[Any]]:
    """The linear function of what it stores and of the tangents."""
    structure, moved = _linear_function(program, moving, types)

    def slopes(*leaves: Any) -> list[Any]:
        linear = jax.tree.unflatten(structure, leaves[: structure.num_leaves])
        return chosen(moved, linear(*leaves[structure.num_leaves :]))

    return slopes


def _linear_program(program: Program, moving: _Moving, types: Any, **_: Any) -> Program:
    return program.derived(f"{moving} linear", lambda *leaves: (_pushing(program, moving, types)(*leaves), None))


def _transposed_program(program: Program, moving: _Moving, types: Any) -> Program:
    def pulled(*leaves: Any) -> tuple[list[Any], None]:
        count = _linear_function(program, moving, types)[0].num_leaves
        stored, given = leaves[:count], leaves[count:]
        slopes = functools.partial(_pushing(program, moving, types), *stored)
        return list(jax.linear_transpose(slopes, *chosen(moving, types))(list(given))), None

    return program.derived(f"{moving} transposed", pulled)


def _transposed(cotangents: Any, *leaves: Any, program: Program, moving: _Moving, types: Any, **_: Any) -> list[Any]:
    count = len(leaves) - sum(moving)
    stored, moves = leaves[:count], leaves[count:]  # of these some may be known
    given = map(ad.instantiate_zeros, cotangents)
    results = _call.bind(*stored, *given, program=_transposed_program(program, moving, types))
    own = [value if ad.is_undefined_primal(move) else None for move, value in zip(moves, results, strict=True)]
    return [None] * count + own


def _batched(leaves: Any, axes: Any, *, program: Program) -> tuple[list[Any], list[int]]:
    results = jax.vmap(program.staged, in_axes=tuple(axes))(*leaves)
    return results, [0] * len(results)


_call.def_impl(lambda *leaves, program: program(*leaves))
_call.def_abstract_eval(lambda *types, program: list(map(jax.typeof, jax.eval_shape(program.traced, *types))))
ad.primitive_jvps[_call] = _differentiated
batching.primitive_batchers[_call] = _batched
mlir.register_lowering(_call, mlir.lower_fun(lambda *leaves, program: program.traced(*leaves), multiple_results=True))


def _as_call(rule: Callable[..., Any]) -> Callable[..., Any]:
    return lambda first, second, **given: rule(first, second, program=_linear_program(**given))


_linear.def_impl(lambda *leaves, **given: _linear_program(**given)(*leaves))
_linear.def_abstract_eval(lambda *_, forms, **__: list(forms))
ad.primitive_jvps[_linear] = _as_call(_differentiated)
ad.primitive_transposes[_linear] = _transposed
batching.primitive_batchers[_linear] = _as_call(_batched)
mlir.register_lowering(
    _linear, mlir.lower_fun(lambda *leaves, **given: _linear_program(**given).traced(*leaves), multiple_results=True)
)
