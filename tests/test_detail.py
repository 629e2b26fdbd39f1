"""`Settings.detail`: hits that may be off, and by how much they are; see docs/level-of-detail.md.

What is asserted is computed apart from jaxhf: heights, blocks of them and places in the picture, in NumPy and double precision.
"""

import dataclasses
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxhf
from jaxhf._ray import Footprint, Ray
from jaxhf._render import cast_camera
from jaxhf._shade import Vertex, first_vertex, make_world
from jaxhf.io._procedural import fractal

CELLS, PIXELS, RAYS, DETAIL = 64, 48, 4096, 6.0
SUN = jaxhf.Directional((0.3, -0.5, 0.6))
EXACT = jaxhf.Settings(shading="flat", shadows=False)
ROUGH = fractal([CELLS + 1, CELLS + 1], seed=2, exponent=2.0, range=(0.0, 0.3)).astype(np.float32).astype(np.float64)
HOLES = np.where(np.random.default_rng(2).uniform(size=ROUGH.shape) < 0.01, np.nan, ROUGH)
SHEARED = np.array([[1.0, 0.2, 0.3, 5.0], [-0.1, 0.9, -0.2, 3.0], [0.2, 0.1, 0.8, -2.0], [0, 0, 0, 1]])
# A plain with a wall at its far end: rays come into the block of half the plain's size as high over the ground as the wall is.
WALL = np.where(np.arange(CELLS + 1)[:, None] == CELLS - 1, 0.1, np.zeros((1, CELLS + 1)))
X, Y = np.random.default_rng(3).uniform(0, PIXELS, (2, RAYS))


class View(NamedTuple):
    """A terrain over the unit square and what sees it; eye and target are in the object's frame."""

    eye: tuple[float, float, float]
    target: tuple[float, float, float] = (0.5, 0.5, 0.1)
    heights: np.ndarray = ROUGH
    world: np.ndarray = np.eye(4)
    in_camera: np.ndarray = np.eye(4)
    extent: float | None = None

    def scene(self, dtype: type[np.floating] = np.float64) -> jaxhf.Scene:
        eye, target = (self.world[:3, :3] @ p + self.world[:3, 3] for p in (self.eye, self.target))
        up, size = (0, 0.1, 1), {"width": PIXELS, "height": PIXELS}
        if self.extent is None:
            camera: Any = jaxhf.Perspective.look_at(eye, target, up, **size)
        else:
            camera = jaxhf.Orthographic.look_at(eye, target, up, self.extent, **size)
        camera = dataclasses.replace(camera, world_from_camera=camera.world_from_camera @ self.in_camera)
        return jaxhf.Scene([jaxhf.Object(jaxhf.Heightfield(self.heights.astype(dtype)), None, self.world)], camera, [SUN])


def scaled(scale: float) -> View:
    return View((0.5, -0.4, 0.7 * scale), (0.5, 0.5, 0.1 * scale), ROUGH * scale, world=np.diag([1, 1, 1 / scale, 1]))


VIEWS = {
    "near": View((0.5, 0.1, 0.4), (0.5, 0.9, 0.15)),
    "far": View((1.5, -1.6, 1.4)),
    "grazing": View((0.5, -0.3, 0.25), (0.5, 0.5, 0.2)),
    "inside": View((0.45, 0.3, 0.22), (0.5, 0.9, 0.2)),
    "from below": View((0.6, 0.2, -0.5)),
    "orthographic": View((1.5, -0.6, 0.8), extent=0.9),
    "orthographic, from below": View((0.5, -0.6, -0.4), extent=0.9),
    "level towards a wall": View((0.5, -0.3, 0.09), (0.5, 1.0, 0.09), WALL),
    "sheared": View((0.5, -0.4, 0.7), world=SHEARED),
    "stretched camera": View((0.5, -0.4, 0.7), in_camera=np.diag([-2.0, 1.5, 1.75, 1.0])),
    "holes": View((0.5, -0.4, 0.7), heights=HOLES),
    "heights of 1e-6": scaled(1e-6),
    "heights of 1e6": scaled(1e6),
}


