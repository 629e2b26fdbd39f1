"""The folders are a picture of the renderer: imports point one way, from scene file to image."""

import ast
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "jaxhf"
# Along the flow: a package imports only from those before it. Two that stand together know nothing of each other.
ORDER = "core < xla < scene < trace io < maps < shade < boundary < rendering < fitting mujoco < study < cli"
READ_FILES = {"maps", "fitting", "study", "cli"}  # the only ones that import from io

FLOORS = [floor.split() for floor in ORDER.split(" < ")]
FLOOR = {name: number for number, names in enumerate(FLOORS) for name in names}
MODULES = sorted(path for path in PACKAGE.rglob("*.py") if path.name not in ("__init__.py", "__main__.py"))


def _parts(path: Path) -> tuple[str, ...]:
    """A module's place below the package, ("trace", "walk")."""
    return path.relative_to(PACKAGE).with_suffix("").parts


def _imported(path: Path) -> set[tuple[str, ...]]:
    """The modules of jaxhf that a module imports, wherever in it the import stands."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.level:
            base = _parts(path)[: -node.level] if node.level else ()
            whole = (*base, *(node.module.split(".") if node.module else ()))
            names = [(*whole, alias.name) for alias in node.names]
            found |= {name if PACKAGE.joinpath(*name).with_suffix(".py").exists() else whole for name in names}
        elif isinstance(node, ast.ImportFrom | ast.Import):
            names = [node.module or ""] if isinstance(node, ast.ImportFrom) else [alias.name for alias in node.names]
            assert not any(name.split(".")[0] == "jaxhf" for name in names), f"{path}: imports within the package are relative"
    return found


def test_every_file_has_its_room():
    directly = {path.name for path in PACKAGE.iterdir() if path.is_file()}
    assert directly == {"__init__.py", "__init__.pyi", "__main__.py", "py.typed"}
    assert {path.name for path in PACKAGE.iterdir() if path.is_dir() and path.name != "__pycache__"} == FLOOR.keys()
    assert len(FLOORS) <= 11
    tested = {path.name for path in (ROOT / "tests").iterdir() if path.is_dir() and path.name != "__pycache__"}
    assert tested - {"references"} <= FLOOR.keys()


@pytest.mark.parametrize("path", MODULES, ids=lambda path: "/".join(_parts(path)))
def test_imports_follow_the_flow(path):
    here = _parts(path)[0]
    for other in {name[0] for name in _imported(path)} - {here}:
        assert FLOOR[other] < FLOOR[here], f"{path}: {here} imports {other}, which does not come before it"
        assert other != "io" or here in READ_FILES, f"{path}: {here} imports io"


def test_no_circle():
    graph = {_parts(path): _imported(path) for path in MODULES}
    assert len(list(TopologicalSorter(graph).static_order())) >= len(MODULES)  # CycleError where there is one


def test_rays_are_batched_and_compiled_in_few_places():
    """Rays are batched where pictures, boundaries and a fit's matrix are made; three say what `vmap` makes of calls."""
    batching = {
        "rendering/tiles",
        "rendering/samples",
        "rendering/render",
        "rendering/cast",
        "rendering/chunks",
        "boundary/term",
        "fitting/linearise",
        "mujoco/scan",
        "mujoco/sensors",
    }
    rules = {"xla/masked", "trace/search"}
    batching |= {"xla/insides"}
    for path in MODULES:
        text, name = path.read_text(), "/".join(_parts(path))
        assert ("custom_vmap" in text) == (name in rules), name
        assert name in batching | rules or "jax.vmap" not in text, f"{name} batches rays"
        assert (
            name in batching | {"xla/devices", "trace/horizon", "fitting/jacobian", "mujoco/hfield"} or "lax.map(" not in text
        ), f"{name} batches rays"
        assert name in {"xla/compilation", "xla/insides", "xla/kernel", "xla/masked"} or "jax.jit" not in text, (
            f"{name} compiles"
        )
        assert name == "xla/devices" or "shard_map(" not in text, f"{name} deals out work"
