"""What it costs to make the programs that jaxhf runs: equations traced, lines of StableHLO, and CPU seconds by stage.

Each program is made in a process of its own, without a cache. The scene is one terrain of `--heights` a side under one
directional light, with shadows and smooth normals, 512 x 512 pixels (for the fit 128 x 128).

With --second: what a first process takes, with an empty folder of programs, and what the second one does, which finds them
there; then pictures and fits of another size, and another terrain of another size. CPU seconds of all threads, and seconds of
the clock; from start to end, with the import of JAX and the work itself.
"""

import json
import os
import re
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import benchmark
import numpy as np

PROGRAMS = {
    "frame": "a picture, 1 sample a pixel, as `jaxhf.render` makes it by itself",
    "inside": "the same within a `jax.jit`",
    "gradient": "a picture, 4 samples, and the gradient of a loss in the heights",
    "edges": "the same with 1e4 points on edges",
    "linearise": "a fit's picture with its derivative, without points on edges",
    "step": "a step of a fit, from that",
}
FIT = """
import sys
import numpy as np
import jaxhf
from jaxhf.scene.procedural import fractal

side = int(sys.argv[1])
heights = fractal([side, side], seed=3, exponent=2.4, range=(0.0, 3.0)).astype(np.float32)
c = (side - 1) / 2
camera = jaxhf.Orthographic.look_at((c, c, 500), (c, c, 0), up=(0, 1, 0), extent=2 * c, width=side, height=side)

def scene(heights, azimuth):
    field = jaxhf.Heightfield(heights, dx=1.0)
    return jaxhf.Scene([jaxhf.Object(field)], camera, [jaxhf.Directional.from_angles(azimuth, 35)])

pictures = [jaxhf.render(scene(heights, azimuth))[..., 0] for azimuth in (100, 220, 340)]
jaxhf.fit([scene(0 * heights, azimuth) for azimuth in (100, 220, 340)], pictures)
"""
TERRAINS = """
import jaxhf

terrain = jaxhf.jacksboro()
jaxhf.save_heights("terrain.tif", terrain)
jaxhf.save_heights("other.npy", terrain.heights[20:330, 30:390])
"""
PICTURE = """
import sys

import jaxhf

field = jaxhf.load_heights(sys.argv[1]).heightfield()
camera = jaxhf.Perspective.framing(field, 200, 35, width=512, height=512)
jaxhf.render(jaxhf.Scene([jaxhf.Object(field)], camera, [jaxhf.Directional.from_angles(315, 35)]))
"""
STAGES = ("trace", "lower", "compile")


def equations(jaxpr: Any) -> Iterator[Any]:
    """All equations of a jaxpr and of those inside."""
    for equation in jaxpr.eqns:
        yield equation
        for value in equation.params.values():
            for inner in value if isinstance(value, (tuple, list)) else (value,):
                inner = getattr(inner, "jaxpr", inner)
                if hasattr(inner, "eqns"):
                    yield from equations(inner)


def make_scene(heights: np.ndarray, pixels: int) -> Any:
    import jaxhf

    return jaxhf.Scene(
        [jaxhf.Object(jaxhf.Heightfield(heights))],
        jaxhf.Perspective.look_at((0.5, -1.2, 1.1), (0.5, 0.5, 0.05), fov=45.0, width=pixels, height=pixels),
        [jaxhf.Directional((-0.5, 0.3, 0.5))],
    )


def arrays_only(function: Any, *arguments: Any) -> tuple[Any, tuple[Any, ...]]:
    """The function under `jax.jit`, of the arrays among its arguments alone, and those."""
    import equinox as eqx
    import jax

    arrays, others = eqx.partition(arguments, eqx.is_array)

    def of_arrays(*arrays: Any) -> Any:
        return eqx.filter(function.__wrapped__(*eqx.combine(arrays, others)), eqx.is_array)

    return jax.jit(of_arrays), arrays


class Called(Exception):
    """Ends a fit at the call that is looked for, with the arguments of this."""


class Ending:
    """In place of a program: raises `Called`; nothing is compiled ahead."""

    def __call__(self, *arguments: Any) -> None:
        raise Called(*arguments)

    def compile_ahead(self, *arguments: Any) -> None:
        pass


def in_fit(module: Any, name: str, heights: np.ndarray) -> tuple[Any, tuple[Any, ...]]:
    """As `arrays_only`, a function of a module and the arguments with which a fit of one picture first calls it."""
    import jaxhf

    function, scene = getattr(module, name), make_scene(heights, 128)
    target = np.asarray(jaxhf.render(scene))[..., 0]

    setattr(module, name, Ending())
    try:
        jaxhf.fit([scene], [target], settings=jaxhf.Settings(edge_samples=8192))
    except Called as call:
        return arrays_only(function, *call.args)
    raise AssertionError(f"a fit does not call {name}")


