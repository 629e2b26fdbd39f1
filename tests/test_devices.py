"""Several devices in one process, which can be had only before JAX is first used: each case in a process of its own."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

PROGRAM = """
import sys
import jax
jax.config.update("jax_num_cpu_devices", int(sys.argv[1]))
import jax.numpy as jnp
import numpy as np
import jaxhf

x = np.linspace(0, 6, 20)
heights = (0.1 * np.sin(x)[None, :] * np.cos(x)[:, None]).astype(np.float32)
scene = jaxhf.Scene(
    objects=[jaxhf.Object(jaxhf.Heightfield(jax.device_put(heights, jax.devices()[0])), jaxhf.Matte(0.7))],
    camera=jaxhf.Perspective.look_at((0.5, -0.9, 0.8), (0.5, 0.5, 0.0), width=50, height=35),
    lights=[jaxhf.Directional((1.0, 0.2, 0.3))],
)
settings = jaxhf.Settings(chunk=64, samples=4)
image, aovs = jaxhf.render(scene, settings, aovs=("depth",))
in_parts = jaxhf.render(scene, settings, progress=lambda done, total: None)
slope = jax.grad(lambda h: jnp.mean(jaxhf.render(scene.with_heights(h), settings) ** 2))(scene.heights)
np.savez(sys.argv[2], devices=jax.device_count(), image=image, depth=aovs["depth"], in_parts=in_parts, slope=slope)
"""


@pytest.fixture(scope="module")
def runs(tmp_path_factory) -> dict[int, dict[str, np.ndarray]]:
    def run(devices: int) -> dict[str, np.ndarray]:
        path: Path = tmp_path_factory.mktemp("devices") / f"{devices}.npz"
        subprocess.run([sys.executable, "-c", PROGRAM, str(devices), str(path)], check=True)
        return dict(np.load(path))

    return {devices: run(devices) for devices in (1, 4)}


def test_pictures_have_the_same_bits_on_any_number_of_devices(runs):
    assert runs[4]["devices"] == 4
    for name in ("image", "depth", "in_parts"):
        np.testing.assert_array_equal(runs[1][name], runs[4][name])
    np.testing.assert_array_equal(runs[4]["image"], runs[4]["in_parts"])
    assert runs[1]["image"].std() > 0.05


def test_derivatives_agree_on_any_number_of_devices(runs):
    """Their sums are taken in another order, in single precision."""
    slope = runs[1]["slope"]
    np.testing.assert_allclose(runs[4]["slope"], slope, atol=1e-5 * np.abs(slope).max())
    assert np.abs(slope).max() > 1e-5
