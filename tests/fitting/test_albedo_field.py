"""An unknown albedo whose logarithm hangs together: its prior, and that a fit tells it from slopes; and a sky's radiance."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxhf
from jaxhf.fitting.model.terms import make_albedo_field
from jaxhf.scene.procedural import fractal

SETTINGS = jaxhf.Settings(samples=1, shadows=False, edge_samples=0)
SIDE, STD, LENGTH = 32, 0.2, 0.5
CELL = 1 / (SIDE - 1)
TRUTH = fractal([SIDE, SIDE], seed=5, exponent=3.0, range=(0.0, 0.06))
FLAT = np.full((SIDE, SIDE), TRUTH.mean(), np.float32)
SPREAD = float(np.std(TRUTH))


def field():
    return make_albedo_field((SIDE, SIDE), (CELL, CELL), STD, LENGTH, np.float32)


def painted(seed: int) -> np.ndarray:
    """Factors that are drawn from the prior."""
    known, modes = field(), np.random.default_rng(seed).standard_normal((SIDE, SIDE, 1), np.float32)
    return np.asarray(known.factors(jnp.asarray(modes) / known.weight))


def scene(heights: np.ndarray, factors: np.ndarray | None = None, sky: float = 0.1) -> jaxhf.Scene:
    """From straight above, a pixel a vertex."""
    down = np.array([[1, 0, 0, 0.5], [0, 1, 0, 0.5], [0, 0, -1, 2], [0, 0, 0, 1]])
    camera = jaxhf.Orthographic(down, extent=SIDE * CELL, width=SIDE, height=SIDE)
    ones = np.ones((SIDE, SIDE, 1)) if factors is None else factors
    albedo = jaxhf.ImageTexture((0.3 * ones).repeat(3, -1).astype(np.float32), at_vertices=True)
    ground = jaxhf.Object(jaxhf.Heightfield(heights.astype(np.float32), CELL, CELL), jaxhf.Matte(albedo))
    return jaxhf.Scene([ground], camera, [jaxhf.Directional.from_angles(135, 40), jaxhf.Sky(sky)])


def picture(*args, **options) -> np.ndarray:
    return np.asarray(jaxhf.render(scene(*args, **options), SETTINGS))[..., 0]


def weights() -> np.ndarray:
    """Without the pixels at the border, which show what is beyond."""
    return np.pad(np.ones((SIDE - 2, SIDE - 2)), 1)


def test_the_logarithm_has_the_deviation_and_correlation_that_are_said():
    length = 0.15
    known = make_albedo_field((SIDE, SIDE), (CELL, CELL), STD, length, np.float32)
    basis = np.asarray(jax.vmap(lambda modes: jnp.log(known.factors(modes)))(jnp.eye(SIDE**2).reshape(-1, SIDE, SIDE, 1)))
    basis = basis.reshape(SIDE**2, SIDE, SIDE) / np.asarray(known.weight).reshape(-1, 1, 1)
    variance = np.sum(basis**2, axis=0)
    assert np.sqrt(variance.mean()) == pytest.approx(STD, rel=1e-4)
    middle = basis[:, SIDE // 2, SIDE // 2]
    for cells in (2, 4, 8):  # the grid ends three lengths from here, and is mirrored there
        found = middle @ basis[:, SIDE // 2, SIDE // 2 + cells] / variance[SIDE // 2, SIDE // 2]
        assert found == pytest.approx(np.exp(-cells * CELL / length), abs=0.06)
    factors = jnp.asarray(painted(0))
    np.testing.assert_allclose(known.factors(known.modes(factors)), factors, rtol=1e-4)


def found_with(unknown: jaxhf.Unknown) -> tuple[jaxhf.Fit, float]:
    """From one picture of a painted terrain; and the error of its slopes along the light, over these slopes."""
    found = jaxhf.fit(
        [scene(FLAT)], [picture(TRUTH, painted(1))], prior=jaxhf.Prior(FLAT, SPREAD, 0.3), noise=0.01, weights=[weights()],
        unknown=unknown, settings=SETTINGS,
    )  # fmt: skip
    of_found, of_truth = (np.diff(values, axis=1)[1:] - np.diff(values, axis=0)[:, 1:] for values in (found.heights, TRUTH))
    return found, float(np.std((of_found - of_truth)[2:-2, 2:-2]) / np.std(of_truth[2:-2, 2:-2]))


def test_one_picture_tells_slopes_from_an_albedo_that_hangs_together():
    found, off = found_with(jaxhf.Unknown(albedo="map", albedo_std=STD, albedo_length=LENGTH, sky_std=0.001))
    assert found.albedo is not None
    assert off < 0.8
    assert np.std(np.asarray(found.heights) - TRUTH) < SPREAD
    assert np.corrcoef(np.log(np.asarray(found.albedo)).ravel(), np.log(painted(1)).ravel())[0, 1] > 0.85


@pytest.mark.slow
def test_factors_each_for_itself_explain_the_picture_by_paint():
    found, off = found_with(jaxhf.Unknown(albedo="map", albedo_std=STD))
    assert off > 1
    assert np.std(np.asarray(found.heights) - TRUTH) > 2 * SPREAD


def test_a_sky_that_was_taken_for_darker_is_found():
    """Where heights and albedo are all but known; of the kinds of unknowns that are sought above, by the same programs."""
    found = jaxhf.fit(
        [scene(TRUTH)], [picture(TRUTH, sky=0.2)], prior=jaxhf.Prior(TRUTH, 1e-4, 0.3), noise=0.001, weights=[weights()],
        unknown=jaxhf.Unknown(albedo="map", albedo_std=0.002, albedo_length=LENGTH, sky_std=1.0), settings=SETTINGS,
    )  # fmt: skip
    sky = found.scenes[0].lights[1]
    assert isinstance(sky, jaxhf.Sky)
    np.testing.assert_allclose(sky.radiance, 0.2, rtol=0.01)
