"""What is changed in a syntax tree to see whether a test notices: operators, and the places that count.

mutmut 3 was tried first. It keeps every changed function in the module, behind a wrapper that picks one when it is called:
walk.py becomes 24153 lines of 369, each of which jaxtyping checks; properties and module constants stay unchanged; and as JAX
traces a function once, each change needs a process of its own all the same. cosmic-ray's operators return text.
"""

import re
from collections.abc import Iterator
from typing import Any

from cosmic_ray.operators.operator import Operator
from cosmic_ray.operators.provider import OperatorProvider
from parso.python.tree import Name

# Of cosmic-ray's operators those whose result is of the same type, which alone would give it away.
_BINARY = "Add_Sub Sub_Add Mul_Div Div_Mul FloorDiv_Mul Mod_FloorDiv Pow_Mul BitAnd_BitOr BitOr_BitAnd BitXor_BitOr"
_COMPARISON = "Lt_LtE LtE_Lt Gt_GtE GtE_Gt Lt_Gt Gt_Lt LtE_GtE GtE_LtE Eq_NotEq NotEq_Eq Is_IsNot IsNot_Is"
_UNARY = "USub_UAdd Delete_USub Delete_Invert Delete_Not"
_OTHERS = (
    "AddNot ReplaceTrueWithFalse ReplaceFalseWithTrue ReplaceAndWithOr ReplaceOrWithAnd NumberReplacer ZeroIterationForLoop"
)
_SUMS = {"arith_expr": "+", "term": "*", "expr": "|", "and_expr": "&", "and_test": "and", "or_test": "or"}
_CALLS = "maximum minimum greater lesser abs clip sqrt floor ceil unit stop_gradient rounded_clamp log exp cumsum sort radians "
_CALLS += "degrees isfinite flip sin cos tan normalised quotient round max min"


def _text(*nodes: Any) -> str:
    return "".join(node.get_code() for node in nodes).strip()


class Shorter(Operator):
    """Leaves out a term, a factor, a condition, a keyword, a call around an argument, `at[].set()`, or a statement."""

    def variants(self, node: Any) -> Iterator[str]:
        parts = getattr(node, "children", [])
        if node.type in _SUMS:
            yield from (_text(*parts[:k], *parts[k + 2 :]) for k in range(1, len(parts), 2))
            yield from [_text(*parts[2:])] if _text(parts[1]) == _SUMS[node.type] else []
        elif node.type == "arglist":
            given = [part for part in parts if _text(part) != ","]
            for part in given:
                if part.type == "argument" and _text(part.children[1]) == "=":
                    yield ", ".join(_text(other) for other in given if other is not part)
        elif node.type in ("atom_expr", "power") and _text(parts[-1]).startswith("("):
            name = re.split(r"\W", _text(*parts[:-1]))[-1]
            given = getattr(parts[-1].children[1], "children", [parts[-1].children[1]])
            if name == "where" and len(given) >= 5:
                yield from (f"({_text(given[2])})", f"({_text(given[4])})")
            elif name in _CALLS.split() and _text(given[0]) != ")":
                yield f"({_text(given[0])})"
            elif len(parts) > 4 and _text(parts[-4]) == ".at":
                yield _text(*parts[:-4])
        elif node.type == "expr_stmt" and "=" in _text(parts[1]) and len(_text(parts[1])) > 1:
            yield "pass"  # an assignment that adds to its left side
        elif node.type == "simple_stmt" and parts[0].type in ("atom_expr", "power"):
            yield "pass\n"

    def mutation_positions(self, node: Any) -> Any:
        return [(node.start_pos, node.end_pos) for _ in self.variants(node)]

    def mutate(self, node: Any, index: int) -> Any:
        return Name(list(self.variants(node))[index], node.start_pos, node.get_first_leaf().prefix)

    @classmethod
    def examples(cls) -> Any:
        return ()


class WithoutDerivative(Shorter):
    """Takes its derivative from a sum or a product that is given a name."""

    def variants(self, node: Any) -> Iterator[str]:
        if node.type in ("arith_expr", "term") and node.parent.type == "expr_stmt" and "//" not in _text(node):
            yield f'__import__("jax").lax.stop_gradient({_text(node)})'


_KINDS = ("ReplaceBinaryOperator_", _BINARY), ("ReplaceComparisonOperator_", _COMPARISON), ("ReplaceUnaryOperator_", _UNARY)
_NAMES = [kind + name for kind, names in (*_KINDS, ("", _OTHERS)) for name in names.split()]
_PROVIDER: Any = OperatorProvider()
OPERATORS = [*(_PROVIDER[name]() for name in _NAMES), Shorter(), WithoutDerivative()]


def counts(node: Any) -> bool:
    """False in what no test could tell: annotations, types, texts of errors, what is printed, decorators."""
    while (parent := node.parent) is not None:
        if parent.type in (
            "raise_stmt",
            "assert_stmt",
            "decorator",
            "annassign",
            "param",
            "parameters",
            "fstring",
            "import_from",
        ):
            return False
        if parent.type == "funcdef" and (
            node.type == "operator" or node is parent.annotation or parent.name.value == "__repr__"
        ):
            return False
        if parent.type == "expr_stmt" and re.match(r"_?[A-Z][a-z]\w* *=", _text(parent)):
            return False
        node = parent
    return True
