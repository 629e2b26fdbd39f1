"""Without JAX's insides all is the same, only slower; and what JAX does not take is done without by itself."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxhf

HEIGHTS = (np.random.default_rng(0).random((9, 9)) / 5).astype(np.float32)
EDGES = jaxhf.Settings(edge_samples=512)


def scene(heights) -> jaxhf.Scene:
    camera = jaxhf.Perspective.look_at((0.5, -1, 1), (0.5, 0.5, 0), fov=40, width=16, height=16)
    return jaxhf.Scene([jaxhf.Object(jaxhf.Heightfield(heights))], camera, [jaxhf.Directional((1, 0, 0.4))])


def outcomes(every: bool) -> dict[str, Any]:
    """A picture and rays; if `every`, also derivatives with points on edges both ways, a batch, and a fit."""
    heights, up = jnp.asarray(HEIGHTS), np.array([0.1, 0.2, 1], np.float32)

    def picture(heights):
        return jaxhf.render(scene(heights), EDGES)

    places = np.random.default_rng(1).random((20, 2), np.float32)
    hits = jaxhf.cast(scene(heights).heightfields[0], np.c_[places, np.ones((20, 1), np.float32)], -up)
    found = {"t": jnp.where(hits.t < 9, hits.t, 0), "normals": hits.ns, "image": jaxhf.render(scene(heights))}
    if not every:
        return found
    known, target = scene(0.9 * HEIGHTS), np.asarray(jaxhf.render(scene(HEIGHTS)))
    fitted = jaxhf.fit([known], [target], noise=0.01, prior=jaxhf.Prior(known.heights, 0.02), max_steps=3)
    both = jax.vmap(lambda heights: jaxhf.render(scene(heights)))(jnp.stack([heights, 2 * heights]))
    _, tangent = jax.jvp(picture, (heights,), (heights**2,))
    gradient = jax.grad(lambda heights: (picture(heights) ** 2).sum())(heights)
    more = {"tangent": tangent, "gradient": gradient, "both": both, "fitted": fitted.heights}
    return {**found, **more, "within": jax.jit(picture)(heights)}


def in_another_process(script: str, *arguments: str, **environment: str) -> str:
    paths = os.pathsep.join(map(str, (Path(__file__).parent, Path(jaxhf.__file__).parents[1])))
    environment = os.environ | {"PYTHONPATH": paths} | environment
    done = subprocess.run([sys.executable, "-c", script, *arguments], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stderr


def is_plain(every: bool) -> bool:
    def total(heights):
        return jaxhf.render(scene(heights)).sum()

    text = jax.jit(jax.grad(total) if every else total).lower(HEIGHTS).as_text()
    (answer,) = {jaxhf.compiler_options() is None, "small_call" not in text, *(["inlineable" not in text] if every else [])}
    return answer


@pytest.mark.deep
@pytest.mark.parametrize("every", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_plain_mode_gives_the_same(every, tmp_path):
    script = f"import numpy, sys, test_plain as t; numpy.savez(sys.argv[1], **t.outcomes({every})); assert t.is_plain({every})"
    assert not in_another_process(script, str(tmp_path / "plain.npz"), JAXHF_PLAIN="1")
    assert not is_plain(every)
    usual, plain = outcomes(every), np.load(tmp_path / "plain.npz")
    for name in plain.files:
        size = np.abs(plain[name]).max()
        assert size > 0
        # Sums in another order: single precision; a step of the fit multiplies that by what it solves.
        np.testing.assert_allclose(usual[name], plain[name], atol=size * (1e-3 if name == "fitted" else 1e-5), err_msg=name)


TRY_OUT = "from jaxhf.xla import insides; insides.TRIED = (0, 0)"  # as for a newer JAX
BREAKS = {
    "an import": "import sys; sys.modules['jax.experimental.serialize_executable'] = None",
    "a lowering": f"{TRY_OUT}; insides.ir.DictAttr = None",
    "a rule": f"{TRY_OUT}; insides.jaxpr_as_fun = None",
}


@pytest.mark.parametrize("name", ["a lowering", *(pytest.param(n, marks=pytest.mark.deep) for n in ("an import", "a rule"))])
def test_what_jax_does_not_take_is_done_without(name):
    """With one warning, which names the version."""
    script = (
        f"{BREAKS[name]}\n"
        "import numpy as np, jaxhf, test_plain\n"
        "images = [jaxhf.render(test_plain.scene(z)) for z in (test_plain.HEIGHTS, 2 * test_plain.HEIGHTS)]\n"
        "assert 0.01 < images[0].mean() < 1\n"
    )
    said = in_another_process(script)
    assert said.count(f"jaxhf is slower than it could be: JAX {jax.__version__} does not take its kernels (") == 1, said


def test_jax_takes_the_kernels():
    from jaxhf.xla import insides  # here, as another process breaks it before it imports this module

    insides.try_out()
    assert jax.__version_info__[:2] <= insides.TRIED, "a newer JAX: run all tests with it, then say so in insides.py"
