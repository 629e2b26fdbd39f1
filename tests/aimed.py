"""Rays aimed at the hard places of a heightfield, by name: `aimed(name, ground, count, seed)`.

Random rays alone prove little: what goes wrong goes wrong at vertices, on edges, along the axes, at grazing angles and at the
border. All rays are NumPy float64; what they are aimed at, if anything, is at o + d. A ray that is steeper than every triangle
crosses the surface wherever it is aimed at a point off the border, so that it must hit; such rays say so.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pytest
from jaxtyping import Float, Int

HIT, MISS, OPEN = 1, 0, -1
DOUBLE = pytest.param(np.float64, marks=(pytest.mark.x64, pytest.mark.deep))
PRECISIONS = pytest.mark.parametrize("dtype", [np.float32, DOUBLE])
"""As users run it; that the same holds in double precision is a further proof."""


class Rays(NamedTuple):
    o: Float[np.ndarray, "n 3"]
    d: Float[np.ndarray, "n 3"]
    expect: Int[np.ndarray, " n"]
    """HIT and MISS: by construction; OPEN: whatever comes."""


class Ground(NamedTuple):
    """What rays are aimed at: heights[iy, ix] at x0 + ix dx, y0 + iy dy."""

    heights: Float[np.ndarray, "ny nx"]
    dx: float = 1.0
    dy: float = 1.0
    x0: float = 0.0
    y0: float = 0.0

    @property
    def cells(self) -> np.ndarray:
        """Cells along x and along y."""
        return np.array(self.heights.shape[::-1]) - 1

    @property
    def corner(self) -> np.ndarray:
        """Of the surface's box, at the lowest."""
        return np.array([self.x0, self.y0, self.low])

    @property
    def size(self) -> np.ndarray:
        """Of the box."""
        return np.array([*(self.cells * [self.dx, self.dy]), self.range])

    @property
    def low(self) -> float:
        return float(np.nanmin(self.heights))

    @property
    def range(self) -> float:
        """Of the heights; 1 where they are all the same."""
        return float(np.nanmax(self.heights) - self.low) or 1.0

    @property
    def slope(self) -> float:
        """Of the steepest triangle, at most: what |dz| is over the length of (dx, dy)."""
        along_x, along_y = np.diff(self.heights, axis=1) / self.dx, np.diff(self.heights, axis=0) / self.dy
        return float(np.hypot(np.nanmax(np.abs(along_x)), np.nanmax(np.abs(along_y))))

    def points(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Points on the surface, x and y in cells."""
        nx, ny = self.cells
        ix, iy = np.clip(np.floor(x).astype(int), 0, nx - 1), np.clip(np.floor(y).astype(int), 0, ny - 1)
        u, v = x - ix, y - iy
        z00, z10 = self.heights[iy, ix], self.heights[iy, ix + 1]
        z01, z11 = self.heights[iy + 1, ix], self.heights[iy + 1, ix + 1]
        z = np.where(v > u, z00 + v * (z01 - z00) + u * (z11 - z01), z00 + u * (z10 - z00) + v * (z11 - z10))
        return np.stack([self.x0 + x * self.dx, self.y0 + y * self.dy, z], axis=1)

    def anywhere(self, generator: np.random.Generator, count: int, beyond: float = 1.0) -> np.ndarray:
        """Points in the box of the surface, and round it as far as `beyond` times its size."""
        return self.corner + self.size * generator.uniform(-beyond, 1 + beyond, (count, 3))


def random_heights(shape: tuple[int, int], scale: float, seed: int) -> np.ndarray:
    """Rough terrain, float32 numbers: a few waves and noise, `scale` high."""
    generator = np.random.default_rng(seed)
    y, x = (np.arange(size) for size in shape)
    waves = np.sin(0.7 * x)[None, :] * np.cos(0.4 * y)[:, None] + generator.uniform(-0.5, 0.5, shape)
    return (scale * waves).astype(np.float32).astype(np.float64)


def _aim(ground: Ground, generator: np.random.Generator, x: np.ndarray, y: np.ndarray) -> Rays:
    """Rays at points of the surface given in cells, half of them steep, from above or below, half from anywhere.

    Origins lie inside and outside of the box.
    """
    count = len(x)
    target = ground.points(x, y)
    o = ground.anywhere(generator, count)
    steep = np.arange(count) % 2 == 0
    away = np.hypot(o[:, 0] - target[:, 0], o[:, 1] - target[:, 1])
    away = away * np.where(generator.random(count) < 0.3, 0.02, 1)  # some start inside the box
    turn = generator.uniform(0, 2 * np.pi, count)
    climb = generator.choice([-1, 1], count) * (1.05 + generator.random(count)) * (ground.slope * away + 0.01 * ground.range)
    above = target + np.stack([away * np.cos(turn), away * np.sin(turn), climb], axis=1)
    o = np.where(steep[:, None], above, o)
    return Rays(o, target - o, np.where(steep, _certain(ground, x, y), OPEN))


def _certain(ground: Ground, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """What a ray does that crosses the surface, or its continuation, once, at (x, y) in cells; OPEN on the border."""
    nx, ny = ground.cells
    beyond = np.maximum(np.abs(x - nx / 2) - nx / 2, np.abs(y - ny / 2) - ny / 2)
    inside, outside = beyond < -1e-4, beyond > 1e-4
    return np.where(inside, HIT, np.where(outside, MISS, OPEN))


def vertices(ground: Ground, generator: np.random.Generator, count: int) -> Rays:
    nx, ny = ground.cells
    x, y = generator.integers(0, nx + 1, count), generator.integers(0, ny + 1, count)
    return _aim(ground, generator, x.astype(float), y.astype(float))


def _fraction(generator: np.random.Generator, count: int) -> np.ndarray:
    """Places along an edge: anywhere, or the middle, or close to an end."""
    return np.choose(generator.integers(0, 3, count), [generator.random(count), np.full(count, 0.5), np.full(count, 1e-6)])


def x_edges(ground: Ground, generator: np.random.Generator, count: int) -> Rays:
    """At edges that run along x."""
    nx, ny = ground.cells
    x = generator.integers(0, nx, count) + _fraction(generator, count)
    return _aim(ground, generator, x, generator.integers(0, ny + 1, count) + 0.0)


def y_edges(ground: Ground, generator: np.random.Generator, count: int) -> Rays:
    nx, ny = ground.cells
    x = generator.integers(0, nx + 1, count) + 0.0
    return _aim(ground, generator, x, generator.integers(0, ny, count) + _fraction(generator, count))


def diagonals(ground: Ground, generator: np.random.Generator, count: int) -> Rays:
    nx, ny = ground.cells
    along = _fraction(generator, count)
    return _aim(ground, generator, generator.integers(0, nx, count) + along, generator.integers(0, ny, count) + along)


def along_diagonals(ground: Ground, generator: np.random.Generator, count: int) -> Rays:
    """Over or below whole diagonals, and straight across them through the vertices."""
    nx, ny = ground.cells
    target = ground.points(generator.integers(0, nx + 1, count) + 0.0, generator.integers(0, ny + 1, count) + 0.0)
    steps = generator.integers(1, 6, count) * generator.choice([-1, 1], count)
    across = generator.choice([-1, 1], count)
    o = target + np.stack(
        [steps * ground.dx, across * steps * ground.dy, ground.range * generator.uniform(-1, 1, count)], axis=1
    )
    return Rays(o, target - o, np.full(count, OPEN))


def vertical(ground: Ground, generator: np.random.Generator, count: int) -> Rays:
    """Through vertices, edges, diagonals and triangles, from above and from below."""
    nx, ny = ground.cells
    ix, iy = generator.integers(0, nx, count), generator.integers(0, ny, count)
    u, v = generator.choice([0, 0.25, 0.5, 0.75, 1], (2, count))
    x, y = ix + u, iy + v
    target = ground.points(x, y)
    side = generator.choice([-1, 1], count)
    o = target + np.stack([np.zeros(count), np.zeros(count), side * ground.range * generator.uniform(0.01, 3, count)], axis=1)
    return Rays(o, target - o, _certain(ground, x, y))


def axis_aligned(ground: Ground, generator: np.random.Generator, count: int) -> Rays:
    """Along x and along y, over grid lines and between them, level and tilted."""
    nx, ny = ground.cells
    o = ground.anywhere(generator, count)
    on_line, level, along_x = (generator.random(count) < 0.5 for _ in range(3))
    column, row = generator.integers(0, nx + 1, count), generator.integers(0, ny + 1, count)
    o[:, 0] = np.where(~along_x & on_line, ground.x0 + column * ground.dx, o[:, 0])
    o[:, 1] = np.where(along_x & on_line, ground.y0 + row * ground.dy, o[:, 1])
    o[:, 2] = np.where(level, ground.low + ground.range * generator.random(count), o[:, 2])
    middle = np.array([ground.x0, ground.y0]) + ground.cells * [ground.dx, ground.dy] / 2
    forward = np.where(generator.random(count) < 0.8, np.sign(np.where(along_x, middle[0] - o[:, 0], middle[1] - o[:, 1])), 1)
    length = np.where(along_x, nx * ground.dx, ny * ground.dy)
    goal = ground.low + ground.range * generator.random(count)
    d = np.stack([along_x * forward * length, ~along_x * forward * length, np.where(level, 0, goal - o[:, 2])], axis=1)
    return Rays(o, d, np.full(count, OPEN))


def grazing(ground: Ground, generator: np.random.Generator, count: int) -> Rays:
    """At 1e-6 to 1e-3 of the mean slope to the mean plane or, every second ray, to the triangle that they are aimed at."""
    nx, ny = ground.cells
    x, y = generator.uniform(0, nx, count), generator.uniform(0, ny, count)
    target = ground.points(x, y)
    turn = generator.uniform(0, 2 * np.pi, count)
    step = 1e-3 * np.stack([np.cos(turn), np.sin(turn)])  # within the triangle, nearly always
    tilt = ground.points(x + step[0], y + step[1])[:, 2] - target[:, 2]
    to_triangle = np.arange(count) % 2 == 0
    angle = generator.choice([-1, 1], count) * 10 ** generator.uniform(-6, -3, count) * ground.range / max(nx, ny)
    rise = np.where(to_triangle, tilt / 1e-3, 0) + angle
    d = np.stack([ground.dx * step[0], ground.dy * step[1], 1e-3 * rise], axis=1)
    back = np.where(to_triangle, generator.uniform(0.5, 5, count), generator.uniform(0.5, 2, count) * max(nx, ny)) * 1e3
    return Rays(target - back[:, None] * d, d * back[:, None], np.full(count, OPEN))


def skimming(ground: Ground, generator: np.random.Generator, count: int) -> Rays:
    """At 1e-6 rad, in world units, to the triangle that they are aimed at or, every second ray, to the horizontal."""
    nx, ny = ground.cells
    x, y = generator.uniform(0, nx, count), generator.uniform(0, ny, count)
    target = ground.points(x, y)
    turn = generator.uniform(0, 2 * np.pi, count)
    step = 1e-3 * np.stack([np.cos(turn), np.sin(turn)])
    to_triangle = np.arange(count) % 2 == 0
    here, along_x, along_y = (ground.points(x + i, y + j) - target for i, j in (step, (step[0], 0 * turn), (0 * turn, step[1])))
    normal = np.where(to_triangle[:, None], np.cross(along_x, along_y), [0.0, 0.0, 1.0])
    tangent = np.where(to_triangle[:, None], here, here * [1.0, 1.0, 0.0])
    normal, tangent = (v / np.maximum(np.linalg.norm(v, axis=1), 1e-300)[:, None] for v in (normal, tangent))
    back = generator.uniform(0.1, 1, count) * max(nx * ground.dx, ny * ground.dy)
    d = back[:, None] * (tangent + generator.choice([-1e-6, 1e-6], (count, 1)) * normal)
    return Rays(target - d, d, np.full(count, OPEN))


def border(ground: Ground, generator: np.random.Generator, count: int) -> Rays:
    """At the outer edges and the four corners, and a thousandth of a cell inside and outside of them."""
    nx, ny = ground.cells
    x, y = generator.uniform(0, nx, count), generator.uniform(0, ny, count)
    side, beyond = generator.integers(0, 8, count), generator.choice([-1e-3, 0, 1e-3], count)
    x = np.select([side == 0, side == 1, side >= 4], [-beyond, nx + beyond, np.where(side % 2, nx + beyond, -beyond)], x)
    y = np.select([side == 2, side == 3, side >= 4], [-beyond, ny + beyond, np.where(side < 6, ny + beyond, -beyond)], y)
    return _aim(ground, generator, x, y)


def through_side(ground: Ground, generator: np.random.Generator, count: int) -> Rays:
    """From outside into the box: through its sides, its lid and its floor."""
    inside, outside = generator.random((count, 3)), generator.random((count, 3))
    axis = generator.integers(0, 3, count)
    outside[np.arange(count), axis] = np.where(generator.random(count) < 0.5, -1, 1) * generator.uniform(1.01, 3, count)
    o = ground.corner + ground.size * outside
    return Rays(o, ground.corner + ground.size * inside - o, np.full(count, OPEN))


def miss(ground: Ground, generator: np.random.Generator, count: int) -> Rays:
    """Past the box, and away from it."""
    one, two = generator.uniform(-1, 2, (2, count, 3))
    axis, side = generator.integers(0, 3, count), generator.choice([-1, 1], count)
    for point in (one, two):  # a line whose ends are both beyond the same face; beyond its second end it goes further off
        point[np.arange(count), axis] = 0.5 + side * generator.uniform(0.51, 1, count)
    swap = side * (two - one)[np.arange(count), axis] < 0
    one, two = np.where(swap[:, None], two, one), np.where(swap[:, None], one, two)
    return Rays(ground.corner + ground.size * one, ground.size * (two - one), np.full(count, MISS))


def random(ground: Ground, generator: np.random.Generator, count: int) -> Rays:
    o = ground.anywhere(generator, count)
    return Rays(o, ground.anywhere(generator, count, 0.2) - o, np.full(count, OPEN))


FAMILIES: dict[str, Callable[[Ground, np.random.Generator, int], Rays]] = {
    "vertices": vertices,
    "x_edges": x_edges,
    "y_edges": y_edges,
    "diagonals": diagonals,
    "along_diagonals": along_diagonals,
    "vertical": vertical,
    "axis_aligned": axis_aligned,
    "grazing": grazing,
    "skimming": skimming,
    "border": border,
    "through_side": through_side,
    "miss": miss,
    "random": random,
}


def aimed(name: str, ground: Ground, count: int, seed: int, roundable: bool = False, stretched: bool = True) -> Rays:
    """`count` rays of one family.

    roundable: they are rounded to single precision, so that float32 renderers see the same rays. stretched: their
    directions are multiplied by powers of two of all sizes, and what they are aimed at is no longer at o + d.
    """
    generator = np.random.default_rng([seed, list(FAMILIES).index(name)])
    rays = FAMILIES[name](ground, generator, count)
    if roundable:
        rays = rays._replace(o=rays.o.astype(np.float32).astype(np.float64), d=rays.d.astype(np.float32).astype(np.float64))
    return rays._replace(d=rays.d * 2.0 ** generator.integers(-6, 7, (count, 1))) if stretched else rays
