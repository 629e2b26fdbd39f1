"""Cases that nobody has looked at: terrain, cameras, suns, noise and map are drawn from a seed, Mitsuba makes the pictures.

A seed of which the default call was changed is one that was looked at: its cases belong to cases.py from then on.
"""

import numpy as np
from cases import MITSUBAS, Case, Definition, Sources, by_mitsuba, smoothed, suns, viewed

import jaxhf
from jaxhf.scene.procedural import bumps, fractal

SAMPLES = 256  # a pixel


def terrain(rng: np.random.Generator) -> tuple[str, np.ndarray, tuple[float, float]]:
    """What kind it is, its heights, and dx, dy."""
    kind, (ny, nx) = str(rng.choice(("fractal", "bumps", "Jacksboro"))), rng.integers(40, 73, 2)
    if kind == "Jacksboro":
        whole = jaxhf.jacksboro()
        row, column = (int(rng.integers(size - n)) for size, n in zip(whole.heights.shape, (ny, nx), strict=True))
        return kind, whole.heights[row : row + ny, column : column + nx].astype(np.float64), (whole.dx, whole.dy)
    cell, seed = float(10 ** rng.uniform(-2, 2)), int(rng.integers(2**31))
    rise = float(rng.uniform(0.1, 0.3)) * cell * max(ny, nx)
    if kind == "fractal":
        return kind, fractal([ny, nx], seed, float(rng.uniform(1.8, 2.6)), (0.0, rise)), (cell, cell)
    count, radius = int(rng.integers(10, 40)), float(rng.uniform(0.05, 0.15))
    hills = bumps([ny, nx], seed=seed, count=count, radius=radius, range=(0.0, rise))
    return kind, hills + fractal([ny, nx], seed + 1, 2.4, (0.0, 0.2 * rise)), (cell, cell)


def drawn(sources: Sources, seed: int, number: int) -> Case:
    """Three to five pictures from as many sides of a terrain, all of its border in sight, and a smoothed map of it."""
    rng = np.random.default_rng([seed, number])
    kind, truth, spacing = terrain(rng)
    (ny, nx), (count, pixels) = truth.shape, rng.integers((3, 112), (6, 193))
    cells, albedo, share = rng.uniform((3, 0.3, 0.003), (8, 0.9, 0.015))
    prior = smoothed(truth, cells)
    spread = float(f"{np.sqrt(np.mean((prior - truth) ** 2)):.1e}")
    extent = np.array([(nx - 1) * spacing[0], (ny - 1) * spacing[1]])
    across, at = 1.1 * np.hypot(*extent), np.array([*extent / 2, prior.mean()])
    turns, azimuths = (rng.uniform(0, 360) + 360 / count * np.arange(count) + rng.normal(0, 20, count) for _ in range(2))
    tilts, distance = np.radians(rng.uniform(10, 40, count)), float(rng.uniform(1.5, 4)) * across
    altitudes, flat, noise_known = rng.uniform(25, 60, count), rng.random() < 0.3, rng.random() < 0.5
    sides = np.stack([np.sin(np.radians(turns)) * np.sin(tilts), np.cos(np.radians(turns)) * np.sin(tilts), np.cos(tilts)], 1)
    eyes = list(at + distance * sides)
    fov, size = float(np.degrees(2 * np.arctan(across / 2 / distance))), {"width": int(pixels), "height": int(pixels)}

    def camera(eye: np.ndarray) -> jaxhf.Orthographic | jaxhf.Perspective:
        if flat:
            return jaxhf.Orthographic.look_at(eye, at, extent=across, **size)
        return jaxhf.Perspective.look_at(eye, at, fov=fov, **size)

    print(
        f"drawn-{number}: {kind}, {ny} x {nx} heights, cells of {spacing[0]:.3g}; {count} {'orthographic ' * flat}pictures of "
        f"{pixels}², {np.degrees(tilts).round()} degrees from above, suns at {altitudes.round()}, noise {share:.1%}, "
        f"{'' if noise_known else 'not '}given; map over {cells:.1f} cells, albedo {albedo:.2f}",
        flush=True,
    )

    def scenes(heights: np.ndarray) -> list[jaxhf.Scene]:
        ground = jaxhf.Object(jaxhf.Heightfield(heights.astype(np.float32), *spacing), jaxhf.Matte(float(albedo)))
        return viewed(ground, [camera(eye) for eye in eyes], suns(*zip(azimuths.tolist(), altitudes.tolist(), strict=True)))

    exact = by_mitsuba(sources, f"drawn-{seed}-{number}", scenes(truth), eyes, at, samples=SAMPLES)
    noise = float(share) * float(np.mean([image.max() for image in exact]))
    targets = exact + noise * rng.standard_normal(exact.shape)
    given = {"prior": jaxhf.Prior(prior, spread), **MITSUBAS} | ({"noise": noise} if noise_known else {})
    return Case(truth, scenes(prior), list(targets), given, prior)


def held_out(seed: int, count: int) -> dict[str, Definition]:
    """So many cases of this seed."""
    return {
        f"drawn-{number}": Definition("float32", lambda sources, number=number: drawn(sources, seed, number))
        for number in range(1, count + 1)
    }
