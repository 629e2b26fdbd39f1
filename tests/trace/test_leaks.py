"""No ray that must hit is lost: float32 rays aimed at the hard places, at all scales, on all kinds of grids, by both walks.

Which rays must hit is known without a search, see `crossings.must_hit`. Of each such ray's hit it is asserted that it is
where the ray meets the surface, on the side from which the ray comes, and that the ray had not been on the other side before.
"""

import aimed
import crossings
import numpy as np
import pytest
from compare import assert_none, every_family, heightfield

import jaxhf

# A ray must hit that still does so when it is shifted by one unit in the last place of the largest lengths that occur. Of
# rays that hit by less than half a unit some are lost, and must be: their origins in cells are rounded by as much.
SLACK = 2.0**-23
# How far a hit's point may be from its triangle's plane and from the ray, in units of `crossings.residuals`. The point's
# coordinates, the cell's size and heights from the lowest are rounded, each to half a unit; on the way to it the origin in
# cells, its mirrored place in the walk's frame, its step to the box, t and its product with d are. Not all are at their worst
# together: of 1e7 rays one is more than 2 units off.
ON_PLANE, ON_RAY = 2.0, 3.0

SHAPES = [(2, 2), (2, 17), (17, 2), (33, 17), (1025, 1025)]
SCALES = (1e-6, 1.0, 1e6)  # heights beside cells of 0.3 x 2
TRAVERSALS = ("pyramid", "dda")
PER_FAMILY = 2048


def terrain(shape: tuple[int, int], scale: float, seed: int) -> aimed.Ground:
    return aimed.Ground(aimed.random_heights(shape, scale, seed), dx=0.3, dy=2.0)


def check(ground: aimed.Ground, seed: int) -> np.ndarray:
    """Asserts that no ray of `PER_FAMILY` of each family leaks; returns how many of each had to hit."""
    rays, names = every_family(ground, seed, PER_FAMILY, stretched=False)
    o, d, _ = rays
    course = crossings.Course(ground, o, d, SLACK)
    sure = crossings.must_hit(course)
    field = heightfield(ground, np.float32)
    hits = {traversal: jaxhf.cast(field, o, d, jaxhf.Settings(traversal=traversal, shading="flat")) for traversal in TRAVERSALS}
    one, other = (np.column_stack([hit.status, hit.cell, hit.triangle, hit.t]) for hit in hits.values())
    assert_none((one != other).any(1), names, rays)
    for hit in hits.values():
        assert_none(sure.must & (np.asarray(hit.status) != jaxhf.Status.HIT), names, rays)
        t = np.where(sure.must, np.asarray(hit.t, np.float64), 0)
        cell, triangle, p = np.asarray(hit.cell), np.asarray(hit.triangle), np.asarray(hit.p, np.float64)
        off_plane, off_ray = crossings.residuals(course, cell, triangle, p, t)
        assert_none(sure.must & (off_plane > ON_PLANE), names, rays)
        assert_none(sure.must & (off_ray > ON_RAY), names, rays)
        assert_none(sure.must & (t > sure.by * (1 + SLACK)), names, rays)  # else it is behind the surface
        # Before `since` a ray may have hit at the very border already.
        assert_none(sure.must & (np.asarray(hit.side) != sure.side) & (t > sure.since), names, rays)
        some = np.flatnonzero(sure.must)[:: 1 if ground.heights.size < 1000 else 300]  # 2 ms a ray at 1025 x 1025
        before = crossings.Course(ground, o[some], d[some], SLACK)
        early = crossings.has_changed_sides(before, sure.side[some], sure.since[some], t[some])
        assert_none(early, names[some], aimed.Rays(*(value[some] for value in rays)))
    return sure.must[names != "miss"].reshape(-1, PER_FAMILY).sum(1)


@pytest.mark.optimised
@pytest.mark.parametrize(
    "shapes",
    [SHAPES[1:4:2], pytest.param(SHAPES[:3:2], marks=pytest.mark.deep), pytest.param(SHAPES[4:], marks=pytest.mark.slow)],
    ids=["small", "narrow", "large"],
)
def test_no_leak(shapes):
    """Among 5e4 rays and more on small grids, and as many as fit on a large one."""
    known = np.array([[check(terrain(shape, scale, seed=1), seed=2) for scale in SCALES] for shape in shapes])
    assert known.sum() > (50_000 if len(shapes) > 1 else 40_000)
    # Narrow grids have no vertex or edge but those of the border, where nothing is sure.
    assert min(shapes[-1]) == 2 or known[-1].min() > PER_FAMILY / 3


@pytest.mark.slow
@pytest.mark.parametrize("shape", SHAPES)
def test_no_leak_in_many(shape):
    """Among 2e6 rays and more on each grid: 1e7 in all."""
    known, seed = 0, 10
    while known < 2_000_000:
        known += sum(int(check(terrain(shape, scale, seed), seed).sum()) for scale in SCALES)
        seed += 1
