"""Times the seed scenes at their own sample counts, on one core and on all, against stock pbrt-v2 where its program is given.

The scenes lie in a folder of .pbrt files. `--pbrt` names the program of pbrt-v2 (github.com/mmp/pbrt-v2, built with OpenEXR);
it then renders each scene in the same run, in turn with ours, on the same cores. Its time is what it says of its
rendering phase, without reading the scene and building its hierarchy; ours is a warm frame with the normals and bounds of
the heights in it. Ours is also shown with what comes before the first frame: reading and compiling.
"""

import argparse
import math
import os
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

SCENES = ("hftest", "landsea-0", "landsea-1", "landsea-2", "texture", "landsea-big", "landsea-big64")
# Seconds of pbrt-v2's rendering phase: stock on one core, a course's walk over cells without bounds and with bounds for each
# cell on one core, stock on two. Taken on two cores like those of docs/measurements/speed.md, busy at the time, and handed down
# with the scenes; nothing was measured for landsea-big64.
PUBLISHED = {
    "hftest": (0.10, 0.11, 0.10, 0.10),
    "landsea-0": (0.60, 1.75, 0.66, 0.32),
    "landsea-1": (0.70, 1.50, 0.64, 0.35),
    "landsea-2": (0.57, 1.12, 0.57, 0.35),
    "texture": (0.46, 0.92, 0.44, 0.24),
    "landsea-big": (1.49, 38.4, 1.36, 0.79),
}


def serve(folder: Path, name: str, devices: int) -> None:
    """Renders a frame for every line that is read, and prints its seconds; the first line printed is the first frame's."""
    import jax

    import jaxhf

    jax.config.update("jax_num_cpu_devices", devices)
    begin = time.perf_counter()
    scene = jaxhf.load_scene(folder / f"{name}.pbrt")
    jax.block_until_ready(jaxhf.render(scene))
    print(time.perf_counter() - begin, flush=True)
    for _ in sys.stdin:
        begin = time.perf_counter()
        jax.block_until_ready(jaxhf.render(scene))
        print(time.perf_counter() - begin, flush=True)


def pbrt(program: str, scene: Path, cores: set[int]) -> float:
    """Seconds that pbrt-v2 takes to render, by its own progress line, which has one decimal."""
    ours = os.sched_getaffinity(0)
    with tempfile.TemporaryDirectory() as folder:
        command = [program, "--ncores", str(len(cores)), "--outfile", f"{folder}/out.tga", str(scene.resolve())]
        os.sched_setaffinity(0, cores)  # which it inherits
        try:
            done = subprocess.run(command, capture_output=True, text=True, check=True, cwd=folder)
        finally:
            os.sched_setaffinity(0, ours)
    said = re.findall(r"Rendering: \[\++\]\s+\(([\d.]+)s\)", done.stdout)
    assert said, f"{scene.name}: pbrt gave no time: {done.stdout[-300:]}{done.stderr[-300:]}"
    return float(said[-1])


def markdown(rows: dict[str, list[float]]) -> str:
    """One line a scene: ours on one core and on all, then pbrt-v2's where it ran in turn with ours, else as published."""
    heads = ("scene", "one core: first", "frame", "all cores: first", "frame", "pbrt-v2, one core", "all cores")
    heads += ("published: stock, one core", "no bounds", "bounds", "stock, two cores")
    lines = [f"| {' | '.join(heads)} |", "|" + "---|" * len(heads)]
    for name, row in rows.items():
        first, frame, *theirs = row[: len(row) // 2]
        first_all, frame_all, *theirs_all = row[len(row) // 2 :]
        measured = [f"{seconds:.1f}" for seconds in (*theirs, *theirs_all)] or ["-"] * 2
        published = [f"{seconds:.2f}" for seconds in PUBLISHED.get(name, ())] or ["-"] * 4
        ours = (f"{first:.1f}", f"{frame:.3f}", f"{first_all:.1f}", f"{frame_all:.3f}")
        lines.append(f"| {' | '.join((name, *ours, *measured, *published))} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="where the .pbrt scenes lie")
    parser.add_argument("--scenes", nargs="+", default=list(SCENES))
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--pbrt", help="the program of pbrt-v2")
    parser.add_argument("--markdown", action="store_true", help="print a table at the end, with published figures beside ours")
    parser.add_argument("--serve", metavar="SCENE", help=argparse.SUPPRESS)
    parser.add_argument("--devices", type=int, default=1, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.serve:
        serve(options.folder, options.serve, options.devices)
        return
    everything = os.sched_getaffinity(0)
    minutes = math.ceil(len(options.scenes) * (35 + 2 * options.repeats * (2 if options.pbrt else 1)) / 60)
    print(f"about {minutes} minutes on two free cores", flush=True)
    rows: dict[str, list[float]] = {}
    for name in options.scenes:
        for cores in ({min(everything)}, everything):
            command = [sys.executable, __file__, str(options.folder), "--serve", name, "--devices", str(len(cores))]
            with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as ours:
                assert ours.stdin is not None
                assert ours.stdout is not None
                os.sched_setaffinity(ours.pid, cores)
                first = float(ours.stdout.readline())
                times, theirs = [], []
                for _ in range(options.repeats):
                    ours.stdin.write("\n")
                    ours.stdin.flush()
                    times.append(float(ours.stdout.readline()))
                    if options.pbrt:
                        theirs.append(pbrt(options.pbrt, options.folder / f"{name}.pbrt", cores))
                ours.stdin.close()
            line = f"{name:12s} {len(cores)} cores   first {first:5.1f} s   frame {np.median(times):6.3f} s"
            if theirs:
                ratio = np.median(np.array(times) / np.array(theirs))
                line += f"   pbrt-v2 {np.median(theirs):5.2f} s   ratio {ratio:5.2f}"
            print(line, flush=True)
            rows.setdefault(name, []).extend([first, float(np.median(times)), *([float(np.median(theirs))] if theirs else [])])
    if options.markdown:
        print(markdown(rows))


if __name__ == "__main__":
    main()
