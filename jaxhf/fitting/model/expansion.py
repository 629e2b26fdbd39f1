"""The loss of a fit about some unknowns: pictures, residuals, and products with their derivative J.

This is the only place that knows how J is kept: as `Linearised` pictures, or, where mirrors or a sun with a size make samples
depend on more than one triangle, as a program that renders again for each product.
"""

import contextlib
import dataclasses
import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from ...core.autodiff import with_tangent
from ...core.types import AnyArray
from ...preparation.world import make_world, resolve_settings
from ...rendering.render import render_each
from ...rendering.samples import PictureSamples
from ...scene.scene import Scene
from ...xla.compilation import compiled
from ...xla.devices import on_every_device, over_spread
from .linearise import Linearised, LinearisedEach, LinearisedEdges, changing_pixels, linearise
from .pictures import Group, vertex_values, with_albedo, with_material
from .problem import Problem, surface_of
from .sample_rows import SampleRows
from .unknowns import KNOWN, Unknowns, View, moved_each

Rows = list[Float[AnyArray, "_ _ _ _"]]
"""A number for each value of each picture, group by group, shape (n, h, w, c); groups differ in it."""
Surface = tuple[Float[Array, "my mx"], Unknowns]
"""A number for each height of the padded surface, and the other unknowns, without `coefficients`."""
_PROBES = 8  # of the pictures' curvature
# Chunks of samples that one lookup serves: in pieces of 64 a product took half as long again.
_TOGETHER = 1024
_LEAST_FACTOR = 1e-6  # of an albedo, about which a relative change is taken


class Expansion(eqx.Module):
    """A problem about some unknowns, and there the pictures of each group with their derivatives; None where these are not
    kept, see `can_be_linearised`."""

    problem: Problem
    unknowns: Unknowns
    linearised: LinearisedEach

    @property
    def heights(self) -> Float[Array, "ny nx"]:
        return self.problem.basis.crop(surface_of(self.unknowns, self.problem.basis))

    @property
    def is_linearised(self) -> bool:
        """Whether the derivatives of all pictures are kept."""
        return all(known is not None for known in self.linearised)

    def of(self, problem: Problem) -> "Expansion":
        """The same pictures in a problem that differs in noise, priors or basis alone."""
        return dataclasses.replace(self, problem=problem)

    def with_noise(self, noise: Float[np.ndarray, " pictures"]) -> "Expansion":
        """The same with another standard deviation of each picture's values at weight 1, beside the error of their samples."""
        sampling = [None if known is None else np.asarray(known.sampling) for known in self.linearised]
        return self.of(self.problem.with_noise(noise, sampling))

    def pictures(self) -> Rows:
        """As they would be measured."""
        if not self.is_linearised:
            return _pictures(on_every_device(self, self.problem.mesh))
        images: Any = [np.asarray(known.image) for known in self.linearised if known is not None]  # which need no program
        exposures, offsets = jax.tree.map(np.asarray, (self.unknowns.exposures, self.unknowns.offsets))
        with np.errstate(all="ignore"):  # of a fit that ends as not finite
            return _as_measured(images, exposures, offsets, np.asarray(self.problem.bright), self.problem.groups)

    def left(self) -> list[Float[np.ndarray, "n h w c"]]:
        """(picture - target) / noise, by NumPy: each operation of JAX's would be a program to compile."""
        pairs = zip(self.problem.groups, self.pictures(), strict=True)
        with np.errstate(over="ignore"):  # of a fit that ends as not finite
            return [np.asarray(group.weights) * (np.asarray(image) - np.asarray(group.targets)) for group, image in pairs]

    def informing(self) -> list[Bool[np.ndarray, "n h w c"]]:
        """Which values depend on the heights; all of those with a weight where that is not known."""
        found = [np.asarray(group.given) > 0 for group in self.problem.groups]
        pairs = zip(found, self.linearised, strict=True)
        return [counts if known is None else counts & changing_pixels(known)[..., None] for counts, known in pairs]

    def push(self, change: Surface) -> Rows:
        """J times a change of the surface and of the other unknowns: by what the pictures change, in units of the noise."""
        return _push(*on_every_device((self, change), self.problem.mesh))

    def pull(self, rows: Rows) -> Surface:
        """Jᵀ times a number for each value of the pictures."""
        return _pull(*on_every_device((self, rows), self.problem.mesh))

    def random_gradients(self) -> tuple[Float[np.ndarray, "k ny nx"], list[Any]]:
        """The derivatives in each height, and in the other unknowns, of sums of residuals with random normal factors, of a few
        such sums.

        They are exactly zero for a height on which no picture depends, as its column of J is zero; for another height they are
        zero with probability zero. Their covariance over the factors is JᵀJ.
        """
        found, of_others = [], []
        for seed in range(_PROBES):
            rng = np.random.default_rng(seed)
            rows = [rng.standard_normal(group.targets.shape, np.float32) for group in self.problem.groups]
            gradient, others = self.pull([jnp.asarray(row, self.unknowns.coefficients.dtype) for row in rows])
            found.append(self.problem.basis.crop(np.asarray(gradient, np.float64)))
            of_others.append(jax.tree.map(np.asarray, others))
        return np.stack(found), of_others


