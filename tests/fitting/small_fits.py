"""A small terrain in three lights, which the tests of fits share: the same sizes, and so the same programs."""

import dataclasses
import inspect
from typing import Any

import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np

import jaxhf
from jaxhf.fitting.given import Given
from jaxhf.fitting.model.expansion import Expansion, expand, prior_residuals
from jaxhf.fitting.model.linearise import LinearisedEdges
from jaxhf.fitting.model.normal_matrix import in_row
from jaxhf.fitting.model.pictures import checked_pictures
from jaxhf.fitting.model.problem import Problem, make_problem
from jaxhf.fitting.model.unknowns import Unknowns
from jaxhf.fitting.solve.stages import balanced
from jaxhf.scene.procedural import fractal

# No shadows, and a frame that ends inside the terrain: so the interior derivative is that of the picture.
SETTINGS = jaxhf.Settings(shadows=False, samples=1, chunk=1024, edge_samples=0)
LIGHTS = ((0.5, -0.3, 0.6), (0.3, 0.5, 0.6), (-0.5, 0.3, 0.6))
SIZE = 24
CAMERA = jaxhf.Perspective.look_at((0.5, 0.5, 3.0), (0.5, 0.5, 0.0), up=(0, 1, 0), fov=18.6, width=SIZE, height=SIZE)
HALF = jaxhf.Perspective.look_at((0.25, 0.5, 3), (0.25, 0.5, 0), up=(0, 1, 0), fov=7.6, width=SIZE, height=SIZE)
EVERYTHING = jaxhf.Unknown(albedo="constant", exposures=True, offsets=True, light_std=1.0, camera_std=(0.01, 1.0))
TRUTH = fractal([12, 12], seed=3, exponent=3.0, range=(0.0, 0.1))


def scenes(
    heights=None, albedo: Any = 0.7, camera: jaxhf.Perspective | jaxhf.Orthographic = CAMERA, others: Any = ()
) -> list[jaxhf.Scene]:
    heights = np.full_like(TRUTH, 0.05) if heights is None else heights
    field = jaxhf.Object(jaxhf.Heightfield(heights), jaxhf.Matte(albedo))
    return [jaxhf.Scene([field, *others], camera, [jaxhf.Directional(towards)]) for towards in LIGHTS]


def pictures(**options) -> list[np.ndarray]:
    return [np.asarray(jaxhf.render(scene, SETTINGS))[..., 0] for scene in scenes(TRUTH, **options)]


def given(**options) -> Given:
    """With `fit`'s defaults."""
    known = {name: item.default for name, item in inspect.signature(jaxhf.fit).parameters.items()}
    defaults = {"settings": jaxhf.Settings(), "unknown": jaxhf.Unknown()}
    return Given(**{**{field.name: known[field.name] for field in dataclasses.fields(Given)}, **defaults, **options})


def posed(scenes: Any, targets: Any, given: Given) -> tuple[Problem, Unknowns]:
    """As `fit` poses it."""
    targets, weights, noise = checked_pictures(scenes, targets, given.weights, given.noise)
    return make_problem(scenes, targets, dataclasses.replace(given, weights=weights, noise=noise))


def expanded(scenes: list[jaxhf.Scene], targets: list[np.ndarray], **options) -> Expansion:
    """About where a fit starts, in units of one curvature as at its end, but for the errors of samples."""
    problem, unknowns = posed(scenes, targets, given(**options))
    here = expand(unknowns, problem)
    scale = jnp.asarray(balanced(here)[0], problem.basis.scale.dtype)
    return here.of(dataclasses.replace(problem, basis=dataclasses.replace(problem.basis, scale=scale)))


def dense(here: Expansion, roots: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """J of the pictures, by their change with each unknown, J of the priors, by JAX, and which unknowns are not held."""
    basis, dtype = here.problem.basis, here.unknowns.coefficients.dtype
    others = here.unknowns.without_modes()
    flat, unflat = jax.flatten_util.ravel_pytree((jnp.zeros_like(basis.base), others))
    alone = jax.jit(lambda k: unflat(jnp.zeros_like(flat).at[k].set(1)))
    rows = [in_row(here.push(alone(k))) for k in range(flat.size)]

    def priors(x: jax.Array) -> jax.Array:
        """Of unknowns that have moved by x; the base takes what a mode would, so that held heights move, too."""
        surface, more = unflat(x)
        problem = dataclasses.replace(here.problem, basis=dataclasses.replace(basis, base=basis.base + surface, free=None))
        moved = jax.tree.map(lambda a, b: a + b, others, more)
        unknowns = eqx.tree_at(lambda u: u.coefficients, moved, jnp.zeros_like(basis.base), is_leaf=lambda leaf: leaf is None)
        return jax.flatten_util.ravel_pytree(prior_residuals(unknowns, problem))[0]

    free = np.ones(flat.size)
    if basis.free is not None:
        free[: basis.base.size] = np.ravel(basis.free)
    jacobian = np.asarray(jax.jit(jax.jacfwd(priors))(jnp.zeros(flat.size, dtype)), np.float64)
    return roots[:, None] * np.stack(rows, axis=1) * free, jacobian * free, free > 0


def edges_in(pixel: Any, kind: Any, resampled: Any) -> LinearisedEdges:
    """Points on edges of pictures in one channel, a row of each, which lie in these pixels and are moved by nothing."""
    pixel, kind, resampled = (jnp.asarray(values, jnp.int32) for values in (pixel, kind, resampled))
    n, count = pixel.shape
    slopes, vertices = jnp.zeros((n, 1, 1, 5, count)), jnp.zeros((n, 1, 5, count), jnp.int32)
    return LinearisedEdges(slopes, vertices, pixel, kind, resampled)


def rms(values: Any) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if np.size(values) else 0.0


def off_in_shape(heights: Any) -> float:
    """Of the heights but for their mean, over the truth's range, root mean square."""
    error = np.asarray(heights) - TRUTH
    return rms(error - error.mean()) / float(np.ptp(TRUTH))
