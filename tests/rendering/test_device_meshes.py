"""Meshes of the caller's own: with explicit axes, set for all of JAX, and within a `shard_map` or a `pmap`.

They need several devices, which can be had only before JAX is first used: all their cases share a process of their own.
"""

import json
import subprocess
import sys

import pytest

from jaxhf.xla import devices

PROGRAM = """
import json
import sys
import warnings
import jax
jax.config.update("jax_num_cpu_devices", 4)
jax.config.update("jax_disable_most_optimizations", True)
import jax.numpy as jnp
import numpy as np
from jax.sharding import AxisType, NamedSharding, PartitionSpec as P
import jaxhf

warnings.simplefilter("ignore")  # pmap is deprecated
explicit = jax.make_mesh((4,), ("i",), axis_types=(AxisType.Explicit,))
auto = jax.make_mesh((4,), ("i",), axis_types=(AxisType.Auto,))
mixed = jax.make_mesh((2, 2), ("i", "j"), axis_types=(AxisType.Auto, AxisType.Explicit))
heights = (np.random.default_rng(0).random((5, 5)) / 5).astype(np.float32)
many = np.stack([heights * k for k in range(4)])
sharded, rows = (jax.device_put(given, NamedSharding(explicit, P("i"))) for given in (many, heights[:4]))
settings = jaxhf.Settings(shading="flat", shadows=False, chunk=64)
camera = jaxhf.Perspective.look_at((0.5, -1, 1), (0.5, 0.5, 0), fov=40, width=16, height=16)
scene = lambda h: jaxhf.Scene([jaxhf.Object(jaxhf.Heightfield(h))], camera, [jaxhf.Directional((1, 0, 0.4))])
d = np.stack([np.zeros(8), 0.02 * np.arange(8), -np.ones(8)], -1)

render = lambda h=heights, **how: jaxhf.render(scene(h), settings, **how)
prepared = lambda h=heights, **how: jaxhf.render(jaxhf.prepare(scene(h), settings, **how))
in_parts = lambda **how: render(progress=lambda done, total: None, **how)
slope = lambda h=jnp.asarray(heights), **how: jax.grad(lambda h: render(h, **how).sum())(h)
cast = lambda h=heights, **how: jaxhf.cast(jaxhf.Heightfield(h), np.array([0.5, 0.4, 3]), d).t
horizon = lambda h=heights, **how: jaxhf.horizon(h, 4, dx=0.25, **how)
short = dict(settings=settings, start=0.0, max_steps=2)
found = lambda **how: jaxhf.fit([scene(heights)], [target], unknown=jaxhf.Unknown(exposures=True), **short, **how)
fit = lambda **how: found(**how).heights
bright = lambda fit: fit.exposures[0] * jaxhf.render(fit.scenes[0], settings)
target = np.asarray(render())
ready = jaxhf.prepare(scene(heights), settings)
with jax.set_mesh(explicit):
    ready_explicit = jaxhf.prepare(scene(heights), settings)


def within(mesh, call):
    def called():
        with jax.set_mesh(mesh):
            return call()
    return called


def mapped(call, given=many, mesh=auto, check=False):
    shard = jax.shard_map(lambda h: call(h[0])[None], mesh=mesh, in_specs=P("i"), out_specs=P("i"), check_vma=check)
    return lambda: np.asarray(shard(given))[1]


WHAT = dict(render=render, prepared=prepared, in_parts=in_parts, slope=slope, horizon=horizon, fit=fit)
SAME = {f"{name} on explicit axes": (lambda call=call: call(mesh=explicit), call) for name, call in WHAT.items()}
for kind, mesh in (("explicit", explicit), ("auto", auto)):
    for name, call in {**WHAT, "cast": cast}.items():
        SAME[f"{name} within explicit axes" if mesh is explicit else f"{name} within auto axes"] = (within(mesh, call), call)
for name in ("render", "slope", "cast", "horizon", "prepared"):
    call = locals()[name]
    alone = lambda call=call: jax.jit(call)(jnp.asarray(many[1]))
    SAME[f"{name} in a shard_map"] = (mapped(call), alone)
    SAME[f"{name} in a pmap"] = (lambda call=call: jax.pmap(call)(many)[1], alone)
SAME |= {
    "the mesh that is set": (within(explicit, lambda: render(mesh=explicit)), render),
    "mixed axes": (lambda: render(mesh=mixed), render),
    "within mixed axes": (within(mixed, slope), slope),
    "jit within explicit axes": (within(explicit, lambda: jax.jit(render)(heights)), lambda: jax.jit(render)(heights)),
    "a shard_map over explicit axes": (mapped(render, sharded, explicit), lambda: jax.jit(render)(many[1])),
    "shards within explicit axes": (within(explicit, lambda: render(rows)), lambda: render(heights[:4])),
    "shards cast within explicit axes": (within(explicit, lambda: cast(rows)), lambda: cast(heights[:4])),
    "shards on explicit axes": (lambda: render(rows, mesh=explicit), lambda: render(heights[:4])),
    "a scene that is prepared outside": (mapped(lambda h: jaxhf.render(ready) + 0 * h[0, 0]), lambda: jax.jit(render)(heights)),
    "what was found within explicit axes": (within(explicit, lambda: bright(found())), lambda: bright(found())),
    "a key": (within(explicit, lambda: render(key=jax.random.key(1))), render),
}
REFUSED = {
    "another mesh": (within(explicit, lambda: render(mesh=auto)), "render: mesh must be None or that of jax.set_mesh, "),
    "a mesh in a shard_map": (mapped(lambda h: render(h, mesh=auto)), "render: mesh must be None within a shard_map or pmap"),
    "another's scene": (within(auto, lambda: jaxhf.render(ready)), "render: the scene was prepared on Mesh("),
    "a scene of explicit axes": (lambda: jaxhf.render(ready_explicit), "render: the scene was prepared on Mesh("),
    "a scene prepared and cast": (within(auto, lambda: jaxhf.cast(ready, d * 0, d).t), "cast: the scene was prepared on Mesh("),
    "a checked cast": (mapped(cast, check=True), "cast: the shard_map around it needs check_vma=False"),
    "a checked shard_map": (mapped(render, check=True), "render: the shard_map around it needs check_vma=False"),
    "a checked preparation": (mapped(prepared, check=True), "prepare: the shard_map around it needs check_vma=False"),
    "a checked map": (mapped(horizon, check=True), "horizon: the shard_map around it needs check_vma=False"),
}
said = {}
for name, (call, other) in SAME.items():
    try:
        one, two = np.asarray(call()), np.asarray(other())
        off = np.nanmax(np.abs(one - two)) / np.nanmax(np.abs(two))
        said[name] = f"off by {off}" if off > 1e-4 or one.shape != two.shape else "as it should"
    except Exception as error:
        said[name] = f"{type(error).__name__}: {error}"[:300]
for name, (call, rule) in REFUSED.items():
    try:
        call()
        said[name] = "not refused"
    except ValueError as error:
        said[name] = "as it should" if str(error).startswith(rule) and "\\n" not in str(error) else f"{error}"
print(json.dumps(said))
"""


@pytest.mark.slow  # a minute of compilation
def test_meshes_of_the_callers_own():
    done = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, timeout=1200)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert len(found) > 40
    wrong = [f"{name}: {what}" for name, what in found.items() if what != "as it should"]
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize(("backend", "counts"), [("cpu", [1, 1, 2, 152]), ("gpu", [None] * 4)])
def test_small_pictures_get_fewer_devices_of_a_cpu(monkeypatch, backend, counts):
    mesh, asked = devices.local_mesh(), []
    monkeypatch.setattr("jax.default_backend", lambda: backend)
    monkeypatch.setattr(devices, "local_mesh", lambda most: asked.append(most) or mesh)
    for rays in (1, 70_000, 140_000, 10**7):
        devices.worthwhile_mesh(rays)
    assert asked == counts
