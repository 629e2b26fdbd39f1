"""The same bits for the same ray, wherever it lies in a picture or a batch and however often, on the CPU.

Tiles and chunks have one fixed size, which makes them one compiled kernel. Two sizes are two kernels, and nothing is promised.
"""

import aimed
import jax
import numpy as np
import pytest
from compare import every_family, heightfield, numpied

import jaxhf

GROUND = aimed.Ground(aimed.random_heights((33, 17), 0.6, seed=3), dx=0.3, dy=0.2)
FIELD = heightfield(GROUND, np.float32)
SETTINGS = jaxhf.Settings(chunk=64)  # tiles of 8 x 8
AOVS = ("depth", "normal", "cell", "shadow")


SUN, LAMP = jaxhf.Directional((-1, 0.5, 0.5), (2, 3, 4)), jaxhf.Point((1.5, 0.25, 2.5), 2.0)


def seen(camera, *lights) -> dict[str, np.ndarray]:
    scene = jaxhf.Scene([jaxhf.Object(FIELD, jaxhf.Matte(0.7))], camera, lights)
    image, aovs = jaxhf.render(scene, SETTINGS, aovs=AOVS)
    return {"image": np.asarray(image), **{name: np.asarray(value) for name, value in aovs.items()}}


def orthographic(width: int, height: int) -> jaxhf.Orthographic:
    """Pixels of 1/16 whatever the size; pictures are cut out of each other's middle."""
    extent = min(width, height) / 16
    return jaxhf.Orthographic.look_at((2.4, -2.0, 4.0), (2.4, 3.2, 0.0), extent=extent, width=width, height=height)


def perspective(width: int, height: int) -> jaxhf.Perspective:
    """`fov` is the angle across the shorter side, so that the longer one may vary."""
    return jaxhf.Perspective.look_at((2.4, -3.0, 4.0), (2.4, 3.2, 0.0), fov=40, width=width, height=height)


@pytest.mark.parametrize(
    ("camera", "whole", "crop", "lights"),
    [
        (perspective, (64, 32), (42, 32), [SUN]),
        pytest.param(orthographic, (64, 64), (58, 32), [SUN, LAMP], marks=pytest.mark.deep),
    ],
)
def test_a_crop_has_the_bits_of_the_whole(camera, whole, crop, lights):
    """The same pixels lie in other tiles, at other places in them: crops are shifted by (3, 16) and by 11 pixels."""
    left, top = ((a - b) // 2 for a, b in zip(whole, crop, strict=True))
    large, small = seen(camera(*whole), *lights), seen(camera(*crop), *lights)
    assert np.ptp(large["image"]) > 0.1
    assert 0.05 < large["shadow"].mean() < 0.95
    for name, value in small.items():
        np.testing.assert_array_equal(value, large[name][top : top + crop[1], left : left + crop[0]], name)


def test_repeated_runs_have_the_same_bits():
    """Also when everything has been compiled anew."""
    first, again = (seen(perspective(64, 32), SUN) for _ in range(2))
    jax.clear_caches()
    anew = seen(perspective(64, 32), SUN)
    for name, value in first.items():
        np.testing.assert_array_equal(value, again[name], name)
        np.testing.assert_array_equal(value, anew[name], name)


def test_rays_have_the_same_bits_in_any_order_and_number():
    (o, d, _), _ = every_family(GROUND, seed=4)
    whole = numpied(jaxhf.cast(FIELD, o, d, SETTINGS))
    shuffled = np.random.default_rng(5).permutation(len(o))
    for chosen in (shuffled, shuffled[:65]):  # a single chunk is another program
        part = numpied(jaxhf.cast(FIELD, o[chosen], d[chosen], SETTINGS))
        for name, values in whole.items():
            np.testing.assert_array_equal(part[name], values[chosen], name)
