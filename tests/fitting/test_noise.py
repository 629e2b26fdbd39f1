"""How large noise is where heights are as many as pixels, and so explain a part of it."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from small_fits import SETTINGS as SMALL, SIZE, TRUTH, edges_in, expanded, given, posed, scenes as small_scenes

import jaxhf
from jaxhf.fitting.model.linearise import changing_pixels
from jaxhf.fitting.solve import noise as _noise, run as _run
from jaxhf.fitting.solve.noise import OCTAVES, Restricted
from jaxhf.fitting.trust.facts import misfit_of_length

SUNS = ((315, 20), (60, 30), (180, 40))
SETTINGS = jaxhf.Settings(normals="six", edge_samples=0)
N = 33
NOISE = 0.001


def terrain(seed: int, relief: float) -> tuple[np.ndarray, np.random.Generator]:
    """Fractal heights whose spectrum is not the prior's, and what draws the noise."""
    rng = np.random.default_rng(seed)
    frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(N, 1 / N), np.fft.fftfreq(N, 1 / N)))
    amplitude = np.where(frequency > 0, np.maximum(frequency, 1) ** -2.3, 0)
    heights = np.fft.ifft2(np.fft.fft2(rng.standard_normal((N, N))) * amplitude).real
    return heights * relief / heights.std(), rng


def scenes(heights: np.ndarray, count: int) -> list[jaxhf.Scene]:
    """One pixel a height, from straight above."""
    middle = (N - 1) / 2
    camera = jaxhf.Orthographic.look_at(
        (middle, middle, 1e3), (middle, middle, 0), up=(0, 1, 0), extent=N - 1, width=N - 1, height=N - 1
    )
    ground = jaxhf.Object(jaxhf.Heightfield(heights.astype(np.float32), dx=1.0), jaxhf.Matte(0.3))
    return [jaxhf.Scene([ground], camera, [jaxhf.Directional.from_angles(*sun, 1.0)]) for sun in SUNS[:count]]


def fitted(seed: int, relief: float, count: int, matte: bool = True, **options) -> jaxhf.Fit:
    """From a flat start and its prior, to pictures with 0.1 % noise of a surface that is Lambert's or the Moon's."""
    heights, rng = terrain(seed, relief)
    targets = []
    for scene in scenes(heights, count):
        image, aovs = jaxhf.render(scene, jaxhf.Settings(samples=16), aovs=("normal",))
        exact = np.asarray(image)[..., 0] if matte else moonlit(scene, np.asarray(aovs["normal"]))
        targets.append(exact + NOISE * rng.standard_normal(exact.shape))
    known = {"settings": SETTINGS, "prior": jaxhf.Prior(0.0, relief, 4.0)}
    return jaxhf.fit(scenes(0 * heights, count), targets, **known | options)


def moonlit(scene: jaxhf.Scene, normal: np.ndarray) -> np.ndarray:
    """By Lommel and Seeliger: 2 μ0 / (μ0 + μ) in place of μ0."""
    (sun,) = scene.lights
    assert isinstance(sun, jaxhf.Directional)
    towards = np.asarray(sun.towards)
    incident, emitted = np.maximum(normal @ towards, 0) / np.linalg.norm(towards), np.maximum(normal[..., 2], 1e-6)
    return 0.3 / np.pi * 2 * incident / (incident + emitted)


@pytest.mark.deep  # the noise of common pictures is in test_fit_truth.py
@pytest.mark.parametrize(("count", "seed"), [(1, 1), (3, 2)])
def test_noise_is_found_where_heights_explain_a_part_of_it(count, seed):
    """To a tenth, and chi2 by degree of freedom is about 1; raw residuals say 0.15 and 0.5 to 0.8 of the noise."""
    found = fitted(seed, 0.6, count)
    np.testing.assert_allclose(found.noise, NOISE, rtol=0.1)
    assert 0.9 < found.stats["chi2"] < 1.2
    assert found.warnings == ()


@pytest.mark.deep
@pytest.mark.parametrize("count", [1, 3])
def test_noise_is_found_in_spite_of_shadows_that_stand_elsewhere(count):
    """No points on edges move them, so a part of the pictures is never explained; chi2 says so."""
    found = fitted(0, 1.2, count)
    np.testing.assert_allclose(found.noise, NOISE, rtol=0.15)  # as is their doing: 0.94 to 1.13 of it over four seeds
    assert found.stats["chi2"] > 1.2


@pytest.mark.deep  # test_fit_truth.py has it of common pictures
def test_chi2_is_by_degree_of_freedom_where_the_noise_is_given():
    found = fitted(1, 0.6, 1, noise=NOISE)
    assert 0.8 < found.stats["chi2"] < 1.2  # of some 340 degrees of freedom: to 8 %
    assert found.warnings == ()


@pytest.mark.parametrize(("length", "fits"), [(1.0, False), (6.0, True)])
def test_a_prior_length_that_does_not_fit_is_named(length, fits):
    """Such as one in cells where it is in metres: too short for what the prior is off by, which is smooth."""
    smooth = 0.6 * np.sin(np.arange(N) / 5)[:, None] * np.cos(np.arange(N) / 6)
    options = given(prior=jaxhf.Prior(0.0, float(smooth.std()), length))
    problem, _ = posed(scenes(smooth, 1), [np.zeros((N - 1, N - 1))], options)
    said = misfit_of_length(problem, options)
    assert said is None if fits else "its length, 1 or 1 cells, may be too short" in str(said)


