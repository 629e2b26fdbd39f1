"""Times the seed scenes at their own sample counts, on one core and on all, against stock pbrt-v2 where its program is given.

The scenes lie in a folder of .pbrt files. `--pbrt` names the program of pbrt-v2 (github.com/mmp/pbrt-v2, built with OpenEXR);
it then renders each scene in the same run, in turn with ours, on the same cores. Its time is what it says of its
rendering phase, without reading the scene and building its hierarchy; ours is a warm frame with the normals and bounds of
the heights in it. Ours is also shown with what comes before the first frame: reading and compiling.
"""

import math
import os
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import benchmark
import numpy as np

SCENES = ("hftest", "landsea-0", "landsea-1", "landsea-2", "texture", "landsea-big", "landsea-big64")


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


def main() -> None:
    claims = "with --pbrt that a frame takes less than half of pbrt-v2's time"
    run = benchmark.Run(__doc__, needs="a folder of the seed scenes, for --pbrt its program", claims=claims)
    parser = run.parser
    parser.add_argument("folder", type=Path, help="where the .pbrt scenes lie")
    parser.add_argument("--scenes", nargs="+", default=list(SCENES))
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--pbrt", help="the program of pbrt-v2")
    parser.add_argument("--serve", metavar="SCENE", help=benchmark.HIDDEN)
    parser.add_argument("--devices", type=int, default=1, help=benchmark.HIDDEN)
    options = run.parse()
    if options.serve:
        serve(options.folder, options.serve, options.devices)
        return
    if missing := [name for name in options.scenes if not (options.folder / f"{name}.pbrt").is_file()]:
        benchmark.refuse(f"{options.folder} has no {missing[0]}.pbrt")
    if options.pbrt and not benchmark.have(options.pbrt):
        benchmark.refuse(f"{options.pbrt}: there is no such program for --pbrt")
    everything = os.sched_getaffinity(0)
    minutes = math.ceil(len(options.scenes) * (35 + 2 * options.repeats * (2 if options.pbrt else 1)) / 60)
    print(f"about {minutes} minutes on two free cores", flush=True)
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
            row: dict[str, float] = {"first, s": first, "frame": float(np.median(times))}
            if theirs:
                row |= {"pbrt-v2": float(np.median(theirs)), "ratio": float(np.median(np.array(times) / np.array(theirs)))}
                run.claim(row["ratio"] < 0.5, f"{name}: {row['ratio']:.2f} of pbrt-v2's time, below 0.5")
            run.row(f"{name}, {len(cores)} cores", row)
    run.end()


if __name__ == "__main__":
    main()
