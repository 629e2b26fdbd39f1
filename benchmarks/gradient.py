"""Accuracy and time of the picture's derivative with respect to heights, with and without moving boundaries.

The common work of `--peers` (a folder with common_work.py and gradient_B_low.npz, or `--reference`, an npz of the same
form for another camera and light): relative error and cosine against central differences, the median over directions; and
the noise of the edge points alone, from two keys.
"""

import argparse
import importlib.util
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxhf


def common_work(peers: Path) -> Any:
    spec = importlib.util.spec_from_file_location("common_work", peers / "common_work.py")
    assert spec is not None
    assert spec.loader is not None
    work = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(work)
    return work


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--peers", type=Path, required=True)
    parser.add_argument("--reference", type=Path)
    parser.add_argument("--camera", default="B")
    parser.add_argument("--light", default="low")
    parser.add_argument("--samples", type=int, default=16)
    parser.add_argument("--edge-samples", type=int, nargs="*", default=[0, 10000, 100000])
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    work = common_work(options.peers)
    reference = np.load(options.reference or options.peers / "gradient_B_low.npz")
    heights, directions = work.bumps(64)
    names = [name for name in directions if name in reference]
    eye, target, fov = work.CAMERAS[options.camera]
    scene = jaxhf.Scene(
        [jaxhf.Object(jaxhf.Heightfield(jnp.asarray(heights)), jaxhf.Matte(work.ALBEDO))],
        jaxhf.Perspective.look_at(eye, target, fov=fov, width=128, height=128),
        [jaxhf.Directional(work.light(options.light))],
    )
    print(f"{'points':>8} {'cosine':>8} {'error':>8} {'noise':>8} {'value and gradient, ms':>24}")
    for count in options.edge_samples:
        settings = jaxhf.Settings(normals="six-angle", samples=options.samples, edge_samples=count)

        def picture(heights: jax.Array, key: jax.Array, settings: jaxhf.Settings = settings) -> jax.Array:
            return jaxhf.render(scene.with_heights(heights), settings, key=key)[..., 0]

        @jax.jit
        def along(direction: jax.Array, key: jax.Array, picture: Any = picture) -> jax.Array:
            return jax.jvp(lambda heights: picture(heights, key), (jnp.asarray(heights),), (direction,))[1]

        gradient = jax.jit(jax.value_and_grad(lambda heights, key, picture=picture: jnp.sum(picture(heights, key) ** 2)))
        errors, cosines, noises = [], [], []
        for name in names:
            expected = np.asarray(reference[name], float)
            one, two = (np.asarray(along(jnp.asarray(directions[name]), jax.random.key(k))) for k in (0, 1))
            size = np.linalg.norm(expected)
            errors.append(np.linalg.norm(one - expected) / size)
            cosines.append(np.vdot(one, expected) / np.linalg.norm(one) / size)
            noises.append(np.linalg.norm(one - two) / np.sqrt(2) / size)
        times = []
        for k in range(6):
            start = time.perf_counter()
            jax.block_until_ready(gradient(jnp.asarray(heights), jax.random.key(k)))
            times.append(time.perf_counter() - start)
        summary = [np.median(values) for values in (cosines, errors, noises)]
        print(f"{count:8} {summary[0]:8.4f} {summary[1]:8.4f} {summary[2]:8.4f} {1e3 * np.median(times[1:]):24.0f}", flush=True)


if __name__ == "__main__":
    main()