@pytest.mark.deep
def test_a_noise_that_pictures_cannot_tell_is_asked_for():
    """One sun and no prior: the heights explain nearly all of the picture, noise included."""
    found = fitted(1, 0.6, 1, prior=None, max_steps=30)
    assert any("noise= tells the fit" in warning for warning in found.warnings)


@pytest.mark.deep
def test_a_surface_that_is_not_lamberts_is_a_suspect():
    found = fitted(1, 0.6, 1, matte=False, prior=jaxhf.Prior(0.0, 0.6))
    assert any("does not reflect as its material does" in warning for warning in found.warnings)


def test_pixels_tell_that_change_with_the_heights_that_are_sought():
    """Beside the terrain none do; of a picture in which no shading does, those that a boundary crosses."""
    wide = jaxhf.Perspective.look_at((0.5, 0.5, 3), (0.5, 0.5, 0), up=(0, 1, 0), fov=28.0, width=SIZE, height=SIZE)
    views = small_scenes(TRUTH, camera=wide)
    _, aovs = jaxhf.render(views[0], SMALL, aovs=("object",))
    (known,) = expanded(views, [np.zeros((SIZE, SIZE))] * 3, settings=SMALL, noise=0.01).linearised
    assert known is not None
    np.testing.assert_array_equal(changing_pixels(known), np.stack([np.asarray(aovs["object"]) == 0] * 3))
    assert 0.3 < changing_pixels(known).mean() < 0.7
    edges = edges_in(3 * [[5, 7, 9]], 3 * [[0, 1, 2]], 3 * [[5, 7, 9]])
    told = changing_pixels(dataclasses.replace(known, depends=jnp.zeros_like(known.depends), edges=edges))
    assert [np.flatnonzero(picture).tolist() for picture in told] == 3 * [[7, 9]]


def test_a_part_of_the_pictures_tells_their_noise(monkeypatch):
    """Of a block of heights, and of the pixels that show no others."""
    heights, rng = terrain(1, 0.6)
    (scene,) = scenes(heights, 1)
    exact = np.asarray(jaxhf.render(scene, jaxhf.Settings(samples=16)))[..., 0]
    target = exact + NOISE * rng.standard_normal(exact.shape)
    here = expanded([scene], [target], settings=SETTINGS, prior=jaxhf.Prior(heights, 0.05, 4.0), noise=2 * NOISE)
    whole = Restricted(here).noise(True, np.ones(OCTAVES))
    np.testing.assert_allclose(whole.noise, NOISE, rtol=0.1)
    for name, value in (("_MOST_SIDE", 32), ("_BLOCK", 24), ("_LEAST_TOLD", 100)):
        monkeypatch.setattr(_noise, name, value)
    part = Restricted(here)
    assert 400 < part._values.size < 24 * 24
    found = part.noise(True, np.ones(OCTAVES)).noise
    np.testing.assert_allclose(found, NOISE, rtol=0.15)  # of some 300 degrees of freedom: to 4 %


def test_octaves_that_no_picture_tells_come_back_to_the_priors_std():
    """From where an estimate before had taken them; else those of which pictures tell little run away."""
    heights, _ = terrain(1, 0.6)
    (scene,) = scenes(heights, 1)
    target = np.asarray(jaxhf.render(scene, jaxhf.Settings(samples=16)))[..., 0]
    here = expanded([scene], [target], settings=SETTINGS, prior=jaxhf.Prior(heights, 0.05, 4.0), noise=1e3)
    found = Restricted(here).noise(False, np.full(OCTAVES, 5.0))
    np.testing.assert_allclose(found.widths, 0.2, rtol=0.02)


def fitted_to_a_map(length: float | None) -> float:
    """By what heights are off that are fitted from a map with smooth errors, which is said to have this length."""
    heights, rng = terrain(1, 0.6)
    smooth = gaussian_filter(heights, 3.0)
    exact = np.asarray(jaxhf.render(scenes(heights, 1)[0], jaxhf.Settings(samples=16)))[..., 0]
    target = exact + NOISE * rng.standard_normal(exact.shape)
    prior = jaxhf.Prior(smooth, float((smooth - heights).std()), length)
    found = jaxhf.fit(scenes(smooth, 1), [target], settings=SETTINGS, prior=prior)
    return float(np.std(np.asarray(found.heights) - heights))


def test_errors_of_a_map_are_asked_of_the_pictures(monkeypatch):
    """Where their length is not known; taken for independent they cost most."""
    asked = fitted_to_a_map(None)
    monkeypatch.setattr(_run, "_MOST_WIDTH", 1.0)
    assert asked < 0.8 * fitted_to_a_map(None)


@pytest.mark.slow
def test_a_map_is_as_good_without_the_length_of_its_errors():
    assert fitted_to_a_map(None) < 1.1 * fitted_to_a_map(2.1)
