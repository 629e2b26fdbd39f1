"""What benchmarks/mutations.py changes: operators by their results, and what it leaves alone. It is run by hand."""

import ast
from pathlib import Path

import pytest

pytest.importorskip("cosmic_ray", reason="the operators of mutations, the extra dev, are not installed")

from cosmic_ray.ast import ast_nodes, get_ast
from cosmic_ray.mutating import mutate_code

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"


@pytest.fixture(scope="module", autouse=True)
def benchmarks():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(BENCHMARKS))
        yield


def results(operator, code: str) -> set[str]:
    count = sum(len(list(operator.mutation_positions(node))) for node in ast_nodes(get_ast(code)))
    return {mutate_code(code, operator, k) or "" for k in range(count)}


@pytest.mark.parametrize(
    ("code", "expected"),
    [
        ("y = a + b - c", {"y = b - c", "y = a - c", "y = a + b"}),
        ("y = a * b / c", {"y = b / c", "y = a / c", "y = a * b"}),
        ("y = f(x, k=1)", {"y = f(x)"}),
        ("y = jnp.where(c, a, b)", {"y = (a)", "y = (b)"}),
        ("y = lax.stop_gradient(x)", {"y = (x)"}),
        ("y = x.at[0].set(1)", {"y = x"}),
        ("y += x", {"pass"}),
        ("said.append(x)\n", {"pass\n"}),
        ("y = f(x)", set()),
    ],
)
def test_what_is_left_out(code, expected):
    from mutants import Shorter

    assert results(Shorter(), code) == expected


def test_a_derivative_is_taken_away():
    from mutants import WithoutDerivative

    assert results(WithoutDerivative(), "y = a * b") == {'y = __import__("jax").lax.stop_gradient(a * b)'}


def test_what_no_test_can_tell_stays():
    """Of this module only the body's sum counts."""
    from mutants import counts

    code = 'N = int\nSize = int | None\n\ndef f(x: int | None, *, k=-1) -> int | None:\n    """1 + 1"""\n    return x + k\n'
    code += '\n\ndef g(x):\n    y = f"{x + 1}"\n    raise ValueError(x + 1)\n'
    found = [node.get_code().strip() for node in ast_nodes(get_ast(code)) if node.type == "operator" and counts(node)]
    assert [sign for sign in found if sign not in "()[]:,.="] == ["+"]


def test_draws_are_kept_by_their_seed_and_are_python():
    from mutations import ROOT, draw

    drawn = draw("normals", 4, 1)
    assert drawn == draw("normals", 4, 1) != draw("normals", 4, 2)
    for change in drawn:
        assert ast.dump(ast.parse(change.code)) != ast.dump(ast.parse(change.path.read_text()))
        assert change.path.is_relative_to(ROOT / "jaxhf" / "trace")
        assert change.before != change.after
