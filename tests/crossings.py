"""Which rays must hit, and whether they had hit before: for millions of rays, in plain NumPy and double precision.

g(t) = height of a ray - height of the surface is linear between two crossings of lines x = i, y = j and diagonals. A ray over
the footprint that is above the surface at one place and below it at another must hit on the way: no search is needed to know
that. And one that is on its first side at all crossings up to a hit has met nothing before it. Rounding is allowed for as in
`oracle.OracleHit`: by a shift of the ray against the surface of `slack` times the largest lengths that occur.
"""

from typing import NamedTuple

import aimed
import numpy as np
import oracle
from jaxtyping import Bool, Float, Int

Parameters = Float[np.ndarray, "n k"]
"""Places along rays: t, several to each."""


class Course:
    """The way of n rays over a surface without holes, in cells and heights over the lowest.

    Attributes:
      reach: the largest length along x and y that occurs, in cells: of the grid, or from its corner to the origin.
      tall: that along z: the range of the heights, or the distance from the lowest to the origin.
    """

    def __init__(self, ground: aimed.Ground, o: Float[np.ndarray, "n 3"], d: Float[np.ndarray, "n 3"], slack: float):
        self.cell, self.corner = np.array([ground.dx, ground.dy, 1.0]), np.array([ground.x0, ground.y0, ground.low])
        self.ground = ground._replace(heights=ground.heights - ground.low, dx=1.0, dy=1.0, x0=0.0, y0=0.0)
        self.o, self.d = (o - self.corner) / self.cell, d / self.cell
        self.reach = np.maximum(np.abs(self.o[:, :2]).max(1), ground.cells.max())
        self.tall = np.maximum(np.ptp(ground.heights), np.abs(self.o[:, 2]))
        self.slack = slack
        self.steepness = oracle.steepness(ground.heights)

    def place(self, t: Parameters) -> tuple[Parameters, Parameters]:
        return self.o[:, :1] + t * self.d[:, :1], self.o[:, 1:2] + t * self.d[:, 1:2]

    def gap(self, t: Parameters) -> tuple[Parameters, Parameters]:
        """g, and how much of it may be rounding; beyond the footprint over its nearest point."""
        nx, ny = self.ground.cells
        x, y = self.place(t)
        x, y = np.clip(x, 0, nx).ravel(), np.clip(y, 0, ny).ravel()
        height = self.ground.points(x, y)[:, 2].reshape(t.shape)
        steepness = self.steepness[np.minimum(y.astype(int), ny - 1), np.minimum(x.astype(int), nx - 1)].reshape(t.shape)
        rise = self.slack * (self.tall[:, None] + self.reach[:, None] * steepness)
        return self.o[:, 2:] + t * self.d[:, 2:] - height, rise

    def over_footprint(self) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        """t >= 0 between which the rays are surely over the footprint; in the wrong order where they never are."""
        inset = self.slack * self.reach
        return oracle.within_slabs(self.o, self.d, [(inset, cells - inset) for cells in self.ground.cells])

    def crossings(self) -> Parameters:
        """t at which the rays cross lines and diagonals, unordered; not finite where they never do."""
        nx, ny = self.ground.cells
        lines = (
            (np.arange(nx + 1), self.o[:, 0], self.d[:, 0]),
            (np.arange(ny + 1), self.o[:, 1], self.d[:, 1]),
            (np.arange(-ny, nx + 1), self.o[:, 0] - self.o[:, 1], self.d[:, 0] - self.d[:, 1]),
        )
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.concatenate([(number - o[:, None]) / d[:, None] for number, o, d in lines], axis=1)


class Crossing(NamedTuple):
    """What is sure about the first hit of each ray.

    Attributes:
      must: whether there is one.
      since, side: from that t on, until it hits, the ray is on that side: 1 above, -1 below.
      by: the t by which it has hit.
    """

    must: Bool[np.ndarray, " n"]
    since: Float[np.ndarray, " n"]
    side: Int[np.ndarray, " n"]
    by: Float[np.ndarray, " n"]


def must_hit(course: Course) -> Crossing:
    """Which rays are seen to change sides by a few looks on their way, most of them around t = 1."""
    near, far = course.over_footprint()
    passes = near < far
    near, far = np.where(passes, near, 0), np.where(passes, far, 0)
    height = np.abs(course.o[:, 2]) + 2 * course.tall
    with np.errstate(divide="ignore", over="ignore"):  # no need to follow a steep ray far below the lowest or above the highest
        far = np.minimum(far, near + np.nan_to_num(2 * height / np.abs(course.d[:, 2]), nan=0))
    around = [1 + sign * 10.0**-k for k in range(1, 7) for sign in (-1, 1)]
    looks = np.concatenate([np.tile(around, (len(near), 1)), near[:, None] + np.linspace(0, 1, 17) * (far - near)[:, None]], 1)
    looks = np.sort(np.clip(looks, near[:, None], far[:, None]), axis=1)
    g, rise = course.gap(looks)
    side = np.where(np.abs(g[:, 0]) > rise[:, 0], np.sign(g[:, 0]), 0).astype(int)
    changed = side[:, None] * g < -rise
    return Crossing(passes & changed.any(1), looks[:, 0], side, looks[np.arange(len(looks)), changed.argmax(1)])


def has_changed_sides(
    course: Course, side: Int[np.ndarray, " n"], after: Float[np.ndarray, " n"], before: Float[np.ndarray, " n"]
) -> Bool[np.ndarray, " n"]:
    """Whether a ray is surely on the side that is not `side` at a crossing between the parameters `after` and `before`."""
    near, far = course.over_footprint()
    t = course.crossings()
    open_ = (t > np.maximum(after, near)[:, None]) & (t < np.minimum(before, far)[:, None])
    g, rise = course.gap(np.where(open_, t, 0))
    return np.any(open_ & (side[:, None] * g < -rise), axis=1)


def residuals(
    course: Course, cell: Int[np.ndarray, "n 2"], triangle: Int[np.ndarray, " n"], p: Float[np.ndarray, "n 3"], t: np.ndarray
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """How far points are from the planes of triangles, and from the rays' places at t: in float32's units in the last place.

    They are units of the largest lengths that occur. Along x and y that is the `reach`; along z it is `tall` and, as a step
    in x or y is one in z on a slope, that slope times the `reach`. So measured it does not matter how the axes are scaled.
    """
    (x, y, z), (ix, iy) = ((p - course.corner) / course.cell).T, cell.T
    heights = course.ground.heights
    z00, z10, z01, z11 = heights[iy, ix], heights[iy, ix + 1], heights[iy + 1, ix], heights[iy + 1, ix + 1]
    slope_x, slope_y = np.where(triangle == 1, z11 - z01, z10 - z00), np.where(triangle == 1, z01 - z00, z11 - z10)
    unit = np.finfo(np.float32).eps * course.reach
    unit_z = np.finfo(np.float32).eps * course.tall + unit * (np.abs(slope_x) + np.abs(slope_y))
    place = course.o + t[:, None] * course.d
    off_ray = np.abs(np.column_stack([x, y, z]) - place) / np.column_stack([unit, unit, unit_z])
    return np.abs(z - (z00 + slope_x * (x - ix) + slope_y * (y - iy))) / unit_z, off_ray.max(1)
