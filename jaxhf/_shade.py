"""Radiance along one ray: direct light, shadows, mirrors."""

import functools
from collections.abc import Iterable

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Bool

from ._cylinder import make_tube
from ._grid import Grid, make_grid
from ._heightfield import Heightfield
from ._hit import Hit, Origin, Surface, blocked, intersect
from ._lanes import only_where
from ._light import Directional, Light, Point, Sky
from ._material import Material, Matte, Mirror
from ._ray import Ray
from ._scene import Scene, Shape
from ._settings import Settings
from ._store import stored
from ._texture import ImageTexture
from ._transform import affine, dot, largest_component, power_of_two, unit
from ._types import Flag, Index, MatrixLeaf, Scalar, Vector
from ._walk import Status

# A cosine below this is rounded off; 0.6 degrees from the horizon of the shading normal.
_GRAZING = 0.01


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


def radiance(world: World, ray: Ray, settings: Settings) -> tuple[Vector, Index]:
    """What comes along a camera ray against its direction, shape (3,), and how many walks ran out of steps on the way."""
    if not mirrors(world.materials, settings):
        return direct(world, ray, settings)[:2]

    def bounce(carry, _):
        ray, origin, throughput, total, active, exhausted = carry
        reached = only_where(active, functools.partial(_bounce, settings), world, ray, origin, active)
        mirrored_ray, vertex, reflectance, light, goes_on, more = reached
        carry = mirrored_ray, vertex, throughput * reflectance, total + throughput * light, goes_on, exhausted + more
        return carry, None

    dtype = ray.d.dtype
    none = jnp.zeros((), jnp.int32)
    init = (ray, nowhere(dtype), jnp.ones(3, dtype), jnp.zeros(3, dtype), jnp.ones((), bool), none)
    (_, _, _, total, _, exhausted), _ = lax.scan(bounce, init, length=settings.max_depth + 1)
    return total, exhausted


def mirrors(materials: Iterable[Material], settings: Settings) -> bool:
    """Whether light may come by way of a mirror."""
    return settings.max_depth > 0 and any(isinstance(material, Mirror) for material in materials)


def direct(world: World, ray: Ray, settings: Settings) -> tuple[Vector, Index, Vertex]:
    """`radiance` where there are no mirrors, and from where it comes."""
    vertex = first_vertex(world, ray, settings)
    light, exhausted = _outgoing(world, ray, vertex, vertex.hit.status != int(Status.EXHAUSTED), settings)
    return light, exhausted + _count(vertex.hit.status == int(Status.EXHAUSTED)), vertex


def _bounce(
    settings: Settings, world: World, ray: Ray, origin: Vertex, active: Flag
) -> tuple[Ray, Vertex, Vector, Vector, Flag, Index]:
    """Follows `ray` to where it arrives.

    Returns:
      The mirrored ray, where it starts, and by how much it weighs less; the light from there; whether to go on; how many
      walks ran out of steps.
    """
    vertex = first_vertex(world, ray, settings, origin, active)
    out_of_steps = active & (vertex.hit.status == int(Status.EXHAUSTED))
    light, exhausted = _outgoing(world, ray, vertex, active & ~out_of_steps, settings)
    mirrored, reflectance = _mirrored(world, vertex)
    onwards = Ray(vertex.hit.p, _reflect(ray.d, vertex.hit))
    return onwards, vertex, reflectance, light, active & mirrored, exhausted + _count(out_of_steps)


def _count(flag: Flag) -> Index:
    return flag.astype(jnp.int32)


def nowhere(dtype) -> Vertex:
    """The origin of a camera ray, in the form of those of mirrored rays."""
    zero, up, whole = jnp.zeros(3, dtype), jnp.array([0, 0, 1], dtype), jnp.zeros((), jnp.int32)
    hit = Hit(
        status=whole, t=jnp.zeros((), dtype), p=zero, n=up, ns=up, uv=jnp.zeros(2, dtype), dp_du=zero, dp_dv=zero,
        dn_du=zero, dn_dv=zero, cell=jnp.zeros(2, jnp.int32), triangle=whole, side=jnp.ones((), jnp.int32),
    )  # fmt: skip
    return Vertex(hit, jnp.full((), -1, jnp.int32))


def _outgoing(world: World, ray: Ray, vertex: Vertex, active: Flag, settings: Settings) -> tuple[Vector, Index]:
    """Light that a matte surface sends back along `ray`, or the sky where there is no surface."""
    hit = active & (vertex.hit.status == int(Status.HIT))
    total, exhausted = jnp.zeros_like(ray.d), jnp.zeros((), jnp.int32)
    albedo = _albedo(world, vertex)
    if albedo is not None:
        matte = hit & _is(world, vertex, Matte)
        for light in world.lights:
            irradiance, more = only_where(matte, functools.partial(_irradiance, settings), world, light, vertex, matte)
            total, exhausted = total + irradiance, exhausted + more
        total = jnp.where(matte, albedo / jnp.pi * total, 0)
    for light in world.lights:
        if isinstance(light, Sky):
            total = total + jnp.where(active & (vertex.hit.status == int(Status.MISS)), light.radiance, 0)
    return total, exhausted


