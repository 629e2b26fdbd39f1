"""What a sun's chords cost and gain: penumbras beside the mean of 1024 directional lights, in 129 x 129 heights and pixels.

Two towers 0.35 high, of 9 vertices a side and of one, under a sun in the west, 30 degrees high and 5 degrees wide, seen from
above; and Jacksboro, azimuth 315, altitude 8, the disc of 4 degrees. Errors are those of ground that sees 1 to 99 % of the
lights, in shares of level ground in the whole sun; times are medians of prepared frames in turn, in units of that
with 8 chords.
"""

import time

import benchmark
import jax
import jax.numpy as jnp
import numpy as np

import jaxhf

CHORDS = (4, 8, 16, 32, 64)
SIZE = 128
MOST = {8: 0.0125, 16: 0.0085, 32: 0.003, 64: 0.001}  # the mean errors of docs/measurements/sun-chords.csv, and a little more
SETTINGS = jaxhf.Settings(samples=9)


def spread(towards: np.ndarray, diameter: float, count: int) -> np.ndarray:
    """Directions evenly over a disc, on Vogel's spiral (Mathematical Biosciences 44, 1979)."""
    side = np.cross(towards, (0, 0, 1))
    side /= np.linalg.norm(side)
    k = np.arange(count)
    off, turn = np.sqrt((k + 0.5) / count) * np.deg2rad(diameter) / 2, k * np.pi * (3 - np.sqrt(5))
    found = towards + np.outer(off * np.cos(turn), side) + np.outer(off * np.sin(turn), np.cross(side, towards))
    return found / np.linalg.norm(found, axis=1, keepdims=True)


def towers(half: float) -> tuple[jaxhf.Heightfield, float, float, float]:
    y, x = np.mgrid[0:129, 0:129]
    z = np.where((abs(x - 64) <= half) & (abs(y - 64) <= half), 0.35, 0)
    return jaxhf.Heightfield(z.astype(np.float32)), 270.0, 30.0, 5.0


def jacksboro() -> tuple[jaxhf.Heightfield, float, float, float]:
    terrain = jaxhf.jacksboro()
    heights = terrain.heights[100:229, 100:229].astype(np.float32)
    return jaxhf.Heightfield(heights, terrain.dx, terrain.dy), 315.0, 8.0, 4.0


def main() -> None:
    run = benchmark.Run(__doc__, needs="matplotlib (Jacksboro's heights)", claims="bounds of the mean error for 8 to 64 chords")
    run.parse()
    benchmark.need("matplotlib")
    errors: dict[int, list[float]] = {chords: [] for chords in CHORDS}
    seconds: dict[int, list[float]] = {chords: [] for chords in CHORDS}
    for field, azimuth, altitude, diameter in (towers(4), towers(0), jacksboro()):
        ny, nx = field.heights.shape
        at = np.array([field.dx * (nx - 1) / 2, field.dy * (ny - 1) / 2, float(field.heights.max())])
        extent = 0.9 * min(at[:2]) * 2
        camera = jaxhf.Orthographic.look_at((*at[:2], at[2] + extent), at, (0, 1, 0), extent, width=SIZE, height=SIZE)
        towards = np.asarray(jaxhf.Directional.from_angles(azimuth, altitude).towards)
        ground = [jaxhf.Object(field, jaxhf.Matte(1.0))]
        ready = jaxhf.prepare(jaxhf.Scene(ground, camera, [jaxhf.Directional(towards, 1.0)]), SETTINGS)

        @jax.jit
        def mean(directions: jax.Array, ready: jaxhf.Prepared) -> jax.Array:
            def add(total: jax.Array, direction: jax.Array) -> tuple[jax.Array, None]:
                return total + jaxhf.render(ready.with_lights([jaxhf.Directional(direction, 1.0)]))[..., 0], None

            return jax.lax.scan(add, jnp.zeros((SIZE, SIZE)), directions)[0] / len(directions)

        truth = np.asarray(mean(jnp.asarray(spread(towards, diameter, 1024), jnp.float32), ready))
        unshadowed = np.asarray(jaxhf.render(ready))[..., 0]
        lit = np.where(unshadowed > 0, truth / np.where(unshadowed > 0, unshadowed, 1), 0)
        penumbra = (lit > 0.01) & (lit < 0.99)
        suns = {chords: ready.with_lights([jaxhf.Sun(towards, 1.0, diameter, chords)]) for chords in CHORDS}
        for chords, sun in suns.items():
            off = np.abs(np.asarray(jaxhf.render(sun))[..., 0] - truth)[penumbra] / (np.sin(np.deg2rad(altitude)) / np.pi)
            errors[chords] += [float(off.mean()), float(off.max())]
        for _ in range(7):
            for chords, sun in suns.items():
                begin = time.perf_counter()
                jaxhf.render(sun).block_until_ready()
                seconds[chords].append(time.perf_counter() - begin)
    usual = np.median(seconds[8])
    for chords in CHORDS:
        names = (f"{name}: {which}" for name in ("tower", "tower of one vertex", "Jacksboro") for which in ("mean", "worst"))
        shown = {name: f"{100 * error:.2f} %" for name, error in zip(names, errors[chords], strict=True)}
        run.row(f"{chords} chords", shown | {"time": np.median(seconds[chords]) / usual})
        worst, most = max(errors[chords][::2]), MOST.get(chords, 1)
        run.claim(worst < most, f"{chords} chords are off by {worst:.2%} in the mean, at most {most:.2%}")
    run.end()


if __name__ == "__main__":
    main()
