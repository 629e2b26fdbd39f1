"""Changes the package's syntax tree in one place at a time, and says which changes no test notices.

    python benchmarks/mutations.py [--rooms walk maps] [--count 10] [--seed 1]

The operators are cosmic-ray's, and some of our own that leave out a part or a derivative. Places are drawn by a seed, as many
in each room of the package; then the tests aimed there run in a copy of the tree, up to the first that fails. Without a change
they must pass. A change that makes them use up three times their processor time, and a minute, counts as noticed. The table
goes to docs/measurements/mutations.csv, where other rooms' rows stay; more than one survivor in ten is an error.
"""

import argparse
import ast
import csv
import itertools
import os
import random
import re
import resource
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections import defaultdict
from pathlib import Path
from typing import NamedTuple

from cosmic_ray.ast import ast_nodes, get_ast
from cosmic_ray.mutating import mutate_code
from cosmic_ray.operators.operator import Operator
from mutants import OPERATORS, WithoutDerivative, counts

ROOT = Path(__file__).parents[1]
TABLE = ROOT / "docs" / "measurements" / "mutations.csv"
DERIVED = re.compile("trace/(normals|intersect)|scene/camera|shade|boundary/(term|sample)")  # where derivatives may go missing

# Room: modules -> pytest's arguments for the tests aimed at them, those first that fail soonest.
AIMS = """
walk: trace/walk*.py trace/[ps][ye]*.py -> rendering/test_cast.py shade/test_penumbra.py '-k=oracle or sun or vmap'
normals: trace/normals.py -> scene/test_scene.py rendering/test_cast.py -k=normal
normals: trace/intersect.py -> trace/test_leaving.py trace/test_extremes.py rendering/test_cast.py shade/test_shade.py
cameras: scene/camera.py -> scene/test_scene.py scene/test_framing.py scene/test_projections.py scene/test_far_camera.py
cameras: scene/pose.py scene/projection.py -> scene/test_scene.py scene/test_projections.py scene/test_far_camera.py
cameras: scene/resection.py scene/mapped.py -> scene/test_resection.py io/test_map_cameras.py
cameras: scene/framing.py -> scene/test_framing.py scene/test_projections.py scene/test_scene.py
lights: scene/sun.py -> scene/test_sun.py
lights: scene/light.py -> scene/test_scene.py scene/test_sun.py shade/test_shade.py
lights: shade/lighting.py -> shade/test_shade.py shade/test_hidden_sky.py shade/test_penumbra.py rendering/test_gradient.py
tiles: rendering/tiles.py -> rendering/test_render.py rendering/test_bits.py
tiles: rendering/samples.py -> rendering/test_render.py boundary/test_edges.py
tiles: rendering/chunks.py -> rendering/test_cast.py rendering/test_bits.py
maps: maps/hillshade.py maps/slope.py maps/surface.py maps/choices.py -> maps/test_maps.py
maps: maps/r*.py io/terrain/colours.py -> maps/test_maps.py cli/test_hillshade.py '-k=tint or colour or pales or adds'
maps: maps/shadows.py -> maps/test_shadows.py
maps: maps/skyview.py maps/windows.py -> maps/test_skyview.py
mujoco: mujoco/[hprs]*[dreys].py -> mujoco/test_sensors.py mujoco/test_ray.py --optimised=tests
mujoco: mujoco/scan.py -> mujoco/test_scan.py --optimised=tests
io: io/pictures/[ceip]*.py -> io/test_images.py io/test_full_disk.py
io: io/files.py io/pictures/films.py -> io/test_images.py io/test_files.py io/test_full_disk.py
io: scene/procedural.py -> scene/test_procedural.py
io: io/scenes/pbrt/*.py -> io/test_pbrt.py
io: io/scenes/toml/*.py io/scenes/load.py -> io/test_toml.py io/test_fit_case.py
io: io/terrain/meshes.py -> io/test_meshes.py
io: io/gdal.py io/terrain/g*.py -> io/test_grids.py io/test_terrain.py io/test_rasters.py
io: io/terrain/[lrst]*.py -> io/test_terrain.py io/test_grids.py io/test_rasters.py
boundary: boundary/*.py -> boundary
fitting: fitting/model/linearise.py fitting/model/sample_rows.py -> fitting/test_linearise.py fitting/test_expansion.py
fitting: fitting/solve/sta*.py -> fitting/test_fit_parts.py fitting/test_fit_stops.py fitting/test_linearise.py
fitting: fitting/model/n*.py fitting/solve/noise.py -> fitting/test_normal_matrix.py fitting/test_noise.py
fitting: fitting/model/rows.py -> fitting/test_normal_matrix.py fitting/test_noise.py
fitting: fitting/*.py fitting/model/[prtu]*.py -> fitting/test_fit_parts.py fitting/test_fit.py
fitting: fitting/model/e*.py fitting/solve/run.py -> fitting/test_fit.py fitting/test_fit_defaults.py
fitting: fitting/trust/words.py -> fitting/test_fit.py fitting/test_fit_defaults.py
fitting: fitting/trust/[fj]*.py -> fitting/test_fit.py fitting/test_fit_defaults.py fitting/test_normal_matrix.py
"""
ROOMS = defaultdict(list)
for _room, _modules, _tests in re.findall(r"(\w+): (.*) -> (.*)", AIMS):
    ROOMS[_room] += [(path, _tests) for name in _modules.split() for path in sorted((ROOT / "jaxhf").glob(name))]


