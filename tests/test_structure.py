"""The imports are a picture of the renderer: they point one way, from scene file to image."""

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "jaxhf"
# Along the flow: a module imports only from modules before it.
FLOW = (
    "_types", "_store", "_lanes", "_devices", "_settings", "_ray", "_transform", "_texture", "_material", "_light", "_camera",
    "_film", "_heightfield", "_pyramid", "_grid", "_cylinder",
    "_scene", "_walk", "_begin", "_march", "_traverse", "_hit", "_shade",
    "_silhouette", "_lottery", "_edges", "_boundaries", "_render", "_jacobian", "io",
    "_unknowns", "_problem", "_residuals", "_solvers", "_uncertainty", "_descent", "_fit", "_plots", "_report", "_fit_command",
    "_hillshade", "_info",
    "_worker", "_measure", "_tradeoff", "_sweeping", "_front", "_curves", "__init__", "__main__",
)  # fmt: skip


def _stage(path: Path) -> str:
    relative = path.relative_to(PACKAGE)
    return "io" if relative.parts[0] == "io" else relative.stem


def _imported(path: Path) -> list[str]:
    """The stages that a module imports, wherever in it the import stands."""
    stages = []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.level:
            inside_io = _stage(path) == "io" and node.level == 1
            stages += ["io"] if inside_io else [node.module.split(".")[0]] if node.module else [a.name for a in node.names]
        elif isinstance(node, ast.ImportFrom | ast.Import):
            names = [node.module or ""] if isinstance(node, ast.ImportFrom) else [alias.name for alias in node.names]
            assert not any(name.split(".")[0] == "jaxhf" for name in names), f"{path}: imports within the package are relative"
    return stages


@pytest.mark.parametrize(
    "path", sorted([*PACKAGE.rglob("*.py"), *PACKAGE.rglob("*.pyi")]), ids=lambda path: str(path.relative_to(PACKAGE))
)
def test_imports_follow_the_flow(path):
    here = FLOW.index(_stage(path))
    for name in _imported(path):
        assert FLOW.index(name) < here or name == _stage(path) == "io", f"{path.name} imports {name}, which comes after it"


def test_rays_are_batched_in_three_places_and_compiled_in_one():
    """Pixels in one, points on edges in another, both for the matrix of a fit in the third.

    Besides, two modules say what `vmap` is to make of a function of one ray.
    """
    batching, rules = ("_render", "_boundaries", "_jacobian"), ("_lanes", "_march")
    for path in PACKAGE.rglob("*.py"):
        text, stage = path.read_text(), _stage(path)
        assert ("custom_vmap" in text) == (stage in rules), path.name
        assert stage in (*batching, *rules) or "jax.vmap" not in text, f"{path.name} batches rays"
        assert stage in (*batching, "_devices") or "lax.map(" not in text, f"{path.name} batches rays"
        assert stage == "_render" or "jax.jit" not in text, f"{path.name} compiles"
        assert stage == "_devices" or "shard_map" not in text, f"{path.name} deals out work"
