"""Where a directional light reaches a heightfield for certain: no walk may find anything in the way there."""

import functools

import aimed
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxhf
from jaxhf.core.affine import affine
from jaxhf.core.ray import Ray
from jaxhf.core.vector import dot, unit
from jaxhf.preparation.ceiling import clears, make_ceiling
from jaxhf.scene.procedural import fractal
from jaxhf.trace.grid import make_grid
from jaxhf.trace.intersect import blocked, intersect

COUNT = 2048
UPRIGHT = np.eye(4)
TILTED = np.array([[0.8, 0.3, 0.2, 5.0], [-0.3, 0.9, 0.1, -3.0], [0.1, -0.4, 1.1, 2.0], [0, 0, 0, 1]])
ALTITUDES = (-20.0, 0.0, 3.0, 12.0, 35.0, 60.0, 90.0)
AZIMUTHS = (0.0, 37.0, 90.0, 135.0, 161.0, 200.0, 225.0, 270.0, 315.0)


@functools.partial(jax.jit, static_argnames=("dx", "dy"))
def judged(heights, world, x, y, up, suns, dx: float, dy: float):
    """For each sun and each hit from above (`up`) or below, in cells, whether walks are wanted, are spared, meet something."""
    grid = make_grid(jaxhf.Heightfield(heights, dx, dy), affine(world), jaxhf.Settings(shading="flat"))

    def under(sun):
        ceiling, wi = make_ceiling(grid, unit(sun)), unit(sun)

        def one(x, y, up):
            far = jnp.where(up, 2, -1) * jnp.maximum(grid.z_top, 1)
            start = grid.world_from_grid.ray(Ray(jnp.stack([x, y, far]), jnp.stack([0 * x, 0 * x, -far])))
            hit = intersect(grid, 0, start)
            wanted = (hit.object == 0) & (dot(wi, hit.n) * hit.side.astype(wi.dtype) > 0)
            met, _ = blocked(grid, Ray(hit.p, wi), hit, wanted, None, number=0)
            return wanted, wanted & clears(ceiling, grid, 0, hit), met

        return jax.vmap(one)(x, y, up)

    return jax.lax.map(under, suns)


def suns(dtype) -> np.ndarray:
    return np.array([jaxhf.Directional.from_angles(a, h).towards for h in ALTITUDES for a in AZIMUTHS], dtype)


def places(cells: np.ndarray, dtype, exact: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """All over the cells, if `exact` also on their edges and at vertices; three quarters of them seen from above."""
    generator = np.random.default_rng(1)
    (u, v), kind = generator.uniform(0, 1, (2, COUNT)), generator.integers(0, 6, COUNT) if exact else np.zeros(COUNT)
    u, v = np.where((kind == 1) | (kind == 4), 0, u), np.where((kind == 2) | (kind == 4), 0, np.where(kind == 3, u, v))
    x, y = generator.integers(0, cells, (COUNT, 2)).T + np.stack([u, v])
    return x.astype(dtype), y.astype(dtype), np.arange(COUNT) % 4 > 0


def spared(heights: np.ndarray, dtype, world=UPRIGHT, dx: float = 1.0, dy: float = 1.0) -> np.ndarray:
    """The share of spared walks under each sun, of those that meet nothing, shape (altitudes, azimuths)."""
    cells = np.array(heights.shape)[::-1] - 1
    # Where a vertex is not hit to the last bit, a walk may meet the triangle beside it by its own rounding.
    exact = world is UPRIGHT
    arguments = heights.astype(dtype), world.astype(dtype), *places(cells, dtype, exact), suns(dtype)
    wanted, clear, met = map(np.asarray, judged(*arguments, dx, dy))
    assert not (clear & met).any(), np.argwhere(clear & met)[:5]
    return (clear.sum(1) / np.maximum((wanted & ~met).sum(1), 1)).reshape(len(ALTITUDES), len(AZIMUTHS))


HEIGHTS = {
    "rough": aimed.random_heights((17, 33), 1.0, seed=3),
    "mild": fractal([17, 33], seed=2, exponent=2.4, range=(0.0, 4.0)),
    "flat": np.full((17, 33), 0.7),
    "wall": np.where(np.arange(33) == 20, 5.0, 0.0) * np.ones((17, 1)),
}


@aimed.PRECISIONS
def test_no_walk_is_spared_that_meets_something(dtype):
    """High and low suns and those below the horizon, along the axes, along diagonals and between."""
    shares = {}
    for name, heights in HEIGHTS.items():
        for scale in (1e-6, 1.0, 1e6) if name in ("rough", "mild") else (1.0,):
            shares[name, scale] = spared(heights * scale, dtype)
        spared(np.where(heights > np.quantile(heights, 0.97), np.nan, heights), dtype)
        spared(heights, dtype, TILTED)
    # Nearly all where every triangle faces the sun; only some of its hits are seen from above.
    assert np.all(shares["flat", 1.0][2:] == 1)
    assert np.all(shares["mild", 1e-6][2:] == 1)
    assert np.all(shares["mild", 1.0][5:] > 0.8)
    assert np.all(shares["mild", 1.0][4] > 0.5)
    assert np.all(shares["rough", 1e6][4] < 0.5)


@pytest.mark.deep
def test_a_square_terrain_of_many_cells():
    share = spared(fractal([300, 300], seed=5, exponent=2.2, range=(0.0, 0.25)), np.float32, dx=1 / 299, dy=1 / 299)
    assert np.all(share[3:6].mean(1) > (0.3, 0.8, 0.95))
