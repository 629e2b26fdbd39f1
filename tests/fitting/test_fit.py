"""Fits of small pictures, one for each kind of unknown, by what comes out: each against the truth, in single precision."""

import dataclasses
import re
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.special
from small_fits import HALF, LIGHTS, SETTINGS, SIZE, TRUTH, off_in_shape, pictures, rms, scenes

import jaxhf
from jaxhf.core.affine import rotate
from jaxhf.fitting.model.unknowns import differences

OPTIONS: dict[str, Any] = {"settings": SETTINGS, "noise": 0.01}


@pytest.fixture(scope="module")
def targets() -> list[np.ndarray]:
    return pictures()


def test_heights_come_back_from_a_flat_start(targets):
    """To single precision. One picture has a hole, where its target means nothing."""
    weights = [np.ones((SIZE, SIZE)), None, None]
    weights[0][4:7, 5:9] = 0
    spoilt = [np.where(weights[0] > 0, targets[0], np.nan), *targets[1:]]
    lines = []
    found = jaxhf.fit(scenes(), spoilt, **OPTIONS, weights=weights, progress=lines.append)
    assert found.result is jaxhf.Stop.CONVERGED
    assert rms(np.asarray(found.heights) - TRUTH) < 2e-3 * np.ptp(TRUTH)  # what a step of no use leaves
    assert found.heights.dtype == np.float32
    assert found.seen.all()
    assert found.std is None
    assert [line._replace(to_come=None) for line in lines] == list(found.history)
    assert found.stats["steps"] == len(lines) == lines[-1].step
    assert lines[-1].loss == found.stats["loss"] < 1e-4 * lines[0].loss
    for image, residual, target in zip(found.images, found.residuals, targets, strict=True):
        assert image.shape == residual.shape == (SIZE, SIZE)
        np.testing.assert_allclose(image, target, atol=3e-4)  # a thirtieth of the noise
    assert np.all(found.residuals[0][4:7, 5:9] == 0)


def test_what_follows_the_pictures_is_compiled_beside_them(targets, programs):
    """And no program twice, as if another had been guessed than comes."""
    jax.clear_caches()
    jaxhf.fit(scenes(), targets, **OPTIONS)
    names, beside = [name for name, _ in programs], {name for name, other in programs if other}
    assert len(names) == len(set(names))
    assert beside == {"_made_world", "_rows_of_samples", "_advance", "_pull"}


def test_another_fit_of_the_same_size_compiles_nothing(targets, compilations):
    jaxhf.fit(scenes(), targets, **OPTIONS)
    compilations.clear()
    other = jaxhf.fit(scenes(), [0.9 * target for target in targets], **OPTIONS)
    assert not compilations
    assert other.result is jaxhf.Stop.CONVERGED


@pytest.mark.x64
@pytest.mark.deep
def test_heights_come_back_to_double_precision():
    """What stops a fit in single precision is rounding alone."""
    found = jaxhf.fit(scenes(), pictures(), settings=SETTINGS, noise=1e-5)
    assert found.result is jaxhf.Stop.CONVERGED
    assert found.heights.dtype == np.float64
    assert rms(np.asarray(found.heights) - TRUTH) < 1e-5 * np.ptp(TRUTH)


def test_wild_pixels_are_let_go(targets):
    """A twentieth of them, brighter than all others, and 0.2 % noise: heights are off by at most 1 %."""
    rng, wild = np.random.default_rng(1), []
    for target in targets:
        noisy = target + 0.002 * rng.standard_normal(target.shape)
        wild.append(np.where(rng.uniform(size=target.shape) < 0.05, 1.0, noisy))
    assert off_in_shape(jaxhf.fit(scenes(), wild, settings=SETTINGS, noise=0.002).heights) < 0.02


