"""An unknown albedo that all channels of the pictures share."""

from typing import Any

import numpy as np
import pytest
from small_fits import SETTINGS, TRUTH, off_in_shape, pictures, rms, scenes

import jaxhf
from jaxhf.scene.procedural import fractal

NOISE = 0.03
PRIOR = jaxhf.Prior(0.05, 0.03, 0.3)
COLOURS = np.random.default_rng(2).uniform(0.3, 0.9, (12, 12, 3)).astype(np.float32)  # a texel at each vertex
FACTORS = np.exp(fractal([12, 12], seed=9, exponent=2.0, range=(-0.4, 0.4)))[:, :, None].astype(np.float32)
ONE = np.full((1, 1, 1), 0.8, np.float32)
KINDS: dict[str, tuple[Any, np.ndarray, dict[str, Any]]] = {  # how the albedo is known, the factors in truth, what is sought
    "a number": ((0.5, 0.7, 0.3), ONE, {"albedo": "constant"}),
    "a number for each vertex": ((0.5, 0.7, 0.3), FACTORS, {"albedo": "map", "albedo_std": 0.3}),
    "texels": (COLOURS, FACTORS, {"albedo": "map", "albedo_std": 0.3}),
    "texels that hang together": (COLOURS, FACTORS, {"albedo": "map", "albedo_std": 0.3, "albedo_length": 0.5}),
}


def texture(texels: Any) -> jaxhf.ImageTexture:
    return jaxhf.ImageTexture(np.asarray(texels, np.float32), at_vertices=True)


def found(kind: str, seed: int, shared: bool, **options: Any) -> jaxhf.Fit:
    """By three pictures in colour, with noise, of a terrain whose albedo is as known but for grey factors."""
    known, factors, sought = KINDS[kind]
    painted = tuple(0.8 * value for value in known) if factors is ONE else texture(known * factors)
    rng = np.random.default_rng(seed)
    exact = [np.asarray(jaxhf.render(scene, SETTINGS)) for scene in scenes(TRUTH, painted)]
    targets = [image + NOISE * rng.standard_normal(image.shape) for image in exact]
    albedo = texture(known) if isinstance(known, np.ndarray) else known
    unknown = jaxhf.Unknown(**sought, albedo_shared=shared)
    return jaxhf.fit(scenes(albedo=albedo), targets, unknown=unknown, settings=SETTINGS, noise=NOISE, prior=PRIOR, **options)


DEEP, SLOW = pytest.mark.deep, pytest.mark.slow


# test_expansion.py has their derivatives.
@pytest.mark.parametrize("kind", [pytest.param(kind, marks=DEEP if kind == "texels" else SLOW) for kind in KINDS])
def test_factors_that_channels_share_are_found(kind):
    """Three times as many values tell each: where it stands for itself it is √3 times nearer; the heights are no worse.

    Beside the border, of which the pictures show a part.
    """
    _, factors, _ = KINDS[kind]
    shared, each = (found(kind, 4, which, draws=8 * which) for which in (True, False))
    assert shared.albedo is not None
    assert each.albedo is not None
    assert shared.albedo.shape == factors.shape
    assert each.albedo.shape == (*factors.shape[:2], 3)
    within = np.s_[:] if factors is ONE else np.s_[1:-1, 1:-1]
    off, off_each = (rms((np.asarray(fit.albedo) - factors)[within]) for fit in (shared, each))
    assert off < (0.9 if factors is ONE else 0.75) * off_each
    assert off_in_shape(shared.heights) < 1.03 * off_in_shape(each.heights)
    assert shared.std is not None
    assert 0.5 < rms(np.asarray(shared.heights) - TRUTH) / rms(shared.std) < 2
    for scene, image in zip(shared.scenes, shared.images, strict=True):
        np.testing.assert_allclose(jaxhf.render(scene, SETTINGS), image, atol=1e-5)


def test_grey_pictures_have_one_channel_to_share_it():
    """The same bits."""
    targets = [image + NOISE * np.random.default_rng(1).standard_normal(image.shape) for image in pictures()]
    shared, each = (
        jaxhf.fit(
            scenes(), targets, unknown=jaxhf.Unknown(albedo="map", albedo_std=0.3, albedo_shared=which), settings=SETTINGS,
            noise=NOISE, max_steps=4,
        )
        for which in (True, False)
    )  # fmt: skip
    np.testing.assert_array_equal(shared.heights, each.heights)
    np.testing.assert_array_equal(shared.albedo, each.albedo)
    assert np.ptp(np.asarray(shared.albedo)) > 0.01