def expand(unknowns: Unknowns, problem: Problem, then: Callable[[Expansion], None] = lambda about: None) -> Expansion:
    """The problem about these unknowns, where points on edges are drawn and the pictures traced.

    While programs are compiled for that, `then` is called with an expansion of forms alone, to compile others meanwhile."""
    # What enters a compiled program must lie in the same places each time, or it is compiled again for the other ones.
    unknowns, problem = on_every_device((unknowns, problem), problem.mesh)

    def begin(forms: LinearisedEach) -> None:
        with contextlib.suppress(Exception):  # which the user is told of by what is called then
            about = on_every_device(Expansion(problem, unknowns, forms), problem.mesh)
            then(about)
            _pull.compile_ahead(about, [group.targets for group in problem.groups])
            if not about.is_linearised:
                _pictures.compile_ahead(about)

    return Expansion(problem, unknowns, linearise(unknowns, problem, begin))


def residuals(unknowns: Unknowns, about: Expansion) -> tuple[Any, None]:
    """All residuals, whose half squares add up to the loss; the second value is optimistix's auxiliary output.

    Those of the pictures pass through `soften`, so that a solver that accepts steps by the loss needs to know nothing of
    reweighting. (Steps by reweighted least squares left the terrain's border in a wrong place: far outliers pull.)
    """
    problem = about.problem
    pairs = zip(problem.groups, _simulate(unknowns, about, problem.basis.heights(unknowns.coefficients)), strict=True)
    parts = [soften(group.weights * (image - group.targets), problem.loss_scale) for group, image in pairs]
    return (parts, prior_residuals(unknowns, problem)), None


def prior_residuals(unknowns: Unknowns, problem: Problem) -> list[Array]:
    """How far the unknowns are from what is known of them without the pictures, in standard deviations."""
    surface = problem.terms.surface.of_surface(unknowns.coefficients, problem.basis)
    return [surface, *(term.residual(values) for term, values in problem.terms.others(unknowns))]


@functools.partial(compiled, jit=eqx.filter_jit, newer=None)
def _pictures(expansion: Expansion) -> Rows:
    unknowns = expansion.unknowns
    return _simulate(unknowns, expansion, expansion.problem.basis.heights(unknowns.coefficients))


def _by_surface(expansion: Expansion) -> tuple[Callable[[Float[Array, "my mx"], Unknowns], Rows], Surface]:
    """Pictures in units of the noise as a function of the surface and the other unknowns, and these."""
    problem, unknowns = expansion.problem, expansion.unknowns

    def pictures(surface: Float[Array, "my mx"], others: Unknowns) -> Rows:
        images = _simulate(others, expansion, problem.basis.crop(surface))
        return [group.weights * image for group, image in zip(problem.groups, images, strict=True)]

    return pictures, (problem.basis.surface(unknowns.coefficients), unknowns.without_modes())


@functools.partial(compiled, jit=eqx.filter_jit, newer=None)
def _push(expansion: Expansion, change: Surface) -> Rows:
    pictures, here = _by_surface(expansion)
    return jax.jvp(pictures, here, change)[1]


@functools.partial(compiled, jit=eqx.filter_jit, newer=None)
def _pull(expansion: Expansion, rows: Rows) -> Surface:
    pictures, here = _by_surface(expansion)
    return jax.vjp(pictures, *here)[1](rows)


