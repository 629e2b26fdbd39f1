"""JAX's flags, Python's, and JAX's transformations: none changes what is computed. One process a flag, one small scene."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

pytestmark = pytest.mark.slow  # a process is a few seconds, a first one without a cache half a minute

SCENE = """
import sys
import jax
if "-" not in sys.argv[2]:
    jax.config.update("jax_num_cpu_devices", int(sys.argv[2]))
import jax.numpy as jnp
import numpy as np
import jaxhf

heights = (np.random.default_rng(0).random((5, 5)) / 5).astype(np.float32)
settings = jaxhf.Settings(shading="flat", chunk=64)
camera = jaxhf.Perspective.look_at((0.5, -1, 1), (0.5, 0.5, 0), fov=40, width=16, height=16)

def scene(h):
    return jaxhf.Scene([jaxhf.Object(jaxhf.Heightfield(h))], camera, [jaxhf.Directional((1, 0, 0.4))])

def render(h):
    return jaxhf.render(scene(h), settings)

def loss(h):
    return jnp.mean(render(h) ** 2)
"""

PROGRAM = (
    SCENE
    + """
found = {"render": render(heights)}
picture, layers = jaxhf.render(scene(heights), settings, aovs=("depth", "normal", "shadow"))
found |= {"with layers": picture, **layers}
found["jit"] = jax.jit(render)(heights)
found["gradient"] = jax.grad(loss)(jnp.asarray(heights))
hit = jaxhf.cast(jaxhf.Heightfield(heights), np.array([0.5, 0.4, 3]), np.array([[0, 0, -1], [0.1, 0.05, -1], [0, 0, 1]]))
found |= {"cast": hit.t, "cast normal": hit.n}
found["prepared"] = jaxhf.render(jaxhf.prepare(scene(heights), settings))
found["hillshade"] = jaxhf.hillshade(heights, dx=0.25)
np.savez(sys.argv[1], **found)
"""
)

# flag: what the environment has, Python's options, and the number of CPU devices where it is not one
FLAGS: dict[str, tuple[dict[str, str], list[str], str]] = {
    "none": ({}, [], "-"),
    "x64": ({"JAX_ENABLE_X64": "1"}, [], "-"),
    "debug nans": ({"JAX_DEBUG_NANS": "1"}, [], "-"),
    "rank promotion": ({"JAX_NUMPY_RANK_PROMOTION": "raise"}, [], "-"),
    "dtype promotion": ({"JAX_NUMPY_DTYPE_PROMOTION": "strict"}, [], "-"),
    "tracer leaks": ({"JAX_CHECK_TRACER_LEAKS": "1"}, [], "-"),
    "checks": ({"JAX_ENABLE_CHECKS": "1"}, [], "-"),
    "bfloat16": ({"JAX_DEFAULT_MATMUL_PRECISION": "bfloat16"}, [], "-"),
    "cache": ({"JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}, [], "-"),
    "4 host devices": ({"XLA_FLAGS": "--xla_force_host_platform_device_count=4"}, [], "-"),
    "3 CPU devices": ({}, [], "3"),
    "warnings": ({}, ["-W", "error"], "-"),
    "development mode": ({}, ["-X", "dev"], "-"),
    "without assertions": ({}, ["-OO"], "-"),
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("flags")


def run(folder: Path, name: str) -> dict[str, np.ndarray]:
    environment, options, devices = FLAGS[name]
    path = folder / f"{name}.npz"
    if not path.exists():
        kept = {"JAX_COMPILATION_CACHE_DIR": str(folder / "cache"), **os.environ, **environment}
        command = [sys.executable, *options, "-c", PROGRAM, str(path), devices]
        done = subprocess.run(command, env=kept, capture_output=True, text=True, timeout=600)
        assert done.returncode == 0, done.stderr[-3000:]
    return dict(np.load(path))


@pytest.mark.parametrize("name", [name for name in FLAGS if name != "none"])
def test_a_flag_changes_no_bit(folder, name):
    expected, found = run(folder, "none"), run(folder, name)
    assert expected.keys() == found.keys()
    assert np.abs(expected["gradient"]).max() > 1e-3
    for key, value in expected.items():
        assert found[key].dtype == value.dtype
        if key == "gradient" and "devices" in name:  # a sum over devices
            np.testing.assert_allclose(found[key], value, rtol=0, atol=6e-6 * np.abs(value).max())
        else:
            np.testing.assert_array_equal(found[key], value, err_msg=key)


TRANSFORMED = (
    SCENE
    + """
