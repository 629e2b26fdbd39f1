"""Products with the derivative of linearised pictures: the pictures themselves, with that derivative."""

import math

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Float, Int

from ...core.autodiff import with_tangent
from ...preparation.world import make_world, resolve_settings
from ...rendering.samples import PictureSamples
from ...scene.scene import Scene
from ...xla.devices import on_every_device, over_spread
from .linearise import Linearised, LinearisedEdges, SampleRows
from .pictures import Group, vertex_values
from .problem import Problem
from .unknowns import Unknowns, View

# Chunks of samples that one lookup serves: in pieces of 64 a product took half as long again.
_TOGETHER = 1024
_LEAST_FACTOR = 1e-6  # of an albedo, about which a relative change is taken


def picture_each(
    known: Linearised, group: Group, heights: Float[jax.Array, "ny nx"], unknowns: Unknowns, problem: Problem
) -> Float[jax.Array, "n h w c"]:
    """The pictures that are known, with their derivatives in the heights, in what moves lights and cameras, and in the albedo's
    factors; all of these must have the values at which `linearise_each` was called."""
    settings, mesh, view, factors = problem.settings, problem.mesh, problem.moves(unknowns, group), problem.factors(unknowns)

    def values(scene: Scene) -> Float[jax.Array, "vertices n"]:
        return vertex_values(make_world(on_every_device(group.complete(scene, heights, factors), mesh), settings))

    scenes = group.scenes
    count = math.prod(heights.shape)
    if jax.tree.leaves(scenes.objects):  # each picture has vertices of its own
        each = lax.map(values, scenes)
        first = jnp.arange(each.shape[0])[:, None, None, None] * count
        at_vertices = each.reshape(-1, each.shape[-1])
    else:
        at_vertices, first = values(jax.tree.map(lambda leaf: leaf[0], scenes)), jnp.int32(0)
    relative = None
    if factors is not None:
        here = lax.stop_gradient(factors)
        relative = factors / jnp.where(jnp.abs(here) < _LEAST_FACTOR, _LEAST_FACTOR, here)
    # All pictures at once: a loop over them would copy what it reads of each.
    of_samples = over_spread(mesh, _of_samples, (at_vertices, first, view, relative), known.samples)
    light = None
    if known.edges is not None:
        places = jnp.minimum(known.edges.vertices, count - 1) + first
        heights = at_vertices[:, 0].at[places].get(mode="promise_in_bounds")
        light = jnp.moveaxis(jnp.sum(known.edges.slopes * heights[:, :, None], axis=3), 2, -1)

    def one(
        image: jax.Array, edges: LinearisedEdges | None, of_samples: jax.Array, light: jax.Array | None, view: View
    ) -> Float[jax.Array, "h w c"]:
        samples = PictureSamples(camera, settings, None if edges is None else edges.resampled)
        change = samples.in_pixels(of_samples)
        if edges is not None and light is not None:
            light = _with_view(light, edges.view, view).reshape(-1, image.shape[-1])
            finer, flat = samples.of_resampled(of_samples).mean(1), change.reshape(-1, image.shape[-1])
            flat = flat.at[edges.resampled].set(finer, unique_indices=True).at[edges.pixel].add(light)
            change = flat.reshape(change.shape)
        return with_tangent(image, change)

    camera, settings = scenes.camera, resolve_settings(settings, scenes)
    return jax.vmap(one)(known.image, known.edges, of_samples, light, view)


def _of_samples(
    shared: tuple[Float[jax.Array, "vertices m"], jax.Array, View, Float[jax.Array, "ty tx k"] | None], rows: SampleRows
) -> Float[jax.Array, "n chunks samples c"]:
    """What samples of n pictures change by: their rows times what they share: what stands at the vertices (and the number of
    each picture's first one), what moves light and camera, and the relative change of the albedo's factors."""
    at_vertices, first, view, relative = shared
    n, chunks, channels, k, size = rows.slopes.shape
    of_one = at_vertices.shape[0] // (n if first.ndim else 1)
    vertices = jnp.minimum(rows.vertices, of_one - 1) + first
    joined = rows.slopes.reshape(-1, channels, k, size), vertices.reshape(-1, 3, size)
    found = _by_vertices(at_vertices, *joined).reshape(n, chunks, channels, size)
    if rows.albedo is not None and relative is not None:
        factors = relative.reshape(-1, relative.shape[-1]).at[rows.albedo.texels].get(mode="promise_in_bounds")
        change = jnp.einsum("nqkts,nqtsk->nqks", rows.albedo.slopes, factors)  # broadcasts factors that channels share
        found = found + (change if channels == change.shape[2] else jnp.sum(change, axis=2, keepdims=True))
    return jax.vmap(_with_view)(jnp.moveaxis(found, 2, -1), rows.view, view)


def _by_vertices(
    at_vertices: Float[jax.Array, "vertices m"],
    slopes: Float[jax.Array, "chunks c k samples"],
    vertices: Int[jax.Array, "chunks 3 samples"],
) -> Float[jax.Array, "chunks c samples"]:
    """The matrix of samples times what stands at the vertices."""
    chunks, channels, _, size = slopes.shape
    parts = math.ceil(chunks / _TOGETHER)

    def in_parts(values: jax.Array) -> jax.Array:
        padded = jnp.pad(values, ((0, -chunks % parts), *((0, 0) for _ in values.shape[1:]))) if chunks % parts else values
        return padded.reshape(parts, -1, *values.shape[1:])

    def part(rows: tuple[jax.Array, jax.Array]) -> jax.Array:
        slopes, vertices = rows
        total = jnp.zeros((slopes.shape[0], channels, size), slopes.dtype)
        # Looked up a row of four at a time and used number by number: 262144 samples took 0.8 ms, and 2.9 ms transposed. A
        # number at a time it was 1.1 and 10 ms, with sums over the rows 11 and 3.9 ms.
        for vertex in range(3):
            row = at_vertices.at[vertices[:, vertex]].get(mode="promise_in_bounds")
            for number in range(row.shape[-1]):
                slope = slopes[:, :, vertex if number == 0 else 3 * vertex + number + 2]
                total = total + slope * row[:, None, :, number]
        return total

    return lax.map(part, (in_parts(slopes), in_parts(vertices))).reshape(-1, channels, size)[:chunks]


def _with_view(change: Float[jax.Array, "chunks n c"], slopes: View, numbers: View) -> Float[jax.Array, "chunks n c"]:
    """What samples change by, with their part from the light and the camera."""
    for slope, values in zip(jax.tree.leaves(slopes), jax.tree.leaves(numbers), strict=True):
        for k in range(values.shape[0]):
            change = change + jnp.moveaxis(slope[:, :, k] * values[k], 1, -1)
    return change
