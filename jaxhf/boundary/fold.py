"""The two triangles of an edge, as sight or light that passes a point of the edge meets them. Discrete: no derivative."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from ..core.ray import Ray
from ..core.types import Flag, Index, Scalar, Vector
from ..core.vector import dot, largest_component, unit
from ..scene.camera import Camera
from ..scene.light import Point, casts_sharp_shadows
from ..trace.grid import Grid, triangle_plane
from ..trace.hit import Hit
from ..trace.intersect import intersect
from ..trace.skirt import Walls
from ..trace.status import Status
from ..trace.world import World, nearest_hit, no_hit
from ..xla.materialise import materialise
from .outline import UPWARDS, along_edge, column_of, faces_of, is_alone, outwards
from .sample import BoundarySample, between_ends, on_edge
from .silhouette import whole_cells

# Other surfaces are looked for beside the edge and from a little before it, so that those that share a border with the edge's
# are met: this many times the square root of an ulp of the grid's larger side beside it, and as many times that before it.
_ASIDE, _BACK = 1 / 16, 16
# Units in the last place within which a wall's upper edge is a terrain's border.
_TOUCHING = 64


class WallFaces(eqx.Module):
    """The faces of an edge that are walls of a skirt, or its floor.

    Attributes:
      touching: of the object whose they are, with both in `cell`, what says that a ray from the edge cannot meet them; of no
        object where none touches the edge.
      near, ahead: in place of the triangles of `Fold`, at a point of the face beside the edge, where no other face's rounding
        shadows it.
      is_near, is_ahead: whether they are that.
      inwards: as far from the edge over the terrain, world frame; zero where no wall touches the edge of a triangle.
      within: as far from the edge into the solid, where the source sees it from there; else zero.
    """

    touching: Hit
    near: Hit
    ahead: Hit
    is_near: Flag
    is_ahead: Flag
    inwards: Vector
    within: Vector


class Fold(eqx.Module):
    """An edge's two triangles at a sample, met by the ray that passes it from the eye, or from the light whose shadow it is.

    Attributes:
      past: the ray, from the sample on, away from its source; `d` has length 1.
      distance: of the source; infinite for a directional light.
      near: on the triangle over which the ray comes; says what a ray needs that leaves it towards the source.
      ahead: on that over which the ray goes on; says what the ray needs to leave it. At a border both are the only triangle.
      source_side: of the triangle ahead, 1 where the source stands on its +z side, else -1.
      bends: whether the source sees only one of the triangles, or there is only one: then the edge bounds what it sees.
      beside: the ray that other surfaces than the edge's are met by, on the side away from `near`; it begins `back` earlier.
      back: in the units of the ray.
      across: unit normal of the plane through the edge and the source, towards `near`; in the surface's own frame.
      faces: those that are not triangles; None in a scene without a skirt.
    """

    past: Ray
    distance: Scalar
    near: Hit
    ahead: Hit
    source_side: Index
    bends: Flag
    beside: Ray
    back: Scalar
    across: Vector
    faces: WallFaces | None = None


def towards(world: World, camera: Camera, light: Index, p: Vector) -> tuple[Vector, Scalar]:
    """Unit direction from p to a light, or to the eye where that is -1, and the distance."""
    eye, at_place = camera.viewpoint()
    sight = eye - p if at_place else eye * camera.film_from_world()(p)[3]
    chosen = unit(sight)
    distance = dot(sight, chosen)
    for number, source in enumerate(world.lights):
        if not casts_sharp_shadows(source):
            continue
        there = source.p - p if isinstance(source, Point) else source.towards
        to = unit(there)
        far = dot(there, to) if isinstance(source, Point) else jnp.full_like(distance, jnp.inf)
        chosen, distance = jnp.where(light == number, to, chosen), jnp.where(light == number, far, distance)
    return chosen, distance


def fold_at(world: World, camera: Camera, sample: BoundarySample) -> Fold:
    """The fold at a sample."""
    p = on_edge(world, sample, sample.s)
    to, distance = towards(world, camera, sample.light, p)
    chosen = None
    for k, grid, _ in world.grids:
        here = _fold_on(grid, k, sample, Ray(p, -to), distance)
        here = _with_walls(world, grid, sample, here) if skirts(world) else here
        chosen = here if chosen is None else jax.tree.map(lambda a, b, k=k: jnp.where(sample.surface == k, a, b), here, chosen)
    for k, walls in skirts(world):
        here = _fold_of_walls(world, walls, k, sample, Ray(p, -to), distance)
        chosen = here if chosen is None else jax.tree.map(lambda a, b, k=k: jnp.where(sample.surface == k, a, b), here, chosen)
    assert chosen is not None
    return chosen


def _fold_on(grid: Grid, number: int, sample: BoundarySample, past: Ray, distance: Scalar) -> Fold:
    local = grid.grid_from_world.vector(past.d)
    d = unit(local)
    ix, iy = sample.start[0], sample.start[1]
    along_x, along_y = sample.end[1] == iy, sample.end[0] == ix
    # The triangles to the left of the edge (above it, where it runs along x) and to its right.
    left_x, left_y, left_upper = jnp.where(along_y, ix - 1, ix), iy, ~along_x & ~along_y
    right_x, right_y, right_upper = ix, jnp.where(along_x, iy - 1, iy), along_x | along_y
    has_left, has_right = _has_cell(grid, left_x, left_y), _has_cell(grid, right_x, right_y)
    leftwards = jnp.where(along_x, d[1] > 0, jnp.where(along_y, d[0] < 0, d[1] > d[0]))
    ahead_left = (has_left & leftwards) | ~has_right
    near_left = ahead_left ^ (has_left & has_right)
    x, y = between_ends(sample, sample.s)

    def on_triangle(left: Flag) -> tuple[Hit, Index]:
        """A hit from the side of the source on one of the two, and the side."""
        cell_x = jnp.clip(jnp.where(left, left_x, right_x), 0, grid.cells[0] - 1)
        cell_y = jnp.clip(jnp.where(left, left_y, right_y), 0, grid.cells[1] - 1)
        upper = jnp.where(left, left_upper, right_upper)
        a, b, _ = triangle_plane(grid, cell_x, cell_y, upper)
        side = jnp.where(d[2] - a * d[0] - b * d[1] <= 0, 1, -1).astype(jnp.int32)
        hit = eqx.tree_at(
            lambda hit: (hit.cell, hit.triangle, hit.side, hit.uv, hit.object),
            no_hit(d.dtype),
            (
                jnp.stack([cell_x, cell_y]),
                upper.astype(jnp.int32),
                side,
                jnp.stack([x / grid.cells[0], y / grid.cells[1]]),
                jnp.full((), number, jnp.int32),
            ),
        )
        return hit, side

    near, near_side = on_triangle(near_left)
    ahead, source_side = on_triangle(ahead_left)
    z0, z1 = (grid.rows.at[v[1] * grid.shape[1] + v[0]].get(mode="clip") for v in (sample.start, sample.end))
    e = jnp.stack([*(sample.end - sample.start).astype(d.dtype), jnp.where(jnp.isfinite(z1 - z0), z1 - z0, 0)])
    normal = jnp.stack([e[i] * d[j] - e[j] * d[i] for i, j in ((1, 2), (2, 0), (0, 1))])
    # The triangle on the left lies on the side of e x d if the source sees its +z side.
    across = unit(normal) * jnp.where(near_left, near_side, -near_side).astype(d.dtype)
    bends = (near_side != source_side) | ~(has_left & has_right)
    step = _beside(max(grid.cells), d.dtype)
    back = _BACK * step / dot(local, d)
    beside = Ray(past.o - grid.world_from_grid.vector(across * step) - back * past.d, past.d)
    return Fold(past, distance, near, ahead, source_side, bends, beside, back, across)


def skirts(world: World) -> list[tuple[int, Walls]]:
    """The skirts, with the numbers of their objects."""
    return [(k, surface) for k, surface in enumerate(world.surfaces) if isinstance(surface, Walls)]


def _with_walls(world: World, grid: Grid, sample: BoundarySample, fold: Fold) -> Fold:
    """The fold with the wall that stands below the grid's border, where the sample is on that: it is the other face there.

    Of the two the source sees the outer side of both, and the wall is ahead; or of one, which is near, and the edge bounds it;
    or the inner side of both, and again the wall is ahead.
    """
    p, dtype = fold.past.o, fold.past.o.dtype
    ix, iy = sample.start[0], sample.start[1]
    along_x, along_y = sample.end[1] == iy, sample.end[0] == ix
    first = (along_x & (iy == 0)) | (along_y & (ix == 0))
    on_border = first | (along_x & (iy == grid.cells[1])) | (along_y & (ix == grid.cells[0]))
    side = jnp.where(along_x, 0, 2).astype(jnp.int32) + jnp.where(first, 0, 1).astype(jnp.int32)
    nowhere = no_hit(dtype)
    faces = WallFaces(nowhere, nowhere, nowhere, jnp.zeros((), bool), jnp.zeros((), bool), *[jnp.zeros(3, dtype)] * 2)
    for number, walls in skirts(world):
        if walls.cells != grid.cells:
            continue
        column, row = column_of(walls, side, jnp.where(along_x, ix, iy)), jnp.ones_like(ix)
        there = faces_of(walls, jnp.zeros_like(row), column, row, True).has_first
        local, world_from = walls.object_from_world.ray(fold.past), walls.world_from_object
        gap = largest_component(local.o - along_edge(walls, jnp.stack([column, row]), jnp.stack([column + 1, row]), sample.s))
        rounding = _TOUCHING * float(jnp.finfo(dtype).eps) * (largest_component(local.o) + max(walls.size))
        touches = on_border & there & (gap <= rounding)
        outside = dot(outwards(side, dtype), local.d) < 0
        bends = (fold.source_side > 0) != outside
        step = _beside(max(walls.size), dtype)
        wall = _hit_face(number, side, side, p - step * world_from.vector(outwards(jnp.full_like(side, UPWARDS), dtype)))
        inwards = -step * world_from.vector(outwards(side, dtype))
        within = jnp.where(bends | outside, 0, inwards + wall.p - p)
        here = WallFaces(_touching(wall), wall, wall, bends & outside, ~bends, inwards, within)
        faces = jax.tree.map(lambda new, old, touches=touches: jnp.where(touches, new, old), here, faces)
        fold = dataclasses.replace(fold, bends=jnp.where(touches, bends, fold.bends))
    return dataclasses.replace(fold, faces=faces)


def _fold_of_walls(world: World, walls: Walls, number: int, sample: BoundarySample, past: Ray, distance: Scalar) -> Fold:
    """The fold at a sample of one of their own edges: its faces stand for the triangles."""
    local, world_from = walls.object_from_world.vector(past.d), walls.world_from_object
    d, dtype = unit(local), past.d.dtype
    start, end = sample.start, sample.end
    kind = jnp.where(end[1] == start[1], 0, jnp.where(end[0] == start[0], 1, 2))
    faces = faces_of(walls, kind, start[0], start[1], is_alone(world, walls))
    one, other = (jnp.where(faces.has_first, a, b) for a, b in ((faces.first, faces.second), (faces.second, faces.first)))
    both = faces.has_first & faces.has_second
    one_outside, other_outside = (dot(outwards(face, dtype), d) < 0 for face in (one, other))
    bends = ~both | (one_outside != other_outside)
    swapped = both & bends & other_outside
    near, ahead = jnp.where(swapped, other, one), jnp.where(swapped, one, other)
    zero, whole = jnp.zeros_like(sample.s), jnp.ones_like(sample.s)
    e = along_edge(walls, start, end, whole) - along_edge(walls, start, end, zero)
    normal = unit(jnp.stack([e[i] * d[j] - e[j] * d[i] for i, j in ((1, 2), (2, 0), (0, 1))]))
    across = jnp.where(dot(normal, outwards(ahead, dtype)) > 0, -normal, normal)
    step = _beside(max(walls.size), dtype)
    back = _BACK * step / dot(local, d)
    beside = Ray(past.o - world_from.vector(across * step) - back * past.d, past.d)
    on_near, on_ahead = (
        _hit_face(number, face, jnp.where(both, rest, face), past.o - step * world_from.vector(outwards(rest, dtype)))
        for face, rest in ((near, ahead), (ahead, near))
    )
    within = jnp.where(bends | one_outside, 0, on_near.p + on_ahead.p - 2 * past.o)
    found = WallFaces(_touching(on_near), on_near, on_ahead, jnp.ones((), bool), both & ~bends, jnp.zeros(3, dtype), within)
    nowhere = no_hit(dtype)
    return Fold(past, distance, nowhere, nowhere, jnp.ones((), jnp.int32), bends, beside, back, across, found)


def _beside(size: int | float, dtype: Any) -> float:
    """How far beside an edge other surfaces are looked for, in the unit of the surface's size."""
    return _ASIDE * float(jnp.finfo(dtype).eps) ** 0.5 * size


