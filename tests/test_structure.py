"""The folders are a picture of the renderer: imports point one way, from scene file to image."""

import ast
import itertools
from graphlib import TopologicalSorter
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "jaxhf"
# Along the flow: a package imports only from those before it. Two that stand together know nothing of each other.
ORDER = "core < xla scene < trace io < preparation < maps shade < boundary < rendering < fitting mujoco < study < cli"
ROOMS = {  # and modules, in this order, too; what they share stands beside them
    "io": ["pictures", "terrain", "scenes"],
    "fitting": ["model", "solve", "trust", "cropped", "fit", "windows"],
}
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
    assert len(FLOORS) <= 10
    tested = {path.name for path in (ROOT / "tests").iterdir() if path.is_dir() and path.name != "__pycache__"}
    assert tested - {"references"} <= FLOOR.keys()


def test_imports_follow_the_flow():
    """Each only from rooms before its own, and from `io` only where files are read; no module leads back to itself."""
    graph = {_parts(path): _imported(path) for path in MODULES}
    arrows = {(here, name[0]) for here, names in graph.items() for name in names if name[0] != here[0]}
    assert not {(here, other) for here, other in arrows if FLOOR[other] >= FLOOR[here[0]]}, "these do not come before"
    assert not {here for here, other in arrows if other == "io" and here[0] not in READ_FILES}, "these import io"
    for package, rooms in ROOMS.items():
        inside = {(here[1], name[1]) for here, names in graph.items() for name in names if here[0] == name[0] == package}
        floor = {name: number for number, name in enumerate(rooms)}
        assert not {(here, other) for here, other in inside if floor.get(other, -1) > floor.get(here, -1)}, package
        assert {(other, here) for here, other in inside} >= set(itertools.pairwise(rooms[:3]))  # or none was found
    assert len(arrows) > 200  # or nothing was found to be compared
    assert len(list(TopologicalSorter(graph).static_order())) >= len(MODULES)  # CycleError where there is one


MAPS_OVER_RAYS = {
    "rendering/tiles", "rendering/render", "rendering/cast", "rendering/chunks", "boundary/term",
    "boundary/points",
    "fitting/model/sample_rows", "fitting/model/expansion", "maps/viewshed", "mujoco/geoms", "mujoco/primitives",
    "mujoco/scan", "mujoco/sensors", "preparation/sky", "xla/insides", "xla/kernel", "xla/program_calls",
}  # fmt: skip
RULES = {"xla/masked", "trace/search"}  # of what `vmap` makes of a call
PLACES = {  # what stands in these modules alone
    "custom_vmap": RULES,
    "jax.vmap": MAPS_OVER_RAYS | RULES,
    "lax.map(": MAPS_OVER_RAYS
    | {
        "xla/devices",
        "boundary/silhouette",
        "preparation/horizon",
        "fitting/model/rows",
        "fitting/model/unknowns",
        "mujoco/hfield",
    },
    "jax.jit": {"xla/compilation", "xla/insides", "xla/kept", "xla/masked", "xla/program_calls"},
    "shard_map(": {"xla/devices"},
    "default_backend(": {"xla/devices", "xla/kept", "study/plan"},  # in the last to tell measurements apart
}


def test_batches_compilation_and_backends_have_few_places():
    texts = {"/".join(_parts(path)): path.read_text() for path in MODULES}
    for word, places in PLACES.items():
        assert not {name for name, text in texts.items() if word in text} - places, word
    assert all("custom_vmap" in texts[name] for name in RULES)