h = jnp.asarray(heights)
change = jnp.asarray(np.random.default_rng(1).standard_normal(h.shape).astype(np.float32))
picture, slope = render(h), jax.grad(loss)(h)
moved = jax.jvp(render, (h,), (change,))[1]
two = jnp.stack([h, h])
yes, zero, one = jnp.asarray(True), jnp.asarray(0), jnp.asarray(1)

@jax.custom_vjp
def own(h):
    return render(h)

own.defvjp(lambda h: (render(h), h), lambda h, cotangent: jax.vjp(render, h)[1](cotangent))
linear = jax.linearize(render, h)[1]
policies = jax.checkpoint_policies

def kept(policy):
    return lambda: jax.jit(jax.grad(jax.checkpoint(loss, policy=policy)))(h)

CASES = {
    "jit": (lambda: jax.jit(render)(h), picture),
    "vmap": (lambda: jax.vmap(render)(two)[1], picture),
    "scan": (lambda: jax.lax.scan(lambda carry, h: (carry, render(h)), 0, two)[1][1], picture),
    "fori": (lambda: jax.lax.fori_loop(0, 2, lambda k, _: render(h), picture * 0), picture),
    "while": (lambda: jax.lax.while_loop(lambda c: c[0] < 1, lambda c: (c[0] + 1, render(h)), (zero, picture * 0))[1], picture),
    "cond": (lambda: jax.jit(lambda yes: jax.lax.cond(yes, render, lambda h: picture * 0, h))(yes), picture),
    "switch": (lambda: jax.jit(lambda k: jax.lax.switch(k, [lambda h: picture * 0, render], h))(one), picture),
    "jvp": (lambda: jax.jit(lambda h: jax.jvp(render, (h,), (change,))[1])(h), moved),
    "linearize": (lambda: linear(change), moved),
    "vjp": (lambda: jax.vjp(loss, h)[1](jnp.ones(()))[0], slope),
    "linear_transpose": (lambda: jax.linear_transpose(linear, h)(2 * picture / picture.size)[0], slope),
    "nothing saved": (kept(policies.nothing_saveable), slope),
    "everything saved": (kept(policies.everything_saveable), slope),
    "products saved": (kept(policies.dots_saveable), slope),
    "products without a batch saved": (kept(policies.dots_with_no_batch_dims_saveable), slope),
    "custom_vjp": (lambda: jax.grad(lambda h: jnp.mean(own(h) ** 2))(h), slope),
    "donation": (lambda: jax.jit(loss_and_step, donate_argnums=0)(jnp.array(heights))[1], slope),
    "ahead of time": (lambda: jax.jit(render).lower(h).compile()(h), picture),
}

def loss_and_step(h):
    slope = jax.grad(loss)(h)
    return h - 0.1 * slope, slope

found = {}
for name, (call, expected) in CASES.items():
    value = np.asarray(call())
    found[name] = np.abs(value - np.asarray(expected)).max() / np.abs(np.asarray(expected)).max()
    assert value.shape == expected.shape
np.savez(sys.argv[1], **found)
"""
)


def test_transformations_give_the_plain_call(folder):
    """Within rounding: a program of another form rounds otherwise."""
    path = folder / "transformed.npz"
    kept = {**os.environ, "JAX_COMPILATION_CACHE_DIR": str(folder / "cache"), "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
    command = [sys.executable, "-c", TRANSFORMED, str(path), "-"]
    done = subprocess.run(command, env=kept, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stderr[-3000:]
    found = {name: float(off) for name, off in np.load(path).items()}
    assert len(found) == 18
    assert {name: off for name, off in found.items() if not off < 2e-5} == {}