@pytest.mark.deep  # each alone, and wild pixels, are in other tests
def test_exposures_and_the_albedo_come_back_in_spite_of_outliers(targets):
    """As a product. A twentieth of the pixels is wild."""
    rng, truth = np.random.default_rng(1), np.array([1.0, 1.2, 0.9])
    measured = [0.8 * exposure * picture for picture, exposure in zip(targets, truth, strict=True)]
    for picture in measured:
        picture += 0.001 * rng.standard_normal(picture.shape)
        picture[rng.uniform(size=picture.shape) < 0.05] = 1.0
    found = jaxhf.fit(
        scenes(), measured, settings=SETTINGS, noise=0.001, unknown=jaxhf.Unknown(albedo="constant", exposures=True)
    )
    assert found.albedo is not None
    assert found.albedo.shape == (1, 1, 1)
    np.testing.assert_allclose(np.asarray(found.exposures) * float(found.albedo[0, 0, 0]), 0.8 * truth, rtol=0.01)
    assert off_in_shape(found.heights) < 0.02


def test_a_map_of_the_albedo_comes_back():
    """Three pictures say for each place its slopes and its albedo, so priors pull by 1e-5; at the border they show little."""
    y, x = np.mgrid[0:1:12j, 0:1:12j]
    factor = 1 + 0.3 * np.sin(5 * x + 3 * y)
    painted = pictures(albedo=jaxhf.ImageTexture(0.7 * factor[..., None].repeat(3, axis=-1)))
    found = jaxhf.fit(scenes(), painted, settings=SETTINGS, noise=0.001, unknown=jaxhf.Unknown(albedo="map"))
    assert found.albedo is not None
    assert found.albedo.shape == (12, 12, 1)
    np.testing.assert_allclose(np.asarray(found.albedo)[..., 0], factor, rtol=1e-3)
    assert off_in_shape(found.heights) < 1e-3
    for scene, image in zip(found.scenes, found.images, strict=True):
        np.testing.assert_allclose(jaxhf.render(scene, SETTINGS)[..., 0], image, atol=1e-5)


def test_a_number_of_the_material_comes_back():
    """And heights with it, which are off where it is taken for known; it is found in `scenes`."""
    laws = (jaxhf.LunarLambert(0.7, limb) for limb in (0.2, 0.7))
    guessed, true = (jax.tree.map(jnp.asarray, law) for law in laws)

    def of(law, all_scenes):
        return [eqx.tree_at(lambda scene: scene.objects[0].material, scene, law) for scene in all_scenes]

    targets = [np.asarray(jaxhf.render(scene, SETTINGS))[..., 0] for scene in of(true, scenes(TRUTH))]
    found = jaxhf.fit(
        of(guessed, scenes()), targets, settings=SETTINGS, noise=0.001, unknown=jaxhf.Unknown(material_std={"limb": 1.0})
    )
    np.testing.assert_allclose([scene.objects[0].material.limb for scene in found.scenes], 0.7, rtol=5e-3)  # pyright: ignore[reportAttributeAccessIssue]
    assert off_in_shape(found.heights) < 0.01


def test_exposures_and_offsets_come_back_apart(targets):
    """They trade against each other where slopes are small: a step that is solved to a tenth leaves 0.2 % of that."""
    exposures, offsets = np.array([1.0, 1.2, 0.9]), np.array([0.02, -0.01, 0.05])
    measured = [e * picture + o for picture, e, o in zip(targets, exposures, offsets, strict=True)]
    found = jaxhf.fit(scenes(), measured, settings=SETTINGS, noise=0.001, unknown=jaxhf.Unknown(exposures=True, offsets=True))
    assert found.exposures is not None
    assert found.offsets is not None
    np.testing.assert_allclose(found.exposures, exposures, rtol=0.006)
    np.testing.assert_allclose(found.offsets, offsets, atol=0.004)
    assert off_in_shape(found.heights) < 0.01


EYES = ((0.5, -0.6, 2.2), (1.5, 1.0, 2.2), (-0.5, 1.0, 2.2))


