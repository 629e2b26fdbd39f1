"""The noise of a detector, which grows with what it measures: a number for each picture, and weights."""

import re

import numpy as np
import pytest
from small_fits import SETTINGS, TRUTH, pictures, scenes
from test_windows import ABOVE, PLAIN, scenes as in_windows

import jaxhf
from jaxhf.fitting import windows as _windows
from jaxhf.fitting.model.pictures import checked_pictures

READ, GAIN = 0.002, 0.0005
DETECTOR = jaxhf.Noise(READ, GAIN)
KNOWN = jaxhf.Prior(0.05, 0.03, 0.2)
SOUGHT = jaxhf.Unknown(albedo="constant")  # in all fits, for the same programs


def by_hand(target: np.ndarray, weight: np.ndarray | float = 1.0) -> tuple[float, np.ndarray]:
    """The noise at weight 1, and the weights."""
    weight = np.broadcast_to(weight, target.shape)
    variance = READ**2 + GAIN * np.maximum(target, 0)
    noise = np.sqrt(np.mean(variance[weight > 0]))
    return float(noise), weight * noise / np.sqrt(variance)


def noisy() -> list[np.ndarray]:
    rng = np.random.default_rng(2)
    return [(t + rng.normal(0, np.sqrt(READ**2 + GAIN * t))).astype(np.float64) for t in pictures()]


def test_a_detectors_noise_is_that_of_weights_made_by_hand():
    targets, masks = noisy(), [None, np.tile([0.0, 1.0, 1.0], (24, 8)), None]
    found = jaxhf.fit(scenes(), targets, noise=DETECTOR, weights=masks, prior=KNOWN, unknown=SOUGHT, settings=SETTINGS)
    noise, weights = zip(*(by_hand(t, 1.0 if m is None else m) for t, m in zip(targets, masks, strict=True)), strict=True)
    same = jaxhf.fit(scenes(), targets, noise=noise, weights=weights, prior=KNOWN, unknown=SOUGHT, settings=SETTINGS)
    np.testing.assert_array_equal(found.heights, same.heights)
    np.testing.assert_array_equal(found.noise, noise)
    assert found.stats["chi2"] == same.stats["chi2"]
    assert 0.9 < found.stats["chi2"] < 1.1
    # By the recipe of weights alone, with a noise of 1: to a tenth of what a fit leaves undone.
    recipe = [weight / one for weight, one in zip(weights, noise, strict=True)]
    other = jaxhf.fit(scenes(), targets, noise=1.0, weights=recipe, prior=KNOWN, unknown=SOUGHT, settings=SETTINGS)
    np.testing.assert_allclose(found.heights, other.heights, atol=1e-3 * np.ptp(TRUTH))


def test_dark_pixels_count_more_than_bright_ones():
    """A factor that dark and bright pixels contradict each other about is their mean by the variances of their noise."""
    rugged = 3 * TRUTH  # of which dark pixels are a quarter as bright as bright ones
    exact = [np.asarray(jaxhf.render(scene, SETTINGS))[..., 0] for scene in scenes(rugged)]
    dark = [image < np.median(image) for image in exact]
    targets = [np.where(where, 1.01, 0.99) * image for image, where in zip(exact, dark, strict=True)]
    known, noise = jaxhf.Prior(rugged, 1e-5, 0.2), jaxhf.Noise(0.0002, 0.0001)
    found = jaxhf.fit(scenes(rugged), targets, prior=known, unknown=SOUGHT, noise=noise, settings=SETTINGS)
    told = [1 / (0.0002**2 + 0.0001 * target) for target in targets]
    above = sum(np.sum(w * image * target) for w, image, target in zip(told, exact, targets, strict=True))
    below = sum(np.sum(w * image**2) for w, image in zip(told, exact, strict=True))
    alike = sum(np.sum(image * target) for image, target in zip(exact, targets, strict=True)) / sum(np.sum(i**2) for i in exact)
    assert found.albedo is not None
    factor = float(np.mean(found.albedo))
    assert above / below > alike + 1e-3
    assert abs(factor - above / below) < 0.1 * (above / below - alike)  # residuals of a third of the noise are robust's to 2 %


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_what_is_no_measurement_does_not_count(dtype):
    """Values are compared as the target is stored: 0.7 in single precision is less than 0.7."""
    targets = [np.full((24, 24), 0.1, dtype) for _ in range(3)]
    targets[0][0, :4] = 0.7, 0.8, -9999.1, np.nextafter(dtype(0.7), dtype(0))
    targets[1][0, :2] = np.nan, -0.5
    noise = [jaxhf.Noise(0.01, saturation=0.7, nodata=-9999.1), jaxhf.Noise(0.01, 0.1, nodata=np.nan), 0.02]
    kept, weights, found = checked_pictures(scenes(), targets, None, noise)
    assert [list(weight[0, :5, 0] > 0) for weight in weights[:2]] == [[False] * 3 + [True] * 2, [False] + [True] * 4]
    np.testing.assert_array_equal([np.isnan(target).sum() for target in kept], [3, 1, 0])
    np.testing.assert_array_equal(weights[2], 1)
    np.testing.assert_allclose(found, [0.01, np.sqrt(0.01**2 + 0.1 * 0.1 * 574 / 575), 0.02], rtol=1e-6)
    np.testing.assert_allclose(weights[1][0, 1, 0], found[1] / 0.01)  # below 0 is read noise alone


