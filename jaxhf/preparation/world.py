"""A scene made ready for tracing, and the first hit over all its objects."""

import dataclasses
import functools
import math
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Float

from ..core.affine import affine
from ..core.errors import require_kind
from ..core.ray import Ray
from ..core.settings import Settings
from ..core.types import Flag, Index, MatrixLeaf, Scalar
from ..core.vector import unit
from ..scene.heightfield import Heightfield, Size
from ..scene.light import Directional, Light, Sun
from ..scene.material import Material, Mirror
from ..scene.scene import Scene, Shape
from ..scene.skirt import Skirt
from ..trace.cylinder import make_tube
from ..trace.grid import Grid, make_grid
from ..trace.hit import Hit, Status
from ..trace.intersect import Surface, blocked, intersect
from ..trace.skirt import make_walls
from ..xla.masked import only_where
from ..xla.materialise import materialise
from .ceiling import Ceiling, clears, make_ceiling
from .sky import visible_sky

Ceilings = tuple[tuple[Ceiling | None, ...], ...]
"""For each light and each object."""


class World(eqx.Module):
    """A scene made ready for tracing, with the settings for which it was made.

    Attributes:
      surfaces: of each object, see `make_grid`, `make_tube` and `make_walls`.
      materials: of each object.
      lights: as the scene's.
      ceilings: for each light and each object, where that object cannot keep the light from itself; None for all but a
        heightfield under a directional light, and where no walk is to be spared.
      sky: for each object, what it leaves to see of the sky at its vertices, see `visible_sky`; None for all but heightfields,
        and where no sky is hidden.
      has_room: see `make_roomy_world`.
      settings: nothing in them is left to the scene, see `resolve_settings`.
    """

    surfaces: tuple[Surface, ...]
    materials: tuple[Material | Mirror, ...]
    lights: tuple[Light, ...]
    ceilings: Ceilings
    sky: tuple[Float[jax.Array, "_ 3"] | None, ...]
    settings: Settings = eqx.field(static=True)
    has_room: bool = eqx.field(static=True, default=False)

    @property
    def grids(self) -> tuple[tuple[int, Grid, int], ...]:
        """Of each grid: the number of its object, the grid, and the number of its first vertex, counted over all grids."""
        found, first = [], 0
        for k, surface in enumerate(self.surfaces):
            if isinstance(surface, Grid):
                found.append((k, surface, first))
                first += surface.rows.shape[0]
        return tuple(found)


def resolve_settings(settings: Settings, scene: Scene) -> Settings:
    """The settings with what they leave to the scene filled in."""
    require_kind("", "settings", settings, Settings, "a jaxhf.Settings")
    samples = scene.samples if settings.samples is None else settings.samples
    side = math.isqrt(samples - 1) + 1
    return dataclasses.replace(settings, samples=side**2, edge_samples=settings.edge_samples or 0)


def make_world(scene: Scene, settings: Settings, sizes: Sequence[Size | None] | None = None) -> World:
    """Prepares what does not depend on the ray; `scene` must be `localise`d. `sizes`: of objects whose size is data."""
    settings = resolve_settings(settings, scene)
    sizes = sizes or [None] * len(scene.objects)
    surfaces = tuple(
        make_surface(obj.shape, obj.world_from_object, settings, size) for obj, size in zip(scene.objects, sizes, strict=True)
    )
    return World(
        surfaces=surfaces,
        materials=tuple(obj.material for obj in scene.objects),
        lights=scene.lights,
        ceilings=make_ceilings(surfaces, scene.lights, settings),
        sky=_hidden_sky(surfaces, scene.sky_occlusion),
        settings=settings,
    )


def _hidden_sky(surfaces: tuple[Surface, ...], azimuths: int | None) -> tuple[Float[jax.Array, "_ 3"] | None, ...]:
    return tuple(
        visible_sky(surface, azimuths, _joined_to(surface, surfaces)) if azimuths and isinstance(surface, Grid) else None
        for surface in surfaces
    )


def _joined_to(grid: Grid, surfaces: tuple[Surface, ...]) -> list[Grid]:
    """The other grids with which it is one surface."""
    grids = (surface for surface in surfaces if isinstance(surface, Grid) and surface is not grid)
    return [other for other in grids if other.seam is not None and grid.seam is not None]