def _hit_face(number: int, face: Index, other: Index, p: Vector) -> Hit:
    return dataclasses.replace(
        no_hit(p.dtype), object=jnp.full((), number, jnp.int32), cell=jnp.stack([face, other]).astype(jnp.int32), p=p
    )


def _touching(hit: Hit) -> Hit:
    return dataclasses.replace(hit, triangle=jnp.ones((), jnp.int32))


def _has_cell(grid: Grid, ix: Index, iy: Index) -> Flag:
    """Whether there is such a cell, with all its vertices."""
    x, y = jnp.clip(ix, 0, grid.cells[0] - 1), jnp.clip(iy, 0, grid.cells[1] - 1)
    return materialise((x == ix) & (y == iy) & whole_cells(grid)[y, x])


class Probe(eqx.Module):
    """A ray from a hit, and how far it looks.

    Attributes:
      ray: by which the edge's own surface is met.
      beside: by which others are; it begins `back` earlier. None where there are no others.
      back: in the units of the rays.
      leaving: the hit.
      touching: for walls in its place; None in a scene without a skirt.
      active: whether it looks at all.
      t_max: how far.
    """

    ray: Ray
    beside: Ray | None
    back: Scalar
    leaving: Hit
    active: Flag
    t_max: Scalar
    touching: Hit | None = None