class Found(NamedTuple):
    """Hits, in double precision: whether, t, the cell and the point."""

    met: np.ndarray
    t: np.ndarray
    cell: np.ndarray
    p: np.ndarray


def found(scene: jaxhf.Scene, detail: float | None) -> Found:
    vertex = jax.device_get(cast_camera(scene, X, Y, dataclasses.replace(EXACT, detail=detail)))
    hit = vertex.hit
    np.testing.assert_array_equal(vertex.index >= 0, hit.status == jaxhf.Status.HIT)
    assert set(np.unique(hit.status)) <= {jaxhf.Status.HIT, jaxhf.Status.MISS}
    return Found(vertex.index >= 0, np.asarray(hit.t, np.float64), hit.cell, np.asarray(hit.p, np.float64))


def half_of_the_screen(camera: Any) -> float:
    return float(camera.extent) / 2 if isinstance(camera, jaxhf.Orthographic) else float(np.tan(np.deg2rad(camera.fov) / 2))


def rays(camera: Any) -> tuple[np.ndarray, np.ndarray]:
    """Origins and unit directions, world frame."""
    world, half = np.asarray(camera.world_from_camera), half_of_the_screen(camera)
    screen = np.stack([2 * X / PIXELS - 1, 1 - 2 * Y / PIXELS], axis=1) * half
    one, zero = np.ones((RAYS, 1)), np.zeros((RAYS, 1))
    if isinstance(camera, jaxhf.Orthographic):
        o, d = np.hstack([screen, zero]), np.hstack([0 * screen, one])
    else:
        o, d = np.zeros((RAYS, 3)), np.hstack([screen, one])
    d = d @ world[:3, :3].T
    return o @ world[:3, :3].T + world[:3, 3], d / np.linalg.norm(d, axis=1)[:, None]


def seen_at(camera: Any, p: np.ndarray) -> np.ndarray:
    """The places in the picture, in pixels, at which points in the world are seen; nan behind the camera."""
    inverse, half = np.linalg.inv(camera.world_from_camera), half_of_the_screen(camera)
    x, y, z = (p @ inverse[:3, :3].T + inverse[:3, 3]).T
    depth = np.ones_like(z) if isinstance(camera, jaxhf.Orthographic) else np.where(z > 0, z, np.nan)
    return np.stack([(x / (half * depth) + 1) * PIXELS / 2, (1 - y / (half * depth)) * PIXELS / 2], axis=1)


@pytest.mark.parametrize("name", ["perspective", "orthographic", "stretched", "squeezed"])
def test_the_footprint(name):
    """Lines of its length, in all directions, are seen within `detail`; without a stretch the longest of them by little."""
    stretch = {"stretched": np.diag([-2.0, 1.5, 1.75, 1.0]), "squeezed": np.diag([-0.5, 0.7, 0.6, 1.0]) + 0.1 * np.eye(4, k=1)}
    in_camera = stretch.get(name, np.eye(4)) * np.array([[1, 1, 1, 0]] * 3 + [[0, 0, 0, 1]])
    view = View((0.5, -0.4, 0.7), in_camera=in_camera, extent=0.9 if name == "orthographic" else None)
    camera = view.scene().camera
    (o, d), t = rays(camera), np.random.default_rng(5).uniform(0.1, 9, RAYS)
    w = np.random.default_rng(6).normal(size=(RAYS, 3))
    w = w - 0.9 * (w * d).sum(1)[:, None] * d  # most of it across the ray
    length = np.asarray(jax.vmap(lambda x, y, t: camera.footprint(x, y, DETAIL)(t))(X, Y, t))
    ends = o + t[:, None] * d + w / np.linalg.norm(w, axis=1)[:, None] * length[:, None]
    shift = np.linalg.norm(seen_at(camera, ends) - np.stack([X, Y], axis=1), axis=1)
    assert shift.max() <= DETAIL * (1 + 1e-12)
    assert shift.max() > (0.95 if name in ("perspective", "orthographic") else 0.5) * DETAIL


