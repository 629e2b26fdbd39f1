"""What `materialise` is worth: frames with it, with nothing in its place, and with `lax.optimization_barrier`."""

import re
import sys
from collections.abc import Callable
from pathlib import Path

import benchmark
import jax
from forward import report, scene, terrain

import jaxhf
from jaxhf.preparation.localise import localise
from jaxhf.preparation.world import make_world, resolve_settings
from jaxhf.rendering.picture import trace_picture
from jaxhf.xla.devices import local_mesh
from jaxhf.xla.materialise import materialise

FORMS: dict[str, Callable] = {
    "materialise": materialise,
    "nothing": lambda tree: tree,
    "optimization_barrier": jax.lax.optimization_barrier,
}
USERS = [
    module
    for name, module in sys.modules.items()
    if name.startswith("jaxhf.")
    and vars(module).get("materialise") is materialise
    and name != materialise.__module__  # where the places of gathers are kept
]


def compiled(base: jaxhf.Scene, settings: jaxhf.Settings, form: Callable) -> tuple[Callable[[], object], int]:
    """One frame as a function, and how many instructions its fused kernels hold."""
    for module in USERS:
        vars(module)["materialise"] = form
    jax.clear_caches()
    local = localise(base)
    settings = resolve_settings(settings, base)
    frame = jax.jit(lambda local: trace_picture(make_world(local, settings), local.camera, (), local_mesh(), None))
    program = frame.lower(local).compile(compiler_options=jaxhf.compiler_options())
    bodies = re.findall(r"^%?fused_computation\S* .*?\{\n(.*?)^\}", program.as_text() or "", re.M | re.S)
    return lambda: jax.block_until_ready(program(local)), sum(body.count("\n") for body in bodies)


def main() -> None:
    run = benchmark.Run(__doc__, claims="that with it kernels hold fewer instructions than with nothing in its place")
    run.parse()
    landsea = jaxhf.load_scene(Path(__file__).parents[1] / "scenes" / "landsea.toml")
    cases = {
        "landsea without mirrors": (landsea, jaxhf.Settings(samples=1, max_depth=0)),
        "landsea": (landsea, jaxhf.Settings(samples=1)),
        "64² heights, camera B": (scene(terrain(64), "B"), jaxhf.Settings()),
    }
    for title, (base, settings) in cases.items():
        programs = {name: compiled(base, settings, form) for name, form in FORMS.items()}
        report(run, title, {f"{name}, {count}": frame for name, (frame, count) in programs.items()}, repeats=5)
        ours, without = programs["materialise"][1], programs["nothing"][1]
        run.claim(ours < without, f"{title}: {ours} fused instructions, fewer than {without}")
    run.end()


if __name__ == "__main__":
    main()
