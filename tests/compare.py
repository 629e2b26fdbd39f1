"""Holding `cast` against the oracle, ray by ray.

A ray may end in another way than the oracle says only where a rounding decides. How far rounding goes is `SLACK`, the shift
of a ray against the surface relative to the largest lengths that occur (see `oracle.OracleHit`). Behind a height over the
surface stand about a dozen operations, each rounded to half of `eps`: into the frame of the grid, to the box, along the ray,
along an edge. In double precision the oracle's own rounding is part of it.
"""

import dataclasses

import aimed
import numpy as np
import oracle

import jaxhf

SLACK = {np.float32: 8 * 2.0**-24, np.float64: 8 * 2.0**-53}
DOWN = np.array([0.0, 0.0, -1.0])
# One size of field and of batch for many tests: each other one is compiled anew.
ROUGH = aimed.Ground(aimed.random_heights((33, 17), 1.0, seed=3), dx=0.5, dy=2.0, x0=-3.0, y0=10.0)
PER_FAMILY = 100
COUNT = PER_FAMILY * len(aimed.FAMILIES)


def heightfield(ground: aimed.Ground, dtype: type[np.floating] = np.float64) -> jaxhf.Heightfield:
    return jaxhf.Heightfield(ground.heights.astype(dtype), *ground[1:])


def numpied(hit):
    """The fields of a Hit as NumPy arrays in double precision or integers."""
    fields = {field.name: getattr(hit, field.name) for field in dataclasses.fields(hit)}
    arrays = {name: np.asarray(value) for name, value in fields.items() if value is not None}
    return {name: value.astype(np.float64) if value.dtype.kind == "f" else value for name, value in arrays.items()}


def every_family(
    ground: aimed.Ground, seed: int, count: int = PER_FAMILY, stretched: bool = True
) -> tuple[aimed.Rays, np.ndarray]:
    """Rays of each family, one after the other, as float32 numbers, and the names that go with them."""
    parts = [aimed.aimed(name, ground, count, seed, roundable=True, stretched=stretched) for name in aimed.FAMILIES]
    o, d, expect = (np.concatenate(values) for values in zip(*parts, strict=True))
    return aimed.Rays(o, d, expect), np.repeat(list(aimed.FAMILIES), count)


def assert_none(wrong, names, rays):
    """Asserts that `wrong` marks no ray; says of which families they are, and gives the first."""
    where = np.flatnonzero(wrong)
    counts = dict(zip(*np.unique(names[where], return_counts=True), strict=True))
    assert len(where) == 0, f"{counts}; first: ray {where[0]}, o = {rays.o[where[0]].tolist()}, d = {rays.d[where[0]].tolist()}"


def compare_with_oracle(ground: aimed.Ground, rays: aimed.Rays, names: np.ndarray, dtype: type[np.floating]):
    """Asserts that `cast` is right about every ray; returns what the oracle says."""
    hit = numpied(jaxhf.cast(heightfield(ground, dtype), rays.o, rays.d))
    expected = oracle.cast(*ground, rays.o, rays.d, slack=SLACK[dtype])
    eps = np.finfo(dtype).eps
    met, t = hit["status"] == jaxhf.Status.HIT, hit["t"]
    assert_none(~np.isin(hit["status"], (jaxhf.Status.HIT, jaxhf.Status.MISS)), names, rays)
    assert_none(expected.decided & (hit["status"] != expected.status), names, rays)
    assert_none(met != np.isfinite(t), names, rays)
    assert_none(met & ((t < 0) | (t * (1 + eps) < expected.earliest)), names, rays)  # t itself is rounded, too
    assert_none(met & expected.decided & (t > expected.latest), names, rays)
    for name, value in hit.items():
        assert_none(~np.isfinite(value.reshape(len(t), -1)).all(1) & (met | (name != "t")), names, rays)

    # The point is on the ray and on the surface, each to within a shift; its coordinates are rounded once more, with x0 and y0.
    along = rays.o + np.where(met, t, 0)[:, None] * rays.d
    corner = eps * np.array([abs(ground.x0), abs(ground.y0), abs(ground.low) + ground.range])
    shift = expected.shift[:, None] * [ground.dx, ground.dy]
    assert_none(met & (np.abs(hit["p"] - along) > np.column_stack([shift, 2 * expected.rise]) + corner).any(1), names, rays)

    # Where shifted rays hit close to each other, and away from edges, the triangle is known and with it all the rest.
    cells = ground.cells
    spread = np.where(expected.decided & met, expected.spread, 0)
    reach = np.max(np.abs(rays.d[:, :2]) / [ground.dx, ground.dy], axis=1) * spread + expected.shift
    sharp = met & expected.decided & (reach < expected.place.inside)
    place = expected.place
    assert_none(sharp & (hit["cell"] != place.cell).any(1), names, rays)
    assert_none(sharp & (hit["triangle"] != place.triangle), names, rays)
    assert_none(sharp & (np.abs(hit["uv"] - place.uv) * cells > reach[:, None]).any(1), names, rays)
    # The normal: a length and products, and before them two heights, each rounded relative to the range of all heights.
    off = eps * ground.range * (1 / ground.dx + 1 / ground.dy) * place.n[:, 2]
    assert_none(sharp & (np.abs(hit["n"] - place.n).max(1) > 4 * eps + off), names, rays)
    assert_none(sharp & (hit["side"] * (place.n * rays.d).sum(1) > 0), names, rays)
    return expected, sharp