class Change(NamedTuple):
    path: Path
    tests: str
    code: str
    line: int
    before: str
    after: str


def change(path: Path, tests: str, operator: Operator, occurrence: int) -> Change | None:
    """None where it would be no Python, or the same."""
    source = path.read_text()
    code = mutate_code(source, operator, occurrence) or source
    try:
        if ast.dump(ast.parse(code)) == ast.dump(ast.parse(source)):
            return None
    except SyntaxError:
        return None
    old, new = source.splitlines(), code.splitlines()
    first = next(k for k, (a, b) in enumerate(zip(old, new, strict=False)) if a != b)
    last = next(k for k, (a, b) in enumerate(zip(old[::-1], new[::-1], strict=False)) if a != b)
    before, after = (" ".join(map(str.strip, lines[first : len(lines) - last])) for lines in (old, new))
    return Change(path, tests, code, first + 1, before, after)


def draw(room: str, count: int, seed: int) -> list[Change]:
    """Places are drawn evenly over the room, and of each place's changes one."""
    found = defaultdict(list)
    for path, tests in ROOMS[room]:
        nodes = [(node, counts(node)) for node in ast_nodes(get_ast(path.read_text()))]
        for operator in OPERATORS:
            if isinstance(operator, WithoutDerivative) and not DERIVED.search(str(path)):
                continue
            occurrences = (pair for pair in nodes for _ in operator.mutation_positions(pair[0]))
            for occurrence, (node, counted) in enumerate(occurrences):
                if counted:
                    found[str(path), node.start_pos].append((path, tests, operator, occurrence))
    generator = random.Random(f"{seed} {room}")
    places = generator.sample(sorted(found), len(found))
    return list(itertools.islice(filter(None, (change(*generator.choice(found[place])) for place in places)), count))


class Tree:
    """A copy of what the tests need, in which one module at a time is changed."""

    def __init__(self, folder: Path):
        self.root, self.spent = folder / "tree", {}
        for part in ("jaxhf", "tests", "scenes", "docs"):
            shutil.copytree(ROOT / part, self.root / part)
        shutil.copy(ROOT / "pyproject.toml", self.root)
        (folder / "shared").symlink_to(ROOT.parent / "shared")  # scenes that are not part of the project

    def run(self, tests: str, limit: float = 3600) -> tuple[str, str]:
        """What became of a change, in so many seconds of processor time; and the test that failed, with its error."""
        names = [part if part.startswith("-") else f"tests/{part}" for part in shlex.split(tests)]
        command = [sys.executable, "-m", "pytest", "-xqrfE", "--tb=no", "-p", "no:cacheprovider"]
        command += ["-m", "not slow and not deep", *names]
        programs = os.environ.get("JAX_COMPILATION_CACHE_DIR", str(self.root / "programs"))
        changed = {"PYTHONPATH": str(self.root), "JAX_COMPILATION_CACHE_DIR": programs, "COLUMNS": "400"}
        done = subprocess.run(
            command, cwd=self.root, env=os.environ | changed, capture_output=True, text=True, check=False,
            preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_CPU, (int(limit), int(limit))),
        )  # fmt: skip
        if done.returncode in (0, -24, -9):
            return ("timeout" if done.returncode else "survived"), ""
        failed = re.search(r"^(?:FAILED|ERROR) tests/(\S+)(?:.*? - (\w+))?", done.stdout, re.MULTILINE)
        return "killed", f"{failed[1]}: {failed[2]}" if failed else f"exit code {done.returncode}: {done.stderr[-200:]}"

    def outcome(self, change: Change) -> tuple[str, str]:
        if change.tests not in self.spent:
            start = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
            if (found := self.run(change.tests))[0] != "survived":
                sys.exit(f"without a change {change.tests} do not pass: {found[1]}")
            self.spent[change.tests] = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime - start
        path = self.root / change.path.relative_to(ROOT)
        kept = path.read_text()
        path.write_text(change.code)
        try:
            return self.run(change.tests, 60 + 3 * self.spent[change.tests])
        finally:
            path.write_text(kept)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rooms", nargs="+", choices=ROOMS, default=list(ROOMS), metavar="ROOM", help=" ".join(ROOMS))
    parser.add_argument("--count", type=int, default=10, help="changes of each room")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    table = list(csv.reader(TABLE.read_text().splitlines()[2:])) if TABLE.exists() else []
    with tempfile.TemporaryDirectory(prefix="mutations-") as folder:
        tree = Tree(Path(folder))
        for room in options.rooms:
            table = [row for row in table if row[0] != room]
            for one in draw(room, options.count, options.seed):
                place = f"{one.path.relative_to(ROOT / 'jaxhf')}:{one.line}"
                table.append([room, place, f"`{one.before}`", f"`{one.after}`", *tree.outcome(one)])
                print(*table[-1], sep="\n    ", flush=True)
            table.sort(key=lambda row: list(ROOMS).index(row[0]))
            with TABLE.open("w", newline="") as file:
                file.write(f"# python benchmarks/mutations.py --count {options.count} --seed {options.seed}\n")
                csv.writer(file, lineterminator="\n").writerows([("room", "place", "before", "after", "outcome", "by"), *table])
    survivors = sum(row[4] == "survived" for row in table)
    print(f"{survivors} of {len(table)} survived")
    return int(10 * survivors > len(table))


if __name__ == "__main__":
    sys.exit(main())