def above_or_below(view: View, points: np.ndarray, cell: np.ndarray) -> np.ndarray:
    """The points of the surface on the object's verticals through points over `cell`; all in the world."""
    inverse = np.linalg.inv(view.world)
    place = (points @ inverse[:3, :3].T + inverse[:3, 3])[:, :2] * CELLS - cell
    assert np.all((place > -1e-4) & (place < 1 + 1e-4))
    (u, v), (ix, iy), z = place.T, cell.T, view.heights
    z00, z10, z01, z11 = z[iy, ix], z[iy, ix + 1], z[iy + 1, ix], z[iy + 1, ix + 1]
    height = np.where(v > u, z00 + v * (z01 - z00) + u * (z11 - z01), z00 + u * (z10 - z00) + v * (z11 - z10))
    surface = np.column_stack([(cell + place) / CELLS, height])
    return surface @ view.world[:3, :3].T + view.world[:3, 3]


def range_of_block(heights: np.ndarray, cell: np.ndarray, level: int) -> float:
    """Highest minus lowest of the block of 2^level x 2^level cells that holds a cell; nan if there is a hole."""
    ix, iy = (cell >> level) << level
    block = heights[iy : iy + 2**level + 1, ix : ix + 2**level + 1]
    return float(block.max() - block.min())


@pytest.mark.parametrize("name", VIEWS)
def test_the_bound(name):
    """The theorem, statement by statement."""
    view = VIEWS[name]
    scene = view.scene()
    camera = scene.camera
    o, d = rays(camera)
    exact, hit, detail = found(scene, None), found(scene, DETAIL), DETAIL
    met, both = hit.met, hit.met & exact.met
    assert not np.any(exact.met & ~met)

    # The surface straight above or below the ray's point is seen that close, and is what is reported as `p`.
    on_ray = (o + np.where(met, hit.t, 0)[:, None] * d)[met]
    surface = above_or_below(view, on_ray, hit.cell[met])
    shift = np.linalg.norm(seen_at(camera, surface) - np.stack([X, Y], axis=1)[met], axis=1)
    assert np.all(shift <= detail + 1e-6)
    assert np.all(np.linalg.norm(surface - view.world[:3, 3] - hit.p[met], axis=1) < 1e-9)
    # And as far as seen across the line of sight, so that depth is bounded where that is along the vertical.
    if not np.array_equal(view.in_camera, np.eye(4)):
        return
    pixel = 2 * half_of_the_screen(camera) / PIXELS
    if isinstance(camera, jaxhf.Perspective):
        pixel = pixel * hit.t[met] * (d[met] @ np.asarray(camera.world_from_camera)[:3, 2]) ** 2
    assert np.all(np.linalg.norm(surface - on_ray, axis=1) <= detail * pixel * (1 + 1e-9))

    # What the ray meets before lies in the block of the reported hit, whose heights are as close as was asked.
    for k in np.flatnonzero(both & (exact.t < hit.t * (1 - 1e-12))):
        levels = [level for level in range(7) if np.array_equal(exact.cell[k] >> level, hit.cell[k] >> level)]
        least = min(range_of_block(view.heights, exact.cell[k], level) for level in levels)
        width = 2 * half_of_the_screen(camera) / PIXELS * (1 if view.extent else exact.t[k])
        assert least * np.linalg.norm(view.world[:3, 2]) <= detail * width

    # It does something, and comes within sight of the bound.
    assert np.mean((hit.cell != exact.cell).any(1)[both]) > 0.02
    assert shift.max() > 0.2 * detail


def test_the_bound_in_single_precision():
    view = VIEWS["grazing"]
    scene = view.scene(np.float32)
    (o, d), hit = rays(scene.camera), found(scene, DETAIL)
    surface = above_or_below(view, (o + np.where(hit.met, hit.t, 0)[:, None] * d)[hit.met], hit.cell[hit.met])
    shift = np.linalg.norm(seen_at(scene.camera, surface) - np.stack([X, Y], axis=1)[hit.met], axis=1)
    # Positions are rounded to some 1e-7, pixels are 0.005 wide where the terrain is nearest.
    assert np.all(shift <= DETAIL + 1e-3)
    assert np.all(np.linalg.norm(surface - hit.p[hit.met], axis=1) < 1e-6)