def off_by_a_degree(scene: jaxhf.Scene, k: int) -> jaxhf.Scene:
    """Its light turned by 1 degree, its camera too, and moved by 1 % of the terrain's side."""
    rng = np.random.default_rng(10 + k)
    step, axis, across = rng.standard_normal((3, 3))
    (sun,) = scene.lights
    assert isinstance(sun, jaxhf.Directional)
    pose = np.array(scene.camera.world_from_camera)
    pose[:3, :3] = rotate(1.0, *axis)[:3, :3] @ pose[:3, :3]
    pose[:3, 3] += 0.01 * step / np.linalg.norm(step)
    towards = rotate(1.0, *np.cross(sun.towards, across))[:3, :3] @ np.asarray(sun.towards)
    camera = dataclasses.replace(scene.camera, world_from_camera=pose)
    return scene.with_camera(camera).with_lights([jaxhf.Directional(towards)])


@pytest.mark.deep  # their part of each product is in test_normal_matrix.py
def test_lights_and_cameras_that_are_off_by_a_degree_are_found():
    """An eighth of the heights is surveyed: else terrain, cameras and lights could turn together by a degree.

    As measured: taken as known they leave heights 2.6 times worse than the prior; sought, 2.3 times better.
    """
    rng = np.random.default_rng(6)
    surveyed = np.zeros(TRUTH.shape, bool)
    surveyed[1::4, 1::4] = surveyed[3::4, 3::4] = True
    std = np.where(surveyed, 0.0005, 0.01)
    prior = TRUTH + std * rng.standard_normal(TRUTH.shape)
    cameras = [jaxhf.Perspective.look_at(eye, (0.5, 0.5, 0.05), fov=14.0, width=SIZE, height=SIZE) for eye in EYES]
    given = [scene.with_camera(camera) for scene, camera in zip(scenes(prior), cameras, strict=True)]
    taken = [off_by_a_degree(scene, k).with_heights(TRUTH) for k, scene in enumerate(given)]
    measured = [np.asarray(jaxhf.render(scene, SETTINGS))[..., 0] for scene in taken]
    measured = [picture + 0.001 * rng.standard_normal(picture.shape) for picture in measured]
    options: dict[str, Any] = {"settings": SETTINGS, "noise": 0.001, "prior": jaxhf.Prior(prior, std)}
    known = jaxhf.fit(given, measured, **options)
    found = jaxhf.fit(given, measured, unknown=jaxhf.Unknown(light_std=1, camera_std=(0.01, 1)), draws=50, **options)
    error = np.asarray(found.heights) - TRUTH
    assert rms(np.asarray(known.heights) - TRUTH) > 1.5 * rms(prior - TRUTH)
    assert rms(error) < 0.5 * rms(prior - TRUTH)
    assert found.std is not None
    assert 0.5 < rms(error) / rms(found.std) < 1.5
    for scene, truth, image in zip(found.scenes, taken, found.images, strict=True):
        light, _, rotation = differences(scene, truth)  # a camera's position and rotation trade against each other
        assert light < 0.4
        assert rotation < 0.4
        np.testing.assert_allclose(jaxhf.render(scene, SETTINGS)[..., 0], image, atol=1e-5)


PRIOR_STD, NOISE = 0.004, 0.01


def dense_posterior(settings: jaxhf.Settings = SETTINGS) -> np.ndarray:
    """The covariance of heights by Bayes' rule, as a matrix by NumPy, from `render`'s derivative in each of them."""

    @jax.jit
    def rows(light: jax.Array) -> jax.Array:
        def picture(heights: jax.Array) -> jax.Array:
            scene = scenes(TRUTH)[0].with_lights([jaxhf.Directional(light)])
            return jaxhf.render(eqx.tree_at(lambda s: s.heightfields[0].heights, scene, heights), settings)[..., 0].ravel()

        return jax.jacfwd(picture)(jnp.asarray(TRUTH, light.dtype)).reshape(-1, TRUTH.size)

    jacobian = np.concatenate([np.asarray(rows(jnp.asarray(light)), np.float64) for light in LIGHTS]) / NOISE
    return np.linalg.inv(jacobian.T @ jacobian + np.eye(TRUTH.size) / PRIOR_STD**2)