def _simulate(unknowns: Unknowns, about: Expansion, heights: Float[Array, "ny nx"]) -> Rows:
    """The pictures as they would be measured: with their exposures and offsets; a grey one is the mean of the channels."""
    problem, images = about.problem, []
    for group, known in zip(problem.groups, about.linearised, strict=True):
        if known is not None:
            image = _picture_each(known, group, heights, unknowns, problem)
        else:
            factors, seen = problem.factors(unknowns), _common(unknowns, problem)
            complete = functools.partial(group.complete, heights=heights, factors=factors, numbers=seen)
            views = moved_each(group.scenes, problem.moves(unknowns, group))
            image = render_each(views, complete, problem.settings, problem.mesh)
            if group.targets.shape[-1] == 1:
                image = jnp.mean(image, axis=-1, keepdims=True)
        images.append(image)
    return _as_measured(images, unknowns.exposures, unknowns.offsets, problem.bright, problem.groups)


def _as_measured(images: Rows, exposures: Any, offsets: Any, bright: Any, groups: Sequence[Group]) -> Rows:
    """The pictures of each group with the exposures and offsets that are sought; by JAX, or by NumPy."""
    if exposures is not None:
        images = [image * group.each(exposures) for image, group in zip(images, groups, strict=True)]
    if offsets is not None:
        images = [image + bright * group.each(offsets) for image, group in zip(images, groups, strict=True)]
    return images


def _picture_each(
    known: Linearised, group: Group, heights: Float[jax.Array, "ny nx"], unknowns: Unknowns, problem: Problem
) -> Float[jax.Array, "n h w c"]:
    """The pictures that are known, with their derivatives in the heights, in what moves lights and cameras, and in the albedo's
    factors; all of these must have the values at which `linearise` was called."""
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


def _common(unknowns: Unknowns, problem: Problem) -> View:
    """By what a material's numbers are moved in all pictures."""
    material, unit = unknowns.view.material, problem.view_unit.material
    return KNOWN if material is None or unit is None else View(material=material[0] * unit, names=unknowns.view.names)


def found_scenes(scenes: Sequence[Scene], unknowns: Unknowns, problem: Problem) -> tuple[Scene, ...]:
    """The scenes as they were given, with all that was found; positions keep double precision."""
    heights, found = problem.basis.crop(surface_of(unknowns, problem.basis)), list(scenes)
    factors = problem.factors(unknowns)
    for group in problem.groups:
        # A far camera moves as one whose rays begin at its matrix: by that the eye moves, and given ones have no `_ahead`.
        plain = eqx.tree_at(lambda scenes: scenes.camera._ahead, group.scenes, None, is_leaf=lambda leaf: leaf is None)
        views = moved_each(plain, problem.moves(unknowns, group))
        new, old = ((part.lights, part.camera) for part in (views, plain))
        change = jax.tree.map(lambda new, old: np.asarray(new) - np.asarray(old), new, old)
        for n, k in enumerate(group.indices):
            scene = with_material(scenes[k].with_heights(heights), jax.tree.map(np.asarray, _common(unknowns, problem)))
            if factors is not None:
                scene = with_albedo(scene, factors)
            if jax.tree.leaves(unknowns.view):
                given = scene.lights, scene.camera
                lights, camera = jax.tree.map(lambda leaf, more, n=n: np.asarray(leaf) + more[n], given, change)
                scene = scene.with_lights(lights).with_camera(camera)
            found[k] = scene
    return tuple(found)


def soften(residual: Array, scale: Float[AnyArray, ""]) -> Array:
    """A residual whose half square is ρ of the given one: sign(r) √(2ρ(r)); k = scale, in standard deviations.

    ρ is the robust loss of the pictures: Geman and McClure's (1985), ρ(r) = r²/2 / (1 + (r/k)²), which forgets what is far off.
    """
    return residual / jnp.sqrt(1 + (residual / scale) ** 2)


def influence_function(
    residual: Float[np.ndarray, " n"], scale: Float[AnyArray, ""]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """ψ = ρ', its derivative, and ψ / r, the weight of residuals in iteratively reweighted least squares."""
    square = (residual / float(scale)) ** 2
    weight = 1 / (1 + square) ** 2
    return weight * residual, weight * (1 - 3 * square) / (1 + square), weight