def test_next_to_nothing_is_the_exact_picture():
    """Bit for bit, as only blocks of equal heights could be stopped at, and bounds are rounded outwards."""
    scene = VIEWS["near"].scene(np.float32)
    image = jaxhf.render(scene, dataclasses.replace(EXACT, detail=1e-9))
    np.testing.assert_array_equal(image, jaxhf.render(scene, EXACT))
    assert np.std(image) > 0.1


def test_derivatives_hold_t_where_the_triangle_is_not_met():
    """Elsewhere t is that of its plane: lifting the surface by 1 brings it closer by n_z / (n . d). All are finite."""
    scene = VIEWS["grazing"].scene()
    o, d = rays(scene.camera)
    settings = dataclasses.replace(EXACT, detail=DETAIL)

    def lifted(heights: jax.Array) -> Any:
        hit = cast_camera(scene.with_heights(heights), X, Y, settings).hit
        return hit.t, hit.p, hit.n, hit.dp_du

    values, backwards = jax.vjp(lifted, scene.heights)
    _, forwards = jax.jvp(lifted, (scene.heights,), (jnp.ones_like(scene.heights),))
    (t, p, n), (dt, dp) = map(np.asarray, values[:3]), map(np.asarray, forwards[:2])
    met = np.isfinite(t)
    beside = met & (np.abs(p - (o + np.where(met, t, 0)[:, None] * d)).max(1) > 1e-9)
    np.testing.assert_array_equal(dt[beside], 0)
    np.testing.assert_allclose(dp[beside], np.broadcast_to([0, 0, 1], (beside.sum(), 3)), rtol=1e-12)
    through = met & ~beside
    np.testing.assert_allclose(dt[through], (n[:, 2] / (n * d).sum(1))[through], rtol=1e-9)
    assert min(beside.sum(), through.sum()) > 300
    (gradient,) = backwards(jax.tree.map(jnp.ones_like, values))
    assert all(np.isfinite(leaf).all() for leaf in (*forwards, gradient))
    assert np.any(gradient)


@jax.jit
def leaving(scene: jaxhf.Scene, starts: Vertex, d: jax.Array, footprint: Footprint) -> Vertex:
    world = make_world(scene, EXACT)
    return jax.vmap(lambda start, d: first_vertex(world, Ray(start.hit.p, d), EXACT, start, footprint=footprint))(starts, d)


def test_rays_that_leave_a_surface_are_exact():
    """As mirrored ones do, whose search has the footprint of their camera ray."""
    scene = VIEWS["near"].scene()
    starts = cast_camera(scene, X, Y, EXACT)
    d = jnp.asarray(np.random.default_rng(4).normal(size=(RAYS, 3)) + np.array([0, 0, 1]))
    no, wide = (Footprint(jnp.full((), width), jnp.full((), width)) for width in (0.0, 1.0))
    met, exact, same = starts.index >= 0, leaving(scene, starts, d, no), leaving(scene, starts, d, wide)
    np.testing.assert_array_equal(same.hit.cell[met], exact.hit.cell[met])
    np.testing.assert_array_equal(same.hit.t[met], exact.hit.t[met])
    free = eqx.tree_at(lambda starts: starts.index, starts, jnp.full_like(starts.index, -1))
    assert np.mean(leaving(scene, free, d, wide).hit.cell != exact.hit.cell) > 0.1


def test_cast_knows_no_pixels():
    """Its program is the same."""
    programs = {
        jax.jit(lambda field, s=s: jaxhf.cast(field, np.zeros(3), np.ones(3), s)).lower(jaxhf.Heightfield(ROUGH)).as_text()
        for s in (EXACT, dataclasses.replace(EXACT, detail=1.0))
    }
    assert len(programs) == 1
