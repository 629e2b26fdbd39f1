"""Several devices and several processes, which can be had only before JAX is first used: each case in processes of its own."""

import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

PROGRAM = """
import sys
import jax
jax.config.update("jax_num_cpu_devices", int(sys.argv[1]))
path, processes, process, port = sys.argv[2], *map(int, sys.argv[3:])
if processes > 1:
    jax.distributed.initialize(f"localhost:{port}", processes, process)
import jax.numpy as jnp
import numpy as np
import jaxhf

auto = 2 * (jax.sharding.AxisType.Auto,)
meshes = {"none": None}
if jax.device_count() == 4:
    meshes["all"] = jax.make_mesh((2, 2), ("down", "across"), axis_types=auto)
if jax.local_device_count() == 4:
    meshes["three"] = jax.make_mesh((1, 3), ("a", "b"), axis_types=auto, devices=jax.devices()[1:])
    meshes["last"] = jax.make_mesh((1, 1), ("a", "b"), axis_types=auto, devices=jax.devices()[3:])
x = np.linspace(0, 6, 20)
heights = (0.1 * np.sin(x)[None, :] * np.cos(x)[:, None]).astype(np.float32)
if processes == 1:
    heights = jax.device_put(heights, jax.devices()[0])
scene = jaxhf.Scene(
    objects=[jaxhf.Object(jaxhf.Heightfield(heights), jaxhf.Matte(0.7))],
    camera=jaxhf.Perspective.look_at((0.5, -0.9, 0.8), (0.5, 0.5, 0.0), width=50, height=35),
    lights=[jaxhf.Directional((1.0, 0.2, 0.3))],
)
settings = jaxhf.Settings(chunk=64, samples=4)
results = {}
for name, mesh in meshes.items():
    image, aovs = jaxhf.render(scene, settings, aovs=("depth",), mesh=mesh)
    results |= {f"image {name}": image, f"depth {name}": aovs["depth"]}
mesh = meshes.get("all")
results["in parts"] = jaxhf.render(scene, settings, progress=lambda done, total: None, mesh=mesh)
prepared = jaxhf.prepare(scene, settings, mesh=mesh)
results["prepared"] = jaxhf.render(prepared)
for name, edge_samples in (("slope", 0), ("slope with edges", 600)):
    settings = jaxhf.Settings(chunk=64, edge_samples=edge_samples)
    results[name] = jax.grad(lambda h: jnp.mean(jaxhf.render(scene.with_heights(h), settings, mesh=mesh) ** 2))(scene.heights)
view = jaxhf.Perspective.look_at((0.5, 0.5, 3.0), (0.5, 0.5, 0.0), up=(0, 1, 0), fov=18.0, width=12, height=12)
lights = [jaxhf.Directional(towards) for towards in ((1.0, 0.2, 0.7), (-0.4, 0.8, 0.7))]
small = [jaxhf.Scene([jaxhf.Object(jaxhf.Heightfield(heights[:6, :6]))], view, [light]) for light in lights]
settings = jaxhf.Settings(chunk=64)
targets = [np.asarray(jaxhf.render(scene, settings, mesh=mesh)) for scene in small]
found = jaxhf.fit(small, targets, settings=settings, start=0.0, levels=(1.0,), max_steps=3, mesh=mesh)
results |= {"fitted": found.heights, "truth": heights[:6, :6]}
if mesh is not None:
    try:
        jaxhf.render(prepared, mesh=jax.make_mesh((4,), ("other",), axis_types=auto[:1]))
    except ValueError as error:
        results["refused"] = str(error)
np.savez(path, devices=jax.device_count(), **results)
"""


def _run(folder: Path, devices: int, processes: int = 1) -> list[dict[str, np.ndarray]]:
    """What each process found."""
    with socket.socket() as free:
        free.bind(("localhost", 0))
        port = free.getsockname()[1]
    paths = [folder / f"{process}.npz" for process in range(processes)]
    running = [
        subprocess.Popen([sys.executable, "-c", PROGRAM, str(devices), str(path), str(processes), str(process), str(port)])
        for process, path in enumerate(paths)
    ]
    try:
        assert [process.wait(timeout=600) for process in running] == [0] * processes
    finally:
        for process in running:
            process.kill()
    return [dict(np.load(path)) for path in paths]


@pytest.fixture(scope="module")
def one(tmp_path_factory) -> dict[str, np.ndarray]:
    return _run(tmp_path_factory.mktemp("one"), devices=1)[0]


@pytest.fixture(scope="module", params=["4 devices", "2 processes"])
def many(request, tmp_path_factory) -> list[dict[str, np.ndarray]]:
    devices, processes = (4, 1) if request.param == "4 devices" else (2, 2)
    return _run(tmp_path_factory.mktemp("many"), devices, processes)


def test_pictures_have_the_same_bits_on_any_number_of_devices(one, many):
    for found in many:
        assert found["devices"] == 4
        pictures = [name for name in found if name.startswith("image")]
        assert len(pictures) == (4 if len(many) == 1 else 2)
        for name in (*pictures, "in parts", "prepared"):
            np.testing.assert_array_equal(found[name], one["image none"], err_msg=name)
        for name in pictures:
            np.testing.assert_array_equal(found[name.replace("image", "depth")], one["depth none"])
    assert one["image none"].std() > 0.05


def test_derivatives_agree_on_any_number_of_devices(one, many):
    """Their sums are taken in another order, in single precision; a point on an edge may then go to the next edge."""
    slope, with_edges = one["slope"], one["slope with edges"]
    for found in many:
        np.testing.assert_allclose(found["slope"], slope, atol=1e-5 * np.abs(slope).max())
        assert np.linalg.norm(found["slope with edges"] - with_edges) < 0.1 * np.linalg.norm(with_edges)
    assert np.abs(slope).max() > 1e-5
    assert np.linalg.norm(with_edges - slope) > 0.2 * np.linalg.norm(slope)


def test_fits_agree_on_any_number_of_devices(one, many):
    """What sums in another order change in single precision, the iterations of LSMR enlarge: 2e-4 was seen."""
    for found in many:
        np.testing.assert_allclose(found["fitted"], one["fitted"], atol=1e-3 * np.ptp(one["truth"]))
    assert np.std(one["fitted"] - one["truth"]) < 0.5 * np.std(one["truth"])


def test_a_prepared_scene_is_not_rendered_on_another_mesh(many):
    for found in many:
        assert "render: the scene was prepared on Mesh" in str(found["refused"])