def noisy_fit(rng: np.random.Generator, targets: list[np.ndarray], draws: int) -> jaxhf.Fit:
    """Of a draw of the truth from the prior, as well as of the noise."""
    noisy = [target + NOISE * rng.standard_normal(target.shape) for target in targets]
    prior = TRUTH + PRIOR_STD * rng.standard_normal(TRUTH.shape)
    return jaxhf.fit(scenes(prior), noisy, settings=SETTINGS, noise=NOISE, prior=jaxhf.Prior(prior, PRIOR_STD), draws=draws)


@pytest.mark.deep  # once, of another renderer's pictures, in test_fit_truth.py
def test_draws_hold_the_truth_as_often_as_they_say(targets):
    """12 fits of 144 heights, with deviations by 50 draws: 68.3 % and 95.4 %, and by the covariance that NumPy finds.

    Of 1728 three binomial deviations are 3.4 and 1.5 points; a fit's heights hang together a little, so it is a bit more.
    """
    covariance = dense_posterior()
    expected = np.sqrt(np.diag(covariance)).reshape(TRUTH.shape)
    rng, errors, deviations = np.random.default_rng(2), [], []
    for _ in range(12):
        found = noisy_fit(rng, targets, 50)
        errors.append(np.asarray(found.heights, np.float64) - TRUTH)
        deviations.append(found.std)
        assert found.warnings == ()
    inside = np.abs(errors) / np.asarray(deviations)
    assert abs(np.mean(inside < 1) - 0.683) < 0.04
    assert abs(np.mean(inside < 2) - 0.954) < 0.02
    # All fits take the same draws, which tell a height's deviation to 10 %. The width of the prior is estimated, too: from this
    # seed 1.043, from the next 1.049 (1.039 and 1.044 before a few modes were held by what its owner says of it).
    ratio = np.mean(deviations, axis=0) / expected
    np.testing.assert_allclose(np.mean(ratio), 1, atol=0.05)
    assert 0.6 < np.std(ratio) * np.sqrt(2 * 50) < 1.4
    # xᵀ C⁻¹ x is chi squared, 1728 degrees of freedom to 3.4 %, times 1.10: what Geman and McClure's loss loses by letting far
    # pixels go, E ψ² / (E ψ')² of normal residuals.
    squares = [np.ravel(error) @ np.linalg.solve(covariance, np.ravel(error)) for error in errors]
    np.testing.assert_allclose(np.mean(squares), 1.10 * TRUTH.size, rtol=0.1)


def test_what_no_picture_shows_is_marked():
    told = []
    found = jaxhf.fit(scenes(camera=HALF), pictures(camera=HALF), **OPTIONS, max_steps=5, draws=20, progress=told.append)
    assert found.result is jaxhf.Stop.MAX_STEPS
    assert [step.to_come for step in told[:5]] == [4, 3, 2, 1, 0]
    unseen = ~found.seen
    assert found.std is not None
    assert unseen[:, 8:].all()  # less than 0.45 of the side is in sight, and normals reach a cell farther
    assert found.seen[4:8, 1:5].all()
    assert np.isinf(found.std[unseen]).all()
    assert np.isfinite(found.std[found.seen]).all()
    ended = r"MAX_STEPS after 5 steps, [\d.]+ s, chi2 [\d.]+, \d+ warnings"
    said = rf"Fit\(12 x 12, heights [\d.]+ \.\. [\d.]+ ± [\d.]+, {ended}\)"
    assert re.fullmatch(said, repr(found))


def test_a_loss_that_is_not_finite_stops_the_fit(targets):
    wild = [targets[0].copy(), *targets[1:]]
    wild[0][3, 3] = 3e38  # times its weight it is infinite
    found = jaxhf.fit(scenes(), wild, **OPTIONS)
    assert found.result is jaxhf.Stop.NON_FINITE
    np.testing.assert_array_equal(found.heights, np.float32(0.05))