def probe(world: World, ray: Ray, leaving: Hit, active: Flag, t_max: Scalar) -> Probe:
    """One that meets all surfaces by the same ray."""
    beside = ray if len(world.surfaces) > 1 else None
    return Probe(ray, beside, jnp.zeros_like(t_max), leaving, active, t_max, leaving if skirts(world) else None)


def probe_source(world: World, fold: Fold, active: Flag) -> Probe:
    """From the edge to the source."""
    if fold.faces is None:
        return probe(world, Ray(fold.past.o, -fold.past.d), fold.near, active, fold.distance)
    found = probe(world, Ray(fold.past.o + fold.faces.within, -fold.past.d), fold.near, active, fold.distance)
    return dataclasses.replace(found, touching=fold.faces.touching)


def probe_beyond(world: World, fold: Fold, active: Flag) -> Probe:
    """Past the edge. Another surface that touches the edge there is met at a t between -`back` and `back`."""
    leaving = eqx.tree_at(lambda hit: hit.side, fold.ahead, -fold.source_side)
    beside = fold.beside if len(world.surfaces) > 1 else None
    touching = None if fold.faces is None else fold.faces.touching
    return Probe(fold.past, beside, fold.back, leaving, active, jnp.full_like(fold.back, jnp.inf), touching)


def meet(world: World, sample: BoundarySample, probe: Probe) -> tuple[Hit, Flag]:
    """What a probe meets, t counted from the start of its `ray`; and whether an active one meets nothing before its `t_max`."""
    hits = []
    for number, surface in enumerate(world.surfaces):
        ray, back = probe.ray, None
        if probe.beside is not None and isinstance(surface, Walls):  # along which sight may pass
            ray, back = probe.beside, probe.back
        elif probe.beside is not None:
            own = sample.surface == number
            ray = jax.tree.map(lambda a, b, own=own: jnp.where(own, a, b), probe.ray, probe.beside)
            back = jnp.where(own, 0, probe.back)
        hit = intersect(
            surface,
            number,
            ray,
            max_steps=world.settings.max_steps,
            leaving=probe.touching if isinstance(surface, Walls) else probe.leaving,
            active=probe.active,
            t_max=probe.t_max if back is None else probe.t_max + back,
        )
        hits.append(hit if back is None else eqx.tree_at(lambda hit: hit.t, hit, hit.t - back))
    hit = nearest_hit(hits)
    return hit, probe.active & ~((hit.status == int(Status.HIT)) & (hit.t < probe.t_max))
