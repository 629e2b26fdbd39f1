"""By how much the radiance jumps across a boundary in the picture, where its sample is seen.

The two sides are not looked for by rays beside the boundary: those would be a distance apart that rounding forbids to be small,
and could stand on both sides of another boundary. Everything is followed from the sample itself, over the triangles that share
its edge: a jump belongs to the edge, or there is none.
"""

import dataclasses
import functools

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax

from ..core.ray import Ray
from ..core.types import Flag, Index, Point2, Scalar, Vector
from ..core.vector import dot, select
from ..preparation.world import World, no_hit
from ..scene.camera import Camera
from ..scene.projection import size_of
from ..shade.radiance import radiance_from, shadowed_radiance
from ..shade.reflectance import depends_on_view
from ..trace.hit import Hit, Status
from ..trace.intersect import hit_on_triangle
from ..xla.masked import only_where
from ..xla.materialise import materialise
from .fold import Fold, fold_at, meet, towards
from .sample import BoundarySample, picture_point


class BoundarySegment(eqx.Module):
    """The boundary in the picture round a sample of it.

    Attributes:
      valid: whether the sample is in the picture.
      x: its position, pixels from the top left corner.
      across: normal to the boundary, of length |dx/ds|; towards the triangle that is nearer to the eye or, for a shadow,
        towards the shadow.
      speed: at which the boundary moves in the picture as the edge is lifted, pixels by the grid's unit of height.
    """

    valid: Flag
    x: Point2
    across: Point2
    speed: Scalar


def pass_edge(world: World, camera: Camera, sample: BoundarySample) -> tuple[BoundarySample, Fold, Hit]:
    """Follows the ray past a sample's edge.

    Returns:
      The sample with the triangle on which its shadow falls; valid where nothing hides the boundary: not the edge from its
      source nor, for a shadow, its place from the eye. The edge's triangles; and the hit behind the edge, where a shadow falls.
    """
    fold = fold_at(world, camera, sample)
    casts, never, past, none = sample.light >= 0, jnp.zeros((), bool), fold.past, jnp.zeros_like(fold.back)
    onwards = dataclasses.replace(fold.ahead, side=-fold.ahead.side)

    def look(known: tuple[Flag, Hit, Flag], number: Index) -> tuple[tuple[Flag, Hit, Flag], None]:
        """From the edge to its source; past the edge; and from a shadow to the eye, on the side from which it was met."""
        free, beyond, _ = known
        back, to_eye = Ray(past.o, -past.d), towards(world, camera, jnp.full((), -1, jnp.int32), beyond.p)
        up = Ray(beyond.p, to_eye[0])
        faces = dot(up.d, beyond.n) * beyond.side.astype(up.d.dtype) > 0
        ways = (
            (back, back, none, fold.near, sample.valid & (fold.bends | ~casts), fold.distance),
            (past, fold.beside, fold.back, onwards, free & fold.bends, jnp.full_like(fold.back, jnp.inf)),
            (up, up, none, beyond, _falls(sample, fold, free, beyond) & faces, to_eye[1]),
        )
        hit, clear = meet(world, sample, *select(number, enumerate(ways)))
        beyond = lax.cond(number == 1, lambda hits: hits[0], lambda hits: hits[1], (hit, beyond))  # no kernel, unlike `where`
        return (jnp.where(number == 0, clear, free), beyond, clear), None

    # One walk in the compiled program, not three.
    known = never, no_hit(sample.s.dtype), never
    (free, beyond, seen), _ = lax.scan(look, known, jnp.arange(3, dtype=jnp.int32))
    falls = _falls(sample, fold, free, beyond)
    sample = dataclasses.replace(
        sample,
        valid=jnp.where(casts, seen, free),
        receiver=jnp.maximum(beyond.object, 0),
        cell=beyond.cell,
        upper=beyond.triangle == 1,
        t=jnp.where(falls, beyond.t, 0),
    )
    return sample, fold, beyond


def _falls(sample: BoundarySample, fold: Fold, free: Flag, beyond: Hit) -> Flag:
    """Whether a shadow begins at the hit beyond: not on a surface that touches the edge, or shares it as a border."""
    contact = jnp.where(beyond.object == sample.surface, 0, fold.back)
    return (sample.light >= 0) & free & (beyond.status == int(Status.HIT)) & (beyond.t > contact)


def boundary_segment(world: World, camera: Camera, sample: BoundarySample, fold: Fold) -> BoundarySegment:
    """The boundary round a sample: its position in the picture, its normal and its speed, by forward differentiation."""
    at = functools.partial(picture_point, world, camera, sample)
    x, along, valid = materialise(jax.jvp(at, (sample.s,), (jnp.ones_like(sample.s),), has_aux=True))
    length = jnp.sqrt(along[0] * along[0] + along[1] * along[1])
    # Of what would cross the whole picture within less than the rounding of s, no position is known.
    width, height = size_of(camera)
    valid = valid & (length > 0) & (length * float(jnp.finfo(x.dtype).eps) < width + height)
    across = jnp.where(valid, jnp.stack([-along[1], along[0]]), 0)
    _, motion, _ = jax.jvp(functools.partial(at, sample.s), (jnp.zeros_like(fold.across),), (fold.across,), has_aux=True)
    rate = (across[0] * motion[0] + across[1] * motion[1]) / jnp.where(valid, length, 1)
    speed = jnp.abs(rate * fold.across[2])  # along the edge and along the ray the boundary stands still
    speed = jnp.where(valid & jnp.isfinite(speed), speed, 0)
    return BoundarySegment(valid, jnp.where(valid, x, 0), across * jnp.sign(rate), speed)


def radiance_jump(
    world: World, camera: Camera, sample: BoundarySample, fold: Fold, beyond: Hit, active: Flag, side: Index
) -> Vector:
    """One of two parts whose sum is the radiance beyond the boundary minus that on the side of `across`.

    Args:
      world, camera: the scene.
      sample, fold, beyond: from `pass_edge`.
      active: whether the sample counts.
      side: 1: what stands beyond; 0: what stands on the near side, with its sign.
    """
    stands = active & (sample.light < 0)
    light = only_where(stands, _side_radiance, world, fold, beyond, side, stands)
    light = jnp.where(side == 0, -light, light)
    if world.settings.shadows:
        wo = towards(world, camera, jnp.full((), -1, jnp.int32), beyond.p)[0] if depends_on_view(world) else None
        shadow = only_where(active & ~stands, shadowed_radiance, world, sample.light, beyond, wo)
        light = jnp.where(stands, light, jnp.where(active & (side == 1), shadow, 0))
    return light


def _side_radiance(world: World, fold: Fold, beyond: Hit, side: Index, active: Flag) -> Vector:
    """What comes to the eye from the triangle that is near, or from what stands beyond: the other triangle, if that is seen."""
    at = lax.cond(side == 0, lambda ends: ends[0], lambda ends: ends[1], (fold.near, fold.ahead))
    on_triangle = ((number, hit_on_triangle(grid, number, fold.past, at)) for number, grid, _ in world.grids)
    hit = select(jnp.where((side == 0) | ~fold.bends, at.object, -1), on_triangle, beyond)
    return radiance_from(world, fold.past, hit, active)
