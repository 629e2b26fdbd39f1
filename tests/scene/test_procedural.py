"""Heights and textures by formula: the same for the same seed, inside the range that they state, and the right way up."""

import numpy as np
import pytest

from jaxhf.scene.heightfield import MOST_CELLS
from jaxhf.scene.procedural import HEIGHTS, TEXTURES, bumps, checker, fractal, grid, sky, waves


@pytest.mark.parametrize("make", HEIGHTS.values(), ids=HEIGHTS)
def test_heights_are_determined_by_their_seed_and_fill_their_range(make):
    first, again, other = (make([24, 31], seed=seed, range=(-0.1, 0.7)) for seed in (3, 3, 4))
    assert first.shape == (24, 31)
    np.testing.assert_array_equal(first, again)
    assert not np.allclose(first, other)
    assert (first.min(), first.max()) == (-0.1, 0.7)


def test_heights_are_the_same_everywhere():
    """Samples that were made once, on x86-64 Linux with NumPy 2.4: a change here changes every scene that uses them."""
    samples = [make([8, 8], seed=1)[2, 5] for make in (fractal, waves, bumps)]
    np.testing.assert_allclose(samples, [0.7389077942189307, 0.41256120229241067, 0.5473502606933719], rtol=1e-12)


def test_fractal_falls_off_as_its_exponent_says():
    spectrum = np.abs(np.fft.fft2(fractal([256, 256], seed=0, exponent=1.5)))
    frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(256), np.fft.fftfreq(256)))
    used = (frequency > 0.02) & (frequency < 0.5)
    slope = np.polyfit(np.log(frequency[used]), np.log(spectrum[used]), 1)[0]
    assert slope == pytest.approx(-1.5, abs=0.02)  # 50,000 samples of a logarithm that scatters by 0.64


def test_level_fills_what_lies_lower_and_waves_run_where_they_are_sent():
    plain, filled = fractal([32, 32], seed=2), fractal([32, 32], seed=2, level=0.4)
    np.testing.assert_array_equal(filled, np.maximum(plain, 0.4))
    assert (plain < 0.4).any()
    heights = waves([32, 32], seed=1, direction=90.0, spread=0.0)  # to the north: no change from west to east
    np.testing.assert_allclose(heights, np.repeat(heights[:, :1], 32, axis=1), atol=1e-12)
    assert np.ptp(heights[:, 0]) > 0.99


@pytest.mark.parametrize("make", TEXTURES.values(), ids=TEXTURES)
def test_textures_are_determined_and_finite(make):
    first = make([48, 96])
    assert first.shape == (48, 96, 3)
    np.testing.assert_array_equal(first, make([48, 96]))
    assert np.isfinite(first).all()
    assert first.min() >= 0


def test_grid_is_red_along_u_and_green_along_v():
    texels = grid([400, 400], lines=4)
    south_west, south_east, north_west = texels[50, 50], texels[50, 350], texels[350, 50]
    assert south_east[0] > south_west[0] + 0.4
    assert south_east[1] == south_west[1]
    assert north_west[1] > south_west[1] + 0.4
    np.testing.assert_allclose(texels[2, 200], (0.8, 0.02, 0.02))  # the axis v = 0
    np.testing.assert_allclose(texels[250, 2], (0.02, 0.6, 0.02))  # the axis u = 0
    np.testing.assert_allclose(texels[250, 100], (0.03, 0.03, 0.03))  # the line u = 1/4
    # Anti-aliased: coarser texels hold less contrast, not other lines.
    np.testing.assert_allclose(grid([40, 40], lines=4).mean((0, 1)), texels.mean((0, 1)), atol=0.01)


def test_checker_starts_with_its_first_colour():
    texels = checker([2, 4], squares=2, first=(1.0, 0.0, 0.0), second=(0.0, 0.0, 1.0))
    np.testing.assert_array_equal(texels[:, :, 0], [[1, 1, 0, 0], [0, 0, 1, 1]])


def test_sky_is_bright_at_the_sun_and_blue_at_the_top():
    texels = sky([64, 256], sun=(0.0, 0.5), clouds=0.0, sun_radiance=(9.0, 9.0, 9.0))
    np.testing.assert_allclose(texels[32, 0], 9)
    assert np.unravel_index(texels.sum(2).argmax(), (64, 256))[0] in (31, 32)
    np.testing.assert_allclose(texels[32, [1, 2]], texels[32, [-2, -3]])  # u closes on itself round the sun
    top, bottom = texels[-1, 128], texels[0, 128]
    assert top[2] / top[0] > 3
    assert bottom[2] / bottom[0] < 1.2
    clear, cloudy = (sky([64, 256], clouds=clouds) for clouds in (0.0, 0.3))  # clouds cover their part of it
    assert (np.abs(clear - cloudy).max(2) > 0).mean() == pytest.approx(0.3, abs=0.01)


@pytest.mark.parametrize(
    ("make", "parameters", "message"),
    [
        (fractal, {"size": [1, 5]}, r"size must be at least 2 x 2, it is \[1, 5\]"),
        (waves, {"size": [2**15, 2**15]}, f"at most {MOST_CELLS} pixels"),
        (fractal, {"range": (1.0, 0.0)}, r"range must be \(lowest, highest\), it is \[1.0, 0.0\]"),
        (fractal, {"seed": -1}, "seed must be a whole number from 0 on, it is -1"),
        (waves, {"count": 0}, "count must be a whole number from 1 on, it is 0"),
        (waves, {"lengths": (0.5, 0.1)}, r"lengths must be \(shortest, longest\), both positive, they are \[0.5, 0.1\]"),
        (bumps, {"radius": 0.0}, "radius must be positive and finite, it is 0.0"),
        (grid, {"lines": 0}, "lines must be a whole number from 1 on, it is 0"),
        (sky, {"clouds": 1.5}, r"clouds must lie in 0..1, it is 1.5"),
        (sky, {"sun_radius": 0.0}, "sun_radius must be positive and finite, it is 0.0"),
    ],
)
def test_bad_parameters_are_named(make, parameters, message):
    with pytest.raises(ValueError, match=message):
        make(**{"size": [8, 8], **parameters})