def test_terrain_with_a_hole_is_found_from_a_start_without(targets):
    """Whatever stood in the scene's heights counts no more: the same bits as from a scene that was filled in."""
    filled = np.full((12, 12), 0.05)
    holed = np.where(np.arange(144).reshape(12, 12) == 27, np.nan, filled)
    found = jaxhf.fit(scenes(holed), targets, start=filled, **OPTIONS, max_steps=3)
    np.testing.assert_array_equal(found.heights, jaxhf.fit(scenes(filled), targets, **OPTIONS, max_steps=3).heights)
    assert np.ptp(found.heights) > 0.01


def test_heights_that_are_held_stay_as_they_are(targets):
    """A window in terrain that goes on around it: known there, found here, to the deviation that the noise leaves."""
    std = np.zeros((12, 12))
    std[3:9, 3:9] = 0.02
    known = np.where(std > 0, 0.05, TRUTH)
    found = jaxhf.fit(scenes(), targets, **OPTIONS, prior=jaxhf.Prior(known, std), draws=10)  # from a start elsewhere
    heights = np.asarray(found.heights)
    np.testing.assert_array_equal(heights[std == 0], known.astype(np.float32)[std == 0])
    assert rms((heights - TRUTH)[std > 0]) < 0.2 * rms((known - TRUTH)[std > 0])
    assert found.std is not None
    assert found.samples is not None
    assert (found.std[std == 0] == 0).all()
    assert (found.std[std > 0] > 0).all()
    np.testing.assert_allclose(np.sqrt(np.mean((found.samples - heights) ** 2, axis=0)), found.std, atol=1e-7)


def test_a_height_that_is_held_tells_of_those_beside_it(targets):
    """As the errors of the prior hang together, by Whittle's correlation (r/L) K₁(r/L): pictures of such noise tell nothing."""
    held = np.full(TRUTH.shape, np.nan)
    held[5, 6] = 0.12
    found = jaxhf.fit(scenes(), targets, settings=SETTINGS, noise=1e3, prior=jaxhf.Prior(0.1, 0.02, 0.25, held))
    y, x = (np.indices(TRUTH.shape).T - (5, 6)).T / (len(TRUTH) - 1)
    r = np.maximum(np.hypot(x, y) / 0.25, 1e-9)
    np.testing.assert_allclose(np.asarray(found.heights) - 0.1, 0.02 * r * scipy.special.k1(r), rtol=0, atol=1e-3)
    assert found.heights[5, 6] == np.float32(0.12)
    with pytest.raises(
        jaxhf.ArgumentError, match=r"Prior: held must be finite, nan where heights are sought, of shape \(12, 12\)"
    ):
        jaxhf.fit(scenes(), targets, settings=SETTINGS, prior=jaxhf.Prior(0.1, 0.02, 0.25, held[1:]))
    with pytest.raises(jaxhf.ArgumentError, match="its shape is \\(12, 12\\), 0 of them nan"):
        jaxhf.fit(scenes(), targets, settings=SETTINGS, prior=jaxhf.Prior(0.1, 0.02, 0.25, 0 * TRUTH))
    with pytest.raises(jaxhf.ArgumentError, match="Prior: held must be heights, it is a name"):
        jaxhf.Prior(0.1, 0.02, 0.25, "held.tif")


@pytest.mark.deep
def test_a_mirror_beside_the_terrain_goes_the_same_way(targets):
    """Whose samples depend on more than one triangle: then pictures are rendered again for each product."""
    mirror = jaxhf.Object(jaxhf.Heightfield(np.full((2, 2), 0.5), dx=0.1, x0=0.2, y0=0.4), jaxhf.Mirror(0.9))
    measured = [np.asarray(jaxhf.render(scene, SETTINGS))[..., 0] for scene in scenes(TRUTH, others=[mirror])]
    found = jaxhf.fit(scenes(others=[mirror]), measured, **OPTIONS, max_steps=8)
    assert off_in_shape(found.heights) < 0.1