def make_ceilings(surfaces: tuple[Surface, ...], lights: tuple[Light, ...], settings: Settings) -> Ceilings:
    """See `World`: all of it that depends on the lights, beside these."""
    # A walk whose steps are counted is not to be spared.
    spared = settings.shadows and settings.early_exit and settings.max_steps is None
    return tuple(tuple(_make_ceiling(surface, light, spared) for surface in surfaces) for light in lights)


def _make_ceiling(surface: Surface, light: Light, wanted: bool) -> Ceiling | None:
    if not wanted or not isinstance(surface, Grid) or not isinstance(light, Directional) or isinstance(light, Sun):
        return None
    return make_ceiling(surface, unit(light.towards))


def make_surface(shape: Shape, world_from_object: MatrixLeaf | None, settings: Settings, size: Size | None = None) -> Surface:
    """A shape made ready for tracing."""
    world = None if world_from_object is None else affine(jnp.asarray(world_from_object))
    if isinstance(shape, Heightfield):
        return make_grid(shape, world, settings, size)
    return make_walls(shape, world, size) if isinstance(shape, Skirt) else make_tube(shape, world)


def first_hit(
    world: World,
    ray: Ray,
    leaving: Hit | None = None,
    active: Flag | None = None,
    count_steps: bool = False,
    tangents: bool = False,
) -> Hit:
    """The nearest hit over all objects. A ray that one object could not decide (EXHAUSTED, INVALID) has that status.

    The arguments are those of `intersect`.
    """
    meet = functools.partial(intersect, leaving=leaving, active=active, count_steps=count_steps, tangents=tangents)
    return nearest_hit([meet(surface, number, ray) for number, surface in enumerate(world.surfaces)])


def nearest_hit(hits: list[Hit]) -> Hit:
    """The nearest of one ray's hits on all objects, in their order; its steps are those of all, if they were counted."""
    nearest = hits[0]
    for hit in hits[1:]:
        closer = hit.t < nearest.t
        status = jnp.maximum(hit.status, nearest.status)  # ordered: MISS, HIT, EXHAUSTED, INVALID
        steps = None if nearest.steps is None or hit.steps is None else nearest.steps + hit.steps
        nearest = jax.tree.map(lambda new, old, closer=closer: jnp.where(closer, new, old), hit, nearest)
        nearest = dataclasses.replace(nearest, status=status, steps=steps)
    if len(hits) == 1:
        return nearest
    number = jnp.where(nearest.status == int(Status.HIT), nearest.object, -1)
    return materialise(dataclasses.replace(nearest, object=number))


def unblocked(world: World, ray: Ray, leaving: Hit, active: Flag, t_max: Scalar | None, light: int) -> tuple[Flag, Index]:
    """Whether an active ray meets nothing before `t_max`, and how many walks ran out of steps; no derivative.

    Args:
      world: what may be in the way.
      ray: from the hit `leaving`.
      active: False spares the ray the search; it then counts as blocked.
      t_max: where to give up; None: nowhere.
      light: the number of the light to which the ray goes, whose ceilings spare walks.
    """
    surfaces, ray, leaving, t_max = lax.stop_gradient((world.surfaces, ray, leaving, t_max))
    free, exhausted = active, jnp.zeros((), jnp.int32)
    for number, surface in enumerate(surfaces):
        search = functools.partial(blocked, number=number)
        ceiling = world.ceilings[light][number]
        if ceiling is None or not isinstance(surface, Grid):
            met, ran_out = search(surface, ray, leaving, free, t_max)
        else:
            walks = free & ~clears(ceiling, surface, number, leaving)
            met, ran_out = only_where(walks, search, surface, ray, leaving, walks, t_max)
        free, exhausted = free & ~met, exhausted + ran_out.astype(jnp.int32)
    return free, exhausted


def no_hit(dtype) -> Hit:
    """A hit on nothing: what camera rays leave, in the form of what mirrored rays leave."""
    zero, up, whole = jnp.zeros(3, dtype), jnp.array([0, 0, 1], dtype), jnp.zeros((), jnp.int32)
    return Hit(
        status=whole, object=whole - 1, t=jnp.zeros((), dtype), p=zero, n=up, ns=up, uv=jnp.zeros(2, dtype),
        cell=jnp.zeros(2, jnp.int32), triangle=whole, side=jnp.ones((), jnp.int32),
    )  # fmt: skip