def _irradiance(settings: Settings, world: World, light: Light, vertex: Vertex, active: Flag) -> tuple[Vector, Index]:
    """What arrives at the side of the surface that the ray came from."""
    hit = vertex.hit
    if isinstance(light, Sky):
        cosine = hit.ns[2] * hit.side.astype(hit.ns.dtype)
        return light.radiance * (jnp.pi * (1 + cosine) / 2), jnp.zeros((), jnp.int32)
    wi, arriving, distance = stored(_towards(light, hit.p), world.surfaces[0].sure)
    lit, exhausted = _visible(world, wi, distance, vertex, active, settings)
    cosine = rounded_abs(dot(wi, hit.ns)) if settings.shading == "smooth" else jnp.abs(dot(wi, hit.ns))
    return jnp.where(lit, arriving * cosine, 0), exhausted


def _towards(light: Directional | Point, p: Vector) -> tuple[Vector, Vector, Scalar | None]:
    """Unit direction to the light, irradiance across that direction, distance (None: infinite)."""
    if isinstance(light, Directional):
        return unit(light.towards), light.radiance, None
    to = light.p - p
    size = largest_component(to)
    size = power_of_two(jnp.where(size > 0, size, 1))  # beyond its square root no number has a square
    to = to / size
    square = dot(to, to)
    square = jnp.where(square > 0, square, 1)
    distance = jnp.sqrt(square)
    return to / distance, light.intensity / square / size / size, distance * size


def _visible(
    world: World, wi: Vector, distance: Scalar | None, vertex: Vertex, active: Flag, settings: Settings
) -> tuple[Flag, Index]:
    """Whether light from `wi` reaches the side that the ray came from, and how many walks ran out of steps.

    The triangle's own normal decides on which side the light stands (Veach 1997, section 5.3; pbrt-v2's BSDF::f).
    """
    hit = vertex.hit
    lit = active & (dot(wi, hit.n) * hit.side.astype(wi.dtype) > 0)
    exhausted = jnp.zeros((), jnp.int32)
    if settings.shadows:
        for k, surface in enumerate(world.surfaces):
            origin = Origin(hit, vertex.index == k)
            hidden, ran_out = blocked(surface, Ray(hit.p, wi), settings, origin, lit, distance)
            lit, exhausted = lit & ~hidden, exhausted + _count(ran_out)
    return lit, exhausted


def rounded_abs(cosine: Scalar) -> Scalar:
    """|cosine|, with the corner at zero replaced by a parabola that meets it with equal slope.

    Where an interpolated normal faces away from a surface that does face the light, a cosine clamped at zero leaves a
    black hole; pbrt-v2 takes its absolute value, whose derivative jumps. This is that, without the jump: it differs
    only below 0.01, by at most 0.005.
    """
    size = jnp.abs(cosine)
    return jnp.where(size < _GRAZING, (cosine * cosine + _GRAZING**2) / (2 * _GRAZING), size)


def _reflect(d: Vector, hit: Hit) -> Vector:
    """The mirrored direction about the shading normal, lifted where it would dive below the triangle itself.

    The lift along n is smooth and begins 0.6 degrees above the surface; the idea of bending a reflection
    back is that of Keller et al. (The Iray light transport simulation and rendering system, 2017, appendix A.3).
    """
    out = d - 2 * dot(d, hit.ns) * hit.ns
    n = hit.n * hit.side.astype(d.dtype)
    height = dot(out, n)
    low = height < _GRAZING
    lifted = _GRAZING**2 / jnp.where(low, 2 * _GRAZING - height, 1)
    return jnp.where(low, unit(out + (lifted - height) * n), out)


def _is(world: World, vertex: Vertex, kind: type) -> Flag:
    """Whether the vertex lies on an object of a material."""
    flags = [isinstance(material, kind) for material in world.materials]
    if all(flags):
        return vertex.index >= 0
    found = jnp.zeros((), bool)
    for k, flag in enumerate(flags):
        found = found | (vertex.index == k) if flag else found
    return found


def _albedo(world: World, vertex: Vertex) -> Vector | None:
    """That of the object which was hit; None where no object is matte."""
    values = [
        (k, m.albedo(vertex.hit.uv) if isinstance(m.albedo, ImageTexture) else jnp.asarray(m.albedo))
        for k, m in enumerate(world.materials)
        if isinstance(m, Matte)
    ]
    return _select(values, vertex.index)


def _mirrored(world: World, vertex: Vertex) -> tuple[Flag, Vector]:
    values = [(k, jnp.asarray(m.reflectance)) for k, m in enumerate(world.materials) if isinstance(m, Mirror)]
    reflectance = _select(values, vertex.index)
    assert reflectance is not None
    return _is(world, vertex, Mirror), reflectance


def _select(values: list[tuple[int, Vector]], index: Index) -> Vector | None:
    """The value whose number is `index`; any of them where there is none such."""
    chosen = None
    for k, value in values:
        chosen = value if chosen is None else jnp.where(index == k, value, chosen)
    return chosen


def in_shadow(world: World, vertex: Vertex, settings: Settings) -> Bool[jax.Array, " lights"]:
    """For each light but the sky, whether it fails to reach the vertex: blocked, or behind the surface; shape (lights,)."""
    hit = vertex.index >= 0
    flags = []
    for light in world.lights:
        if not isinstance(light, Sky):
            wi, _, distance = _towards(light, vertex.hit.p)
            flags.append(hit & ~_visible(world, wi, distance, vertex, hit, settings)[0])
    return jnp.stack(flags) if flags else jnp.zeros(0, bool)
