"""The pictures of a fit and products with their derivative J, against `jaxhf.render` of scenes that are made by hand."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_fits import SETTINGS, SIZE, TRUTH, expanded, given, posed, rms, scenes

import jaxhf
from jaxhf.fitting.model.expansion import Expansion, expand, found_scenes
from jaxhf.fitting.model.normal_matrix import in_row
from jaxhf.fitting.model.rows import pictures_by_heights
from jaxhf.fitting.model.unknowns import Unknowns, differences, moved
from jaxhf.fitting.trust.facts import on_boundaries

PLACE = np.array([[0.9, 0.1, 0.05, 0.1], [-0.1, 0.9, 0.1, 0.2], [0.05, 0.1, 0.8, 0.25], [0, 0, 0, 1]])
SUN, SKY = jaxhf.Directional((0.3, -0.4, 0.5)), jaxhf.Sky(0.1)
LAMP = jaxhf.Point((0.1, 0.3, 0.9), (0.9, 0.8, 0.7))
CAMERAS = [
    jaxhf.Perspective.look_at(eye, (0.5, 0.5, 0.1), fov=50.0, width=width, height=22)
    for eye, width in (((0.6, -0.8, 0.9), 37), ((-0.6, 0.3, 1.1), 30))
]
TEXELS = np.random.default_rng(1).uniform(0.2, 0.9, (3, 4, 3))
KNOWN_LAW = jaxhf.Unknown(albedo="map", exposures=True, offsets=True, light_std=1.0, camera_std=(0.1, 1.0), sky_std=0.5)
EVERYTHING = dataclasses.replace(KNOWN_LAW, material_std={"limb": 0.2})
SHARED = dataclasses.replace(KNOWN_LAW, albedo_shared=True)
MOST = dataclasses.replace(EVERYTHING, albedo_shared=True)
ROUNDING = {"single": 2e-4, "double": 1e-10}  # of the largest value: sums of some hundred terms that are rounded


def waves(ny: int, nx: int, height: float) -> np.ndarray:
    y, x = np.mgrid[0:ny, 0:nx] / max(ny, nx)
    return height * (np.sin(5 * x + 2 * y) + np.cos(3 * x - 6 * y + 1))


def paint(albedo: Any, unknown: jaxhf.Unknown, limb: Any = 0.4) -> jaxhf.Material:
    return jaxhf.LunarLambert(albedo, limb) if unknown.material_std else jaxhf.Matte(albedo)


def scene_of(k: int, crowded: bool, unknown: jaxhf.Unknown = KNOWN_LAW) -> jaxhf.Scene:
    """The sought terrain, turned and painted; if `crowded`, between a cylinder and another heightfield, which has a hole."""
    painted = paint(jaxhf.ImageTexture(TEXELS), unknown)
    objects = [jaxhf.Object(jaxhf.Heightfield(waves(9, 8, 0.05), dx=0.09), painted, PLACE)]
    if crowded:
        holed = waves(12, 10, 0.08) - 0.3
        holed[4, 3] = np.nan
        tube = jaxhf.Object(jaxhf.Cylinder(radius=0.15, z_min=-0.3, z_max=0.3), painted)
        objects = [tube, *objects, jaxhf.Object(jaxhf.Heightfield(holed), jaxhf.Matte((0.3, 0.5, 0.7)))]
    return jaxhf.Scene(objects, CAMERAS[k], (SKY, SUN, LAMP) if crowded else (SKY, SUN))


def moved_expansion(settings: jaxhf.Settings, channels: tuple[int, ...], unknown: jaxhf.Unknown) -> Expansion:
    """Of pictures with so many channels each, about unknowns that have all moved."""
    rng = np.random.default_rng(5)
    targets = [rng.uniform(0.1, 0.3, (22, camera.width, c)) for camera, c in zip(CAMERAS, channels, strict=False)]
    weights = [rng.uniform(0.5, 2.0, target.shape) for target in targets]
    options = given(settings=settings, unknown=unknown, noise=0.01, weights=weights)
    problem, unknowns = posed([scene_of(k, len(channels) > 1, unknown) for k in range(len(targets))], targets, options)
    rng, leaves, tree = np.random.default_rng(7), *jax.tree.flatten(unknowns)
    leaves = [leaf + jnp.asarray(0.02 * rng.standard_normal(leaf.shape), leaf.dtype) for leaf in leaves]
    return expand(jax.tree.unflatten(tree, leaves), problem)


def by_render(expansion: Expansion, unknown: jaxhf.Unknown, surface: jax.Array, others: Unknowns) -> list[jax.Array]:
    """The same pictures in units of the noise, each by `jaxhf.render`."""
    images, problem = [], expansion.problem
    crowded = problem.count > 1
    assert others.albedo is not None
    assert others.exposures is not None
    assert others.offsets is not None
    for group in problem.groups:
        (k,) = group.indices
        scene = eqx.tree_at(lambda scene: scene.heightfields[0].heights, scene_of(k, crowded, unknown), surface)
        texture = jaxhf.ImageTexture(jnp.asarray(TEXELS, surface.dtype) * others.albedo)
        limb, limbs, unit = 0.4, others.view.material, problem.view_unit.material
        if limbs is not None and unit is not None:
            limb = limb + limbs[0, 0] * unit[0]
        painted = paint(texture, unknown, limb)
        scene = eqx.tree_at(lambda scene: scene.objects[int(crowded)].material, scene, painted)
        own = dataclasses.replace(others.view, material=None), dataclasses.replace(problem.view_unit, material=None)
        view = jax.tree.map(lambda values, unit, k=k: values[k] * unit, *own)
        lights, camera = moved(scene.lights, scene.camera, view)
        image = jaxhf.render(dataclasses.replace(scene, lights=lights, camera=camera), problem.settings)
        if group.targets.shape[-1] == 1:
            image = image.mean(-1, keepdims=True)
        images.append(group.weights * (others.exposures[k] * image + problem.bright * others.offsets[k])[None])
    return images


NO_EDGES = jaxhf.Settings(samples=1, chunk=64, shadows=False, edge_samples=0)
EDGES = jaxhf.Settings(samples=4, chunk=256, edge_samples=300)
FLAT = dataclasses.replace(NO_EDGES, shading="flat", samples=4)


@pytest.mark.parametrize(
    ("settings", "channels", "precision", "unknown"),
    [
        (NO_EDGES, (3,), "single", MOST),
        pytest.param(NO_EDGES, (1, 3), "double", EVERYTHING, marks=[pytest.mark.x64, pytest.mark.slow]),
        pytest.param(NO_EDGES, (1, 3), "double", SHARED, marks=[pytest.mark.x64, pytest.mark.slow]),
        pytest.param(EDGES, (3,), "double", KNOWN_LAW, marks=[pytest.mark.x64, pytest.mark.deep]),
        pytest.param(FLAT, (3,), "double", KNOWN_LAW, marks=[pytest.mark.x64, pytest.mark.deep]),
    ],
    ids=["single", "crowded, double", "crowded, shared, double", "edges, double", "flat, double"],
)
def test_products_are_those_of_the_derivative_of_render(settings, channels, precision, unknown, monkeypatch):
    """J and its transpose, in all unknowns at once; and the derivative in heights as a sparse matrix.

    A pixel that is resampled differs from `render`'s in its value, so in exposures times that, which are still there.
    """
    monkeypatch.setattr("jaxhf.fitting.model.linearise._POINTS_PER_PIXEL", 64)  # then as many are resampled as by `render`
    here, rounding = moved_expansion(settings, channels, unknown), ROUNDING[precision]
    others = here.unknowns.without_modes()
    assert others.albedo is not None
    assert others.albedo.shape == (*TEXELS.shape[:2], 1 if unknown.albedo_shared else max(channels))
    rng = np.random.default_rng(3)

    def drawn(tree: Any) -> Any:
        return jax.tree.map(lambda leaf: jnp.asarray(rng.standard_normal(leaf.shape), leaf.dtype), tree)

    at = here.heights, others
    change, rows = drawn(at), drawn([group.targets for group in here.problem.groups])
    if settings.edge_samples:
        change = eqx.tree_at(lambda change: change[1].exposures, change, jnp.zeros(1))
    images, expected = jax.jit(lambda at, change: jax.jvp(lambda *at: by_render(here, unknown, *at), at, change))(at, change)
    found = here.push(change)
    for mine, theirs in zip(found, expected, strict=True):
        np.testing.assert_allclose(mine, theirs, rtol=0, atol=rounding * np.abs(theirs).max())
    left = [image - group.weights * group.targets for image, group in zip(images, here.problem.groups, strict=True)]
    off, resampled = in_row(here.left()) - in_row(left), in_row(on_boundaries(here)) > 0
    np.testing.assert_allclose(off[~resampled], 0, atol=rounding * np.abs(in_row(images)).max())
    assert (np.abs(off[resampled]) > 0.01).any() == (settings.edge_samples > 0)  # of the noise
    there = sum(np.vdot(a, b) for a, b in zip(rows, found, strict=True))
    back = sum(np.vdot(a, b) for a, b in zip(jax.tree.leaves(here.pull(rows)), jax.tree.leaves(change), strict=True))
    np.testing.assert_allclose(back, there, rtol=0, atol=rounding * in_row(found).size * rms(in_row(found)))
    still = change[0], jax.tree.map(jnp.zeros_like, others)
    matrix, by_heights = pictures_by_heights(here), in_row(here.push(still))
    assert matrix is not None
    assert matrix.nnz < 0.3 * np.prod(matrix.shape)
    np.testing.assert_allclose(matrix @ np.ravel(change[0]), by_heights, rtol=0, atol=rounding * np.abs(by_heights).max())


PAINTED = TEXELS.astype(np.float32)
# What is painted, what is sought, in how many channels, and whether these share it: where texels lie has nothing to do with how
# channels go together, so each of both is there twice.
ALBEDOS = {
    "one factor": (0.7, "constant", 3, True),
    "one factor of a texture": (jaxhf.ImageTexture(PAINTED), "constant", 1, False),
    "vertices": (0.7, "map", 3, True),
    "texels that repeat": (jaxhf.ImageTexture(PAINTED), "map", 3, False),
    "texels that end": (jaxhf.ImageTexture(PAINTED, wrap="clamp"), "map", 1, False),
    "texels at vertices": (jaxhf.ImageTexture(PAINTED, at_vertices=True), "map", 3, False),
}


@pytest.mark.deep  # test_fit.py finds a map of it
@pytest.mark.parametrize("name", ALBEDOS)
def test_the_derivative_in_an_albedo_is_a_difference_of_two_pictures(name):
    """Light is proportional to it, so the difference is exact however far apart they are."""
    albedo, kind, channels, shared = ALBEDOS[name]
    scene = scenes(TRUTH, albedo)[:1]
    target = np.random.default_rng(0).uniform(0.1, 0.3, (SIZE, SIZE, channels)).astype(np.float32)
    unknown = jaxhf.Unknown(albedo=kind, albedo_shared=shared)
    here = expanded(scene, [target], settings=SETTINGS, noise=0.1, unknown=unknown)
    assert here.unknowns.albedo is not None
    old = albedo if isinstance(albedo, jaxhf.ImageTexture) else jaxhf.ImageTexture(np.full((1, 1, 3), albedo, np.float32))
    rng, shape = np.random.default_rng(1), here.unknowns.albedo.shape
    assert shape[2] == (1 if shared else channels)
    at = rng.uniform(0.5, 1.5, shape).astype(np.float32)
    here = expand(dataclasses.replace(here.unknowns, albedo=jnp.asarray(at)), here.problem)

    def picture(factors: np.ndarray) -> np.ndarray:
        texture = dataclasses.replace(old, texels=np.asarray(old.texels) * factors)
        image = np.asarray(jaxhf.render(scenes(TRUTH, texture)[0], SETTINGS), np.float64)
        return image.mean(-1, keepdims=True) if channels == 1 else image

    np.testing.assert_allclose(in_row(here.pictures()), np.ravel(picture(at)), rtol=1e-5)
    surface, moves = jnp.zeros_like(here.problem.basis.base), [rng.uniform(-0.4, 0.4, shape).astype(np.float32)]
    for k in rng.permutation(at.size)[:8]:
        moves.append(np.zeros(shape, np.float32))
        moves[-1].flat[k] = 0.4
    expected = np.zeros(0)
    for move in moves:
        change = eqx.tree_at(lambda u: (u.coefficients, u.albedo), here.unknowns, (None, jnp.asarray(move)))
        expected = np.ravel(picture(at + move) - picture(at - move)) / 2 / 0.1
        # To rounding of the pictures, whose largest value is 3 in units of the noise.
        np.testing.assert_allclose(in_row(here.push((surface, change))), expected, atol=1e-5)
    assert rms(expected) > 1e-3


@pytest.mark.parametrize("kind", [jaxhf.Perspective, jaxhf.Orthographic])
def test_lights_and_far_cameras_that_were_found_are_said(kind):
    """A far camera's rays begin in front of the terrain; its eye moves as far as was found, whatever it is turned by."""
    lens = 1.0 if kind is jaxhf.Orthographic else 0.2
    far = kind.look_at((0.5, 0.0, 300.0), (0.5, 0.5, 0.0), (0, 1, 0), lens, width=SIZE, height=SIZE)
    seen, images = scenes(camera=far), [np.zeros((SIZE, SIZE), np.float32)] * 3
    off = jaxhf.Unknown(light_std=1.0, camera_std=(0.3, 1.0))
    problem, unknowns = posed(seen, images, given(unknown=off, settings=SETTINGS))
    unknowns = eqx.tree_at(lambda unknowns: unknowns.view, unknowns, jax.tree.map(lambda leaf: leaf + 0.02, unknowns.view))
    for group in problem.groups:
        assert group.scenes.camera._ahead is not None
        moves = np.asarray(problem.moves(unknowns, group).camera)
        for k, move, turn in zip(group.indices, moves[:, :3], moves[:, 3:], strict=True):
            light, distance, rotation = differences(seen[k], found_scenes(seen, unknowns, problem)[k])
            assert light > 0.1
            angle = np.degrees(2 * np.arctan(np.linalg.norm(turn) / 2))
            np.testing.assert_allclose([distance, rotation], [np.linalg.norm(move), angle], rtol=1e-3)
