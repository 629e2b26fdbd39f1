"""A scene made ready for tracing, and the first hit over all its objects."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp

from ..core.affine import affine
from ..core.materialise import stored
from ..core.ray import Ray
from ..core.sampling import grid_side
from ..core.settings import Settings
from ..core.types import Flag, Index, MatrixLeaf
from ..scene.heightfield import Heightfield
from ..scene.light import Light
from ..scene.material import Material
from ..scene.scene import Scene, Shape
from .cylinder import make_tube
from .grid import Grid, make_grid
from .hit import Hit
from .intersect import Surface, intersect
from .status import Status
from .walk_start import Origin


class World(eqx.Module):
    """A scene made ready for tracing: see `make_grid`, `make_tube`."""

    surfaces: tuple[Surface, ...]
    materials: tuple[Material, ...]
    lights: tuple[Light, ...]

    @property
    def grids(self) -> tuple[tuple[int, Grid, int], ...]:
        """Of each grid: which surface it is, the grid, and the number of its first vertex, counted over all surfaces."""
        found, first = [], 0
        for k, surface in enumerate(self.surfaces):
            if isinstance(surface, Grid):
                found.append((k, surface, first))
                first += surface.rows.shape[0]
        return tuple(found)


def make_world(scene: Scene, settings: Settings) -> World:
    """Prepares what does not depend on the ray; `scene` must be `localise`d."""

    return World(
        surfaces=tuple(make_surface(obj.shape, obj.world_from_object, settings) for obj in scene.objects),
        materials=tuple(obj.material for obj in scene.objects),
        lights=scene.lights,
    )


def make_surface(shape: Shape, world_from_object: MatrixLeaf | None, settings: Settings) -> Surface:
    world = None if world_from_object is None else affine(jnp.asarray(world_from_object))
    if isinstance(shape, Heightfield):
        normals = settings.normals if settings.shading == "smooth" else None
        return make_grid(shape, world, normals, levels=0 if settings.traversal == "dda" else None)
    return make_tube(shape, world)


class Vertex(eqx.Module):
    """A hit, and which object it is on; -1 for none."""

    hit: Hit
    index: Index


def first_vertex(
    world: World,
    ray: Ray,
    settings: Settings,
    origin: Vertex | None = None,
    active: Flag | None = None,
    count_steps: bool = False,
) -> Vertex:
    """The nearest hit over all objects. A ray that one object could not decide (EXHAUSTED, INVALID) has that status."""
    nearest, index, steps = None, jnp.full((), -1, jnp.int32), jnp.zeros((), jnp.int32)
    for k, surface in enumerate(world.surfaces):
        start = None if origin is None else Origin(origin.hit, origin.index == k)
        hit = intersect(surface, ray, settings, start, active, count_steps)
        if hit.steps is not None:
            steps = steps + hit.steps
        if nearest is None:
            nearest, index = hit, jnp.where(hit.status == int(Status.HIT), k, index)
            continue
        closer = hit.t < nearest.t
        status = jnp.maximum(hit.status, nearest.status)  # ordered: MISS, HIT, EXHAUSTED, INVALID
        nearest = jax.tree.map(lambda new, old, closer=closer: jnp.where(closer, new, old), hit, nearest)
        nearest = eqx.tree_at(lambda hit: hit.status, nearest, status)
        index = jnp.where(closer, k, index)
    assert nearest is not None
    if count_steps:
        nearest = eqx.tree_at(lambda hit: hit.steps, nearest, steps)
    vertex = Vertex(nearest, jnp.where(nearest.status == int(Status.HIT), index, -1))
    return stored(vertex, world.surfaces[0].sure) if len(world.surfaces) > 1 else vertex


def nowhere(dtype) -> Vertex:
    """The origin of a camera ray, in the form of those of mirrored rays."""
    zero, up, whole = jnp.zeros(3, dtype), jnp.array([0, 0, 1], dtype), jnp.zeros((), jnp.int32)
    hit = Hit(
        status=whole, t=jnp.zeros((), dtype), p=zero, n=up, ns=up, uv=jnp.zeros(2, dtype), dp_du=zero, dp_dv=zero,
        dn_du=zero, dn_dv=zero, cell=jnp.zeros(2, jnp.int32), triangle=whole, side=jnp.ones((), jnp.int32),
    )  # fmt: skip
    return Vertex(hit, jnp.full((), -1, jnp.int32))


def settle(settings: Settings, scene: Scene) -> Settings:
    """The settings with what they leave to the scene filled in."""
    samples = scene.samples if settings.samples is None else settings.samples
    return dataclasses.replace(settings, samples=grid_side(samples) ** 2)
