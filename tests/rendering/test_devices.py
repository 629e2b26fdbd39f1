"""Several devices and several processes, which can be had only before JAX is first used: each case in processes of its own."""

import functools
import socket
import subprocess
import sys
from collections.abc import Callable

import numpy as np
import pytest

PROGRAM = """
import dataclasses
import sys
import jax
jax.config.update("jax_num_cpu_devices", int(sys.argv[1]))
path, processes, process, port = sys.argv[2], *map(int, sys.argv[3:6])
parts = sys.argv[6:]
if processes > 1:
    jax.distributed.initialize(f"localhost:{port}", processes, process)
import jax.numpy as jnp
import numpy as np
import jaxhf

auto = 2 * (jax.sharding.AxisType.Auto,)
meshes = {"none": None}
if jax.device_count() == 4:
    meshes["all"] = jax.make_mesh((2, 2), ("down", "across"), axis_types=auto)
if "more meshes" in parts:
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
settings = jaxhf.Settings(chunk=64)
results, mesh = {}, meshes.get("all")
if "pictures" in parts:
    large = scene.with_camera(dataclasses.replace(scene.camera, width=80, height=75))  # by the program for any size
    for name, each in meshes.items():
        results[f"image {name}"] = jaxhf.render(large, settings, mesh=each)
    results["of its size"] = jaxhf.render(scene, settings, mesh=mesh)
    results["in parts"] = jaxhf.render(large, settings, progress=lambda done, total: None, mesh=mesh)
    if processes == 1 and mesh is not None:
        backwards = jax.make_mesh((2, 2), ("down", "across"), axis_types=auto, devices=jax.devices()[::-1])
        given = large.with_heights(np.asarray(heights))
        with jax.set_mesh(backwards):
            results["image backwards"] = jaxhf.render(given, settings, progress=lambda done, total: None, mesh=mesh)
    shown = jaxhf.render(large, settings, mesh=mesh)
    results["memories"] = len({shard.data.unsafe_buffer_pointer() for shard in shown.addressable_shards})
    brighter = jax.jit(lambda image: image + 1, donate_argnums=0)(shown)
    results["donated"] = np.stack([shard.data for shard in brighter.addressable_shards])
    prepared = jaxhf.prepare(large, settings, mesh=mesh)
    results["prepared"] = jaxhf.render(prepared)
    results["prepared on"] = min(len(leaf.sharding.device_set) for leaf in jax.tree.leaves(prepared._world))
    if mesh is not None:
        try:
            jaxhf.render(prepared, mesh=jax.make_mesh((4,), ("other",), axis_types=auto[:1]))
        except ValueError as error:
            results["refused"] = str(error)
jax.config.update("jax_disable_most_optimizations", True)  # pictures alone are compared bit by bit
for name, edge_samples in (("slope", 0), ("slope with edges", 600)):
    if name in parts:
        settings = jaxhf.Settings(chunk=64, edge_samples=edge_samples, shadows=False)  # a smaller program
        mean_square = lambda h: jnp.mean(jaxhf.render(scene.with_heights(h), settings, mesh=mesh) ** 2)
        results[name] = jax.grad(mean_square)(scene.heights)
view = jaxhf.Perspective.look_at((0.5, 0.5, 3.0), (0.5, 0.5, 0.0), up=(0, 1, 0), fov=18.0, width=12, height=12)
lights = [jaxhf.Directional(towards) for towards in ((1.0, 0.2, 0.7), (-0.4, 0.8, 0.7))]
small = [jaxhf.Scene([jaxhf.Object(jaxhf.Heightfield(heights[:6, :6]))], view, [light]) for light in lights]
settings = jaxhf.Settings(chunk=64, shading="flat", shadows=False)
if "horizon" in parts:
    rough = np.random.default_rng(4).uniform(size=(41, 165)).astype(np.float32)
    rough[8:11, :9] = np.nan  # of twelve tiles
    for name, each in (("all", None), ("three", meshes.get("three"))):
        found = jaxhf.horizon(rough, [0, 45, 200, 333], dx=2.0, dy=1.0, lowest=-90.0, mesh=each)
        results |= {f"horizon by {name}": found, f"devices by {name}": len(found.sharding.device_set)}
if "fitted" in parts:
    import jaxhf.fitting.solve.run as run
    import jaxhf.xla.devices as devices

    devices._LEAST_DIVIDED, advance, shares = 2, run.advance, []

    def watched(unknowns, position, expansion, *others):
        slopes = expansion.linearised[0].samples.values.slopes
        kept = max((leaf for leaf in jax.tree.leaves(position.f_info.jac) if hasattr(leaf, "size")), key=lambda leaf: leaf.size)
        shares.append([max(part.data.size for part in leaf.addressable_shards) / leaf.size for leaf in (slopes, kept)])
        return advance(unknowns, position, expansion, *others)

    run.advance = watched
    targets = [np.asarray(jaxhf.render(scene, settings, mesh=mesh)) for scene in small]
    found = jaxhf.fit(small, targets, settings=settings, start=0.0, max_steps=3, mesh=mesh)
    results |= {"fitted": found.heights, "truth": heights[:6, :6], "largest share of J": np.max(shares[-1])}
np.savez(path, devices=jax.device_count(), **results)
"""