def program(name: str, size: int) -> tuple[Any, tuple[Any, ...]]:
    """A function under `jax.jit`, and its arguments."""
    import jax
    import jax.numpy as jnp

    import jaxhf
    from jaxhf.scene.procedural import fractal

    heights = fractal([size, size], seed=3, exponent=2.4, range=(0.0, 0.15)).astype(np.float32)
    if name in ("linearise", "step"):
        from jaxhf.fitting.model import sample_rows
        from jaxhf.fitting.solve import steps

        module, function = (sample_rows, "_rows_of_samples") if name == "linearise" else (steps, "_advance")
        return in_fit(module, function, heights)
    if name == "frame":
        from jaxhf.preparation.localise import localise
        from jaxhf.preparation.world import make_world, resolve_settings
        from jaxhf.rendering.picture import trace_picture
        from jaxhf.xla.devices import local_mesh, on_every_device

        scene, mesh = make_scene(heights, 512), local_mesh(1)
        resolved, local = resolve_settings(jaxhf.Settings(), scene), on_every_device(localise(scene), mesh)

        def frame(scene: Any) -> Any:
            return trace_picture(make_world(scene, resolved), scene.camera, (), mesh, None)

        return jax.jit(frame), (local,)
    settings = {
        "inside": jaxhf.Settings(),
        "gradient": jaxhf.Settings(samples=4),
        "edges": jaxhf.Settings(samples=4, edge_samples=10_000),
    }[name]
    scene = make_scene(heights, 512)

    def picture(heights: Any) -> Any:
        return jaxhf.render(scene.with_heights(heights), settings)

    function = picture if name == "inside" else jax.value_and_grad(lambda heights: jnp.sum(picture(heights) ** 2))
    return jax.jit(function), (jnp.asarray(heights),)


def measure(name: str, size: int) -> dict[str, float]:
    import jax

    import jaxhf

    jax.config.update("jax_enable_compilation_cache", False)
    function, arguments = program(name, size)
    jax.clear_caches()
    cost: dict[str, float] = {}

    def timed(stage: str, work: Callable[[], Any]) -> Any:
        begin = time.process_time()
        made = work()
        cost[stage] = time.process_time() - begin
        return made

    traced = timed("trace", lambda: function.trace(*arguments))
    lowered = timed("lower", traced.lower)
    timed("compile", lambda: lowered.compile(compiler_options=jaxhf.compiler_options()))
    text = lowered.as_text()
    return cost | {"equations": sum(1 for _ in equations(traced.jaxpr.jaxpr)), "lines": text.count("\n")}


def spent(words: list[str], folder: str, cache: str) -> tuple[float, float]:
    """CPU seconds and seconds of a Python process in this folder, which keeps its programs in `cache`."""
    environment = {key: value for key, value in os.environ.items() if not key.startswith("JAX_")} | {"JAXHF_CACHE": cache}
    before, begin = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    subprocess.run([sys.executable, *words], cwd=folder, env=environment, check=True, capture_output=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, time.perf_counter() - begin


def second(run: benchmark.Run) -> None:
    readme = re.search(r"```python\n(.*?)```", (Path(__file__).parents[1] / "README.md").read_text(), re.DOTALL)
    assert readme is not None
    view = ["-m", "jaxhf", "view", "terrain.tif", "-o", "picture.png"]
    other_view = ["other.npy" if word == "terrain.tif" else word for word in view]
    others = {
        "a picture of 344 x 403 heights": {"of 310 x 360": ["-c", PICTURE, "other.npy"]},
        "a fit of 32 x 32 heights": {"of 48 x 48": ["-c", FIT, "48"]},
        "`jaxhf view`": {"with --size 700x500": [*view, "--size", "700x500"], "of 310 x 360 heights": other_view},
    }
    processes = {
        "README's Python block": ["-c", readme[1]],
        "a picture of 344 x 403 heights": ["-c", PICTURE, "terrain.tif"],
        "a fit of 32 x 32 heights": ["-c", FIT, "32"],
        "`jaxhf view`": view,
    }
    with tempfile.TemporaryDirectory() as folder:
        spent(["-c", TERRAINS], folder, "0")
        for k, (name, words) in enumerate(processes.items()):
            (first, begun), (again, ended) = (spent(words, folder, f"programs{k}") for _ in range(2))
            run.row(name, {"first, CPU s": first, "second, CPU s": again, "first, s": begun, "second, s": ended})
            for what, words in others.get(name, {}).items():
                spends, seconds = spent(words, folder, f"programs{k}")
                run.row(f"{name} {what}, after them", {"CPU s": spends, "s": seconds})
    run.end()


def main() -> None:
    run = benchmark.Run(__doc__)
    parser = run.parser
    parser.add_argument("--heights", type=int, default=256, help="a side (256)")
    parser.add_argument("--repeats", type=int, default=3, help="processes for each program, of which the median is told (3)")
    parser.add_argument("programs", nargs="*", help=f"out of {', '.join(PROGRAMS)} (all)")
    parser.add_argument("--second", action="store_true", help="first and second processes instead; POSIX alone")
    parser.add_argument("--child", help=benchmark.HIDDEN)
    options = run.parse()
    if options.child:
        print(json.dumps(measure(options.child, options.heights)))
        return
    if options.second:
        second(run)
        return
    for name in options.programs or PROGRAMS:
        command = [sys.executable, __file__, "--child", name, "--heights", str(options.heights)]
        runs = [json.loads(subprocess.check_output(command, text=True)) for _ in range(options.repeats)]
        stages = {stage: float(np.median([made[stage] for made in runs])) for stage in STAGES}
        total = float(np.median([sum(made[stage] for stage in STAGES) for made in runs]))
        counts = {"equations": runs[0]["equations"], "lines of StableHLO": runs[0]["lines"]}
        run.row(PROGRAMS[name], counts | stages | {"together, CPU s": total})
    run.end()


if __name__ == "__main__":
    main()
