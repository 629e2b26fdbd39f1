"""Derivatives of rough terrain in low light beside central differences: what triangles that turn from the light leave out.

White noise on 40 x 40 heights, and its interpolation to 157 x 157, on a slope that rises to the east by a fifth; light from the
north. The mean of the picture is differentiated by the light's azimuth and altitude and by the height of the noise. Printed are
ratios of `jax.grad` with 50,000 points on edges to central differences with two steps, of sums over some noises.
"""

import functools

import benchmark
import jax
import jax.numpy as jnp
import numpy as np
from scipy.interpolate import make_interp_spline

import jaxhf
from jaxhf.core.settings import Shading

SIDE = 40
STEPS = np.array([[2, 2, 0.08], [1, 1, 0.04]], np.float32)
NAMES = ("azimuth", "altitude", "relief")
CASES: tuple[tuple[Shading, int], ...] = (("smooth", SIDE), ("smooth", 4 * SIDE - 3), ("flat", SIDE))


def mean(settings: jaxhf.Settings, heights: jax.Array, at: jax.Array) -> jax.Array:
    """The mean of the picture, at an azimuth and an altitude in degrees and a factor on the heights, shape (3,)."""
    azimuth, altitude = jnp.deg2rad(at[0]), jnp.deg2rad(at[1])
    level = jnp.cos(altitude)
    towards = jnp.stack([jnp.sin(azimuth) * level, jnp.cos(azimuth) * level, jnp.sin(altitude)])
    heights = at[2] * heights + 0.2 * jnp.linspace(0, 1, len(heights))
    camera = jaxhf.Orthographic.look_at((0.5, 0.5, 2), (0.5, 0.5, 0), (0, 1, 0), 0.9, width=24, height=24)
    scene = jaxhf.Scene([jaxhf.Object(jaxhf.Heightfield(heights), jaxhf.Matte(1.0))], camera, [jaxhf.Directional(towards)])
    return jaxhf.render(scene, settings).mean()


def main() -> None:
    run = benchmark.Run(__doc__, claims="that derivatives of flat shading are right, of the light to 0.03, of heights to 0.02")
    run.parser.add_argument("--noises", type=int, default=8)
    noises = run.parse().noises
    for shading, side in CASES:
        finer = make_interp_spline(np.linspace(0, 1, SIDE), np.eye(SIDE))(np.linspace(0, 1, side))
        value = jax.jit(functools.partial(mean, jaxhf.Settings(samples=400, shading=shading)))
        points = jaxhf.Settings(samples=64, shading=shading, edge_samples=50_000)
        gradient = jax.jit(jax.grad(functools.partial(mean, points), argnums=1))
        for altitude in (5, 10, 20, 30):
            at = np.array([0, altitude, 1], np.float32)
            by_grad, differences = np.zeros(3), np.zeros((2, 3))
            for seed in range(noises):
                heights = finer @ np.random.default_rng(seed).normal(0, 0.004, (SIDE, SIDE)) @ finer.T
                heights = heights.astype(np.float32)
                by_grad += gradient(heights, at)
                for k, parameter in np.ndindex(2, 3):
                    step = STEPS[k, parameter] * np.eye(3, dtype=np.float32)[parameter]
                    ahead, behind = value(heights, at + step), value(heights, at - step)
                    differences[k, parameter] += (ahead - behind) / (2 * STEPS[k, parameter])
            ratios = (by_grad / differences).T
            title = f"{shading}, {side} x {side}, {altitude} degrees"
            names = [f"{name}, {step}" for name in NAMES for step in ("step", "half of it")]
            run.row(title, dict(zip(names, ratios.ravel(), strict=True)))
            off = np.abs(ratios[:, 1] - 1)
            if shading == "flat":
                right = max(off[:2]) < 0.03 and off[2] < 0.02
                run.claim(right, f"{title}: ratios are off by {off.round(4)}, at most 0.03, 0.03 and 0.02")
    run.end()


if __name__ == "__main__":
    main()