# Devices of a process, processes, and what they compute. Derivatives and fits are the same sums over devices, whether these
# belong to one process or to two.
RUNS = {
    "one": (1, 1, ["pictures"]),
    "slope on one": (1, 1, ["slope"]),
    "four": (4, 1, ["pictures"]),
    "slope on four": (4, 1, ["slope"]),
    "some of four": (4, 1, ["pictures", "more meshes"]),
    "horizon on one": (1, 1, ["horizon"]),
    "horizon on four": (4, 1, ["horizon", "more meshes"]),
    "two processes": (2, 2, ["pictures", "slope"]),
    "more on one": (1, 1, ["slope with edges", "fitted"]),
    "more on four": (4, 1, ["slope with edges", "fitted"]),
    "fitted by two processes": (2, 2, ["fitted"]),
}
Found = Callable[[str], list[dict[str, np.ndarray]]]


@pytest.fixture(scope="module")
def found(tmp_path_factory) -> Found:
    """What each process of a run found."""

    @functools.cache
    def run(name: str) -> list[dict[str, np.ndarray]]:
        devices, processes, parts = RUNS[name]
        with socket.socket() as free:
            free.bind(("localhost", 0))
            port = free.getsockname()[1]
        paths = [tmp_path_factory.mktemp("run") / "found.npz" for _ in range(processes)]
        running = [
            subprocess.Popen([sys.executable, "-c", PROGRAM, *map(str, (devices, path, processes, process, port)), *parts])
            for process, path in enumerate(paths)
        ]
        try:
            assert [process.wait(timeout=600) for process in running] == [0] * processes
        finally:
            for process in running:
                process.kill()
        return [dict(np.load(path)) for path in paths]

    return run


FURTHER = [pytest.param("some of four", marks=pytest.mark.slow), pytest.param("two processes", marks=pytest.mark.deep)]


@pytest.mark.parametrize("name", ["four", *FURTHER])
def test_pictures_have_the_same_bits_on_any_number_of_devices(found, name):
    (one,) = found("one")
    for each in found(name):
        assert each["devices"] == 4
        assert each["image none"].shape == (75, 80, 3)
        pictures = [name for name in each if name.startswith("image")]
        assert len(pictures) == {"four": 3, "some of four": 5, "two processes": 2}[name]
        assert each["prepared on"] == 4  # or each frame would copy the terrain to the others
        np.testing.assert_array_equal(each["of its size"], one["of its size"])
        for picture in (*pictures, "in parts", "prepared"):
            np.testing.assert_array_equal(each[picture], one["image none"], err_msg=picture)
        assert each["memories"] == 1  # all devices of a process share the picture's, which a program may not change
        for donated in each["donated"]:
            np.testing.assert_array_equal(donated, one["image none"] + 1)
        assert "render: the scene was prepared on Mesh" in str(each["refused"])
    assert one["image none"].std() > 0.05


@pytest.mark.parametrize(
    "name", [pytest.param("slope on four", marks=pytest.mark.slow), pytest.param("two processes", marks=pytest.mark.deep)]
)
def test_derivatives_agree(found, name):
    """Their sums are taken in another order, in single precision."""
    slope = found("slope on one")[0]["slope"]
    for each in found(name):
        np.testing.assert_allclose(each["slope"], slope, atol=1e-5 * np.abs(slope).max())
    assert np.abs(slope).max() > 1e-5


@pytest.mark.deep
def test_derivatives_of_boundaries_agree_over_devices(found):
    """In single precision a sample of a boundary may go to the next edge."""
    (one,), (four,) = found("more on one"), found("more on four")
    with_edges, slope = one["slope with edges"], found("slope on one")[0]["slope"]
    assert np.linalg.norm(four["slope with edges"] - with_edges) < 0.1 * np.linalg.norm(with_edges)
    assert np.linalg.norm(with_edges - slope) > 0.2 * np.linalg.norm(slope)


@pytest.mark.deep
def test_horizons_have_the_same_bits_on_any_number_of_devices(found):
    """On all four of a process, which is the default, and on three by `mesh`."""
    (one,), (four,) = found("horizon on one"), found("horizon on four")
    assert (four["devices by all"], four["devices by three"]) == (4, 3)
    for name in ("all", "three"):
        np.testing.assert_array_equal(four[f"horizon by {name}"], one["horizon by all"], name)


@pytest.mark.deep
@pytest.mark.parametrize("name", ["more on four", "fitted by two processes"])
def test_fits_agree_over_devices_each_of_which_has_a_part_of_the_derivative(found, name):
    """What sums in another order change in single precision, iterations enlarge: 2e-4 was seen."""
    (one,) = found("more on one")
    assert one["largest share of J"] == 1
    for each in found(name):
        np.testing.assert_allclose(each["fitted"], one["fitted"], atol=1e-3 * np.ptp(one["truth"]))
        assert each["largest share of J"] == 1 / 4
    assert np.std(one["fitted"] - one["truth"]) < 0.5 * np.std(one["truth"])
