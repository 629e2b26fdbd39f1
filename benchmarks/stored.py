"""What `stored` is worth: frames with it, with nothing in its place, and with `lax.optimization_barrier`."""

import re
from collections.abc import Callable
from pathlib import Path

import jax
from forward import report, scene, terrain

import jaxhf
from jaxhf.boundary import term as _boundaries
from jaxhf.core import materialise as _store
from jaxhf.core.devices import local_mesh
from jaxhf.rendering import render as _render
from jaxhf.scene.localise import localise
from jaxhf.shade import lighting as _lighting
from jaxhf.trace import intersect as _hit, normals as _normals, world as _world
from jaxhf.trace.world import settle

USERS = (_boundaries, _normals, _hit, _render, _lighting, _world)
FORMS: dict[str, Callable] = {
    "stored": _store.stored,
    "nothing": lambda tree, sure: tree,
    "optimization_barrier": lambda tree, sure: jax.lax.optimization_barrier(tree),
}


def compiled(base: jaxhf.Scene, settings: jaxhf.Settings, form: Callable) -> tuple[Callable[[], object], int]:
    """One frame as a function, and how many instructions its fused kernels hold."""
    for module in USERS:
        vars(module)["stored"] = form
    jax.clear_caches()
    local = localise(base)
    program = _render._trace_all.lower(local, settle(settings, base), (), local_mesh(), None).compile()
    bodies = re.findall(r"^%?fused_computation\S* .*?\{\n(.*?)^\}", program.as_text() or "", re.M | re.S)
    return lambda: jax.block_until_ready(program(local)), sum(body.count("\n") for body in bodies)


def main() -> None:
    landsea = jaxhf.load_scene(Path(__file__).parents[1] / "scenes" / "landsea.toml")
    cases = {
        "landsea without mirrors": (landsea, jaxhf.Settings(samples=1, max_depth=0)),
        "landsea": (landsea, jaxhf.Settings(samples=1)),
        "64² heights, camera B": (scene(terrain(64), "B"), jaxhf.Settings()),
    }
    for title, (base, settings) in cases.items():
        programs = {name: compiled(base, settings, form) for name, form in FORMS.items()}
        report(title, {f"{name}, {count}": frame for name, (frame, count) in programs.items()}, repeats=5)


if __name__ == "__main__":
    main()