def test_windows_take_it(monkeypatch):
    """Each picture's number is that of the whole, and so are the weights."""
    asked = []
    monkeypatch.setattr(_windows, "fit", lambda scenes, targets, **options: asked.append(options) or 1 / 0)
    views, target = in_windows(np.zeros((48, 48), np.float32), ABOVE)[:1], np.random.default_rng(0).uniform(0, 1, (48, 48))
    with pytest.raises(ZeroDivisionError):
        jaxhf.fit_windows(views, [target], prior=jaxhf.Prior(0.0, 0.1), window=32, noise=DETECTOR, settings=PLAIN)
    noise, weights = by_hand(target)
    np.testing.assert_allclose(asked[0]["noise"], [noise], rtol=1e-12)
    (weight,) = asked[0]["weights"]
    assert np.count_nonzero(weight) > 300
    assert np.isin(weight[weight > 0].round(9), weights.round(9)).all()


BAD = [
    ({"read": 0.0}, "Noise: read must be positive and finite, it is 0.0"),
    ({"read": None}, "Noise: read must be positive and finite, it is None"),
    ({"read": 1.0, "gain": -1.0}, "Noise: gain must be from 0 on and finite, it is -1.0"),
    ({"read": 1.0, "gain": np.inf}, "Noise: gain must be from 0 on and finite, it is inf"),
    ({"read": 1.0, "saturation": 0.0}, "Noise: saturation must be positive and finite, it is 0.0"),
    ({"read": 1.0, "nodata": "none"}, "Noise: nodata must be a number, it is 'none'"),
]


@pytest.mark.parametrize(("options", "message"), BAD, ids=[message for _, message in BAD])
def test_a_detector_that_cannot_be_is_refused(options, message, as_users_call_it):
    with pytest.raises(jaxhf.ArgumentError, match=re.escape(message)):
        jaxhf.Noise(**options)


@pytest.mark.parametrize(
    ("noise", "message"),
    [
        ([DETECTOR] * 2, "noise must be positive or a jaxhf.Noise, one or one for each scene, it is [Noise(read=0.002"),
        ([DETECTOR, 0.1, -1.0], "noise must be positive or a jaxhf.Noise, one or one for each scene, it is [Noise(read=0.002"),
        ([DETECTOR, 0.1, "x"], "noise must be positive or a jaxhf.Noise, one or one for each scene, it is [Noise(read=0.002"),
        (jaxhf.Noise(0.1, saturation=1e-9), "targets[0] must have values with a weight that are below its Noise's saturation"),
    ],
)
def test_a_detector_that_does_not_fit_is_refused(noise, message, as_users_call_it):
    with pytest.raises(jaxhf.ArgumentError, match=re.escape(message)):
        jaxhf.fit(scenes(), [np.full((24, 24), 0.1)] * 3, noise=noise)
